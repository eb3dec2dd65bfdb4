"""Where a clean layout does not stay at rest in the physics engine, objects are put where they do, clean all the same.

The engine collides convex parts, which fill hollows and round edges that the meshes have, and it lets round things roll. What
it moves is looked at from below: an object that moves though all others are held is the cause of what happens, and is tried at
other places and yaws; each has to be clean by the meshes first, and then to stay in the engine. What is carried looks for them
on its carrier, where the engine takes it first; what rolls or tips over on the table leans against a neighbour. Tilts never
change.
"""

from collections.abc import Iterator, Sequence

import numpy as np
import shapely

from models.physics_corrector.certify.layout_state import LayoutState
from models.physics_corrector.certify.mesh_queries import MeshQueries
from models.physics_corrector.certify.resting_pose import is_at_rest
from models.physics_corrector.certify.settle_trial import SettleTrial
from models.physics_corrector.certify.support_inference import TABLE_TOP, SupportEdge, beyond, wanted_carriers
from models.physics_corrector.packing.packing_problem import AXES, holds
from stable_data.metrics.audit import BOUNDS_SLACK
from stable_data.metrics.collision import TOLERANCE
from stable_data.scene import FloatArray, Relation
from stable_data.scene_graph.relations import INSIDE_SLACK
from stable_data.simulation.settling import MOVE_LIMIT, TURN_LIMIT, RigidBody

_VERDICT, _LOOK = 4.0, 1.5  # seconds that things are let go: to say that they stay, and to see where they fall
_ROUNDS, _PATIENCE = 4, 3  # how often everything is let go, and how often an object is put elsewhere
_BESIDE = 0.01  # what is so near to a thing that is let go is held beside it, metres
_TOUCH = 2e-3  # what is so near to a thing in its new place is let go with it, metres
_DEEP = 0.5  # what is so far below its container's rim is deep in it, share of its own height
_RIM = 4e-3  # the bottom of what is in a container stays this much below its rim, metres
_RINGS = (0.003, 0.007, 0.012, 0.018, 0.026, 0.036, 0.05, 0.07, 0.1)  # how far away a place is looked for, metres
_AROUND, _TURNS = 8, 12
_TURN_COST = 0.008  # metres a radian
_CLIMB = 2.0  # how much rising counts beside moving aside
_BATCH, _BATCHES = 16, 20  # places that are looked at together, the best of them first; and how many of such
_SAME = np.array([1e3, 1e3, 1e3, 20.0])  # poses are the same within a millimetre and 3 degrees
_FOLLOWED = 2  # how often the place to which the engine takes a thing is tried next
_FARTHEST = 0.3  # how far away a neighbour to lean on is looked for, metres
_NEIGHBOURS, _SIDES = 8, 8
_ASKEW = (0.0, 0.7, -0.7)  # and how much a thing that leans is turned from the way that it falls, radians
_BROKEN = 0.15  # what a lost directional relation costs, metres


class SettleRepair:
    """Makes a clean layout rest in the engine, as far as it can.

    Args:
        layout: The layout, clean by the exact audit; changed.
        meshes: Its objects.
        bodies: The same as the engine sees them.
        orders: Directional relations that should be kept.
        places: At how many an object is tried in the engine at most.
    """

    def __init__(
        self, layout: LayoutState, meshes: MeshQueries, bodies: Sequence[RigidBody], orders: Sequence[Relation], places: int
    ) -> None:
        self._layout, self._meshes, self._bodies, self._places = layout, meshes, bodies, places
        self._meant = set(wanted_carriers(layout.scene))
        self._seen: dict[tuple[tuple[int, ...], bytes], list[int]] = {}
        self._moved: list[int] = []
        self._patience = [_PATIENCE] * len(bodies)
        self._refused: list[list[FloatArray]] = [[] for _ in bodies]
        number = {o.instance: k for k, o in enumerate(layout.scene.objects)}
        self._orders = [(number[r.subject], number[r.target], np.array(AXES[r.kind])) for r in orders]

    def settle(self, moved: Sequence[int]) -> None:
        """Puts what the engine moves elsewhere, as far as that is found to help.

        Args:
            moved: What it moves.
        """
        layout = self._layout
        best = moved, layout.poses.copy(), list(layout.carried)
        for _ in range(_ROUNDS):
            self._moved = self._seen_moving()
            while self._moved and self._improved():
                self._moved = self._seen_moving()
            moved = self._moving(self._trial(layout.present(), []))
            if len(moved) < len(best[0]):
                best = moved, layout.poses.copy(), list(layout.carried)
            self._moved = moved
            if not moved or not self._improved():
                break
        layout.poses[:], layout.carried[:] = best[1], best[2]

    def _seen_moving(self) -> list[int]:
        """What moves when one tree at a time is let go: quicker than everything at once, and nearly as true."""
        layout, moved = self._layout, []
        for root in layout.roots():
            tree = layout.tree(root)
            around = self._around(*self._box(tree), _BESIDE)
            key = (*tree, TABLE_TOP, *around), layout.poses[[*tree, *around]].tobytes()
            if key not in self._seen:
                self._seen[key] = self._moving(self._trial(tree, around))
            moved += self._seen[key]
        return moved

    def _moving(self, trial: SettleTrial) -> list[int]:
        stays = trial.stays(self._layout.poses, _VERDICT, MOVE_LIMIT, TURN_LIMIT)
        moved = [k for k, stay in zip(trial.free, stays.tolist(), strict=True) if not stay]
        for k in moved:
            self._refused[k].append(self._layout.poses[k].copy())
        return moved

    def _box(self, members: Sequence[int]) -> tuple[FloatArray, FloatArray]:
        """The box around objects, two (3,) metres."""
        boxes = [self._meshes.box(m, self._layout.poses[m]) for m in members]
        return np.min([low for low, _ in boxes], axis=0), np.max([high for _, high in boxes], axis=0)

    def _improved(self) -> bool:
        """Puts elsewhere what moves by itself, or, where nothing does, what others move. False where nothing could be."""
        layout = self._layout
        free = [k for k in self._moved if self._patience[k] and np.isfinite(layout.stiffness(k))]
        free.sort(key=lambda k: (layout.low(k), k))
        causes = [k for k in free if not self._stays(k)]
        for some in (causes, [k for k in free if k not in causes]):
            changed = False
            for k in some:
                is_put = self._put_elsewhere(k)
                changed |= is_put
                self._patience[k] = self._patience[k] - 1 if is_put else 0
            if changed:
                return True
        return False

    # --- one object

    def _stays(self, k: int) -> bool:
        """Does an object stay where it is while all others are held?"""
        trial = self._trial([k], self._around(*self._box([k]), _BESIDE))
        return trial.all_stay(self._layout.poses, _VERDICT, MOVE_LIMIT, TURN_LIMIT)

    def _trial(self, free: Sequence[int], held: Sequence[int]) -> SettleTrial:
        held = [j for j in held if j not in free]
        return SettleTrial(self._bodies, self._layout.poses, free, held, self._layout.scene.table)

    def _around(self, low: FloatArray, high: FloatArray, gap: float) -> list[int]:
        """What is so near to a box, two (3,) metres."""
        boxes = [(j, *self._meshes.box(j, self._layout.poses[j])) for j in self._layout.present()]
        return [j for j, least, most in boxes if (least <= high + gap).all() and (most >= low - gap).all()]

    def _put_elsewhere(self, k: int) -> bool:
        """Finds an object a place where it stays: on its carrier, else, if it may leave that, on the table."""
        layout, was = self._layout, self._layout.carried[k]
        if was.parent != TABLE_TOP:
            low, high = self._meshes.box(was.parent, layout.poses[was.parent])
            reach = float(np.linalg.norm(layout.shapes[k].size))
            if self._tried(k, self._carried(k), low - reach, high + reach):
                return True
            if not self._may_leave(k):
                return False
            layout.carried[k] = SupportEdge()
        reach = _FARTHEST + float(np.linalg.norm(layout.shapes[k].size))
        if self._tried(k, self._on_the_table(k), layout.poses[k, :3] - reach, layout.poses[k, :3] + reach):
            return True
        layout.carried[k] = was
        return False

    def _may_leave(self, k: int) -> bool:
        """May an object be put from its carrier onto the table: not meant to be there, and not deep in it?"""
        layout, p = self._layout, self._layout.carried[k].parent
        is_deep = self._meshes.box(p, layout.poses[p])[1][2] - layout.low(k) > _DEEP * layout.shapes[k].size[2]
        return k not in self._meant and not (layout.carried[k].is_in and is_deep)

    def _tried(self, k: int, candidates: Iterator[FloatArray], low: FloatArray, high: FloatArray) -> bool:
        """Takes the first candidate at which an object with all that it carries is clean and stays."""
        layout, tree = self._layout, self._layout.tree(k)
        trial = self._trial(tree, self._around(low, high, 0.0))
        was, refused = layout.poses.copy(), list(self._refused[k])
        for candidate in candidates:
            pose = candidate
            for _ in range(1 + _FOLLOWED):
                layout.carry(k, pose)
                if any(np.abs((pose - other) * _SAME).max() < 1 for other in refused) or not self._is_clean(tree, was):
                    layout.poses[tree] = was[tree]
                    break
                if trial.all_stay(layout.poses, _VERDICT, MOVE_LIMIT, TURN_LIMIT) and self._stays_among_others(tree):
                    return True
                ended = trial.outcome(layout.poses, _LOOK)[0]
                layout.poses[tree] = was[tree]
                refused.append(pose)
                if len(refused) >= self._places:
                    return False
                pose = self._down(k, ended)
        return False

    def _stays_among_others(self, tree: Sequence[int]) -> bool:
        """Does an object stay, with all that it carries, when what is near to it is free to move; and does that?"""
        layout = self._layout
        touching = {j for m in tree for j in self._around(*self._box([m]), _TOUCH)}
        free = sorted({m for j in {*touching, *tree} for m in layout.tree(layout.root_of(j))})
        trial = self._trial(free, self._around(*self._box(free), _BESIDE))
        stays = trial.stays(layout.poses, _VERDICT, MOVE_LIMIT, TURN_LIMIT)
        return all(stay or (m in self._moved and m not in tree) for m, stay in zip(free, stays.tolist(), strict=True))

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
        if parent == TABLE_TOP and layout.low(k) > TOLERANCE:
            return False
        if parent != TABLE_TOP and not self._is_carried(k, float(was[k, 2] - layout.shapes[k].size[2] / 2)):
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

    def _is_carried(self, k: int, was: float) -> bool:
        """Is an object, whose bottom was at a height, in its container as deep as to count, or on its carrier?"""
        layout, carried = self._layout, self._layout.carried[k]
        p = carried.parent
        outside = beyond(layout.poses[k, :2], layout.shapes[p].posed_footprint(layout.poses[p]))
        low, high = self._meshes.box(p, layout.poses[p])
        if carried.is_in and was < high[2] - _RIM:
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
        places = np.concatenate(
            [pose[None, :2], middle[None], *(centre + r * ring for r in _RINGS for centre in (pose[:2], middle))]
        )
        places = places[shapely.intersects_xy(region, places[:, 0], places[:, 1])]
        turns = 2 * np.pi * np.arange(_TURNS) / _TURNS
        turns = np.where(turns > np.pi, turns - 2 * np.pi, turns)
        cost = np.linalg.norm(places - pose[:2], axis=1)[:, None] + _TURN_COST * np.abs(turns)
        order = np.argsort(cost.ravel(), kind="stable")
        every = len(order) // _BATCH + 1
        for n in range(min(every, _BATCHES)):
            # In turn what is near, and some of everything.
            batch = order[n // 2 * _BATCH : (n // 2 + 1) * _BATCH] if n % 2 == 0 else order[n // 2 :: every]
            lowered = []
            for m in batch.tolist():
                place, turn = places[m // len(turns)], turns[m % len(turns)]
                there = self._down(k, np.array([*place, pose[2], pose[3] + turn]))
                lowered.append((float(cost.ravel()[m]) + _CLIMB * max(0.0, float(there[2] - pose[2])), there))
            yield from (there for _, there in sorted(lowered, key=lambda item: item[0]))

    def _on_the_table(self, k: int) -> Iterator[FloatArray]:
        """Poses on the table: free ones for what stands alone, and those at which it meets a neighbour the way that it falls."""
        layout, meshes = self._layout, self._meshes
        pose, own = layout.poses[k].copy(), set(layout.tree(k))
        pose[2] = layout.shapes[k].size[2] / 2
        alone = layout.poses.copy()
        alone[k] = pose
        trial = SettleTrial(self._bodies, alone, [k], [], layout.scene.table)
        candidates = []
        if trial.all_stay(alone, _VERDICT, MOVE_LIMIT, TURN_LIMIT):
            angles = 2 * np.pi * np.arange(_AROUND) / _AROUND
            ring = np.stack([np.cos(angles), np.sin(angles)], axis=1)
            places = np.concatenate([pose[None, :2], *(pose[:2] + r * ring for r in (*_RINGS, 0.15, 0.2, _FARTHEST))])
            candidates = [np.array([*place, *pose[2:]]) for place in places]
        way = trial.outcome(alone, _LOOK)[0, :2] - pose[:2]
        falls = float(np.arctan2(way[1], way[0]))
        reach = float(np.linalg.norm(layout.shapes[k].size[:2])) / 2
        found = []
        for j in layout.present():
            low, high = meshes.box(j, layout.poses[j])
            gap = np.linalg.norm(np.maximum(0.0, np.maximum(low[:2] - pose[:2], pose[:2] - high[:2])))
            if j not in own and gap <= _FARTHEST and low[2] < layout.shapes[k].size[2]:
                found.append((float(gap), j))
        for _, j in sorted(found)[:_NEIGHBOURS]:
            low, high = meshes.box(j, layout.poses[j])
            middle, distance = (low[:2] + high[:2]) / 2, reach + float(np.linalg.norm(high[:2] - low[:2])) / 2
            toward = float(np.arctan2(*(pose[:2] - middle)[::-1]))
            for side in toward + 2 * np.pi * np.arange(_SIDES) / _SIDES:
                out = np.array([np.cos(side), np.sin(side)])
                for turn in _ASKEW:
                    there = np.array([*(middle + distance * out), pose[2], pose[3] + side + np.pi - falls + turn])
                    candidates.append(meshes.slid(k, there, -out, [j], layout.poses, distance))
        yield from sorted(candidates, key=lambda there: self._cost(k, there))

    def _cost(self, k: int, pose: FloatArray) -> float:
        """How far an object is moved, and what relations of it and of what it carries that breaks, metres."""
        layout = self._layout
        tree, broken = set(layout.tree(k)), 0
        shift = pose[:2] - layout.poses[k, :2]
        for i, j, axis in self._orders:
            if (i in tree) != (j in tree) and layout.is_there[i] and layout.is_there[j]:
                offset = layout.poses[i, :2] - layout.poses[j, :2]
                after = offset + (shift if i in tree else -shift)
                broken += holds(offset, axis) and not holds(after, axis)
        return float(np.linalg.norm(shift)) + _BROKEN * broken
