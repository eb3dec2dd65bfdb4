"""Samples of a surface: of all of it for the point encoder, and of its bottom region for support contact.

Both are in farthest-point order: every prefix is itself an evenly spread sample, so one stored row serves every size.
"""

import numpy as np
import numpy.typing as npt

from stable_data.errors import MeshError
from stable_data.geometry.mesh import Mesh, double_areas, unit_normals
from stable_data.scene import FloatArray, IntArray

_CANDIDATES = 16  # drawn for each point of the result
_BAND_SHARE, _BAND_MIN, _BAND_MAX = 0.05, 1e-3, 1e-2  # of the height; metres
_SIDEWAYS = 0.02  # weight of a face in the bottom region that does not face down, relative to one that does
_LOWEST_SHARE = 0.25  # largest share of lowest vertices among the points


def surface_points(
    mesh: Mesh, num: int = 1024, rng: np.random.Generator | None = None, candidates: int = _CANDIDATES
) -> tuple[npt.NDArray[np.float32], npt.NDArray[np.float32]]:
    """Samples points all over a surface with their normals, in farthest-point order.

    Candidates are spread evenly by area; each next point is the candidate farthest from all points before it.

    Args:
        mesh: In any unit.
        num: Number of points.
        rng: Source of the candidates; by default a fixed one, so that a mesh always gives the same points.
        candidates: Candidates for each point: with fewer, points are less evenly spread and sooner found.

    Returns:
        Points (num, 3) float32 in the mesh's frame and unit, and the unit normals of their faces (num, 3) float32.

    Raises:
        MeshError: ``mesh_no_area``: there is no surface to sample.
    """
    rng = np.random.default_rng(0) if rng is None else rng
    normals, areas = unit_normals(mesh.triangles)
    points, face = _sample(mesh.triangles, areas, candidates * num, rng)
    start = int(np.argmax(((points - points.mean(axis=0)) ** 2).sum(axis=1)))
    kept = _farthest_first(points, num, [start])
    return points[kept].astype(np.float32), normals[face[kept]].astype(np.float32)


def bottom_points(
    vertices: FloatArray, faces: IntArray, num: int = 128, band: float | None = None, rng: np.random.Generator | None = None
) -> npt.NDArray[np.float32]:
    """Samples points of the bottom region, the paper's B_i of the support-contact loss (delta, gap and L_sup).

    The region is the part of the surface less than ``band`` above the lowest vertex, cut exactly at that height. Faces that point
    down are preferred, because they can rest on a support. The lowest vertices are always among the points, so that ``min |D_s|``
    over them is exact if an object stands on a plane.

    Args:
        vertices: (V, 3) float64, metres, scaled and tilted, z up: the yaw frame, or the world frame.
        faces: (F, 3) int64.
        num: Number of points.
        band: Height of the region, metres; by default 5 % of the object's height, at least 1 mm and at most 10 mm.
        rng: Source of the candidates; by default a fixed one.

    Returns:
        (num, 3) float32, metres, same frame, in farthest-point order.
    """
    rng = np.random.default_rng(0) if rng is None else rng
    heights = np.ascontiguousarray(vertices[:, 2][faces].T)
    lowest_corner = np.minimum(np.minimum(heights[0], heights[1]), heights[2])
    low, high = lowest_corner.min(), heights.max()
    band = float(np.clip(_BAND_SHARE * (high - low), _BAND_MIN, _BAND_MAX)) if band is None else band
    faces = faces[lowest_corner <= low + band]  # the other faces cannot reach into the band
    lowest = vertices[np.unique(faces)]
    lowest = lowest[lowest[:, 2] <= low + 0.01 * band]
    lowest = lowest[_farthest_first(lowest, max(1, int(num * _LOWEST_SHARE)), [int(np.argmin(lowest[:, 2]))])]
    triangles = _below(vertices[faces], low + band)
    normals, areas = unit_normals(triangles)
    weights = areas * np.maximum(-normals[:, 2], _SIDEWAYS)
    if weights.sum() <= 0:  # the mesh touches the band only at points or edges
        return np.resize(lowest, (num, 3)).astype(np.float32)
    pool = np.concatenate([lowest, _sample(triangles, weights, _CANDIDATES * num, rng)[0]])
    return pool[_farthest_first(pool, num, list(range(len(lowest))))].astype(np.float32)


def sample_surface(mesh: Mesh, num: int) -> FloatArray:
    """Samples points evenly over a surface in no order, (num, 3) float64, mesh units; always the same for the same mesh."""
    return _sample(mesh.triangles, double_areas(mesh), num, np.random.default_rng(0))[0]


def sample_oriented_surface(mesh: Mesh, num: int) -> tuple[FloatArray, FloatArray]:
    """Samples points as :func:`sample_surface`, with the unit normals of their faces, (num, 3) float64 each."""
    triangles = mesh.triangles
    normals, _ = unit_normals(triangles)
    points, face = _sample(triangles, double_areas(mesh), num, np.random.default_rng(0))
    return points, normals[face]


def _sample(triangles: FloatArray, weights: FloatArray, num: int, rng: np.random.Generator) -> tuple[FloatArray, IntArray]:
    """Samples points (num, 3) on triangles, evenly by weight, and returns the triangle of each (num,)."""
    total = np.cumsum(weights)
    if not total[-1] > 0:
        raise MeshError("mesh has no area, expected a surface to sample; is every face degenerate?", "mesh_no_area")
    # One draw in each of num equal strata is far more even than independent draws.
    picked = np.searchsorted(total, (np.arange(num) + rng.random(num)) / num * total[-1], side="right")
    face = np.minimum(picked, np.flatnonzero(weights)[-1])
    root, v = np.sqrt(rng.random(num))[:, None], rng.random(num)[:, None]  # the root makes the points uniform in the triangle
    a, b, c = (triangles[face, n] for n in range(3))
    return (1 - root) * a + root * (1 - v) * b + root * v * c, face


def _farthest_first(points: FloatArray, num: int, chosen: list[int]) -> IntArray:
    """Returns indices (at most num, P) of points: the chosen ones, then each time the point farthest from all before it."""
    # A new point only changes points that are nearer to it than the current largest distance. With the points sorted along one
    # axis, these lie in one slice.
    axis = int(np.argmax(np.ptp(points, axis=0)))
    in_order = np.argsort(points[:, axis], kind="stable")
    place = np.empty_like(in_order)
    place[in_order] = np.arange(len(points))
    centred = np.roll(points[in_order] - points.mean(axis=0), -axis, axis=1)
    x, y, z = np.ascontiguousarray(centred.T, np.float32)
    squared, steps, offsets = (np.full(len(points), value, np.float32) for value in (np.inf, 0, 0))
    order: list[int] = place[chosen[:num]].tolist()
    near = slice(None)
    for n in range(min(num, len(points))):
        if n == len(order):
            order.append(int(squared.argmax()))
            at, reach = x[order[n]], 1.0001 * squared[order[n]] ** 0.5  # a margin for rounding in float32
            near = slice(*x.searchsorted([at - reach, at + reach]).tolist())
        last, step, offset = order[n], steps[near], offsets[near]
        np.subtract(x[near], x[last], out=offset)
        np.multiply(offset, offset, out=step)
        for other in (y, z):
            np.subtract(other[near], other[last], out=offset)
            np.multiply(offset, offset, out=offset)
            np.add(step, offset, out=step)
        np.minimum(squared[near], step, out=squared[near])
    return in_order[order]


def _below(triangles: FloatArray, height: float) -> FloatArray:
    """Clips triangles (F, 3, 3) to the part below a height; the results have the same normals."""
    triangles = triangles[triangles[:, :, 2].min(axis=1) < height]
    count = (triangles[:, :, 2] < height).sum(axis=1)
    # A cyclic rotation of the corners brings the single corner below, or above, to the front and preserves the normal.
    odd = np.where(count == 1, triangles[:, :, 2].argmin(axis=1), triangles[:, :, 2].argmax(axis=1))
    a, b, c = (triangles[np.arange(len(triangles)), (odd + n) % 3] for n in range(3))
    drop = np.where(count < 3, 1.0, 0.0)[:, None]
    with np.errstate(divide="ignore", invalid="ignore"):
        ab = a + (b - a) * drop * np.nan_to_num((height - a[:, 2:]) / (b[:, 2:] - a[:, 2:]))
        ac = a + (c - a) * drop * np.nan_to_num((height - a[:, 2:]) / (c[:, 2:] - a[:, 2:]))
    one, two, three = count == 1, count == 2, count == 3
    return np.concatenate(
        [
            triangles[three],
            np.stack([a, ab, ac], axis=1)[one],
            np.stack([ab, b, c], axis=1)[two],
            np.stack([ab, c, ac], axis=1)[two],
        ]
    )
