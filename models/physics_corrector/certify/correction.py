"""Requests and results of corrections."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from enum import StrEnum
from typing import TYPE_CHECKING, TypeAlias

from models.physics_corrector.certify import CertificationResult, CorrectionStatus, DroppedObject
from stable_data.assets.store import AssetStore
from stable_data.errors import Notice
from stable_data.geometry.shape import Shape
from stable_data.metrics.audit import audit_scene
from stable_data.metrics.card import MetricCard
from stable_data.metrics.movement import add_movement
from stable_data.metrics.relations_kept import RelationsKept, relations_kept
from stable_data.metrics.verdicts import Audit
from stable_data.scene import Relation, Scene

if TYPE_CHECKING:  # MuJoCo takes long to import
    from stable_data.simulation.settling import SettleResult

Fixed: TypeAlias = frozenset[str]
"""Instances of a scene that must not move."""


class SolvedBy(StrEnum):
    """The step that made a scene clean."""

    START = "start"
    """None: it was clean already."""

    FLOW = "flow"
    """The learned flow."""

    REFINE = "refine"
    """The batched refinement."""

    CERTIFY = "certify"
    """The certification."""

    POST_PROCESSING = "post_processing"
    """A post-hoc optimiser of another system, in place of all of these."""


@dataclass(frozen=True, slots=True)
class CorrectionOptions:
    """The permitted changes and the checks of the correction of one scene.

    Attributes:
        fixed: Instances that must not move, in addition to those that the options of the corrector fix.
        new: Instances that no correction has placed yet. If tilts may change, those that a relation of the scene puts on or in
            another object are first dropped there in a simulation.
        may_tilt: Whether tilts may change, as in generated scenes. Otherwise only positions and yaws change.
        asks_engine: Whether MuJoCo decides which objects stay at rest, and the others are repaired.
        asked: Relations that shall hold, see :class:`~models.physics_corrector.certify.options.CertifyOptions`.
        still: Instances that move as little as a clean layout allows, see the same.
    """

    fixed: Fixed = frozenset()
    new: frozenset[str] = frozenset()
    may_tilt: bool = False
    asks_engine: bool = False
    asked: frozenset[Relation] = frozenset()
    still: Fixed = frozenset()


@dataclass(frozen=True, slots=True, eq=False)
class CertificationRequest:
    """A scene after the flow, to be certified in this process or in another one.

    Attributes:
        scene: The scene, resolved (``AssetStore.resolved``).
        raw: The scene after the flow; None without a flow, or if its poses are not finite.
        options: The permitted changes.
        audit: The exact audit of ``scene``; None if it is not known.
        prepared: The layout with which certification starts, if it was prepared with others as a batch.
    """

    scene: Scene
    raw: Scene | None
    options: CorrectionOptions = CorrectionOptions()
    audit: Audit | None = None
    prepared: "PreparedLayout | None" = None


@dataclass(frozen=True, slots=True, eq=False)
class PreparedLayout:
    """A layout after the drop of its new objects and the refinement.

    Attributes:
        scene: The scene before the flow; if tilts may change, with its new objects dropped onto their carriers.
        raw: The scene after the flow, whose dropped objects have moved with their carriers; None without a flow.
        refined: The scene after the refinement; None without one.
        audit: The exact audit of ``refined``.
        is_solved: Whether the refinement has left nothing to certify.
    """

    scene: Scene
    raw: Scene | None = None
    refined: Scene | None = None
    audit: Audit | None = None
    is_solved: bool = False


@dataclass(frozen=True, slots=True, eq=False)
class KnownShapes:
    """Geometry that the caller has already, without assets: sufficient without MuJoCo and without changes of tilt.

    Attributes:
        shapes: Instance -> shape, the same in all scenes.
    """

    shapes: Mapping[str, Shape]

    def resolved(self, scene: Scene) -> tuple[Scene, list[Shape], tuple[Notice, ...]]:
        """Returns the unchanged scene and the geometry of its objects in order, like ``AssetStore.resolved``."""
        return scene, [self.shapes[o.instance] for o in scene.objects], ()


Assets: TypeAlias = AssetStore | KnownShapes
"""A source of the geometry of objects."""


@dataclass(frozen=True, slots=True, eq=False)
class Correction:
    """The result for one scene.

    Attributes:
        status: The outcome.
        reason: Why the scene is not certified; empty if it is.
        start: The scene before the correction.
        raw: The scene after the flow, before certification; None without a flow, or if its poses are not finite.
        certified: The corrected scene, which is clean unless the status is ``unclean`` or ``unknown``; None if infeasible.
        dropped: Objects for which no place was found.
        card_before: Metric card of the start; None if it could not be judged.
        card_raw: Metric card of the raw scene; None without a flow, or if it was not requested.
        card_after: Metric card of the corrected scene, with its movement and its preserved relations; None if infeasible.
        audit_before: The exact audit of the start; None if it could not be judged.
        audit: The exact audit of the corrected scene; None if infeasible.
        kept: Counts of the relations of the start that still hold; None if infeasible.
        rest: MuJoCo's verdict on ``certified``; None if there was no simulation.
        engine_fault: Why the simulation failed; empty if it did not, or was not requested.
        solved_by: The step that made the scene clean; None if it is not.
        unsolved: Why a post-hoc optimiser has not reached its own goal; empty if it has, or if none corrected the scene.
    """

    status: CorrectionStatus
    reason: str
    start: Scene
    raw: Scene | None = None
    certified: Scene | None = None
    dropped: tuple[DroppedObject, ...] = ()
    card_before: MetricCard | None = None
    card_raw: MetricCard | None = None
    card_after: MetricCard | None = None
    audit_before: Audit | None = None
    audit: Audit | None = None
    kept: RelationsKept | None = None
    rest: "SettleResult | None" = None
    engine_fault: str = ""
    solved_by: SolvedBy | None = None
    unsolved: str = ""


@dataclass(frozen=True, slots=True, eq=False)
class InputScene:
    """A scene before its correction: the reference for movement and relations.

    Attributes:
        scene: The scene, resolved.
        shapes: The geometry of its objects, in order.
        audit: Its exact audit.
    """

    scene: Scene
    shapes: Sequence[Shape]
    audit: Audit

    @classmethod
    def of(cls, scene: Scene, assets: Assets, audit: Audit | None = None) -> "InputScene":
        """Resolves a scene, and audits it if no audit is given.

        Args:
            scene: The scene.
            assets: Geometry of its objects.
            audit: Its exact audit, if known.
        """
        scene, shapes, _ = assets.resolved(scene)
        return cls(scene, shapes, audit_scene(scene, shapes) if audit is None else audit)


def shapes_by_instance(scene: Scene, shapes: Sequence[Shape]) -> dict[str, Shape]:
    """Returns instance -> geometry for the objects of a scene."""
    return {o.instance: shape for o, shape in zip(scene.objects, shapes, strict=True)}


def build_correction(
    start: InputScene,
    result: CertificationResult,
    shapes: Mapping[str, Shape],
    *,
    raw: Scene | None = None,
    card_raw: MetricCard | None = None,
) -> Correction:
    """Builds a correction from a certification; computes the figures of movement and of preserved relations.

    Args:
        start: The scene before the correction.
        result: Its certification.
        shapes: Instance -> certified geometry; its tilts may differ from those of ``start``.
        raw: The scene after the flow.
        card_raw: Metric card of ``raw``.
    """
    card_after, kept = None, None
    if result.scene is not None and result.audit is not None:
        after = [shapes[o.instance] for o in result.scene.objects]
        kept = relations_kept(start.scene, result.scene, start.shapes, after, audits=(start.audit, result.audit))
        card_after = add_movement(result.audit.card(), start.scene, result.scene, kept)
    return Correction(
        status=result.status,
        reason=result.reason,
        start=start.scene,
        raw=raw,
        certified=result.scene,
        dropped=result.dropped,
        card_before=start.audit.card(),
        card_raw=card_raw,
        card_after=card_after,
        audit_before=start.audit,
        audit=result.audit,
        kept=kept,
        rest=result.rest,
    )


def replace_result(correction: Correction, again: Correction) -> Correction:
    """Returns a correction with the certified scene, and all figures of it, of another correction of the same start."""
    return replace(
        correction, certified=again.certified, card_after=again.card_after, audit=again.audit, kept=again.kept, rest=again.rest
    )
