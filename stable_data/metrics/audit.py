"""The audit of a scene: every verdict on collision, support and bounds, pair by pair and object by object.

Definitions are those of docs/audit.md, against the scaled, tilted triangle meshes. An object whose mesh is missing is a
box: what its box rules out is known (boxes that do not meet do not collide), the rest is unknown and never a pass. So is what
is left when a scene's budget of work is used up. Objects of the same triangles in the same place are judged once.
"""

import hashlib
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
from stable_data.metrics.bounds import enters_zone, leaves_table
from stable_data.metrics.card import MetricCard
from stable_data.metrics.collision import NEAR, ROUNDING, TOLERANCE, penetration
from stable_data.metrics.support import carries, distance_to_surface
from stable_data.metrics.triangle_intersection import MeshPair, PosedTriangles, WorkBudget, WorkLimitError
from stable_data.scene import TABLE, FloatArray, Scene

BOUNDS_SLACK = 1e-3
"""How far a footprint may reach over an edge, metres: the format's own rounding."""

MAX_WORK = 300_000_000
"""What a scene's exact tests may cost, in triangles that they look at: some 25 s; the fullest tables take 40 million."""

_GAP_WORK = 4  # triangles that are tested in the time of one whose distance is asked
_MAX_KEPT = 2_000_000  # triangles of pairs that are kept for the next question
_GAP_RANGE = 0.1  # supports farther than this are not looked for by the paper's gap, metres


@dataclass(frozen=True, slots=True)
class PairVerdict:
    """How deep two objects are in each other.

    Attributes:
        first: Instance.
        second: Instance.
        penetration: Metres; None where the boxes meet and a mesh is missing or the audit was cut short.
    """

    first: str
    second: str
    penetration: float | None


@dataclass(frozen=True, slots=True)
class ObjectVerdict:
    """How one object stands.

    Attributes:
        instance: Its name.
        floats: Lowered by the tolerance it meets nothing that carries, or only what it carries itself; None where a missing
            mesh, or an audit that was cut short, leaves it open.
        supports: What it meets then: instances, or ``table``.
        gap: The paper's smallest distance of the bottom region to a support, metres; None where unknown.
        table_penetration: How far it reaches below the table top, metres.
        leaves_table: Its footprint reaches over the edge; None where only the box of a missing mesh does.
        enters_restricted_zone: Its footprint reaches into the restricted zone; None likewise.
        has_mesh: Whether its mesh was there.
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
        objects: One verdict an object, in the scene's order.
        num_tilted: Objects tilted by more than 5 degrees.
        tolerance: What floating and the card's headline were judged at, metres.
        is_cut_short: Whether the scene's budget of work was used up, so that verdicts are unknown.
    """

    scene_id: str
    pairs: tuple[PairVerdict, ...]
    objects: tuple[ObjectVerdict, ...]
    num_tilted: int
    tolerance: float = TOLERANCE
    is_cut_short: bool = False

    @property
    def notices(self) -> tuple[Notice, ...]:
        """What about the audit itself deserves a look."""
        if not self.is_cut_short:
            return ()
        unknown = sum(p.penetration is None for p in self.pairs)
        message = (
            f"{self.scene_id}: work limit reached with {unknown} pairs of objects unknown, expected at most {MAX_WORK} triangles "
            "to test; separate the objects that overlap, or use simpler meshes"
        )
        return (Notice(self.scene_id, "audit", "audit_cut_short", message),)

    def share_deeper(self, depth: float) -> float | None:
        """Pairs that collide deeper than a depth in metres, as a share of all; None where a pair is unknown."""
        if any(p.penetration is None for p in self.pairs):
            return None
        count = len(self.objects)
        return sum(p.penetration is not None and p.penetration > depth for p in self.pairs) / max(1, count * (count - 1) // 2)

    def card(self, num_stacked: int | None = None, num_contained: int | None = None) -> MetricCard:
        """The figures of the scene.

        Args:
            num_stacked: Objects on another one, where the scene graph is known.
            num_contained: Objects in another one, likewise.
        """
        depths = [p.penetration for p in self.pairs if p.penetration is not None]
        unknown = len(self.pairs) - len(depths)
        collisions = sum(d > self.tolerance for d in depths)
        sunk = max((o.table_penetration for o in self.objects), default=0.0)
        floats = [o.floats for o in self.objects]
        outside = [o.is_outside for o in self.objects]
        gaps = [o.gap for o in self.objects]
        num_without_mesh = sum(not o.has_mesh for o in self.objects)
        count = max(1, len(self.objects))
        fails = collisions > 0 or any(floats) or sunk > self.tolerance + ROUNDING or any(outside)
        # Without an exact mesh nothing is clean: that is what the verdicts are against.
        is_open = num_without_mesh > 0 or unknown > 0 or None in floats
        return MetricCard(
            num_objects=len(self.objects),
            num_stacked=num_stacked,
            num_contained=num_contained,
            num_tilted=self.num_tilted,
            num_without_mesh=num_without_mesh,
            num_unknown_pairs=unknown,
            num_collisions=collisions,
            oc=self.share_deeper(self.tolerance),
            oc_0mm=self.share_deeper(0.0),
            oc_1mm=self.share_deeper(1e-3),
            oc_10mm=self.share_deeper(1e-2),
            max_penetration_mm=None if unknown else 1e3 * max(depths, default=0.0),
            table_penetration_mm=1e3 * sunk,
            float_rate=None if None in floats else sum(map(bool, floats)) / count,
            max_gap_mm=None if None in gaps else 1e3 * max((g for g in gaps if g is not None), default=0.0),
            out_of_bounds_rate=None if None in outside else sum(map(bool, outside)) / count,
            clean=False if fails else None if is_open else True,
        )

    def rows(self) -> dict[str, list[dict[str, Any]]]:
        """Columns ``pairs`` and ``verdicts`` of the table ``scenes``."""
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
            ],
        }


class PosedScene:
    """A scene's meshes where they stand, with their boxes.

    Args:
        scene: The scene.
        shapes: The geometry of each object, in the scene's order.
    """

    def __init__(self, scene: Scene, shapes: Sequence[Shape]) -> None:
        self.scene, self.shapes = scene, shapes
        self.instances = [o.instance for o in scene.objects]
        self.vertices = [shape.posed(pose) for shape, pose in zip(shapes, scene.poses(), strict=True)]
        # Column by column: reducing along the long axis of (V, 3) is slow.
        self.low = np.array([[v[:, axis].min() for axis in range(3)] for v in self.vertices]).reshape(-1, 3)
        self.high = np.array([[v[:, axis].max() for axis in range(3)] for v in self.vertices]).reshape(-1, 3)
        self.budget = WorkBudget(MAX_WORK)
        self._surfaces: dict[int, PosedTriangles] = {}
        self._pairs: dict[tuple[int, int], MeshPair] = {}
        self._num_kept = 0
        self._depths: dict[tuple[int, int], float | None] = {}
        self._carries: dict[tuple[int, int, float], bool] = {}
        self._gaps: dict[int, float | None] = {}
        self._bottoms: dict[int, FloatArray] = {}

    @cached_property
    def first_alike(self) -> list[int]:
        """For each object the first one of the same triangles in the same place: itself, unless objects coincide."""
        boxes = [low.tobytes() + high.tobytes() for low, high in zip(self.low, self.high, strict=True)]
        count, first = Counter(boxes), dict[bytes, int]()
        return [k if count[box] == 1 else first.setdefault(self._content(k), k) for k, box in enumerate(boxes)]

    def _content(self, index: int) -> bytes:
        return hashlib.sha256(self.vertices[index].tobytes() + self.shapes[index].faces.tobytes()).digest()

    def surface(self, index: int) -> PosedTriangles:
        """Triangles of one object with their boxes, metres, world frame."""
        index = self.first_alike[index]
        if index not in self._surfaces:
            self._surfaces[index] = PosedTriangles(self.vertices[index][self.shapes[index].faces])
        return self._surfaces[index]

    def triangles(self, index: int) -> FloatArray:
        """Triangles of one object, (F, 3, 3) float64, metres, world frame."""
        return self.surface(index).triangles

    def pair(self, first: int, second: int, margin: float) -> MeshPair:
        """Two objects of the scene, first <= second, that may be moved by a margin; kept for a while where that is NEAR.

        Raises:
            WorkLimitError: The scene's budget is used up.
        """
        one, other = self.surface(first), self.surface(second)
        if margin > NEAR:
            return MeshPair(one, other, margin, self.budget)
        if (first, second) not in self._pairs:
            self._pairs[first, second] = pair = MeshPair(one, other, NEAR, self.budget)
            self._num_kept += pair.num_triangles
            while self._num_kept > _MAX_KEPT and len(self._pairs) > 1:
                self._num_kept -= self._pairs.pop(next(iter(self._pairs))).num_triangles
        return self._pairs[first, second]

    def penetration(self, first: int, second: int) -> float | None:
        """How deep two objects are in each other, metres; None where that is unknown."""
        if not (self.shapes[first].is_exact and self.shapes[second].is_exact):
            return None
        one, other = self.first_alike[first], self.first_alike[second]
        i, j = min(one, other), max(one, other)
        if (i, j) not in self._depths:
            try:
                self._depths[i, j] = penetration(self.surface(i), self.surface(j), self.pair(i, j, NEAR))
            except WorkLimitError:
                self._depths[i, j] = None
        return self._depths[i, j]

    @cached_property
    def meeting_boxes(self) -> list[tuple[int, int]]:
        """Pairs of objects whose axis-aligned boxes meet."""
        apart = (self.low[:, None] > self.high[None]).any(axis=2)
        apart |= apart.T
        first, second = np.nonzero(np.triu(~apart, 1))
        return list(zip(first.tolist(), second.tolist(), strict=True))

    def below(self, index: int, gap: float) -> Iterator[int]:
        """Objects whose boxes the object's box meets when lowered by up to a gap, metres."""
        lowered = self.low[index] - (0, 0, gap)
        meets = (lowered <= self.high).all(axis=1) & (self.high[index] >= self.low).all(axis=1)
        return (int(j) for j in np.nonzero(meets)[0] if j != index)

    def stands_on_table(self, index: int, gap: float) -> bool:
        """Does the object reach the table top when lowered by a gap, metres?"""
        over = (self.low[index, :2] < self.scene.table.size_xy).all() and (self.high[index, :2] > 0).all()
        return bool(over and self.low[index, 2] <= gap + ROUNDING)

    def nears_zone(self, index: int) -> bool:
        """Does the object's axis-aligned box meet the restricted zone?"""
        zone = self.scene.table.restricted_zone
        if zone is None:
            return False
        low, high = self.low[index], self.high[index]
        return bool(low[0] < zone[1] and high[0] > zone[0] and low[1] < zone[3] and high[1] > zone[2])

    def supports(self, index: int, gap: float) -> tuple[str, ...] | None:
        """What carries an object when it is lowered by a gap.

        Args:
            index: The object.
            gap: Metres.

        Returns:
            Instances and ``table``; None where nothing known carries it and something unknown might.
        """
        found, is_open = self._supports(index, gap)
        return None if is_open and not found else found

    def _supports(self, index: int, gap: float) -> tuple[tuple[str, ...], bool]:
        """What is known to carry an object, and whether what is unknown might besides."""
        found, is_open = [TABLE] if self.stands_on_table(index, gap) else [], False
        reach = gap + ROUNDING
        for other in self.below(index, reach):
            if not (self.shapes[index].is_exact and self.shapes[other].is_exact):
                is_open = True
                continue
            try:
                if self._is_carried(self.first_alike[index], self.first_alike[other], reach):
                    found.append(self.instances[other])
            except WorkLimitError:
                is_open = True
        return tuple(found), is_open

    def _is_carried(self, upper: int, lower: int, reach: float) -> bool:
        key = upper, lower, reach
        if key not in self._carries:
            pair = self.pair(min(upper, lower), max(upper, lower), reach)
            self._carries[key] = carries(pair, reach, upper_is_first=upper <= lower)
        return self._carries[key]

    def gap(self, index: int) -> float | None:
        """The paper's distance of the bottom region to the nearest support (L_sup, delta), metres; None where unknown."""
        same = self.first_alike[index]  # it has the same neighbours, but for the name
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
                return max(0.0, lowest)  # the region is higher than that, so it meets the table top where it reaches below
            best = min(best, lowest) if lowest > 0 else float(min(best, np.abs(self._bottom(index)[:, 2]).min()))
        others = list(self.below(index, best))
        if others and not all(self.shapes[k].is_exact for k in (index, *others)):
            return None
        for other in dict.fromkeys(self.first_alike[k] for k in others):
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
        tolerance: Depth, gap and sinking that are let pass, metres.

    Returns:
        Every verdict.
    """
    return audit_posed_scene(PosedScene(scene, shapes), tolerance)


def audit_posed_scene(posed: PosedScene, tolerance: float = TOLERANCE) -> Audit:
    """Judges a scene whose meshes are posed already; see :func:`audit_scene`."""
    pairs = []
    for i, j in posed.meeting_boxes:
        depth = posed.penetration(i, j)
        if depth != 0.0:
            pairs.append(PairVerdict(posed.instances[i], posed.instances[j], depth))
    judged = [_judge_object(posed, index, tolerance) for index in range(len(posed.instances))]
    objects = _without_circles(tuple(o for o, _ in judged), {o.instance for o, is_open in judged if is_open})
    num_tilted = sum(o.tilt_angle > math.radians(5) for o in posed.scene.objects)
    return Audit(posed.scene.scene_id, tuple(pairs), objects, num_tilted, tolerance, posed.budget.is_spent)


def _judge_object(posed: PosedScene, index: int, tolerance: float) -> tuple[ObjectVerdict, bool]:
    """The verdict on an object, and whether something unknown might carry it besides what does."""
    supports, is_open = posed._supports(index, tolerance)
    table, slack, is_exact = posed.scene.table, BOUNDS_SLACK + ROUNDING, posed.shapes[index].is_exact
    leaves = leaves_table(posed.low[index], posed.high[index], table, slack)
    enters = posed.nears_zone(index) and enters_zone(posed.triangles(index), table.restricted_zone, slack)
    verdict = ObjectVerdict(
        instance=posed.instances[index],
        floats=None if is_open and not supports else not supports,
        supports=supports,
        gap=posed.gap(index),
        table_penetration=max(0.0, -float(posed.low[index, 2])),
        leaves_table=leaves and (is_exact or None),
        enters_restricted_zone=enters and (is_exact or None),
        has_mesh=is_exact,
    )
    return verdict, is_open


def _without_circles(objects: tuple[ObjectVerdict, ...], is_open: Set[str] = frozenset()) -> tuple[ObjectVerdict, ...]:
    """Lets objects float that only carry each other: as one body, lowered, they meet nothing.

    Args:
        objects: The verdicts on them alone.
        is_open: Instances that something unknown might carry besides: whether a circle with one of them floats is unknown.
    """
    carriers: nx.DiGraph[str] = nx.DiGraph((o.instance, below) for o in objects for below in o.supports)
    hovering = {
        name: None if circle & is_open else True
        for circle in nx.strongly_connected_components(carriers)
        if len(circle) > 1 and all(below in circle for one in circle for below in carriers.successors(one))
        for name in circle
    }
    return tuple(replace(o, floats=hovering.get(o.instance, o.floats)) for o in objects)
