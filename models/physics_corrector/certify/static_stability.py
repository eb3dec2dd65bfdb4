"""Does what is carried stay where it is put, or does it tip, roll or slide? Statics with friction, from exact contacts.

What stands on a base wide enough for its height is quickly seen to be steady: its centre of mass is well inside the hull of the
points that carry it. What leans (a pen on the rim of its cup, an apple between others and the wall of its bowl) is steady where
forces within the friction cones of its contacts can hold its weight, and still can when everything is tilted a little.
"""

from collections.abc import Sequence
from weakref import WeakKeyDictionary

import igl
import numpy as np
import scipy.optimize
import shapely

from models.physics_corrector.certify.mesh_queries import MeshQueries
from stable_data.geometry.mesh import unit_normals
from stable_data.geometry.shape import Shape
from stable_data.scene import FloatArray, IntArray

STEADY = 0.1
"""What is this steady stays: a slope at which it would not yet tip, the tangent of its angle."""

FALLS = -0.1
"""What is less steady than this falls, and in between nobody knows."""

_TOUCH = 1e-3  # what is so near to another thing leans on it, metres
_FRICTION = 0.5  # coefficient that what leans may count on; less than engines take
_SLOPE = 0.1  # tangent of the angle by which everything is tilted
_BARELY = -0.02  # what is less steady than this does not stand alone
_FOOT, _ROCK = 4e-4, 0.035  # what it stands on is so low, metres, or less steep than this
_BESIDE = -1.0  # what stands alone and is less steady than this hangs beside what carries it
_MOST = 48  # contacts that forces are looked for in
_UNHELD = 0.008  # share of the weight that may be left over
_EASE, _STRONGEST = 1e-3, 3.0  # how much forces are shunned; and all of them together at most, in weights
_LEAST_HEIGHT = 5e-3  # of a centre of mass over what carries it, metres

_centres: "WeakKeyDictionary[Shape, FloatArray]" = WeakKeyDictionary()
_alone: "WeakKeyDictionary[Shape, bool]" = WeakKeyDictionary()


def centre_of_mass(shape: Shape) -> FloatArray:
    """Of the solid that a shape's faces bound, (3,), metres, yaw frame; the middle of its box where they bound none."""
    if shape not in _centres:
        triangles = shape.vertices[shape.faces]
        volume = np.einsum("ij,ij->i", triangles[:, 0], np.cross(triangles[:, 1], triangles[:, 2])) / 6
        total = float(volume.sum())
        middle = (volume[:, None] * triangles.sum(axis=1) / 4).sum(axis=0) / total if abs(total) > 1e-9 else np.zeros(3)
        _centres[shape] = middle if (np.abs(middle) <= shape.size / 2).all() else np.zeros(3)
    return _centres[shape]


def stands_alone(shape: Shape) -> bool:
    """Would a shape stay upright on the bare table? A pen that leans in its cup would not."""
    if shape not in _alone:
        # It may rock by a degree or two about its lowest point until it stands.
        lowest = shape.vertices[shape.vertices[:, 2].argmin()]
        apart = shape.vertices - lowest
        foot = shape.vertices[apart[:, 2] <= _FOOT + _ROCK * np.linalg.norm(apart[:, :2], axis=1)]
        _alone[shape] = _inside(foot, centre_of_mass(shape)) >= _BARELY
    return _alone[shape]


def steadiness(meshes: MeshQueries, k: int, pose: FloatArray, others: Sequence[int], poses: FloatArray) -> float:
    """How steady an object is at a pose: the tangent of the slope at which it would tip; see ``STEADY`` and ``FALLS``.

    Args:
        meshes: The objects.
        k: The object.
        pose: Where it is, clear of others, (4,).
        others: What may carry it, besides the table.
        poses: Where those are, (N, 4).
    """
    others = meshes.near(k, pose, others, poses, _TOUCH, aside=_TOUCH)
    base = _base(meshes, k, pose, others, poses)
    if base >= STEADY or (base < _BESIDE and stands_alone(meshes.shapes[k])):
        return base
    points, normals = _leaning(meshes, k, pose, others, poses)
    middle = _middle(meshes, k, pose)
    length = float(meshes.shapes[k].size.max()) / 2
    slopes = [(s * _SLOPE, t * _SLOPE) for s, t in ((0, 0), (1, 0), (-1, 0), (0, 1), (0, -1))]
    if all(_is_held(points, normals, middle, length, np.array([*slope, -1.0])) for slope in slopes):
        return STEADY
    return base


def _middle(meshes: MeshQueries, k: int, pose: FloatArray) -> FloatArray:
    """Centre of mass of an object at a pose, (3,), metres."""
    c, s = np.cos(pose[3]), np.sin(pose[3])
    x, y, z = centre_of_mass(meshes.shapes[k])
    return np.array([c * x - s * y, s * x + c * y, z]) + pose[:3]


def _base(meshes: MeshQueries, k: int, pose: FloatArray, others: Sequence[int], poses: FloatArray) -> float:
    """How far inside the hull of what carries an object its centre of mass is, seen from above, by its height over that."""
    points = meshes.bearing(k, pose, others, poses)
    if not len(points):
        return -np.inf
    return _inside(points, _middle(meshes, k, pose))


def _inside(points: FloatArray, middle: FloatArray) -> float:
    """How far inside the hull of points (C, 3) a centre of mass (3,) is, seen from above, by its height over them."""
    hull, point = shapely.convex_hull(shapely.multipoints(points[:, :2])), shapely.Point(middle[:2])
    inside = hull.boundary.distance(point) if hull.geom_type == "Polygon" and hull.contains(point) else -hull.distance(point)
    return float(inside) / max(_LEAST_HEIGHT, float(middle[2] - points[:, 2].mean()))


def _leaning(
    meshes: MeshQueries, k: int, pose: FloatArray, others: Sequence[int], poses: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Where an object nearly touches others or the table, (C, 3) metres, and the way it is pushed there, (C, 3) unit."""
    shape, posed = meshes.shapes[k], meshes.shapes[k].posed(pose)
    low = posed[posed[:, 2] <= _TOUCH]
    points, normals = [low], [np.tile([0.0, 0.0, 1.0], (len(low), 1))]
    for j in others:
        mine, theirs = meshes.touching(k, pose, j, poses[j], _TOUCH)
        if not len(mine):
            continue
        one, two = posed[shape.faces[mine]], meshes.shapes[j].posed(poses[j])[meshes.shapes[j].faces[theirs]]
        for corners, faces, sign in ((one, two, 1.0), (two, one, -1.0)):
            there, ways = _nearest(corners, faces)
            points.append(there)
            normals.append(sign * ways)
    return np.concatenate(points), np.concatenate(normals)


def _nearest(corners: FloatArray, faces: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Corners of triangles that are near faces, (C, 3) metres, and the way from there to them, (C, 3) unit."""
    candidates = np.unique(corners.reshape(-1, 3), axis=0)
    soup = np.ascontiguousarray(faces.reshape(-1, 3))
    squared, index, there = igl.point_mesh_squared_distance(candidates, soup, np.arange(len(soup)).reshape(-1, 3))
    near = np.asarray(squared) <= _TOUCH**2
    apart, distance = (candidates - there)[near], np.sqrt(np.asarray(squared)[near])[:, None]
    outward = unit_normals(faces)[0][np.asarray(index, np.int64)[near]]
    # What is a hair's breadth inside is pushed out all the same.
    inside = (apart * outward).sum(axis=1, keepdims=True) < 0
    ways = np.where(distance > 1e-6, np.where(inside, -apart, apart) / np.maximum(distance, 1e-9), outward)
    return np.asarray(there)[near], ways


def _is_held(points: FloatArray, normals: FloatArray, middle: FloatArray, length: float, pull: FloatArray) -> bool:
    """Can forces within the friction cones (pyramids of four edges) balance a pull (3,) at the centre of mass?"""
    if not len(points):
        return False
    chosen = _spread(points, normals)
    points, normals = points[chosen], normals[chosen]
    aside = np.cross(normals, np.eye(3)[np.abs(normals).argmin(axis=1)])
    aside /= np.linalg.norm(aside, axis=1, keepdims=True)
    across = np.cross(normals, aside)
    edges = np.concatenate([normals + _FRICTION * way for way in (aside, -aside, across, -across)])
    arms = np.tile(points - middle, (4, 1)) / length
    matrix = np.concatenate([edges.T, np.cross(arms, edges).T])
    # Of all forces the small ones are wanted: a rigid thing that stands astride a wall does not clamp it.
    eased = np.concatenate([matrix, np.full((1, matrix.shape[1]), _EASE)])
    forces = scipy.optimize.nnls(eased, np.concatenate([-pull, np.zeros(4)]))[0]
    left = matrix @ forces + np.concatenate([pull, np.zeros(3)])
    return bool(np.linalg.norm(left) < _UNHELD and forces.sum() < _STRONGEST)


def _spread(points: FloatArray, normals: FloatArray) -> IntArray:
    """At most so many contacts, as far apart as can be."""
    if len(points) <= _MOST:
        return np.arange(len(points))
    features = np.concatenate([points / max(1e-9, float(np.ptp(points, axis=0).max())), normals], axis=1)
    chosen = [0]
    distance = np.linalg.norm(features - features[0], axis=1)
    while len(chosen) < _MOST:
        chosen.append(int(distance.argmax()))
        distance = np.minimum(distance, np.linalg.norm(features - features[chosen[-1]], axis=1))
    return np.array(chosen)
