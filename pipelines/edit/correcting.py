"""The correction of an edited scene: what the edit asks for shall hold, and the other objects stay where they can."""

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

from models.physics_corrector.certify.correction import Correction, CorrectionOptions, Fixed
from models.physics_corrector.corrector import PhysicsCorrector
from models.semantic_reasoner.editing import EditResult
from pipelines.edit.settings import EditSettings
from pipelines.edit.tilts import standing_on_end
from stable_data.assets.store import AssetStore
from stable_data.metrics.verdicts import ROUNDING, Audit
from stable_data.scene import Relation, RelationKind, Scene, SceneObject
from stable_data.scene_graph.relations import cell_of
from stable_data.scene_graph.support_tree import SupportTree

_ON_IN = frozenset({RelationKind.ON, RelationKind.IN})
_QUARTER = math.pi / 2
_SMALLER = (0.8, 0.6)
"""Factors of the size of new objects that find no place: the sizes of most kinds of things differ so much."""


@dataclass(frozen=True, slots=True)
class _Form:
    """A change of the objects of which an edit asks something, so that they fit.

    Attributes:
        size: Factor of the size of new ones.
        turns: Quarter turns from straight of those that stand on the table; None: they keep their yaw.
        is_on_end: Whether those that shall be in another object stand on end.
    """

    size: float = 1.0
    turns: int | None = None
    is_on_end: bool = False


@dataclass(frozen=True, slots=True)
class _Attempt:
    """One correction of an edited scene.

    Attributes:
        fixed: Objects that do not move.
        form: How the objects differ of which the edit asks something.
        is_asked: Whether the directions and cells that the edit asks for are constraints.
        flows: Whether the learned flow moves the objects first.
    """

    fixed: Fixed
    form: _Form = _Form()
    is_asked: bool = True
    flows: bool = False


@dataclass(frozen=True, slots=True)
class EditCorrector:
    """Corrects edited scenes.

    Attributes:
        settings: The settings of the job.
        corrector: The Physics Corrector.
        store: The geometry of the assets.
    """

    settings: EditSettings
    corrector: PhysicsCorrector
    store: AssetStore

    def correct(self, scene: Scene, audit: Audit, edited: EditResult, untouched: Fixed) -> Correction:
        """Corrects a scene, in attempts that move more and more objects.

        Args:
            scene: The edited scene with its assets.
            audit: Its exact audit.
            edited: What the edit changes.
            untouched: Instances that the edit does not change.

        Returns:
            The first correction without fault; if there is none, the one with the fewest dropped objects and missed relations.
        """
        best: Correction | None = None
        for attempt in dict.fromkeys(self._attempts(scene, audit, edited, untouched)):
            formed = self._formed(scene, edited, attempt.form)
            if formed is scene and attempt.form != _Form():
                continue
            tried = self._tried(attempt, formed, audit if formed is scene else None, edited, untouched)
            if best is None or _faults(tried, edited.wanted) < _faults(best, edited.wanted):
                best = tried
            if not any(_faults(best, edited.wanted)):
                break
        assert best is not None  # there is always an attempt
        return best

    def _attempts(self, scene: Scene, audit: Audit, edited: EditResult, untouched: Fixed) -> Iterator[_Attempt]:
        always, others = self.settings.fixed_in(scene), self.settings.others
        if others != "free":
            moving = frozenset[str]() if others == "fixed" else _at_fault(scene, audit, untouched)
            for form in _forms(edited):
                yield _Attempt(always | (untouched - moving), form)
        if others == "fixed_first":
            yield _Attempt(always | (untouched - _at_fault(scene, audit)))
        if others != "fixed":
            yield _Attempt(always)
            yield _Attempt(always, flows=True)
        if any(r.kind not in _ON_IN for r in edited.wanted):  # is it for their sake that it fails?
            yield _Attempt(always | untouched if others == "fixed" else always, is_asked=False)

    def _tried(self, attempt: _Attempt, scene: Scene, audit: Audit | None, edited: EditResult, untouched: Fixed) -> Correction:
        corrector = self.corrector if attempt.flows else replace(self.corrector, flow=None)
        asked = frozenset(edited.wanted if attempt.is_asked else ())
        options = CorrectionOptions(attempt.fixed, asked=asked, still=untouched)
        return corrector.correct([scene], self.store, options, None if audit is None else [audit])[0]

    def _formed(self, scene: Scene, edited: EditResult, form: _Form) -> Scene:
        """The scene with another form of the objects that carry nothing and of which the edit asks something."""
        carriers = {o.support for o in scene.objects}
        asked = {r.subject: r.kind for r in edited.wanted if r.subject not in carriers}
        objects = tuple(self._in_form(o, asked[o.instance], edited, form) if o.instance in asked else o for o in scene.objects)
        return scene if objects == scene.objects else replace(scene, objects=objects)

    def _in_form(self, o: SceneObject, kind: RelationKind, edited: EditResult, form: _Form) -> SceneObject:
        if form.turns is not None and kind not in _ON_IN:
            return replace(o, yaw=math.remainder((round(o.yaw / _QUARTER) + form.turns) * _QUARTER, math.tau))
        if form.is_on_end and kind is RelationKind.IN:
            return standing_on_end(o, self.store)
        return _scaled(o, form.size) if form.size != 1.0 and o.instance in edited.added else o


def _forms(edited: EditResult) -> Iterator[_Form]:
    """The forms in which objects may fit, the usual one first."""
    yield _Form()
    kinds = {r.kind for r in edited.wanted}
    if kinds - _ON_IN:
        yield from (_Form(turns=turns) for turns in (0, 1))
    if RelationKind.IN in kinds:
        yield _Form(is_on_end=True)
    if any(r.subject in edited.added for r in edited.wanted):
        yield from (_Form(size) for size in _SMALLER)


def missed_relations(wanted: Sequence[Relation], done: Correction) -> list[Relation]:
    """The wanted relations that do not hold in a corrected scene."""
    assert done.certified is not None
    assert done.kept is not None
    size = done.certified.table.size_xy
    cells = {Relation(o.instance, RelationKind.IS_AT, cell_of(o.position, size)) for o in done.certified.objects}
    return [r for r in wanted if r in done.kept.asked_missing or (r.kind is RelationKind.IS_AT and r not in cells)]


def _faults(done: Correction, wanted: Sequence[Relation]) -> tuple[bool, int, int]:
    """Whether there is no clean layout, and the numbers of dropped objects and of missed relations."""
    missed = 0 if done.certified is None else len(missed_relations(wanted, done))
    return done.certified is None, len(done.dropped), missed


def _scaled(o: SceneObject, factor: float) -> SceneObject:
    """An object of another size on the same place."""
    (x, y, _), (w, d, h) = o.position, o.size
    scale = None if o.scale is None else (factor * o.scale[0], factor * o.scale[1], factor * o.scale[2])
    height = o.bottom + factor * h / 2
    return replace(o, position=(x, y, height), size=(factor * w, factor * d, factor * h), scale=scale)


def _at_fault(scene: Scene, audit: Audit, among: Fixed | None = None) -> Fixed:
    """The objects that keep a scene from being clean, with all objects on them.

    Args:
        scene: The scene.
        audit: Its audit.
        among: The objects whose own faults are meant, and those between two of them; None: all.
    """
    deep = audit.tolerance + ROUNDING
    names = frozenset(o.instance for o in scene.objects) if among is None else among
    found = {
        o.instance for o in audit.objects if o.floats is not False or o.is_outside is not False or o.table_penetration > deep
    }
    for pair in audit.pairs:
        if (pair.penetration is None or pair.penetration > audit.tolerance) and {pair.first, pair.second} <= names:
            found |= {pair.first, pair.second}
    return frozenset(SupportTree.of(scene.objects).with_descendants(found & names))
