"""The audit of a scene: exact verdicts on collision, support and bounds, for each pair of objects and each object.

The definitions are in docs/audit.md; they use the scaled and tilted triangle meshes. An object whose mesh is missing is a box.
What this box excludes is known (boxes that do not meet do not collide); the rest is unknown and never a pass. Verdicts beyond
the work limit of a scene are unknown too. Objects with the same triangles in the same place are judged once.
"""

import hashlib
import itertools
from collections import Counter
from collections.abc import Iterator, Sequence, Set
from dataclasses import replace
from functools import cached_property

import networkx as nx
import numpy as np

from stable_data.geometry.shape import Shape
from stable_data.geometry.surface_sampling import bottom_points
from stable_data.limits import LIMITS
from stable_data.metrics.bounds import enters_zone, leaves_table
from stable_data.metrics.collision import LEVELS, NEAR, penetration
from stable_data.metrics.support import carries, distance_to_surface
from stable_data.metrics.triangle_intersection import MeshPair, PosedTriangles, WorkBudget, WorkLimitError
from stable_data.metrics.verdicts import ROUNDING, TOLERANCE, Audit, ObjectVerdict, PairVerdict, num_tilted
from stable_data.scene import TABLE, FloatArray, Scene, SceneObject

BOUNDS_SLACK = 1e-3
"""How far a footprint may reach over an edge, metres: the rounding of the format."""

_GAP_WORK = 4  # work of one distance to a triangle, in triangles tested for a crossing
_MAX_CACHED = 2_000_000  # triangles of the cached pairs
_GAP_RANGE = 0.1  # the paper's gap is searched up to this distance, metres


class PosedScene:
    """The meshes of a scene at their poses, with their boxes. Answers of the exact tests are cached.

    Args:
        scene: The scene.
        shapes: The geometry of each object, in the scene's order.
        most: Penetrations over this one, metres, are not measured: they are infinite. For the audit, all must be measured.
    """

    def __init__(self, scene: Scene, shapes: Sequence[Shape], most: float = LEVELS[-1]) -> None:
        self.scene, self.shapes, self._most = scene, shapes, most
        self.instances = [o.instance for o in scene.objects]
        self.vertices = [shape.posed(pose) for shape, pose in zip(shapes, scene.poses(), strict=True)]
        # Column by column: reducing along the long axis of (V, 3) is slow.
        self.low = np.array([[v[:, axis].min() for axis in range(3)] for v in self.vertices]).reshape(-1, 3)
        self.high = np.array([[v[:, axis].max() for axis in range(3)] for v in self.vertices]).reshape(-1, 3)
        self.budget = WorkBudget(LIMITS.work.max_audit_triangles)
        self._surfaces: dict[int, PosedTriangles] = {}
        self._pairs: dict[tuple[int, int], MeshPair] = {}
        self._num_cached = 0
        self._depths: dict[tuple[int, int], float | None] = {}
        self._carries: dict[tuple[int, int, float], bool] = {}
        self._gaps: dict[int, float | None] = {}
        self._bottoms: dict[int, FloatArray] = {}

    def reuse(self, scene: Scene, audit: Audit) -> None:
        """Takes over the answers of an audit of another scene, on pairs of objects that are alike in both: nothing is judged twice.

        Args:
            scene: The audited scene, with the same assets.
            audit: Its audit.
        """
        if audit.is_cut_short:
            return
        number = {o.instance: k for k, o in enumerate(self.scene.objects)}
        verdicts = {o.instance: o for o in audit.objects}
        depths = {(p.first, p.second): p.penetration for p in audit.pairs}
        # An object that coincides with another one is judged by that one's triangles.
        same = [
            (number[o.instance], verdicts[o.instance])
            for o in scene.objects
            if (k := number.get(o.instance)) is not None
            and _geometry(o) == _geometry(self.scene.objects[k])
            and verdicts[o.instance].has_mesh
            and self.shapes[k].is_exact
            and self.first_equal[k] == k
        ]
        for (i, one), (j, other) in itertools.permutations(same, 2):
            self._carries[i, j, audit.tolerance + ROUNDING] = other.instance in one.supports
            if i < j and (other.instance, one.instance) not in depths:
                self._depths[i, j] = depths.get((one.instance, other.instance), 0.0)

    @cached_property
    def first_equal(self) -> list[int]:
        """For each object, the first object with the same triangles in the same place: itself, unless objects coincide."""
        boxes = [low.tobytes() + high.tobytes() for low, high in zip(self.low, self.high, strict=True)]
        count, first = Counter(boxes), dict[bytes, int]()
        # Only objects with equal boxes can coincide, so that the vertices of the others are not hashed.
        return [k if count[box] == 1 else first.setdefault(self._digest(k), k) for k, box in enumerate(boxes)]

    def _digest(self, index: int) -> bytes:
        return hashlib.sha256(self.vertices[index].tobytes() + self.shapes[index].faces.tobytes()).digest()

    def surface(self, index: int) -> PosedTriangles:
        """Triangles of one object with their boxes, metres, world frame."""
        index = self.first_equal[index]
        if index not in self._surfaces:
            self._surfaces[index] = PosedTriangles(self.vertices[index][self.shapes[index].faces])
        return self._surfaces[index]

    def pair(self, first: int, second: int, margin: float) -> MeshPair:
        """Two objects of the scene, first <= second, that may be moved by a margin. Recent pairs with the margin NEAR are cached.

        Raises:
            WorkLimitError: The work limit of the scene is reached.
        """
        one, other = self.surface(first), self.surface(second)
        if margin > NEAR:
            return MeshPair(one, other, margin, self.budget)
        if (first, second) not in self._pairs:
            self._pairs[first, second] = pair = MeshPair(one, other, NEAR, self.budget)
            self._num_cached += pair.num_triangles
            while self._num_cached > _MAX_CACHED and len(self._pairs) > 1:  # dicts are ordered: the oldest pair goes first
                self._num_cached -= self._pairs.pop(next(iter(self._pairs))).num_triangles
        return self._pairs[first, second]

    def penetration(self, first: int, second: int) -> float | None:
        """The penetration of two objects, metres; None if it is unknown, infinite if it was not measured."""
        if not (self.shapes[first].is_exact and self.shapes[second].is_exact):
            return None
        one, other = self.first_equal[first], self.first_equal[second]
        i, j = min(one, other), max(one, other)  # pairs of coinciding objects share one answer
        if (i, j) not in self._depths:
            try:
                self._depths[i, j] = penetration(self.surface(i), self.surface(j), self.pair(i, j, NEAR), self._most)
            except WorkLimitError:
                self._depths[i, j] = None
        return self._depths[i, j]

    @cached_property
    def meeting_boxes(self) -> list[tuple[int, int]]:
        """Pairs of objects whose axis-aligned boxes meet."""
        apart = (self.low[:, None] > self.high[None]).any(axis=2)
        apart |= apart.T  # an entry compares its pair in one order only
        first, second = np.nonzero(np.triu(~apart, 1))
        return list(zip(first.tolist(), second.tolist(), strict=True))

    def below(self, index: int, gap: float) -> Iterator[int]:
        """Objects whose boxes the object's box meets when it is lowered by up to a gap, metres."""
        lowered = self.low[index] - (0, 0, gap)
        meets = (lowered <= self.high).all(axis=1) & (self.high[index] >= self.low).all(axis=1)
        return (int(j) for j in np.nonzero(meets)[0] if j != index)

    def stands_on_table(self, index: int, gap: float) -> bool:
        """Whether the object reaches the table top when it is lowered by a gap, metres."""
        # A box that only touches the edge from outside is not over the table.
        over = (self.low[index, :2] < self.scene.table.size_xy).all() and (self.high[index, :2] > 0).all()
        return bool(over and self.low[index, 2] <= gap + ROUNDING)

    def nears_zone(self, index: int) -> bool:
        """Whether the object's axis-aligned box meets the restricted zone."""
        zone = self.scene.table.restricted_zone
        if zone is None:
            return False
        low, high = self.low[index], self.high[index]
        return bool(low[0] < zone[1] and high[0] > zone[0] and low[1] < zone[3] and high[1] > zone[2])

    def supports(self, index: int, gap: float) -> tuple[str, ...] | None:
        """Returns the supports that an object meets when it is lowered by a gap.

        Args:
            index: The object.
            gap: Metres.

        Returns:
            Instances and ``table``; None if no known support is found and an unknown one is possible.
        """
        found, is_uncertain = self._supports(index, gap)
        return None if is_uncertain and not found else found

    def _supports(self, index: int, gap: float) -> tuple[tuple[str, ...], bool]:
        """The known supports of an object, and whether unknown ones are possible."""
        found, is_uncertain = [TABLE] if self.stands_on_table(index, gap) else [], False
        reach = gap + ROUNDING
        for other in self.below(index, reach):
            if not (self.shapes[index].is_exact and self.shapes[other].is_exact):
                is_uncertain = True
                continue
            try:
                if self._is_carried(self.first_equal[index], self.first_equal[other], reach):
                    found.append(self.instances[other])
            except WorkLimitError:
                is_uncertain = True
        return tuple(found), is_uncertain

    def _is_carried(self, upper: int, lower: int, reach: float) -> bool:
        key = upper, lower, reach
        if key not in self._carries:
            pair = self.pair(min(upper, lower), max(upper, lower), reach)
            self._carries[key] = carries(pair, reach, upper_is_first=upper <= lower)
        return self._carries[key]

    def gap(self, index: int) -> float | None:
        """The paper's distance of the bottom region to the nearest support (L_sup, delta), metres; None if unknown."""
        same = self.first_equal[index]  # its neighbours are the same, except for the names
        if same not in self._gaps:
            try:
                self._gaps[same] = self._gap(index)
            except WorkLimitError:
                self._gaps[same] = None
        return self._gaps[same]

    def _gap(self, index: int) -> float | None:
        best, lowest = _GAP_RANGE, float(self.low[index, 2])
        if self.stands_on_table(index, _GAP_RANGE):
            if abs(lowest) <= TOLERANCE + ROUNDING:
                return max(0.0, lowest)  # the region is higher than the tolerance: it crosses the table top if lowest < 0
            best = min(best, lowest) if lowest > 0 else float(min(best, np.abs(self._bottom(index)[:, 2]).min()))
        others = list(self.below(index, best))  # a support found so far bounds the search
        if others and not all(self.shapes[k].is_exact for k in (index, *others)):
            return None
        for other in dict.fromkeys(self.first_equal[k] for k in others):
            bottom, surface = self._bottom(index), self.surface(other)
            self.budget.spend(_GAP_WORK * (len(bottom) + len(surface.triangles)))
            best = distance_to_surface(bottom, surface, best)
        return best

    def _bottom(self, index: int) -> FloatArray:
        """Points of an object's bottom region, (P, 3) float64, metres, world frame."""
        if index not in self._bottoms:
            self._bottoms[index] = bottom_points(self.vertices[index], self.shapes[index].faces).astype(np.float64)
        return self._bottoms[index]


def audit_scene(scene: Scene, shapes: Sequence[Shape], tolerance: float = TOLERANCE) -> Audit:
    """Judges a scene exactly.

    Args:
        scene: The scene.
        shapes: The geometry of each object, in the scene's order (``AssetStore.shapes``).
        tolerance: Accepted penetration, gap and depth in the table, metres.
    """
    return audit_posed_scene(PosedScene(scene, shapes), tolerance)


def audit_posed_scene(posed: PosedScene, tolerance: float = TOLERANCE) -> Audit:
    """Judges a scene whose meshes are posed already; see :func:`audit_scene`."""
    pairs = []
    fixed = posed.scene.fixed & set(posed.instances)
    is_fixed = [name in fixed for name in posed.instances]
    for i, j in posed.meeting_boxes:
        if is_fixed[i] and is_fixed[j]:
            continue
        depth = posed.penetration(i, j)
        if depth != 0.0:
            pairs.append(PairVerdict(posed.instances[i], posed.instances[j], depth))
    judged = [
        (_of_surroundings(posed, index), False) if is_fixed[index] else _judge_object(posed, index, tolerance)
        for index in range(len(posed.instances))
    ]
    objects = _mark_support_cycles(tuple(o for o, _ in judged), {o.instance for o, is_uncertain in judged if is_uncertain})
    tilted = num_tilted(posed.scene)
    return Audit(posed.scene.scene_id, tuple(pairs), objects, tilted, tolerance, posed.budget.is_spent, fixed)


def _geometry(o: SceneObject) -> tuple[object, ...]:
    return o.asset_id, o.scale, o.size, o.tilt_quat_xyzw, o.position, o.yaw


def _of_surroundings(posed: PosedScene, index: int) -> ObjectVerdict:
    """The verdict on a fixed object: it hangs or stands where it is fixed, whatever is below it."""
    return ObjectVerdict(posed.instances[index], False, (), 0.0, 0.0, False, False, posed.shapes[index].is_exact)


def _judge_object(posed: PosedScene, index: int, tolerance: float) -> tuple[ObjectVerdict, bool]:
    """The verdict on an object, and whether it may have unknown supports besides."""
    supports, is_uncertain = posed._supports(index, tolerance)
    table, slack, is_exact = posed.scene.table, BOUNDS_SLACK + ROUNDING, posed.shapes[index].is_exact
    leaves = leaves_table(posed.low[index], posed.high[index], table, slack)
    # Most objects are far from the zone; their boxes show it without a look at the triangles.
    enters = posed.nears_zone(index) and enters_zone(posed.surface(index).triangles, table.restricted_zone, slack)
    verdict = ObjectVerdict(
        instance=posed.instances[index],
        floats=None if is_uncertain and not supports else not supports,
        supports=supports,
        gap=posed.gap(index),
        table_penetration=max(0.0, -float(posed.low[index, 2])),
        leaves_table=leaves and (is_exact or None),  # a box over the edge proves nothing about the missing mesh
        enters_restricted_zone=enters and (is_exact or None),
        has_mesh=is_exact,
    )
    return verdict, is_uncertain


def _mark_support_cycles(objects: tuple[ObjectVerdict, ...], is_uncertain: Set[str] = frozenset()) -> tuple[ObjectVerdict, ...]:
    """Marks objects as floating that support only each other: lowered together, they meet nothing.

    Args:
        objects: The verdicts on single objects.
        is_uncertain: Instances with possible unknown supports: whether a cycle with one of them floats is unknown.
    """
    carriers: nx.DiGraph[str] = nx.DiGraph((o.instance, below) for o in objects for below in o.supports)
    floating = {
        name: None if cycle & is_uncertain else True
        for cycle in nx.strongly_connected_components(carriers)
        if len(cycle) > 1 and all(below in cycle for one in cycle for below in carriers.successors(one))
        for name in cycle
    }
    return tuple(replace(o, floats=floating.get(o.instance, o.floats)) for o in objects)
