"""The verdicts of an audit, and what follows from them: the metric card, and the columns of the table ``scenes``.

:mod:`stable_data.metrics.audit` makes them from meshes. Nothing here needs a mesh, so that cards can be computed again from stored
verdicts.
"""

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from stable_data.errors import Notice
from stable_data.limits import LIMITS, at_most
from stable_data.metrics.card import MetricCard
from stable_data.scene import Scene

TOLERANCE = 5e-4
"""The headline tolerance of collision, table penetration and floating, metres."""

ROUNDING = 1e-9
"""Added to the limit in every comparison with a tolerance, metres. Layouts are written to half a millimetre, and a sum of such
lengths that equals the tolerance comes out a little above or below it."""


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


def audit_of_row(row: Mapping[str, Any], scene: Scene) -> Audit:
    """Returns the audit that a row of ``scenes`` states, by the tolerance of the card.

    Verdicts on fixed objects are not stored: each has no fault, and its mesh is taken to be there.

    Args:
        row: The row, with the columns of :meth:`Audit.rows`; one verdict for each movable object, in the scene's order.
        scene: The scene of the row.
    """
    pairs = (PairVerdict(p["first"], p["second"], _metres(p["penetration_mm"])) for p in row["pairs"])
    stored = {
        v["instance"]: ObjectVerdict(
            v["instance"],
            v["floats"],
            tuple(v["supports"]),
            _metres(v["gap_mm"]),
            v["table_penetration_mm"] / 1e3,
            v["leaves_table"],
            v["enters_restricted_zone"],
            v["has_mesh"],
        )
        for v in row["verdicts"]
    }
    objects = tuple(
        ObjectVerdict(o.instance, False, (), 0.0, 0.0, False, False, True) if o.instance in scene.fixed else stored[o.instance]
        for o in scene.objects
    )
    fixed = scene.fixed & {o.instance for o in scene.objects}
    return Audit(scene.scene_id, tuple(pairs), objects, num_tilted(scene), fixed=fixed)


def num_tilted(scene: Scene) -> int:
    """Returns the number of movable objects that are tilted by more than 5 degrees."""
    return sum(o.tilt_angle > math.radians(5) for o in scene.movable)


def _metres(millimetres: float | None) -> float | None:
    return None if millimetres is None else millimetres / 1e3
