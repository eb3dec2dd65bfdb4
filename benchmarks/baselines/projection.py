"""The nearest places at which convex bodies keep a gap: the non-linear programme of Steerable and MesaTask, by our own solver.

    min Σ_i |p_i − p_i⁰|²   such that   φ_ij(p_i − p_j) ≥ gap for all pairs,   low ≤ p ≤ high

Rotations are fixed, so φ_ij, the signed distance of two convex bodies, is a convex function of p_i − p_j, and its tangent is
nowhere above it. Whatever satisfies the tangents at one iterate therefore satisfies the constraints themselves: every iterate
is the exact solution of a quadratic programme and no step length has to be sought (the convex-concave procedure). The
programme is still not a convex one: which side of each other two bodies end on is decided by where they start.

Constraints may be missed at a price, which is so high that they are missed only where not all of them can be met.
"""

import time
from dataclasses import dataclass, field

import numpy as np
import numpy.typing as npt
from scipy.optimize import nnls

from benchmarks.baselines.hulls import ConvexBodies, Distances
from stable_data.scene import FloatArray, IntArray

_MARGIN = 1e-5  # on top of the gap, metres: bodies that just touch have no normal
_SOFTNESS = 1e-6  # inverse price of missing a constraint
_SMALL_STEP = 1e-5  # metres
_PATIENCE = 30  # iterations without progress; where directions conflict the iterates may go round in a circle
_PROGRESS = 0.99  # what is left of the worst miss, or of the objective, where one iteration was progress


@dataclass(frozen=True, slots=True)
class ProjectionSettings:
    """The programme and when to stop.

    Attributes:
        gap: Least distance of any two bodies, metres.
        influence: Pairs farther apart than this are left out until they come closer, metres.
        tolerance: By how much a constraint may be missed in the end, metres.
        max_iterations: Quadratic programmes at most.
        max_seconds: Processor time.
        rows_per_pair: Constraints of two bodies at a time where they have several parts: the deepest.
    """

    gap: float
    influence: float
    tolerance: float
    max_iterations: int
    max_seconds: float = np.inf
    rows_per_pair: int = 4


@dataclass(frozen=True, slots=True, eq=False)
class Freedom:
    """Where bodies may go.

    Attributes:
        is_free: Coordinates that may change, (N, 3) bool.
        low: Least values of them, (N, 3) float64, metres, −inf for none.
        high: Greatest values, (N, 3) float64, metres, inf for none.
    """

    is_free: npt.NDArray[np.bool_]
    low: FloatArray
    high: FloatArray


@dataclass(frozen=True, slots=True, eq=False)
class ProjectionResult:
    """What :func:`project` found.

    Attributes:
        positions: (N, 3) float64, metres.
        converged: All constraints are met and nothing moves any more.
        missed: By how much the worst constraint is missed, metres.
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
    """The last known normal of each pair, for the moment at which two bodies touch."""

    known: dict[tuple[int, int], FloatArray] = field(default_factory=dict)

    def completed(self, near: Distances, positions: FloatArray) -> FloatArray:
        """The normals (E, 3), none missing."""
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
    bodies: ConvexBodies,
    start: FloatArray,
    freedom: Freedom,
    settings: ProjectionSettings,
    *,
    among: IntArray | None = None,
) -> ProjectionResult:
    """Solves the programme.

    Args:
        bodies: The bodies.
        start: p⁰, (N, 3) float64, metres.
        freedom: Where they may go.
        settings: The programme.
        among: Bodies that are in it, (K,) int64; the others are not there. All where None.

    Returns:
        The nearest places found. Where it did not converge they are the last iterate.
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
            solved = _nearest(near, normals.completed(near, positions), positions, start, is_free, freedom, settings.gap)
        except RuntimeError:  # the solver's own bound on its iterations
            return ProjectionResult(positions, False, missed, iteration, "a quadratic programme was not solved")
        step = float(np.abs(solved - positions).max(initial=0.0))
        is_met = missed <= settings.tolerance
        now = (0.0 if is_met else missed, float(np.square(positions - start).sum()))
        is_progress = now[0] < _PROGRESS * best[0] or (now[0] == best[0] and now[1] < _PROGRESS * best[1])
        best, num_idle = (now, 0) if is_progress else (best, num_idle + 1)
        if step < _SMALL_STEP or num_idle > _PATIENCE:
            reason = "" if is_met else f"bodies remain {1e3 * missed:.2f} mm nearer than they may be"
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
    """The nearest places to the start that satisfy the tangents at the present positions, (N, 3)."""
    num_rows, place = len(near.first), np.arange(start.size).reshape(start.shape)
    rows = np.zeros((num_rows, start.size))
    index = np.arange(num_rows)[:, None]
    rows[index, place[near.first]] = normal
    rows[index, place[near.second]] = -normal
    wanted = gap + _MARGIN - near.distance + rows @ (positions - start).ravel()
    free = place[is_free]
    rows = rows[:, free]
    # What is fixed stays where it starts, so no row asks it for anything.
    identity = np.eye(len(free))
    above, below = (freedom.low - start)[is_free], (start - freedom.high)[is_free]
    is_low, is_high = np.isfinite(above), np.isfinite(below)
    rows = np.concatenate([rows, identity[is_low], -identity[is_high]])
    wanted = np.concatenate([wanted, above[is_low], below[is_high]])
    moved = start.copy()
    moved[is_free] += least_shift(rows, wanted)
    return moved


def least_shift(rows: FloatArray, wanted: FloatArray) -> FloatArray:
    """The shortest y with rows · y ≥ wanted, or nearly so.

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
