"""Post-hoc optimisers in the place of the Physics Corrector: the same requests, the same exact audit of the result."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

from models.baselines.methods import METHODS
from models.baselines.outcome import Baseline
from models.physics_corrector.certify import CertificationResult, CorrectionStatus
from models.physics_corrector.certify.correction import (
    Assets,
    CertificationRequest,
    Correction,
    CorrectionOptions,
    InputScene,
    SolvedBy,
    build_correction,
    shapes_by_instance,
)
from models.physics_corrector.certify.layout_search import remaining_faults
from stable_data.assets.store import AssetStore
from stable_data.errors import ConfigError
from stable_data.metrics.audit import audit_scene
from stable_data.scene import Scene


@dataclass(frozen=True, slots=True)
class PostProcessor:
    """Corrects scenes by a post-hoc optimiser, with the interface of :class:`~models.physics_corrector.corrector.PhysicsCorrector`.

    Nothing is dropped onto its carrier before, no tilt changes and nothing is removed: the optimiser gets the layout as it is. Whether the
    result is clean is decided by the exact audit; whether the optimiser holds it for solved is told beside that.

    Attributes:
        method: The optimiser.
    """

    method: Baseline

    @classmethod
    def named(cls, name: str) -> "PostProcessor":
        """Returns the post-processor with one of :data:`~models.baselines.methods.METHODS`."""
        return cls(METHODS[name])

    def move(self, scenes: Sequence[Scene], assets: Assets, options: Sequence[CorrectionOptions]) -> list[CertificationRequest]:
        """Returns one request per scene; nothing is computed for all scenes together."""
        resolved = [assets.resolved(scene)[0] for scene in scenes]
        return [CertificationRequest(scene, None, own) for scene, own in zip(resolved, options, strict=True)]

    def prepare(self, requests: Sequence[CertificationRequest], assets: Assets) -> list[CertificationRequest]:
        """Returns the requests as they are."""
        return list(requests)

    def certify(self, request: CertificationRequest, assets: Assets) -> Correction:
        """Optimises one scene and audits the result.

        Args:
            request: The scene; instances that must not move are obstacles.
            assets: Geometry of its objects.

        Returns:
            The correction. A scene that is not clean has the status ``unclean``, and one whose audit is unknown ``unknown``.

        Raises:
            ConfigError: ``assets`` is not an :class:`AssetStore` (``assets_missing``).
        """
        if not isinstance(assets, AssetStore):
            found = type(assets).__name__
            raise ConfigError(
                f"{request.scene.scene_id}: assets is {found}, expected an AssetStore to optimise with", "assets_missing"
            )
        start = InputScene.of(request.scene, assets, request.audit)
        held = replace(start.scene, fixed=start.scene.fixed | request.options.fixed)
        outcome = self.method.correct(held, start.shapes, assets)
        end, shapes, _ = assets.resolved(replace(outcome.scene, fixed=start.scene.fixed))
        audit = audit_scene(end, shapes)
        is_clean = audit.card().clean
        status = {True: CorrectionStatus.CERTIFIED, False: CorrectionStatus.UNCLEAN, None: CorrectionStatus.UNKNOWN}[is_clean]
        reason = "" if is_clean else f"not clean after post-processing: {remaining_faults(audit)}"
        done = build_correction(start, CertificationResult(end, status, reason, audit=audit), shapes_by_instance(end, shapes))
        has_moved = (end.poses() != start.scene.poses()).any()
        solved_by = None if not is_clean else SolvedBy.POST_PROCESSING if has_moved else SolvedBy.START
        return replace(done, solved_by=solved_by, unsolved="" if outcome.converged else outcome.reason or "it did not converge")
