"""The Physics Corrector: turns coarse layouts into scenes that are exactly clean.

The learned flow moves all objects at once; ``certify`` proves the result or repairs it. A
:class:`~models.physics_corrector.certify.correction.Correction` reports both: the raw result of the flow and the certified
result, with the cards of these and of the input.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from typing import TypeAlias

from models.physics_corrector.certify import CertifyOptions
from models.physics_corrector.certify.correction import (
    Assets,
    CertificationRequest,
    Correction,
    CorrectionOptions,
    Fixed,
    InputScene,
    build_correction,
    shapes_by_instance,
)
from models.physics_corrector.certify.flow_start import certify_moved
from stable_data.assets.store import AssetStore
from stable_data.errors import ConfigError, MeshError
from stable_data.geometry.shape import Shape
from stable_data.metrics.audit import Audit, audit_scene
from stable_data.scene import Scene

Flow: TypeAlias = Callable[[Sequence[Scene], Sequence[Sequence[Shape]], Sequence[Fixed]], list[Scene]]
"""Moves the objects of scenes: scenes, the shapes of their objects, the fixed instances of each -> the moved scenes."""

_DEFAULT_OPTIONS = CorrectionOptions()


@dataclass(frozen=True, slots=True)
class PhysicsCorrector:
    """Corrects scenes: the flow moves all scenes as one batch, then each scene is certified.

    :meth:`correct` does both. A job that certifies scenes in separate processes calls :meth:`move` once and :meth:`certify` for
    each request.

    Attributes:
        flow: The learned part, such as :class:`~models.physics_corrector.learned_flow.LearnedFlow`; None certifies without it.
        options: Options of `certify`.
        judges_raw: Whether the raw result of the flow is audited too; this costs one more audit per scene.
    """

    flow: Flow | None = None
    options: CertifyOptions = field(default_factory=CertifyOptions)
    judges_raw: bool = True

    def correct(
        self,
        scenes: Sequence[Scene],
        assets: Assets,
        options: CorrectionOptions | Sequence[CorrectionOptions] = _DEFAULT_OPTIONS,
        audits: Sequence[Audit] | None = None,
    ) -> list[Correction]:
        """Corrects scenes; a result does not depend on the other scenes, except for rounding in the flow's batch.

        Args:
            scenes: The scenes; with stages if task objects are known, so that these are not dropped.
            assets: Geometry of their objects.
            options: Permitted changes: one for all scenes, or one for each.
            audits: The exact audits of the scenes, if the caller has them.

        Returns:
            One correction per scene, in order.

        Raises:
            ConfigError: MuJoCo is needed, or tilts may change, and ``assets`` is not an :class:`AssetStore`
                (``assets_missing``).
        """
        return [self.certify(request, assets) for request in self.move(scenes, assets, options, audits)]

    def move(
        self,
        scenes: Sequence[Scene],
        assets: Assets,
        options: CorrectionOptions | Sequence[CorrectionOptions] = _DEFAULT_OPTIONS,
        audits: Sequence[Audit] | None = None,
    ) -> list[CertificationRequest]:
        """The first half of :meth:`correct`, with the same arguments: moves the objects of all scenes by the flow, in one batch.

        Returns:
            One request per scene, in order; without a flow, objects do not move.
        """
        each = [options] * len(scenes) if isinstance(options, CorrectionOptions) else options
        resolved = [assets.resolved(scene)[:2] for scene in scenes]
        found = [scene for scene, _ in resolved]
        raws: Sequence[Scene | None] = [None] * len(scenes)
        if self.flow is not None:
            raws = self.flow(found, [shapes for _, shapes in resolved], [self.options.fixed | own.fixed for own in each])
        known = [None] * len(scenes) if audits is None else audits
        return [CertificationRequest(*request) for request in zip(found, raws, each, known, strict=True)]

    def certify(self, request: CertificationRequest, assets: Assets) -> Correction:
        """The second half of :meth:`correct`: proves or repairs one scene after the flow.

        Args:
            request: The scene.
            assets: Geometry of its objects.
        """
        wanted = request.options
        start = InputScene.of(request.scene, assets, request.audit)
        options = replace(
            self.options,
            fixed=self.options.fixed | wanted.fixed,
            asked=self.options.asked | wanted.asked,
            still=self.options.still | wanted.still,
        )
        scene, raw, shapes = start.scene, request.raw, start.shapes
        card_raw = audit_scene(raw, shapes).card() if raw is not None and self.judges_raw else None
        if start.audit.card().clean and not wanted.may_tilt:
            raw = None  # a clean scene stays as it is, whatever the flow proposes
        if not (wanted.may_tilt or wanted.asks_engine):
            result, _ = certify_moved(scene, raw, shapes, options)
            return build_correction(start, result, shapes_by_instance(scene, shapes), raw=request.raw, card_raw=card_raw)
        if not isinstance(assets, AssetStore):
            found = type(assets).__name__
            raise ConfigError(f"{scene.scene_id}: assets is {found}, expected an AssetStore to simulate with", "assets_missing")
        # Imported here because MuJoCo's import is slow.
        from models.physics_corrector.stabilization.drop_simulation import drop_new_objects
        from models.physics_corrector.stabilization.settle_repair import repair_settling
        from models.physics_corrector.stabilization.stabilize import stabilize
        from stable_data.simulation.collision_bodies import bodies_of

        if wanted.may_tilt:
            dropped = drop_new_objects(scene, wanted.new, options.fixed, assets)
            scene, shapes, _ = assets.resolved(dropped.scene)
            raw = None if raw is None else dropped.with_motion_of(raw)
        bodies, fault = None, ""
        if wanted.asks_engine and not wanted.may_tilt:
            try:
                bodies = bodies_of(scene, shapes, assets)
            except MeshError as error:
                fault = str(error)
        result, certifier = certify_moved(scene, raw, shapes, options)
        if bodies is not None:
            result = repair_settling(certifier, result, bodies)
        done = build_correction(start, result, shapes_by_instance(scene, shapes), raw=request.raw, card_raw=card_raw)
        if wanted.asks_engine and wanted.may_tilt:
            return stabilize(done, start, options, assets)
        return replace(done, engine_fault=fault)
