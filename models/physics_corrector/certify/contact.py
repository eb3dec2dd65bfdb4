"""Exact questions about meshes at poses: do two meet, does one rest on others, how low does one come?"""

from collections.abc import Sequence
from weakref import WeakKeyDictionary

import fcl
import numpy as np
import shapely

from stable_data.metrics.collision import DIRECTIONS, NEAR, nested
from stable_data.metrics.crossing import MeshPair, Surface
from stable_data.metrics.support import carries
from stable_data.scene import FloatArray
from stable_data.shape import Shape

_ANY = fcl.CollisionRequest()
_STEP = 5e-3  # how far a thing is lowered before the next look, metres
_FINE = 2e-5  # to which a resting height is found, metres
_REACH, _MOST_CONTACTS = 4e-4, 200  # how far what rests is lowered to see what carries it, metres, and in so many points
_AIR = 4e-5  # left below what rests, metres

_trees: "WeakKeyDictionary[Shape, fcl.BVHModel]" = WeakKeyDictionary()


_centres: "WeakKeyDictionary[Shape, FloatArray]" = WeakKeyDictionary()


def _tree(shape: Shape) -> fcl.BVHModel:
    if shape not in _trees:
        tree = fcl.BVHModel()
        tree.beginModel(len(shape.vertices), len(shape.faces))
        tree.addSubModel(shape.vertices, shape.faces)
        tree.endModel()
        _trees[shape] = tree
    return _trees[shape]


def _centre_of_mass(shape: Shape) -> FloatArray:
    """Of the solid that a shape's faces bound, (3,), metres, yaw frame; the middle of its box where they bound none."""
    if shape not in _centres:
        triangles = shape.vertices[shape.faces]
        volume = np.einsum("ij,ij->i", triangles[:, 0], np.cross(triangles[:, 1], triangles[:, 2])) / 6
        total = float(volume.sum())
        middle = (volume[:, None] * triangles.sum(axis=1) / 4).sum(axis=0) / total if abs(total) > 1e-9 else np.zeros(3)
        _centres[shape] = middle if (np.abs(middle) <= shape.size / 2).all() else np.zeros(3)
    return _centres[shape]


class Meshes:
    """The meshes of a scene's objects, to be asked at any poses.

    Args:
        shapes: The geometry of each object.
    """

    def __init__(self, shapes: Sequence[Shape]) -> None:
        self.shapes = shapes
        self._extents: dict[tuple[int, float], tuple[FloatArray, FloatArray]] = {}
        self._penetrates: dict[tuple[int, int, bytes], bool] = {}
        self._surfaces: dict[tuple[int, bytes], Surface] = {}

    def box(self, k: int, pose: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Lowest and highest corner of an object at a pose (4,), two (3,) metres."""
        yaw = float(pose[3])
        if (k, yaw) not in self._extents:
            posed = self.shapes[k].posed((0.0, 0.0, 0.0, yaw)).T
            self._extents[k, yaw] = posed.min(axis=1), posed.max(axis=1)
        low, high = self._extents[k, yaw]
        return low + pose[:3], high + pose[:3]

    def near(self, k: int, pose: FloatArray, others: Sequence[int], poses: FloatArray, gap: float = 0.0) -> list[int]:
        """Those of other objects whose boxes an object's box meets when it is lowered by up to a gap, metres."""
        low, high = self.box(k, pose)
        low = low - (0.0, 0.0, gap)
        boxes = [self.box(j, poses[j]) for j in others]
        return [j for j, (a, b) in zip(others, boxes, strict=True) if (low <= b).all() and (high >= a).all()]

    def cross(self, i: int, pose: FloatArray, j: int, other: FloatArray) -> bool:
        """Do two meshes touch?"""
        return MeshPair(self._surface(i, pose), self._surface(j, other), 0.0).cross()

    def penetrates(self, i: int, pose: FloatArray, j: int, other: FloatArray) -> bool:
        """Are two meshes deeper in each other than the tolerance, as the audit judges it?"""
        key = (i, j, np.concatenate([pose, other]).tobytes())
        if key not in self._penetrates:
            self._penetrates[key] = self._are_deep(i, pose, j, other)
        return self._penetrates[key]

    def _are_deep(self, i: int, pose: FloatArray, j: int, other: FloatArray) -> bool:
        (low, high), (other_low, other_high) = self.box(i, pose), self.box(j, other)
        if (low > other_high).any() or (high < other_low).any():
            return False
        within = ((low >= other_low - NEAR).all() and (high <= other_high + NEAR).all()) or (
            (other_low >= low - NEAR).all() and (other_high <= high + NEAR).all()
        )
        one, two = self._surface(i, pose), self._surface(j, other)
        pair = MeshPair(one, two, NEAR)
        contact = pair.contact()
        if contact is None:
            return bool(within) and (nested(one, two) or nested(two, one))
        ways = NEAR * np.concatenate([DIRECTIONS, contact.normals, -contact.normals])
        for number, way in enumerate(ways):
            if not pair.cross(way, number):
                moved = Surface(one.triangles + way)
                return bool(within) and (nested(moved, two) or nested(two, moved))
        return True

    def rests(self, k: int, pose: FloatArray, others: Sequence[int], poses: FloatArray) -> list[int]:
        """Which of other objects carry an object at a pose, as the audit judges it."""
        near = self.near(k, pose, others, poses, NEAR)
        surface = self._surface(k, pose) if near else None
        return [j for j in near if surface is not None and carries(MeshPair(surface, self._surface(j, poses[j]), NEAR), NEAR)]

    def beyond_support(self, k: int, pose: FloatArray, others: Sequence[int], poses: FloatArray) -> float:
        """How far an object's centre of mass is outside the hull of the points that carry it, seen from above, metres.

        A little lowered it touches in those points; on the table they are its lowest vertices.
        """
        shape = self.shapes[k]
        posed = shape.posed(pose)
        points = [posed[posed[:, 2] <= _REACH, :2]]
        moving = self._body(k, pose - (0.0, 0.0, _REACH, 0.0))
        request = fcl.CollisionRequest(num_max_contacts=_MOST_CONTACTS, enable_contact=True)
        for j in others:
            result = fcl.CollisionResult()
            if fcl.collide(moving, self._body(j, poses[j]), request, result):
                points.append(np.array([c.pos[:2] for c in result.contacts]))
        found = np.concatenate(points)
        if not len(found):
            return float("inf")
        c, s = np.cos(pose[3]), np.sin(pose[3])
        middle = np.array([[c, -s], [s, c]]) @ _centre_of_mass(shape)[:2] + pose[:2]
        return float(shapely.distance(shapely.Point(middle), shapely.convex_hull(shapely.MultiPoint(found))))

    def lowered(self, k: int, pose: FloatArray, others: Sequence[int], poses: FloatArray) -> float:
        """Height of an object's centre when it comes down from above until it is just clear of what is below, metres.

        Args:
            k: The object.
            pose: x and y from which it comes, and its yaw, (4,).
            others: What it may come down on; besides there is the table.
            poses: Where they are, (N, 4).
        """
        floor = float(self.shapes[k].size[2]) / 2
        low, high = self.box(k, pose)
        below = []
        highest = floor
        for j in others:
            other_low, other_high = self.box(j, poses[j])
            if (low[:2] <= other_high[:2]).all() and (high[:2] >= other_low[:2]).all():
                below.append(self._body(j, poses[j]))
                highest = max(highest, float(other_high[2]) + floor + _AIR)
        moving, there = self._body(k, pose), np.array(pose[:3])

        def touches(z: float) -> bool:
            there[2] = z
            moving.setTranslation(there)
            return any(self._bodies_cross(moving, other) for other in below)

        z = highest
        while touches(z):  # it started inside something: from farther up
            z += _STEP
        while z > floor and not touches(max(floor, z - _STEP)):
            z = max(floor, z - _STEP)
        if z <= floor:
            return floor
        under = z - _STEP
        while z - under > _FINE:
            middle = (z + under) / 2
            z, under = (z, middle) if touches(middle) else (middle, under)
        return z + _AIR

    def _body(self, k: int, pose: FloatArray) -> fcl.CollisionObject:
        c, s = np.cos(pose[3]), np.sin(pose[3])
        turn = np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])
        return fcl.CollisionObject(_tree(self.shapes[k]), fcl.Transform(turn, np.array(pose[:3])))

    @staticmethod
    def _bodies_cross(one: fcl.CollisionObject, other: fcl.CollisionObject) -> bool:
        return bool(fcl.collide(one, other, _ANY, fcl.CollisionResult()) > 0)

    def _surface(self, k: int, pose: FloatArray) -> Surface:
        key = (k, pose.tobytes())
        if key not in self._surfaces:
            if len(self._surfaces) > 4 * len(self.shapes):
                self._surfaces.clear()
            self._surfaces[key] = Surface(self.shapes[k].posed(pose)[self.shapes[k].faces])
        return self._surfaces[key]
