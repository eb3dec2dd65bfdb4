"""Where a clean layout does not stay at rest in the physics engine, objects are put where they do, clean all the same.

The engine collides convex parts, which fill hollows and round edges that the meshes have, and it lets round things roll. What it
moves is looked at from below: an object that moves though all others are held is the cause of what happens, and is tried at other
places and yaws; each has to be clean by the meshes first, and then to stay in the engine. What is carried looks for them on its
carrier, where the engine takes it first; what rolls or tips over on the table leans against a neighbour. Tilts never change.
"""

from collections.abc import Iterator, Sequence

import numpy as np
import shapely

from models.physics_corrector.certify.carriers import TABLE_TOP, beyond
from models.physics_corrector.certify.contact import Meshes
from models.physics_corrector.certify.crowd import AXES
from models.physics_corrector.certify.layout import Layout
from models.physics_corrector.certify.nesting import is_at_rest
from models.physics_corrector.certify.trial import Trial
from stable_data.metrics.audit import BOUNDS_SLACK
from stable_data.metrics.collision import TOLERANCE
from stable_data.physics import MOVE_LIMIT, TURN_LIMIT, Body
from stable_data.relations import INSIDE_SLACK
from stable_data.scene import FloatArray, Relation

_MARGIN = 0.8  # share of the limits within which an object has to stay where it is tried
_LOOK, _VERDICT = 1.5, 4.0  # seconds: to find what moves; and to say that it stays
_ROUNDS = 4
_REACH = 0.03  # what is so near to where an object may go is held beside it, metres
_RIM = 4e-3  # the bottom of what is in a container stays this much below its rim, metres
_RINGS = (0.003, 0.007, 0.012, 0.018, 0.026, 0.036, 0.05, 0.07, 0.1)  # how far away a place is looked for, metres
_AROUND, _TURNS = 8, 12
_TURN_COST = 0.008  # metres a radian
_CLIMB = 2.0  # how much rising counts beside moving aside
_BATCH = 24
_TRIALS, _LOWERED = 40, 240  # places that are tried at most for an object: in the engine, and by the meshes
_FOLLOWED, _FALLEN = 2, 45.0  # how often the engine's own outcome is tried next, where it turned less than this, degrees
_FARTHEST = 0.3  # how far away a neighbour to lean on is looked for, metres
_NEIGHBOURS, _SIDES = 8, 8
_BROKEN = 0.05  # what a lost directional relation costs, metres


class Resting:
    """Makes a clean layout rest in the engine, as far as it can.

    Args:
        layout: The layout, clean by the exact audit; changed.
        meshes: Its objects.
        bodies: The same as the engine sees them.
        orders: Directional relations that should be kept.
    """

    def __init__(self, layout: Layout, meshes: Meshes, bodies: Sequence[Body], orders: Sequence[Relation]) -> None:
        self._layout, self._meshes, self._bodies = layout, meshes, bodies
        number = {o.instance: k for k, o in enumerate(layout.scene.objects)}
        self._orders = [(number[r.subject], number[r.target], np.array(AXES[r.kind])) for r in orders]

    def settled(self) -> list[int]:
        """Puts what the engine moves elsewhere. Returns what still does not stay."""
        layout = self._layout
        moved = self._moved(_LOOK)
        best = (len(moved), layout.poses.copy(), list(layout.carried))
        hopeless: set[int] = set()
        for _ in range(_ROUNDS):
            changed = False
            for k in sorted(moved, key=lambda k: (layout.low(k), k)):
                if k not in hopeless and not layout.is_fixed[k] and not self._stays(k):
                    if self._put_elsewhere(k):
                        changed = True
                    else:
                        hopeless.add(k)
            if not changed:
                break
            moved = self._moved(_LOOK)
            if len(moved) < best[0]:
                best = (len(moved), layout.poses.copy(), list(layout.carried))
        layout.poses[:], layout.carried[:] = best[1], best[2]
        return self._moved(_VERDICT)

    def _moved(self, seconds: float) -> list[int]:
        layout = self._layout
        present = layout.present()
        trial = Trial(self._bodies, layout.poses, present, [], layout.scene.table)
        stays = trial.stays(layout.poses, seconds, MOVE_LIMIT, TURN_LIMIT)
        return [k for k, stay in zip(present, stays.tolist(), strict=True) if not stay]

    # --- one object

    def _stays(self, k: int) -> bool:
        """Does an object stay where it is while all others are held?"""
        low, high = self._meshes.box(k, self._layout.poses[k])
        return self._trial([k], low, high).all_stay(self._layout.poses, _VERDICT, MOVE_LIMIT, TURN_LIMIT)

    def _trial(self, free: Sequence[int], low: FloatArray, high: FloatArray) -> Trial:
        """Objects that are let go within a box, two (3,) metres, where all that may meet them is held."""
        layout, held = self._layout, []
        for j in layout.present():
            least, most = self._meshes.box(j, layout.poses[j])
            if j not in free and (least <= high + _REACH).all() and (most >= low - _REACH).all():
                held.append(j)
        return Trial(self._bodies, layout.poses, free, held, layout.scene.table)

    def _put_elsewhere(self, k: int) -> bool:
        layout = self._layout
        parent = layout.carried[k].parent
        if parent == TABLE_TOP:
            return self._tried(k, self._leaning(k), self._span(k, _FARTHEST), follows=True)
        low, high = self._meshes.box(parent, layout.poses[parent])
        reach = float(np.linalg.norm(layout.shapes[k].size))
        if self._tried(k, self._carried(k), (low - reach, high + reach), follows=True):
            return True
        return False

    def _span(self, k: int, distance: float) -> tuple[FloatArray, FloatArray]:
        reach = distance + float(np.linalg.norm(self._layout.shapes[k].size)) / 2
        return self._layout.poses[k, :3] - reach, self._layout.poses[k, :3] + reach

    def _tried(
        self, k: int, candidates: Iterator[FloatArray], span: tuple[FloatArray, FloatArray], *, follows: bool
    ) -> bool:
        """Takes the first candidate at which an object with all that it carries is clean and stays."""
        layout, tree = self._layout, self._layout.tree(k)
        trial = self._trial(tree, *span)
        was, number = layout.poses.copy(), 0
        move, turn = _MARGIN * MOVE_LIMIT, _MARGIN * TURN_LIMIT
        for candidate in candidates:
            pose = candidate
            for _ in range(1 + _FOLLOWED * follows):
                layout.carry(k, pose)
                if self._is_clean(tree, was):
                    number += 1
                    if trial.all_stay(layout.poses, _VERDICT, move, turn):
                        return True
                    ended, turns = trial.outcome(layout.poses, _LOOK)
                else:
                    turns = np.array([np.inf])
                layout.poses[tree] = was[tree]
                if turns[0] > _FALLEN or number >= _TRIALS:
                    break
                pose = self._down(k, ended[0])
            if number >= _TRIALS:
                break
        return False

    def _down(self, k: int, pose: FloatArray) -> FloatArray:
        layout = self._layout
        own = set(layout.tree(k))
        others = [j for j in layout.present() if j not in own]
        return np.array([pose[0], pose[1], self._meshes.lowered(k, pose, others, layout.poses), pose[3]])

    # --- what the meshes say

    def _is_clean(self, tree: Sequence[int], was: FloatArray) -> bool:
        """Is an object with all that it carries where the exact audit allows it, and what leant on it still at rest?"""
        layout, meshes = self._layout, self._meshes
        k, size = tree[0], np.array(layout.scene.table.size_xy)
        parent, others = layout.carried[k].parent, [j for j in layout.present() if j not in tree]
        zone = layout.scene.table.restricted_zone
        for m in tree:
            low, high = meshes.box(m, layout.poses[m])
            if (low[:2] < -BOUNDS_SLACK).any() or (high[:2] > size + BOUNDS_SLACK).any():
                return False
            if zone is not None and high[0] > zone[0] and low[0] < zone[1] and high[1] > zone[2] and low[1] < zone[3]:
                return False
        if parent != TABLE_TOP and not self._is_carried(k):
            return False
        if not is_at_rest(meshes, layout.poses, k, layout.poses[k], others):
            return False
        if any(
            meshes.penetrates(m, layout.poses[m], j, layout.poses[j])
            for m in tree[1:]
            for j in meshes.near(m, layout.poses[m], others, layout.poses)
        ):
            return False
        return all(self._still_rests(j, tree, others, was) for j in others if layout.low(j) > TOLERANCE)

    def _still_rests(self, j: int, tree: Sequence[int], others: Sequence[int], was: FloatArray) -> bool:
        """Does something still carry an object, where part of a tree that is moved may have carried it?"""
        layout, meshes = self._layout, self._meshes
        if not meshes.near(j, layout.poses[j], tree, was, 2 * TOLERANCE):
            return True
        near = meshes.near(j, layout.poses[j], [*others, *tree], layout.poses, 2 * TOLERANCE)
        return bool(meshes.rests(j, layout.poses[j], [m for m in near if m != j], layout.poses))

    def _is_carried(self, k: int) -> bool:
        layout, carried = self._layout, self._layout.carried[k]
        p = carried.parent
        outside = beyond(layout.poses[k, :2], layout.shapes[p].posed_footprint(layout.poses[p]))
        low, high = self._meshes.box(p, layout.poses[p])
        if carried.is_in:
            return outside <= INSIDE_SLACK and low[2] - TOLERANCE <= layout.low(k) < high[2] - _RIM
        return outside <= 0 and bool(self._meshes.rests(k, layout.poses[k], [p], layout.poses))

    # --- candidates

    def _carried(self, k: int) -> Iterator[FloatArray]:
        """Poses on or in its carrier to which an object comes down, those that move and turn it least first."""
        layout = self._layout
        p, pose = layout.carried[k].parent, layout.poses[k].copy()
        region = shapely.Polygon(layout.shapes[p].posed_footprint(layout.poses[p]))
        angles = 2 * np.pi * np.arange(_AROUND) / _AROUND
        ring = np.stack([np.cos(angles), np.sin(angles)], axis=1)
        middle = np.array([region.centroid.x, region.centroid.y])
        places = np.concatenate([pose[None, :2], middle[None], *(centre + r * ring for r in _RINGS for centre in (pose[:2], middle))])
        places = places[shapely.intersects_xy(region, places[:, 0], places[:, 1])]
        turns = 2 * np.pi * np.arange(_TURNS) / _TURNS
        turns = np.where(turns > np.pi, turns - 2 * np.pi, turns)
        cost = np.linalg.norm(places - pose[:2], axis=1)[:, None] + _TURN_COST * np.abs(turns)
        order = np.argsort(cost.ravel(), kind="stable")[:_LOWERED]
        for batch in np.array_split(order, max(1, len(order) // _BATCH)):
            lowered = []
            for n in batch.tolist():
                place, turn = places[n // len(turns)], turns[n % len(turns)]
                there = self._down(k, np.array([*place, pose[2], pose[3] + turn]))
                lowered.append((float(cost.ravel()[n]) + _CLIMB * max(0.0, float(there[2] - pose[2])), there))
            yield from (there for _, there in sorted(lowered, key=lambda item: item[0]))

    def _leaning(self, k: int) -> Iterator[FloatArray]:
        """Poses on the table at which an object, the way that it falls, meets a neighbour; near ones first."""
        layout, meshes = self._layout, self._meshes
        pose, own = layout.poses[k].copy(), set(layout.tree(k))
        falls = self._falls(k)
        reach = float(np.linalg.norm(layout.shapes[k].size[:2])) / 2
        found = []
        for j in layout.present():
            low, high = meshes.box(j, layout.poses[j])
            gap = np.linalg.norm(np.maximum(0.0, np.maximum(low[:2] - pose[:2], pose[:2] - high[:2])))
            if j not in own and gap <= _FARTHEST and low[2] < layout.shapes[k].size[2]:
                found.append((float(gap), j))
        candidates = []
        for _, j in sorted(found)[:_NEIGHBOURS]:
            low, high = meshes.box(j, layout.poses[j])
            middle, distance = (low[:2] + high[:2]) / 2, reach + float(np.linalg.norm(high[:2] - low[:2])) / 2
            toward = float(np.arctan2(*(pose[:2] - middle)[::-1]))
            for side in toward + 2 * np.pi * np.arange(_SIDES) / _SIDES:
                out = np.array([np.cos(side), np.sin(side)])
                there = np.array([*(middle + distance * out), pose[2], pose[3] + side + np.pi - falls])
                there = meshes.slid(k, there, -out, [j], layout.poses, distance)
                candidates.append((self._cost(k, there), there))
        yield from (there for _, there in sorted(candidates, key=lambda item: item[0]))

    def _falls(self, k: int) -> float:
        """The way that an object at its yaw falls on a bare table, radians."""
        layout = self._layout
        pose = layout.poses[k]
        trial = Trial(self._bodies, layout.poses, [k], [], layout.scene.table)
        way = trial.outcome(layout.poses, _LOOK)[0][0, :2] - pose[:2]
        return float(np.arctan2(way[1], way[0]))

    def _cost(self, k: int, pose: FloatArray) -> float:
        """How far an object is moved, and what relations of it and of what it carries that breaks, metres."""
        layout = self._layout
        tree, broken = set(layout.tree(k)), 0
        shift = pose[:2] - layout.poses[k, :2]
        for i, j, axis in self._orders:
            if (i in tree) != (j in tree) and layout.is_there[i] and layout.is_there[j]:
                offset = layout.poses[i, :2] - layout.poses[j, :2]
                after = offset + (shift if i in tree else -shift)
                broken += _holds(offset, axis) and not _holds(after, axis)
        return float(np.linalg.norm(shift)) + _BROKEN * broken


def _holds(offset: FloatArray, axis: FloatArray) -> bool:
    """Is an offset (2,) within 45 degrees of an axis (2,)?"""
    along = float(offset @ axis)
    return along > 0 and 2 * along * along >= float(offset @ offset)
