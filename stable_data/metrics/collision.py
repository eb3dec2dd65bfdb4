"""Object-object collision: the smallest translation that parts two meshes that cross or nest."""

import itertools

import numpy as np

from stable_data.mesh import Mesh, is_closed
from stable_data.metrics.crossing import MeshPair, Surface
from stable_data.scene import FloatArray
from stable_data.shape import winding_number

_axes = np.array([d for d in itertools.product((-1.0, 0.0, 1.0), repeat=3) if any(d)])
DIRECTIONS: FloatArray = _axes / np.linalg.norm(_axes, axis=1, keepdims=True)
"""The 26 fixed directions along which a pair may be parted, (26, 3) float64, unit, world frame."""

LEVELS = (1e-5, 5e-4, 1e-3, 2e-3, 3e-3, 5e-3, 1e-2, 2e-2, 5e-2)
"""Translations that are tried outright, metres; every tolerance that is reported is among them."""

DEEPEST = 0.1
"""What is reported for a pair that none of LEVELS parts, metres."""

NEAR = 5e-4
"""Margin of the pair that a depth search starts with, metres: the first levels, and the lowering of the support check."""

_RESOLUTION = 0.02  # of the depth itself
_ALIKE = 0.1  # normals that differ by less, about 6 degrees, part a pair at depths that differ by less than the resolution

def penetration(a: FloatArray | Surface, b: FloatArray | Surface, pair: MeshPair | None = None) -> float:
    """How deep two meshes are in each other (DESIGN section 7).

    Zero when they neither cross nor nest; else the smallest translation along a contact normal or one of 26 fixed directions
    that parts them. Tested at LEVELS, then refined between them to 2 %.

    Args:
        a: Triangles of one object, (F, 3, 3) float64, metres, world frame.
        b: Triangles of the other, (G, 3, 3).
        pair: The two as a pair with a margin of NEAR, where there is one already.

    Returns:
        Depth, metres; DEEPEST where nothing up to 50 mm parts them, and for a mesh inside a solid.
    """
    a, b = (x if isinstance(x, Surface) else Surface(x) for x in (a, b))
    pair = pair or MeshPair(a, b, NEAR)
    contact = pair.contact()
    if contact is None:
        return DEEPEST if nested(a, b) or nested(b, a) else 0.0
    directions = _directions(contact.normals)
    below, reach = 0.0, NEAR
    for level in LEVELS:
        if level > reach:
            reach = LEVELS[-1]
            pair = MeshPair(a, b, reach)
        depth = _parting(pair, directions, below, level)
        if depth is not None:
            return depth
        below = level
    return DEEPEST


def _directions(normals: FloatArray) -> FloatArray:
    """The fixed directions, then both ways along contact normals; of normals nearly alike one stands for all."""
    both = np.concatenate([normals, -normals])
    _, first = np.unique(np.round(both / _ALIKE), axis=0, return_index=True)
    return np.concatenate([DIRECTIONS, both[np.sort(first)]])


def _parting(pair: MeshPair, directions: FloatArray, below: float, level: float) -> float | None:
    """Smallest translation up to a level that parts a pair, to 2 %, or None; none of ``below`` does."""
    best = None
    for number, direction in enumerate(directions):
        if best is not None and best <= LEVELS[0]:
            break  # touching, and no more
        wanted = level if best is None else best * (1 - _RESOLUTION)  # what gains less is not looked for
        if wanted <= below or pair.cross(wanted * direction, number):
            continue
        low, best = below, wanted
        while best > LEVELS[0] and best - low > _RESOLUTION * best:
            middle = (low + best) / 2
            low, best = (middle, best) if pair.cross(middle * direction, number) else (low, middle)
    return best


def nested(inner: FloatArray | Surface, outer: FloatArray | Surface) -> bool:
    """Does one mesh lie wholly inside the solid that another one bounds, without crossing it?

    An open mesh bounds none: a die at the bottom of a vase without thickness is not inside its wall.

    Args:
        inner: Triangles, (F, 3, 3) float64, metres, world frame.
        outer: Triangles, (G, 3, 3).
    """
    inner, outer = (x if isinstance(x, Surface) else Surface(x) for x in (inner, outer))
    if (inner.box[0] < outer.box[0] - 1e-9).any() or (inner.box[1] > outer.box[1] + 1e-9).any():
        return False
    if abs(winding_number(inner.triangles[0, :1], outer.triangles)[0]) <= 0.5:
        return False
    vertices, faces = np.unique(outer.triangles.reshape(-1, 3), axis=0, return_inverse=True)
    return is_closed(Mesh(vertices, faces.reshape(-1, 3)))
