"""Steerable Scene Generation's projection, re-implemented from its description: not their code, and not their solver.

Pfaff et al., "Steerable Scene Generation with Post Training and Inference-Time Search", 2025. Theirs is an inverse-kinematics
programme in Drake, solved by SNOPT; ``benchmarks/steerable_drake.py`` runs that. Here the same programme with the released
settings is solved by ``projection``, which does not fail where SNOPT does: the figures are an upper bound for the formulation.
The programme: only positions change, with the sum of their squared changes as the objective; no pair of bodies nearer than 0; one
convex hull a mesh (as Drake makes of a mesh); the table as a fixed box; a scene that the solver does not solve is discarded.
"""

import time
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from models.baselines.hulls import ConvexBodies, table_box
from models.baselines.outcome import BaselineResult
from models.baselines.projection import Freedom, ProjectionSettings, project
from stable_data.assets.store import AssetStore
from stable_data.errors import MeshError
from stable_data.geometry.shape import Shape
from stable_data.scene import FloatArray, Scene
from stable_data.simulation.collision_bodies import parts_of


@dataclass(frozen=True, slots=True)
class Steerable:
    """The projection with its released settings, and the budget of the STABLE paper's Table 2.

    The solver ends earlier where it converges, or where thirty iterations bring no progress.

    Attributes:
        with_parts: Use the convex parts of the meshes instead of one hull each, so that hollows stay hollow.
        influence: Pairs farther apart than this do not count, metres.
        tolerance: Tolerance of the solver, a share of the influence distance, by which its constraint is scaled.
        max_iterations: Largest number of iterations of the solver.
        max_seconds: Time limit of the solver.
    """

    with_parts: bool = False
    influence: float = 0.03
    tolerance: float = 1e-3
    max_iterations: int = 50_000
    max_seconds: float = 60.0

    def correct(self, scene: Scene, shapes: Sequence[Shape], store: AssetStore) -> BaselineResult:
        """Moves objects apart, also vertically; see :class:`~models.baselines.outcome.Baseline`.

        Steerable would discard a scene that did not converge; here its last iterate is returned.
        """
        poses = scene.poses()
        box, middle = table_box(scene.table)
        try:
            bodies = ConvexBodies([*turned_parts(scene, shapes, store, with_parts=self.with_parts), [box]])
        except MeshError as error:
            return BaselineResult(scene, False, 0.0, str(error))
        start = np.concatenate([poses[:, :3], middle[None]])
        is_free = np.ones(start.shape, np.bool_)
        is_free[-1] = False
        is_free[:-1][[o.instance in scene.fixed for o in scene.objects]] = False
        anywhere = np.full(start.shape, np.inf)
        settings = ProjectionSettings(
            0.0, self.influence, self.tolerance * self.influence, self.max_iterations, self.max_seconds
        )
        begin = time.process_time()
        found = project(bodies, start, Freedom(is_free, -anywhere, anywhere), settings)
        seconds = time.process_time() - begin
        poses[:, :3] = found.positions[:-1]
        return BaselineResult(scene.with_poses(poses), found.converged, seconds, found.reason)


def turned_parts(
    scene: Scene, shapes: Sequence[Shape], store: AssetStore, *, with_parts: bool = False
) -> list[list[FloatArray]]:
    """Returns the points of the convex parts of every object, turned by its yaw; one whole shape if not ``with_parts``.

    Raises:
        MeshError: A mesh has no convex parts.
    """
    bodies = []
    for o, shape in zip(store.resolved(scene)[0].objects if with_parts else scene.objects, shapes, strict=True):
        points = [part.vertices for part in parts_of(o, shape, store)] if with_parts else [shape.vertices]
        c, s = np.cos(o.yaw), np.sin(o.yaw)
        turn = np.array([[c, s, 0.0], [-s, c, 0.0], [0.0, 0.0, 1.0]])
        bodies.append([p @ turn for p in points])
    return bodies
