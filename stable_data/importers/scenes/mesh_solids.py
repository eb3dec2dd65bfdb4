"""Convex parts of meshes that are seen, for scene files whose bodies have no colliders of their own.

Objects become the convex parts of their assets, hollow where they are hollow. Surroundings often are sheets: a floor is one polygon, a
table top has no lower side. Such a sheet becomes a slab whose seen side stays where it is, so that things stand on it.
"""

from dataclasses import dataclass

import numpy as np
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

from stable_data.errors import MeshError
from stable_data.geometry.convex_decomposition import collider_parts, inside_convex
from stable_data.geometry.mesh import Mesh, double_areas, drop_unused_vertices, is_closed, signed_volumes, unit_normals
from stable_data.geometry.mesh_repair import repair_mesh
from stable_data.geometry.reduction import join_triangles, reduce_mesh
from stable_data.importers.scenes.convex_solids import hull_of
from stable_data.scene import FloatArray, IntArray

_NO_POINTS = np.zeros((0, 3))
_MOST_FACES = 100_000  # triangles of a mesh that is cut; a larger one is reduced first
_MOST_PIECES = 256  # connected pieces of a mesh that are cut one by one
_MOST_CUTS = 48  # pieces and facets of a mesh that are cut; the largest pieces first
_MOST_FACETS = 64  # flat parts of an open piece
_FLAT = 1e-4  # metres, and share of the largest extent: what is thinner is a sheet
_CONVEX = 1e-3  # a piece is convex if its hull has at most this share more volume, a facet if its hull has more area
_SAME_PLANE = np.cos(np.radians(1.0))  # of the normals of neighbouring triangles of a facet
_THICKNESS = 0.02  # of a slab, share of the shorter side of its sheet
_THINNEST, _THICKEST = 0.005, 0.05  # metres


def solid_parts(mesh: Mesh, name: str) -> list[Mesh]:
    """Convex parts of an object.

    Args:
        mesh: Its triangles, metres, not welded.
        name: Its name in messages.

    Raises:
        MeshError: It has no area, or is a line (``mesh_empty``, ``convex_failed``), or is too complex (``mesh_too_complex``).
    """
    return _cut(_welded(mesh, name), name)


def fixed_parts(mesh: Mesh, name: str, down: FloatArray, inside: FloatArray = _NO_POINTS) -> list[Mesh]:
    """Convex parts of something that does not move.

    Args:
        mesh: Its triangles, metres, not welded.
        name: Its name in messages.
        down: The unit vector, (3,), that points down in its frame.
        inside: Centres of things, (N, 3), in its frame. A closed surface that faces inwards around one of them is a room.

    Raises:
        MeshError: It has no area (``mesh_empty``).
    """
    welded, surroundings = _welded(mesh, name), _FixedMesh(down, name)
    pieces = _pieces(welded)
    if len(pieces) > _MOST_PIECES:
        return surroundings.cut(welded)
    found: dict[int, list[Mesh]] = {}
    if len(inside):
        rooms = {k: piece for k, piece in enumerate(pieces) if _is_room(piece, inside)}
        pieces = [p for k, p in enumerate(pieces) if k in rooms or not any(_is_around(p, room) for room in rooms.values())]
    for k in sorted(range(len(pieces)), key=lambda k: (-float(pieces[k].extents.max()), k)):  # the largest are cut first
        found[k] = surroundings.parts(pieces[k], is_room=len(inside) > 0 and _is_room(pieces[k], inside))
    return [part for k in range(len(pieces)) for part in found[k]]


def _welded(mesh: Mesh, name: str) -> Mesh:
    welded, _ = join_triangles([mesh.triangles], name)
    return reduce_mesh(welded, _MOST_FACES)[0]


def _cut(mesh: Mesh, name: str) -> list[Mesh]:
    middle = (mesh.vertices.min(axis=0) + mesh.vertices.max(axis=0)) / 2
    # The repair moves the box to the origin; its centre is that of the points it keeps.
    repaired, _, _ = repair_mesh(Mesh(mesh.vertices - middle, mesh.faces), name)
    return [Mesh(part.vertices + middle, part.faces) for part in collider_parts(repaired)]


def _hull(points: FloatArray) -> list[Mesh]:
    hull = hull_of(points)
    return [] if hull is None else [hull]


def _pieces(mesh: Mesh) -> list[Mesh]:
    """The pieces of a mesh that share no vertex, in the order of their first faces."""
    a, b, c = mesh.faces.T
    return _groups(mesh, _linked(np.concatenate([a, b]), np.concatenate([b, c]), len(mesh.vertices))[a])


def _linked(one: IntArray, other: IntArray, count: int) -> IntArray:
    """The group of each of ``count`` things, (count,), of which pairs (P,) and (P,) are linked."""
    links = coo_array((np.ones(len(one), np.int8), (one, other)), shape=(count, count))
    return connected_components(links, directed=False)[1].astype(np.int64)


def _groups(mesh: Mesh, labels: IntArray) -> list[Mesh]:
    """The faces of each label, in the order of their first faces."""
    order = np.argsort(labels, kind="stable")
    starts = np.flatnonzero(np.diff(labels[order], prepend=-1))
    rows = sorted(np.split(order, starts[1:]), key=lambda group: int(group[0]))
    return [Mesh(*drop_unused_vertices(mesh.vertices, mesh.faces[group])) for group in rows]


@dataclass(slots=True)
class _FixedMesh:
    """Divides the pieces of a mesh that does not move into convex parts.

    Attributes:
        down: The unit vector, (3,), that points down in its frame.
        name: Its name in messages.
        num_cuts: Pieces that may still be cut; the others become hulls.
    """

    down: FloatArray
    name: str
    num_cuts: int = _MOST_CUTS

    def parts(self, piece: Mesh, *, is_room: bool = False) -> list[Mesh]:
        """The convex parts of a connected piece; those of a room are behind its walls."""
        if is_room:
            return [part for facet in _facets(piece) for part in self.slab(facet, is_seen=True)]
        thickness, extent = _flatness(piece.vertices), float(piece.extents.max())
        if thickness <= max(_FLAT, _FLAT * extent):
            return self.slab(piece)
        hull = hull_of(piece.vertices)
        if hull is None:
            return []
        if is_closed(piece):
            volume, most = abs(float(signed_volumes(piece.triangles).sum())), float(signed_volumes(hull.triangles).sum())
            return [hull] if volume >= (1 - _CONVEX) * most else self.cut(piece)
        facets = _facets(piece)
        if len(facets) > _MOST_FACETS:
            return self.cut(piece)
        return [part for facet in facets for part in self.slab(facet)]

    def cut(self, mesh: Mesh) -> list[Mesh]:
        """The convex parts of any mesh; its hull if it cannot be cut."""
        self.num_cuts -= 1
        try:
            return _cut(mesh, self.name) if self.num_cuts >= 0 else _hull(mesh.vertices)
        except MeshError:
            return _hull(mesh.vertices)

    def slab(self, sheet: Mesh, *, is_seen: bool = False) -> list[Mesh]:
        """A sheet with a thickness behind its front; below it, if it is rather level, unless it is known to be seen from its front."""
        normals, areas = unit_normals(sheet.triangles)
        kept = areas > 1e-12 * areas.max()
        normal = normals[int(areas.argmax())]
        facing = kept & (normals @ normal > 0)  # not the other side of a sheet with two
        sides = sheet.vertices @ np.linalg.svd(normal[None])[2][1:].T
        thickness = float(np.clip(_THICKNESS * np.ptp(sides, axis=0).min(), _THINNEST, _THICKEST))
        behind = -normal
        if not is_seen and abs(normal @ self.down) > np.sqrt(0.5):
            behind = normal * np.sign(normal @ self.down)
        solid = hull_of(np.concatenate([sheet.vertices, sheet.vertices + thickness * behind]))
        if solid is None:
            return []
        area = float(double_areas(sheet)[facing].sum()) / 2
        if area * thickness >= (1 - _CONVEX) * abs(float(signed_volumes(solid.triangles).sum())):
            return [solid]
        flat = Mesh(*drop_unused_vertices(sheet.vertices, sheet.faces[facing]))
        return self.cut(_prism(flat, thickness * behind))


def _is_room(piece: Mesh, inside: FloatArray) -> bool:
    """Whether a closed surface of few flat sides faces inwards and has one of some points, (N, 3), inside."""
    if not is_closed(piece) or float(signed_volumes(piece.triangles).sum()) >= 0:
        return False
    hull = hull_of(piece.vertices)
    return hull is not None and bool(inside_convex(hull, inside).any()) and len(_facets(piece)) <= _MOST_FACETS


def _is_around(piece: Mesh, room: Mesh) -> bool:
    """Whether a piece is the outer side of the walls of a room."""
    hull = hull_of(piece.vertices)
    return is_closed(piece) and hull is not None and bool(inside_convex(hull, room.vertices).all())


def _flatness(points: FloatArray) -> float:
    """Extent of points (P, 3) across the plane that fits them best."""
    centred = points - points.mean(axis=0)
    _, axes = np.linalg.eigh(centred.T @ centred)
    return float(np.ptp(centred @ axes[:, 0]))


def _facets(mesh: Mesh) -> list[Mesh]:
    """Groups of neighbouring triangles that lie in one plane."""
    normals, _ = unit_normals(mesh.triangles)
    edges = np.sort(mesh.faces[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2), axis=1)
    faces = np.repeat(np.arange(len(mesh.faces)), 3)
    order = np.lexsort((faces, edges[:, 1], edges[:, 0]))
    edges, faces = edges[order], faces[order]
    shared = (edges[1:] == edges[:-1]).all(axis=1)
    one, other = faces[:-1][shared], faces[1:][shared]
    level = np.einsum("ij,ij->i", normals[one], normals[other]) > _SAME_PLANE
    return _groups(mesh, _linked(one[level], other[level], len(mesh.faces)))


def _prism(sheet: Mesh, shift: FloatArray) -> Mesh:
    """The closed solid between a flat sheet and its copy at a distance, (3,)."""
    count, faces = len(sheet.vertices), sheet.faces
    edges = faces[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2)
    keys, back = edges[:, 0] * count + edges[:, 1], edges[:, 1] * count + edges[:, 0]
    rim = edges[~np.isin(keys, back)]
    sides = np.concatenate(
        [
            np.column_stack([rim[:, 1], rim[:, 0], rim[:, 0] + count]),
            np.column_stack([rim[:, 1], rim[:, 0] + count, rim[:, 1] + count]),
        ]
    )
    solid = np.concatenate([faces, faces[:, ::-1] + count, sides])
    normals, areas = unit_normals(sheet.triangles)
    if normals[int(areas.argmax())] @ shift > 0:
        solid = solid[:, ::-1]
    return Mesh(np.concatenate([sheet.vertices, sheet.vertices + shift]), solid)
