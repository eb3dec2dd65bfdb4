"""How well the box of an asset fits the box that is wanted, and the scale that makes it fit.

Proportions are compared by the cosine of the two boxes' edge vectors, as MesaTask does: 1 where one is the other enlarged. One
factor for all axes is the least-squares one, ``s = w·e / e·e``: it is what the cosine measures, for ``|w − s e| = |w| sin``, so
that the asset that scores best is also the one whose box comes nearest. Long edges decide, so a sheet of paper that is wanted
1 mm thick and modelled 5 mm thick keeps its length, where the geometric mean (which is the factor of equal volume) would shrink
it by two fifths. And the diagonal never becomes longer than the wanted one, as it does where the longest edges are made equal.
"""

import numpy as np
import numpy.typing as npt

from stable_data.rotations import rotation_matrix
from stable_data.scene import FloatArray, QuatXyzw, Vec3

_RIGHT_ANGLE = 1e-3  # radians by which a tilt may be off and still take each axis to an axis, for stretching along them
_ORTHOGONAL = 1e-6


def box_proportions(boxes: npt.ArrayLike) -> FloatArray:
    """Boxes as unit vectors, (..., 3) float64.

    Args:
        boxes: Edges along x, y and z, (..., 3), any unit, not all zero.
    """
    edges = np.asarray(boxes, np.float64)
    unit: FloatArray = edges / _diagonal(edges)[..., None]
    return unit


def size_score(one: npt.ArrayLike, other: npt.ArrayLike) -> FloatArray:
    """Cosine of the proportions of boxes, (...) float64 in [0, 1]; scale-free.

    Args:
        one: Unit vectors that :func:`box_proportions` gave, (..., 3).
        other: Likewise; shapes broadcast.
    """
    product = np.asarray(one) * np.asarray(other)
    # Added in this order whatever the shapes are, so that a pair scores the same alone and in a batch.
    score: FloatArray = np.minimum(product[..., 0] + product[..., 1] + product[..., 2], 1.0)
    return score


def uniform_scale_factor(wanted: npt.ArrayLike, boxes: npt.ArrayLike) -> FloatArray:
    """The factor that brings boxes nearest to the wanted ones, (...) float64, positive.

    Where the two share no edge at all, such as a needle laid across another, the factor that makes their diagonals equal.

    Args:
        wanted: Metres, (..., 3).
        boxes: Mesh units, (..., 3).
    """
    w, e = np.asarray(wanted, np.float64), np.asarray(boxes, np.float64)
    cosine = size_score(box_proportions(w), box_proportions(e))
    factor: FloatArray = _diagonal(w) / _diagonal(e) * np.where(cosine > _ORTHOGONAL, cosine, 1.0)
    return factor


def stretched_scale(wanted: Vec3, box: Vec3, tilt_quat_xyzw: QuatXyzw) -> tuple[Vec3 | None, float]:
    """Scale along the mesh's own axes that makes the tilted box the wanted one, and how much it distorts.

    Args:
        wanted: Metres, yaw frame.
        box: Box of the tilted mesh, mesh units, yaw frame.
        tilt_quat_xyzw: Rotation before yaw, unit.

    Returns:
        Metres per mesh unit, or None where the tilt is by no right angles or an edge is zero; and the largest component over the
        smallest, infinite for None.
    """
    turn = np.abs(rotation_matrix(tilt_quat_xyzw))
    if min(wanted) <= 0 or min(box) <= 0 or turn.max(axis=1).min() < np.cos(_RIGHT_ANGLE):
        return None, np.inf
    factors = np.divide(wanted, box)
    x, y, z = factors[turn.argmax(axis=0)].tolist()  # mesh axis j is the box's axis argmax_i |R_ij|
    return (x, y, z), float(factors.max() / factors.min())


def _diagonal(boxes: FloatArray) -> FloatArray:
    """Lengths of boxes' diagonals, (...)."""
    largest = boxes.max(axis=-1)
    edges = boxes / largest[..., None]  # first, so that squares of very small and very large edges stay numbers
    lengths: FloatArray = largest * np.sqrt((edges * edges).sum(axis=-1))
    return lengths
