"""Mesh repair: closes and orients a mesh as far as possible, but leaves openings that can hold objects."""

from dataclasses import dataclass, replace
from typing import TypeAlias

import igl
import numpy as np
import numpy.typing as npt
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components, minimum_spanning_tree
from scipy.spatial import KDTree

from stable_data.errors import MeshError, Notice
from stable_data.geometry.mesh import Edges, Mesh, area_vectors, center_vertices, double_areas, signed_volumes, unit_normals
from stable_data.geometry.shape import winding_number
from stable_data.limits import LIMITS, at_most
from stable_data.scene import FloatArray, IntArray

_CRACK = 0.03  # a narrower hole, share of the largest extent, is damage and not a mouth
_SLIVER = 1e-4  # a hole of a smaller area, share of the surface, is damage too
_SMALL_MOUTH = 0.02  # share of the surface up to which a hole that does not open upwards is a cut end and not a hollow
# Winding number at a mouth's centre above which the mouth is inside the object: 0.5 alone, 1.5 inside another part.
_BURIED_WINDING = 0.75
_NUM_PROBES = 512

BoolArray: TypeAlias = npt.NDArray[np.bool_]


@dataclass(frozen=True, slots=True)
class MeshReport:
    """Properties of a mesh after repair, and the actions of the repair.

    Attributes:
        num_vertices: Vertices.
        num_faces: Faces.
        is_watertight: Every edge joins exactly two faces that use it in opposite directions.
        was_watertight: The same before repair.
        is_solid: The mesh encloses a reliable volume: it is closed except for slivers.
        is_sheet: The opposite: an open mesh, treated as a thin shell whose hollow is outside.
        num_components: Parts that share no edge.
        num_boundary_edges: Edges of one face.
        num_nonmanifold_edges: Edges of more than two faces.
        num_flipped_faces: Faces whose orientation the repair reversed.
        volume: Enclosed volume, cubic mesh units; overlapping parts count twice, 0 for a sheet.
        area: Surface, squared mesh units, one side.
        actions: The actions of the repair, in words.
    """

    num_vertices: int
    num_faces: int
    is_watertight: bool
    was_watertight: bool
    is_solid: bool
    is_sheet: bool
    num_components: int
    num_boundary_edges: int
    num_nonmanifold_edges: int
    num_flipped_faces: int
    volume: float
    area: float
    actions: tuple[str, ...]


def repair_mesh(mesh: Mesh, asset_id: str) -> tuple[Mesh, MeshReport, tuple[Notice, ...]]:
    """Closes and orients a mesh as far as possible without filling a hollow that could hold an object.

    A hole is closed if it is a crack, if its mouth is inside the object (the hidden end of a handle), or if it is small and does not
    open upwards. The mouth of a bowl, a cup or a vase is none of these.

    Args:
        mesh: As loaded.
        asset_id: The asset's name in notices.

    Returns:
        The repaired mesh, its coordinates rounded to float32; its report; and the notice ``glb_inside_out`` if most faces of a solid
        had to be reversed.

    Raises:
        MeshError: ``mesh_too_complex``: it has more parts or holes than the limits, or their arrangement makes repair too slow.
    """
    actions = []
    before = Edges.of(mesh.faces)
    faces = drop_duplicate_faces(mesh.faces)
    if len(faces) < len(mesh.faces):
        actions.append(f"dropped {len(mesh.faces) - len(faces)} duplicate faces")
    original, faces = faces, _orient_faces(faces)
    part = _part_of_faces(faces)
    _check_limit(asset_id, "parts", int(part.max()) + 1, "max_repair_parts")
    vertices, caps = _caps(mesh.vertices, faces, part, asset_id)
    is_reversed = _is_inside_out(vertices, faces, part, caps, asset_id)
    faces = np.where(is_reversed[part][:, None], faces[:, ::-1], faces)
    caps = caps.with_reversed(is_reversed)
    num_flipped = int((faces != original).any(axis=1).sum())
    if num_flipped:
        actions.append(f"turned {num_flipped} of {len(faces)} faces")
    is_filled = _is_back_of_sheet(vertices, faces, part, caps, asset_id)
    is_filled |= _is_safe_to_fill(vertices, faces, caps, ~is_filled, asset_id)
    if is_filled.any():
        actions.append(f"closed {is_filled.sum()} of {len(is_filled)} holes")
    centred = center_vertices(vertices, np.concatenate([faces, caps.faces[is_filled[caps.hole]]]))
    # As a file stores it: the mesh that is judged is then the mesh that a run has.
    repaired = Mesh(centred.vertices.astype(np.float32), centred.faces)
    report = mesh_report(repaired, was_watertight=before.is_watertight, num_flipped=num_flipped, actions=tuple(actions))
    if report.is_solid and num_flipped > len(original) / 2:
        message = f"asset {asset_id}: {num_flipped} of {len(original)} faces pointed inwards; they were reversed"
        return repaired, report, (Notice(asset_id, "mesh", "glb_inside_out", message),)
    return repaired, report, ()


def drop_duplicate_faces(faces: IntArray) -> IntArray:
    """Drops duplicate faces, and both of two opposite faces on the same corners, unless all are such (a sheet drawn twice)."""
    corners = np.sort(faces, axis=1)
    _, first, index, count = np.unique(corners, axis=0, return_index=True, return_inverse=True, return_counts=True)
    index = index.reshape(-1)
    if len(first) == len(faces):
        return faces
    # An even permutation of the sorted corners is one orientation, an odd one the other.
    is_even = (
        (faces == corners).all(axis=1)
        | (faces == corners[:, [1, 2, 0]]).all(axis=1)
        | (faces == corners[:, [2, 0, 1]]).all(axis=1)
    )
    cancels = (np.bincount(index, np.where(is_even, 1, -1)) == 0) & (count > 1)
    if cancels.sum() <= 0.1 * len(first):  # a larger share means a sheet drawn twice
        first = first[~cancels]
    return faces[np.sort(first)]


def _check_limit(asset_id: str, what: str, count: int, limit: str) -> None:
    if count > getattr(LIMITS.work, limit):
        message = f"asset {asset_id}: repair found {count} {what}, expected {at_most(LIMITS.work, limit)}; simplify the mesh"
        raise MeshError(message, "mesh_too_complex")


def _orient_faces(faces: IntArray) -> IntArray:
    """Gives neighbours opposite directions along their edge, and each patch the orientation of most of its faces."""
    edges = Edges.of(faces)
    is_shared = edges.count == 2
    if (edges.balance[is_shared] == 0).all():
        return faces
    num = len(faces)
    users = np.argsort(edges.of_faces.ravel(), kind="stable") // 3  # faces, edge by edge
    first = (np.cumsum(edges.count) - edges.count)[is_shared]
    one, other, clashes = users[first], users[first + 1], edges.balance[is_shared] != 0
    _, once = np.unique(one * num + other, return_index=True)  # a sheet drawn twice shares three edges with itself
    neighbours = coo_array((1 + clashes[once], (one[once], other[once])), shape=(num, num))
    # In a tree each face is reached in one way, even on a patch with a single side. This tree crosses the fewest clashing edges.
    tree = minimum_spanning_tree(neighbours).tocoo()
    patch = connected_components(tree, directed=False)[1]
    is_crossed = tree.data > 1
    # Every face appears twice, as it is and reversed; connected entries have the same orientation.
    a = np.concatenate([tree.row, tree.row + num])
    b = np.concatenate([tree.col + num * is_crossed, tree.col + num * ~is_crossed])
    side = connected_components(coo_array((np.ones(len(a)), (a, b)), shape=(2 * num, 2 * num)), directed=False)[1][:num]
    is_reversed = side != side[np.unique(patch, return_index=True)[1]][patch]
    is_reversed ^= (np.bincount(patch, np.where(is_reversed, -1, 1)) < 0)[patch]
    return np.where(is_reversed[:, None], faces[:, ::-1], faces)


def _part_of_faces(faces: IntArray) -> IntArray:
    """The part of every face, (F,): faces that share an edge belong to one part, even if more than two meet there."""
    edges, num = Edges.of(faces), len(faces)
    size = num + len(edges.corners)
    joined = coo_array((np.ones(3 * num), (np.repeat(np.arange(num), 3), num + edges.of_faces.ravel())), shape=(size, size))
    return connected_components(joined, directed=False)[1][:num].astype(np.int64)


def _rims(boundary: IntArray) -> tuple[IntArray, IntArray]:
    """Joins boundary edges to closed chains, each in the direction in which the edges of a cap run.

    Returns:
        The edges (B, 2), hole by hole, and the hole of each (B,).
    """
    following: dict[int, list[int]] = {}
    for a, b in boundary.tolist():
        following.setdefault(b, []).append(a)
    rims: list[tuple[int, int]] = []
    lengths = []
    for start, next_vertices in following.items():
        while next_vertices:
            num_before, vertex, after = len(rims), start, None
            while after != start:
                after = following[vertex].pop()
                rims.append((vertex, after))
                vertex = after
            lengths.append(len(rims) - num_before)
    return np.array(rims, np.int64).reshape(-1, 2), np.repeat(np.arange(len(lengths)), lengths)


def _sums(values: FloatArray, group: IntArray) -> FloatArray:
    """Sums rows (B, 3) by group, (G, 3)."""
    return np.stack([np.bincount(group, column) for column in values.T], axis=1)


@dataclass(frozen=True, slots=True, eq=False)
class _Caps:
    """A fan of triangles over every hole, from the rim to its centre.

    Attributes:
        faces: (B, 3), hole by hole; the last corner is the centre.
        hole: The hole of each, (B,).
        start: The first face of each hole, (H,).
        part: The part of each hole, (H,).
    """

    faces: IntArray
    hole: IntArray
    start: IntArray
    part: IntArray

    def with_reversed(self, is_reversed: BoolArray) -> "_Caps":
        """Reverses the fans of some parts (P,)."""
        return replace(self, faces=np.where(is_reversed[self.part[self.hole]][:, None], self.faces[:, [1, 0, 2]], self.faces))


def _caps(vertices: FloatArray, faces: IntArray, part: IntArray, asset_id: str) -> tuple[FloatArray, _Caps]:
    """Appends the centre of every hole to the vertices, and creates the fans."""
    owner = np.zeros(len(vertices), np.int64)
    owner[faces] = part[:, None]
    rims, hole = _rims(Edges.of(faces).boundary())
    count = np.bincount(hole)
    _check_limit(asset_id, "holes", len(count), "max_repair_parts")
    start = np.cumsum(count) - count
    caps = np.concatenate([rims, len(vertices) + hole[:, None]], axis=1)
    centres = _sums(vertices[rims[:, 0]], hole) / count[:, None]
    return np.concatenate([vertices, centres]), _Caps(caps, hole, start, owner[rims[start, 0]])


def _is_inside_out(vertices: FloatArray, faces: IntArray, part: IntArray, caps: _Caps, asset_id: str) -> BoolArray:
    """Whether each part must be reversed, (P,); an inward part inside another part is a cavity and stays."""
    closed = np.concatenate([faces, caps.faces])
    label = np.concatenate([part, caps.part[caps.hole]])
    volume = np.bincount(label, signed_volumes(vertices[closed]))
    noise = 1e-9 * np.ptp(vertices, axis=0).max() ** 3
    is_reversed = np.full(len(volume), volume.sum() < -noise)
    volume = np.where(is_reversed, -volume, volume)
    inward = np.flatnonzero(volume < -noise)
    if len(inward):
        points = vertices[faces[np.unique(part, return_index=True)[1][inward]]].mean(axis=1)
        order = np.argsort(label, kind="stable")
        winding = _winding_of_others(vertices, closed[order], label[order], points, inward, asset_id)
        is_reversed[inward] ^= np.abs(winding) <= 0.5
    return is_reversed


def _winding_of_others(
    vertices: FloatArray, closed: IntArray, label: IntArray, points: FloatArray, own: IntArray, asset_id: str
) -> FloatArray:
    """Winding numbers (K,) of all other parts around points (K, 3), each of which is on its own part (K,).

    The faces (F, 3) are sorted by part. A closed part winds only around points in its box.
    """
    corners = vertices[closed]
    count = np.bincount(label)
    start = np.cumsum(count) - count
    low, high = np.minimum.reduceat(corners.min(axis=1), start), np.maximum.reduceat(corners.max(axis=1), start)
    tree, centre, reach = KDTree(points), (low + high) / 2, (high - low).max(axis=1) * (0.5 + 1e-9)
    num_near = tree.query_ball_point(centre, reach, p=np.inf, return_length=True)
    _check_limit(asset_id, "pairs of parts in each other's boxes", int(num_near.sum()), "max_repair_pairs")
    winding, num_asked, around = np.zeros(len(points)), 0, np.flatnonzero(num_near)
    found = tree.query_ball_point(centre[around], reach[around], p=np.inf, return_sorted=True) if len(around) else ()
    for k, near in zip(around, map(np.array, found), strict=True):
        inside = near[((points[near] >= low[k]) & (points[near] <= high[k])).all(axis=1) & (own[near] != k)]
        if len(inside):
            num_asked += len(inside) * int(count[k])
            _check_limit(asset_id, "faces around points in other parts", num_asked, "max_repair_sums")
            winding[inside] += winding_number(points[inside], corners[start[k] : start[k] + count[k]])
    return winding


def _is_back_of_sheet(vertices: FloatArray, faces: IntArray, part: IntArray, caps: _Caps, asset_id: str) -> BoolArray:
    """Whether each cap lies flat on faces with the same rim, (H,): a plate without thickness, whose back may be closed."""
    if not len(caps.start):
        return np.zeros(0, bool)
    surface = double_areas(Mesh(vertices, faces))
    area = np.maximum(np.bincount(caps.hole, double_areas(Mesh(vertices, caps.faces))), 1e-300)
    face, hole = _beneath(len(vertices), faces, caps, asset_id)
    ratios = np.stack([np.bincount(part, surface)[caps.part], np.bincount(hole, surface[face], len(area))]) / area
    own, beneath = (ratios > 0.95) & (ratios < 1.05)
    is_back: BoolArray = own | beneath
    return is_back


def _beneath(num_vertices: int, faces: IntArray, caps: _Caps, asset_id: str) -> tuple[IntArray, IntArray]:
    """Returns pairs of a face and a hole whose rim contains all three corners of the face."""
    num = len(caps.start)
    on_rim = np.unique(caps.faces[:, 0] * num + caps.hole)  # (corner, hole), sorted
    count = np.bincount(on_rim // num, minlength=num_vertices)
    start = np.cumsum(count) - count
    # The corner that is on the fewest rims gives the fewest candidates.
    rarest = np.take_along_axis(faces, count[faces].argmin(axis=1)[:, None], axis=1)[:, 0]
    _check_limit(asset_id, "pairs of a face and a hole that touch", int(count[rarest].sum()), "max_repair_pairs")
    face = np.repeat(np.arange(len(faces)), count[rarest])
    step = np.arange(len(face)) - np.repeat(np.cumsum(count[rarest]) - count[rarest], count[rarest])
    hole = on_rim[start[rarest[face]] + step] % num
    keep = np.isin(faces[face] * num + hole[:, None], on_rim).all(axis=1)
    return face[keep], hole[keep]


def _is_safe_to_fill(vertices: FloatArray, faces: IntArray, caps: _Caps, is_asked: BoolArray, asset_id: str) -> BoolArray:
    """Whether closing a hole cannot close a hollow that could hold an object, (H,), for the requested holes."""
    if not is_asked.any():
        return np.zeros(len(is_asked), bool)
    corners = vertices[caps.faces]
    normals, rim = area_vectors(corners) / 2, corners[:, 0]
    normal, fan_area = _sums(normals, caps.hole), np.bincount(caps.hole, np.linalg.norm(normals, axis=1))
    area, surface = np.linalg.norm(normal, axis=1), double_areas(Mesh(vertices, faces)).sum() / 2
    width = (np.maximum.reduceat(rim, caps.start) - np.minimum.reduceat(rim, caps.start)).max(axis=1)
    is_slit = (area <= _SLIVER * surface) & (fan_area <= 10 * _SLIVER * surface)
    is_safe: BoolArray = is_slit | (width <= _CRACK * np.ptp(vertices, axis=0).max())
    is_cut_end = area >= 0.9 * fan_area  # the mouth is nearly planar
    is_safe |= is_cut_end & (area <= _SMALL_MOUTH * surface) & (normal[:, 2] <= 0.5 * area)
    is_safe &= is_asked
    # At the centre of its mouth a part alone has winding number 0.5; a larger one means that another part surrounds the mouth.
    rest = np.flatnonzero(is_cut_end & is_asked & ~is_safe)
    if len(rest):
        _check_limit(asset_id, "faces around holes, hole by hole", len(rest) * len(faces), "max_repair_sums")
        # Exact sums: at a point in the plane of a rim, libigl's tree gives a different number each time.
        is_safe[rest] = winding_number(corners[caps.start[rest], 2], vertices[faces]) > _BURIED_WINDING
    return is_safe


def mesh_report(
    mesh: Mesh, *, was_watertight: bool | None = None, num_flipped: int = 0, actions: tuple[str, ...] = ()
) -> MeshReport:
    """Returns the properties of a mesh that is used as it is.

    Args:
        mesh: The mesh.
        was_watertight: Whether it was closed before it was repaired; None if it was not repaired.
        num_flipped: Faces that the repair reversed.
        actions: Its actions.
    """
    edges = Edges.of(mesh.faces)
    volume = float(signed_volumes(mesh.triangles).sum())
    area = float(double_areas(mesh).sum() / 2)
    is_solid = volume > 1e-9 * mesh.extents.max() ** 3 and _encloses(mesh, edges)
    return MeshReport(
        num_vertices=len(mesh.vertices),
        num_faces=len(mesh.faces),
        is_watertight=edges.is_watertight,
        was_watertight=edges.is_watertight if was_watertight is None else was_watertight,
        is_solid=is_solid,
        is_sheet=not is_solid,
        num_components=int(_part_of_faces(mesh.faces).max()) + 1,
        num_boundary_edges=int((edges.count == 1).sum()),
        num_nonmanifold_edges=int((edges.count > 2).sum()),
        num_flipped_faces=num_flipped,
        volume=volume if is_solid else 0.0,
        area=area,
        actions=actions,
    )


def _encloses(mesh: Mesh, edges: Edges) -> bool:
    """Whether points just outside nearly all of the surface are outside by winding number (or inside another part)."""
    if (edges.balance == 0).all():
        return True
    double_area = double_areas(mesh)
    rims, hole = _rims(edges.boundary())
    apex = mesh.vertices[rims[np.unique(hole, return_index=True)[1], 0]][hole]
    # The area vector of a hole is the same for every surface that fills it.
    mouths = _sums(np.cross(mesh.vertices[rims[:, 0]] - apex, mesh.vertices[rims[:, 1]] - apex), hole)
    widest = float(np.linalg.norm(mouths, axis=1).max(initial=0.0))
    if widest > 10 * _SLIVER * double_area.sum():
        return False
    picked = np.searchsorted(np.cumsum(double_area), (np.arange(_NUM_PROBES) + 0.5) / _NUM_PROBES * double_area.sum())
    corners = mesh.triangles[np.minimum(picked, len(mesh.faces) - 1)]
    outside = corners.mean(axis=1) + 1e-4 * mesh.extents.max() * unit_normals(corners)[0]
    winding = igl.fast_winding_number(mesh.vertices, mesh.faces, outside)  # to 0.01; exact numbers take seven times as long
    return bool((np.abs(winding - np.round(winding)) < 0.25).mean() >= 0.95)
