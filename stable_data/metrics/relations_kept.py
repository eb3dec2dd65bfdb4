"""Which relations of a scene a correction has kept: columns of the metric card beside movement."""

from collections.abc import Callable, Sequence, Set
from dataclasses import dataclass, replace
from typing import TypeAlias

import numpy as np

from stable_data.geometry.shape import Shape
from stable_data.metrics.audit import Audit, PosedScene
from stable_data.metrics.collision import ROUNDING, TOLERANCE
from stable_data.scene import TABLE, Relation, RelationKind, Scene
from stable_data.scene_graph.relations import direction_of, is_held, relations_of, scene_graph

_ON_IN = frozenset({RelationKind.ON, RelationKind.IN})
Stuck: TypeAlias = Callable[[str, str], bool]
"""Is one of two objects deeper in the other than the audit lets pass? Of boxes that stand in nobody can say."""

DIRECTIONAL = frozenset({RelationKind.LEFT_OF, RelationKind.RIGHT_OF, RelationKind.IN_FRONT_OF, RelationKind.BEHIND})
"""Relations of two things beside each other, that hold within 45 degrees of their direction."""


@dataclass(frozen=True, slots=True)
class RelationsKept:
    """Counts of relations before and after a correction. Those of objects that were dropped are left out.

    What is stuck in a thing, deeper than the audit lets pass, is not on or in it: nothing could keep it there.

    Attributes:
        on_in_held: ``on`` and ``in`` another object: how many held before.
        on_in_kept: How many of these still hold, directly or through what lies in between; what was on a thing may now be in
            it.
        directional_held: ``left of``, ``right of``, ``in front of``, ``behind``: how many held before.
        directional_kept: How many of these still hold.
        asked_broken: ``on`` and ``in`` of the scene's own relations that did not hold before.
        asked_restored: How many of these hold now, likewise.
        asked_missing: Of the scene's own relations, of all the kinds above, those that do not hold now, whether they did
            before or not.
    """

    on_in_held: int
    on_in_kept: int
    directional_held: int
    directional_kept: int
    asked_broken: int
    asked_restored: int
    asked_missing: tuple[Relation, ...]

    @property
    def on_in_share(self) -> float | None:
        """The card's ``relations_kept_on_in``; None where none held."""
        return self.on_in_kept / self.on_in_held if self.on_in_held else None

    @property
    def directional_share(self) -> float | None:
        """The card's ``relations_kept_directional``; None where none held."""
        return self.directional_kept / self.directional_held if self.directional_held else None


def relations_kept(
    before: Scene,
    after: Scene,
    shapes: Sequence[Shape],
    shapes_after: Sequence[Shape] | None = None,
    *,
    audits: tuple[Audit | None, Audit | None] = (None, None),
) -> RelationsKept:
    """Compares the scene graphs of a scene before and after.

    A directional relation holds while its subject is within 45 degrees of that direction, seen from its target; that another
    object has come nearer does not break it.

    Args:
        before: The scene as it was; its ``relations`` are what is asked for.
        after: The same without the objects that were dropped, moved.
        shapes: The geometry of the objects of ``before``, in its order.
        shapes_after: That of the objects of ``after``, in its order, where it is another one: what tips over has another tilt.
        audits: The audits of both, where they are known: what touches what is then not looked at again.

    Returns:
        The counts.
    """
    there = {o.instance for o in after.objects}
    shape = {o.instance: s for o, s in zip(before.objects, shapes, strict=True)}
    kept = replace(before, objects=tuple(o for o in before.objects if o.instance in there))
    own = [shape[o.instance] for o in kept.objects]
    later = shapes_after or [shape[o.instance] for o in after.objects]
    graphs = [_relations(kept, own, audits[0]), _relations(after, later, audits[1])]
    on_in_before, on_in_after = ({r for r in found if r.kind in _ON_IN and r.target != TABLE} for found in graphs)
    directional = [r for r in graphs[0] if r.kind in DIRECTIONAL]
    asked = {r for r in before.relations if r.kind in _ON_IN and {r.subject, r.target} <= there}
    broken = asked - on_in_before
    turned = {r for r in before.relations if r.kind in DIRECTIONAL and {r.subject, r.target} <= there and not _holds(after, r)}
    return RelationsKept(
        on_in_held=len(on_in_before),
        on_in_kept=sum(is_held(on_in_after, r) for r in on_in_before),
        directional_held=len(directional),
        directional_kept=sum(_holds(after, r) for r in directional),
        asked_broken=len(broken),
        asked_restored=sum(is_held(on_in_after, r) for r in broken),
        asked_missing=tuple(r for r in before.relations if (r in asked and not is_held(on_in_after, r)) or r in turned),
    )


def _relations(scene: Scene, shapes: Sequence[Shape], audit: Audit | None) -> Set[Relation]:
    contacts, stuck = _touching(scene, shapes) if audit is None else _touching_by(audit, {o.instance for o in scene.objects})
    footprints = {o.instance: s.posed_footprint(p) for o, s, p in zip(scene.objects, shapes, scene.poses(), strict=True)}
    found = relations_of(scene_graph(scene, contacts, footprints))
    return {r for r in found if r.kind not in _ON_IN or r.target == TABLE or not stuck(r.subject, r.target)}


def _touching(scene: Scene, shapes: Sequence[Shape]) -> tuple[dict[str, tuple[str, ...]], Stuck]:
    """What carries each object, and what is stuck."""
    posed = PosedScene(scene, shapes)
    number = {name: k for k, name in enumerate(posed.instances)}

    def stuck(one: str, other: str) -> bool:
        i, j = sorted((number[one], number[other]))
        return (posed.penetration(i, j) or 0.0) > TOLERANCE + ROUNDING

    return {name: posed.supports(k, TOLERANCE) or () for k, name in enumerate(posed.instances)}, stuck


def _touching_by(audit: Audit, there: Set[str]) -> tuple[dict[str, tuple[str, ...]], Stuck]:
    """The same as an audit has it, of the objects that are there."""
    deep = {frozenset((p.first, p.second)) for p in audit.pairs if (p.penetration or 0.0) > TOLERANCE + ROUNDING}
    carried = {
        o.instance: tuple(s for s in o.supports if s in there or s == TABLE) for o in audit.objects if o.instance in there
    }
    return carried, lambda one, other: frozenset((one, other)) in deep


def _holds(scene: Scene, relation: Relation) -> bool:
    dx, dy, _ = np.subtract(scene[relation.subject].position, scene[relation.target].position)
    return direction_of(dx, dy) is relation.kind
