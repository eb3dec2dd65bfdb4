"""How well the box of an asset fits a requested box, and the scale that makes it fit.

The score is the cosine of the two edge vectors, as in MesaTask; it is 1 if the boxes have the same proportions. The uniform
scale is the least-squares factor ``s = w·e / e·e``. It agrees with the cosine, since ``|w − s e| = |w| sin``: the asset with the
best score also has the nearest box. Long edges have the most influence, so a sheet of paper with a requested thickness of 1 mm
and a modelled one of 5 mm keeps its length; the geometric mean (the factor of equal volume) would shrink it by two fifths. The
diagonal never becomes longer than the requested one, unlike with the factor that makes the longest edges equal.
"""

import numpy as np
import numpy.typing as npt

from stable_data.rotations import rotation_matrix
from stable_data.scene import FloatArray, QuatXyzw, Vec3

_RIGHT_ANGLE = 1e-3  # radians by which a tilt may differ from a right-angled one and still be stretched along the axes
_ORTHOGONAL = 1e-6  # cosine up to which two boxes have no edge in common


def box_proportions(boxes: npt.ArrayLike) -> FloatArray:
    """Returns the edge vectors of boxes as unit vectors, (..., 3) float64.

    Args:
        boxes: Edges along x, y and z, (..., 3), any unit, not all zero.
    """
    edges = np.asarray(boxes, np.float64)
    unit: FloatArray = edges / diagonal(edges)[..., None]
    return unit


def size_score(one: npt.ArrayLike, other: npt.ArrayLike) -> FloatArray:
    """Computes the cosine of the proportions of boxes, (...) float64 in [0, 1]; it does not depend on scale.

    Args:
        one: Unit vectors of :func:`box_proportions`, (..., 3).
        other: Unit vectors of :func:`box_proportions`; shapes broadcast.
    """
    product = np.asarray(one) * np.asarray(other)
    # One order of addition for all shapes, so that a pair has the same score alone and in a batch.
    score: FloatArray = np.minimum(product[..., 0] + product[..., 1] + product[..., 2], 1.0)
    return score


def uniform_scale_factor(wanted: npt.ArrayLike, boxes: npt.ArrayLike) -> FloatArray:
    """Computes the factor that scales boxes nearest to requested boxes, (...) float64, positive.

    If the two have no edge in common, such as two needles along different axes, the factor makes their diagonals equal.

    Args:
        wanted: Metres, (..., 3).
        boxes: Mesh units, (..., 3).
    """
    w, e = np.asarray(wanted, np.float64), np.asarray(boxes, np.float64)
    return scale_factor(diagonal(w) / diagonal(e), size_score(box_proportions(w), box_proportions(e)))


def scale_factor(ratio: FloatArray, cosine: FloatArray) -> FloatArray:
    """Computes the factor of :func:`uniform_scale_factor` from the ratio of the diagonals, requested by own, and the cosine, (...)."""
    factor: FloatArray = ratio * np.where(cosine > _ORTHOGONAL, cosine, 1.0)
    return factor


def turned_box(box: Vec3) -> Vec3:
    """Returns a box that is turned by 90 degrees about z."""
    return box[1], box[0], box[2]


def stretched_scale(wanted: Vec3, box: Vec3, tilt_quat_xyzw: QuatXyzw) -> tuple[Vec3 | None, float]:
    """Computes the scale along the mesh axes that gives the tilted mesh a requested box, and its distortion.

    Args:
        wanted: Metres, yaw frame.
        box: Box of the tilted mesh, mesh units, yaw frame.
        tilt_quat_xyzw: Rotation before yaw, unit.

    Returns:
        Metres per mesh unit, or None if the tilt is not right-angled or an edge is zero; and the ratio of the largest and the
        smallest component, infinite for None.
    """
    turn = np.abs(rotation_matrix(tilt_quat_xyzw))
    if min(wanted) <= 0 or min(box) <= 0 or turn.max(axis=1).min() < np.cos(_RIGHT_ANGLE):
        return None, np.inf
    factors = np.divide(wanted, box)
    x, y, z = factors[turn.argmax(axis=0)].tolist()  # mesh axis j is the box's axis argmax_i |R_ij|
    return (x, y, z), float(factors.max() / factors.min())


def diagonal(boxes: FloatArray) -> FloatArray:
    """Computes the lengths of the diagonals of boxes (..., 3), (...) float64."""
    largest = boxes.max(axis=-1)
    edges = boxes / largest[..., None]  # so that the squares neither underflow nor overflow
    lengths: FloatArray = largest * np.sqrt((edges * edges).sum(axis=-1))
    return lengths
