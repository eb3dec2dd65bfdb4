"""The audit of a scene: exact verdicts on collision, support and bounds, for each pair of objects and each object.

The definitions are in docs/audit.md; they use the scaled and tilted triangle meshes. An object whose mesh is missing is a box.
What this box excludes is known (boxes that do not meet do not collide); the rest is unknown and never a pass. Verdicts beyond
the work limit of a scene are unknown too. Objects with the same triangles in the same place are judged once.
"""

import hashlib
import itertools
import math
from collections import Counter
from collections.abc import Iterator, Sequence, Set
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import networkx as nx
import numpy as np

from stable_data.errors import Notice
from stable_data.geometry.shape import Shape
from stable_data.geometry.surface_sampling import bottom_points
from stable_data.limits import LIMITS, at_most
from stable_data.metrics.bounds import enters_zone, leaves_table
from stable_data.metrics.card import MetricCard
from stable_data.metrics.collision import LEVELS, NEAR, ROUNDING, TOLERANCE, penetration
from stable_data.metrics.support import carries, distance_to_surface
from stable_data.metrics.triangle_intersection import MeshPair, PosedTriangles, WorkBudget, WorkLimitError
from stable_data.scene import TABLE, FloatArray, Scene, SceneObject

BOUNDS_SLACK = 1e-3
"""How far a footprint may reach over an edge, metres: the rounding of the format."""

_GAP_WORK = 4  # work of one distance to a triangle, in triangles tested for a crossing
_MAX_CACHED = 2_000_000  # triangles of the cached pairs
_GAP_RANGE = 0.1  # the paper's gap is searched up to this distance, metres


@dataclass(frozen=True, slots=True)
class PairVerdict:
    """The penetration of two objects.

    Attributes:
        first: Instance.
        second: Instance.
        penetration: Metres; None if the boxes meet and a mesh is missing or the audit was cut short.
    """

    first: str
    second: str
    penetration: float | None


@dataclass(frozen=True, slots=True)
class ObjectVerdict:
    """The verdict on one object.

    Attributes:
        instance: Its name.
        floats: Lowered by the tolerance, it meets no support, or only objects that it supports itself. None if a missing mesh,
            or an audit that was cut short, leaves this open.
        supports: The supports that it meets when lowered: instances, or ``table``.
        gap: The paper's smallest distance of the bottom region to a support, metres; None if unknown.
        table_penetration: How far it reaches below the table top, metres.
        leaves_table: Its footprint reaches over the edge; None if only the box of a missing mesh does.
        enters_restricted_zone: Its footprint reaches into the restricted zone; None as for ``leaves_table``.
        has_mesh: Whether its mesh is available.
    """

    instance: str
    floats: bool | None
    supports: tuple[str, ...]
    gap: float | None
    table_penetration: float
    leaves_table: bool | None
    enters_restricted_zone: bool | None
    has_mesh: bool

    @property
    def is_outside(self) -> bool | None:
        """Whether it is out of bounds in either way."""
        if self.leaves_table or self.enters_restricted_zone:
            return True
        return None if self.leaves_table is None or self.enters_restricted_zone is None else False


@dataclass(frozen=True)
class Audit:
    """All verdicts on one scene.

    Attributes:
        scene_id: The scene.
        pairs: Pairs that touch or are unknown; every other pair is apart.
        objects: One verdict for each object, in the scene's order.
        num_tilted: Objects tilted by more than 5 degrees.
        tolerance: The tolerance of floating and of the card's headline figures, metres.
        is_cut_short: Whether the work limit was reached, so that verdicts are unknown.
        fixed: Objects of the surroundings (``Scene.fixed``): they count in no share, and have no fault of their own.
    """

    scene_id: str
    pairs: tuple[PairVerdict, ...]
    objects: tuple[ObjectVerdict, ...]
    num_tilted: int
    tolerance: float = TOLERANCE
    is_cut_short: bool = False
    fixed: frozenset[str] = frozenset()

    @property
    def num_judged(self) -> int:
        """Number of objects that are judged: all but the fixed ones."""
        return len(self.objects) - len(self.fixed)

    @property
    def num_pairs(self) -> int:
        """Number of pairs that are judged: all but those of two fixed objects."""
        return math.comb(len(self.objects), 2) - math.comb(len(self.fixed), 2)

    @property
    def notices(self) -> tuple[Notice, ...]:
        """The warning that the audit was cut short, if it was."""
        if not self.is_cut_short:
            return ()
        unknown = sum(p.penetration is None for p in self.pairs)
        message = (
            f"{self.scene_id}: work limit reached with {unknown} pairs of objects unknown, expected "
            f"{at_most(LIMITS.work, 'max_audit_triangles', 'triangles')} to test; separate the objects that overlap, or use simpler meshes"
        )
        return (Notice(self.scene_id, "audit", "audit_cut_short", message),)

    def share_deeper(self, depth: float) -> float | None:
        """The share of all pairs that collide deeper than a depth in metres; None if a pair is unknown."""
        if any(p.penetration is None for p in self.pairs):
            return None
        return sum(p.penetration is not None and p.penetration > depth for p in self.pairs) / max(1, self.num_pairs)

    def card(self) -> MetricCard:
        """The metric card of the scene. Counts that need the scene graph are None, see :func:`stable_data.metrics.card.add_counts`."""
        depths = [p.penetration for p in self.pairs if p.penetration is not None]
        unknown = len(self.pairs) - len(depths)
        collisions = sum(d > self.tolerance for d in depths)
        sunk = max((o.table_penetration for o in self.objects), default=0.0)
        floats = [o.floats for o in self.objects]
        outside = [o.is_outside for o in self.objects]
        gaps = [o.gap for o in self.objects]
        num_without_mesh = sum(not o.has_mesh for o in self.objects)
        count = max(1, self.num_judged)
        fails = collisions > 0 or any(floats) or sunk > self.tolerance + ROUNDING or any(outside)
        # Only an exact mesh can be found clean.
        is_uncertain = num_without_mesh > 0 or unknown > 0 or None in floats
        return MetricCard(
            num_objects=self.num_judged,
            num_stacked=None,
            num_contained=None,
            num_tilted=self.num_tilted,
            num_without_mesh=num_without_mesh,
            num_unknown_pairs=unknown,
            num_collisions=collisions,
            oc=self.share_deeper(self.tolerance),
            oc_0mm=self.share_deeper(0.0),
            oc_1mm=self.share_deeper(1e-3),
            oc_10mm=self.share_deeper(1e-2),
            float_gap=None if None in gaps else sum(g is not None and g > TOLERANCE + ROUNDING for g in gaps) / count,
            max_penetration_mm=None if unknown else 1e3 * max(depths, default=0.0),
            table_penetration_mm=1e3 * sunk,
            float_rate=None if None in floats else sum(map(bool, floats)) / count,
            max_gap_mm=None if None in gaps else 1e3 * max((g for g in gaps if g is not None), default=0.0),
            out_of_bounds_rate=None if None in outside else sum(map(bool, outside)) / count,
            clean=False if fails else None if is_uncertain else True,
        )

    def rows(self) -> dict[str, list[dict[str, Any]]]:
        """The columns ``pairs`` and ``verdicts`` of the table ``scenes``; fixed objects have no verdict."""
        pairs = [(p.first, p.second, None if p.penetration is None else 1e3 * p.penetration) for p in self.pairs]
        return {
            "pairs": [dict(zip(("first", "second", "penetration_mm"), pair, strict=True)) for pair in pairs],
            "verdicts": [
                {
                    "instance": o.instance,
                    "floats": o.floats,
                    "supports": o.supports,
                    "gap_mm": None if o.gap is None else 1e3 * o.gap,
                    "table_penetration_mm": 1e3 * o.table_penetration,
                    "leaves_table": o.leaves_table,
                    "enters_restricted_zone": o.enters_restricted_zone,
                    "has_mesh": o.has_mesh,
                }
                for o in self.objects
                if o.instance not in self.fixed
            ],
        }


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
    num_tilted = sum(o.tilt_angle > math.radians(5) for o in posed.scene.objects if o.instance not in posed.scene.fixed)
    return Audit(posed.scene.scene_id, tuple(pairs), objects, num_tilted, tolerance, posed.budget.is_spent, fixed)


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
