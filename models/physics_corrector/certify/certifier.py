"""Certification: makes a scene clean by the exact audit, with little movement and its relations preserved."""

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import replace
from functools import cache

import numpy as np
from threadpoolctl import ThreadpoolController

from models.physics_corrector.certify.layout_search import LayoutSearch, build_scene
from models.physics_corrector.certify.layout_state import LayoutState
from models.physics_corrector.certify.mesh_queries import MeshQueries
from models.physics_corrector.certify.options import CertificationResult, CertifyOptions, CorrectionStatus, DroppedObject
from models.physics_corrector.certify.support_inference import expected_carriers, infer_carriers, known_carriers
from stable_data.errors import SceneError
from stable_data.geometry.shape import Shape
from stable_data.metrics.audit import BOUNDS_SLACK, audit_scene
from stable_data.metrics.verdicts import TOLERANCE, Audit
from stable_data.scene import Scene

_DEFAULT = CertifyOptions()


def certify(
    scene: Scene, shapes: Sequence[Shape], options: CertifyOptions = _DEFAULT, *, original: Scene | None = None
) -> CertificationResult:
    """Makes a scene clean by the exact audit, with little movement and its relations preserved.

    Args:
        scene: The layout; positions are box centres (``AssetStore.resolved``).
        shapes: The geometry of each object, in the scene's order.
        options: Settings.
        original: The layout whose relations are preserved and from which movement is measured; None: ``scene``.

    Returns:
        The corrected scene with its audit, or the reason why none was found. The audit names every remaining collision.

    Raises:
        SceneError: Shapes (``shapes_differ``), ``original`` (``original_differs``) or ``options.fixed`` (``fixed_unknown``) do
            not belong to the scene.
    """
    return Certifier(scene, shapes, options, original).certify()


@cache
def _thread_pools() -> ThreadpoolController:
    return ThreadpoolController()


@contextmanager
def one_blas_thread() -> Iterator[None]:
    """Limits linear algebra to one thread: with many small matrices, more threads only wait for each other."""
    with _thread_pools().limit(limits=1, user_api="blas"):
        yield


class Certifier:
    """Certifies one scene; arguments and errors as for :func:`certify`.

    Attributes:
        scene: The start layout.
        options: Settings.
        original: The layout whose relations are preserved.
        shapes: The geometry of the objects; a box that replaces a missing mesh is checked like a mesh.
        meshes: The same geometry, for exact queries.
        search: The search for a clean layout; None before the search, and if the scene was clean already.
    """

    def __init__(
        self, scene: Scene, shapes: Sequence[Shape], options: CertifyOptions = _DEFAULT, original: Scene | None = None
    ) -> None:
        if len(shapes) != len(scene.objects):
            found = f"{len(shapes)} shapes for {len(scene.objects)} objects"
            raise SceneError(f"{scene.scene_id}: {found}, expected one each; pass AssetStore.resolved", "shapes_differ")
        names = [o.instance for o in scene.objects]
        if original is not None and [o.instance for o in original.objects] != names:
            raise SceneError(
                f"{scene.scene_id}: the original has other objects, expected the same in order", "original_differs"
            )
        if unknown := sorted(options.fixed - set(names)):
            raise SceneError(f"{scene.scene_id}: fixed {unknown} are not in the scene, expected its instances", "fixed_unknown")
        self.scene, self.options, self.original = scene, options, original or scene
        self._given = shapes
        self.shapes = [s.as_mesh() for s in shapes]
        self.meshes = MeshQueries(self.shapes, options.depth)
        self.search: LayoutSearch | None = None

    def certify(self) -> CertificationResult:
        """Certifies the scene."""
        with one_blas_thread():
            wanted = expected_carriers(self.scene) if self.options.restore else {}
            if not (wanted or self.options.asked) and (audit := self._audit_if_clean()) is not None:
                return self.conclude(self.scene, audit)
            self.search = LayoutSearch(self.scene, self.original, self.shapes, self.meshes, self.options, wanted)
            found = self.search.find()
            if found is None:
                dropped = tuple(self.search.dropped)
                return CertificationResult(None, CorrectionStatus.INFEASIBLE, self.search.reason, dropped)
            return replace(self.conclude(build_scene(self.search.layout), found), num_broken=self.search.num_broken)

    def layout(self) -> LayoutState:
        """Returns the certified layout: from the search, or from the scene if no search was needed."""
        if self.search is not None:
            return self.search.layout
        known = known_carriers(self.scene, self.shapes, frozenset(), {})
        carried = [choice[0] for choice in infer_carriers(self.meshes, self.scene.poses(), known)]
        return LayoutState(self.scene, self.shapes, carried, self.options.fixed)

    def conclude(self, scene: Scene, audit: Audit) -> CertificationResult:
        """Returns the result for a clean scene: certified, unless objects were dropped or meshes are missing.

        Args:
            scene: The clean scene.
            audit: Its exact audit.
        """
        dropped: tuple[DroppedObject, ...] = () if self.search is None else tuple(self.search.dropped)
        if dropped and not scene.objects:
            reason = f"every object was dropped: {dropped[0].reason}"
            return CertificationResult(None, CorrectionStatus.INFEASIBLE, reason, dropped)
        there = {o.instance for o in scene.objects}
        missing = [o.instance for o, s in zip(self.scene.objects, self._given, strict=True) if not s.is_exact]
        if boxed := [name for name in missing if name in there]:
            shapes = [s for o, s in zip(self.scene.objects, self._given, strict=True) if o.instance in there]
            reason = f"the meshes of {boxed} are missing: clean with boxes in their place, which proves nothing"
            return CertificationResult(scene, CorrectionStatus.UNKNOWN, reason, dropped, audit_scene(scene, shapes))
        reason = "; ".join(f"{d.instance} dropped: {d.reason}" for d in dropped)
        status = CorrectionStatus.DROPPED if dropped else CorrectionStatus.CERTIFIED
        return CertificationResult(scene, status, reason, dropped, audit)

    def _audit_if_clean(self) -> Audit | None:
        """Returns the audit of a layout that is clean already, else None."""
        poses, size = self.scene.poses(), np.array(self.scene.table.size_xy)
        boxes = [self.meshes.box(k, pose) for k, pose in enumerate(poses)]
        # The cheap checks first: most layouts fail one of them, and the audit takes longest.
        fixed = [o.instance in self.scene.fixed for o in self.scene.objects]
        for (low, high), is_fixed in zip(boxes, fixed, strict=True):
            if is_fixed:
                continue
            if low[2] < -TOLERANCE or (low[:2] < -BOUNDS_SLACK).any() or (high[:2] > size + BOUNDS_SLACK).any():
                return None
        for k in range(len(poses)):
            near = [j for j in self.meshes.near(k, poses[k], range(k), poses) if not (fixed[k] and fixed[j])]
            if any(self.meshes.penetrates(k, poses[k], j, poses[j]) for j in near):
                return None
        audit = audit_scene(self.scene, self.shapes)
        return audit if audit.card().clean else None
