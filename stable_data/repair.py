"""Repair of a mesh: closed and outward where it can be, open where it could hold something."""

from dataclasses import dataclass

import igl
import numpy as np

from stable_data.errors import Notice
from stable_data.mesh import Edges, Mesh, area_vectors, centred, double_areas, signed_volumes, unit_normals
from stable_data.scene import FloatArray, IntArray

_CRACK = 0.03  # a hole narrower than this share of the largest extent is damage, not a mouth
_SLIVER = 1e-4  # so is one of less area than this share of the surface
_SMALL_MOUTH = 0.02  # share of the surface up to which a hole that does not look up is a cut end, not a hollow
_BURIED = 0.75  # winding number at a mouth's centre above which it lies inside the object: 0.5 alone, 1.5 inside another part
_NUM_PROBES = 512


@dataclass(frozen=True, slots=True)
class MeshReport:
    """What a mesh is like after repair, and what repair did.

    Attributes:
        num_vertices: Vertices.
        num_faces: Faces.
        is_watertight: Every edge joins exactly two faces that run against each other along it.
        was_watertight: The same before repair.
        is_solid: It encloses a volume that can be relied on: closed but for slivers.
        is_sheet: It does not: open, and to be treated as a thin shell whose hollow is outside.
        num_components: Parts that share no edge.
        num_boundary_edges: Edges of one face.
        num_nonmanifold_edges: Edges of more than two faces.
        num_flipped_faces: Faces that repair turned round.
        volume: Enclosed volume, cubic mesh units; overlapping parts count twice, 0 for a sheet.
        area: Surface, squared mesh units, one side.
        actions: What was done, in plain words.
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


def repair(mesh: Mesh, asset_id: str) -> tuple[Mesh, MeshReport, tuple[Notice, ...]]:
    """Makes a mesh as closed and outward as it can be without filling anything that could hold something.

    A hole is closed where it is a crack, where its mouth lies inside the object (the buried end of a handle), or where it is
    small and does not open upwards. The mouth of a bowl, a cup or a vase is none of these.

    Args:
        mesh: As loaded.
        asset_id: Named in notices.

    Returns:
        The repaired mesh, its report, and ``glb_inside_out`` where all of it had to be turned.
    """
    actions = []
    before = Edges.of(mesh.faces)
    faces = _without_duplicates(mesh.faces)
    if len(faces) < len(mesh.faces):
        actions.append(f"dropped {len(mesh.faces) - len(faces)} duplicate faces")
    given, faces = faces, _oriented(faces)
    component = igl.facet_components(faces)[1]
    vertices, caps, cap_component = _caps(mesh.vertices, faces, component)
    faces, caps = _turned_outward(vertices, faces, component, caps, cap_component)
    num_flipped = int((faces != given).any(axis=1).sum())
    if num_flipped:
        actions.append(f"turned {num_flipped} of {len(faces)} faces")
    filled = [
        cap for cap in caps if _is_back_of_sheet(vertices, faces, component, cap) or _is_safe_to_fill(vertices, faces, cap)
    ]
    if filled:
        actions.append(f"closed {len(filled)} of {len(caps)} holes")
    repaired = centred(vertices, np.concatenate([faces, *filled]))
    report = _report(repaired, before.is_watertight, num_flipped, tuple(actions))
    if report.is_solid and num_flipped > len(given) / 2:
        message = f"asset {asset_id}: {num_flipped} of {len(given)} faces looked inwards; turned"
        return repaired, report, (Notice(asset_id, "mesh", "glb_inside_out", message),)
    return repaired, report, ()


def _without_duplicates(faces: IntArray) -> IntArray:
    """One of faces on the same corners; neither of two that look against each other, unless all do (a sheet drawn twice)."""
    corners = np.sort(faces, axis=1)
    _, first, index, count = np.unique(corners, axis=0, return_index=True, return_inverse=True, return_counts=True)
    index = index.reshape(-1)
    if len(first) == len(faces):
        return faces
    is_even = (
        (faces == corners).all(axis=1)
        | (faces == corners[:, [1, 2, 0]]).all(axis=1)
        | (faces == corners[:, [2, 0, 1]]).all(axis=1)
    )
    cancels = (np.bincount(index, np.where(is_even, 1, -1)) == 0) & (count > 1)
    if cancels.sum() <= 0.1 * len(first):
        first = first[~cancels]
    return faces[np.sort(first)]


def _oriented(faces: IntArray) -> IntArray:
    """Neighbours running against each other along their edge, each patch the way most of its faces were."""
    edges = Edges.of(faces)
    if (edges.balance[edges.count == 2] == 0).all():
        return faces
    oriented, patch = igl.bfs_orient(faces)
    kept = np.where((oriented == faces).all(axis=1), 1, -1)
    minority = (np.bincount(patch, kept) < 0)[patch]
    is_turned = (kept < 0) ^ minority
    return np.where(is_turned[:, None], faces[:, ::-1], faces)


def _loops(boundary: IntArray) -> list[list[int]]:
    """Closed chains of boundary edges, each run against its faces: the way a cap's own edges run."""
    following: dict[int, list[int]] = {}
    for a, b in boundary.tolist():
        following.setdefault(b, []).append(a)
    loops = []
    while following:
        start = vertex = next(iter(following))
        loop: list[int] = []
        while vertex in following:
            loop.append(vertex)
            ways = following[vertex]
            vertex = ways.pop()
            if not ways:
                del following[loop[-1]]
            if vertex == start:
                loops.append(loop)
                break
    return loops


def _caps(vertices: FloatArray, faces: IntArray, component: IntArray) -> tuple[FloatArray, list[IntArray], IntArray]:
    """A fan over every hole: vertices with the fans' centres appended, faces of each fan, the component that each closes."""
    owner = np.zeros(len(vertices), np.int64)
    owner[faces] = component[:, None]
    loops = _loops(Edges.of(faces).boundary())
    centres = [vertices[loop].mean(axis=0) for loop in loops]
    caps = [
        np.stack([loop, np.roll(loop, -1), np.full(len(loop), len(vertices) + n)], axis=1).astype(np.int64)
        for n, loop in enumerate(loops)
    ]
    return np.concatenate([vertices, np.reshape(centres, (-1, 3))]), caps, owner[[loop[0] for loop in loops]]


def _turned_outward(
    vertices: FloatArray, faces: IntArray, component: IntArray, caps: list[IntArray], cap_component: IntArray
) -> tuple[IntArray, list[IntArray]]:
    """Faces and caps with every part looking outwards; a part inside another that looks inwards is a cavity and stays."""
    closed = np.concatenate([faces, *caps])
    label = np.concatenate([component, np.repeat(cap_component, [len(cap) for cap in caps])])
    volume = np.bincount(label, signed_volumes(vertices[closed]))
    noise = 1e-9 * np.ptp(vertices, axis=0).max() ** 3
    is_turned = np.full(len(volume), volume.sum() < -noise)
    volume = np.where(is_turned, -volume, volume)
    for part in np.flatnonzero(volume < -noise):
        others = closed[label != part]
        point = vertices[closed[label == part][0]].mean(axis=0, keepdims=True)
        is_cavity = len(others) and abs(igl.winding_number(vertices, others, point)[0]) > 0.5
        is_turned[part] ^= not is_cavity
    faces = np.where(is_turned[component][:, None], faces[:, ::-1], faces)
    return faces, [cap[:, [1, 0, 2]] if is_turned[part] else cap for cap, part in zip(caps, cap_component, strict=True)]


def _is_back_of_sheet(vertices: FloatArray, faces: IntArray, component: IntArray, cap: IntArray) -> bool:
    """Whether a cap lies flat on faces that have the same rim: a plate of no thickness, which may have a back."""
    own = component == component[(faces == cap[0, 0]).any(axis=1)][0]
    beneath = np.isin(faces, cap[:, 0]).all(axis=1)
    area = double_areas(Mesh(vertices, cap)).sum()
    ratios = [double_areas(Mesh(vertices, faces[some])).sum() / max(area, 1e-300) for some in (own, beneath)]
    return any(0.95 < ratio < 1.05 for ratio in ratios)


def _is_safe_to_fill(vertices: FloatArray, faces: IntArray, cap: IntArray) -> bool:
    """Whether closing a hole cannot close a hollow that something could lie in."""
    corners = vertices[cap]
    normals = area_vectors(corners) / 2
    normal, rim = normals.sum(axis=0), corners[:, 0]
    area, fan_area = float(np.linalg.norm(normal)), float(np.linalg.norm(normals, axis=1).sum())
    surface = double_areas(Mesh(vertices, faces)).sum() / 2
    is_slit = area <= _SLIVER * surface and fan_area <= 10 * _SLIVER * surface
    if is_slit or np.ptp(rim, axis=0).max() <= _CRACK * np.ptp(vertices, axis=0).max():
        return True
    if area < 0.9 * fan_area:
        return False  # far from planar: not a cut end
    if area <= _SMALL_MOUTH * surface and normal[2] <= 0.5 * area:
        return True
    # At its mouth's centre a part counts itself half; more can only come from what surrounds the mouth.
    return bool(igl.winding_number(vertices, faces, corners[:1, 2])[0] > _BURIED)


def _report(mesh: Mesh, was_watertight: bool, num_flipped: int, actions: tuple[str, ...]) -> MeshReport:
    edges = Edges.of(mesh.faces)
    volume = float(signed_volumes(mesh.triangles).sum())
    area = float(double_areas(mesh).sum() / 2)
    is_solid = volume > 1e-9 * mesh.extents.max() ** 3 and _encloses(mesh, edges)
    return MeshReport(
        num_vertices=len(mesh.vertices),
        num_faces=len(mesh.faces),
        is_watertight=edges.is_watertight,
        was_watertight=was_watertight,
        is_solid=is_solid,
        is_sheet=not is_solid,
        num_components=int(igl.facet_components(mesh.faces)[0]),
        num_boundary_edges=int((edges.count == 1).sum()),
        num_nonmanifold_edges=int((edges.count > 2).sum()),
        num_flipped_faces=num_flipped,
        volume=volume if is_solid else 0.0,
        area=area,
        actions=actions,
    )


def _encloses(mesh: Mesh, edges: Edges) -> bool:
    """Whether points just outside nearly all of the surface count as outside by winding number (or inside another part)."""
    if (edges.balance == 0).all():
        return True
    double_area = double_areas(mesh)
    mouths = [mesh.vertices[loop] for loop in _loops(edges.boundary())]
    widest = max(
        (float(np.linalg.norm(np.cross(m - m[0], np.roll(m, -1, axis=0) - m[0]).sum(axis=0))) for m in mouths), default=0.0
    )
    if widest > 10 * _SLIVER * double_area.sum():
        return False
    picked = np.searchsorted(np.cumsum(double_area), (np.arange(_NUM_PROBES) + 0.5) / _NUM_PROBES * double_area.sum())
    corners = mesh.triangles[np.minimum(picked, len(mesh.faces) - 1)]
    outside = corners.mean(axis=1) + 1e-4 * mesh.extents.max() * unit_normals(corners)[0]
    winding = igl.winding_number(mesh.vertices, mesh.faces, outside)
    return bool((np.abs(winding - np.round(winding)) < 0.25).mean() >= 0.95)
