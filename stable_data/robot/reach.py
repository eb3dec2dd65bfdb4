"""Whether a robot can carry out the task of a scene: what it reaches, and what it holds in a trial.

The steps of the goal are gone through in order. What a step picks up is surveyed, and grasped in simulated trials; then it is put where
the step wants it, so that later steps find the scene as it then is. Unknown is never a pass: what was not looked at is None.
"""

from collections import Counter
from collections.abc import Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from enum import StrEnum

import numpy as np
from scipy.spatial.transform import Rotation

from stable_data.errors import GoalError, MeshError
from stable_data.robot.arm.assembly import assemble
from stable_data.robot.arm.clearance import HeldObject
from stable_data.robot.arm.kinematics import arm_of
from stable_data.robot.arm.mounting import AUTO, CHOSEN_EDGES, Mount, mount_of, mount_setting
from stable_data.robot.arm.robots import Robot
from stable_data.robot.arm.world import RobotWorld
from stable_data.robot.grasp_trial import GraspFinder, GraspOutcome, ReachableGrasp
from stable_data.robot.task_progress import scene_state, target_places
from stable_data.rotations import quat_of, rotation_matrix, wxyz
from stable_data.scene import FloatArray, QuatXyzw, Scene, Vec3
from stable_data.simulation.scene_geometry import SceneGeometry
from stable_data.tasks.checking import SceneState, start_state
from stable_data.tasks.compiling import compile_goal
from stable_data.tasks.geometry import TaskGeometry
from stable_data.tasks.goal import Goal, Step, StepAction
from stable_data.tasks.placing import TargetPose, placed_state, target_poses
from stable_data.tasks.sentences import not_checkable

START_COLLIDES = "robot_start_collides"
"""Code of a scene in which the robot touches something where it starts."""

REASON_SEPARATOR = " | "
"""Between the reasons of a task."""

_OF_NO_MOUNT = frozenset({"too_wide", "no_free_place"})  # reasons that are the same from every place

_OVER = 0.05  # height of the tool above the top of a target, metres
_TOOL_YAWS = 4  # that are tried there
_SETTLE_SECONDS = 0.3  # after an object was put at its place
_MOST_PLACES = 24  # of a step
_MOST_GRIPS = 4  # grasps with which an arm of few joints is tried at a place
_OBJECT_YAWS = 8  # headings of the object there


class ReachRole(StrEnum):
    """Why an object was looked at."""

    GRASP = "grasp"
    TARGET = "target"
    OTHER = "other"


@dataclass(frozen=True, slots=True)
class ObjectReach:
    """What a robot can do with an object.

    Attributes:
        instance: The object.
        role: ``grasp``: the task needs it to be grasped; ``target``: only to be reached from above; ``other``: neither is known.
        reachable: Whether the arm comes to one of its grasps without touching anything; of a target, whether the open hand comes
            above it.
        graspable: Whether a grasp held in a trial; None without a trial, unless nothing is reachable.
        num_candidates: Poses of the hand that its mesh offers, as far as they were looked at; None of a target.
        num_reachable: Those that the arm reaches freely.
        num_out_of_reach: Those that the arm cannot reach.
        blocked_by: Name of what is in the way of the others -> how many.
        num_tried: Grasps that were tried.
        num_grasps: Those of them that held.
        reason: Why it is not reachable or not graspable: a code, with details after a colon; None if nothing is wrong.
    """

    instance: str
    role: ReachRole
    reachable: bool | None
    graspable: bool | None = None
    num_candidates: int | None = None
    num_reachable: int | None = None
    num_out_of_reach: int | None = None
    blocked_by: Mapping[str, int] | None = None
    num_tried: int | None = None
    num_grasps: int | None = None
    reason: str | None = None


@dataclass(frozen=True, slots=True)
class TriedGrasp:
    """A grasp that was tried.

    Attributes:
        instance: The object.
        number: Its rank among the reachable grasps of the object, from 0.
        position: Origin of the tool frame at the grasp, metres, frame of the scene.
        quat_xyzw: Rotation of the tool frame.
        width: Of the object between the fingers, metres.
        opening: Of the hand on the way there, metres.
        score: See :class:`~stable_data.robot.grasps.Grasps`.
        outcome: What became of it.
    """

    instance: str
    number: int
    position: Vec3
    quat_xyzw: QuatXyzw
    width: float
    opening: float
    score: float
    outcome: GraspOutcome


@dataclass(frozen=True, slots=True)
class SceneReach:
    """What a robot can do in a scene.

    Attributes:
        robot: Name of the robot.
        mount: Where it stands, as a setting that gives the same place again; None if it could not be put there.
        task_kind: Kind of the goal; None if it is not known.
        task_reachable: Whether a grasp of each object that the task picks up and a place for it are reachable; None if the goal is not
            known.
        task_graspable: Whether also a grasp of each object that the task picks up held; None if nothing was tried.
        task_reason: Why not, in one line: ``code: details``, joined by ``REASON_SEPARATOR``; None if nothing is wrong.
        objects: The objects that were looked at.
        grasps: The grasps that were tried.
    """

    robot: str
    mount: str | None
    task_kind: str | None
    task_reachable: bool | None
    task_graspable: bool | None
    task_reason: str | None
    objects: tuple[ObjectReach, ...] = ()
    grasps: tuple[TriedGrasp, ...] = ()


@dataclass(frozen=True, slots=True)
class ReachOptions:
    """What is looked at.

    Attributes:
        mount: Where the robot stands, see :func:`~stable_data.robot.arm.mounting.mount_of`. If the task is not reachable from the place of
            ``auto``, the middles of the edges are tried too.
        tries: Grasps of an object that are tried at most; 0 tries none.
        all_objects: Whether objects that the task does not need are looked at too.
    """

    mount: str = AUTO
    tries: int = 3
    all_objects: bool = False


def survey_reach(
    geometry: SceneGeometry,
    robot: Robot,
    options: ReachOptions = ReachOptions(),
    containers: Mapping[str, bool | None] | None = None,
) -> SceneReach:
    """Surveys what a robot can do in a scene.

    Args:
        geometry: The scene with its geometry; the supports of its objects are known.
        robot: The robot; its files are there.
        options: What is looked at.
        containers: Whether objects can be put into an object; None: as the annotations of the geometry say.

    Returns:
        The survey. Of a scene without a goal that can be checked it has the objects, and None for the task.

    Raises:
        ConfigError: The mount is not valid, or the files of the robot cannot be read.
    """
    task = TaskGeometry.of(geometry)
    if containers is not None:
        task = replace(task, containers=containers)
    goal, unknown = None, None
    try:
        goal = compile_goal(task)
        if not goal.steps:
            raise not_checkable(str(goal), "no step leads to it")
    except GoalError as error:
        goal, unknown = None, f"{error.code}: {one_line(str(error).removeprefix(f'{geometry.scene.scene_id}: '))}"
    subjects, targets = needed_objects(geometry, goal)
    scene = geometry.scene
    places = None if goal is None or options.mount != AUTO else target_places(goal, task)
    first = mount_of(robot, scene, options.mount, {*subjects, *targets}, places)
    best: SceneReach | None = None
    for mount in (first, *(_other_mounts(robot, scene, first) if options.mount == AUTO and goal is not None else ())):
        found = _survey_from(mount, robot, task, geometry, options, goal, unknown)
        if best is None or found.task_reachable or reason_codes(best.task_reason) == [START_COLLIDES]:
            best = found
        if found.task_reachable or not _depends_on_mount(found):
            break
    assert best is not None  # there is a first mount
    return best


def _other_mounts(robot: Robot, scene: Scene, first: Mount) -> Iterator[Mount]:
    """Places to try where the first one does not do: the middles of the edges."""
    middles = (mount_of(robot, scene, edge) for edge in CHOSEN_EDGES)
    return (mount for mount in middles if mount != first)


def _depends_on_mount(found: SceneReach) -> bool:
    """Whether a task that is not reachable could be so from another place: nothing is wrong with its objects and places themselves."""
    return found.task_reason is not None and not _OF_NO_MOUNT.intersection(reason_codes(found.task_reason))


def _survey_from(
    mount: Mount,
    robot: Robot,
    task: TaskGeometry,
    geometry: SceneGeometry,
    options: ReachOptions,
    goal: Goal | None,
    unknown: str | None,
) -> SceneReach:
    """The survey from one place.

    Args:
        mount: The place.
        robot: The robot.
        task: The scene for its task.
        geometry: The scene.
        options: What is looked at.
        goal: The goal, if it is known.
        unknown: Why it is not.
    """
    setting = mount_setting(mount, geometry.scene.table)
    mount = mount_of(robot, geometry.scene, setting)  # rounded as it is stated
    nothing = SceneReach(robot.name, setting, None if goal is None else str(goal.kind), None, None, unknown)
    try:
        built = assemble(geometry, robot, mount)
    except MeshError as error:
        return replace(nothing, task_reason=f"{error.code}: {one_line(str(error))}")
    finder = GraspFinder(built, arm_of(robot))
    hit = finder.clearance.hits(finder.arm.home, robot.hand.max_opening)
    if hit is not None:
        verdict = None if goal is None else False
        reason = f"{START_COLLIDES}: {robot.name} touches {hit} where it starts, at {setting}"
        return replace(nothing, task_reachable=verdict, task_graspable=verdict, task_reason=reason)
    survey = _Survey(task, finder, options.tries)
    subjects, targets = needed_objects(geometry, goal)
    faults = [] if goal is None else survey.steps(goal)
    for name in subjects:
        survey.object(name, ReachRole.GRASP if goal is not None else ReachRole.OTHER)
    for name in targets:
        survey.target(name)
    if options.all_objects:
        for o in geometry.scene.movable:
            survey.object(o.instance, ReachRole.OTHER)
    found = replace(nothing, objects=tuple(survey.found.values()), grasps=tuple(survey.tried))
    return found if goal is None else _verdict(found, faults)


def needed_objects(geometry: SceneGeometry, goal: Goal | None) -> tuple[tuple[str, ...], tuple[str, ...]]:
    """Returns the objects that a task picks up, and those that are only targets; without a goal all task objects are of the first."""
    movable = {o.instance for o in geometry.scene.movable}
    if goal is None:
        task = geometry.scene.task
        return tuple(n for n in dict.fromkeys(() if task is None else task.task_objects) if n in movable), ()
    subjects = dict.fromkeys(step.subject for step in goal.steps)
    names = {o.instance for o in geometry.scene.objects}
    targets = dict.fromkeys(t for step in goal.steps for c in step.conditions for t in c.targets)
    return tuple(subjects), tuple(t for t in targets if t in names and t not in subjects)


def reason_codes(reason: str | None) -> list[str]:
    """Returns the codes of a task's reason."""
    return [] if reason is None else [part.partition(":")[0] for part in reason.split(REASON_SEPARATOR)]


def one_line(text: str) -> str:
    """Returns a text with its whitespace, line breaks among it, as single spaces."""
    return " ".join(text.split())


def _verdict(found: SceneReach, faults: Collection[str]) -> SceneReach:
    """The survey with its verdict on the task.

    Args:
        found: The survey of a scene with a goal.
        faults: Why places of the steps are not reached.
    """
    picked = [
        o for o in found.objects if o.role is ReachRole.GRASP
    ]  # where a target matters, a place on or in it is out of reach
    reachable = not faults and all(o.reachable for o in picked)
    graspable: bool | None = reachable and all(o.graspable is not False for o in picked)
    if graspable and any(o.graspable is None for o in picked):
        graspable = None
    reasons = [_at_front(o.reason, o.instance) for o in picked if o.reason is not None]
    return replace(
        found,
        task_reachable=reachable,
        task_graspable=graspable,
        task_reason=REASON_SEPARATOR.join(dict.fromkeys([*reasons, *faults])) or None,
    )


def _at_front(reason: str, instance: str) -> str:
    """A reason of an object with its name: ``code: instance, details``."""
    code, _, details = reason.partition(": ")
    return f"{code}: {instance}" + (f", {details}" if details else "")


class _Survey:
    """A survey under way; the simulation shows the scene as the steps so far leave it.

    Attributes:
        found: The objects that were looked at.
        tried: The grasps that were tried.
    """

    def __init__(self, task: TaskGeometry, finder: GraspFinder, tries: int) -> None:
        self._task, self._finder, self._tries = task, finder, tries
        self._world = RobotWorld(finder.built)
        self._start = self._world.snapshot()
        self._grips: dict[str, list[HeldObject]] = {}  # objects in the hand by their best grasps
        self.found: dict[str, ObjectReach] = {}
        self.tried: list[TriedGrasp] = []

    def steps(self, goal: Goal) -> list[str]:
        """Goes through the steps of a goal; returns why places are not reached. The scene then is as it was."""
        faults = []
        state = start_state(self._task)
        for number, step in enumerate(goal.steps):
            self.object(step.subject, ReachRole.GRASP)
            if step.action is StepAction.PICK:
                continue
            try:
                poses = target_poses(step, self._task, state, _MOST_PLACES)
            except GoalError as error:
                faults.append(f"{error.code}: {step.subject}, {_wish(step)}")
                continue
            reached = self._reached(step.subject, poses)
            if reached is None:
                faults.append(f"place_out_of_reach: {step.subject}, {_wish(step)}")
            if number + 1 < len(goal.steps):
                state = self._moved(state, step.subject, poses[reached or 0])
        self._world.restore(self._start)
        return faults

    def object(self, name: str, role: ReachRole) -> None:
        """Surveys an object where it is now, and tries its best grasps; one that is known already is left as it is."""
        if name in self.found:
            return
        survey = self._finder.survey(self._world, name)
        self._grips[name] = [self._in_hand(name, grasp) for grasp in survey.reachable[:_MOST_GRIPS]]
        outcomes = []
        for number, (grasp, outcome) in enumerate(self._finder.trials(self._world, survey.reachable, self._tries)):
            outcomes.append(outcome)
            self.tried.append(self._row(grasp, number, outcome))
        held = sum(outcome is GraspOutcome.HELD for outcome in outcomes)
        reason = survey.reason
        if outcomes and not held:
            most = Counter(outcomes).most_common(1)[0][0]
            reason = f"{most}: held in 0 of {len(outcomes)} trials"
        self.found[name] = ObjectReach(
            name,
            role,
            bool(survey.reachable),
            held > 0 if outcomes else None if survey.reachable else False,
            survey.num_candidates,
            len(survey.reachable),
            survey.num_out_of_reach,
            dict(sorted(survey.blocked_by.items())),
            len(outcomes),
            held,
            reason,
        )

    def target(self, name: str) -> None:
        """Finds whether the open hand comes above an object."""
        if name in self.found:
            return
        pose = self._world.object_poses[self._task.rows[name]]
        index, hit = self._above(self._tops(name, pose[None, :3], pose[None, 3:]), frozenset())
        reason = None if index is not None else "out_of_reach" if hit is None else f"blocked: by {hit}"
        self.found[name] = ObjectReach(name, ReachRole.TARGET, index is not None, reason=reason)

    def _reached(self, name: str, poses: Sequence[TargetPose]) -> int | None:
        """The first pose of an object that the hand comes above; None if it comes above none.

        An arm with few joints hardly ever points straight down: it may also come there with the object in one of its grasps.
        """
        positions = np.array([(*p.position[:2], p.release_height) for p in poses])
        index = self._above(self._tops(name, positions, np.array([p.quat_xyzw for p in poses])), frozenset({name}))[0]
        if index is not None or self._finder.arm.is_full:
            return index
        return next(
            (k for k, pose in enumerate(poses) if any(self._comes_with(grip, pose) for grip in self._grips[name])), None
        )

    def _comes_with(self, held: HeldObject, pose: TargetPose) -> bool:
        """Whether the hand comes to a pose of an object that it holds, at some heading of the object."""
        mount, height = self._finder.built.mount, np.array([*pose.position[:2], pose.release_height])
        yaws = Rotation.from_euler("z", 2 * np.pi * np.arange(_OBJECT_YAWS)[:, None] / _OBJECT_YAWS).as_matrix()
        turns = mount.rotation.T @ yaws @ rotation_matrix(pose.quat_xyzw) @ held.rotation.T
        solved = self._finder.arm.solve(mount.to_base(height) - turns @ held.position, turns)
        self._finder.clearance.look(self._world)
        self._finder.clearance.hold(None)
        opening, allowed = self._finder.built.robot.hand.max_opening, frozenset({held.instance})
        joints = solved.joints[solved.can_place]
        return any(self._finder.clearance.hits(one, opening, allowed=allowed) is None for one in joints)

    def _in_hand(self, name: str, grasp: ReachableGrasp) -> HeldObject:
        """Where an object is in the hand that grasps it."""
        pose, mount = self._world.object_poses[self._task.rows[name]], self._finder.built.mount
        x, y, z, w = pose[3:].tolist()
        turn = mount.rotation.T @ rotation_matrix((x, y, z, w))
        return HeldObject(name, grasp.rotation.T @ (mount.to_base(pose[:3]) - grasp.position), grasp.rotation.T @ turn)

    def _tops(self, name: str, positions: FloatArray, quats_xyzw: FloatArray) -> FloatArray:
        """Points above an object at poses, (K, 3), metres, frame of the scene."""
        row, points = self._task.rows[name], []
        for position, quat in zip(positions, quats_xyzw.tolist(), strict=True):
            item = self._task.posed(row, position, quat).item
            points.append((*item.position[:2], item.top + _OVER))
        return np.array(points)

    def _above(self, points: FloatArray, allowed: frozenset[str]) -> tuple[int | None, str | None]:
        """The first of some points, (K, 3), frame of the scene, to which the open hand comes, pointing down; or what is in the way."""
        finder = self._finder
        yaws = np.arange(_TOOL_YAWS) * np.pi / _TOOL_YAWS
        down = Rotation.from_euler("z", yaws[:, None]).as_matrix() @ np.diag([1.0, -1.0, -1.0])
        positions = np.repeat(finder.built.mount.to_base(points), _TOOL_YAWS, axis=0)
        solved = finder.arm.solve(positions, np.tile(down, (len(points), 1, 1)))
        finder.clearance.look(self._world)
        finder.clearance.hold(None)
        hit = None
        for k in np.flatnonzero(solved.can_place).tolist():
            hit = finder.clearance.hits(solved.joints[k], finder.built.robot.hand.max_opening, allowed=allowed)
            if hit is None:
                return k // _TOOL_YAWS, None
        return None, hit

    def _moved(self, state: SceneState, name: str, pose: TargetPose) -> SceneState:
        """Puts an object at its place in the simulation, and returns the state there after it has settled."""
        placed, built, data = placed_state(self._task, state, name, pose), self._finder.built, self._world.data
        for instance, (address, speed) in built.free_addresses.items():
            row = self._task.rows[instance]
            data.qpos[address : address + 3] = placed.positions[row]
            x, y, z, w = placed.quats_xyzw[row].tolist()
            data.qpos[address + 3 : address + 7] = wxyz((x, y, z, w))
            data.qvel[speed : speed + 6] = 0.0
        home, opening = self._finder.arm.home, built.robot.hand.max_opening
        self._world.place_arm(home)
        before = self._world.snapshot()
        self._world.advance(home, opening, _SETTLE_SECONDS)
        if not self._world.has_diverged:
            return scene_state(self._world)
        self._world.restore(before)
        return placed

    def _row(self, grasp: ReachableGrasp, number: int, outcome: GraspOutcome) -> TriedGrasp:
        mount = self._finder.built.mount
        x, y, z = mount.to_scene(grasp.position).tolist()
        quat = quat_of(Rotation.from_matrix(mount.rotation @ grasp.rotation))
        return TriedGrasp(grasp.instance, number, (x, y, z), quat, grasp.width, grasp.opening, grasp.score, outcome)


def _wish(step: Step) -> str:
    return "; ".join(map(str, step.conditions)) or "a free spot on the table"
