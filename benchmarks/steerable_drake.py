"""Steerable's projection in Drake itself, beside the re-implementation: methods of ``benchmarks.correction`` if Drake is installed.

Needs Drake: ``pip install -c constraints.txt -e '.[drake]'`` (its wheel contains the solver SNOPT, and MOSEK, which needs its own
licence; MOSEK is not used here).

The programme as released: an inverse-kinematics problem over free bodies, fixed quaternions, the sum of squared changes of the
positions, ``AddMinimumDistanceLowerBoundConstraint(0, 0.03)``, SNOPT with a feasibility tolerance of 1e-3, at most 5000 major
iterations and 60 s. One convex hull a mesh, as Drake uses a mesh in distance queries; the table is a fixed box.
"""

import time
from collections.abc import Sequence
from dataclasses import dataclass
from importlib.util import find_spec
from typing import Any

import numpy as np

from models.baselines.hulls import solid_hull, table_box
from models.baselines.outcome import BaselineResult
from models.baselines.steerable import turned_parts
from stable_data.assets.store import AssetStore
from stable_data.errors import MeshError
from stable_data.geometry.shape import Shape
from stable_data.scene import FloatArray, Scene


@dataclass(frozen=True, slots=True)
class SteerableInDrake:
    """The projection as released, in Drake.

    Attributes:
        with_parts: Use convex parts instead of one hull a mesh.
        influence: Pairs farther apart than this do not count, metres.
        tolerance: SNOPT's major feasibility tolerance.
        max_iterations: SNOPT's limit of major iterations.
        max_seconds: SNOPT's time limit.
    """

    with_parts: bool = False
    influence: float = 0.03
    tolerance: float = 1e-3
    max_iterations: int = 5000
    max_seconds: float = 60.0

    def correct(self, scene: Scene, shapes: Sequence[Shape], store: AssetStore) -> BaselineResult:
        """Moves objects apart; see :class:`~models.baselines.outcome.Baseline`. Not converged: Steerable discards the scene."""
        try:
            bodies = [
                [solid_hull(points) for points in parts]
                for parts in turned_parts(scene, shapes, store, with_parts=self.with_parts)
            ]
        except MeshError as error:
            return BaselineResult(scene, False, 0.0, str(error))
        poses = scene.poses()
        problem = self._problem(bodies, poses[:, :3], scene)
        begin = time.process_time()
        positions, is_solved, status = self._solved(problem)
        seconds = time.process_time() - begin
        poses[:, :3] = positions
        return BaselineResult(scene.with_poses(poses), is_solved, seconds, "" if is_solved else f"SNOPT: status {status}")

    def _problem(self, bodies: Sequence[Sequence[FloatArray]], positions: FloatArray, scene: Scene) -> "_Problem":
        from pydrake.geometry import Box, Convex
        from pydrake.math import RigidTransform
        from pydrake.multibody.inverse_kinematics import InverseKinematics
        from pydrake.multibody.plant import AddMultibodyPlantSceneGraph, CoulombFriction
        from pydrake.multibody.tree import SpatialInertia, UnitInertia
        from pydrake.systems.framework import DiagramBuilder

        builder = DiagramBuilder()
        plant, _ = AddMultibodyPlantSceneGraph(builder, time_step=0.0)
        friction, nowhere = CoulombFriction(1.0, 1.0), RigidTransform()
        inertia = SpatialInertia(1.0, np.zeros(3), UnitInertia(0.01, 0.01, 0.01))  # any value will do: there are no forces
        corners, middle = table_box(scene.table)
        plant.RegisterCollisionGeometry(
            plant.world_body(), RigidTransform(middle), Box(*np.ptp(corners, axis=0)), "table", friction
        )
        added = []
        for n, parts in enumerate(bodies):
            body = plant.AddRigidBody(f"body_{n}", inertia)
            for k, points in enumerate(parts):
                shape = Convex(points=points.T, label=f"part_{n}_{k}")
                plant.RegisterCollisionGeometry(body, nowhere, shape, f"part_{n}_{k}", friction)
            added.append(body)
        plant.Finalize()
        diagram = builder.Build()
        context = diagram.CreateDefaultContext()
        inside = plant.GetMyMutableContextFromRoot(context)
        for body, position in zip(added, positions, strict=True):
            plant.SetFreeBodyPose(inside, body, RigidTransform(position))
        programme = InverseKinematics(plant, inside)
        return _Problem(programme, diagram, context, plant.GetPositions(inside), [b.floating_positions_start() for b in added])

    def _solved(self, problem: "_Problem") -> tuple[FloatArray, bool, int]:
        from pydrake.solvers import SnoptSolver, SolverOptions

        prog, q, start = problem.programme.prog(), problem.programme.q(), problem.start
        for first in problem.firsts:
            quat, place = slice(first, first + 4), slice(first + 4, first + 7)
            prog.AddBoundingBoxConstraint(start[quat], start[quat], q[quat])
            prog.AddQuadraticErrorCost(np.eye(3), start[place], q[place])
        problem.programme.AddMinimumDistanceLowerBoundConstraint(0.0, self.influence)
        options = SolverOptions()
        options.SetOption(SnoptSolver.id(), "Major feasibility tolerance", self.tolerance)
        options.SetOption(SnoptSolver.id(), "Major iterations limit", self.max_iterations)
        options.SetOption(SnoptSolver.id(), "Time limit", self.max_seconds)
        result = SnoptSolver().Solve(prog, start, options)
        values = result.GetSolution(q)
        positions = np.array([values[first + 4 : first + 7] for first in problem.firsts]).reshape(-1, 3)
        return positions, bool(result.is_success()), int(result.get_solver_details().info)


@dataclass(frozen=True, slots=True, eq=False)
class _Problem:
    """Drake's objects, stored together because the problem refers to the others without owning them.

    Attributes:
        programme: The inverse-kinematics problem.
        diagram: The diagram to which it refers.
        context: The context to which it refers.
        start: q⁰.
        firsts: Index in q at which each body's quaternion starts; its position follows.
    """

    programme: Any
    diagram: Any
    context: Any
    start: FloatArray
    firsts: list[int]


def in_drake() -> dict[str, SteerableInDrake]:
    """Returns Steerable in Drake, by name, with hulls and with convex parts; empty if Drake is not installed."""
    if find_spec("pydrake") is None:
        return {}
    return {"steerable_drake": SteerableInDrake(), "steerable_drake_parts": SteerableInDrake(True)}
