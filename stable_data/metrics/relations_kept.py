"""Counts which relations of a scene still hold after a correction: columns of the metric card beside movement."""

from collections.abc import Callable, Sequence, Set
from dataclasses import dataclass, replace
from typing import TypeAlias

import numpy as np

from stable_data.geometry.shape import Shape
from stable_data.metrics.audit import PosedScene
from stable_data.metrics.verdicts import ROUNDING, TOLERANCE, Audit
from stable_data.scene import TABLE, Relation, RelationKind, Scene
from stable_data.scene_graph.relations import direction_of, is_held, relations_of, scene_graph

_ON_IN = frozenset({RelationKind.ON, RelationKind.IN})
DepthTest: TypeAlias = Callable[[str, str], bool]
"""Whether two objects penetrate deeper than the tolerance. False if the depth is unknown, as for boxes without a mesh."""

DIRECTIONAL = frozenset({RelationKind.LEFT_OF, RelationKind.RIGHT_OF, RelationKind.IN_FRONT_OF, RelationKind.BEHIND})
"""Relations of two objects beside each other; they hold within 45 degrees of their direction."""


@dataclass(frozen=True, slots=True)
class RelationsKept:
    """Counts of relations before and after a correction, without those of dropped objects.

    An object that penetrates another one deeper than the tolerance is not on or in it: a correction could not preserve that.

    Attributes:
        on_in_held: Number of ``on`` and ``in`` relations to another object that held before.
        on_in_kept: Number of these that still hold, directly or through the objects between. An object that was on another one
            may now be in it.
        directional_held: Number of ``left of``, ``right of``, ``in front of`` and ``behind`` relations that held before.
        directional_kept: Number of these that still hold.
        asked_broken: Number of ``on`` and ``in`` relations of the scene's own ``relations`` that did not hold before.
        asked_restored: Number of these that hold now, by the rule of ``on_in_kept``.
        asked_missing: The scene's own relations of all these kinds that do not hold now, whether they held before or not.
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
        """The card's ``relations_kept_on_in``; None if none held."""
        return self.on_in_kept / self.on_in_held if self.on_in_held else None

    @property
    def directional_share(self) -> float | None:
        """The card's ``relations_kept_directional``; None if none held."""
        return self.directional_kept / self.directional_held if self.directional_held else None


def relations_kept(
    before: Scene,
    after: Scene,
    shapes: Sequence[Shape],
    shapes_after: Sequence[Shape] | None = None,
    *,
    audits: tuple[Audit | None, Audit | None] = (None, None),
    known: Sequence[tuple[Scene, Audit]] = (),
) -> RelationsKept:
    """Compares the scene graphs of a scene before and after a correction.

    A directional relation holds while its subject is within 45 degrees of that direction, seen from its target. Another object
    that has come nearer does not break it.

    Args:
        before: The scene before; its own ``relations`` are the requested ones.
        after: The same scene without the dropped objects, moved.
        shapes: The geometry of the objects of ``before``, in its order.
        shapes_after: The geometry of the objects of ``after``, in its order, if it differs: an object that tips over has
            another tilt.
        audits: The audits of both scenes, if they are known: contacts are then not computed again.
        known: Audited scenes with some of the objects of ``before`` or ``after``, with the same geometry: where a scene has no audit,
            the contacts of objects that are at the same poses are taken from these.
    """
    present = {o.instance for o in after.objects}
    shape = {o.instance: s for o, s in zip(before.objects, shapes, strict=True)}
    kept = replace(before, objects=tuple(o for o in before.objects if o.instance in present))
    shapes_kept = [shape[o.instance] for o in kept.objects]
    shapes_after = shapes_after or [shape[o.instance] for o in after.objects]
    graphs = [_relations(kept, shapes_kept, audits[0], known), _relations(after, shapes_after, audits[1], known)]
    on_in_before, on_in_after = ({r for r in found if r.kind in _ON_IN and r.target != TABLE} for found in graphs)
    directional = [r for r in graphs[0] if r.kind in DIRECTIONAL]
    asked = [r for r in before.relations if {r.subject, r.target} <= present]
    broken = {r for r in asked if r.kind in _ON_IN} - on_in_before
    return RelationsKept(
        on_in_held=len(on_in_before),
        on_in_kept=sum(is_held(on_in_after, r) for r in on_in_before),
        directional_held=len(directional),
        directional_kept=sum(_holds(after, r) for r in directional),
        asked_broken=len(broken),
        asked_restored=sum(is_held(on_in_after, r) for r in broken),
        asked_missing=tuple(
            r
            for r in asked
            if (r.kind in _ON_IN and not is_held(on_in_after, r)) or (r.kind in DIRECTIONAL and not _holds(after, r))
        ),
    )


def _relations(
    scene: Scene, shapes: Sequence[Shape], audit: Audit | None, known: Sequence[tuple[Scene, Audit]]
) -> Set[Relation]:
    contacts, is_deep = _contacts(scene, shapes, known) if audit is None else _audited_contacts(audit, scene)
    footprints = {o.instance: s.posed_footprint(p) for o, s, p in zip(scene.objects, shapes, scene.poses(), strict=True)}
    found = relations_of(scene_graph(scene, contacts, footprints))
    return {r for r in found if r.kind not in _ON_IN or r.target == TABLE or not is_deep(r.subject, r.target)}


def _contacts(
    scene: Scene, shapes: Sequence[Shape], known: Sequence[tuple[Scene, Audit]]
) -> tuple[dict[str, tuple[str, ...]], DepthTest]:
    """The supports of each object, and a test for deep penetration."""
    posed = PosedScene(scene, shapes, TOLERANCE)  # how deep the deep ones are does not matter
    for judged in known:
        posed.reuse(*judged)
    number = {name: k for k, name in enumerate(posed.instances)}

    def is_deep(one: str, other: str) -> bool:
        i, j = sorted((number[one], number[other]))
        return (posed.penetration(i, j) or 0.0) > TOLERANCE + ROUNDING

    return {name: posed.supports(k, TOLERANCE) or () for k, name in enumerate(posed.instances)}, is_deep


def _audited_contacts(audit: Audit, scene: Scene) -> tuple[dict[str, tuple[str, ...]], DepthTest]:
    """The result of :func:`_contacts`, read from an audit, for the objects that are present."""
    present = {o.instance for o in scene.objects}
    deep = {frozenset((p.first, p.second)) for p in audit.pairs if (p.penetration or 0.0) > TOLERANCE + ROUNDING}
    contacts = {
        o.instance: tuple(s for s in o.supports if s in present or s == TABLE) for o in audit.objects if o.instance in present
    }
    return contacts, lambda one, other: frozenset((one, other)) in deep


def _holds(scene: Scene, relation: Relation) -> bool:
    dx, dy, _ = np.subtract(scene[relation.subject].position, scene[relation.target].position)
    return direction_of(dx, dy) is relation.kind
