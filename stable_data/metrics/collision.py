"""Collision of two objects: the smallest translation that separates two meshes that cross or nest."""

import itertools
import math

import numpy as np

from stable_data.geometry.mesh import Mesh, is_closed
from stable_data.geometry.shape import winding_number
from stable_data.metrics.triangle_intersection import MeshPair, PosedTriangles, posed_triangles
from stable_data.metrics.verdicts import ROUNDING, TOLERANCE
from stable_data.scene import FloatArray

_axes = np.array([d for d in itertools.product((-1.0, 0.0, 1.0), repeat=3) if any(d)])
DIRECTIONS: FloatArray = _axes / np.linalg.norm(_axes, axis=1, keepdims=True)
"""The 26 fixed directions along which a pair may be separated, (26, 3) float64, unit, world frame."""

LEVELS = (1e-5, TOLERANCE, 1e-3, 2e-3, 3e-3, 5e-3, 1e-2, 2e-2, 5e-2)
"""Translations that are tested directly, metres; every reported tolerance is among them."""

DEEPEST = 0.1
"""The depth that is reported for a pair that no level of LEVELS separates, metres."""

NEAR = TOLERANCE + ROUNDING
"""Margin of the pair with which a depth search starts, metres. It covers the levels up to the tolerance and the lowering of the
support check."""

_RESOLUTION = 0.02  # relative to the depth
_PROBES, _PROMISING = 1000, 8  # corners that rank directions; number of directions with an exact bound
_NESTING_WORK = 4  # work of one triangle in the nesting test, in triangles tested for a crossing
_ALIKE = 0.1  # normals that differ by less, about 6 degrees, give depths that differ by less than the resolution


def penetration(
    a: FloatArray | PosedTriangles, b: FloatArray | PosedTriangles, pair: MeshPair | None = None, most: float = LEVELS[-1]
) -> float:
    """Computes how deep two meshes are in each other (docs/audit.md).

    The depth is zero if they neither cross nor nest. Else it is the smallest translation that separates them along a contact
    normal or one of 26 fixed directions. It is tested at LEVELS, then refined between two levels to 2 %.

    Args:
        a: Triangles of one object, (F, 3, 3) float64, metres, world frame.
        b: Triangles of the other object, (G, 3, 3).
        pair: The two meshes as a pair with a margin of NEAR, if it exists already. All work is counted in its budget.
        most: Depths over this one, metres, need not be measured.

    Returns:
        Depth, metres; DEEPEST if no translation up to 50 mm separates them, and for a mesh inside a solid; infinite if it is
        over ``most`` and was not measured.

    Raises:
        WorkLimitError: The work limit of the pair is reached.
    """
    first, second = posed_triangles(a), posed_triangles(b)
    pair = pair or MeshPair(first, second, NEAR)
    contact = pair.contact()
    if contact is None:
        pair.budget.spend(_NESTING_WORK * (len(first.triangles) + len(second.triangles)))
        return DEEPEST if is_nested(first, second) or is_nested(second, first) else 0.0
    directions = _directions(contact.normals)
    below, bound = 0.0, np.inf
    for level in LEVELS:
        if below >= most:
            return math.inf
        if below == TOLERANCE:  # the limit of the first pair's margin
            pair = MeshPair(first, second, LEVELS[-1] + ROUNDING, pair.budget)
            directions, bound = _rank_directions(first, second, directions)
        depth = _smallest_translation(pair, directions, below, level, bound)
        if depth is not None:
            return depth
        below = level
    return DEEPEST


def _directions(normals: FloatArray) -> FloatArray:
    """The fixed directions, then both directions of each contact normal; of nearly equal normals only the first is used."""
    both = np.concatenate([normals, -normals])
    _, first = np.unique(np.round(both / _ALIKE), axis=0, return_index=True)
    return np.concatenate([DIRECTIONS, both[np.sort(first)]])


def _rank_directions(a: PosedTriangles, b: PosedTriangles, directions: FloatArray) -> tuple[FloatArray, float]:
    """Sorts directions, most promising first, and gives a distance that certainly separates two meshes: by a plane between them.

    For convex objects this distance is the depth, found without a query of a bounding-volume tree.
    """
    rough_a, rough_b = (directions @ surface.triangles[:: max(1, len(surface.triangles) // _PROBES), 0].T for surface in (a, b))
    directions = directions[np.argsort(rough_b.max(axis=1) - rough_a.min(axis=1), kind="stable")]
    first_a, first_b = (directions[:_PROMISING] @ surface.triangles.reshape(-1, 3).T for surface in (a, b))
    # The margin keeps rounding from leaving the meshes in contact at this distance.
    return directions, float((first_b.max(axis=1) - first_a.min(axis=1)).min()) + 1e-7


def _smallest_translation(pair: MeshPair, directions: FloatArray, below: float, level: float, bound: float) -> float | None:
    """The smallest translation up to ``level`` that separates a pair, to 2 %, or None. ``below`` does not separate it, ``bound`` does."""
    best = bound if bound <= level else None
    for number, direction in enumerate(directions):
        if best is not None and best <= LEVELS[0]:
            break  # the meshes only touch
        tried = level if best is None else best * (1 - _RESOLUTION)  # smaller gains are within the resolution
        if tried <= below or pair.cross((tried + ROUNDING) * direction, number):
            continue
        low, best = below, tried
        while best > LEVELS[0] and best - low > _RESOLUTION * best:
            middle = (low + best) / 2
            low, best = (middle, best) if pair.cross(middle * direction, number) else (low, middle)
    return best


def is_nested(inner: FloatArray | PosedTriangles, outer: FloatArray | PosedTriangles) -> bool:
    """Returns whether one mesh is wholly inside the solid that another mesh bounds, without crossing it.

    An open mesh bounds no solid: a die at the bottom of a vase without wall thickness is not nested.

    Args:
        inner: Triangles, (F, 3, 3) float64, metres, world frame.
        outer: Triangles, (G, 3, 3).
    """
    inside, outside = posed_triangles(inner), posed_triangles(outer)
    # The box and the winding number are cheap tests; whether the mesh is closed is tested last.
    if (inside.box[0] < outside.box[0] - 1e-9).any() or (inside.box[1] > outside.box[1] + 1e-9).any():
        return False
    # The meshes do not cross, so one vertex decides for all.
    if abs(winding_number(inside.triangles[0, :1], outside.triangles)[0]) <= 0.5:
        return False
    vertices, faces = np.unique(outside.triangles.reshape(-1, 3), axis=0, return_inverse=True)
    return is_closed(Mesh(vertices, faces.reshape(-1, 3)))
