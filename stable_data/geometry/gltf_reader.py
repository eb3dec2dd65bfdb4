"""Reads meshes and nodes from untrusted binary glTF files."""

import errno
import json
import re
import struct
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, NoReturn, TypeAlias, TypeVar

import numpy as np
import numpy.typing as npt

from stable_data.errors import MeshError, Notice
from stable_data.geometry.mesh import (
    WELD,
    Mesh,
    center_vertices,
    double_areas,
    drop_unused_vertices,
    join_meshes,
    weld_vertices,
)
from stable_data.geometry.surface import Surface
from stable_data.limits import LIMITS, GltfLimits, MeshLimits, at_most
from stable_data.scene import FloatArray, IntArray

_FLAT = 1e-12  # a face of a smaller area, share of the squared extent, does not count
_SMALLEST = 1e-30  # squares and cubes of smaller extents, or of extents above its inverse, leave the range of a double
COLLIDERS = "colliders"
"""Name of the mesh that holds the convex parts of a file; no node shows it."""

PART_FACES = "part_faces"
"""Key in the ``extras`` of that mesh: the number of faces of each part, in order."""

FACE_ORDER = "face_order"
"""Key in the ``extras`` of a painted mesh: the accessor with the number of each face before faces were grouped by colour,
or null if that changed no number."""

TEXTURE = "texture:"
"""Start of the address of an image that is a row of the table ``textures``; its SHA-256 follows."""

TextureLookup: TypeAlias = Callable[[str], bytes | None]
"""Returns the image file of a SHA-256; None if there is none."""

_MAGIC, _JSON_CHUNK, _BIN_CHUNK = 0x46546C67, 0x4E4F534A, 0x004E4942
_COMPONENTS = {5120: "<i1", 5121: "<u1", 5122: "<i2", 5123: "<u2", 5125: "<u4", 5126: "<f4"}
_TYPES = {1: "SCALAR", 2: "VEC2", 3: "VEC3", 4: "VEC4"}
_SURFACES = _TRIANGLES, _STRIP, _FAN = 4, 5, 6
# Required extensions that change only the look of a surface, or that the accessor reader supports.
_HARMLESS = (
    "KHR_materials_",
    "KHR_texture_",
    "EXT_texture_",
    "MSFT_texture_",
    "KHR_lights_",
    "KHR_xmp",
    "KHR_mesh_quantization",
)
_LEVEL_STEPS = np.zeros(256, np.int8)  # change of the nesting level at each character of a JSON text
_LEVEL_STEPS[list(b"[{")] = 1
_LEVEL_STEPS[list(b"]}")] = -1
# The exceptions of json, struct, numpy and indexing on invalid content.
_PARSE_ERRORS = (ArithmeticError, AttributeError, LookupError, RecursionError, TypeError, ValueError, struct.error)
_ADDRESS = re.compile(re.escape(TEXTURE) + "([0-9a-f]{64})")
_Result = TypeVar("_Result")


def load_glb(data: bytes | Path, asset_id: str, *, limits: MeshLimits = LIMITS.mesh) -> tuple[Mesh, tuple[Notice, ...]]:
    """Reads a binary glTF as one mesh: geometry only, no texture, no second file.

    Args:
        data: The file, or its content. Not trusted: sizes are checked against its true length, and no URI in it is opened.
        asset_id: The asset's name in messages.
        limits: Sizes beyond which the file is refused.

    Returns:
        The mesh, file units, z up, node transforms applied, vertices welded, centred on its box; and notices about it.

    Raises:
        MeshError: The file cannot be used; ``code`` is ``glb_truncated``, ``glb_zero_bytes``, ``glb_nan_vertices``,
            ``glb_no_faces``, ``glb_degenerate_only``, ``glb_too_large``, ``glb_unsupported``, ``glb_unreadable`` or ``glb_invalid``.
    """
    return _read(data, _GlbReader(asset_id, limits), lambda reader: (_welded(*reader.soup(), reader), tuple(reader.notices)))


def load_stored_mesh(data: bytes | Path, asset_id: str, *, limits: MeshLimits = LIMITS.mesh) -> tuple[Mesh, bool]:
    """Reads a mesh as :func:`stable_data.geometry.gltf_writer.write_glb` stores it in a run; the arguments are those of :func:`load_glb`.

    Returns:
        The very mesh that was written; nothing is welded, and only a box that is not centred, of a mesh from elsewhere, is moved.
        And whether its faces are in the order that they had: older files group them by colour and do not say it.

    Raises:
        MeshError: As :func:`load_glb`.
    """
    return _read(data, _GlbReader(asset_id, limits), lambda reader: _stored(*reader.soup(), reader))


@dataclass(frozen=True, slots=True, eq=False)
class PlacedNode:
    """A node of the scene of a glTF document, in the axes of the file: y up.

    Attributes:
        index: Its number in the document.
        parent: Number of the node above it; None for a root.
        parent_from_node: Its own transform, (4, 4).
        world_from_node: Its transform with those of all nodes above it, (4, 4).
        mesh: Number of its mesh; None without one.
    """

    index: int
    parent: int | None
    parent_from_node: FloatArray
    world_from_node: FloatArray
    mesh: int | None


def placed_nodes(document: dict[str, Any], asset_id: str, *, limits: GltfLimits = LIMITS.mesh) -> tuple[PlacedNode, ...]:
    """Returns the nodes of the default scene of a glTF document, each after the node above it, in file order.

    Args:
        document: The JSON of the file, not trusted.
        asset_id: The file's name in messages.
        limits: ``max_nodes``.

    Raises:
        MeshError: ``glb_invalid``: the nodes are no tree or break the format; ``glb_too_large``.
    """
    return _guarded(_GlbReader(asset_id, limits, document=document), lambda reader: tuple(reader.placed_nodes()))


def count_triangles(document: dict[str, Any], asset_id: str, *, limits: GltfLimits) -> tuple[int, int]:
    """Counts the triangles and vertices of the default scene of a glTF document, each as often as it is shown; none is read.

    Args:
        document: The JSON of the file, not trusted.
        asset_id: The file's name in messages.
        limits: Sizes beyond which the file is refused.

    Raises:
        MeshError: As :func:`placed_nodes`.
    """
    return _guarded(
        _GlbReader(asset_id, limits, document=document),
        lambda reader: reader.count_triangles(mesh for mesh, _ in reader.placed_meshes()),
    )


def load_meshes(
    data: bytes | Path, asset_id: str, indices: Sequence[int], *, limits: GltfLimits = LIMITS.mesh
) -> tuple[dict[int, Mesh], tuple[Notice, ...]]:
    """Reads meshes of a file by their numbers; other arguments are those of :func:`load_glb`.

    Args:
        data: The file, or its content.
        asset_id: The asset's name in messages.
        indices: Numbers of meshes; one that is shown several times is listed as often, for the limits.
        limits: Sizes beyond which the file is refused.

    Returns:
        Number -> all triangles of the mesh in its own frame, y up as in the file, not welded; a mesh without triangles is left
        out. And notices about them.

    Raises:
        MeshError: The codes are those of :func:`load_glb`.
    """

    def extract(reader: _GlbReader) -> tuple[dict[int, Mesh], tuple[Notice, ...]]:
        return reader.meshes(indices), tuple(reader.notices)

    return _read(data, _GlbReader(asset_id, limits), extract)


def load_colliders(data: bytes | Path, asset_id: str, *, limits: MeshLimits = LIMITS.mesh) -> tuple[Mesh, ...]:
    """Reads the convex parts of a file, as :func:`stable_data.geometry.gltf_writer.write_glb` stores them.

    The arguments are those of :func:`load_glb`.

    Returns:
        Closed convex meshes, in the frame and unit of :func:`load_glb`'s mesh; none if the file has no ``colliders``.

    Raises:
        MeshError: The file or the parts cannot be used; the codes are those of :func:`load_glb`.
    """
    return _read(data, _GlbReader(asset_id, limits), _GlbReader.colliders)


def load_surfaces(
    data: bytes | Path, asset_id: str, *, limits: MeshLimits = LIMITS.mesh, textures: TextureLookup | None = None
) -> list[Surface]:
    """Reads the surfaces of a file with their colours and textures; other arguments are those of :func:`load_glb`.

    Args:
        data: The file, or its content.
        asset_id: The asset's name in messages.
        limits: Sizes beyond which the file is refused.
        textures: Finds an image whose URI is an address of the table ``textures``, as :func:`stable_data.geometry.gltf_writer.write_look`
            writes it. No other URI is opened: without an image in the file, a surface has none.

    Raises:
        MeshError: The file violates the format (the codes are those of :func:`load_glb`), or ``textures`` lacks an image
            (``texture_missing``).
    """
    return _read(data, _GlbReader(asset_id, limits, textures), _GlbReader.surfaces)


def texture_addresses(look: bytes | None) -> tuple[str, ...]:
    """Returns the SHA-256 of each image of the table ``textures`` that a look names, each once, sorted.

    Args:
        look: A value of the column ``look``. One that cannot be read, which is shown nowhere, has no images.
    """
    try:
        return () if look is None else _read(look, _GlbReader("", LIMITS.mesh), _GlbReader.addresses)
    except MeshError:
        return ()


def _read(data: bytes | Path, reader: "_GlbReader", extract: Callable[["_GlbReader"], _Result]) -> _Result:
    """Opens a file and extracts a result; see :func:`_guarded`."""

    def opened(reader: "_GlbReader") -> _Result:
        reader.open(reader.content(data) if isinstance(data, Path) else data)
        return extract(reader)

    return _guarded(reader, opened)


def _guarded(reader: "_GlbReader", extract: Callable[["_GlbReader"], _Result]) -> _Result:
    """Extracts a result. Every failure is a MeshError, and no content of a file causes a numpy warning."""
    try:
        with np.errstate(all="ignore"):
            return extract(reader)
    except MeshError:
        raise
    except _PARSE_ERRORS as error:
        found = f"breaks the glTF 2.0 format ({type(error).__name__}: {error})"
        reader.fail("glb_invalid", found, "a valid GLB; export it again")


@dataclass(slots=True)
class _GlbReader:
    """Reads one file; every size stated in it is checked against the bytes that exist."""

    asset_id: str
    limits: GltfLimits
    textures: TextureLookup | None = None
    notices: list[Notice] = field(default_factory=list)
    document: dict[str, Any] = field(default_factory=dict)
    binary: memoryview = field(default_factory=lambda: memoryview(b""))
    images: dict[int, bytes] = field(default_factory=dict)
    stored_images: dict[str, bytes] = field(default_factory=dict)
    num_image_bytes: int = 0
    num_stored_bytes: int = 0

    def fail(self, code: str, found: str, expected: str) -> NoReturn:
        raise MeshError(f"asset {self.asset_id}: {found:.300}, expected {expected}", code)

    def check_limit(self, name: str, found: int) -> None:
        """Refuses a file that exceeds a field of its limits."""
        if found > getattr(self.limits, name):
            what = name.removeprefix("max_").replace("_", " ")
            self.fail("glb_too_large", f"has {found} {what}", f"{at_most(self.limits, name)}; simplify it")

    def note(self, code: str, message: str) -> None:
        self.notices.append(Notice(self.asset_id, "mesh", code, f"asset {self.asset_id}: {message}"))

    def content(self, path: Path) -> bytes:
        """Reads the content of a file."""
        try:
            if not path.is_file():  # the read of a pipe or a device could wait for ever
                raise FileNotFoundError(errno.ENOENT, "missing or not a regular file")
            self.check_limit("max_bytes", path.stat().st_size)
            return path.read_bytes()
        except OSError as error:
            reason = error.strerror or type(error).__name__
            raise MeshError(f"asset {self.asset_id}: {path} cannot be read: {reason}", "glb_unreadable") from error

    def soup(self) -> tuple[FloatArray, IntArray]:
        """Corners (V, 3) in the file's frame, z up, and faces (F, 3), node transforms applied, not welded.

        Primitives that name the same corners in the same place, such as those of the colours of a mesh, share them.
        """
        self._refuse_unsupported()
        vertices, faces, num_vertices = [], [], 0
        known: dict[object, tuple[FloatArray, int]] = {}
        for primitive, corners, triangles in self._placed_primitives():
            name = primitive["attributes"]["POSITION"]
            first, start = known.get(name, (None, 0))
            if first is None or not np.array_equal(first, corners):
                start = num_vertices
                known[name] = corners, start
                vertices.append(corners)
                num_vertices += len(corners)
            faces.append(triangles + start)
        return np.concatenate(vertices), np.concatenate(faces)

    def face_order(self, num_faces: int) -> IntArray | None:
        """The number of each face of the scene before its faces were grouped by colour, (F,); None if the file does not say it."""
        meshes = [self._entry("meshes", node.mesh) for node in self.placed_nodes() if node.mesh is not None]
        mesh = meshes[0]
        if len(meshes) != 1 or FACE_ORDER not in mesh.get("extras", {}):
            return None if sum(len(each["primitives"]) for each in meshes) > 1 else np.arange(num_faces)
        if mesh["extras"][FACE_ORDER] is None:
            return np.arange(num_faces)
        order = self._accessor(mesh["extras"][FACE_ORDER], 1)[:, 0].astype(np.int64)
        if not np.array_equal(np.sort(order), np.arange(num_faces)):
            self.fail("glb_invalid", f"{FACE_ORDER} is not an order of its {num_faces} faces", "each number once")
        return order

    def surfaces(self) -> list[Surface]:
        """The surfaces of the scene; see :func:`load_surfaces`."""
        self._refuse_unsupported()
        surfaces = []
        for primitive, corners, triangles in self._placed_primitives():
            factor, opacity, texture = self._base_colour(primitive)
            attributes, colours, uv = primitive["attributes"], None, None
            if "COLOR_0" in attributes:
                width = 4 if self._entry("accessors", attributes["COLOR_0"])["type"] == "VEC4" else 3
                colours = self._accessor(attributes["COLOR_0"], width, triangles)[..., :3].astype(np.float64)
            image = None if texture is None else self._image(texture)
            moved = (texture or {}).get("extensions", {}).get("KHR_texture_transform", {})
            name = f"TEXCOORD_{moved.get('texCoord', (texture or {}).get('texCoord', 0))}"
            if image is not None and name in attributes:
                uv = _moved_uv(self._accessor(attributes[name], 2, triangles).astype(np.float64), moved)
            has_alpha, opacity = opacity is not None, 1.0 if opacity is None else opacity
            shown = corners[triangles]
            if not np.isfinite(shown).all():
                self.fail("glb_nan_vertices", "has corners of triangles that are not finite", "finite coordinates")
            surfaces.append(Surface(shown, factor, colours, image, uv, opacity, has_alpha).with_valid_look())
        return surfaces

    def meshes(self, indices: Sequence[int]) -> dict[int, Mesh]:
        """See :func:`load_meshes`."""
        self._refuse_unsupported()
        self.count_triangles(indices)
        found = {}
        for index in dict.fromkeys(indices):
            parts = [Mesh(corners, faces) for _, corners, faces in self._primitives(self._entry("meshes", index)) if len(faces)]
            if parts:
                joined = join_meshes(parts)
                mesh = Mesh(*drop_unused_vertices(joined.vertices, joined.faces))
                if not np.isfinite(mesh.vertices).all():
                    self.fail("glb_nan_vertices", f"mesh {index} has vertices that are not finite", "finite coordinates")
                found[index] = mesh
        return found

    def addresses(self) -> tuple[str, ...]:
        """See :func:`texture_addresses`."""
        uris = (image.get("uri") for image in self.document.get("images", []))
        return tuple(sorted({found[1] for uri in uris if isinstance(uri, str) and (found := _ADDRESS.fullmatch(uri))}))

    def _base_colour(
        self, primitive: dict[str, Any]
    ) -> tuple[tuple[float, float, float] | None, float | None, dict[str, Any] | None]:
        """Factor, opacity and texture of a primitive's material; no factor without a material, no opacity where alpha is ignored."""
        if "material" not in primitive:
            return None, None, None
        material = self._entry("materials", primitive["material"])
        # An archived extension that files still use.
        older = material.get("extensions", {}).get("KHR_materials_pbrSpecularGlossiness")
        names = ("baseColorFactor", "baseColorTexture") if older is None else ("diffuseFactor", "diffuseTexture")
        found = material.get("pbrMetallicRoughness", {}) if older is None else older
        red, green, blue, *rest = (float(channel) for channel in found.get(names[0], (1.0, 1.0, 1.0))[:4])
        mode = material.get("alphaMode", "OPAQUE")
        opacity = None
        if mode != "OPAQUE":  # a mask is seen or not: its factor only moves the limit
            opacity = float(np.clip(rest[0], 0.0, 1.0)) if rest and mode == "BLEND" else 1.0
        return (red, green, blue), opacity, found.get(names[1])

    def _image(self, texture: dict[str, Any]) -> bytes | None:
        """The content of a texture's image; None if it is neither in the file nor in the table ``textures``."""
        entry = self._entry("textures", texture["index"])
        source = entry.get("extensions", {}).get("EXT_texture_webp", {}).get("source", entry.get("source"))
        image = {} if source is None else self._entry("images", source)
        if "bufferView" not in image:
            address = _ADDRESS.fullmatch(str(image.get("uri")))
            return None if address is None or self.textures is None else self._stored_image(address[1], self.textures)
        index = image["bufferView"]
        if index not in self.images:  # many primitives may share one large texture
            self.images[index] = bytes(self._view(index))
            self.num_image_bytes += len(self.images[index])
            if self.num_image_bytes > len(self.binary):  # overlapping textures could fill the memory
                self.fail("glb_invalid", "has textures that overlap", "a part of the file for each; export it again")
        return self.images[index]

    def _stored_image(self, sha256: str, textures: TextureLookup) -> bytes:
        """An image of the table ``textures``."""
        if sha256 not in self.stored_images:
            content = textures(sha256)
            if content is None:
                found = f"its look names the image {sha256}, which the table textures does not have"
                self.fail("texture_missing", found, "a row for it; import the asset again")
            self.stored_images[sha256] = content
            self.num_stored_bytes += len(content)
            self.check_limit("max_bytes", self.num_stored_bytes)
        return self.stored_images[sha256]

    def _placed_primitives(self) -> Iterator[tuple[dict[str, Any], FloatArray, IntArray]]:
        """Every primitive of the scene with its corners (V, 3), z up, in the scene's frame, and its triangles (F, 3)."""
        placed = list(self.placed_meshes())
        if not self.count_triangles(mesh_index for mesh_index, _ in placed)[0]:
            self.fail("glb_no_faces", "has no triangle", "at least one; is it a point cloud, a skeleton or an empty node?")
        primitives: dict[int, list[tuple[dict[str, Any], FloatArray, IntArray]]] = {}
        for mesh_index, world_from_node in placed:
            if mesh_index not in primitives:
                primitives[mesh_index] = list(self._primitives(self._entry("meshes", mesh_index)))
            is_mirrored = np.linalg.det(world_from_node[:3, :3]) < 0  # a mirrored mesh would be inside out
            for primitive, corners, triangles in primitives[mesh_index]:
                moved = corners @ world_from_node[:3, :3].T + world_from_node[:3, 3]
                # From y up to z up.
                yield primitive, moved[:, [0, 2, 1]] * (1.0, -1.0, 1.0), triangles[:, ::-1] if is_mirrored else triangles

    def count_triangles(self, mesh_indices: Iterable[int]) -> tuple[int, int]:
        """Counts the triangles and vertices of meshes, each as often as it is listed, before any is read.

        Primitives may share an accessor and nodes may share a mesh, so a small file can describe a very large scene.
        """
        num_primitives = num_corners = num_faces = 0
        for mesh_index, times in Counter(mesh_indices).items():
            primitives = self._entry("meshes", mesh_index)["primitives"]
            num_primitives += times * len(primitives)
            self.check_limit("max_primitives", num_primitives)
            for primitive in primitives:
                if (mode := primitive.get("mode", _TRIANGLES)) in _SURFACES:
                    corners = indices = self._count(primitive["attributes"]["POSITION"])
                    if "indices" in primitive:
                        indices = self._count(primitive["indices"])
                    num_corners += times * corners
                    num_faces += times * (indices // 3 if mode == _TRIANGLES else max(indices - 2, 0))
        self.check_limit("max_corners", num_corners)
        self.check_limit("max_faces", num_faces)
        return num_faces, num_corners

    def _count(self, accessor: int) -> int:
        return self._size(self._entry("accessors", accessor), f"accessors[{accessor}]", "count")

    def colliders(self) -> tuple[Mesh, ...]:
        """The convex parts of the mesh ``colliders``, centred on their common box, with the node transform of the scene's one mesh."""
        meshes = self.document.get("meshes", [])
        found = [k for k, mesh in enumerate(meshes) if mesh.get("name") == COLLIDERS and "extras" in mesh]
        placed = list(self.placed_meshes())
        if not found or len(placed) != 1:
            return ()
        world_from_node, mesh = placed[0][1], meshes[found[0]]
        counts = mesh["extras"][PART_FACES]
        self.check_limit("max_colliders", len(counts))
        self.count_triangles(found[:1])
        surfaces = list(self._primitives(mesh))
        num_faces = len(surfaces[0][2]) if surfaces else 0
        if not counts or not all(type(count) is int and count >= 4 for count in counts) or sum(counts) != num_faces:
            self.fail("glb_invalid", f"colliders have {counts!r:.80} faces", f"numbers from 4 that add up to {num_faces}")
        _, corners, faces = surfaces[0]
        corners = corners @ world_from_node[:3, :3].T + world_from_node[:3, 3]
        corners = corners[:, [0, 2, 1]] * (1.0, -1.0, 1.0)
        corners = corners - (corners.min(axis=0) + corners.max(axis=0)) / 2
        if not np.isfinite(corners).all():
            self.fail("glb_nan_vertices", "a collider has a corner that is not finite", "finite coordinates")
        return tuple(Mesh(*drop_unused_vertices(corners, part)) for part in np.split(faces, np.cumsum(counts)[:-1]))

    def open(self, content: bytes) -> None:
        """Splits the file into its two chunks."""
        size = len(content)
        if size == 0:
            self.fail("glb_zero_bytes", "file is empty", "a GLB; copy it again")
        if isinstance(self.limits, MeshLimits):  # a scene is packed from files that have limits of their own
            self.check_limit("max_bytes", size)
        if size < 20:  # 12 bytes of header and 8 bytes before the first chunk
            self.fail("glb_truncated", f"file has {size} bytes", "a GLB header and a chunk; copy it again")
        magic, version, claimed, json_length, json_type = struct.unpack_from("<5I", content)
        if magic != _MAGIC or version != 2 or json_type != _JSON_CHUNK:
            found = f"starts with {content[:8]!r} and chunk {json_type:#x}"
            self.fail("glb_invalid", found, "binary glTF 2.0 with its JSON chunk first")
        self.check_limit("max_json_bytes", json_length)
        chunk, end = self._chunk(content, 20, json_length)
        text = bytes(chunk)
        self.check_limit("max_json_levels", _num_levels(text))
        self.document = json.loads(text.decode())  # decoded here, because json.loads would guess the encoding of bytes
        if end + 8 <= size and struct.unpack_from("<I", content, end + 4)[0] == _BIN_CHUNK:
            self.binary, end = self._chunk(content, end + 8, struct.unpack_from("<I", content, end)[0])
        if claimed != size:
            self.note("glb_length_mismatch", f"header claims {claimed} bytes, the file has {size}; read by its true length")

    def _chunk(self, content: bytes, start: int, length: int) -> tuple[memoryview, int]:
        if start + length > len(content):
            found = f"a chunk ends at byte {start + length} of {len(content)}"
            self.fail("glb_truncated", found, "a whole file; copy it again")
        return memoryview(content)[start : start + length], start + length

    def _refuse_unsupported(self) -> None:
        required = [e for e in self.document.get("extensionsRequired", []) if not e.startswith(_HARMLESS)]
        if required:
            expected = "plain accessors; export it without compression or instancing"
            self.fail("glb_unsupported", f"requires {required!r:.200}", expected)

    def placed_meshes(self) -> Iterator[tuple[int, FloatArray]]:
        """Yields (mesh index, world_from_node (4, 4)) of every mesh in the scene, in file order."""
        for node in self.placed_nodes():
            if node.mesh is not None:
                yield node.mesh, node.world_from_node

    def placed_nodes(self) -> Iterator[PlacedNode]:
        """The nodes of the scene; see :func:`placed_nodes`."""
        roots = self._roots(self.document.get("nodes", []))
        self.check_limit("max_nodes", len(roots))
        # A stack instead of recursion, which could overflow; reversed, so that nodes come in file order.
        stack: list[tuple[int, int | None, FloatArray]] = [(root, None, np.eye(4)) for root in reversed(roots)]
        seen: set[int] = set()
        while stack:
            index, parent, world_from_parent = stack.pop()
            node = self._entry("nodes", index)
            if index in seen:
                self.fail("glb_invalid", f"node {index} has two parents", "a tree of nodes; export it again")
            seen.add(index)
            parent_from_node = _parent_from_node(node)
            world_from_node = world_from_parent @ parent_from_node
            if "mesh" in node:
                self._entry("meshes", node["mesh"])
            yield PlacedNode(index, parent, parent_from_node, world_from_node, node.get("mesh"))
            children = node.get("children", [])
            self.check_limit("max_nodes", len(seen) + len(stack) + len(children))
            stack.extend((child, index, world_from_node) for child in reversed(children))

    def _roots(self, nodes: list[dict[str, Any]]) -> list[int]:
        if self.document.get("scenes"):
            return list(self._entry("scenes", self.document.get("scene", 0)).get("nodes", []))
        # Without a scene, every node without a parent is a root.
        children = {child for node in nodes for child in node.get("children", [])}
        return [index for index in range(len(nodes)) if index not in children]

    def _primitives(self, mesh: dict[str, Any]) -> Iterator[tuple[dict[str, Any], FloatArray, IntArray]]:
        """Yields every primitive that has triangles with its corners (V, 3) float64 and triangles (F, 3) int64."""
        for primitive in mesh["primitives"]:
            mode = primitive.get("mode", _TRIANGLES)
            if mode not in _SURFACES:
                message = f"a primitive of points or lines (mode {mode!r:.40}) has no surface and is skipped"
                self.note("glb_primitive_skipped", message)
                continue
            corners = self._accessor(primitive["attributes"]["POSITION"], 3).astype(np.float64)
            indices = np.arange(len(corners))
            if "indices" in primitive:
                indices = self._indices(primitive["indices"], len(corners))
            yield primitive, corners, _triangles(indices, mode)

    def _indices(self, accessor: int, num_corners: int) -> IntArray:
        indices = self._accessor(accessor, 1)[:, 0]
        if indices.dtype.kind != "u" or (len(indices) and indices.max() >= num_corners):
            found = f"a face index reaches beyond the {num_corners} vertices"
            self.fail("glb_invalid", found, "unsigned indices of vertices that exist")
        return indices.astype(np.int64)

    def _accessor(self, index: int, width: int, rows: IntArray | slice = slice(None)) -> npt.NDArray[Any]:
        """Values (count, width) of an accessor, or some rows of them; checks that all lie in its buffer view."""
        accessor, name = self._entry("accessors", index), f"accessors[{index}]"
        if "sparse" in accessor or "bufferView" not in accessor:
            self.fail("glb_unsupported", f"{name} is sparse or has no data", "plain accessors; export it without compression")
        if accessor["type"] != _TYPES[width]:
            self.fail("glb_invalid", f"{name} holds {accessor['type']!r:.40}", f"{width} numbers per element")
        kind, view = np.dtype(_COMPONENTS[accessor["componentType"]]), self._entry("bufferViews", accessor["bufferView"])
        element = kind.itemsize * width
        count, offset = self._size(accessor, name, "count"), self._size(accessor, name, "byteOffset", 0)
        stride = self._size(view, f"the bufferView of {name}", "byteStride", 0) or element
        if stride < element:
            self.fail("glb_invalid", f"{name} has elements of {element} bytes every {stride}", "elements that do not overlap")
        content, end = self._view(accessor["bufferView"]), offset + (count - 1) * stride + element if count else offset
        if end > len(content):
            self.fail("glb_truncated", f"{name} ends at byte {end} of the {len(content)} of its bufferView", "all its elements")
        # numpy checks the size against the buffer only if the buffer is not empty, so it was checked above.
        values = np.ndarray((count, width), kind, content, offset, (stride, kind.itemsize))[rows]
        # Normalised integers represent numbers up to 1.
        return values / np.iinfo(kind).max if accessor.get("normalized") and kind.kind != "f" else values

    def _view(self, index: int) -> memoryview:
        """The bytes of a buffer view."""
        view, name = self._entry("bufferViews", index), f"bufferViews[{index}]"
        if "uri" in self._entry("buffers", view["buffer"]) or view["buffer"] != 0:
            expected = "one self-contained GLB; external files are not opened"
            self.fail("glb_unsupported", "its content is in a second file or a URI", expected)
        start, length = self._size(view, name, "byteOffset", 0), self._size(view, name, "byteLength")
        if start + length > len(self.binary):
            found = f"{name} ends at byte {start + length} of {len(self.binary)}"
            self.fail("glb_truncated", found, "a whole file; copy it again")
        return self.binary[start : start + length]

    def _entry(self, kind: str, index: object) -> dict[str, Any]:
        """Returns an entry of a list of the document; a negative index is refused, because it would count from the end."""
        entries = self.document[kind]
        if not isinstance(entries, list) or type(index) is not int or not 0 <= index < len(entries):
            self.fail("glb_invalid", f"refers to {kind}[{index!r:.40}]", f"an index into its list of {kind}; export it again")
        entry = entries[index]
        if not isinstance(entry, dict):
            self.fail("glb_invalid", f"{kind}[{index}] is {entry!r:.40}", "an object; export it again")
        return entry

    def _size(self, owner: dict[str, Any], name: str, key: str, default: int | None = None) -> int:
        """Returns a count or a number of bytes."""
        value = owner.get(key, default)
        if type(value) is not int or value < 0:  # isinstance would accept a bool
            self.fail("glb_invalid", f"{name} has {key} {value!r:.40}", "a whole number from 0; export it again")
        return value


def _num_levels(text: bytes) -> int:
    """Nesting depth of a JSON text; counted before parsing, because the parser is recursive."""
    # Escaped backslashes and quotes do not end a string.
    letters = np.frombuffer(text.replace(b"\\\\", b"").replace(b'\\"', b""), np.uint8)
    is_outside = np.cumsum(letters == ord('"')) % 2 == 0  # outside of strings
    return int(np.cumsum(_LEVEL_STEPS[letters] * is_outside).max(initial=0))


def _parent_from_node(node: dict[str, Any]) -> FloatArray:
    if "matrix" in node:
        return np.array(node["matrix"], np.float64).reshape(4, 4).T  # glTF stores columns first
    x, y, z, w = np.array(node.get("rotation", (0, 0, 0, 1)), np.float64)
    s = 2 / (x * x + y * y + z * z + w * w)  # also normalises the quaternion
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


def _moved_uv(uv: FloatArray, transform: dict[str, Any]) -> FloatArray:
    """Texture coordinates (..., 2) after the extension KHR_texture_transform; unchanged without one."""
    if not transform:
        return uv
    turn = float(transform.get("rotation", 0.0))
    scaled = uv * np.array(transform.get("scale", (1.0, 1.0)), np.float64).reshape(2)
    rotation = np.array([[np.cos(turn), np.sin(turn)], [-np.sin(turn), np.cos(turn)]])
    return np.asarray(scaled @ rotation.T + np.array(transform.get("offset", (0.0, 0.0)), np.float64).reshape(2))


def _triangles(indices: IntArray, mode: int) -> IntArray:
    if mode == _TRIANGLES:
        return indices[: len(indices) // 3 * 3].reshape(-1, 3)  # an incomplete last triangle is dropped
    num = max(len(indices) - 2, 0)
    if mode == _FAN:
        return np.stack([np.broadcast_to(indices[:1], num), indices[1 : num + 1], indices[2 : num + 2]], axis=1)
    strip = np.stack([indices[:num], indices[1 : num + 1], indices[2 : num + 2]], axis=1)
    strip[1::2] = strip[1::2, ::-1]  # every second triangle of a strip has the opposite winding
    return strip


def _welded(soup: FloatArray, faces: IntArray, reader: _GlbReader) -> Mesh:
    """Welds corners (V, 3) and faces (F, 3) to one clean mesh."""
    soup, faces, extent = _used(soup, faces, reader)
    return _with_area(center_vertices(*weld_vertices(soup, faces, WELD * extent)), extent, reader)


def _stored(soup: FloatArray, faces: IntArray, reader: _GlbReader) -> tuple[Mesh, bool]:
    """Corners (V, 3) and faces (F, 3) as a mesh, in the middle of whose box is the origin; and whether its faces are in order."""
    soup, faces, extent = _used(soup, faces, reader)
    order = reader.face_order(len(faces))
    if order is not None:
        faces = faces[np.argsort(order)]
    is_centred = np.abs(soup.min(axis=0) + soup.max(axis=0)).max() <= 2 * WELD * extent
    mesh = Mesh(soup, faces) if is_centred else center_vertices(soup, faces)
    return _with_area(mesh, extent, reader), order is not None


def _used(soup: FloatArray, faces: IntArray, reader: _GlbReader) -> tuple[FloatArray, IntArray, float]:
    """The used ones of corners (V, 3), the faces (F, 3) on them, and their largest extent; refuses coordinates of no usual size."""
    soup, faces = drop_unused_vertices(soup, faces)
    if not np.isfinite(soup).all():
        bad = int((~np.isfinite(soup)).any(axis=1).sum())
        reader.fail("glb_nan_vertices", f"{bad} of {len(soup)} vertices are not finite", "finite coordinates; export it again")
    extent = float(np.ptp(soup, axis=0).max())
    if not _SMALLEST < extent < 1 / _SMALLEST:
        reader.fail("glb_degenerate_only", f"its largest extent is {extent:.3g}", "a surface of a usual size")
    return soup, faces, extent


def _with_area(mesh: Mesh, extent: float, reader: _GlbReader) -> Mesh:
    """A mesh; one without area is refused."""
    if not (double_areas(mesh) > _FLAT * extent * extent).any():
        reader.fail("glb_degenerate_only", f"none of {len(mesh.faces)} faces has an area", "a surface; export it again")
    return mesh
