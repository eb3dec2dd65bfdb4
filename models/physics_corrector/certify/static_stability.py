"""Static stability with friction, from exact contacts: whether a supported object stays, or tips, rolls or slides.

An object on a base that is wide enough for its height is steady: its centre of mass is well inside the hull of its support
points. This test is fast. An object that leans (a pen on the rim of its cup, an apple between others and the wall of its bowl) is
steady if forces within the friction cones of its contacts can balance its weight, also when the scene is tilted a little.
"""

from collections.abc import Sequence
from weakref import WeakKeyDictionary

import igl
import numpy as np
import scipy.optimize
import shapely

from models.physics_corrector.certify import constants
from models.physics_corrector.certify.mesh_queries import MeshQueries
from stable_data.geometry.mesh import unit_normals
from stable_data.geometry.shape import Shape
from stable_data.scene import FloatArray, IntArray

_centres: "WeakKeyDictionary[Shape, FloatArray]" = WeakKeyDictionary()
_alone: "WeakKeyDictionary[Shape, bool]" = WeakKeyDictionary()


def centre_of_mass(shape: Shape) -> FloatArray:
    """Returns the centre of mass of a shape, (3,), metres, yaw frame.

    It is the one that is known of the object; else that of a homogeneous solid, or the centre of the box if the faces bound no
    volume.
    """
    if shape.center_of_mass is not None:
        return shape.center_of_mass
    if shape not in _centres:
        triangles = shape.vertices[shape.faces]
        volume = np.einsum("ij,ij->i", triangles[:, 0], np.cross(triangles[:, 1], triangles[:, 2])) / 6
        total = float(volume.sum())
        middle = (volume[:, None] * triangles.sum(axis=1) / 4).sum(axis=0) / total if abs(total) > 1e-9 else np.zeros(3)
        _centres[shape] = middle if (np.abs(middle) <= shape.size / 2).all() else np.zeros(3)
    return _centres[shape]


def stands_alone(shape: Shape) -> bool:
    """Whether a shape stays upright on the bare table; a pen at the tilt at which it leans in its cup does not."""
    if shape not in _alone:
        # The shape may rock by one or two degrees about its lowest point until it stands.
        lowest = shape.vertices[shape.vertices[:, 2].argmin()]
        apart = shape.vertices - lowest
        aside = np.linalg.norm(apart[:, :2], axis=1)
        foot = shape.vertices[apart[:, 2] <= constants.FOOT_HEIGHT + constants.ROCKING_SLOPE * aside]
        _alone[shape] = _inside_by_height(foot, centre_of_mass(shape)) >= constants.STANDS_ALONE
    return _alone[shape]


def steadiness(meshes: MeshQueries, k: int, pose: FloatArray, others: Sequence[int], poses: FloatArray) -> float:
    """Computes the steadiness of an object: the tangent of the slope at which it would tip; see ``constants.STEADY``, ``FALLS``.

    Args:
        meshes: The objects.
        k: The object.
        pose: Its pose, without contact with others, (4,).
        others: Objects that may carry it, besides the table.
        poses: Poses of all objects, (N, 4).
    """
    others = meshes.near(k, pose, others, poses, constants.CONTACT_DISTANCE, aside=constants.CONTACT_DISTANCE)
    base = _base_steadiness(meshes, k, pose, others, poses)
    if base >= constants.STEADY or (base < constants.HANGS_BESIDE and stands_alone(meshes.shapes[k])):
        return base
    points, normals = _contacts(meshes, k, pose, others, poses)
    middle = _centre_at(meshes, k, pose)
    length = float(meshes.shapes[k].size.max()) / 2
    tilt = constants.TEST_SLOPE
    slopes = ((0.0, 0.0), (tilt, 0.0), (-tilt, 0.0), (0.0, tilt), (0.0, -tilt))
    if all(_is_balanced(points, normals, middle, length, np.array([*slope, -1.0])) for slope in slopes):
        return constants.STEADY
    return base


def _centre_at(meshes: MeshQueries, k: int, pose: FloatArray) -> FloatArray:
    """Returns the centre of mass of an object at a pose, (3,), metres."""
    c, s = np.cos(pose[3]), np.sin(pose[3])
    x, y, z = centre_of_mass(meshes.shapes[k])
    return np.array([c * x - s * y, s * x + c * y, z]) + pose[:3]


def _base_steadiness(meshes: MeshQueries, k: int, pose: FloatArray, others: Sequence[int], poses: FloatArray) -> float:
    """Returns the steadiness on the support points alone, without friction."""
    points = meshes.support_points(k, pose, others, poses)
    if not len(points):
        return -np.inf
    return _inside_by_height(points, _centre_at(meshes, k, pose))


def _inside_by_height(points: FloatArray, middle: FloatArray) -> float:
    """Returns how far a centre of mass (3,) is inside the hull of points (C, 3), seen from above, divided by its height over them."""
    hull, point = shapely.convex_hull(shapely.multipoints(points[:, :2])), shapely.Point(middle[:2])
    inside = hull.boundary.distance(point) if hull.geom_type == "Polygon" and hull.contains(point) else -hull.distance(point)
    return float(inside) / max(constants.MIN_CENTRE_HEIGHT, float(middle[2] - points[:, 2].mean()))


def _contacts(
    meshes: MeshQueries, k: int, pose: FloatArray, others: Sequence[int], poses: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Returns the contacts of an object with others and the table, (C, 3) metres, and the directions of their forces, (C, 3) unit."""
    shape, posed = meshes.shapes[k], meshes.shapes[k].posed(pose)
    low = posed[posed[:, 2] <= constants.CONTACT_DISTANCE]
    points, normals = [low], [np.tile([0.0, 0.0, 1.0], (len(low), 1))]
    for j in others:
        mine, theirs = meshes.contact_triangles(k, pose, j, poses[j], constants.CONTACT_DISTANCE)
        if not len(mine):
            continue
        one, two = posed[shape.faces[mine]], meshes.shapes[j].posed(poses[j])[meshes.shapes[j].faces[theirs]]
        for corners, faces, sign in ((one, two, 1.0), (two, one, -1.0)):
            there, ways = _nearest_on_faces(corners, faces)
            points.append(there)
            normals.append(sign * ways)
    return np.concatenate(points), np.concatenate(normals)


def _nearest_on_faces(corners: FloatArray, faces: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Returns the points of faces that are near corners of triangles, (C, 3) metres, and the directions to these, (C, 3) unit."""
    # Neighbouring triangles share corners: each corner is asked for once.
    candidates = np.unique(corners.reshape(-1, 3), axis=0)
    soup = np.ascontiguousarray(faces.reshape(-1, 3))
    squared, index, there = igl.point_mesh_squared_distance(candidates, soup, np.arange(len(soup)).reshape(-1, 3))
    near = np.asarray(squared) <= constants.CONTACT_DISTANCE**2
    apart, distance = (candidates - there)[near], np.sqrt(np.asarray(squared)[near])[:, None]
    outward = unit_normals(faces)[0][np.asarray(index, np.int64)[near]]
    # A corner that is slightly inside is pushed out as well.
    inside = (apart * outward).sum(axis=1, keepdims=True) < 0
    ways = np.where(distance > 1e-6, np.where(inside, -apart, apart) / np.maximum(distance, 1e-9), outward)
    return np.asarray(there)[near], ways


def _is_balanced(points: FloatArray, normals: FloatArray, middle: FloatArray, length: float, pull: FloatArray) -> bool:
    """Whether forces within the friction cones (pyramids of four edges) balance a pull (3,) at the centre of mass."""
    if not len(points):
        return False
    chosen = _spread_contacts(points, normals)
    points, normals = points[chosen], normals[chosen]
    aside = np.cross(normals, np.eye(3)[np.abs(normals).argmin(axis=1)])
    aside /= np.linalg.norm(aside, axis=1, keepdims=True)
    across = np.cross(normals, aside)
    edges = np.concatenate([normals + constants.FRICTION * way for way in (aside, -aside, across, -across)])
    arms = np.tile(points - middle, (4, 1)) / length
    matrix = np.concatenate([edges.T, np.cross(arms, edges).T])
    # Small forces are preferred: a rigid object that stands astride a wall does not clamp it.
    eased = np.concatenate([matrix, np.full((1, matrix.shape[1]), constants.FORCE_PENALTY)])
    forces = scipy.optimize.nnls(eased, np.concatenate([-pull, np.zeros(4)]))[0]
    left = matrix @ forces + np.concatenate([pull, np.zeros(3)])
    return bool(np.linalg.norm(left) < constants.MAX_RESIDUAL and forces.sum() < constants.MAX_TOTAL_FORCE)


def _spread_contacts(points: FloatArray, normals: FloatArray) -> IntArray:
    """Returns the indices of at most ``MAX_CONTACTS`` contacts, chosen by farthest-point sampling."""
    if len(points) <= constants.MAX_CONTACTS:
        return np.arange(len(points))
    features = np.concatenate([points / max(1e-9, float(np.ptp(points, axis=0).max())), normals], axis=1)
    chosen = [0]
    distance = np.linalg.norm(features - features[0], axis=1)
    while len(chosen) < constants.MAX_CONTACTS:
        chosen.append(int(distance.argmax()))
        distance = np.minimum(distance, np.linalg.norm(features - features[chosen[-1]], axis=1))
    return np.array(chosen)
