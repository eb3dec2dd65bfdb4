"""A scripted expert: carries out the steps of a goal with grasps that hold, planned paths, and a new attempt after a miss.

It is a program, not a policy: it sees the simulation's state. Its commands are joints and the opening of the hand, one a control step.
"""

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from enum import StrEnum
from itertools import islice

import numpy as np

from stable_data.robot.arm.clearance import HeldObject
from stable_data.robot.arm.control import CONTROL_SECONDS
from stable_data.robot.arm.motion import plan_path, timed, tool_line
from stable_data.robot.arm.world import RobotWorld
from stable_data.robot.grasp_trial import (
    CLOSE_SECONDS,
    STILL_SECONDS,
    GraspFinder,
    GraspOutcome,
    ReachableGrasp,
)
from stable_data.rotations import quat_product, rotation_matrix, yaw_quat
from stable_data.scene import FloatArray
from stable_data.tasks.placing import TargetPose

SPEED, CARRYING, SLOW = 1.2, 0.8, 0.6
"""Speeds of the joints, radians a second: free, with an object in the hand, and near objects."""

_ATTEMPTS = 3  # at a grasp
_TRIED = 4  # grasps that are simulated before one is chosen
_ABOVE = 0.10  # of a place, before the object is lowered, metres
_RELEASE = 0.003  # height above its support at which an object is released, metres
_YAWS = 8  # that are tried for a placed object, beside the wanted one
_MOST_TOUCHED = 3  # things that the arm may touch where a path begins
_TURNED = 6  # places of which other headings are tried
_MOST_DROPPED = 0.04  # how far above its place an object is let go where something is in the way, metres
_DROP = 0.02  # an object that is released higher than this above its place is dropped, as into a container, metres
_RETREAT = 0.10  # back along the approach after a release, metres
_WAIT_SECONDS = 0.6  # at the end, until everything is at rest
_IN_HAND = 0.004  # how deep a held object may touch its support at the place, metres


@dataclass(frozen=True, slots=True, eq=False)
class Command:
    """What the arm shall do in one control step.

    Attributes:
        joints: Commanded at the end of the step, (J,), radians.
        opening: Of the hand, metres; 0 closes with force.
    """

    joints: FloatArray
    opening: float


class ExpertFailure(StrEnum):
    """Why the expert gave up."""

    NO_GRASP = "no_grasp"
    NO_PATH = "no_path"
    NO_PLACE = "no_place"
    LOST = "lost"
    MISSED = "missed"


class ExpertError(Exception):
    """The expert gave up.

    Args:
        reason: Why.
        detail: About what: an instance, and what is in the way.
    """

    def __init__(self, reason: ExpertFailure, detail: str) -> None:
        super().__init__(f"{reason}: {detail}")
        self.reason, self.detail = reason, detail


class Expert:
    """Carries out picks and places.

    The methods yield commands; the caller executes each before it asks for the next one.

    Args:
        finder: Grasps of the scene.
        world: The simulation that executes the commands.
        seed: Seed of paths and choices.
    """

    def __init__(self, finder: GraspFinder, world: RobotWorld, seed: int = 0) -> None:
        self._finder, self._world, self._seed = finder, world, seed
        self._arm, self._clearance, self._built = finder.arm, finder.clearance, finder.built
        self._is_holding = False

    def pick(self, instance: str) -> Iterator[Command]:
        """Grasps an object and lifts it.

        Raises:
            ExpertError: There is no grasp, no way to it, or all attempts missed.
        """
        failed: list[ReachableGrasp] = []
        reason, detail = ExpertFailure.NO_GRASP, instance
        for _ in range(_ATTEMPTS):
            grasp = self._choose(instance, failed)
            if grasp is None:
                break
            path = self._path_to(grasp.before, grasp.opening)
            if path is None:
                failed.append(grasp)
                reason, detail = ExpertFailure.NO_PATH, f"to {instance}"
                continue
            yield from self._follow(path, grasp.opening, SPEED)
            yield from self._follow(grasp.approach, grasp.opening, SLOW)
            yield from self._wait(STILL_SECONDS, grasp.opening)
            yield from self._wait(CLOSE_SECONDS, 0.0)
            if instance in self._world.contacts().gripped:
                yield from self._follow(self._finder.lift(grasp), 0.0, SLOW)
                if instance in self._world.contacts().gripped:
                    self._is_holding = True
                    return
            failed.append(grasp)
            reason, detail = ExpertFailure.MISSED, instance
            yield from self.withdraw()
        raise ExpertError(reason, detail)

    def place(self, instance: str, places: Sequence[TargetPose], *, may_turn: bool = True) -> Iterator[Command]:
        """Puts the held object at the first place that the arm reaches without touching anything else, and lets it go.

        Args:
            instance: The held object.
            places: Poses, best first.
            may_turn: Whether the object may be put down at another heading than theirs.

        Raises:
            ExpertError: The object is not held, or no place is reached.
        """
        with self._holding(instance) as held:
            found = self._reachable_place(held, places, may_turn=may_turn)
            if found is None:
                raise ExpertError(ExpertFailure.NO_PLACE, instance)
            path, lowering = found
            yield from self._follow(path, 0.0, CARRYING)
            yield from self._follow(lowering, 0.0, SLOW)
            yield from self._wait(STILL_SECONDS, 0.0)
        if instance not in self._world.contacts().gripped:
            raise ExpertError(ExpertFailure.LOST, instance)
        self._is_holding = False
        yield from self.withdraw()

    def carry(self, instance: str, places: Sequence[TargetPose]) -> Iterator[Command]:
        """Brings the held object to the first place that the arm reaches without touching anything else, and keeps it in the hand.

        Args:
            instance: The held object.
            places: Poses in the air, best first; it may get there at another heading than theirs.

        Raises:
            ExpertError: The object is not held, or no place is reached.
        """
        with self._holding(instance) as held:
            path = self._reachable_path(held, places)
            if path is None:
                raise ExpertError(ExpertFailure.NO_PLACE, instance)
            yield from self._follow(path, 0.0, CARRYING)
        if instance not in self._world.contacts().gripped:
            raise ExpertError(ExpertFailure.LOST, instance)

    def withdraw(self) -> Iterator[Command]:
        """Opens the hand and moves it back along its approach, away from whatever is between or beside the fingers."""
        yield from self._wait(CLOSE_SECONDS, self._built.robot.hand.max_opening)
        yield from self._rise(self._built.robot.hand.max_opening)

    def rest(self) -> Iterator[Command]:
        """Waits until everything is at rest."""
        yield from self._wait(_WAIT_SECONDS, 0.0 if self._is_holding else self._built.robot.hand.max_opening)

    def _choose(self, instance: str, failed: Sequence[ReachableGrasp]) -> ReachableGrasp | None:
        """The best grasp that holds in a trial; the best one at all if none does."""
        grasps = self._finder.reachable(self._world, instance)
        new = list(islice((g for g in grasps if not any(_is_same(g, old) for old in failed)), _TRIED))
        for grasp, outcome in self._finder.trials(self._world, new, _TRIED):
            if outcome is GraspOutcome.HELD:
                return grasp
        return new[0] if new else None

    def _path_to(self, joints: FloatArray, opening: float) -> FloatArray | None:
        self._clearance.look(self._world)
        self._clearance.hold(None)
        start = self._world.commanded_joints
        return plan_path(
            self._arm, self._clearance, start, joints, opening, allowed=self._touched(start, opening), seed=self._seed
        )

    def _touched(self, joints: FloatArray, opening: float) -> frozenset[str]:
        """What the arm touches where it is, such as an object that a failed grasp has tilted: it may go on touching that."""
        found: frozenset[str] = frozenset()
        while len(found) <= _MOST_TOUCHED:
            hit = self._clearance.hits(joints, opening, allowed=found)
            if hit is None:
                return found
            found |= {hit}
        return found

    @contextmanager
    def _holding(self, instance: str) -> Iterator[HeldObject]:
        """Plans with the object in the hand, as it is held now.

        Raises:
            ExpertError: It is not held.
        """
        if not self._is_holding or instance not in self._world.contacts().gripped:
            raise ExpertError(ExpertFailure.LOST, instance)
        held = self._in_hand(instance)
        self._clearance.look(self._world)
        self._clearance.hold(held)
        try:
            yield held
        finally:
            self._clearance.hold(None)

    def _reachable_path(self, held: HeldObject, places: Sequence[TargetPose]) -> FloatArray | None:
        """A path to a place, with the object in the hand."""
        start = self._world.commanded_joints
        for place in self._turned(places, may_turn=True):
            position, turn = self._tool_at(held, place, place.position[2])
            joints = self._free_joints(position, turn, start)
            path = None if joints is None else self._path_with_object(start, joints)
            if path is not None:
                return path
        return None

    def _tool_at(self, held: HeldObject, place: TargetPose, height: float) -> tuple[FloatArray, FloatArray]:
        """Position (3,), metres, and rotation (3, 3) of the tool, frame of the base, with the held object at a place.

        Args:
            held: The object in the hand.
            place: The place.
            height: z of the object, metres, instead of that of the place.
        """
        turn = self._built.mount.rotation.T @ rotation_matrix(place.quat_xyzw) @ held.rotation.T
        return self._built.mount.to_base(np.array([*place.position[:2], height])) - turn @ held.position, turn

    def _free_joints(self, position: FloatArray, turn: FloatArray, start: FloatArray) -> FloatArray | None:
        """Joints that bring the tool to a pose where the arm and the object in the hand touch nothing."""
        solved = self._arm.solve(position[None], turn[None], start)
        joints = solved.joints[0]
        return joints if solved.can_place[0] and self._clearance.hits(joints, 0.0) is None else None

    def _path_with_object(self, start: FloatArray, goal: FloatArray) -> FloatArray | None:
        """A path with an object in the hand, which may touch on the way what it touches at the start."""
        touched = self._touched(start, 0.0)
        return plan_path(self._arm, self._clearance, start, goal, 0.0, allowed=touched, seed=self._seed)

    def _reachable_place(
        self, held: HeldObject, places: Sequence[TargetPose], *, may_turn: bool
    ) -> tuple[FloatArray, FloatArray] | None:
        """A path above a place, and the path down to it."""
        start = self._world.commanded_joints
        for place in self._turned(places, may_turn=may_turn):
            z = place.position[2]
            height = max(z + _RELEASE, place.release_height) if place.release_height - z > _DROP else z + _RELEASE
            position, tool_turn = self._tool_at(held, place, height)
            for rise in (_ABOVE, _ABOVE / 3):
                found = self._way_down(held, place, position + np.array([0.0, 0.0, rise]), position, tool_turn, start)
                if found is not None:
                    return found
        return None

    def _way_down(
        self,
        held: HeldObject,
        place: TargetPose,
        above: FloatArray,
        position: FloatArray,
        turn: FloatArray,
        start: FloatArray,
    ) -> tuple[FloatArray, FloatArray] | None:
        """A path to a pose of the tool above a place, and the path down to it; None if the arm touches anything on the way."""
        self._clearance.hold(held)
        over = self._free_joints(above, turn, start)
        if over is None:
            return None
        lowering = tool_line(self._arm, over, position, turn)
        if lowering is None:
            return None
        lowering = self._until_touch(lowering, frozenset() if place.support is None else frozenset({place.support}))
        ends, _ = self._arm.poses(lowering[-1:])
        if np.linalg.norm(ends[0] - position) > _MOST_DROPPED:
            return None
        path = self._path_with_object(start, over)
        return None if path is None else (path, lowering)

    def _until_touch(self, path: FloatArray, allowed: frozenset[str]) -> FloatArray:
        """The part of a path down to a place before arm or object touch anything but the support: from there the object is let go."""
        for k, joints in enumerate(path):
            if self._clearance.hits(joints, 0.0, allowed=allowed, allowed_depth=_IN_HAND) is not None:
                return path[: max(k, 1)]
        return path

    def _turned(self, places: Sequence[TargetPose], *, may_turn: bool) -> Iterator[TargetPose]:
        """The places as they are, and then, if the object may be turned, the first ones at other headings."""
        yield from places
        if may_turn:
            for place in places[:_TURNED]:
                for k in range(1, _YAWS):
                    turn = 2 * np.pi * k / _YAWS
                    yield replace(place, quat_xyzw=quat_product(yaw_quat(turn), place.quat_xyzw), yaw=place.yaw + turn)

    def _in_hand(self, instance: str) -> HeldObject:
        """Where an object is in the hand now."""
        pose = self._world.object_poses[self._built.names.index(instance)]
        x, y, z, w = pose[3:].tolist()
        turn = np.array(self._world.data.site_xmat[self._built.tool]).reshape(3, 3)
        return HeldObject(instance, turn.T @ (pose[:3] - self._world.tool_position), turn.T @ rotation_matrix((x, y, z, w)))

    def _follow(self, path: FloatArray, opening: float, speed: float) -> Iterator[Command]:
        for joints in timed(path, speed, CONTROL_SECONDS):
            yield Command(joints, opening)

    def _wait(self, seconds: float, opening: float) -> Iterator[Command]:
        joints = self._world.commanded_joints
        for _ in range(max(1, round(seconds / CONTROL_SECONDS))):
            yield Command(joints, opening)

    def _rise(self, opening: float) -> Iterator[Command]:
        """Moves the hand back along its approach, or as far as the arm can."""
        joints = self._world.commanded_joints
        position, rotation = (found[0] for found in self._arm.poses(joints[None]))
        for share in (1.0, 0.6, 0.3):
            path = tool_line(self._arm, joints, position - share * _RETREAT * rotation[:, 2], rotation, spacing=0.02)
            if path is not None:
                yield from self._follow(path, opening, SLOW)
                return


def _is_same(one: ReachableGrasp, other: ReachableGrasp) -> bool:
    return bool(np.linalg.norm(one.position - other.position) < 0.01 and (one.rotation[:, 2] @ other.rotation[:, 2]) > 0.95)
