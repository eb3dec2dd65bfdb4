"""Repair of a clean layout that does not stay at rest in MuJoCo: objects move to places where they stay, with the same tilts.

MuJoCo collides convex parts, which fill cavities and round off edges of the meshes, and round objects roll. The repair goes from
the table upwards: an object that moves while all others are held is a cause, and is tried at other places and yaws. A candidate
must first be clean by the meshes, and then stay in MuJoCo. For an object on a carrier, the pose to which MuJoCo moves it is a
candidate too; an object that rolls or tips over on the table is leaned against a neighbour.
"""

from collections.abc import Iterator, Sequence
from dataclasses import replace

import numpy as np
import shapely

from models.physics_corrector.certify.certifier import Certifier, one_blas_thread
from models.physics_corrector.certify.layout_search import build_scene
from models.physics_corrector.certify.layout_state import LayoutState
from models.physics_corrector.certify.mesh_queries import MeshQueries
from models.physics_corrector.certify.options import CertificationResult
from models.physics_corrector.certify.packing_bodies import directional_relations
from models.physics_corrector.certify.resting_pose import is_at_rest
from models.physics_corrector.certify.support_inference import TABLE_TOP, SupportEdge, distance_outside, expected_carriers
from models.physics_corrector.packing.packing_problem import AXES, holds_relation
from models.physics_corrector.stabilization.limits import LOOK_SECONDS, STAYS, VERDICT_SECONDS
from models.physics_corrector.stabilization.settle_trial import SettleTrial
from stable_data.errors import SceneError
from stable_data.geometry.leaning import RIM_MARGIN
from stable_data.metrics.audit import BOUNDS_SLACK, audit_scene
from stable_data.metrics.verdicts import TOLERANCE
from stable_data.scene import FloatArray, Relation, Scene
from stable_data.scene_graph.relations import INSIDE_SLACK
from stable_data.simulation.settling import PhysicsOptions, RigidBody, SettleResult, settle

# Tuned on: not recorded, for all values below.
# --- attempts
_ROUNDS = 4  # simulations of the whole scene
_MOVES_PER_OBJECT = 3  # relocations of one object
_OUTCOMES_FOLLOWED = 2  # times that the final pose of a trial is the next candidate
# --- which objects take part in a trial
_HELD_GAP = 0.01  # objects this near to a free one are held beside it, metres
_FREE_GAP = 2e-3  # objects this near to one at its new place are free with it, metres
_DEEP = 0.5  # an object this far below the rim is deep in its container, share of its own height
# --- candidates on a carrier
_RINGS = (0.003, 0.007, 0.012, 0.018, 0.026, 0.036, 0.05, 0.07, 0.1)  # distances, metres
_DIRECTIONS, _YAWS = 8, 12  # directions on a ring; yaws at each place
_YAW_COST = 0.008  # cost of turning, metres a radian
_RISE_COST = 2.0  # cost of rising, metres a metre
_BATCH, _BATCHES = 16, 20  # candidates that are lowered together and then sorted; number of batches
_POSE_SCALE = np.array([1e3, 1e3, 1e3, 20.0])  # two poses are equal below 1 in all: 1 mm and 3 degrees (0.05 rad)
# --- candidates on the table
_FAR_RINGS = (0.15, 0.2)  # distances besides _RINGS, metres
_NEIGHBOUR_RANGE = 0.3  # largest distance, metres, of a place and of a neighbour to lean on
_NEIGHBOURS, _SIDES = 8, 8  # neighbours, and sides of each, that are tried
_YAW_OFFSETS = (0.0, 0.7, -0.7)  # turns of a leaning object away from the direction in which it falls, radians
_RELATION_COST = 0.15  # cost of a broken directional relation, metres


def repair_settling(certifier: Certifier, done: CertificationResult, bodies: Sequence[RigidBody]) -> CertificationResult:
    """Simulates a certified scene in MuJoCo, and moves objects that do not stay at rest to places where they do.

    Args:
        certifier: The certifier of the scene; its ``options.places`` is the number of places for each object, 0 for none.
        done: Its result; a verdict in it is used instead of a first simulation.
        bodies: The objects for MuJoCo (``stable_data.simulation.collision_bodies.bodies_of``), in the scene's order.

    Returns:
        The result with MuJoCo's verdict; if the simulation fails, ``reason`` gives the cause.

    Raises:
        SceneError: The bodies do not belong to the scene (``bodies_differ``).
    """
    scene, places = done.scene, certifier.options.places
    if [body.name for body in bodies] != [o.instance for o in certifier.scene.objects]:
        raise SceneError(
            f"{certifier.scene.scene_id}: the bodies are of other objects, expected the same in order", "bodies_differ"
        )
    if scene is None:
        return done
    body_of = {body.name: body for body in bodies}

    def verdict(of: Scene) -> SettleResult:
        placed = [replace(body_of[o.instance], position=o.position, yaw=o.yaw) for o in of.objects]
        return settle(placed, of.table, PhysicsOptions(stops_early=not places))

    with one_blas_thread():
        rest = done.rest or verdict(scene)
        if rest.stable is None:
            reason = "; ".join(filter(None, (done.reason, f"MuJoCo cannot simulate it: {rest.reason}")))
            return replace(done, reason=reason)
        if rest.stable or not places:
            return replace(done, rest=rest)
        layout = certifier.layout()
        before, unsteady = layout.poses.copy(), set(rest.unsteady)
        moved = [k for k in layout.present() if layout.scene.objects[k].instance in unsteady]
        orders = directional_relations(layout, certifier.original.poses())
        SettleRepair(layout, certifier.meshes, bodies, orders, places).settle(moved)
        if np.array_equal(layout.poses, before):
            return replace(done, rest=rest)
        repaired = build_scene(layout)
        audit = audit_scene(repaired, [certifier.shapes[k] for k in layout.present()])
        after = verdict(repaired)
        if audit.card().clean and after.num_restless <= rest.num_restless:
            return replace(certifier.conclude(repaired, audit), rest=after)
        return replace(done, rest=rest)


class SettleRepair:
    """The repair of one clean layout.

    Args:
        layout: The layout, clean by the exact audit; changed in place.
        meshes: Its objects.
        bodies: The same objects for MuJoCo.
        orders: Directional relations to preserve.
        places: Largest number of places at which an object is tried in MuJoCo.
    """

    def __init__(
        self, layout: LayoutState, meshes: MeshQueries, bodies: Sequence[RigidBody], orders: Sequence[Relation], places: int
    ) -> None:
        self._layout, self._meshes, self._bodies, self._places = layout, meshes, bodies, places
        self._wanted = set(expected_carriers(layout.scene))
        self._seen: dict[tuple[tuple[int, ...], bytes], list[int]] = {}
        self._moved: list[int] = []
        self._moves_left = [_MOVES_PER_OBJECT] * len(bodies)
        self._refused: list[list[FloatArray]] = [[] for _ in bodies]
        number = {o.instance: k for k, o in enumerate(layout.scene.objects)}
        self._orders = [(number[r.subject], number[r.target], np.array(AXES[r.kind])) for r in orders]

    def settle(self, moved: Sequence[int]) -> None:
        """Relocates objects that move, as long as fewer objects move after it.

        Args:
            moved: Indices of the objects that move.
        """
        layout = self._layout
        best = len(moved), layout.poses.copy(), list(layout.carried)
        for _ in range(_ROUNDS):
            self._moved = self._find_moving_by_tree()
            while self._moved and self._relocate_moving():
                self._moved = self._find_moving_by_tree()
            self._moved, num_restless = self._find_moving(self._trial(layout.present(), []))
            if num_restless < best[0]:
                best = num_restless, layout.poses.copy(), list(layout.carried)
            if not self._moved or not self._relocate_moving():
                break
        layout.poses[:], layout.carried[:] = best[1], best[2]

    def _find_moving_by_tree(self) -> list[int]:
        """Returns the objects that move while only their own tree is free: faster than the whole scene, nearly as accurate."""
        layout, moved = self._layout, []
        for root in layout.roots():
            tree = layout.tree(root)
            around = self._around(*self._box(tree), _HELD_GAP)
            key = (*tree, TABLE_TOP, *around), layout.poses[[*tree, *around]].tobytes()
            if key not in self._seen:
                self._seen[key] = self._find_moving(self._trial(tree, around))[0]
            moved += self._seen[key]
        return moved

    def _find_moving(self, trial: SettleTrial) -> tuple[list[int], int]:
        """Returns the free objects of a trial that move, and how many are not known to stay: more, if the simulation diverges."""
        stays, moves = trial.judge(self._layout.poses, VERDICT_SECONDS, STAYS.move, STAYS.turn)
        moved = [k for k, is_moving in zip(trial.free, moves.tolist(), strict=True) if is_moving]
        for k in moved:
            self._refused[k].append(self._layout.poses[k].copy())
        return moved, int((~stays).sum())

    def _box(self, members: Sequence[int]) -> tuple[FloatArray, FloatArray]:
        """Returns the box around objects, two (3,) metres."""
        boxes = [self._meshes.box(m, self._layout.poses[m]) for m in members]
        return np.min([low for low, _ in boxes], axis=0), np.max([high for _, high in boxes], axis=0)

    def _relocate_moving(self) -> bool:
        """Relocates objects that move by themselves, else those that others move. False if no object was relocated."""
        layout = self._layout
        free = [k for k in self._moved if self._moves_left[k] and np.isfinite(layout.stiffness(k))]
        free.sort(key=lambda k: (layout.low(k), k))
        causes = [k for k in free if not self._stays(k)]
        for some in (causes, [k for k in free if k not in causes]):
            changed = False
            for k in some:
                is_put = self._relocate(k)
                changed |= is_put
                self._moves_left[k] = self._moves_left[k] - 1 if is_put else 0
            if changed:
                return True
        return False

    # --- one object

    def _stays(self, k: int) -> bool:
        """Whether an object stays at its pose while all others are held."""
        trial = self._trial([k], self._around(*self._box([k]), _HELD_GAP))
        return trial.all_stay(self._layout.poses, VERDICT_SECONDS, STAYS.move, STAYS.turn)

    def _trial(self, free: Sequence[int], held: Sequence[int]) -> SettleTrial:
        held = [j for j in held if j not in free]
        return SettleTrial(self._bodies, self._layout.poses, free, held, self._layout.scene.table)

    def _around(self, low: FloatArray, high: FloatArray, gap: float) -> list[int]:
        """Returns the objects whose boxes are within a gap of a box, two (3,) metres."""
        boxes = [(j, *self._meshes.box(j, self._layout.poses[j])) for j in self._layout.present()]
        return [j for j, least, most in boxes if (least <= high + gap).all() and (most >= low - gap).all()]

    def _relocate(self, k: int) -> bool:
        """Moves an object to a place where it stays: on its carrier, else on the table if it may leave its carrier."""
        layout, was = self._layout, self._layout.carried[k]
        if was.parent != TABLE_TOP:
            low, high = self._meshes.box(was.parent, layout.poses[was.parent])
            reach = float(np.linalg.norm(layout.shapes[k].size))
            if self._move_to_first(k, self._carrier_candidates(k), low - reach, high + reach):
                return True
            if not self._may_leave(k):
                return False
            layout.carried[k] = SupportEdge()
        reach = _NEIGHBOUR_RANGE + float(np.linalg.norm(layout.shapes[k].size))
        if self._move_to_first(k, self._table_candidates(k), layout.poses[k, :3] - reach, layout.poses[k, :3] + reach):
            return True
        layout.carried[k] = was
        return False

    def _may_leave(self, k: int) -> bool:
        """Whether an object may leave its carrier for the table: no relation puts it there, and it is not deep in a container."""
        layout, p = self._layout, self._layout.carried[k].parent
        is_deep = self._meshes.box(p, layout.poses[p])[1][2] - layout.low(k) > _DEEP * layout.shapes[k].size[2]
        return k not in self._wanted and not (layout.carried[k].is_in and is_deep)

    def _move_to_first(self, k: int, candidates: Iterator[FloatArray], low: FloatArray, high: FloatArray) -> bool:
        """Moves an object, with all that it carries, to the first candidate pose at which they are clean and stay."""
        layout, tree = self._layout, self._layout.tree(k)
        # One model for all candidates: a trial starts anywhere within the box, and compiling takes longest.
        trial = self._trial(tree, self._around(low, high, 0.0))
        was, refused = layout.poses.copy(), list(self._refused[k])
        for candidate in candidates:
            pose = candidate
            for _ in range(1 + _OUTCOMES_FOLLOWED):
                layout.carry(k, pose)
                if any(np.abs((pose - other) * _POSE_SCALE).max() < 1 for other in refused) or not self._is_clean(tree, was):
                    layout.poses[tree] = was[tree]
                    break
                if trial.all_stay(layout.poses, VERDICT_SECONDS, STAYS.move, STAYS.turn) and self._stays_among_others(tree):
                    return True
                ended = trial.outcome(layout.poses, LOOK_SECONDS)[0]
                layout.poses[tree] = was[tree]
                refused.append(pose)
                if len(refused) >= self._places:
                    return False
                pose = self._lower(k, ended)
        return False

    def _stays_among_others(self, tree: Sequence[int]) -> bool:
        """Whether an object, all that it carries and all objects near it stay while they are free to move."""
        layout = self._layout
        touching = {j for m in tree for j in self._around(*self._box([m]), _FREE_GAP)}
        free = sorted({m for j in {*touching, *tree} for m in layout.tree(layout.root_of(j))})
        trial = self._trial(free, self._around(*self._box(free), _HELD_GAP))
        stays = trial.stays(layout.poses, VERDICT_SECONDS, STAYS.move, STAYS.turn)
        return all(stay or (m in self._moved and m not in tree) for m, stay in zip(free, stays.tolist(), strict=True))

    def _lower(self, k: int, pose: FloatArray) -> FloatArray:
        layout = self._layout
        own = set(layout.tree(k))
        others = [j for j in layout.present() if j not in own]
        return np.array([pose[0], pose[1], self._meshes.resting_height(k, pose, others, layout.poses), pose[3]])

    # --- exact checks

    def _is_clean(self, tree: Sequence[int], was: FloatArray) -> bool:
        """Whether the exact audit allows an object and all that it carries, and objects that leaned on these are still carried."""
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
        """Whether an object that the moved tree may have carried is still carried."""
        layout, meshes = self._layout, self._meshes
        if not meshes.near(j, layout.poses[j], tree, was, 2 * TOLERANCE):
            return True
        near = meshes.near(j, layout.poses[j], [*others, *tree], layout.poses, 2 * TOLERANCE)
        return bool(meshes.carriers_of(j, layout.poses[j], [m for m in near if m != j], layout.poses))

    def _is_carried(self, k: int, was: float) -> bool:
        """Whether an object is on its carrier, or deep enough in its container if its bottom was at a height ``was``."""
        layout, carried = self._layout, self._layout.carried[k]
        p = carried.parent
        outside = distance_outside(layout.poses[k, :2], layout.shapes[p].posed_footprint(layout.poses[p]))
        low, high = self._meshes.box(p, layout.poses[p])
        if carried.is_in and was < high[2] - RIM_MARGIN:
            return outside <= INSIDE_SLACK and low[2] - TOLERANCE <= layout.low(k) < high[2] - RIM_MARGIN
        return outside <= 0 and bool(self._meshes.carriers_of(k, layout.poses[k], [p], layout.poses))

    # --- candidates

    def _carrier_candidates(self, k: int) -> Iterator[FloatArray]:
        """Yields lowered poses of an object on or in its carrier, in order of cost."""
        layout = self._layout
        p, pose = layout.carried[k].parent, layout.poses[k].copy()
        region = shapely.Polygon(layout.shapes[p].posed_footprint(layout.poses[p]))
        angles = 2 * np.pi * np.arange(_DIRECTIONS) / _DIRECTIONS
        ring = np.stack([np.cos(angles), np.sin(angles)], axis=1)
        middle = np.array([region.centroid.x, region.centroid.y])
        places = np.concatenate(
            [pose[None, :2], middle[None], *(centre + r * ring for r in _RINGS for centre in (pose[:2], middle))]
        )
        places = places[shapely.intersects_xy(region, places[:, 0], places[:, 1])]
        turns = 2 * np.pi * np.arange(_YAWS) / _YAWS
        turns = np.where(turns > np.pi, turns - 2 * np.pi, turns)
        cost = np.linalg.norm(places - pose[:2], axis=1)[:, None] + _YAW_COST * np.abs(turns)
        order = np.argsort(cost.ravel(), kind="stable")
        every = len(order) // _BATCH + 1
        for n in range(min(every, _BATCHES)):
            # Batches alternate between the cheapest candidates and a sample of all.
            batch = order[n // 2 * _BATCH : (n // 2 + 1) * _BATCH] if n % 2 == 0 else order[n // 2 :: every]
            lowered = []
            for m in batch.tolist():
                place, turn = places[m // len(turns)], turns[m % len(turns)]
                there = self._lower(k, np.array([*place, pose[2], pose[3] + turn]))
                lowered.append((float(cost.ravel()[m]) + _RISE_COST * max(0.0, float(there[2] - pose[2])), there))
            yield from (there for _, there in sorted(lowered, key=lambda item: item[0]))

    def _table_candidates(self, k: int) -> Iterator[FloatArray]:
        """Yields poses on the table: free ones if the object stands alone, and poses at which it leans on a neighbour as it falls."""
        layout, meshes = self._layout, self._meshes
        pose, own = layout.poses[k].copy(), set(layout.tree(k))
        pose[2] = layout.shapes[k].size[2] / 2
        alone = layout.poses.copy()
        alone[k] = pose
        trial = SettleTrial(self._bodies, alone, [k], [], layout.scene.table)
        candidates = []
        if trial.all_stay(alone, VERDICT_SECONDS, STAYS.move, STAYS.turn):
            angles = 2 * np.pi * np.arange(_DIRECTIONS) / _DIRECTIONS
            ring = np.stack([np.cos(angles), np.sin(angles)], axis=1)
            places = np.concatenate([pose[None, :2], *(pose[:2] + r * ring for r in (*_RINGS, *_FAR_RINGS, _NEIGHBOUR_RANGE))])
            candidates = [np.array([*place, *pose[2:]]) for place in places]
        way = trial.outcome(alone, LOOK_SECONDS)[0, :2] - pose[:2]
        falls = float(np.arctan2(way[1], way[0]))
        reach = float(np.linalg.norm(layout.shapes[k].size[:2])) / 2
        found = []
        for j in layout.present():
            low, high = meshes.box(j, layout.poses[j])
            gap = np.linalg.norm(np.maximum(0.0, np.maximum(low[:2] - pose[:2], pose[:2] - high[:2])))
            if j not in own and gap <= _NEIGHBOUR_RANGE and low[2] < layout.shapes[k].size[2]:
                found.append((float(gap), j))
        for _, j in sorted(found)[:_NEIGHBOURS]:
            low, high = meshes.box(j, layout.poses[j])
            middle, distance = (low[:2] + high[:2]) / 2, reach + float(np.linalg.norm(high[:2] - low[:2])) / 2
            toward = float(np.arctan2(*(pose[:2] - middle)[::-1]))
            for side in toward + 2 * np.pi * np.arange(_SIDES) / _SIDES:
                out = np.array([np.cos(side), np.sin(side)])
                for turn in _YAW_OFFSETS:
                    there = np.array([*(middle + distance * out), pose[2], pose[3] + side + np.pi - falls + turn])
                    candidates.append(meshes.slide(k, there, -out, [j], layout.poses, distance))
        yield from sorted(candidates, key=lambda there: self._cost(k, there))

    def _cost(self, k: int, pose: FloatArray) -> float:
        """Returns the cost of a pose, metres: the distance moved, plus the relations that the move breaks."""
        layout = self._layout
        tree, broken = set(layout.tree(k)), 0
        shift = pose[:2] - layout.poses[k, :2]
        for i, j, axis in self._orders:
            if (i in tree) != (j in tree) and layout.is_there[i] and layout.is_there[j]:
                offset = layout.poses[i, :2] - layout.poses[j, :2]
                after = offset + (shift if i in tree else -shift)
                broken += holds_relation(offset, axis) and not holds_relation(after, axis)
        return float(np.linalg.norm(shift)) + _RELATION_COST * broken
