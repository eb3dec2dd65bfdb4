"""Shapes as stacks of convex slabs, for bodies that only shift on the table.

A slab is a range of heights with a convex outline that contains the mesh in this range, stored as supporting half-planes. If the
outlines of two bodies are apart, so are their meshes. The shifts at which two convex outlines meet form one convex polygon (the
no-fit polygon: the Minkowski sum of one and the mirrored other), bounded by the half-planes of both.
"""

import itertools
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import TypeAlias
from weakref import WeakKeyDictionary

import numpy as np
import numpy.typing as npt
import shapely

from stable_data.geometry.shape import Shape
from stable_data.rotations import rotate_xy
from stable_data.scene import FloatArray

BoolArray: TypeAlias = npt.NDArray[np.bool_]

NUM_SIDES = 28
"""Number of half-planes of an outline."""

NUM_AROUND = 16
"""Number of these with evenly spaced normals."""

_LEVELS = np.array([0.0, 0.006, 0.012, 0.025, 0.05, 0.1, 0.2, 0.4, np.inf])  # heights at which shapes are cut, metres
_LONG = 0.03  # an edge longer than this share of the circumference has its own half-plane
_ALIKE = 1e-3  # neighbouring slabs whose outlines differ by less are merged, metres
_EVENLY = 2 * np.pi * np.arange(NUM_AROUND) / NUM_AROUND  # angles of the evenly spaced normals
_DIRECTIONS = np.stack([np.cos(_EVENLY), np.sin(_EVENLY)])  # the same as unit vectors, (2, NUM_AROUND)


@dataclass(frozen=True, eq=False)
class SlabOutline:
    """Convex outlines by height.

    Attributes:
        normals: Outward normals of the half-planes, (S, M, 2), unit, sorted counter-clockwise.
        offsets: Their distances from the origin, (S, M), metres.
        bottoms: Lower bound of each slab, (S,), metres.
        tops: Upper bound of each slab, (S,), metres.
        is_within: Whether the outline of each slab is within that of each other, (S, S); of two equal ones the first is in the
            second.
    """

    normals: FloatArray
    offsets: FloatArray
    bottoms: FloatArray
    tops: FloatArray
    is_within: BoolArray

    @cached_property
    def corners(self) -> FloatArray:
        """The intersections of neighbouring half-planes, (S, M, 2), metres."""
        following, next_offsets = np.roll(self.normals, -1, axis=1), np.roll(self.offsets, -1, axis=1)
        cross = self.normals[..., 0] * following[..., 1] - self.normals[..., 1] * following[..., 0]
        cross = np.where(np.abs(cross) < 1e-6, np.inf, cross)
        x = (self.offsets * following[..., 1] - next_offsets * self.normals[..., 1]) / cross
        y = (next_offsets * self.normals[..., 0] - self.offsets * following[..., 0]) / cross
        corners = np.stack([x, y], axis=-1)
        repeated = np.isinf(cross)
        if repeated.any():  # two neighbours with the same normal have no intersection: repeat the corner before
            for s, m in np.argwhere(repeated):
                back = next(b for b in range(1, NUM_SIDES) if not repeated[s, m - b])
                corners[s, m] = corners[s, m - back]
        return corners

    @cached_property
    def box(self) -> tuple[FloatArray, FloatArray]:
        """The lowest and the highest corner seen from above, two (2,), metres."""
        return self.corners.min(axis=(0, 1)), self.corners.max(axis=(0, 1))

    def transformed(self, yaw: float, offset: FloatArray) -> "SlabOutline":
        """Returns the slabs, turned by a yaw and moved by a vector (3,), metres."""
        normals = rotate_xy(self.normals, yaw)
        return SlabOutline(
            normals, self.offsets + normals @ offset[:2], self.bottoms + offset[2], self.tops + offset[2], self.is_within
        )


_slabs: "WeakKeyDictionary[Shape, SlabOutline]" = WeakKeyDictionary()


def slabs_of(shape: Shape) -> SlabOutline:
    """Returns the slabs of a shape in its yaw frame, its bottom at height 0; computed once for a shape."""
    if shape not in _slabs:
        _slabs[shape] = _cut_slabs(shape)
    return _slabs[shape]


def join_outlines(stacks: Sequence[SlabOutline]) -> SlabOutline:
    """Returns the slabs of several shapes that move as one."""
    if len(stacks) == 1:
        return stacks[0]
    outlines: list[FloatArray] = []
    ranges = []
    bounds = sorted({float(z) for stack in stacks for z in (*stack.bottoms, *stack.tops)})
    for low, high in itertools.pairwise(bounds):
        points = [s.corners[k] for s in stacks for k in np.nonzero((s.bottoms < high - 1e-9) & (s.tops > low + 1e-9))[0]]
        if points:
            outlines.append(np.concatenate(points))
            ranges.append((low, high))
    return _merge_slabs(outlines, ranges)


def rectangle(low: FloatArray, high: FloatArray) -> SlabOutline:
    """Returns a prism of infinite height over a rectangle with the corners ``low`` and ``high``, (2,) metres."""
    corners = np.array([low, (high[0], low[1]), high, (low[0], high[1])])
    return _merge_slabs([corners], [(-np.inf, np.inf)])


def _cut_slabs(shape: Shape) -> SlabOutline:
    bottom = -float(shape.size[2]) / 2
    vertices, height = shape.vertices, float(shape.size[2])
    levels = np.append(_LEVELS[height - 1e-6 > _LEVELS], height) if height > 1e-6 else np.array([0.0, 1e-6])
    used = np.zeros(len(vertices), bool)
    used[shape.faces] = True
    z, flat = vertices[:, 2] - bottom, vertices[:, :2]
    rings = [_crossings(shape, z, level) for level in levels[1:-1]]
    outlines, ranges = [], []
    for n, (low, high) in enumerate(itertools.pairwise(levels)):
        points = [flat[used & (z >= low - 1e-9) & (z <= high + 1e-9)]]
        points += rings[max(0, n - 1) : n + 1]  # the sections at the lower and at the upper bound of the slab
        cloud = np.concatenate(points)
        if len(cloud):
            outlines.append(_hull_candidates(cloud))
            ranges.append((float(low), float(high)))
    return _merge_slabs(outlines, ranges)


def _crossings(shape: Shape, z: FloatArray, level: float) -> FloatArray:
    """Returns the points at which the edges of a mesh cross a height, (K, 2), metres."""
    above = z > level
    i, j, k = (above[column] for column in shape.faces.T)
    mixed = shape.faces[(i != j) | (j != k)]
    first, second = mixed[:, [0, 1, 2]].ravel(), mixed[:, [1, 2, 0]].ravel()
    passing = above[first] != above[second]
    first, second = first[passing], second[passing]
    share = ((level - z[first]) / (z[second] - z[first]))[:, None]
    return np.asarray(shape.vertices[first, :2] * (1 - share) + shape.vertices[second, :2] * share)


def _hull_candidates(points: FloatArray) -> FloatArray:
    """Returns the points of a cloud (K, 2) that may lie on its hull: those outside a polygon of extreme points."""
    if len(points) < 64:
        return points
    along = points @ _DIRECTIONS
    picked = points[along.argmax(axis=0)]
    edges = np.roll(picked, -1, axis=0) - picked
    normals = np.stack([edges[:, 1], -edges[:, 0]])
    beyond = (points @ normals - (picked * normals.T).sum(axis=1)) >= -1e-12 * np.abs(normals).max()
    return np.concatenate([picked, points[beyond.any(axis=1)]])


def _merge_slabs(outlines: Sequence[FloatArray], ranges: Sequence[tuple[float, float]]) -> SlabOutline:
    """Returns slabs around clouds of points (K, 2); neighbours with like outlines are merged."""
    hulls = [_hull(points) for points in outlines]
    merged: list[tuple[FloatArray, float, float]] = []
    for hull, (low, high) in zip(hulls, ranges, strict=True):
        if merged and merged[-1][2] >= low - 1e-9 and _are_alike(merged[-1][0], hull):
            merged[-1] = (_hull(np.concatenate([merged[-1][0], hull])), merged[-1][1], high)
        else:
            merged.append((hull, low, high))
    sides = [_sides(hull) for hull, _, _ in merged]
    normals, offsets = np.stack([n for n, _ in sides]), np.stack([o for _, o in sides])
    is_within = np.array(
        [[(normals[a] @ hull.T <= offsets[a][:, None] + 1e-6).all() for a in range(len(merged))] for hull, _, _ in merged], bool
    )
    is_within &= ~is_within.T | np.triu(np.ones_like(is_within))
    lows, highs = np.array([low for _, low, _ in merged]), np.array([high for _, _, high in merged])
    return SlabOutline(normals, offsets, lows, highs, is_within)


def _hull(points: FloatArray) -> FloatArray:
    """Returns the convex hull of points (K, 2), counter-clockwise, (H, 2); a line or a point is first widened by 0.01 mm."""
    hull = shapely.convex_hull(shapely.linestrings(points if len(points) > 1 else np.repeat(points, 2, axis=0)))
    if hull.geom_type != "Polygon":
        hull = hull.buffer(1e-5, quad_segs=2)
    coordinates = shapely.get_coordinates(hull)[:-1]
    x, y = coordinates.T
    area = float(x @ np.roll(y, -1) - y @ np.roll(x, -1))
    return np.asarray(coordinates if area > 0 else coordinates[::-1])


def _are_alike(one: FloatArray, other: FloatArray) -> bool:
    return bool(np.abs((one @ _DIRECTIONS).max(axis=0) - (other @ _DIRECTIONS).max(axis=0)).max() <= _ALIKE)


def _sides(hull: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Returns half-planes of a convex polygon, of its long edges and evenly around it: normals (M, 2), offsets (M,)."""
    edges = np.roll(hull, -1, axis=0) - hull
    length = np.linalg.norm(edges, axis=1)
    order = np.argsort(-length, kind="stable")[: NUM_SIDES - NUM_AROUND]
    order = order[length[order] > _LONG * length.sum()]
    angles = np.arctan2(-edges[order, 0], edges[order, 1])
    angles = np.sort(np.concatenate([angles, _EVENLY]) % (2 * np.pi))
    angles = np.concatenate([angles, np.full(NUM_SIDES - len(angles), angles[-1])])
    normals = np.stack([np.cos(angles), np.sin(angles)], axis=1)
    return normals, (hull @ normals.T).max(axis=0)
