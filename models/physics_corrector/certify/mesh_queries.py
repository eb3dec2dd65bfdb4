"""Exact queries on posed meshes: whether two cross, which ones support one, how low one can be placed."""

from collections.abc import Sequence
from weakref import WeakKeyDictionary

import fcl
import numpy as np

from models.physics_corrector.certify.constants import AIR
from stable_data.geometry.shape import Shape
from stable_data.metrics.collision import DIRECTIONS, NEAR, is_nested
from stable_data.metrics.support import carries
from stable_data.metrics.triangle_intersection import MeshPair, PosedTriangles
from stable_data.metrics.verdicts import ROUNDING, TOLERANCE
from stable_data.scene import FloatArray, IntArray

_ANY = fcl.CollisionRequest()
_STEP = 5e-3  # coarse step of a search for contact, metres
_FINE = 2e-5  # accuracy of the bisection after it, metres
_REACH = 4e-4  # how far an object at rest is lowered to touch its carriers, metres
_MOST_CONTACTS = 200  # contacts of two meshes at most
_RISES = (0.0, AIR, 1e-4, 2e-4, _REACH)  # heights by which an object is raised to be free of its carriers, metres
_AROUND_AND_DOWN = np.array([*(d for d in DIRECTIONS if d[2] == 0), (0.0, 0.0, -1.0)])

_trees: "WeakKeyDictionary[Shape, fcl.BVHModel]" = WeakKeyDictionary()


def _tree(shape: Shape) -> fcl.BVHModel:
    if shape not in _trees:
        tree = fcl.BVHModel()
        tree.beginModel(len(shape.vertices), len(shape.faces))
        tree.addSubModel(shape.vertices, shape.faces)
        tree.endModel()
        _trees[shape] = tree
    return _trees[shape]


def _crossings(first: FloatArray, second: FloatArray) -> FloatArray:
    """Returns the ends (C, 3) of the segments in which pairs of triangles, (P, 3, 3) each, cross; fcl's own points are inaccurate."""
    normals = [np.cross(t[:, 1] - t[:, 0], t[:, 2] - t[:, 0]) for t in (first, second)]
    along = np.cross(normals[0], normals[1])
    ends = []
    for own, other, normal in ((first, second, normals[1]), (second, first, normals[0])):
        height = np.einsum("pvd,pd->pv", own - other[:, :1], normal)
        above = height > 0
        alone = np.where(above.sum(axis=1) == 1, above.argmax(axis=1), above.argmin(axis=1))
        rows = np.arange(len(own))
        crossed = []
        for step in (1, 2):
            a, b = height[rows, alone], height[rows, (alone + step) % 3]
            share = (a / np.where(np.abs(a - b) > 1e-30, a - b, np.inf))[:, None]
            crossed.append(own[rows, alone] * (1 - share) + own[rows, (alone + step) % 3] * share)
        ends.append((np.stack(crossed, axis=1), above.any(axis=1) & ~above.all(axis=1)))
    (one, one_valid), (two, two_valid) = ends
    place = [np.einsum("ped,pd->pe", e, along) for e in (one, two)]
    low, high = (f(g(place[0], axis=1), g(place[1], axis=1)) for f, g in ((np.maximum, np.min), (np.minimum, np.max)))
    size = np.einsum("pd,pd->p", along, along)
    valid = one_valid & two_valid & (size > 0) & (low <= high)
    origin, scale = one[valid, 0], size[valid]
    shifts = [(t[valid] - place[0][valid, 0]) / scale for t in (low, high)]
    return np.concatenate([origin + shift[:, None] * along[valid] for shift in shifts])


class _WholePair:
    """Two whole meshes, of which the first is moved by small vectors to test whether they still cross."""

    def __init__(self, moving: fcl.CollisionObject, standing: fcl.CollisionObject, position: FloatArray) -> None:
        self._moving, self._standing, self._position = moving, standing, position

    def cross(self, way: FloatArray, number: int) -> bool:
        """Whether they touch when the first is moved by a vector (3,), metres; ``number`` is for the interface of `MeshPair`."""
        self._moving.setTranslation(self._position + way)
        return bool(fcl.collide(self._moving, self._standing, _ANY, fcl.CollisionResult()) > 0)

    def normals(self) -> FloatArray | None:
        """Returns the normals of their contacts, (C, 3), or None if they do not touch."""
        request, result = fcl.CollisionRequest(num_max_contacts=_MOST_CONTACTS, enable_contact=True), fcl.CollisionResult()
        if not fcl.collide(self._moving, self._standing, request, result):
            return None
        normals = np.array([c.normal for c in result.contacts])
        return np.unique(normals[np.linalg.norm(normals, axis=1) > 0.5].round(2), axis=0)


class _ThinnedPair(MeshPair):
    """The same interface for the parts of two meshes that are near each other."""

    def normals(self) -> FloatArray | None:
        """Returns the normals of their contacts, (C, 3), or None if they do not touch."""
        contact = self.contact()
        return None if contact is None else contact.normals


class MeshQueries:
    """Queries on the meshes of a scene's objects, at any poses.

    Args:
        shapes: The geometry of each object.
        depth: Allowed penetration, metres; at most the audit's tolerance.
    """

    def __init__(self, shapes: Sequence[Shape], depth: float = TOLERANCE) -> None:
        self.shapes, self._depth = shapes, depth + ROUNDING
        self._extents: dict[tuple[int, float], tuple[FloatArray, FloatArray]] = {}
        self._penetrates: dict[tuple[int, int, bytes], bool] = {}
        self._surfaces: dict[tuple[int, bytes], PosedTriangles] = {}
        self._whole: set[int] = set()  # objects whose bounding-volume tree was used

    def box(self, k: int, pose: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Returns the lowest and the highest corner of an object at a pose (4,), two (3,) metres."""
        yaw = float(pose[3])
        # The extent depends on the yaw alone, and most queries of an object differ only in its position.
        if (k, yaw) not in self._extents:
            posed = self.shapes[k].posed((0.0, 0.0, 0.0, yaw)).T
            self._extents[k, yaw] = posed.min(axis=1), posed.max(axis=1)
        low, high = self._extents[k, yaw]
        return low + pose[:3], high + pose[:3]

    def near(
        self, k: int, pose: FloatArray, others: Sequence[int], poses: FloatArray, gap: float = 0.0, aside: float = 0.0
    ) -> list[int]:
        """Returns the other objects whose boxes meet an object's box, enlarged by ``gap`` downwards and ``aside`` sideways, metres."""
        low, high = self.box(k, pose)
        low, high = low - np.array([aside, aside, gap]), high + np.array([aside, aside, 0.0])
        boxes = [self.box(j, poses[j]) for j in others]
        return [j for j, (a, b) in zip(others, boxes, strict=True) if (low <= b).all() and (high >= a).all()]

    def cross(self, i: int, pose: FloatArray, j: int, other: FloatArray) -> bool:
        """Whether two meshes touch."""
        return self._bodies_cross(self._body(i, pose), self._body(j, other))

    def penetrates(self, i: int, pose: FloatArray, j: int, other: FloatArray) -> bool:
        """Whether two meshes penetrate each other deeper than allowed, by the rule of the audit."""
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
        way = np.zeros(3)
        pair = self._pair(i, pose, j, other)
        normals = pair.normals()
        if normals is not None:
            # Deep if no translation by the allowed depth, in any direction, separates the two.
            for number, way in enumerate(self._depth * np.concatenate([DIRECTIONS, normals, -normals])):
                if not pair.cross(way, number):
                    break
            else:
                return True
        if not within:
            return False
        moved, still = PosedTriangles(self.surface(i, pose).triangles + way), self.surface(j, other)
        return is_nested(moved, still) or is_nested(still, moved)

    def _pair(self, i: int, pose: FloatArray, j: int, other: FloatArray) -> "_WholePair | _ThinnedPair":
        """Returns two meshes for crossing tests: whole if both have been used whole in this scene, else thinned.

        A tree that was built for another scene does not count: near the tolerance the two ways differ, and the result would depend
        on the scenes that a process had before.
        """
        if {i, j} <= self._whole:
            return _WholePair(self._body(i, pose), self._body(j, other), pose[:3])
        return _ThinnedPair(self.surface(i, pose), self.surface(j, other), NEAR)

    def carriers_of(self, k: int, pose: FloatArray, others: Sequence[int], poses: FloatArray) -> list[int]:
        """Returns the other objects that carry an object at a pose, by the rule of the audit."""
        lowered = pose - (0.0, 0.0, NEAR, 0.0)
        near = [j for j in self.near(k, pose, others, poses, NEAR) if self._may_carry(k, pose, lowered, j, poses[j])]
        surface = self.surface(k, pose) if near else None
        return [j for j in near if surface is not None and carries(MeshPair(surface, self.surface(j, poses[j]), NEAR), NEAR)]

    def _may_carry(self, k: int, pose: FloatArray, lowered: FloatArray, j: int, other: FloatArray) -> bool:
        return self.cross(k, lowered, j, other) or self.cross(k, pose, j, other)

    def contact_triangles(self, k: int, pose: FloatArray, j: int, other: FloatArray, reach: float) -> tuple[IntArray, IntArray]:
        """Returns the triangles of both objects that meet when the first is moved down or aside by ``reach``, metres; sorted."""
        moving, standing = self._body(k, pose), self._body(j, other)
        request, pairs = fcl.CollisionRequest(num_max_contacts=_MOST_CONTACTS, enable_contact=True), []
        for way in reach * _AROUND_AND_DOWN:
            moving.setTranslation(pose[:3] + way)
            result = fcl.CollisionResult()
            if fcl.collide(moving, standing, request, result):
                pairs += [(c.b1, c.b2) for c in result.contacts]
        found = np.array(pairs, np.int64).reshape(-1, 2)
        return np.unique(found[:, 0]), np.unique(found[:, 1])

    def support_points(self, k: int, pose: FloatArray, others: Sequence[int], poses: FloatArray) -> FloatArray:
        """Returns the points that carry an object, (C, 3) metres: contacts with others when slightly lowered, and vertices on the table."""
        posed = self.shapes[k].posed(pose)
        points = [posed[posed[:, 2] <= _REACH]]
        moving = self._body(k, pose - (0.0, 0.0, _REACH, 0.0)) if others else None
        request = fcl.CollisionRequest(num_max_contacts=_MOST_CONTACTS, enable_contact=True)
        for j in others:
            result = fcl.CollisionResult()
            if fcl.collide(moving, self._body(j, poses[j]), request, result):
                pairs = np.array([(c.b1, c.b2) for c in result.contacts])
                upper = (posed - (0.0, 0.0, _REACH))[self.shapes[k].faces[pairs[:, 0]]]
                lower = self.shapes[j].posed(poses[j])[self.shapes[j].faces[pairs[:, 1]]]
                points.append(_crossings(upper, lower))
        return np.concatenate(points)

    def is_free(self, k: int, pose: FloatArray, others: Sequence[int], poses: FloatArray) -> bool:
        """Whether an object at a pose (4,) touches none of the other objects."""
        near = self.near(k, pose, others, poses)
        moving = self._body(k, pose) if near else None
        return not any(self._bodies_cross(moving, self._body(j, poses[j])) for j in near)

    def raise_free(self, k: int, pose: FloatArray, others: Sequence[int], poses: FloatArray) -> FloatArray:
        """Returns the pose (4,) of an object, raised by up to 0.4 mm, which one at rest may be above its carriers, to touch none of them.

        Args:
            k: The object.
            pose: Its pose, metres and radians; returned as it is if the object touches others at all of the heights.
            others: The objects that it shall not touch.
            poses: Poses of all objects, (N, 4).
        """
        heights = (pose + np.array([0.0, 0.0, rise, 0.0]) for rise in _RISES)
        return next((there for there in heights if self.is_free(k, there, others, poses)), pose)

    def slide(
        self, k: int, pose: FloatArray, way: FloatArray, others: Sequence[int], poses: FloatArray, at_most: float
    ) -> FloatArray:
        """Returns the pose at which an object that slides in a direction (2,) meets another one, after at most ``at_most`` metres."""
        near = [self._body(j, poses[j]) for j in others]
        moving, there = self._body(k, pose), np.array(pose[:3])

        def touches(distance: float) -> bool:
            there[:2] = pose[:2] + distance * way
            moving.setTranslation(there)
            return any(self._bodies_cross(moving, other) for other in near)

        gone = 0.0
        while gone < at_most and not touches(gone + _STEP):
            gone += _STEP
        until = gone + _STEP
        while until - gone > _FINE:
            middle = (gone + until) / 2
            gone, until = (gone, middle) if touches(middle) else (middle, until)
        slid = np.array(pose)
        slid[:2] += max(0.0, gone - AIR) * way
        return slid

    def resting_height(self, k: int, pose: FloatArray, others: Sequence[int], poses: FloatArray) -> float:
        """Returns the height of an object's centre just above the first contact, when it is lowered from above, metres.

        Args:
            k: The object.
            pose: Its x, y and yaw, (4,); z is not used.
            others: Objects that may stop it, besides the table.
            poses: Poses of all objects, (N, 4).
        """
        floor = float(self.shapes[k].size[2]) / 2
        low, high = self.box(k, pose)
        below = []
        highest = floor
        for j in others:
            other_low, other_high = self.box(j, poses[j])
            if (low[:2] <= other_high[:2]).all() and (high[:2] >= other_low[:2]).all():
                below.append((float(other_high[2]) + floor, self._body(j, poses[j])))
                highest = max(highest, float(other_high[2]) + floor + AIR)
        moving, there = self._body(k, pose), np.array(pose[:3])

        def touches(z: float) -> bool:
            there[2] = z
            moving.setTranslation(there)
            return any(z <= top and self._bodies_cross(moving, other) for top, other in below)

        z = highest
        while touches(z):  # the start is inside another object: higher
            z += _STEP
        while z > floor and not touches(max(floor, z - _STEP)):
            z = max(floor, z - _STEP)
        if z <= floor:
            return floor
        under = z - _STEP
        while z - under > _FINE:
            middle = (z + under) / 2
            z, under = (z, middle) if touches(middle) else (middle, under)
        return z + AIR

    def _body(self, k: int, pose: FloatArray) -> fcl.CollisionObject:
        c, s = np.cos(pose[3]), np.sin(pose[3])
        turn = np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])
        self._whole.add(k)
        return fcl.CollisionObject(_tree(self.shapes[k]), fcl.Transform(turn, np.array(pose[:3])))

    @staticmethod
    def _bodies_cross(one: fcl.CollisionObject, other: fcl.CollisionObject) -> bool:
        return bool(fcl.collide(one, other, _ANY, fcl.CollisionResult()) > 0)

    def surface(self, k: int, pose: FloatArray) -> PosedTriangles:
        """Returns the triangles of an object at a pose."""
        key = (k, pose.tobytes())
        if key not in self._surfaces:
            # A bound of the memory: most poses are asked for only once.
            if len(self._surfaces) > 4 * len(self.shapes):
                self._surfaces.clear()
            self._surfaces[key] = PosedTriangles(self.shapes[k].posed(pose)[self.shapes[k].faces])
        return self._surfaces[key]
