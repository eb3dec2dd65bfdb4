"""What a correction is asked for, and its result."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, TypeAlias

from models.physics_corrector.certify import CertificationResult, CorrectionStatus, DroppedObject
from stable_data.assets.store import AssetStore
from stable_data.errors import Notice
from stable_data.geometry.shape import Shape
from stable_data.metrics.audit import Audit, audit_scene
from stable_data.metrics.card import MetricCard
from stable_data.metrics.movement import add_movement
from stable_data.metrics.relations_kept import RelationsKept, relations_kept
from stable_data.scene import Scene

if TYPE_CHECKING:  # the engine takes long to import
    from stable_data.simulation.settling import SettleResult

Fixed: TypeAlias = frozenset[str]
"""Instances of a scene that must stay where they are."""


@dataclass(frozen=True, slots=True)
class CorrectionOptions:
    """What the correction of one scene may change, and what it proves.

    Attributes:
        fixed: Instances that must stay where they are, besides those that the corrector's own options fix.
        new: Instances that no correction has placed yet. Where tilts may change, those that the scene's relations put on or in
            something are dropped there in a simulation first.
        may_tilt: Whether tilts may change: for scenes that are generated. Otherwise only positions and yaws change.
        asks_engine: Whether MuJoCo decides which objects stay at rest, and those that do not are repaired.
    """

    fixed: Fixed = frozenset()
    new: frozenset[str] = frozenset()
    may_tilt: bool = False
    asks_engine: bool = False


@dataclass(frozen=True, slots=True, eq=False)
class CertificationRequest:
    """One scene after the flow, to be certified: in this process or in another.

    Attributes:
        scene: The scene, resolved (``AssetStore.resolved``).
        raw: The scene after the flow; None without a flow.
        options: What may be changed.
        audit: The exact audit of ``scene``; None where it is not known.
    """

    scene: Scene
    raw: Scene | None
    options: CorrectionOptions = CorrectionOptions()
    audit: Audit | None = None


@dataclass(frozen=True, slots=True, eq=False)
class KnownShapes:
    """Geometry that the caller has already, without assets: it is enough where MuJoCo is not asked and tilts do not change.

    Attributes:
        shapes: By instance, the same in all scenes.
    """

    shapes: Mapping[str, Shape]

    def resolved(self, scene: Scene) -> tuple[Scene, list[Shape], tuple[Notice, ...]]:
        """As ``AssetStore.resolved``: the scene as it is, and the geometry of its objects in order."""
        return scene, [self.shapes[o.instance] for o in scene.objects], ()


Assets: TypeAlias = AssetStore | KnownShapes
"""Gives the geometry of the objects of scenes."""


@dataclass(frozen=True, slots=True, eq=False)
class Correction:
    """The result for one scene.

    Attributes:
        status: Whether it is clean, and at what price.
        reason: Why nothing better was possible; empty where certified.
        start: The scene before the correction.
        raw: After the flow, before certification; None without a flow.
        certified: The clean scene; None where infeasible.
        dropped: Objects for which no place was found.
        card_before: Figures of the start; None where it could not be judged at all.
        card_raw: Figures of the raw scene; None without a flow, or where they were not asked for.
        card_after: Figures of the clean scene, with its movement and the relations that it kept; None where infeasible.
        audit: The exact audit of the clean scene; None where infeasible.
        kept: Relations of the start that still hold, counted; None where infeasible.
        rest: MuJoCo's verdict on ``certified``; None where it was not asked or could not be.
        engine_fault: Why MuJoCo could not be asked; empty where it was asked or nobody wanted it.
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
    audit: Audit | None = None
    kept: RelationsKept | None = None
    rest: "SettleResult | None" = None
    engine_fault: str = ""


@dataclass(frozen=True, slots=True, eq=False)
class InputScene:
    """A scene before its correction: the reference of movement and relations.

    Attributes:
        scene: The scene, resolved.
        shapes: The geometry of its objects, in order.
        audit: The exact audit of it.
    """

    scene: Scene
    shapes: Sequence[Shape]
    audit: Audit

    @classmethod
    def of(cls, scene: Scene, assets: Assets, audit: Audit | None = None) -> "InputScene":
        """Resolves a scene, and audits it where that is not done already.

        Args:
            scene: The scene.
            assets: Geometry of its objects.
            audit: Its exact audit, where it is known.
        """
        scene, shapes, _ = assets.resolved(scene)
        return cls(scene, shapes, audit_scene(scene, shapes) if audit is None else audit)


def shapes_by_instance(scene: Scene, shapes: Sequence[Shape]) -> dict[str, Shape]:
    """The geometry of a scene's objects by instance."""
    return {o.instance: shape for o, shape in zip(scene.objects, shapes, strict=True)}


def build_correction(
    start: InputScene,
    result: CertificationResult,
    shapes: Mapping[str, Shape],
    *,
    raw: Scene | None = None,
    card_raw: MetricCard | None = None,
) -> Correction:
    """A certification as a correction, with the figures of movement and of the relations that were kept.

    Args:
        start: The scene before the correction.
        result: Its certification.
        shapes: The geometry that was certified, by instance; its tilts may differ from those of ``start``.
        raw: The scene after the flow.
        card_raw: Figures of ``raw``.
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
        audit=result.audit,
        kept=kept,
        rest=result.rest,
    )


def replace_result(correction: Correction, again: Correction) -> Correction:
    """A correction whose certified scene, and all figures of it, are those of another one of the same start."""
    return replace(
        correction, certified=again.certified, card_after=again.card_after, audit=again.audit, kept=again.kept, rest=again.rest
    )
