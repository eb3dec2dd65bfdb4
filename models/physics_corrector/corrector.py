"""The Physics Corrector: turns coarse layouts into scenes that are exactly clean.

The learned flow moves all objects at once, the batched refinement separates them and rests what is carried, the exact audit verifies,
and ``certify`` repairs what is left. A :class:`~models.physics_corrector.certify.correction.Correction` reports the raw result of the
flow and the corrected scene, with the cards of these and of the input, and which step made it clean.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from typing import Literal, Protocol, TypeAlias

from models.physics_corrector.certify import CertificationResult, Certifier, CertifyOptions, CorrectionStatus
from models.physics_corrector.certify.correction import (
    Assets,
    CertificationRequest,
    Correction,
    CorrectionOptions,
    Fixed,
    InputScene,
    PreparedLayout,
    SolvedBy,
    build_correction,
    shapes_by_instance,
)
from models.physics_corrector.certify.flow_start import certify_moved, choose_start
from models.physics_corrector.certify.layout_search import remaining_faults
from models.physics_corrector.certify.mesh_queries import MeshQueries
from models.physics_corrector.certify.support_inference import TABLE_TOP, expected_carriers, infer_carriers, known_carriers
from models.physics_corrector.refinement.layouts import LayoutToRefine, RefinedLayout
from stable_data.assets.store import AssetStore
from stable_data.errors import ConfigError, MeshError
from stable_data.geometry.shape import Shape
from stable_data.metrics.audit import audit_scene
from stable_data.metrics.relations_kept import DIRECTIONAL
from stable_data.metrics.sampled_collision import add_sampled_collisions
from stable_data.metrics.verdicts import Audit
from stable_data.scene import TABLE, Relation, Scene

SceneMover: TypeAlias = Callable[[Sequence[Scene], Sequence[Sequence[Shape]], Sequence[Fixed]], Sequence[Scene | None]]
"""Moves the objects of scenes, such as :class:`~models.physics_corrector.learned_mover.LearnedMover`: scenes, the shapes of their
objects, the fixed instances of each -> the moved scenes, None for a scene that it cannot move.
"""


class LayoutRefiner(Protocol):
    """Refines layouts in batches, such as :class:`~models.physics_corrector.refinement.refiner.Refiner`, which says how."""

    def rest(self, layouts: Sequence[LayoutToRefine]) -> list[Scene]:
        """Gives objects exact heights."""
        ...

    def refine(self, layouts: Sequence[LayoutToRefine]) -> list[RefinedLayout | None]:
        """Refines layouts."""
        ...


_DEFAULT_OPTIONS = CorrectionOptions()


Polish: TypeAlias = Literal["off", "verify", "certify"]
"""What follows the flow: nothing, so that its own result is published; the refinement, of which the exact audit tells whether it is
clean; or certification of what the refinement leaves.
"""


Purpose: TypeAlias = Literal["repair", "rearrange"]
"""``repair``: the layout is meant as it is, and objects move only as far as a clean one needs; directions between objects stay.
``rearrange``: objects go where the flow puts them, and only the supports and what the task states stay.
"""


@dataclass(frozen=True, slots=True)
class PhysicsCorrector:
    """Corrects scenes: the flow moves all scenes as one batch, the refinement makes most of them clean, the others are certified.

    :meth:`correct` does all. A job that certifies scenes in separate processes calls :meth:`move` and :meth:`prepare` once, and
    :meth:`certify` for each request.

    Attributes:
        flow: The learned part, such as :class:`~models.physics_corrector.learned_flow.LearnedFlow`; None corrects without it.
        options: Options of `certify`.
        judges_raw: Whether the raw result of the flow is audited too; this costs one more audit per scene.
        refiner: The batched refinement; None certifies all scenes.
        polish: What follows the flow. MuJoCo is asked only after certification.
        purpose: Whether layouts are meant as they are.
    """

    flow: SceneMover | None = None
    options: CertifyOptions = field(default_factory=CertifyOptions)
    judges_raw: bool = True
    refiner: LayoutRefiner | None = None
    polish: Polish = "certify"
    purpose: Purpose = "repair"

    @property
    def _rearranges(self) -> bool:
        return self.purpose == "rearrange"

    def correct(
        self,
        scenes: Sequence[Scene],
        assets: Assets,
        options: CorrectionOptions | Sequence[CorrectionOptions] = _DEFAULT_OPTIONS,
        audits: Sequence[Audit] | None = None,
    ) -> list[Correction]:
        """Corrects scenes; a result does not depend on the other scenes, except for rounding in the batches.

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
        requests = self.prepare(self.move(scenes, assets, options, audits), assets)
        return [self.certify(request, assets) for request in requests]

    def move(
        self,
        scenes: Sequence[Scene],
        assets: Assets,
        options: CorrectionOptions | Sequence[CorrectionOptions] = _DEFAULT_OPTIONS,
        audits: Sequence[Audit] | None = None,
    ) -> list[CertificationRequest]:
        """The first part of :meth:`correct`, with the same arguments: moves the objects of all scenes by the flow, in one batch.

        Returns:
            One request per scene, in order; without a flow, objects do not move. If the result of
            the flow is judged or published, and there is a refiner, objects have exact heights. A scene that the flow cannot move
            stays as it is.
        """
        each = [options] * len(scenes) if isinstance(options, CorrectionOptions) else options
        each = [replace(own, fixed=own.fixed | scene.fixed) for own, scene in zip(each, scenes, strict=True)]
        resolved = [assets.resolved(scene)[:2] for scene in scenes]
        found = [scene for scene, _ in resolved]
        raws: Sequence[Scene | None] = [None] * len(scenes)
        if self.flow is not None:
            fixed = [self.options.fixed | own.fixed for own in each]
            raws = self.flow(found, [shapes for _, shapes in resolved], fixed)
            if self.refiner is not None and (self.judges_raw or self.polish == "off"):  # the refinement finds heights itself
                of_scene = zip(raws, resolved, fixed, strict=True)
                moved = [LayoutToRefine(raw, shapes, own) for raw, (_, shapes), own in of_scene if raw is not None]
                rested = iter(self.refiner.rest(moved))
                raws = [None if raw is None else next(rested) for raw in raws]
        known = [None] * len(scenes) if audits is None else audits
        return [CertificationRequest(*request) for request in zip(found, raws, each, known, strict=True)]

    def prepare(self, requests: Sequence[CertificationRequest], assets: Assets) -> list[CertificationRequest]:
        """The second part of :meth:`correct`: drops new objects onto their carriers, and refines all scenes as one batch.

        Args:
            requests: The requests.
            assets: Geometry of their objects.

        Returns:
            The requests with prepared layouts. Scenes that are clean already or of which more is asked than the refinement knows
            are not refined.

        Raises:
            ConfigError: As for :meth:`correct`.
        """
        dropped = [self._dropped(request, assets) for request in requests]
        layouts, chosen = [], []
        for k, (request, (layout, steady)) in enumerate(zip(requests, dropped, strict=True)):
            options = request.options
            is_clean = request.audit is not None and request.audit.card().clean is True
            if self.refiner is None or self.polish == "off" or options.asked or options.still:
                continue
            if is_clean and not options.may_tilt and not self._rearranges:
                continue
            start, shapes, _ = assets.resolved(choose_start(layout.scene, layout.raw, rearranges=self._rearranges))
            start = _with_carriers(start, shapes)
            earlier = {o.instance for o in start.objects} - options.new if options.may_tilt else set()
            layouts.append(LayoutToRefine(start, shapes, self.options.fixed | options.fixed, steady | earlier))
            chosen.append(k)
        prepared = [layout for layout, _ in dropped]
        if self.refiner is not None:
            for k, found in zip(chosen, self.refiner.refine(layouts), strict=True):
                if found is not None:
                    prepared[k] = replace(prepared[k], refined=found.scene, audit=found.audit, is_solved=found.is_solved)
        return [replace(request, prepared=layout) for request, layout in zip(requests, prepared, strict=True)]

    def _dropped(self, request: CertificationRequest, assets: Assets) -> tuple[PreparedLayout, frozenset[str]]:
        """The layout with its new objects dropped, if tilts may change; and the objects that have settled on their carriers."""
        if not request.options.may_tilt:
            return PreparedLayout(request.scene, request.raw), frozenset()
        # Imported here because MuJoCo's import is slow.
        from models.physics_corrector.stabilization.drop_simulation import drop_new_objects

        fixed = self.options.fixed | request.options.fixed
        dropped = drop_new_objects(request.scene, request.options.new, fixed, _asset_store(request.scene, assets))
        raw = None if request.raw is None else dropped.with_motion_of(request.raw)
        return PreparedLayout(dropped.scene, raw), frozenset(dropped.carriers)

    def certify(self, request: CertificationRequest, assets: Assets) -> Correction:
        """The last part of :meth:`correct`: proves or repairs one scene after the flow and the refinement.

        Args:
            request: The scene; it is prepared alone if it is not yet.
            assets: Geometry of its objects.

        Raises:
            ConfigError: As for :meth:`correct`.
        """
        layout = request.prepared or self.prepare([request], assets)[0].prepared
        assert layout is not None
        wanted = request.options
        start = InputScene.of(request.scene, assets, request.audit)
        card_raw = None
        if request.raw is not None and self.judges_raw:
            audit_raw = audit_scene(request.raw, start.shapes)
            card_raw = add_sampled_collisions(audit_raw.card(), request.raw, start.shapes, audit_raw)
        scene, shapes, _ = assets.resolved(layout.scene)
        raw = layout.raw
        is_dropped = wanted.may_tilt and _has_moved(start.scene, scene)
        if start.audit.card().clean and not is_dropped and not self._rearranges:
            raw = None  # a clean scene stays as it is, whatever the flow proposes
        result, certifier, solved_by = self._polished(start, replace(layout, scene=scene, raw=raw), shapes, wanted)
        shape_of = shapes_by_instance(scene, shapes)
        if not wanted.asks_engine:
            done = build_correction(start, result, shape_of, raw=request.raw, card_raw=card_raw)
            return replace(done, solved_by=solved_by)
        # Imported here because MuJoCo's import is slow.
        from models.physics_corrector.stabilization.settle_repair import repair_settling
        from models.physics_corrector.stabilization.stabilize import stabilize
        from stable_data.simulation.collision_bodies import bodies_of

        store, fault = _asset_store(scene, assets), ""
        if not wanted.may_tilt and self.polish == "certify":
            try:
                result = repair_settling(certifier, result, bodies_of(scene, shapes, store))
            except MeshError as error:
                fault = str(error)
        done = build_correction(start, result, shape_of, raw=request.raw, card_raw=card_raw)
        done = replace(done, engine_fault=fault, solved_by=solved_by)
        if not wanted.may_tilt or self.polish != "certify":
            return done
        stable = stabilize(done, start, certifier.options, store)
        has_moved = stable.certified is not None and stable.certified is not done.certified
        return replace(stable, solved_by=SolvedBy.CERTIFY if has_moved else stable.solved_by)

    def _polished(
        self, start: InputScene, layout: PreparedLayout, shapes: Sequence[Shape], wanted: CorrectionOptions
    ) -> tuple[CertificationResult, Certifier, SolvedBy | None]:
        """What follows the flow and the refinement, by ``polish``; the result, its certifier, and what made it clean."""
        stated = _stated_directions(start.scene) if self._rearranges else set()
        options = replace(
            self.options,
            fixed=self.options.fixed | wanted.fixed,
            asked=self.options.asked | wanted.asked | stated,
            still=self.options.still | wanted.still,
        )
        if self.polish == "certify" and not layout.is_solved:
            # What the refinement has reached is the better start, but the scene itself remains the other one.
            moved_scene = layout.refined or layout.raw
            result, certifier = certify_moved(layout.scene, moved_scene, shapes, options, rearranges=self._rearranges)
            moved = result.scene is not None and _has_moved(start.scene, result.scene)
            return result, certifier, _solved_by(result, SolvedBy.CERTIFY if moved or result.dropped else SolvedBy.START)
        end = layout.refined or layout.raw or layout.scene
        audit = layout.audit if layout.refined is not None and layout.audit is not None else audit_scene(end, shapes)
        certifier = Certifier(end, shapes, options, layout.scene)
        result = certifier.conclude(end, audit)
        if audit.card().clean is False:
            faults = remaining_faults(audit)
            result = CertificationResult(end, CorrectionStatus.UNCLEAN, f"not clean, and not certified: {faults}", audit=audit)
        step = SolvedBy.REFINE
        if layout.raw is not None and not _has_moved(layout.raw, end):
            step = SolvedBy.FLOW
        if not _has_moved(start.scene, end):
            step = SolvedBy.START
        return result, certifier, _solved_by(result, step)


def _stated_directions(scene: Scene) -> set[Relation]:
    """The directions between objects that the task of a scene states."""
    return set() if scene.task is None else {r for r in scene.task.relations if r.kind in DIRECTIONAL}


def _solved_by(result: CertificationResult, step: SolvedBy) -> SolvedBy | None:
    """The step that made a result clean; None if it is not known to be clean."""
    is_clean = result.scene is not None and result.audit is not None and result.audit.card().clean is True
    return step if is_clean else None


def _has_moved(before: Scene, after: Scene) -> bool:
    """Whether the objects of a scene are at other poses, or are others."""
    return [(o.instance, o.position, o.yaw) for o in before.objects] != [(o.instance, o.position, o.yaw) for o in after.objects]


def _with_carriers(scene: Scene, shapes: Sequence[Shape]) -> Scene:
    """Returns a scene whose objects all have a support: where one is unknown, those that the layout suggests."""
    if all(o.support is not None for o in scene.objects):
        return scene
    meshes = MeshQueries([s.as_mesh() for s in shapes])
    choices = infer_carriers(meshes, scene.poses(), known_carriers(scene, shapes, frozenset(), expected_carriers(scene)))
    names = [o.instance for o in scene.objects]
    carriers = [TABLE if choice[0].parent == TABLE_TOP else names[choice[0].parent] for choice in choices]
    return replace(scene, objects=tuple(replace(o, support=c) for o, c in zip(scene.objects, carriers, strict=True)))


def _asset_store(scene: Scene, assets: Assets) -> AssetStore:
    if isinstance(assets, AssetStore):
        return assets
    found = type(assets).__name__
    raise ConfigError(f"{scene.scene_id}: assets is {found}, expected an AssetStore to simulate with", "assets_missing")
