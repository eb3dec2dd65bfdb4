"""The geometry of one object: its mesh at its scale and tilt, in its yaw frame."""

from dataclasses import dataclass
from functools import cached_property

import numpy as np
import numpy.typing as npt
import shapely
from scipy.spatial.transform import Rotation

from stable_data.geometry.mesh import Mesh
from stable_data.rotations import rotate_xy
from stable_data.scene import FloatArray, IntArray, QuatXyzw, Vec3

_BOX_CORNERS = np.array([[x, y, z] for x in (-0.5, 0.5) for y in (-0.5, 0.5) for z in (-0.5, 0.5)])
_BOX_SIDES = np.array([[0, 1, 3, 2], [4, 6, 7, 5], [0, 4, 5, 1], [2, 3, 7, 6], [0, 2, 6, 4], [1, 5, 7, 3]])
_BOX_FACES = _BOX_SIDES[:, [0, 1, 2, 0, 2, 3]].reshape(-1, 3)  # each side is split along a diagonal
_MOST_ANGLES = 1 << 14  # solid angles that are computed at a time


@dataclass(frozen=True, eq=False)
class Shape:
    """A triangle mesh in an object's yaw frame, centred on its box.

    Attributes:
        vertices: (V, 3) float64, metres, yaw frame; the box of the referenced ones is centred on the origin.
        faces: (F, 3) int64, wound outwards.
        is_exact: False for a box that replaces a missing or broken mesh: a verdict that depends on it is unknown.
        center_of_mass: The centre of mass that is known of the object, (3,) float64, metres, yaw frame; None: not known.
    """

    vertices: FloatArray
    faces: IntArray
    is_exact: bool = True
    center_of_mass: FloatArray | None = None

    @classmethod
    def from_mesh(cls, mesh: Mesh, scale: Vec3, tilt_quat_xyzw: QuatXyzw, center_of_mass: FloatArray | None = None) -> "Shape":
        """Scales, tilts and centres a mesh; the result is in metres, yaw frame.

        Args:
            mesh: Mesh units, z up.
            scale: Metres per mesh unit along the mesh's axes.
            tilt_quat_xyzw: Rotation before yaw, unit.
            center_of_mass: Its centre of mass at this scale, (3,), metres, frame of the mesh; None: not known.
        """
        turn = Rotation.from_quat(tilt_quat_xyzw).as_matrix().T
        vertices = (mesh.vertices * np.asarray(scale)) @ turn
        low, high = vertices.min(axis=0), vertices.max(axis=0)
        centre = (low + high) / 2
        known = None if center_of_mass is None else center_of_mass @ turn - centre
        return cls(np.ascontiguousarray(vertices - centre), mesh.faces, center_of_mass=known)

    @classmethod
    def box(cls, size: Vec3) -> "Shape":
        """Creates the box that replaces a missing mesh, metres."""
        return cls(_BOX_CORNERS * np.asarray(size), _BOX_FACES, is_exact=False)

    @property
    def ordered_mesh(self) -> Mesh:
        """The surface with its faces in an order that depends on the surface alone: a stored mesh has another one than its source."""
        _, place = np.unique(self.vertices, axis=0, return_inverse=True)
        corners = place.reshape(-1)[self.faces]
        turn = (corners.argmin(axis=1)[:, None] + np.arange(3)) % 3  # the least corner first, with the same orientation
        corners = np.take_along_axis(corners, turn, axis=1)
        return Mesh(self.vertices, np.take_along_axis(self.faces, turn, axis=1)[np.lexsort(corners.T[::-1])])

    def as_mesh(self) -> "Shape":
        """Returns the shape as if its geometry were known: a box that replaces a mesh counts as that box."""
        return self if self.is_exact else Shape(self.vertices, self.faces)

    @cached_property
    def size(self) -> FloatArray:
        """Extent of the box, (3,) float64, metres, yaw frame."""
        extent: FloatArray = np.ptp(self.vertices, axis=0)
        return extent

    @cached_property
    def footprint(self) -> FloatArray:
        """Convex hull of the horizontal projection, (K, 2) float64, metres, yaw frame, counter-clockwise, not closed."""
        hull = shapely.convex_hull(shapely.linestrings(self.vertices[:, :2]))  # a line is built ten times faster than points
        if hull.geom_type != "Polygon":  # a needle or an upright sheet: widen it, so that it has an area
            hull = hull.buffer(1e-5)
        return np.array(shapely.orient_polygons(hull).exterior.coords)[:-1]

    def posed(self, pose: npt.ArrayLike) -> FloatArray:
        """Vertices in the world frame, (V, 3) float64, metres, at a pose (4,): x, y, z in metres and yaw in radians."""
        x, y, z, yaw = np.asarray(pose, np.float64)
        c, s = np.cos(yaw), np.sin(yaw)
        rotated = np.empty_like(self.vertices)
        rotated[:, 0] = c * self.vertices[:, 0] - s * self.vertices[:, 1] + x
        rotated[:, 1] = s * self.vertices[:, 0] + c * self.vertices[:, 1] + y
        rotated[:, 2] = self.vertices[:, 2] + z
        return rotated

    def posed_footprint(self, pose: npt.ArrayLike) -> FloatArray:
        """Footprint in the world frame, (K, 2) float64, metres."""
        x, y, _, yaw = np.asarray(pose, np.float64)
        posed: FloatArray = rotate_xy(self.footprint, yaw) + np.array((x, y))
        return posed


def winding_number(points: FloatArray, triangles: FloatArray) -> FloatArray:
    """How often triangles (F, 3, 3) wind around points (P, 3), (P,) float64: 1 inside, 0 outside of a closed outward mesh.

    Sums exact solid angles (Van Oosterom and Strackee 1983), so holes in the mesh change the result only gradually. Meant for a few
    points: libigl first builds a tree, which takes ten times as long.
    """
    corners = np.ascontiguousarray(np.moveaxis(triangles, 0, 2))[:, :, None]  # (corner, axis, 1, F): whole rows are fast
    total, width = np.zeros(len(points)), min(max(len(triangles), 1), _MOST_ANGLES)
    for start in range(0, len(points), step := max(1, _MOST_ANGLES // width)):
        asked = points[start : start + step].T[:, :, None]
        for first in range(0, len(triangles), width):
            (ax, ay, az), (bx, by, bz), (cx, cy, cz) = (corner[..., first : first + width] - asked for corner in corners)
            la, lb, lc = (np.sqrt(x * x + y * y + z * z) for x, y, z in ((ax, ay, az), (bx, by, bz), (cx, cy, cz)))
            numerator = ax * (by * cz - bz * cy) + ay * (bz * cx - bx * cz) + az * (bx * cy - by * cx)
            ab, bc, ca = ax * bx + ay * by + az * bz, bx * cx + by * cy + bz * cz, cx * ax + cy * ay + cz * az
            total[start : start + step] += np.arctan2(numerator, la * lb * lc + ab * lc + bc * la + ca * lb).sum(1)
    return total / (2 * np.pi)
