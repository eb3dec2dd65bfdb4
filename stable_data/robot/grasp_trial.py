"""Which grasps of an object the arm can reach without touching anything, and which of them hold when they are tried in the scene."""

from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from enum import StrEnum
from typing import TypeAlias

import numpy as np

from stable_data.robot.arm.assembly import RobotModel
from stable_data.robot.arm.clearance import Clearance
from stable_data.robot.arm.control import CONTROL_SECONDS
from stable_data.robot.arm.kinematics import Arm
from stable_data.robot.arm.motion import timed, tool_line
from stable_data.robot.arm.world import RobotWorld
from stable_data.robot.grasps import PRESHAPE, Grasps, PointPairs, grasps_at, opposite_pairs
from stable_data.rotations import rotation_matrix
from stable_data.scene import FloatArray

LIFT = 0.10
"""How far an object is lifted in a trial, metres."""

STILL_SECONDS = 0.25
"""How long the arm is given to arrive where it was commanded before the hand moves; its joints lag by a tenth of a second."""

CLOSE_SECONDS = 0.4
"""How long the hand is given to close or to open."""

_HOLD_SECONDS = 0.3
_SPEED = 1.0  # of a joint, radians a second
_LIFTED_SHARE = 0.6  # an object is held if it came up by this share of the lift
_SLIP = 0.03  # how far a held object may move in the hand, metres
_DISTURBED = 0.05  # how far a trial may move another object, metres
_TARGET_DEPTH = (
    0.004  # how deep the open hand may be in the convex parts of the object, which fill its hollows a little, metres
)

_AT_ONCE = 8  # candidates that are solved together: often the first ones are enough
_FLIPS = np.eye(3), np.diag([-1.0, -1.0, 1.0])  # which finger is on which side
_BESIDE = 0.006  # of the object, where a finger that stands still passes it, metres
_CLOSING = np.cos(0.25)  # how exact the closing direction of an arm with few joints is

# Joints of the pre-grasp and of the grasp, position and rotation of the tool at the grasp.
_Option: TypeAlias = tuple[FloatArray, FloatArray, FloatArray, FloatArray]


class GraspOutcome(StrEnum):
    """What became of a grasp."""

    HELD = "held"
    OUT_OF_REACH = "out_of_reach"
    BLOCKED = "blocked"
    NOT_TRIED = "not_tried"
    MISSED = "missed"
    SLIPPED = "slipped"
    DISTURBED = "disturbed"
    DIVERGED = "diverged"


@dataclass(frozen=True, slots=True, eq=False)
class ReachableGrasp:
    """A grasp that the arm reaches without touching anything.

    Attributes:
        instance: The object.
        position: Origin of the tool frame at the grasp, (3,), metres, frame of the base.
        rotation: (3, 3).
        width: Of the object between the fingers, metres.
        opening: Of the hand on the way there, metres.
        before: Joints of the pre-grasp, (J,).
        approach: Configurations from the pre-grasp to the grasp, (T, J).
        score: See :class:`~stable_data.robot.grasps.Grasps`.
    """

    instance: str
    position: FloatArray
    rotation: FloatArray
    width: float
    opening: float
    before: FloatArray
    approach: FloatArray
    score: float


@dataclass(frozen=True, slots=True)
class GraspSurvey:
    """What is known of the grasps of an object.

    Attributes:
        instance: The object.
        num_candidates: Poses of the hand that its mesh offers.
        reachable: Those that the arm reaches freely, best first.
        blocked_by: Names of what is in the way of the others, with how often each is.
        num_out_of_reach: Candidates that the arm cannot reach at all.
    """

    instance: str
    num_candidates: int
    reachable: tuple[ReachableGrasp, ...]
    blocked_by: dict[str, int]
    num_out_of_reach: int

    @property
    def reason(self) -> str | None:
        """Why the object cannot be grasped, a code with details after a colon; None if a grasp is reachable."""
        if self.reachable:
            return None
        if not self.num_candidates:
            return "too_wide"
        if self.blocked_by and sum(self.blocked_by.values()) >= self.num_out_of_reach:
            most = max(self.blocked_by, key=lambda name: (self.blocked_by[name], name))
            return f"blocked: by {most}"
        return "out_of_reach"


class GraspFinder:
    """Finds and tries grasps in a scene.

    Args:
        built: The scene with the robot.
        arm: The kinematics of the robot.
        clearance: Checks of the scene; None makes one.
    """

    def __init__(self, built: RobotModel, arm: Arm, clearance: Clearance | None = None) -> None:
        self.built, self.arm, self.clearance = built, arm, clearance or Clearance(built)
        self._pairs: dict[str, PointPairs] = {}

    def survey(self, world: RobotWorld, instance: str, *, limit: int = 48) -> GraspSurvey:
        """Finds the grasps of an object where it is now that the arm reaches without touching anything.

        Args:
            world: The simulation.
            instance: The object.
            limit: How many candidates are looked at.
        """
        results = list(self._looked_at(world, instance, limit))
        found = tuple(grasp for _, grasp in results if grasp is not None)
        hits = Counter(hit for hit, grasp in results if grasp is None)
        unreached = hits.pop(None, 0)
        blocked = {name: count for name, count in hits.items() if name is not None}
        return GraspSurvey(instance, len(results), found, blocked, unreached)

    def reachable(self, world: RobotWorld, instance: str, *, limit: int = 48) -> Iterator[ReachableGrasp]:
        """Finds the grasps of :meth:`survey` one after the other, the best first; those that nobody asks for take no time."""
        return (grasp for _, grasp in self._looked_at(world, instance, limit) if grasp is not None)

    def _looked_at(self, world: RobotWorld, instance: str, limit: int) -> Iterator[tuple[str | None, ReachableGrasp | None]]:
        """For each candidate the grasp, or what is in the way, or neither if the arm cannot go there."""
        candidates = self.candidates(world, instance, limit)
        positions = self.built.mount.to_base(candidates.positions)
        rotations = self.built.mount.rotation.T @ candidates.rotations
        is_one_sided = self.built.robot.hand.is_one_sided
        aside = candidates.widths / 2 + _BESIDE if is_one_sided else np.zeros(len(candidates))
        self.clearance.look(world)
        self.clearance.hold(None)
        for first in range(0, len(candidates), _AT_ONCE):
            rows = slice(first, first + _AT_ONCE)
            both = np.concatenate([rotations[rows] @ flip for flip in _FLIPS])
            places = np.tile(positions[rows], (len(_FLIPS), 1)) - np.tile(aside[rows], len(_FLIPS))[:, None] * both[:, :, 1]
            solved = self._solve(places, both)
            count = len(positions[rows])
            for k in range(count):
                options = [option for option in solved[k::count] if option is not None]
                yield self._first_free(options, candidates, first + k, instance)

    def _first_free(
        self, options: Sequence[_Option], candidates: Grasps, k: int, instance: str
    ) -> tuple[str | None, ReachableGrasp | None]:
        """The first way to a grasp on which nothing is touched; else what is in the way, or None if the arm cannot go there."""
        hand, width, hit = self.built.robot.hand, float(candidates.widths[k]), None
        for before, at, position, rotation in sorted(options, key=lambda option: float(abs(option[0] - self.arm.home).sum())):
            for opening in (hand.max_opening, min(hand.max_opening, width + PRESHAPE)):
                hit, path = self._free_approach(before, at, position, rotation, opening, instance)
                if path is not None:
                    score = float(candidates.scores[k])
                    return None, ReachableGrasp(instance, position, rotation, width, opening, before, path, score)
        return hit, None

    def candidates(self, world: RobotWorld, instance: str, limit: int) -> Grasps:
        """The grasps that the mesh of an object offers where it is now, in the frame of the scene."""
        index = self.built.names.index(instance)
        if instance not in self._pairs:
            self._pairs[instance] = opposite_pairs(self.built.geometry.shapes[index], self.built.robot.hand)
        pose = world.object_poses[index]
        x, y, z, w = pose[3:].tolist()
        towards = pose[:3] - self.built.mount.position
        towards[2] = 0.0
        length = np.linalg.norm(towards)
        return grasps_at(
            self._pairs[instance],
            pose[:3],
            rotation_matrix((x, y, z, w)),
            self.built.robot.hand,
            towards=towards / length if length > 1e-6 else None,
            limit=limit,
        )

    def _solve(self, positions: FloatArray, rotations: FloatArray) -> list[_Option | None]:
        """Joints of the pre-grasp and of the grasp, and the pose, of each candidate; None where the arm cannot reach."""
        back = self.built.robot.pre_grasp
        if self.arm.is_full:
            before = self.arm.solve(positions - back * rotations[:, :, 2], rotations)
            at = self.arm.solve(positions, rotations, before.joints, starts=0)
            found = before.found & at.found
        else:  # it takes the object from the direction from which it can, as long as the fingers close across it
            at = self.arm.solve(positions, rotations)
            _, taken = self.arm.poses(at.joints)
            found = at.found & ((taken[:, :, 1] * rotations[:, :, 1]).sum(axis=1) >= _CLOSING)
            rotations = taken
            before = self.arm.solve(positions - back * rotations[:, :, 2], rotations, at.joints, starts=0)
            found &= before.found
        rows = zip(found, before.joints, at.joints, positions, rotations, strict=True)
        return [tuple(row) if is_found else None for is_found, *row in rows]

    def _free_approach(
        self, before: FloatArray, at: FloatArray, position: FloatArray, rotation: FloatArray, opening: float, instance: str
    ) -> tuple[str | None, FloatArray | None]:
        """What is in the way of a grasp, or the path to it."""
        own = frozenset({instance})
        for joints in (at, before):  # the cheap checks first
            hit = self.clearance.hits(joints, opening, allowed=own, allowed_depth=_TARGET_DEPTH)
            if hit is not None:
                return hit, None
        path = tool_line(self.arm, before, position, rotation, spacing=0.02)
        if path is None:
            return None, None
        for joints in path:
            hit = self.clearance.hits(joints, opening, allowed=own, allowed_depth=_TARGET_DEPTH)
            if hit is not None:
                return hit, None
        return None, path

    def try_grasp(self, world: RobotWorld, grasp: ReachableGrasp) -> GraspOutcome:
        """Simulates a grasp in the scene: approach, close, lift, hold. The simulation is left as it then is."""
        index = self.built.names.index(grasp.instance)
        start = world.object_poses
        world.place_arm(grasp.before, grasp.opening)
        for joints in timed(grasp.approach, _SPEED, CONTROL_SECONDS):
            world.advance(joints, grasp.opening, CONTROL_SECONDS)
        world.advance(grasp.approach[-1], grasp.opening, STILL_SECONDS)
        world.advance(grasp.approach[-1], 0.0, CLOSE_SECONDS)
        if world.has_diverged:
            return GraspOutcome.DIVERGED
        if grasp.instance not in world.contacts().gripped:
            return GraspOutcome.MISSED
        in_hand = self._in_hand(world, index)
        for joints in timed(self.lift(grasp), _SPEED, CONTROL_SECONDS):
            world.advance(joints, 0.0, CONTROL_SECONDS)
        world.advance(world.commanded_joints, 0.0, _HOLD_SECONDS)
        if world.has_diverged:
            return GraspOutcome.DIVERGED
        end = world.object_poses
        moved = np.linalg.norm(end[:, :3] - start[:, :3], axis=1)
        came_up = end[index, 2] - start[index, 2]
        slip = np.linalg.norm(self._in_hand(world, index) - in_hand)
        contacts = world.contacts()
        if grasp.instance not in contacts.gripped or came_up < _LIFTED_SHARE * LIFT or slip > _SLIP:
            return GraspOutcome.SLIPPED
        riders = _carried(contacts.supports, grasp.instance)
        others = [k for k, name in enumerate(self.built.names) if name != grasp.instance and name not in riders]
        if others and moved[others].max() > _DISTURBED:
            return GraspOutcome.DISTURBED
        return GraspOutcome.HELD

    def _in_hand(self, world: RobotWorld, index: int) -> FloatArray:
        """Where an object is in the tool frame, (3,), metres."""
        position, rotation = self.built.tool_pose(world.data)
        return np.asarray((self.built.mount.to_base(world.object_poses[index, :3]) - position) @ rotation)

    def lift(self, grasp: ReachableGrasp, height: float = LIFT) -> FloatArray:
        """Configurations that lift the tool straight up from a grasp, (T, J), as far as the arm can follow."""
        at = grasp.approach[-1]
        for share in (1.0, 0.75, 0.5):
            above = grasp.position + np.array([0.0, 0.0, share * height])
            path = tool_line(self.arm, at, above, grasp.rotation, spacing=0.02, may_turn=not self.arm.is_full)
            if path is not None:
                return path
        return grasp.approach[::-1]

    def trials(
        self, world: RobotWorld, grasps: Sequence[ReachableGrasp], tries: int
    ) -> Iterator[tuple[ReachableGrasp, GraspOutcome]]:
        """Tries the first of some grasps one after the other, each in the scene as it is now, and restores the scene.

        Args:
            world: The simulation.
            grasps: The grasps, the best first.
            tries: How many are tried at most.
        """
        state = world.snapshot()
        for grasp in grasps[:tries]:
            outcome = self.try_grasp(world, grasp)
            world.restore(state)
            yield grasp, outcome


def _carried(supports: Mapping[str, tuple[str, ...]], carrier: str) -> frozenset[str]:
    """Everything that rests on an object, directly or through others."""
    found: set[str] = set()
    open_ = [carrier]
    while open_:
        below = open_.pop()
        for name, carriers in supports.items():
            if below in carriers and name not in found:
                found.add(name)
                open_.append(name)
    return frozenset(found)
