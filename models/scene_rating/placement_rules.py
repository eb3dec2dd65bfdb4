"""The rules of the criterion "Placement Plausibility & Intersections": what the exact audit finds."""

from collections.abc import Iterator

from models.scene_rating.fault import Fault, listed, score_by, unknown
from models.scene_rating.rating_case import AuditedScene
from stable_data.metrics.verdicts import ROUNDING, Audit, ObjectVerdict
from stable_data.rating.rating import CriterionScore

_SLIGHT, _GRAVE = 0.1, 0.5  # severity of a fault that is just not accepted, and of one that everybody sees
_SEEN = 0.02  # depth or gap that everybody sees, metres
_OUTSIDE = 0.3  # severity of an object that is out of bounds


class PlacementRules:
    """Judges collisions, floating objects and bounds, by the exact audit (docs/audit.md)."""

    def __call__(self, case: AuditedScene) -> CriterionScore:
        """Returns the score; unknown if the audit leaves a verdict open, such as for an object without a mesh."""
        audit = case.audit
        if not audit.num_judged:
            return unknown("the scene has no objects")
        if open_ := list(_unknown_verdicts(audit)):
            return unknown(f"the audit leaves verdicts open: {listed(open_)}")
        faults = [*_collisions(audit), *(fault for verdict in audit.objects for fault in _faults_of(verdict, audit))]
        return score_by(faults, [f"{audit.num_judged} objects exactly"])


def _unknown_verdicts(audit: Audit) -> Iterator[str]:
    for pair in audit.pairs:
        if pair.penetration is None:
            yield f"{pair.first} and {pair.second}"
    for verdict in audit.objects:
        is_open = verdict.floats is None or verdict.is_outside is None or (verdict.floats and verdict.gap is None)
        if verdict.instance not in audit.fixed and (is_open or not verdict.has_mesh):
            yield verdict.instance


def _collisions(audit: Audit) -> Iterator[Fault]:
    for pair in audit.pairs:
        depth = pair.penetration
        if depth is not None and depth > audit.tolerance:
            yield Fault(_severity(depth), f"{pair.first} and {pair.second} overlap by {_length(depth)}")


def _faults_of(verdict: ObjectVerdict, audit: Audit) -> Iterator[Fault]:
    if verdict.instance in audit.fixed:
        return
    name = verdict.instance
    if verdict.floats and verdict.gap is not None:
        yield Fault(_severity(verdict.gap), f"{name} floats {_length(verdict.gap)} above its support")
    if verdict.table_penetration > audit.tolerance + ROUNDING:
        yield Fault(_severity(verdict.table_penetration), f"{name} is {_length(verdict.table_penetration)} in the table")
    if verdict.leaves_table:
        yield Fault(_OUTSIDE, f"{name} reaches over the edge")
    if verdict.enters_restricted_zone:
        yield Fault(_OUTSIDE, f"{name} is where nothing may stand")


def _severity(length: float) -> float:
    return _SLIGHT + (_GRAVE - _SLIGHT) * min(1.0, length / _SEEN)


def _length(metres: float) -> str:
    return "100 mm or more" if metres >= 0.1 else f"{1e3 * metres:.1f} mm"
