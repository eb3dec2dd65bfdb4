"""Reads glTF and GLB whose buffers and images may lie in other files or in ``data:`` addresses."""

import base64
import json
import struct
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from typing import Any, NoReturn
from urllib.parse import unquote_to_bytes

from stable_data.errors import MeshError
from stable_data.geometry.gltf_reader import count_triangles, load_surfaces
from stable_data.geometry.surface import Surface
from stable_data.importers.formats.mesh_file import Companions, MeshFile, check_face_count, parsing
from stable_data.json_text import json_value
from stable_data.limits import LIMITS, FileLimits, GltfLimits, at_most

_MAGIC = b"glTF"
_JSON_CHUNK, _BIN_CHUNK = 0x4E4F534A, 0x004E4942
_CODES = {"glb_no_faces": "mesh_empty", "glb_nan_vertices": "mesh_not_finite", "glb_too_large": "mesh_too_large"}


def read_gltf(content: bytes, path: str, companions: Companions, *, max_faces: int, files: FileLimits) -> MeshFile:
    """Reads a glTF or GLB; all is packed to one GLB in memory for the reader of :mod:`stable_data.geometry.gltf_reader`.

    Args:
        content: The file; not trusted.
        path: Its name in messages.
        companions: Where buffers and images come from.
        max_faces: Triangles beyond which it is refused.
        files: The limit on the bytes of all buffers and images.

    Raises:
        MeshError: ``cyclic_reference``, ``mesh_empty``, ``mesh_not_finite``, ``mesh_too_large``, ``model_unreadable``, a code of
            :func:`stable_data.geometry.gltf_reader.load_glb`, or that of a buffer which cannot be read.
    """
    document, whole = pack_gltf(content, path, companions, limits=LIMITS.mesh, files=files)
    with parsing(path, "glTF 2.0"):
        asset = document.get("asset", {})
        extras = asset.get("extras", {})
        extras = extras if isinstance(extras, dict) else {}
        licence = str(extras.get("license") or extras.get("licence") or "")
        rights = str(asset.get("copyright") or "")
        author = str(extras.get("author") or "")
    with codes_of_files():
        any_number = replace(LIMITS.mesh, max_faces=sys.maxsize, max_corners=sys.maxsize)
        num_faces, num_corners = count_triangles(document, path, limits=any_number)
        check_face_count(path, max(num_faces, -(-num_corners // 3)), max_faces)
        found = load_surfaces(whole, path, limits=replace(any_number, max_bytes=len(whole)))
    return MeshFile(tuple(_as_in_the_file(surface) for surface in found), None, "y", licence, rights, author)


def gltf_document(content: bytes, path: str, limits: GltfLimits) -> dict[str, Any]:
    """Returns the JSON of a glTF or GLB; of a GLB only the beginning with this JSON is needed.

    Args:
        content: The file; not trusted.
        path: Its name in messages.
        limits: The limit on the JSON of a GLB.

    Raises:
        MeshError: ``model_unreadable``, ``mesh_too_large``.
    """
    with parsing(path, "glTF 2.0"):
        return _opened(content, path, limits)[0]


def json_span(content: bytes) -> tuple[int, int]:
    """Returns where the JSON of a glTF or GLB, which :func:`gltf_document` has read, begins and ends, in bytes."""
    return (20, 20 + json_length(content)) if content.startswith(_MAGIC) else (0, len(content))


def json_length(head: bytes) -> int:
    """Returns the length in bytes of the JSON of a GLB, which begins at byte 20, from these 20 bytes; 0 if it is no GLB."""
    return int(struct.unpack_from("<I", head, 12)[0]) if head.startswith(_MAGIC) and len(head) >= 20 else 0


def pack_gltf(
    content: bytes, path: str, companions: Companions, *, limits: GltfLimits, files: FileLimits
) -> tuple[dict[str, Any], bytes]:
    """Returns the JSON of a glTF or GLB, and the file with all its buffers and images as one GLB.

    Args:
        content: The file; not trusted.
        path: Its name in messages.
        companions: Where buffers and images come from.
        limits: The limit on the JSON of a GLB.
        files: The limit on the bytes of all buffers and images.

    Raises:
        MeshError: ``cyclic_reference``, ``mesh_too_large``, ``model_unreadable``, or the code of a buffer which cannot be read.
    """
    with parsing(path, "glTF 2.0"):
        document, binary = _opened(content, path, limits)
        packed = _Packing(path, companions, document, binary, files)
        packed.check_nodes()
        return document, packed.glb()


@contextmanager
def codes_of_files() -> Iterator[None]:
    """Gives the errors of :mod:`stable_data.geometry.gltf_reader` the codes that those of other formats have."""
    try:
        yield
    except MeshError as error:
        raise MeshError(str(error).removeprefix("asset "), _CODES.get(error.code, error.code)) from error


def _as_in_the_file(surface: Surface) -> Surface:
    """A surface of ``load_surfaces``, which is z up, in the axes of the file."""
    turned = surface.triangles[..., [0, 2, 1]] * (1.0, 1.0, -1.0)
    image = surface.image if surface.corner_uv is not None else None
    return replace(surface, triangles=turned, image=image)


def _opened(content: bytes, path: str, limits: GltfLimits) -> tuple[dict[str, Any], bytes | None]:
    """The JSON of a file, and the binary chunk of a GLB."""
    if not content.startswith(_MAGIC):
        return _object(content), None
    version, _, length, kind = struct.unpack_from("<4I", content, 4)
    if version != 2 or kind != _JSON_CHUNK or length > len(content) - 20:
        raise ValueError(f"version {version}, a first chunk of kind {kind:#x} and {length} bytes")
    if length > limits.max_json_bytes:
        most = at_most(limits, "max_json_bytes", "bytes")
        raise MeshError(f"{path}: has {length:,} bytes of JSON, expected {most}; simplify it", "mesh_too_large")
    document, end = _object(content[20 : 20 + length]), 20 + length
    if end + 8 > len(content):
        return document, None
    length, kind = struct.unpack_from("<2I", content, end)
    return document, content[end + 8 : end + 8 + length] if kind == _BIN_CHUNK else None


def _object(text: bytes) -> dict[str, Any]:
    document = json_value(text.decode("utf-8-sig"))
    if not isinstance(document, dict):
        raise ValueError("the JSON is no object")
    return document


class _Packing:
    """Brings the buffers and images of a document into one binary chunk."""

    def __init__(
        self, path: str, companions: Companions, document: dict[str, Any], binary: bytes | None, files: FileLimits
    ) -> None:
        self.path = path
        self.companions = companions
        self.document = document
        self.binary = binary
        self.files = files
        self.parts: dict[str, bytes] = {}  # by address; many entries may have one
        self.images: dict[str, bytes | None] = {}
        self.chunks: list[bytes] = []
        self.size = 0

    def fail(self, found: str, expected: str, code: str = "model_unreadable") -> NoReturn:
        raise MeshError(f"{self.path}: {found}, expected {expected}", code)

    def check_nodes(self) -> None:
        """Refuses nodes that contain themselves.

        Raises:
            MeshError: ``cyclic_reference``.
        """
        nodes = self.document.get("nodes", [])
        children = [node.get("children", []) for node in nodes]
        stack, trail = [iter(range(len(nodes)))], list[int]()
        above, done = set[int](), set[int]()
        while stack:
            child = next(stack[-1], None)
            if child is None:
                stack.pop()
                if trail:
                    done.add(trail[-1])
                    above.discard(trail.pop())
            elif child in above:
                self.fail(f"node {child} contains itself", "a tree of nodes; export it again", "cyclic_reference")
            elif child not in done and type(child) is int and 0 <= child < len(nodes):
                trail.append(child)
                above.add(child)
                stack.append(iter(children[child]))

    def glb(self) -> bytes:
        """Returns the whole as a binary glTF."""
        starts, sizes = [], []
        for index, buffer in enumerate(self.document.get("buffers", [])):
            content = self._buffer(index, buffer)
            starts.append(self._add(content))
            sizes.append(len(content))
        views = [self._moved(view, starts, sizes) for view in self.document.get("bufferViews", [])]
        images = [self._image(image, views) for image in self.document.get("images", [])]
        document = self.document | {"bufferViews": views, "images": images, "buffers": [{"byteLength": self.size}]}
        text = json.dumps(document, separators=(",", ":")).encode()
        text += b" " * (-len(text) % 4)
        total = 28 + len(text) + self.size
        head = struct.pack("<4s4I", _MAGIC, 2, total, len(text), _JSON_CHUNK)
        return b"".join((head, text, struct.pack("<2I", self.size, _BIN_CHUNK), *self.chunks))

    def _add(self, content: bytes) -> int:
        """Adds content to the chunk; returns where it starts."""
        start, filler = self.size, -len(content) % 4
        self.size += len(content) + filler
        if self.size > self.files.max_bytes:
            most = at_most(self.files, "max_bytes", "bytes")
            self.fail(f"its buffers and images have {self.size} bytes", most, "mesh_too_large")
        self.chunks += (content, bytes(filler))
        return start

    def _buffer(self, index: int, buffer: dict[str, Any]) -> bytes:
        uri = buffer.get("uri")
        if uri is None:
            if index or self.binary is None:
                self.fail(f"buffer {index} has no content", "a uri, or a GLB with a binary chunk; export it again")
            return self.binary
        if uri not in self.parts:
            self.parts[uri] = _of_data_address(uri) if uri.startswith("data:") else self.companions.part(uri)
        return self.parts[uri]

    def _moved(self, view: dict[str, Any], starts: list[int], sizes: list[int]) -> dict[str, Any]:
        """A view of a buffer as a view of the one chunk."""
        buffer, offset, length = view["buffer"], view.get("byteOffset", 0), view["byteLength"]
        if not all(type(n) is int and n >= 0 for n in (buffer, offset, length)) or offset + length > sizes[buffer]:
            self.fail(f"a bufferView ends at byte {offset + length} of {sizes[buffer]}", "a whole file; copy it again")
        return view | {"buffer": 0, "byteOffset": starts[buffer] + offset}

    def _image(self, image: dict[str, Any], views: list[dict[str, Any]]) -> dict[str, Any]:
        """An image as a view of the chunk; without one if its file is missing or refused."""
        uri = image.get("uri")
        if not isinstance(uri, str):
            return image
        if uri not in self.images:
            self.images[uri] = _of_data_address(uri) if uri.startswith("data:") else self.companions.image(uri)
        content = self.images[uri]
        left = {key: value for key, value in image.items() if key != "uri"}
        if content is None:
            return left
        views.append({"buffer": 0, "byteOffset": self._add(content), "byteLength": len(content)})
        return left | {"bufferView": len(views) - 1}


def _of_data_address(uri: str) -> bytes:
    """The content of a ``data:`` address."""
    kind, _, data = uri.partition(",")
    return base64.b64decode(data) if kind.endswith(";base64") else unquote_to_bytes(data)
