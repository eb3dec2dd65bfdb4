"""Object-object collision: the smallest translation that parts two meshes that cross or nest."""

import itertools

import numpy as np

from stable_data.geometry.mesh import Mesh, is_closed
from stable_data.geometry.shape import winding_number
from stable_data.metrics.triangle_intersection import MeshPair, PosedTriangles, posed_triangles
from stable_data.scene import FloatArray

_axes = np.array([d for d in itertools.product((-1.0, 0.0, 1.0), repeat=3) if any(d)])
DIRECTIONS: FloatArray = _axes / np.linalg.norm(_axes, axis=1, keepdims=True)
"""The 26 fixed directions along which a pair may be parted, (26, 3) float64, unit, world frame."""

TOLERANCE = 5e-4
"""The headline tolerance of collision, table penetration and floating, metres."""

ROUNDING = 1e-9
"""What every comparison with a tolerance lets pass besides, metres: layouts are written to half a millimetre, and a sum of such
lengths that is the tolerance itself comes out a little above or below it."""

LEVELS = (1e-5, TOLERANCE, 1e-3, 2e-3, 3e-3, 5e-3, 1e-2, 2e-2, 5e-2)
"""Translations that are tried outright, metres; every tolerance that is reported is among them."""

DEEPEST = 0.1
"""What is reported for a pair that none of LEVELS parts, metres."""

NEAR = TOLERANCE + ROUNDING
"""Margin of the pair that a depth search starts with, metres: the levels up to the tolerance, and the support check's lowering."""

_RESOLUTION = 0.02  # of the depth itself
_PROBES, _PROMISING = 1000, 8  # corners that rank directions; directions of which the bound is taken exactly
_NESTING_WORK = 4  # triangles that take as long as one whose mesh may be nested
_ALIKE = 0.1  # normals that differ by less, about 6 degrees, part a pair at depths that differ by less than the resolution


def penetration(a: FloatArray | PosedTriangles, b: FloatArray | PosedTriangles, pair: MeshPair | None = None) -> float:
    """How deep two meshes are in each other (docs/audit.md).

    Zero when they neither cross nor nest; else the smallest translation along a contact normal or one of 26 fixed directions
    that parts them. Tested at LEVELS, then refined between them to 2 %.

    Args:
        a: Triangles of one object, (F, 3, 3) float64, metres, world frame.
        b: Triangles of the other, (G, 3, 3).
        pair: The two as a pair with a margin of NEAR, where there is one already. All work is counted against its budget.

    Returns:
        Depth, metres; DEEPEST where nothing up to 50 mm parts them, and for a mesh inside a solid.

    Raises:
        WorkLimitError: The pair's budget is used up.
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
        if below == TOLERANCE:  # as far as the pair's margin goes
            pair = MeshPair(first, second, LEVELS[-1] + ROUNDING, pair.budget)
            directions, bound = _parted_surely(first, second, directions)
        depth = _parting(pair, directions, below, level, bound)
        if depth is not None:
            return depth
        below = level
    return DEEPEST


def _directions(normals: FloatArray) -> FloatArray:
    """The fixed directions, then both ways along contact normals; of normals nearly alike one stands for all."""
    both = np.concatenate([normals, -normals])
    _, first = np.unique(np.round(both / _ALIKE), axis=0, return_index=True)
    return np.concatenate([DIRECTIONS, both[np.sort(first)]])


def _parted_surely(a: PosedTriangles, b: PosedTriangles, directions: FloatArray) -> tuple[FloatArray, float]:
    """The directions, most promising first, and a distance that surely parts two meshes: where a plane fits between them.

    For convex objects that is the depth itself, found without one question to a tree.
    """
    rough_a, rough_b = (directions @ surface.triangles[:: max(1, len(surface.triangles) // _PROBES), 0].T for surface in (a, b))
    directions = directions[np.argsort(rough_b.max(axis=1) - rough_a.min(axis=1), kind="stable")]
    first_a, first_b = (directions[:_PROMISING] @ surface.triangles.reshape(-1, 3).T for surface in (a, b))
    return directions, float((first_b.max(axis=1) - first_a.min(axis=1)).min()) + 1e-7


def _parting(pair: MeshPair, directions: FloatArray, below: float, level: float, bound: float) -> float | None:
    """Smallest translation up to a level that parts a pair, to 2 %, or None; none of ``below`` does, one of ``bound`` does."""
    best = bound if bound <= level else None
    for number, direction in enumerate(directions):
        if best is not None and best <= LEVELS[0]:
            break  # touching, and no more
        wanted = level if best is None else best * (1 - _RESOLUTION)  # what gains less is not looked for
        if wanted <= below or pair.cross((wanted + ROUNDING) * direction, number):
            continue
        low, best = below, wanted
        while best > LEVELS[0] and best - low > _RESOLUTION * best:
            middle = (low + best) / 2
            low, best = (middle, best) if pair.cross(middle * direction, number) else (low, middle)
    return best


def is_nested(inner: FloatArray | PosedTriangles, outer: FloatArray | PosedTriangles) -> bool:
    """Does one mesh lie wholly inside the solid that another one bounds, without crossing it?

    An open mesh bounds none: a die at the bottom of a vase without thickness is not inside its wall.

    Args:
        inner: Triangles, (F, 3, 3) float64, metres, world frame.
        outer: Triangles, (G, 3, 3).
    """
    inside, outside = posed_triangles(inner), posed_triangles(outer)
    if (inside.box[0] < outside.box[0] - 1e-9).any() or (inside.box[1] > outside.box[1] + 1e-9).any():
        return False
    if abs(winding_number(inside.triangles[0, :1], outside.triangles)[0]) <= 0.5:
        return False
    vertices, faces = np.unique(outside.triangles.reshape(-1, 3), axis=0, return_inverse=True)
    return is_closed(Mesh(vertices, faces.reshape(-1, 3)))
