"""Convex parts of a mesh for a physics engine: the convex hull if it is accurate enough, else cut pieces that keep hollows open.

Planes cut the solid exactly (manifold3d), always the worst piece first, until the hull of every piece is accurate enough or the
budget of parts is used up. Two rules keep containers hollow. A cut is rated by the empty volume that the hulls of its pieces
still cover. If no single plane reduces this volume (a bowl cut once is as full as before), a fan of planes through the middle of
the hollow is tried.
"""

import heapq
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from functools import cache, partial
from typing import TypeAlias

import fast_simplification
import igl
import manifold3d
import numpy as np
import vhacdx
from scipy.spatial import ConvexHull, QhullError

from stable_data.errors import MeshError
from stable_data.geometry.mesh import Mesh, area_vectors, double_areas, is_closed, join_meshes, signed_volumes, unit_normals
from stable_data.geometry.surface_sampling import sample_surface
from stable_data.scene import FloatArray

ConvexPart: TypeAlias = Mesh
"""A closed convex mesh, faces outward."""

Solid: TypeAlias = manifold3d.Manifold

_MAX_FACES = 3000  # of a solid that is cut; a larger one is simplified first
_SIMPLIFY = 0.002  # tolerance of the fallback simplification, share of the largest extent
_SHELL = 0.01  # thickness given to a sheet, share of its largest extent
_PLATE = 1e-3  # thickness given to a flat part of a solid, share of the mesh's largest extent
_SLAB = 0.1  # two parallel flat parts nearer than this are the two sides of one slab
_MIN_SOLID_VOLUME = 1e-6  # a smaller volume, share of the cubed extent, is that of a sheet
_MIN_VOLUME = 1e-9  # a piece of a smaller volume is dropped
_FRACTIONS = (0.15, 0.3, 0.5, 0.7, 0.85)  # positions along an axis at which planes are tried
_ENOUGH = 0.8  # a single plane is enough if it leaves less than this share of the empty volume
_FAN_PLANES = 4
_FAN_HANDICAP = 1.2  # a fan makes more parts than a single plane, so it must be better by this factor
_NUM_PROBES = 2048
_NEGLIGIBLE = 1e-7  # smaller distances count as zero, share of the largest extent
_NUM_DEPTH_PROBES = 200


@dataclass(frozen=True, slots=True, eq=False)
class ConvexParts:
    """Convex parts that approximate a mesh, and their accuracy. Distances are sampled, in the mesh's unit.

    Attributes:
        parts: At least one.
        method: ``given`` (they came with the mesh), ``hull``, ``cuts``, or ``vhacd`` (an open mesh that could not be given a
            thickness).
        overfill_max: Largest distance by which the parts extend out of the mesh, for example into a hollow.
        overfill_mean: Mean of this distance over the parts' surface; points within the mesh count as 0.
        uncovered_max: Largest distance by which the mesh extends out of the parts.
        uncovered_mean: Mean of this distance over the mesh's surface; points within a part count as 0.
        hull_distance: ``overfill_max`` of the mesh's convex hull, for comparison.
    """

    parts: tuple[ConvexPart, ...]
    method: str
    overfill_max: float
    overfill_mean: float
    uncovered_max: float
    uncovered_mean: float
    hull_distance: float


def convex_parts(
    mesh: Mesh, *, given: Sequence[ConvexPart] = (), kept: bool = False, max_parts: int = 32, tolerance: float = 0.01
) -> ConvexParts:
    """Splits a mesh into few convex parts that follow its surface; the same mesh always gives the same parts.

    Args:
        mesh: Repaired (``stable_data.geometry.mesh_repair``), any unit. An open one is a shell of 1 % of its largest extent.
        given: Parts that came with the mesh, in its frame. They are used if they are convex and within the tolerance, whatever
            their number.
        kept: Use the given parts unchanged, bit for bit, because a physics engine has already used them.
        max_parts: Largest number of parts.
        tolerance: Overfill at which cutting stops, share of the largest extent; a hull within it is used without cutting.

    Returns:
        The parts and their distances, in the mesh's frame and unit.

    Raises:
        MeshError: ``convex_failed``: the mesh gives no part with a volume.
    """
    cutting = _Cutting(mesh, max_parts, tolerance)
    if kept and given:
        parts, method = tuple(cutting.in_units(part) for part in given), "given"
    else:
        parts, method = cutting.choose(given)
    distances = [*cutting.overfill(parts), *cutting.uncovered(parts), cutting.overfill((cutting.hull,))[0]]
    own = tuple(given) if kept and given else cutting.in_frame(parts)
    return ConvexParts(own, method, *(cutting.extent * d for d in distances))


def collider_parts(mesh: Mesh, *, given: Sequence[ConvexPart] = ()) -> tuple[ConvexPart, ...]:
    """Returns only the parts of :func:`convex_parts`: faster, because it measures only what the choice depends on."""
    cutting = _Cutting(mesh)
    return cutting.in_frame(cutting.choose(given)[0])


def is_true_to(mesh: Mesh, parts: Sequence[ConvexPart]) -> bool:
    """Whether convex parts follow a mesh so well that :func:`convex_parts` takes them, in the frame and unit of the mesh.

    Raises:
        MeshError: ``convex_failed``: the mesh is a line or a point.
    """
    return _Cutting(mesh, max_parts=1).choose(parts)[1] == "given"


def hull_of_mesh(mesh: Mesh) -> ConvexPart:
    """Returns the convex hull of a mesh, in its frame and unit; that of a flat mesh is 1 % of its largest extent thick.

    Raises:
        MeshError: ``convex_failed``: the mesh is a line or a point.
    """
    cutting = _Cutting(mesh)
    return cutting.in_frame((cutting.hull,))[0]


class _Cutting:
    """A mesh in units of its largest extent, with cached accuracy measures of parts."""

    def __init__(self, mesh: Mesh, max_parts: int = 32, tolerance: float = 0.01) -> None:
        self.center, self.extent = (mesh.vertices.min(axis=0) + mesh.vertices.max(axis=0)) / 2, float(mesh.extents.max())
        self._unit, self._max_parts, self._tolerance = self.in_units(mesh), max_parts, tolerance
        hull = convex_hull(self._unit.vertices) or _thick_hull(self._unit.vertices, _SHELL)
        if hull is None:
            message = f"mesh with extents {mesh.extents}: no convex hull has a volume, expected a surface that is not flat"
            raise MeshError(message, "convex_failed")
        self.hull = hull
        self.overfill = cache(partial(_overfill, self._unit))
        self.uncovered = cache(partial(_uncovered, self._unit))

    def choose(self, given: Sequence[ConvexPart]) -> tuple[tuple[Mesh, ...], str]:
        """Chooses the parts, in units, and names the method."""
        parts = tuple(filter(None, (convex_hull(self.in_units(part).vertices) for part in given)))
        if parts and max(self.overfill(parts)[0], self.uncovered(parts)[0]) <= self._tolerance:
            return parts, "given"
        parts, method = (), ""
        if self.overfill((self.hull,))[0] > max(self._tolerance, _SHELL):
            parts, method = _divide(self._unit, self._max_parts, self._tolerance)
        return (parts, method) if parts else ((self.hull,), "hull")

    def in_frame(self, parts: tuple[Mesh, ...]) -> tuple[Mesh, ...]:
        """Converts parts to the frame and unit of the mesh."""
        return tuple(Mesh(part.vertices * self.extent + self.center, part.faces) for part in parts)

    def in_units(self, mesh: Mesh) -> Mesh:
        """Converts a mesh to units of the largest extent."""
        return Mesh((mesh.vertices - self.center) / self.extent, mesh.faces)


def _divide(unit: Mesh, max_parts: int, tolerance: float) -> tuple[tuple[Mesh, ...], str]:
    """Returns several parts and their method; no parts if none could be made."""
    solid, plates = _solid_and_plates(unit)
    if solid is None:
        return _vhacd(unit, max_parts), "vhacd"
    plates = plates[: max_parts // 2]
    hulls = [convex_hull(_mesh(piece.solid).vertices) for piece in _cut_repeatedly(solid, max_parts - len(plates), tolerance)]
    return (*(hull for hull in hulls if hull is not None), *plates), "cuts"


def _manifold(mesh: Mesh) -> Solid | None:
    """The solid that a closed mesh bounds, or None if its faces do not bound one."""
    solid = manifold3d.Manifold(manifold3d.Mesh64(mesh.vertices, mesh.faces.astype(np.uint64)))
    return solid if solid.status() == manifold3d.Error.NoError and solid.volume() > _MIN_SOLID_VOLUME else None


def _mesh(solid: Solid) -> Mesh:
    raw = solid.to_mesh64()
    return Mesh(np.asarray(raw.vert_properties, np.float64)[:, :3], np.asarray(raw.tri_verts).astype(np.int64))


def _solid_and_plates(unit: Mesh) -> tuple[Solid | None, tuple[Mesh, ...]]:
    """Returns a solid without overlaps, and its flat parts, which have no thickness, as thin convex parts.

    An open mesh becomes a shell. The solid is None if the mesh does not bound one.
    """
    if not is_closed(unit):
        return _manifold(_shell(unit)), ()
    patch = igl.bfs_orient(unit.faces)[1]  # patches of connected faces
    corners = {n: unit.vertices[np.unique(unit.faces[patch == n])] for n in range(patch.max() + 1)}
    flat = [n for n in corners if _is_plate(corners[n])]
    sheets = [corners[n] for n in flat]
    is_sheet = np.isin(patch, flat)
    solid = _manifold(Mesh(unit.vertices, unit.faces[~is_sheet]))
    if solid is None:
        return _manifold(_shell(unit)), ()
    pieces = solid.decompose()
    # A cavity has a negative volume and must stay in its shell.
    if len(pieces) > 1 and all(piece.volume() > 0 for piece in pieces):
        solid = manifold3d.Manifold.batch_boolean(pieces, manifold3d.OpType.Add)
    return _simplify_solid(solid), tuple(_plates(sheets))


def _simplify_solid(solid: Solid) -> Solid:
    """Reduces a solid to about ``_MAX_FACES`` faces, by quadric collapse if the result still bounds a solid."""
    if solid.num_tri() <= _MAX_FACES:
        return solid
    collapsed = _manifold(_collapse_faces(_mesh(solid)))
    return solid.simplify(_SIMPLIFY) if collapsed is None else collapsed


def _collapse_faces(mesh: Mesh) -> Mesh:
    if len(mesh.faces) <= _MAX_FACES:
        return mesh
    vertices, faces = fast_simplification.simplify(
        mesh.vertices.astype(np.float32), mesh.faces.astype(np.int32), target_count=_MAX_FACES
    )
    return Mesh(vertices, faces)


def _is_plate(corners: FloatArray) -> bool:
    return float(np.ptp((corners - corners.mean(axis=0)) @ _flattest_direction(corners))) < _PLATE


def _plates(sheets: list[FloatArray]) -> Iterator[Mesh]:
    """Thin convex parts of flat sheets (V, 3); two parallel sheets close to each other are the two sides of one slab."""
    while sheets:
        sheet = sheets.pop(0)
        normal = _flattest_direction(sheet)
        for k, other in enumerate(sheets):
            is_parallel = abs(float(normal @ _flattest_direction(other))) > 0.99
            if is_parallel and np.linalg.norm(sheet.mean(axis=0) - other.mean(axis=0)) < _SLAB:
                sheet = np.concatenate([sheet, sheets.pop(k)])
                break
        part = _thick_hull(sheet, _PLATE)
        if part is not None:
            yield part


def _flattest_direction(points: FloatArray) -> FloatArray:
    spread = points - points.mean(axis=0)
    direction: FloatArray = np.linalg.eigh(spread.T @ spread)[1][:, 0]
    return direction


def _shell(unit: Mesh) -> Mesh:
    """Both sides of a sheet, moved by half the shell's thickness along the vertex normals and joined along the rim."""
    normal = np.zeros_like(unit.vertices)
    np.add.at(normal, unit.faces.ravel(), np.repeat(area_vectors(unit.triangles), 3, axis=0))
    offset = _SHELL / 2 * normal / np.maximum(np.linalg.norm(normal, axis=1, keepdims=True), 1e-300)
    rim, num = igl.boundary_facets(unit.faces)[0], len(unit.vertices)
    a, b = rim.astype(np.int64).T
    joints = np.concatenate([np.stack([b, a, a + num], axis=1), np.stack([b, a + num, b + num], axis=1)])
    return Mesh(
        np.concatenate([unit.vertices + offset, unit.vertices - offset]),
        np.concatenate([unit.faces, unit.faces[:, ::-1] + num, joints]),
    )


def convex_hull(points: FloatArray) -> Mesh | None:
    """Convex hull of points (P, 3), None if they are flat. By Qhull, because hulls of manifold3d may fold at slivers."""
    try:
        hull = ConvexHull(points)
    except QhullError:
        return None
    faces = np.searchsorted(np.sort(hull.vertices), hull.simplices).astype(np.int64)
    corners = points[np.sort(hull.vertices)]
    is_inward = np.einsum("ij,ij->i", area_vectors(corners[faces]), hull.equations[:, :3]) < 0
    return Mesh(corners, np.where(is_inward[:, None], faces[:, ::-1], faces))


def _thick_hull(points: FloatArray, thickness: float) -> Mesh | None:
    """Hull of flat points (P, 3), moved apart across their plane so that the hull has a volume."""
    offset = _flattest_direction(points) * thickness / 2
    return convex_hull(np.concatenate([points + offset, points - offset]))


def _empty_volume(solid: Solid) -> float:
    """Volume inside the hull and outside the solid."""
    return max(0.0, float(solid.hull().volume() - solid.volume()))


def _halves(solid: Solid, normal: FloatArray, offset: float) -> tuple[Solid, ...]:
    """Splits a solid by a plane; returns the solid itself if one side is empty."""
    halves = tuple(half for half in solid.split_by_plane(tuple(normal), offset) if half.volume() > _MIN_VOLUME)
    return halves if len(halves) == 2 else (solid,)


@dataclass(order=True, slots=True)
class _Piece:
    """A piece of the solid; the piece with the smallest rank is cut next."""

    rank: float
    number: int
    solid: Solid = field(compare=False)
    depth: float = field(compare=False)


def _cut_repeatedly(solid: Solid, max_parts: int, tolerance: float) -> list[_Piece]:
    """Cuts the worst piece until all hulls are accurate or the budget is used up."""
    queue, done = [_piece(solid, 0)], list[_Piece]()
    number = 1
    while queue and len(queue) + len(done) < max_parts:
        worst = heapq.heappop(queue)
        solids = _cut(worst.solid, max_parts - len(queue) - len(done)) if worst.depth > tolerance else ()
        if not solids:
            done.append(worst)
        for part in solids:
            heapq.heappush(queue, _piece(part, number))
            number += 1
    return sorted(done + queue, key=lambda piece: piece.number)  # in the order of creation


def _piece(solid: Solid, number: int) -> _Piece:
    """Ranks a piece by depth and volume: depth alone prefers slits, volume alone never cuts thin hollows."""
    hull, mesh = _mesh(solid.hull()), _mesh(solid)
    # Samples may miss a small face of the hull, so the centre of every face is a probe too.
    probes = np.concatenate([sample_surface(hull, _NUM_DEPTH_PROBES), hull.triangles.mean(axis=1)])
    depth = float(np.sqrt(igl.point_mesh_squared_distance(probes, mesh.vertices, mesh.faces)[0].max()))
    return _Piece(-depth * _empty_volume(solid) ** (1 / 3), number, solid, depth)


def _cut(solid: Solid, room: int) -> tuple[Solid, ...]:
    """Returns the pieces of the best cut: by one plane, or by a fan if no plane helps and the budget allows it; () for none."""
    best: tuple[Solid, ...] = ()
    best_left = np.inf
    for normal, offset in _planes(_mesh(solid)):
        halves = _halves(solid, normal, offset)
        left = sum(_empty_volume(half) for half in halves)
        if len(halves) == 2 and left < best_left:
            best, best_left = halves, left
    if best_left < _ENOUGH * _empty_volume(solid) or room < 2 * _FAN_PLANES:
        return best
    middle = _middle_of_hollow(solid)
    for axis in range(3):
        fan: tuple[Solid, ...] = (solid,)
        for angle in (np.arange(_FAN_PLANES) + 0.5) * np.pi / _FAN_PLANES:
            normal = np.roll([0.0, np.cos(angle), np.sin(angle)], axis)
            fan = tuple(half for part in fan for half in _halves(part, normal, float(normal @ middle)))
        left = _FAN_HANDICAP * sum(_empty_volume(part) for part in fan)
        if len(fan) > 1 and left < best_left:
            best, best_left = fan, left
    return best


def _planes(mesh: Mesh) -> Iterator[tuple[FloatArray, float]]:
    """Candidate planes as normal and offset, across the principal axes of the piece and the axes of the mesh."""
    weight = double_areas(mesh)
    middles = mesh.triangles.mean(axis=1)
    spread = middles - weight @ middles / weight.sum()
    # Cuts of a large piece are slow, and its pieces are soon small enough for all fractions.
    fractions = _FRACTIONS if len(mesh.faces) <= _MAX_FACES else _FRACTIONS[1:4]
    for normal in (*np.linalg.eigh((spread * weight[:, None]).T @ spread)[1].T, *np.eye(3)):
        along = mesh.vertices @ normal
        for fraction in fractions:
            yield normal, float(along.min() + fraction * np.ptp(along))


def _middle_of_hollow(solid: Solid) -> FloatArray:
    """Centroid (3,) of the volume inside the hull and outside the solid."""
    moment, volume = np.zeros(3), 0.0
    for mesh, sign in ((_mesh(solid.hull()), 1.0), (_mesh(solid), -1.0)):
        weight = sign * signed_volumes(mesh.triangles)
        moment += weight @ mesh.triangles.sum(axis=1) / 4
        volume += weight.sum()
    return moment / max(volume, 1e-12)


def _vhacd(unit: Mesh, max_parts: int) -> tuple[Mesh, ...]:
    """Decomposes any triangle soup with V-HACD, coarsely; may find no part."""
    few = _collapse_faces(unit)
    found = vhacdx.compute_vhacd(
        few.vertices, few.faces.astype(np.uint32), maxConvexHulls=max_parts, resolution=100_000, asyncACD=False
    )
    return tuple(filter(None, (convex_hull(np.asarray(points, np.float64)) for points, _ in found)))


def _overfill(unit: Mesh, parts: tuple[Mesh, ...]) -> tuple[float, float]:
    """Largest and mean distance by which the parts' surface extends out of the mesh."""
    points = sample_surface(join_meshes(parts), _NUM_PROBES)
    distance = np.sqrt(igl.point_mesh_squared_distance(points, unit.vertices, unit.faces)[0])
    # Only these need the slow inside test, and accurate parts have few of them.
    away = np.flatnonzero(distance > _NEGLIGIBLE)
    if is_closed(unit) and len(away):
        distance[away[igl.fast_winding_number(unit.vertices, unit.faces, points[away]) > 0.5]] = 0
    return float(distance.max()), float(distance.mean())


def _uncovered(unit: Mesh, parts: tuple[Mesh, ...]) -> tuple[float, float]:
    """Largest and mean distance by which the mesh's surface extends out of the union of the parts."""
    points, joined = sample_surface(unit, _NUM_PROBES), join_meshes(parts)
    distance = np.sqrt(igl.point_mesh_squared_distance(points, joined.vertices, joined.faces)[0])
    away = np.flatnonzero(distance > _NEGLIGIBLE)
    distance[away[np.any([inside_convex(part, points[away]) for part in parts], axis=0)]] = 0
    return float(distance.max()), float(distance.mean())


def inside_convex(part: ConvexPart, points: FloatArray) -> np.ndarray[tuple[int], np.dtype[np.bool_]]:
    """Whether each point (P, 3) lies in a convex part, (P,) bool."""
    corners = part.triangles
    normals, double_area = unit_normals(corners)
    has_area = double_area > 1e-12 * double_area.max()  # a sliver's normal is noise
    normals, corners = normals[has_area], corners[has_area]
    heights: FloatArray = points @ normals.T - np.einsum("ij,ij->i", normals, corners[:, 0])
    inside: np.ndarray[tuple[int], np.dtype[np.bool_]] = (heights <= 1e-6 * part.extents.max()).all(axis=1)
    return inside
