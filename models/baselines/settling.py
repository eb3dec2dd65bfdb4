"""Settling only: MuJoCo pushes the objects of a layout apart, and the poses at rest are the result."""

import time
from collections.abc import Sequence
from dataclasses import dataclass, replace

from models.baselines.outcome import BaselineResult
from stable_data.assets.store import AssetStore
from stable_data.errors import MeshError
from stable_data.geometry.shape import Shape
from stable_data.scene import Scene
from stable_data.simulation.collision_bodies import DENSITY, bodies_of
from stable_data.simulation.scene_geometry import object_at_rest
from stable_data.simulation.settling import PhysicsOptions, settle

_AT_REST = 1e-3  # largest move during the watched time, metres
_OPTIONS = PhysicsOptions(settle_seconds=2.5, watch_seconds=0.1, rest_move=0.0)


@dataclass(frozen=True, slots=True)
class Settle:
    """MuJoCo on convex parts.

    Attributes:
        options: Settings of the simulation; by default 2.5 s, and 0.1 s to test whether the objects rest.
        density: Density of every object, kg/m³: a layout gives no masses.
    """

    options: PhysicsOptions = _OPTIONS
    density: float = DENSITY

    def correct(self, scene: Scene, shapes: Sequence[Shape], store: AssetStore) -> BaselineResult:
        """Simulates; see :class:`~models.baselines.outcome.Baseline`. Objects may tip over, or fall off the table.

        Converged: the simulation did not diverge, and all objects rest.
        """
        resolved = store.resolved(scene)[0]
        try:
            bodies = bodies_of(resolved, shapes, store, self.density)
        except MeshError as error:
            return BaselineResult(scene, False, 0.0, str(error))
        begin = time.process_time()
        result = settle(bodies, scene.table, self.options)
        seconds = time.process_time() - begin
        if result.drift_mm is None:
            return BaselineResult(scene, False, seconds, result.reason)
        objects = tuple(object_at_rest(o, store.mesh_of(o), result.pose(k)) for k, o in enumerate(resolved.objects))
        is_at_rest = result.drift_mm <= 1e3 * _AT_REST
        reason = "" if is_at_rest else f"an object still moves: {result.drift_mm:.1f} mm in {self.options.watch_seconds:g} s"
        return BaselineResult(replace(scene, objects=objects), is_at_rest, seconds, reason)
