"""What is seen and what collides in a composed USD stage: triangles, materials, primitive shapes."""

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import manifold3d
import numpy as np
import numpy.typing as npt

from stable_data.errors import MeshError
from stable_data.geometry.mesh import Mesh, area_vectors, is_closed, joined_corners
from stable_data.geometry.primitive_shapes import box_triangles, capsule_triangles, cylinder_triangles, sphere_triangles
from stable_data.json_text import quote_value
from stable_data.limits import LIMITS, at_most
from stable_data.scene import FloatArray, IntArray

_ROUND_AXES = {"X": (2, 0, 1), "Y": (1, 2, 0), "Z": (0, 1, 2)}  # of a round shape along z: where x, y and z come from


@dataclass(frozen=True, slots=True, eq=False)
class Faces:
    """The faces of a mesh as triangles.

    Attributes:
        points: (P, 3), in the frame of the prim.
        corners: Points of the corners of the polygons, (C,).
        triangles: Rows of three positions in ``corners``, (T, 3), counter-clockwise seen from outside.
        polygons: The polygon of each triangle, (T,).
    """

    points: FloatArray
    corners: IntArray
    triangles: IntArray
    polygons: IntArray

    def of_corners(self, values: FloatArray, interpolation: str) -> FloatArray | None:
        """Values of a primvar at the corners of the triangles, (T, 3, …); None if there are too few of them."""
        index = {
            "constant": np.zeros_like(self.triangles),
            "uniform": np.repeat(self.polygons[:, None], 3, axis=1),
            "vertex": self.corners[self.triangles],
            "varying": self.corners[self.triangles],
            "faceVarying": self.triangles,
        }.get(interpolation)
        if index is None or not len(values) or (index.size and int(index.max()) >= len(values)):
            return None
        taken: FloatArray = values[index]
        return taken


def faces_of(mesh: Any, time: Any) -> Faces:
    """Reads the polygons of a ``UsdGeom.Mesh``, without those that are holes.

    Raises:
        MeshError: ``model_unreadable`` or ``mesh_not_finite``: its arrays do not fit each other.
    """
    from pxr import UsdGeom

    points = _array(mesh.GetPointsAttr(), time, np.float64).reshape(-1, 3)
    counts = _array(mesh.GetFaceVertexCountsAttr(), time, np.int64)
    corners = _array(mesh.GetFaceVertexIndicesAttr(), time, np.int64)
    path = quote_value(str(mesh.GetPath()))
    if (counts < 0).any() or int(counts.sum()) != len(corners):
        message = f"{path}: its polygons have {int(counts.sum())} corners and {len(corners)} are given, expected as many"
        raise MeshError(message, "model_unreadable")
    if len(corners) and (int(corners.min()) < 0 or int(corners.max()) >= len(points)):
        message = f"{path}: a face refers to point {int(corners.max())}, expected one of its {len(points)}"
        raise MeshError(message, "model_unreadable")
    if not np.isfinite(points).all():
        raise MeshError(f"{path}: a point is not finite, expected numbers; export it again", "mesh_not_finite")
    triangles, polygons = triangulate(points, counts, corners)
    holes = _array(mesh.GetHoleIndicesAttr(), time, np.int64)
    if len(holes):
        kept = ~np.isin(polygons, holes)
        triangles, polygons = triangles[kept], polygons[kept]
    if mesh.GetOrientationAttr().Get(time) == UsdGeom.Tokens.leftHanded:
        triangles = triangles[:, ::-1]
    return Faces(points, corners, triangles, polygons)


def triangulate(points: FloatArray, counts: IntArray, corners: IntArray) -> tuple[IntArray, IntArray]:
    """Divides polygons into triangles that lie inside of them.

    Args:
        points: (P, 3).
        counts: Number of corners of each polygon, (N,).
        corners: Points of the corners, (C,).

    Returns:
        Rows of three positions in ``corners``, (T, 3), and the polygon of each, (T,); in the order of the polygons.
    """
    starts = np.cumsum(counts) - counts
    found, owners = [np.zeros((0, 3), np.int64)], [np.zeros(0, np.int64)]
    for count in np.unique(counts[counts >= 3]):
        polygons = np.flatnonzero(counts == count)
        first, step = starts[polygons][:, None], np.arange(1, count - 1)
        fans = np.stack(np.broadcast_arrays(first, first + step, first + step + 1), axis=2)  # (N, count - 2, 3)
        if count > 3:
            for k in np.flatnonzero(~_fits(points[corners[fans]])):
                start = starts[polygons[k]]
                fans[k] = start + _cut(points[corners[start : start + count]])
        found.append(fans.reshape(-1, 3))
        owners.append(np.repeat(polygons, count - 2))
    triangles, owner = np.concatenate(found), np.concatenate(owners)
    order = np.argsort(owner, kind="stable")
    return triangles[order], owner[order]


def _fits(fans: FloatArray) -> npt.NDArray[np.bool_]:
    """Whether no triangle of a fan (N, T, 3, 3) is turned against the others: then the fan covers its polygon once."""
    normals = np.cross(fans[:, :, 1] - fans[:, :, 0], fans[:, :, 2] - fans[:, :, 0])
    along = np.einsum("ntk,nk->nt", normals, normals.sum(axis=1))
    fits: npt.NDArray[np.bool_] = (along >= -1e-9 * np.abs(along).max(axis=1, keepdims=True)).all(axis=1)
    return fits


def _cut(polygon: FloatArray) -> IntArray:
    """Triangles of a polygon (M, 3) with inner corners, (M - 2, 3)."""
    normal = np.cross(polygon, np.roll(polygon, -1, axis=0)).sum(axis=0)  # Newell's: robust where it is not quite flat
    drop = int(np.abs(normal).argmax())
    flat = np.delete(polygon, drop, axis=1) * ((1, 1) if (normal[drop] > 0) == (drop != 1) else (-1, 1))
    flat = (flat - flat.min(axis=0)) / max(float(np.ptp(flat, axis=0).max()), 1e-300)
    return np.asarray(manifold3d.triangulate([flat]), np.int64)


def simple_shape(prim: Any, time: Any) -> FloatArray | None:
    """Triangles (F, 3, 3) of a cube, sphere, cylinder, capsule or cone in the frame of its prim; None for other prims.

    Raises:
        MeshError: ``model_unreadable``: a size is not more than 0.
    """
    from pxr import UsdGeom

    def size(attribute: Any) -> float:
        value = float(attribute.Get(time))
        if not 0 < value < float("inf"):
            message = f"{quote_value(str(prim.GetPath()))}: the {attribute.GetName()} is {value}, expected more than 0"
            raise MeshError(message, "model_unreadable")
        return value

    if prim.IsA(UsdGeom.Cube):
        return box_triangles() * size(UsdGeom.Cube(prim).GetSizeAttr())
    if prim.IsA(UsdGeom.Sphere):
        return sphere_triangles() * size(UsdGeom.Sphere(prim).GetRadiusAttr())
    for kind, make in ((UsdGeom.Cylinder, cylinder_triangles), (UsdGeom.Capsule, capsule_triangles), (UsdGeom.Cone, _cone)):
        if prim.IsA(kind):
            shape = kind(prim)
            upright = make(size(shape.GetRadiusAttr()), size(shape.GetHeightAttr()))
            order = _ROUND_AXES.get(str(shape.GetAxisAttr().Get(time)), (0, 1, 2))
            return upright[..., order]
    return None


def _cone(radius: float, height: float) -> FloatArray:
    """A cone about the origin along z, (F, 3, 3): a cylinder whose upper rim is one point."""
    triangles = cylinder_triangles(radius, height)
    triangles[triangles[..., 2] > 0, :2] = 0
    kept: FloatArray = triangles[np.linalg.norm(area_vectors(triangles), axis=1) > 0]
    return kept


def collision_shape(prim: Any, triangles: FloatArray) -> Mesh | None:
    """The shape with which a mesh collides, as its approximation says; None if it is not closed.

    Args:
        prim: The mesh.
        triangles: Its triangles, (F, 3, 3), in any frame.
    """
    from pxr import UsdPhysics

    from stable_data.geometry.convex_decomposition import convex_hull

    approximation = UsdPhysics.MeshCollisionAPI(prim).GetApproximationAttr().Get() or "none"
    points = triangles.reshape(-1, 3)
    if not len(points):
        return None
    if approximation == "convexHull":
        return convex_hull(np.unique(points, axis=0))
    low, high = points.min(axis=0), points.max(axis=0)
    if approximation == "boundingCube":
        return joined_corners(box_triangles() * (high - low) + (low + high) / 2)
    if approximation == "boundingSphere":
        radius = float(np.linalg.norm(points - (low + high) / 2, axis=1).max())
        return joined_corners(sphere_triangles() * radius + (low + high) / 2)
    mesh = joined_corners(triangles)
    faces = mesh.faces[(np.diff(np.sort(mesh.faces, axis=1), axis=1) > 0).all(axis=1)]
    return Mesh(mesh.vertices, faces) if len(faces) and is_closed(Mesh(mesh.vertices, faces)) else None


def face_subsets(mesh: Any, num_polygons: int, time: Any) -> Iterator[tuple[Any, npt.NDArray[np.bool_]]]:
    """Yields the parts of a mesh that have one material: the prim with the binding, and which polygons belong to it, (N,) bool."""
    from pxr import UsdGeom, UsdShade

    left = np.ones(num_polygons, bool)
    subsets = UsdShade.MaterialBindingAPI(mesh.GetPrim()).GetMaterialBindSubsets()
    if len(subsets) > LIMITS.model.max_subsets:
        found = f"{quote_value(str(mesh.GetPath()))} has {len(subsets)} subsets"
        raise MeshError(f"{found}, expected {at_most(LIMITS.model, 'max_subsets')}; join them", "mesh_too_large")
    for subset in subsets:
        if subset.GetElementTypeAttr().Get(time) != UsdGeom.Tokens.face:
            continue
        indices = _array(subset.GetIndicesAttr(), time, np.int64)
        chosen = np.zeros(num_polygons, bool)
        chosen[indices[(indices >= 0) & (indices < num_polygons)]] = True
        chosen &= left
        left &= ~chosen
        yield subset.GetPrim(), chosen
    if left.any():
        yield mesh.GetPrim(), left


def _array(attribute: Any, time: Any, kind: type) -> Any:
    """The values of an array attribute, empty if it has none."""
    values = attribute.Get(time)
    return np.zeros(0, kind) if values is None else np.asarray(values, kind)
