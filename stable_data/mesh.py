"""A triangle mesh: read from untrusted GLB bytes, repaired without losing its hollow, weighed.

Mesh frame: z up, centred on its box, in the file's own units (``SceneObject.scale`` turns them into metres).
"""

import json
import struct
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, NoReturn

import igl
import numpy as np
import numpy.typing as npt

from stable_data.errors import MeshError, Notice
from stable_data.scene import FloatArray, IntArray

_WELD = 1e-6  # vertices nearer than this share of the largest extent are one
_FLAT = 1e-12  # a face of less area than this share of the squared extent is no face
_SMALLEST = 1e-30  # extents beyond this and its inverse lose their squares and cubes to rounding
_CRACK = 0.03  # a hole narrower than this share of the largest extent is damage, not a mouth
_SLIVER = 1e-4  # so is one of less area than this share of the surface
_SMALL_MOUTH = 0.02  # share of the surface up to which a hole that does not look up is a cut end, not a hollow
_BURIED = 0.75  # winding number at a mouth's centre above which it lies inside the object: 0.5 alone, 1.5 inside another part
_NUM_PROBES = 512

_MAGIC, _JSON_CHUNK, _BIN_CHUNK = 0x46546C67, 0x4E4F534A, 0x004E4942
_COMPONENTS = {5120: "<i1", 5121: "<u1", 5122: "<i2", 5123: "<u2", 5125: "<u4", 5126: "<f4"}
_TRIANGLES, _STRIP, _FAN = 4, 5, 6
# Required extensions that change how a surface looks, or that the accessor reader covers, not where it is.
_HARMLESS = (
    "KHR_materials_",
    "KHR_texture_",
    "EXT_texture_",
    "MSFT_texture_",
    "KHR_lights_",
    "KHR_xmp",
    "KHR_mesh_quantization",
)
# What json, struct, numpy and plain indexing raise on hostile content.
_HOSTILE = (
    KeyError,
    IndexError,
    TypeError,
    ValueError,
    AttributeError,
    OverflowError,
    RecursionError,
    MemoryError,
    struct.error,
)


@dataclass(frozen=True, slots=True, eq=False)
class Mesh:
    """A triangle mesh.

    Attributes:
        vertices: (V, 3) float64, C-contiguous.
        faces: Corner indices, (F, 3) int64, C-contiguous, counter-clockwise seen from outside.
    """

    vertices: FloatArray
    faces: IntArray

    def __post_init__(self) -> None:
        """Makes the arrays contiguous, so that every geometry library takes them without a copy."""
        object.__setattr__(self, "vertices", np.ascontiguousarray(self.vertices, np.float64))
        object.__setattr__(self, "faces", np.ascontiguousarray(self.faces, np.int64))

    @property
    def extents(self) -> FloatArray:
        """Size of the box, (3,) float64."""
        extents: FloatArray = np.ptp(self.vertices, axis=0)
        return extents

    @property
    def triangles(self) -> FloatArray:
        """Corners of every face, (F, 3, 3) float64."""
        return self.vertices[self.faces]


@dataclass(frozen=True, slots=True)
class MeshLimits:
    """What a mesh file may cost.

    Attributes:
        max_bytes: Size of the file.
        max_faces: Triangles, instances of a mesh counted each.
        max_nodes: Nodes of the file's scene.
    """

    max_bytes: int = 128 * 2**20
    max_faces: int = 1_000_000
    max_nodes: int = 10_000


def load_glb(data: bytes | Path, asset_id: str, *, limits: MeshLimits = MeshLimits()) -> tuple[Mesh, tuple[Notice, ...]]:
    """Reads a binary glTF as one mesh: geometry only, no texture, no second file.

    Args:
        data: The file, or its content. Not trusted: sizes are checked against its true length, and no URI in it is opened.
        asset_id: Named in messages.
        limits: Sizes beyond which the file is refused.

    Returns:
        The mesh, file units, z up, node transforms applied, vertices welded, centred on its box; and what was odd about it.

    Raises:
        MeshError: It cannot be used; ``code`` is ``glb_truncated``, ``glb_zero_bytes``, ``glb_nan_vertices``, ``glb_no_faces``,
            ``glb_degenerate_only``, ``glb_too_large``, ``glb_unsupported`` or ``glb_invalid``.
    """
    content = _read_bytes(data, asset_id, limits) if isinstance(data, Path) else data
    reader = _GlbReader(asset_id, limits)
    try:
        with np.errstate(over="ignore", invalid="ignore"):  # huge numbers end as a MeshError below, not as a warning
            return _welded(*reader.read(content), reader), tuple(reader.notices)
    except MeshError:
        raise
    except _HOSTILE as error:
        reader.fail(
            "glb_invalid", f"breaks the glTF 2.0 format ({type(error).__name__}: {error})", "a valid GLB; export it again"
        )


def _read_bytes(path: Path, asset_id: str, limits: MeshLimits) -> bytes:
    size = path.stat().st_size
    if size > limits.max_bytes:
        raise MeshError(f"asset {asset_id}: file has {size} bytes, expected at most {limits.max_bytes}", "glb_too_large")
    return path.read_bytes()


@dataclass(slots=True)
class _GlbReader:
    """One pass over one file: every size in it is checked against the bytes that are really there."""

    asset_id: str
    limits: MeshLimits
    notices: list[Notice] = field(default_factory=list)
    document: dict[str, Any] = field(default_factory=dict)
    binary: bytes = b""

    def fail(self, code: str, found: str, expected: str) -> NoReturn:
        raise MeshError(f"asset {self.asset_id}: {found}, expected {expected}", code)

    def note(self, code: str, message: str) -> None:
        self.notices.append(Notice(self.asset_id, "mesh", code, f"asset {self.asset_id}: {message}"))

    def read(self, content: bytes) -> tuple[FloatArray, IntArray]:
        """Corners (V, 3) in the file's frame, z up, and faces (F, 3), instances placed; nothing welded yet."""
        self._open(content)
        self._refuse_unsupported()
        vertices, faces, num_vertices, num_faces = [], [], 0, 0
        primitives: dict[int, list[tuple[FloatArray, IntArray]]] = {}
        for mesh_index, world_from_node in self._placed_meshes():
            if mesh_index not in primitives:
                primitives[mesh_index] = list(self._primitives(self.document["meshes"][mesh_index]))
            for corners, triangles in primitives[mesh_index]:
                num_faces += len(triangles)
                if num_faces > self.limits.max_faces or num_vertices + len(corners) > 3 * self.limits.max_faces:
                    self.fail("glb_too_large", "has too many faces", f"at most {self.limits.max_faces}; decimate it")
                is_mirrored = np.linalg.det(world_from_node[:3, :3]) < 0
                faces.append((triangles[:, ::-1] if is_mirrored else triangles) + num_vertices)
                vertices.append(corners @ world_from_node[:3, :3].T + world_from_node[:3, 3])
                num_vertices += len(corners)
        if not num_faces:
            self.fail("glb_no_faces", "has no triangle", "at least one; is it a point cloud, a skeleton or an empty node?")
        return np.concatenate(vertices)[:, [0, 2, 1]] * (1.0, -1.0, 1.0), np.concatenate(faces)

    def _open(self, content: bytes) -> None:
        """Splits the file into its two chunks."""
        size = len(content)
        if size == 0:
            self.fail("glb_zero_bytes", "file is empty", "a GLB; copy it again")
        if size > self.limits.max_bytes:
            self.fail("glb_too_large", f"file has {size} bytes", f"at most {self.limits.max_bytes}")
        if size < 20:
            self.fail("glb_truncated", f"file has {size} bytes", "a GLB header and a chunk; copy it again")
        magic, version, claimed, json_length, json_type = struct.unpack_from("<5I", content)
        if magic != _MAGIC or version != 2 or json_type != _JSON_CHUNK:
            self.fail(
                "glb_invalid",
                f"starts with {content[:8]!r} and chunk {json_type:#x}",
                "binary glTF 2.0 with its JSON chunk first",
            )
        document, end = self._chunk(content, 20, json_length)
        self.document = json.loads(document)
        if end + 8 <= size and struct.unpack_from("<I", content, end + 4)[0] == _BIN_CHUNK:
            self.binary, end = self._chunk(content, end + 8, struct.unpack_from("<I", content, end)[0])
        if claimed != size:
            self.note("glb_length_mismatch", f"header claims {claimed} bytes, the file has {size}; read by its true length")

    def _chunk(self, content: bytes, start: int, length: int) -> tuple[bytes, int]:
        if start + length > len(content):
            self.fail(
                "glb_truncated", f"a chunk ends at byte {start + length} of {len(content)}", "a whole file; copy it again"
            )
        return content[start : start + length], start + length

    def _refuse_unsupported(self) -> None:
        required = [e for e in self.document.get("extensionsRequired", []) if not e.startswith(_HARMLESS)]
        if required:
            self.fail("glb_unsupported", f"requires {required}", "plain accessors; export it without compression or instancing")

    def _placed_meshes(self) -> Iterator[tuple[int, FloatArray]]:
        """(mesh index, world_from_node (4, 4)) of every mesh in the scene, in file order."""
        nodes = self.document.get("nodes", [])
        stack = [(root, np.eye(4)) for root in reversed(self._roots(nodes))]
        seen: set[int] = set()
        while stack:
            index, world_from_parent = stack.pop()
            if index in seen or len(seen) >= self.limits.max_nodes:
                self.fail("glb_invalid", f"node {index} is one too many or has two parents", "a tree of nodes")
            seen.add(index)
            node = nodes[index]
            world_from_node = world_from_parent @ _parent_from_node(node)
            if "mesh" in node:
                yield node["mesh"], world_from_node
            stack.extend((child, world_from_node) for child in reversed(node.get("children", [])))

    def _roots(self, nodes: list[dict[str, Any]]) -> list[int]:
        if self.document.get("scenes"):
            return list(self.document["scenes"][self.document.get("scene", 0)].get("nodes", []))
        children = {child for node in nodes for child in node.get("children", [])}
        return [index for index in range(len(nodes)) if index not in children]

    def _primitives(self, mesh: dict[str, Any]) -> Iterator[tuple[FloatArray, IntArray]]:
        """Corners (V, 3) float64 and triangles (F, 3) int64 of every primitive that has triangles."""
        for primitive in mesh["primitives"]:
            mode = primitive.get("mode", _TRIANGLES)
            if mode not in (_TRIANGLES, _STRIP, _FAN):
                self.note(
                    "glb_primitive_skipped", f"a primitive of points or lines (mode {mode}) has no surface and is left out"
                )
                continue
            corners = self._accessor(primitive["attributes"]["POSITION"], 3).astype(np.float64)
            indices = np.arange(len(corners))
            if "indices" in primitive:
                indices = self._indices(primitive["indices"], len(corners))
            yield corners, _triangles(indices, mode)

    def _indices(self, accessor: int, num_corners: int) -> IntArray:
        indices = self._accessor(accessor, 1)[:, 0]
        if indices.dtype.kind != "u" or (len(indices) and indices.max() >= num_corners):
            self.fail(
                "glb_invalid",
                f"a face index reaches beyond the {num_corners} vertices",
                "unsigned indices of vertices that exist",
            )
        return indices.astype(np.int64)

    def _accessor(self, index: int, width: int) -> npt.NDArray[Any]:
        """Values (count, width) of an accessor, a view of the file."""
        accessor = self.document["accessors"][index]
        if "sparse" in accessor or "bufferView" not in accessor:
            self.fail(
                "glb_unsupported",
                f"accessor {index} is sparse or has no data",
                "plain accessors; export it without compression",
            )
        if accessor["type"] != {1: "SCALAR", 3: "VEC3"}[width]:
            self.fail("glb_invalid", f"accessor {index} holds {accessor['type']}", f"{width} numbers an element")
        view = self.document["bufferViews"][accessor["bufferView"]]
        buffer = self.document["buffers"][view["buffer"]]
        if view["buffer"] != 0 or "uri" in buffer:
            self.fail(
                "glb_unsupported",
                "its geometry lies in a second file or a URI",
                "one self-contained GLB; nothing outside is opened",
            )
        start, length = view.get("byteOffset", 0), view["byteLength"]
        if min(start, length) < 0 or start + length > len(self.binary):
            self.fail(
                "glb_truncated", f"data end at byte {start + length} of {len(self.binary)}", "a whole file; copy it again"
            )
        kind = np.dtype(_COMPONENTS[accessor["componentType"]])
        stride, offset = view.get("byteStride") or kind.itemsize * width, accessor.get("byteOffset", 0)
        if stride < kind.itemsize * width or min(offset, accessor["count"]) < 0:
            self.fail("glb_invalid", f"accessor {index} has stride {stride}, offset {offset}", "elements that do not overlap")
        values = np.ndarray(
            (accessor["count"], width), kind, self.binary[start : start + length], offset, (stride, kind.itemsize)
        )
        return values / np.iinfo(kind).max if accessor.get("normalized") and kind.kind != "f" else values


def _parent_from_node(node: dict[str, Any]) -> FloatArray:
    if "matrix" in node:
        return np.array(node["matrix"], np.float64).reshape(4, 4).T
    x, y, z, w = np.array(node.get("rotation", (0, 0, 0, 1)), np.float64)
    s = 2 / (x * x + y * y + z * z + w * w)
    rotation = np.array(
        [
            [1 - s * (y * y + z * z), s * (x * y - z * w), s * (x * z + y * w)],
            [s * (x * y + z * w), 1 - s * (x * x + z * z), s * (y * z - x * w)],
            [s * (x * z - y * w), s * (y * z + x * w), 1 - s * (x * x + y * y)],
        ]
    )
    matrix = np.eye(4)
    matrix[:3, :3] = rotation * np.array(node.get("scale", (1, 1, 1)), np.float64).reshape(3)
    matrix[:3, 3] = np.array(node.get("translation", (0, 0, 0)), np.float64).reshape(3)
    return matrix


def _triangles(indices: IntArray, mode: int) -> IntArray:
    if mode == _TRIANGLES:
        return indices[: len(indices) // 3 * 3].reshape(-1, 3)
    num = max(len(indices) - 2, 0)
    if mode == _FAN:
        return np.stack([np.broadcast_to(indices[:1], num), indices[1 : num + 1], indices[2 : num + 2]], axis=1)
    strip = np.stack([indices[:num], indices[1 : num + 1], indices[2 : num + 2]], axis=1)
    strip[1::2] = strip[1::2, ::-1]  # every second triangle of a strip runs the other way round
    return strip


def _welded(soup: FloatArray, faces: IntArray, reader: _GlbReader) -> Mesh:
    """One clean mesh of placed corners (V, 3) and faces (F, 3)."""
    soup, faces = _compact(soup, faces)
    if not np.isfinite(soup).all():
        bad = int((~np.isfinite(soup)).any(axis=1).sum())
        reader.fail("glb_nan_vertices", f"{bad} of {len(soup)} vertices are not finite", "finite coordinates; export it again")
    extent = float(np.ptp(soup, axis=0).max())
    if not _SMALLEST < extent < 1 / _SMALLEST:
        reader.fail(
            "glb_degenerate_only", f"its largest extent is {extent:.3g}", "a surface of a size that can be computed with"
        )
    mesh = _centred(*_weld(soup, faces, _WELD * extent))
    if not (double_areas(mesh) > _FLAT * extent * extent).any():
        reader.fail("glb_degenerate_only", f"none of {len(faces)} faces has an area", "a surface; export it again")
    return mesh


def _compact(vertices: FloatArray, faces: IntArray) -> tuple[FloatArray, IntArray]:
    """Drops vertices that no face refers to."""
    used = np.zeros(len(vertices), bool)
    used[faces.ravel()] = True
    return vertices[used], (np.cumsum(used) - 1)[faces]


def _weld(vertices: FloatArray, faces: IntArray, cell: float) -> tuple[FloatArray, IntArray]:
    """Makes one of vertices in one cell and drops faces that collapse.

    An edge of a grid may part twins, along each axis on one of four staggered grids at most; so one of the four joins them.
    """
    for shift in (0.0, 0.25, 0.5, 0.75):
        grid = np.floor((vertices - vertices.min(axis=0)) / cell + shift).astype(np.int64)
        key = (grid[:, 0] << 42) | (grid[:, 1] << 21) | grid[:, 2]
        _, first, index = np.unique(key, return_index=True, return_inverse=True)
        vertices, faces = vertices[first], index[faces]
    a, b, c = faces.T
    return vertices, faces[(a != b) & (b != c) & (c != a)]


def _centred(vertices: FloatArray, faces: IntArray) -> Mesh:
    """A mesh without unused vertices, its box centred on the origin."""
    vertices, faces = _compact(vertices, faces)
    if len(vertices):
        vertices = vertices - (vertices.min(axis=0) + vertices.max(axis=0)) / 2
    return Mesh(vertices, faces)


def double_areas(mesh: Mesh) -> FloatArray:
    """Twice the area of every face, (F,) float64, squared mesh units."""
    a, b, c = (mesh.triangles[:, n] for n in range(3))
    areas: FloatArray = np.linalg.norm(np.cross(b - a, c - a), axis=1)
    return areas


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
    before = _Edges.of(mesh.faces)
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
    repaired = _centred(vertices, np.concatenate([faces, *filled]))
    report = _report(repaired, before.is_watertight, num_flipped, tuple(actions))
    if report.is_solid and num_flipped > len(given) / 2:
        message = f"asset {asset_id}: {num_flipped} of {len(given)} faces looked inwards; turned"
        return repaired, report, (Notice(asset_id, "mesh", "glb_inside_out", message),)
    return repaired, report, ()


@dataclass(frozen=True, slots=True, eq=False)
class _Edges:
    """Undirected edges (E, 2), low corner first; how many faces use each; how many more run it upwards than downwards."""

    corners: IntArray
    count: IntArray
    balance: IntArray

    @classmethod
    def of(cls, faces: IntArray) -> "_Edges":
        """The edges of faces (F, 3)."""
        directed = faces[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2)
        low, high, num = directed.min(axis=1), directed.max(axis=1), faces.max() + 1
        key, index, count = np.unique(low * num + high, return_inverse=True, return_counts=True)
        balance = np.bincount(index, np.where(directed[:, 0] == low, 1, -1)).astype(np.int64)
        return cls(np.stack([key // num, key % num], axis=1), count, balance)

    @property
    def is_watertight(self) -> bool:
        """Whether each joins two faces that run against each other."""
        return bool((self.count == 2).all() and (self.balance == 0).all())

    def boundary(self) -> IntArray:
        """Directed edges that no face runs against, (B, 2): the rims of what is missing, also where three faces meet."""
        forward = np.repeat(self.corners, np.maximum(self.balance, 0), axis=0)
        backward = np.repeat(self.corners[:, ::-1], np.maximum(-self.balance, 0), axis=0)
        return np.concatenate([forward, backward])


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
    edges = _Edges.of(faces)
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
    loops = _loops(_Edges.of(faces).boundary())
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
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]) / 2
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


def signed_volumes(triangles: FloatArray) -> FloatArray:
    """Volume of the tetrahedra from the origin to triangles (F, 3, 3), (F,) float64, negative where they look inwards."""
    volumes: FloatArray = np.einsum("ij,ij->i", triangles[:, 0], np.cross(triangles[:, 1], triangles[:, 2])) / 6
    return volumes


def _report(mesh: Mesh, was_watertight: bool, num_flipped: int, actions: tuple[str, ...]) -> MeshReport:
    edges = _Edges.of(mesh.faces)
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


def is_closed(mesh: Mesh) -> bool:
    """Whether every edge is run as often one way as the other: then winding numbers are whole."""
    return bool((_Edges.of(mesh.faces).balance == 0).all())


def _encloses(mesh: Mesh, edges: _Edges) -> bool:
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
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    normals /= np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-300)
    winding = igl.winding_number(mesh.vertices, mesh.faces, corners.mean(axis=1) + 1e-4 * mesh.extents.max() * normals)
    return bool((np.abs(winding - np.round(winding)) < 0.25).mean() >= 0.95)


@dataclass(frozen=True, slots=True, eq=False)
class MassProperties:
    """What an object weighs and how it resists turning.

    Attributes:
        mass: Kilograms.
        center_of_mass: (3,) float64, metres, the mesh's frame.
        inertia: About the centre of mass, (3, 3) float64, kg m², axes of the mesh's frame.
    """

    mass: float
    center_of_mass: FloatArray
    inertia: FloatArray


def mass_properties(
    mesh: Mesh, *, mass: float | None = None, density: float | None = None, is_sheet: bool = False, thickness: float = 2e-3
) -> MassProperties:
    """Mass, centre and inertia of a homogeneous object, exact for its triangles.

    Args:
        mesh: Metres; faces outward where it is a solid.
        mass: Kilograms; this or ``density``.
        density: kg/m³.
        is_sheet: Take the surface as a shell instead of the volume (``MeshReport.is_sheet``).
        thickness: Of the shell, metres; it decides the mass that a density gives, not the shape of the inertia.

    Returns:
        The properties, in the mesh's frame.

    Raises:
        MeshError: ``mass_invalid``: both or neither of mass and density, or one that is not positive.
        MeshError: ``mass_no_volume``: a solid that encloses none; is it a sheet, or inside out?
    """
    given = [m for m in (mass, density) if m is not None]
    if len(given) != 1 or not (0 < given[0] < float("inf") and thickness > 0):
        raise MeshError(
            f"mass is {mass}, density {density}, thickness {thickness}, expected one of the first two, positive", "mass_invalid"
        )
    corners = mesh.triangles
    total = corners.sum(axis=1)
    # Exact integrals of 1, x and x xᵀ: over a triangle (d = 2), or over the tetrahedron from the origin to it (d = 3).
    weight, d = (double_areas(mesh) / 2 * thickness, 2) if is_sheet else (signed_volumes(corners), 3)
    content = float(weight.sum())
    if content <= 0:
        raise MeshError(
            f"mesh encloses {content:.3g} m3, expected more than 0; is it a sheet, or inside out?", "mass_no_volume"
        )
    center = weight @ total / ((d + 1) * content)
    second = np.einsum("f,fni,fnj->ij", weight, corners, corners) + np.einsum("f,fi,fj->ij", weight, total, total)
    second = second / ((d + 1) * (d + 2)) - content * np.outer(center, center)
    kilograms = mass if mass is not None else given[0] * content
    inertia = (np.trace(second) * np.eye(3) - second) * (kilograms / content)
    return MassProperties(kilograms, center, inertia)
