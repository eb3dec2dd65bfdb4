"""Nearest positions of convex bodies with a gap: the non-linear programme of Steerable and MesaTask, by our own solver.

    min Σ_i |p_i − p_i⁰|²   such that   φ_ij(p_i − p_j) ≥ gap for all pairs,   low ≤ p ≤ high

Rotations are fixed, so φ_ij, the signed distance of two convex bodies, is a convex function of p_i − p_j, and is nowhere below
its tangent. Positions that satisfy the tangents at one iterate therefore satisfy the constraints themselves: every iterate is the
exact solution of a quadratic programme, without a search for a step length (the convex-concave procedure). The programme is still
not convex: the start decides on which side of each other two bodies end.

A constraint may be violated at a price. The price is so high that this happens only if not all constraints can be met.
"""

import time
from dataclasses import dataclass, field

import numpy as np
import numpy.typing as npt
from scipy.optimize import nnls

from models.baselines.hulls import ConvexBodies, Distances
from stable_data.scene import FloatArray, IntArray

_MARGIN = 1e-5  # added to the gap, metres: bodies that just touch have no normal
_SOFTNESS = 1e-6  # inverse price of violating a constraint
_SMALL_STEP = 1e-5  # metres
_PATIENCE = 30  # iterations without progress before the end: with conflicting directions the iterates may cycle
_PROGRESS = 0.99  # an iteration is progress if the worst violation, or the objective, falls below this share


@dataclass(frozen=True, slots=True)
class ProjectionSettings:
    """The programme and when to stop.

    Attributes:
        gap: Least distance of any two bodies, metres.
        influence: Pairs farther apart than this are left out, metres.
        tolerance: Allowed violation of a constraint at the end, metres.
        max_iterations: Largest number of quadratic programmes.
        max_seconds: Limit of processor time.
        rows_per_pair: Largest number of constraints of two bodies of several parts: the deepest ones.
    """

    gap: float
    influence: float
    tolerance: float
    max_iterations: int
    max_seconds: float = np.inf
    rows_per_pair: int = 4


@dataclass(frozen=True, slots=True, eq=False)
class Freedom:
    """Bounds of the positions of bodies.

    Attributes:
        is_free: Coordinates that may change, (N, 3) bool.
        low: Least values, (N, 3) float64, metres, −inf for no bound.
        high: Greatest values, (N, 3) float64, metres, inf for no bound.
    """

    is_free: npt.NDArray[np.bool_]
    low: FloatArray
    high: FloatArray


@dataclass(frozen=True, slots=True, eq=False)
class ProjectionResult:
    """The result of :func:`project`.

    Attributes:
        positions: (N, 3) float64, metres.
        converged: Whether all constraints are met and no body moves any more.
        missed: The worst violation of a constraint, metres.
        num_iterations: Quadratic programmes solved.
        reason: Why it did not converge.
    """

    positions: FloatArray
    converged: bool
    missed: float
    num_iterations: int
    reason: str = ""


@dataclass(slots=True)
class _Normals:
    """The last known normal of each pair, for use while two bodies touch."""

    known: dict[tuple[int, int], FloatArray] = field(default_factory=dict)

    def fill_missing(self, near: Distances, positions: FloatArray) -> FloatArray:
        """Returns the normals (E, 3), with missing ones filled in."""
        normal = near.normal.copy()
        for k, pair in enumerate(zip(near.first.tolist(), near.second.tolist(), strict=True)):
            if np.isnan(normal[k, 0]):
                apart = positions[pair[0]] - positions[pair[1]]
                up = np.array([0.0, 0.0, 1.0])
                length = float(np.linalg.norm(apart))
                normal[k] = self.known.get(pair, apart / length if length > 0 else up)
            self.known[pair] = normal[k]
        return normal


def project(
    bodies: ConvexBodies, start: FloatArray, freedom: Freedom, settings: ProjectionSettings, *, among: IntArray | None = None
) -> ProjectionResult:
    """Solves the programme.

    Args:
        bodies: The bodies.
        start: p⁰, (N, 3) float64, metres.
        freedom: Bounds of the positions.
        settings: The programme.
        among: Bodies of the programme, (K,) int64; the others are ignored. None: all.

    Returns:
        The positions found; the last iterate if it did not converge.
    """
    end = time.process_time() + settings.max_seconds
    is_free = freedom.is_free
    if among is not None:
        is_free = is_free & np.isin(np.arange(len(start)), among)[:, None]
    normals, positions, reach = _Normals(), start.copy(), max(settings.influence, settings.gap + 2 * _MARGIN)
    missed, best, num_idle = np.inf, (np.inf, np.inf), 0
    for iteration in range(settings.max_iterations):
        near = bodies.distances(positions, reach, among)
        outside = np.maximum(freedom.low - positions, positions - freedom.high)[is_free].max(initial=0.0)
        missed = max(float(outside), float((settings.gap - near.distance).max(initial=0.0)))
        if time.process_time() > end:
            return ProjectionResult(positions, False, missed, iteration, f"out of time after {settings.max_seconds:g} s")
        near = near.deepest(settings.rows_per_pair)
        try:
            solved = _nearest(near, normals.fill_missing(near, positions), positions, start, is_free, freedom, settings.gap)
        except RuntimeError:  # the solver reached its own limit of iterations
            return ProjectionResult(positions, False, missed, iteration, "a quadratic programme was not solved")
        step = float(np.abs(solved - positions).max(initial=0.0))
        is_met = missed <= settings.tolerance
        now = (0.0 if is_met else missed, float(np.square(positions - start).sum()))
        is_progress = now[0] < _PROGRESS * best[0] or (now[0] == best[0] and now[1] < _PROGRESS * best[1])
        best, num_idle = (now, 0) if is_progress else (best, num_idle + 1)
        if step < _SMALL_STEP or num_idle > _PATIENCE:
            reason = "" if is_met else f"bodies remain {1e3 * missed:.2f} mm nearer than allowed"
            return ProjectionResult(positions, is_met, missed, iteration, reason)
        positions, reach = solved, max(settings.influence, settings.gap + 2 * _MARGIN, 2 * step)
    return ProjectionResult(
        positions, False, missed, settings.max_iterations, f"still moving after {settings.max_iterations} iterations"
    )


def _nearest(
    near: Distances,
    normal: FloatArray,
    positions: FloatArray,
    start: FloatArray,
    is_free: npt.NDArray[np.bool_],
    freedom: Freedom,
    gap: float,
) -> FloatArray:
    """Returns the positions nearest to the start that satisfy the tangents at the present positions, (N, 3)."""
    num_rows, place = len(near.first), np.arange(start.size).reshape(start.shape)
    rows = np.zeros((num_rows, start.size))
    index = np.arange(num_rows)[:, None]
    rows[index, place[near.first]] = normal
    rows[index, place[near.second]] = -normal
    wanted = gap + _MARGIN - near.distance + rows @ (positions - start).ravel()
    free = place[is_free]
    rows = rows[:, free]
    # Fixed coordinates keep their start value, so their columns are left out.
    identity = np.eye(len(free))
    above, below = (freedom.low - start)[is_free], (start - freedom.high)[is_free]
    is_low, is_high = np.isfinite(above), np.isfinite(below)
    rows = np.concatenate([rows, identity[is_low], -identity[is_high]])
    wanted = np.concatenate([wanted, above[is_low], below[is_high]])
    moved = start.copy()
    moved[is_free] += least_shift(rows, wanted)
    return moved


def least_shift(rows: FloatArray, wanted: FloatArray) -> FloatArray:
    """Computes the shortest y with rows · y ≥ wanted, or nearly so.

    Args:
        rows: A, (M, D) float64.
        wanted: b, (M,) float64.

    Returns:
        argmin |y|² + |s|² / softness with A y + s ≥ b, (D,) float64, from its dual, a non-negative least-squares problem.

    Raises:
        RuntimeError: The solver ran out of iterations.
    """
    if not (wanted > 0).any():
        return np.zeros(rows.shape[1])
    root = np.linalg.cholesky(rows @ rows.T + _SOFTNESS * np.eye(len(rows)))
    price, _ = nnls(root.T, np.linalg.solve(root, wanted), maxiter=30 * len(rows))
    shift: FloatArray = rows.T @ price
    return shift
