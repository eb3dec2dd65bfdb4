"""Writes binary glTF: geometry, colours, convex parts; the same input gives the same bytes."""

import hashlib
import json
import struct
from collections.abc import Callable, Sequence
from typing import Any, TypeAlias

import numpy as np
import numpy.typing as npt

from stable_data.geometry.gltf_reader import COLLIDERS, FACE_ORDER, PART_FACES, TEXTURE
from stable_data.geometry.mesh import Mesh, join_meshes
from stable_data.geometry.mesh_colors import to_linear
from stable_data.geometry.surface import Surface, index_surface
from stable_data.scene import FloatArray, IntArray

# Constants of the glTF 2.0 specification.
_FLOAT, _UINT, _VERTICES, _INDICES = 5126, 5125, 34962, 34963
GltfArray: TypeAlias = FloatArray | IntArray | npt.NDArray[np.float32]
"""An array that an accessor describes, see :func:`pack`."""


def write_glb(
    mesh: Mesh,
    *,
    unit: float = 1.0,
    is_z_up: bool = False,
    paint: Sequence[tuple[str, IntArray]] = (),
    parts: Sequence[Mesh] = (),
    surfaces: Sequence[Surface] = (),
    keeps_order: bool = False,
) -> bytes:
    """Writes a mesh as binary glTF; the same input gives the same bytes.

    Args:
        mesh: Any unit, z up.
        unit: Mesh units per unit of the file.
        is_z_up: Store the coordinates z up, under a node that rotates, scales and moves them.
        paint: Display colours and the faces that have them, each face once: (``#rrggbb``, indices).
        parts: Convex parts whose union is the mesh, in its frame. They become a second mesh, ``colliders``, that no node shows;
            its ``extras.part_faces`` lists the number of faces of each part.
        surfaces: The faces of the mesh with materials and textures, each once; they take the place of ``paint``. Their images, PNG
            or JPEG, are in the file.
        keeps_order: With ``paint``, also say in which order the faces were, on which a sample of a surface depends: ``extras.face_order``
            of the mesh names the accessor of their numbers, or is null if they are in that order.

    Returns:
        The content of the file. The scene is y up, as glTF demands.
    """
    node: dict[str, object] = {"mesh": 0, "name": "asset"}
    if is_z_up:
        shift = mesh.extents[2] / unit / 2  # the mesh stands on the origin of its node
        half = np.sqrt(0.5)
        node |= {"rotation": [-half, 0.0, 0.0, half], "scale": [2.0, 2.0, 2.0], "translation": [0.0, shift, 0.0]}

    def stored(vertices: FloatArray) -> FloatArray:
        if is_z_up:
            return vertices / unit / 2
        return y_up(vertices) / unit

    shown = SurfaceParts()
    arrays = shown.arrays
    meshes: list[dict[str, Any]] = [{"primitives": [shown.primitive(surface, stored) for surface in surfaces]}]
    document: dict[str, Any] = {"scene": 0, "scenes": [{"nodes": [0]}], "nodes": [node], "meshes": meshes}
    if not surfaces:
        face_groups = [mesh.faces[rows] for _, rows in paint] or [mesh.faces]
        primitives = [{"attributes": {"POSITION": 0}, "indices": 1 + k} for k in range(len(face_groups))]
        meshes[0]["primitives"] = primitives
        arrays += [stored(mesh.vertices), *face_groups]
        if paint:
            document["materials"] = [material(color) for color, _ in paint]
            meshes[0]["primitives"] = [{**primitive, "material": k} for k, primitive in enumerate(primitives)]
            order = np.concatenate([rows for _, rows in paint])
            if keeps_order and np.array_equal(order, np.arange(len(order))):
                meshes[0]["extras"] = {FACE_ORDER: None}
            elif keeps_order:
                meshes[0]["extras"] = {FACE_ORDER: len(arrays)}
                arrays.append(order)
    if parts:
        primitive = {"attributes": {"POSITION": len(arrays)}, "indices": len(arrays) + 1}
        meshes.append({"name": COLLIDERS, "primitives": [primitive], "extras": {PART_FACES: [len(p.faces) for p in parts]}})
        joined = join_meshes(parts)
        arrays += [stored(joined.vertices), joined.faces]
    return pack(document | shown.document(shown.embedded_images()), arrays, shown.images)


def material(color: str) -> dict[str, Any]:
    """Returns the glTF material of a display colour (sRGB), ``#rrggbb``; glTF stores linear RGBA."""
    linear = to_linear(np.array([int(color[k : k + 2], 16) / 255 for k in (1, 3, 5)])).tolist()
    factor = [*(round(channel, 5) for channel in linear), 1.0]
    return {"pbrMetallicRoughness": {"baseColorFactor": factor, "metallicFactor": 0.0}}


def write_look(surfaces: Sequence[Surface]) -> bytes:
    """Writes surfaces with colours and texture coordinates as binary glTF, for the column ``look``; y up.

    Args:
        surfaces: At least one triangle in all; any unit, z up. Their images are rows of the table ``textures``: the file has
            their addresses (``texture:`` and the SHA-256 of the image) and not their content.

    Returns:
        The content of the file: a primitive for each surface, in order. Read it with
        :func:`stable_data.geometry.gltf_reader.load_surfaces`.
    """
    parts = SurfaceParts()
    primitives = [parts.primitive(surface, y_up) for surface in surfaces if len(surface.triangles)]
    document: dict[str, Any] = {"scene": 0, "scenes": [{"nodes": [0]}], "nodes": [{"mesh": 0, "name": "look"}]}
    addresses = [{"uri": TEXTURE + hashlib.sha256(image).hexdigest()} for image in parts.images]
    return pack(document | {"meshes": [{"primitives": primitives}]} | parts.document(addresses), parts.arrays)


def y_up(vertices: FloatArray) -> FloatArray:
    """Turns coordinates (V, 3) from z up to y up, as glTF demands."""
    return np.stack([vertices[:, 0], vertices[:, 2], -vertices[:, 1]], axis=1)


class SurfaceParts:
    """Arrays, materials and images of the surfaces in a glTF document under construction.

    Attributes:
        arrays: The accessors of the document, see :func:`pack`.
        images: Contents of the images, each once.
    """

    def __init__(self) -> None:
        self.arrays: list[GltfArray] = []
        self.images: list[bytes] = []
        self.materials: list[dict[str, Any]] = []

    def primitive(
        self,
        surface: Surface,
        to_file: Callable[[FloatArray], FloatArray] = lambda vertices: vertices,
        normals: FloatArray | None = None,
    ) -> dict[str, Any]:
        """Adds a surface and returns its primitive; equal corners are stored once.

        Args:
            surface: At least one triangle.
            to_file: Turns coordinates (V, 3) into those of the file.
            normals: Normals of the corners in the frame of the file, (F, 3, 3); without them faces are seen flat.
        """
        indexed = index_surface(surface, to_file, normals)
        names = {"POSITION": indexed.points, "NORMAL": indexed.normals, "TEXCOORD_0": indexed.uv, "COLOR_0": indexed.colours}
        columns = {name: column for name, column in names.items() if column is not None}
        attributes = {name: len(self.arrays) + k for k, name in enumerate(columns)}
        self.arrays += [*columns.values(), indexed.faces]
        primitive: dict[str, Any] = {"attributes": attributes, "indices": len(self.arrays) - 1}
        material = self._material(surface)
        return primitive if material is None else primitive | {"material": material}

    def _material(self, surface: Surface) -> int | None:
        """The number of the material of a surface, which is added if it is new; None without one."""
        image = surface.image if surface.corner_uv is not None else None
        is_clear = surface.opacity < 1 or (surface.has_alpha and image is not None)
        if surface.colour is None and image is None and not is_clear:
            return None
        found: dict[str, Any] = {
            "baseColorFactor": [*(surface.colour or (1.0, 1.0, 1.0)), surface.opacity],
            "metallicFactor": 0.0,
        }
        if image is not None:
            if image not in self.images:
                self.images.append(image)
            found["baseColorTexture"] = {"index": self.images.index(image)}
        material = {"pbrMetallicRoughness": found, "doubleSided": True} | ({"alphaMode": "BLEND"} if is_clear else {})
        if material not in self.materials:
            self.materials.append(material)
        return self.materials.index(material)

    def embedded_images(self) -> list[dict[str, Any]]:
        """Returns the glTF image of each of ``images`` if :func:`pack` stores them behind all arrays that were added until now."""
        kinds = ["image/png" if image.startswith(b"\x89PNG") else "image/jpeg" for image in self.images]
        return [{"bufferView": len(self.arrays) + k, "mimeType": kind} for k, kind in enumerate(kinds)]

    def document(self, images: Sequence[dict[str, Any]]) -> dict[str, Any]:
        """Returns the entries ``materials``, ``textures`` and ``images`` of the document, as far as there are any.

        Args:
            images: The glTF image of each of ``images``.
        """
        textures = [{"source": k} for k in range(len(images))]
        entries = {"materials": self.materials, "textures": textures, "images": list(images)}
        return {name: found for name, found in entries.items() if found}


def pack(document: dict[str, Any], arrays: Sequence[GltfArray], images: Sequence[bytes] = ()) -> bytes:
    """Packs a glTF document.

    Args:
        document: The document without accessors and buffers.
        arrays: Accessor k is ``arrays[k]``: positions or colours (V, 3), or texture coordinates (V, 2), if it holds floats; else
            faces.
        images: Image files; their buffer views follow those of the arrays.

    Returns:
        The content of the file.
    """
    accessors: list[dict[str, Any]] = []
    views: list[dict[str, Any]] = []
    chunks: list[bytes] = []
    start = 0

    def add(content: bytes, **entries: int) -> None:
        nonlocal start
        chunks.append(content + b"\0" * (-len(content) % 4))
        views.append({"buffer": 0, "byteOffset": start, "byteLength": len(content)} | entries)
        start += len(chunks[-1])

    for k, array in enumerate(arrays):
        if array.dtype.kind == "f":
            stored = array.astype("<f4")
            add(stored.tobytes(), target=_VERTICES)
            accessor: dict[str, Any] = {"bufferView": k, "componentType": _FLOAT, "count": len(stored)}
            box = {"min": stored.min(axis=0).tolist(), "max": stored.max(axis=0).tolist()}
            accessors.append(accessor | ({"type": "VEC3", **box} if stored.shape[1] == 3 else {"type": "VEC2"}))
        else:
            add(array.astype("<u4").tobytes(), target=_INDICES)
            accessors.append({"bufferView": k, "componentType": _UINT, "count": array.size, "type": "SCALAR"})
    for image in images:
        add(image)
    binary = b"".join(chunks)
    document = {"asset": {"version": "2.0", "generator": "stable-data"}, **document}
    document |= {"accessors": accessors, "bufferViews": views, "buffers": [{"byteLength": len(binary)}]}
    text = json.dumps(document, separators=(",", ":")).encode()
    text += b" " * (-len(text) % 4)  # chunks are aligned to 4 bytes
    size = 12 + 8 + len(text) + 8 + len(binary)
    header = struct.pack("<4sII", b"glTF", 2, size)
    return b"".join((header, struct.pack("<I4s", len(text), b"JSON"), text, struct.pack("<I4s", len(binary), b"BIN\0"), binary))
