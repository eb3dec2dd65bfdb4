"""Checks the goal of a task on states of its scene, and gives a shaped reward.

Only the objects that the goal names, and what they rest on, are looked at. ``on``, ``in``, directions, cells and facings are decided
by the code of the scene graph. Unknown is never a pass: an object that fell off the table fulfils nothing.
"""

import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
import shapely

from stable_data.condition import BY_HEIGHT, BY_SIZE, GROUP_KINDS, ConditionKind, GoalCondition
from stable_data.errors import GoalError
from stable_data.rotations import yaw_quat
from stable_data.scene import TABLE, FloatArray, Relation, RelationKind, Scene, SceneObject
from stable_data.scene_graph.relations import (
    are_even,
    contacts_of,
    direction_of,
    facing_of,
    is_between,
    is_held,
    on_in_relations,
)
from stable_data.tasks.geometry import PosedObject, TaskGeometry, outline_of
from stable_data.tasks.goal import Goal, Step, StepAction
from stable_data.tasks.regions import DIRECTIONS, EDGES, NEAR_EDGE, REGIONS, edge_distance, is_in_region, region_bounds

LIFT = 0.02
"""An object is held if it was lifted by at least this height, metres."""

BESIDE = 0.10
"""Largest distance of the outlines of two objects that are beside each other, metres."""

TOGETHER = 0.05
"""Largest distance of the outlines of neighbours that are together, metres."""

APART = 0.08
"""Least distance of the outlines of two objects that are apart, unless a condition states one, metres."""

ROW_WIDTH = 0.03
"""Largest spread of the centres of a row across it, metres."""

SAME_PLACE = 0.04
"""Largest distance of a centre to the place where another object was, metres."""

REST_SPEED = 0.02
"""Largest speed of an object at rest, metres a second."""

FACING_ANGLE = math.radians(22.5)
"""Largest angle between the facing of an object and the direction of what it faces, radians."""

UPRIGHT_ANGLE = math.radians(15)
"""Largest angle of an upright object's own up axis to the vertical, radians."""

LEAST_MOVE = 0.03
"""Least displacement that counts, if a condition states none, metres."""

_MOVE_TOLERANCE = 0.2  # of the stated displacement
_LEAST_TOLERANCE = 0.02  # metres
_FALLEN = -0.02  # an object whose lowest point is lower has left the table, metres
_LEFT_OVER = 5e-3  # least distance to a condition that does not hold, metres
_VIOLATION = 0.05  # distance to a negated condition, metres
_ARM = 0.1  # metres per radian
_REACH_SCALE, _PLACE_SCALE = 5.0, 0.1  # per metre; metres
_ALMOST = 0.99  # largest reward without success


@dataclass(frozen=True, slots=True, eq=False)
class SceneState:
    """The state of the objects of a scene.

    Attributes:
        positions: Centre of each object's box at the start, as a point of its body, (N, 3) float64, metres, world frame.
        quats_xyzw: Rotation of each body from its yaw frame at yaw 0, (N, 4) float64; at the start the rotation by its yaw.
        touching: The supports that each object touches with an upward normal: instances and ``table``. A missing one touches none.
        held: Instances in contact with both fingers that nothing else supports.
        grasped: Instances in contact with both fingers, also if something supports them. Held ones need not be repeated.
        max_speed: Largest speed of an object, metres a second.
        gripper_position: The point between the fingers, (3,) metres, world frame; None if it is not known.
    """

    positions: FloatArray
    quats_xyzw: FloatArray
    touching: Mapping[str, Sequence[str]]
    held: frozenset[str] = frozenset()
    grasped: frozenset[str] = frozenset()
    max_speed: float = 0.0
    gripper_position: FloatArray | None = None

    @property
    def in_gripper(self) -> frozenset[str]:
        """Instances that are not released."""
        return self.held | self.grasped


def start_state(geometry: TaskGeometry) -> SceneState:
    """Returns the state of a scene at its start, with the supports that it states."""
    poses = geometry.scene.poses()
    quats = np.array([yaw_quat(yaw) for yaw in poses[:, 3]]).reshape(-1, 4)
    return SceneState(poses[:, :3], quats, contacts_of(geometry.scene))


class StateView:
    """A state with the boxes, outlines and supports of its objects, computed on demand.

    Args:
        geometry: The scene and its geometry.
        state: The state.
    """

    def __init__(self, geometry: TaskGeometry, state: SceneState) -> None:
        self.geometry, self.state = geometry, state
        self._posed: dict[str, PosedObject] = {}
        self._outlines: dict[str, shapely.Geometry] = {}
        self._on_in: dict[frozenset[str], frozenset[Relation]] = {}

    def posed(self, name: str) -> PosedObject:
        """An object in the state."""
        if name not in self._posed:
            row = self.geometry.rows[name]
            self._posed[name] = self.geometry.posed(row, self.state.positions[row], self.state.quats_xyzw[row].tolist())
        return self._posed[name]

    def item(self, name: str) -> SceneObject:
        """An object with its box in the state."""
        return self.posed(name).item

    def outline(self, name: str) -> shapely.Geometry:
        """The convex outline of an object seen from above, metres."""
        if name not in self._outlines:
            self._outlines[name] = outline_of(self.posed(name).points)
        return self._outlines[name]

    def gap(self, one: str, other: str) -> float:
        """The distance of the outlines of two objects, metres."""
        return float(shapely.distance(self.outline(one), self.outline(other)))

    def on_in(self, names: Iterable[str]) -> frozenset[Relation]:
        """The relations ``on`` and ``in`` of some objects and of what they rest on."""
        key = frozenset(names)
        if key not in self._on_in:
            members, waiting = dict.fromkeys(sorted(key)), list(key)
            while waiting:
                for below in self.state.touching.get(waiting.pop(), ()):
                    if below != TABLE and below not in members:
                        members[below] = None
                        waiting.append(below)
            posed = {name: self.posed(name) for name in members}
            scene = Scene("state", self.geometry.scene.table, tuple(p.item for p in posed.values()))
            contacts = {name: tuple(self.state.touching.get(name, ())) for name in members}
            footprints = {name: shapely.get_coordinates(self.outline(name)) for name in posed}
            self._on_in[key] = on_in_relations(scene, contacts, footprints, self.geometry.containers)
        return self._on_in[key]

    def has_fallen(self, name: str) -> bool:
        """Whether an object has left the table."""
        return self.item(name).bottom < _FALLEN

    def near(self, name: str) -> list[str]:
        """Other objects whose centres are over or near the box around an object's outline, or that touch it."""
        points, centres = self.posed(name).points, self.state.positions[:, :2]
        over = ((centres >= points.min(axis=0) - _VIOLATION) & (centres <= points.max(axis=0) + _VIOLATION)).all(axis=1)
        rows = self.geometry.rows
        return [n for n, row in rows.items() if n != name and (over[row] or name in self.state.touching.get(n, ()))]


class GoalChecker:
    """Checks the goal of a scene's task, and gives a shaped reward.

    Args:
        goal: The goal.
        geometry: The scene at the start and its geometry.

    Raises:
        GoalError: The goal names an instance or a region that the scene does not have (``goal_unresolved``).
    """

    def __init__(self, goal: Goal, geometry: TaskGeometry) -> None:
        self.goal, self.geometry = goal, geometry
        self._predicates = ConditionPredicates(geometry)
        self._seen: tuple[SceneState, StateView] | None = None
        self._may_hold = frozenset(c.subject for c in goal.conditions if c.kind is ConditionKind.HELD and not c.is_negated)
        for condition in (*goal.conditions, *(c for step in goal.steps for c in step.conditions)):
            check_condition(condition, geometry)

    def conditions(self, state: SceneState) -> tuple[bool, ...]:
        """Whether each condition of the goal holds, without regard to speeds."""
        view = self._view(state)
        return tuple(self._predicates.holds(c, view) for c in self.goal.conditions)

    def is_success(self, state: SceneState) -> bool:
        """Whether the goal is reached: all conditions hold, what is placed is released, and nothing moves but held objects."""
        if state.in_gripper - self._may_hold or (not self._may_hold and state.max_speed > REST_SPEED):
            return False
        return all(self.conditions(state))

    def reward(self, state: SceneState) -> float:
        """The shaped reward, from 0 to 1: the share of the steps that are done, with the progress in the next one. 1 means success."""
        if self.is_success(state):
            return 1.0
        view, steps = self._view(state), self.goal.steps
        if not steps:
            return 0.0
        done = self._steps_done(view)
        current = next((step for step, is_done in zip(steps, done, strict=True) if not is_done), None)
        progress = 0.0 if current is None else 0.95 * self._progress(current, view)
        return max(0.0, min(_ALMOST, (sum(done) + progress) / len(steps)))

    def steps_done(self, state: SceneState) -> tuple[bool, ...]:
        """Whether each step of the goal is done."""
        return tuple(self._steps_done(self._view(state)))

    def _view(self, state: SceneState) -> StateView:
        if self._seen is None or self._seen[0] is not state:
            self._seen = state, StateView(self.geometry, state)
        return self._seen[1]

    def _steps_done(self, view: StateView) -> list[bool]:
        """Whether each step is done. A placed object was picked before; one that is picked again was placed before."""
        steps = self.goal.steps
        done = [self._is_done(step, view) for step in steps]
        for k, step in enumerate(steps):
            if not done[k]:
                continue
            earlier = [j for j in range(k) if steps[j].subject == step.subject]
            if step.action is StepAction.PICK and earlier and not all(done[j] for j in range(k) if j not in earlier):
                done[k] = False
                continue
            for j in earlier:
                done[j] = True
        return done

    def _is_done(self, step: Step, view: StateView) -> bool:
        if step.action is StepAction.PICK:
            return self._predicates.holds(GoalCondition(step.subject, ConditionKind.HELD), view)
        if step.conditions:
            return all(self._predicates.holds(c, view) for c in step.conditions)
        row = self.geometry.rows[step.subject]
        moved = float(np.linalg.norm((view.state.positions[row] - self._predicates.start.positions[row])[:2]))
        is_down = step.subject not in view.state.in_gripper and TABLE in view.state.touching.get(step.subject, ())
        return is_down and moved > SAME_PLACE

    def _progress(self, step: Step, view: StateView) -> float:
        """Progress in a step that is not done, 0 to 1."""
        state = view.state
        reach = 0.0
        if state.gripper_position is not None:
            distance = float(np.linalg.norm(np.subtract(state.gripper_position, view.item(step.subject).position)))
            reach = 1 - math.tanh(_REACH_SCALE * distance)
        left = sum(self._predicates.distance(c, view) for c in step.conditions)
        near = math.exp(-left / _PLACE_SCALE)
        is_grasped = step.subject in state.in_gripper
        if step.action is StepAction.PICK:
            lift = min(1.0, max(0.0, self._predicates.lift(step.subject, view) / LIFT)) if is_grasped else 0.0
            return 0.6 * reach + 0.2 * is_grasped + 0.2 * lift
        if step.action is StepAction.PUSH:
            return 0.4 * reach + 0.6 * near
        return near


def check_condition(condition: GoalCondition, geometry: TaskGeometry) -> None:
    """Refuses a condition about an instance, a region or a direction that does not exist (GoalError, ``goal_unresolved``)."""
    kind, instances = condition.kind, geometry.rows.keys()
    words: frozenset[str] = frozenset()
    if kind is ConditionKind.AT:
        words = REGIONS
    elif kind is ConditionKind.HELD:
        words, instances = REGIONS, {}.keys()
    elif kind is ConditionKind.ORDERED:
        words, instances = frozenset({BY_HEIGHT, BY_SIZE}), {}.keys()
    elif kind is ConditionKind.APART:
        words = frozenset(EDGES)
    elif kind is ConditionKind.ON:
        words = frozenset({TABLE})
    elif kind is ConditionKind.MOVED:
        words, instances = frozenset(DIRECTIONS), {}.keys()
    elif kind is ConditionKind.FACING:
        words = frozenset(facing_of(k * math.pi / 4) for k in range(8))
    elif kind is ConditionKind.EMPTY:
        words, instances = frozenset({"in", "on", ""}), {}.keys()
    counts = (
        {2}
        if kind is ConditionKind.BETWEEN
        else {0, 1}
        if kind in _TARGET_OPTIONAL
        else {0}
        if kind in _WITHOUT_TARGET
        else {1}
    )
    subjects = condition.subjects
    is_known = set(subjects) <= geometry.rows.keys() and len(set(subjects)) == len(subjects)
    is_several = (len(subjects) > 1) == (kind in GROUP_KINDS)
    targets = condition.targets or (("",) if kind is ConditionKind.EMPTY else ())
    if is_known and is_several and len(targets) in counts and all(t in words or t in instances for t in targets):
        return
    raise GoalError(
        f"{geometry.scene.scene_id}: condition {str(condition)!r} names what is not in the scene, expected instances of it, regions or "
        "directions; compile the goal again",
        "goal_unresolved",
    )


_TARGET_OPTIONAL = {ConditionKind.HELD, ConditionKind.ORDERED}
_WITHOUT_TARGET = {ConditionKind.UPRIGHT, *GROUP_KINDS}


class ConditionPredicates:
    """The conditions as predicates and as distances.

    Args:
        geometry: The scene at the start and its geometry.

    Attributes:
        start: The state at the start.
        first: The start with its boxes and outlines.
    """

    def __init__(self, geometry: TaskGeometry) -> None:
        self.geometry = geometry
        self.start = start_state(geometry)
        self.first = StateView(geometry, self.start)
        kind = ConditionKind
        self._tests: dict[ConditionKind, Callable[[GoalCondition, StateView], bool]] = {
            kind.HELD: self._is_held,
            kind.ON: self._is_on_or_in,
            kind.IN: self._is_on_or_in,
            **dict.fromkeys((kind.LEFT_OF, kind.RIGHT_OF, kind.IN_FRONT_OF, kind.BEHIND), self._is_in_direction),
            kind.BESIDE: self._is_beside,
            kind.BETWEEN: self._is_between,
            kind.APART: lambda c, view: self._apart(c, view) >= (c.distance or APART),
            kind.AT: self._is_at,
            kind.FACING: self._is_facing,
            kind.UPRIGHT: lambda c, view: self._tilt(c.subject, view) <= UPRIGHT_ANGLE,
            kind.MOVED: self._has_moved,
            kind.EMPTY: lambda c, view: not self.contents(c, view),
            kind.TOGETHER: lambda c, view: max(self._links(c, view)) <= TOGETHER,
            kind.IN_A_ROW: lambda c, view: float(np.ptp(self._centres(c, view), axis=0).min()) <= ROW_WIDTH,
            kind.ORDERED: lambda c, view: bool((np.diff(self._centres(c, view)[:, 0]) > 0).all()),
            kind.EVEN: lambda c, view: are_even(sorted(self._centres(c, view)[:, 0].tolist())),
        }
        self._distances: dict[ConditionKind, Callable[[GoalCondition, StateView], float]] = {
            kind.HELD: self._distance_to_hold,
            kind.ON: self._distance_to_support,
            kind.IN: self._distance_to_support,
            **dict.fromkeys((kind.LEFT_OF, kind.RIGHT_OF, kind.IN_FRONT_OF, kind.BEHIND), self._distance_to_direction),
            kind.BESIDE: lambda c, view: view.gap(c.subject, c.target) - BESIDE,
            kind.BETWEEN: self._distance_to_middle,
            kind.APART: lambda c, view: (c.distance or APART) - self._apart(c, view),
            kind.AT: self._distance_to_region,
            kind.FACING: lambda c, view: _ARM * (self._angle(c, view) - FACING_ANGLE),
            kind.UPRIGHT: lambda c, view: _ARM * (self._tilt(c.subject, view) - UPRIGHT_ANGLE),
            kind.MOVED: lambda c, view: abs(self._displacement(c, view)[0] - (c.distance or LEAST_MOVE)),
            kind.EMPTY: lambda c, view: _VIOLATION * len(self.contents(c, view)),
            kind.TOGETHER: lambda c, view: sum(max(0.0, gap - TOGETHER) for gap in self._links(c, view)),
            kind.IN_A_ROW: lambda c, view: float(np.ptp(self._centres(c, view), axis=0).min()) - ROW_WIDTH,
            kind.ORDERED: lambda c, view: float(np.maximum(0.0, -np.diff(self._centres(c, view)[:, 0])).sum()),
            kind.EVEN: lambda c, view: float(np.ptp(np.diff(np.sort(self._centres(c, view)[:, 0])))),
        }

    def holds(self, condition: GoalCondition, view: StateView) -> bool:
        """Whether a condition holds; an object that is to be somewhere must be released there and be on the table."""
        if condition.kind is ConditionKind.HELD:
            return self._is_held(condition, view) != condition.is_negated
        subjects = condition.subjects
        named = {*subjects, *(t for t in condition.targets if t in self.geometry.rows)}
        if view.state.in_gripper.intersection(subjects) or any(map(view.has_fallen, named)):
            return False
        return self._tests[condition.kind](condition, view) != condition.is_negated

    def distance(self, condition: GoalCondition, view: StateView) -> float:
        """How far a state is from a condition, metres or what counts as much; 0 if it holds but for the release."""
        holds = self._tests[condition.kind](condition, view)
        if holds != condition.is_negated:
            return 0.0
        return _VIOLATION if condition.is_negated else max(_LEFT_OVER, self._distances[condition.kind](condition, view))

    def lift(self, name: str, view: StateView) -> float:
        """How far an object was lifted since the start, metres."""
        return view.item(name).bottom - self.first.item(name).bottom

    # --- the start ---

    def holds_at_start(self, condition: GoalCondition) -> bool:
        """Whether a condition holds at the start."""
        return self.holds(condition, self.first)

    def contents_at_start(self, condition: GoalCondition) -> list[str]:
        """The objects that are in or on the subject of a condition ``empty`` at the start."""
        return self.contents(condition, self.first)

    def staying(self, condition: GoalCondition) -> frozenset[str]:
        """The members of a group that stay: the ends of an even row, and the first of those that come together."""
        if condition.kind is ConditionKind.EVEN:
            ordered = sorted(condition.subjects, key=lambda name: self.first.item(name).position[0])
            return frozenset((ordered[0], ordered[-1]))
        return frozenset(condition.subjects[:1]) if condition.kind is ConditionKind.TOGETHER else frozenset()

    # --- predicates ---

    def _is_held(self, c: GoalCondition, view: StateView) -> bool:
        is_lifted = c.subject in view.state.held and self.lift(c.subject, view) >= LIFT
        return is_lifted and (not c.target or self._is_at(c, view))

    def _is_on_or_in(self, c: GoalCondition, view: StateView) -> bool:
        relation = Relation(c.subject, RelationKind(str(c.kind)), c.target)
        if c.target == TABLE:
            return relation in view.on_in((c.subject,))
        return is_held(view.on_in((c.subject, c.target)), relation)

    def _is_in_direction(self, c: GoalCondition, view: StateView) -> bool:
        dx, dy, _ = np.subtract(view.item(c.subject).position, view.item(c.target).position)
        return direction_of(dx, dy) == str(c.kind)

    def _is_beside(self, c: GoalCondition, view: StateView) -> bool:
        if view.gap(c.subject, c.target) > BESIDE:
            return False
        on_in = view.on_in((c.subject, c.target))
        stacked = (Relation(a, RelationKind.ON, b) for a, b in ((c.subject, c.target), (c.target, c.subject)))
        return not any(is_held(on_in, relation) for relation in stacked)

    def _is_between(self, c: GoalCondition, view: StateView) -> bool:
        return is_between(*(view.item(name).position for name in (c.subject, *c.targets)))

    def _is_at(self, c: GoalCondition, view: StateView) -> bool:
        posed, size = view.posed(c.subject), self.geometry.scene.table.size_xy
        if c.target in REGIONS:
            return is_in_region(c.target, posed.item.position, posed.points, size)
        return self._distance_to_region(c, view) <= SAME_PLACE

    def _is_facing(self, c: GoalCondition, view: StateView) -> bool:
        if c.target in self.geometry.rows:
            return self._angle(c, view) <= FACING_ANGLE
        return facing_of(view.item(c.subject).yaw) == c.target

    def _has_moved(self, c: GoalCondition, view: StateView) -> bool:
        along, across = self._displacement(c, view)
        if across > max(along, 0.0):
            return False
        if c.distance is None:
            return along >= LEAST_MOVE
        return abs(along - c.distance) <= max(_LEAST_TOLERANCE, _MOVE_TOLERANCE * c.distance)

    def contents(self, c: GoalCondition, view: StateView) -> list[str]:
        """The objects that are in or on the subject of a condition ``empty``."""
        near = view.near(c.subject)
        kinds = {RelationKind(c.target)} if c.target else {RelationKind.IN, RelationKind.ON}
        if not near:
            return []
        found = {r.subject for r in view.on_in((c.subject, *near)) if r.target == c.subject and r.kind in kinds}
        return sorted(found)

    # --- measures ---

    def _apart(self, c: GoalCondition, view: StateView) -> float:
        if c.target in EDGES:
            return edge_distance(c.target, view.posed(c.subject).points, self.geometry.scene.table.size_xy)
        return view.gap(c.subject, c.target)

    def _angle(self, c: GoalCondition, view: StateView) -> float:
        """The angle of the facing of an object to what it is to face, radians."""
        item = view.item(c.subject)
        if c.target in self.geometry.rows:
            dx, dy, _ = np.subtract(view.item(c.target).position, item.position)
            wanted = math.atan2(dy, dx) + math.pi / 2
        else:
            wanted = yaw_facing(c.target)
        return abs(math.remainder(item.yaw - wanted, 2 * math.pi))

    def _tilt(self, name: str, view: StateView) -> float:
        row = self.geometry.rows[name]
        x, y, z, w = view.state.quats_xyzw[row].tolist()
        return math.acos(max(-1.0, min(1.0, float(self.geometry.up(row, (x, y, z, w))[2]))))

    def _displacement(self, c: GoalCondition, view: StateView) -> tuple[float, float]:
        """The displacement since the start along a direction and across it, metres."""
        axis, sign = DIRECTIONS[c.target]
        row = self.geometry.rows[c.subject]
        step = view.state.positions[row] - self.start.positions[row]
        return float(sign * step[axis]), abs(float(step[1 - axis]))

    def _links(self, c: GoalCondition, view: StateView) -> list[float]:
        """Distances that connect the subjects, each to the nearest one that is connected already, metres."""
        joined, rest, links = [c.subjects[0]], list(c.subjects[1:]), []
        while rest:
            gap, name = min((min(view.gap(name, other) for other in joined), name) for name in rest)
            links.append(gap)
            joined.append(name)
            rest.remove(name)
        return links

    def _centres(self, c: GoalCondition, view: StateView) -> FloatArray:
        return np.array([view.item(name).position[:2] for name in c.subjects])

    # --- distances ---

    def _distance_to_hold(self, c: GoalCondition, view: StateView) -> float:
        left = max(0.0, LIFT - self.lift(c.subject, view))
        return left + max(0.0, self._distance_to_region(c, view)) if c.target else left

    def _distance_to_support(self, c: GoalCondition, view: StateView) -> float:
        item = view.item(c.subject)
        if c.target == TABLE:
            outside = np.maximum(0.0, np.maximum(np.negative(item.position[:2]), np.subtract(item.position[:2], self._size)))
            return float(np.hypot(*outside)) + max(0.0, item.bottom)
        base = view.item(c.target)
        aside = float(shapely.distance(view.outline(c.target), shapely.Point(item.position[:2])))
        return (
            aside + abs(item.bottom - base.top)
            if c.kind is ConditionKind.ON
            else aside + max(0.0, item.bottom - base.position[2])
        )

    @property
    def _size(self) -> tuple[float, float]:
        return self.geometry.scene.table.size_xy

    def _distance_to_direction(self, c: GoalCondition, view: StateView) -> float:
        step = np.subtract(view.item(c.subject).position, view.item(c.target).position)
        axis, sign = DIRECTIONS[SIDE_NAMES[c.kind]]
        return max(0.0, float(abs(step[1 - axis]) - sign * step[axis])) / math.sqrt(2)

    def _distance_to_middle(self, c: GoalCondition, view: StateView) -> float:
        one, other = (np.array(view.item(name).position[:2]) for name in c.targets)
        return float(np.linalg.norm(view.item(c.subject).position[:2] - (one + other) / 2))

    def _distance_to_region(self, c: GoalCondition, view: StateView) -> float:
        posed = view.posed(c.subject)
        if c.target in EDGES:
            return edge_distance(c.target, posed.points, self._size) - NEAR_EDGE
        at = np.array(posed.item.position[:2])
        if c.target in REGIONS:
            low, high = region_bounds(c.target, self._size)
            return float(np.hypot(*np.maximum(0.0, np.maximum(low - at, at - high))))
        return float(np.linalg.norm(at - self.first.item(c.target).position[:2]))


SIDE_NAMES = {
    ConditionKind.LEFT_OF: "left",
    ConditionKind.RIGHT_OF: "right",
    ConditionKind.IN_FRONT_OF: "front",
    ConditionKind.BEHIND: "back",
}
"""The direction on the table of each relation."""


def yaw_facing(facing: str) -> float:
    """Returns the yaw of an object that faces a direction such as ``front_right``, radians."""
    return next(k * math.pi / 4 for k in range(8) if facing_of(k * math.pi / 4) == facing)
