"""MesaTask's layout optimiser, re-implemented from its description: not their code, and not their solver.

Hao et al., "MesaTask", 2025, tools/layoutopt: Steerable's programme over windows of six neighbours, in Drake with IPOPT. The
programme and settings are the same here: only positions change, at least 1 cm between any two convex hulls, no table, fixed
heights unless the scene graph says otherwise, windows along x that wrap round, three rounds, a window used only if it was solved.

There are two forms. *Fixed*, the default, uses the objects at their poses and returns the optimiser's result. *Released* has the
properties of the released program: every object at identity rotation, as its file's y-up mesh stretched to its box and centred on
the mean of its corners; x and y within 0 to 1 m for every table; a window of six that repeats an object in smaller scenes and so
has no solution; and a result that is used only if it has fewer pairs nearer than 5 cm than before, although the required gap is
1 cm.
"""

import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np

from models.baselines.hulls import ConvexBodies
from models.baselines.outcome import BaselineResult
from models.baselines.projection import Freedom, ProjectionSettings, project
from models.baselines.steerable import turned_parts
from stable_data.assets.store import AssetStore
from stable_data.errors import MeshError
from stable_data.geometry.shape import Shape
from stable_data.scene import TABLE, FloatArray, IntArray, RelationKind, Scene, SceneObject

_RELEASED_LIMIT = 1.0  # upper bound of x and y, metres


@dataclass(frozen=True, slots=True)
class MesaTask:
    """The optimiser with its released settings.

    Attributes:
        is_released: The released form, else the fixed one (see the module).
        gap: Least distance of two objects, metres.
        influence: Pairs farther apart than this do not count, metres.
        tolerance: Tolerance of the solver: by how much the gap may be violated, metres.
        max_iterations: Largest number of iterations of the solver in a window.
        window: Objects in a window.
        num_rounds: Passes of the windows over the scene.
        near: Pairs nearer than this count as colliding, metres.
        lift: How far an object may go up, if it may at all, metres.
    """

    is_released: bool = False
    gap: float = 0.01
    influence: float = 0.2
    tolerance: float = 2e-5
    max_iterations: int = 50_000
    window: int = 6
    num_rounds: int = 3
    near: float = 0.05
    lift: float = 0.25

    def correct(self, scene: Scene, shapes: Sequence[Shape], store: AssetStore) -> BaselineResult:
        """Moves objects apart; see :class:`~models.baselines.outcome.Baseline`.

        Converged: all pairs have the required distance and, in the released form, the result was used.
        """
        if self.is_released and len(scene.objects) < self.window:
            reason = f"{len(scene.objects)} objects, and a window of {self.window} repeats one: no window can be solved"
            return BaselineResult(scene, False, 0.0, reason)
        try:
            hulls = [[_released_points(o, shape, store)] for o, shape in zip(scene.objects, shapes, strict=True)]
            bodies = ConvexBodies(hulls if self.is_released else turned_parts(scene, shapes, store))
        except MeshError as error:
            return BaselineResult(scene, False, 0.0, str(error))
        poses = scene.poses()
        begin = time.process_time()
        before = self._count(bodies, poses[:, :3], self.near)
        positions = self._rounds(bodies, poses[:, :3].copy(), scene)
        seconds = time.process_time() - begin
        after = self._count(bodies, positions, self.near)
        if self.is_released and not (after < before or after == 0):
            return BaselineResult(
                scene, False, seconds, f"result not used: {after} pairs nearer than {100 * self.near:g} cm, {before} before"
            )
        poses[:, :3] = positions
        left = self._count(bodies, positions, self.gap - self.tolerance)
        reason = f"{left} pairs are nearer than {100 * self.gap:g} cm" if left else ""
        return BaselineResult(scene.with_poses(poses), not left, seconds, reason)

    def _rounds(self, bodies: ConvexBodies, positions: FloatArray, scene: Scene) -> FloatArray:
        settings = ProjectionSettings(self.gap, self.influence, self.tolerance, self.max_iterations)
        for _ in range(self.num_rounds):
            for members in self._windows(positions):
                # The limits of each window depend on the positions after the windows before it.
                found = project(bodies, positions, self._freedom(scene, positions), settings, among=members)
                if found.converged:
                    positions = found.positions
            if not self._count(bodies, positions, self.near):
                break
        return positions

    def _windows(self, positions: FloatArray) -> Iterator[IntArray]:
        """Yields windows of neighbours along x, one from every object and again from the first few."""
        order, count = np.argsort(positions[:, 0], kind="stable"), len(positions)
        for first in range(count + self.window - 1):
            yield order[np.arange(first, first + min(self.window, count)) % count]

    def _freedom(self, scene: Scene, positions: FloatArray) -> Freedom:
        """Returns what may move: by default x and y; objects of ``above`` and ``below`` only up; objects in others also up.

        ``on`` counts as ``above``: MesaTask's graphs have no other word for it. Fixed objects do not move.
        """
        place = {o.instance: n for n, o in enumerate(scene.objects)}
        is_free = np.tile([True, True, False], (len(place), 1))
        for relation in scene.relations:
            if relation.target == TABLE or relation.target not in place:
                continue
            if relation.kind in (RelationKind.ON, RelationKind.ABOVE, RelationKind.BELOW):
                for name in (relation.subject, relation.target):
                    is_free[place[name]] = False, False, True
        for relation in scene.relations:
            if relation.kind is RelationKind.IN and relation.target in place:
                is_free[place[relation.subject]] = True
        is_free[[o.instance in scene.fixed for o in scene.objects]] = False
        limit = (_RELEASED_LIMIT, _RELEASED_LIMIT) if self.is_released else scene.table.size_xy
        low, high = np.zeros(positions.shape), np.full(positions.shape, np.inf)
        high[:, :2] = limit
        low[:, 2], high[:, 2] = positions[:, 2], positions[:, 2] + self.lift
        return Freedom(is_free, low, high)

    def _count(self, bodies: ConvexBodies, positions: FloatArray, distance: float) -> int:
        """Counts pairs nearer than a distance."""
        return int((bodies.distances(positions, distance).distance < distance).sum())


def _released_points(o: SceneObject, shape: Shape, store: AssetStore) -> FloatArray:
    """Returns the points of an object in the released form, (V, 3) float64, metres, relative to its position."""
    mesh = store.mesh_of(o) if shape.is_exact else None
    x, y, z = (shape.vertices if mesh is None else mesh.vertices).T
    file = np.stack([x, z, -y], axis=1)  # y up, as in the file, and not rotated
    extents = np.ptp(file, axis=0)
    stretched = file * np.divide(o.size, extents, out=np.ones(3), where=extents > 0)
    points: FloatArray = stretched - stretched.mean(axis=0)
    return points
