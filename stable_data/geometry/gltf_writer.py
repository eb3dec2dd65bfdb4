"""Writes binary glTF: geometry, colours, convex parts; the same input gives the same bytes."""

import json
import struct
from collections.abc import Sequence
from typing import Any

import numpy as np

from stable_data.geometry.gltf_reader import COLLIDERS, PART_FACES
from stable_data.geometry.mesh import Mesh, join_meshes
from stable_data.geometry.mesh_colors import to_linear
from stable_data.scene import FloatArray, IntArray

_FLOAT, _UINT, _VERTICES, _INDICES = 5126, 5125, 34962, 34963  # constants of the glTF 2.0 specification


def write_glb(
    mesh: Mesh,
    *,
    unit: float = 1.0,
    is_z_up: bool = False,
    paint: Sequence[tuple[str, IntArray]] = (),
    parts: Sequence[Mesh] = (),
) -> bytes:
    """Writes a mesh as binary glTF; the same input gives the same bytes.

    Args:
        mesh: Any unit, z up.
        unit: Mesh units per unit of the file.
        is_z_up: Store the coordinates z up, under a node that rotates, scales and moves them.
        paint: Display colours and the faces that have them, each face once: (``#rrggbb``, indices).
        parts: Convex parts whose union is the mesh, in its frame. They become a second mesh, ``colliders``, that no node shows;
            its ``extras.part_faces`` lists the number of faces of each part.

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
        return np.stack([vertices[:, 0], vertices[:, 2], -vertices[:, 1]], axis=1) / unit  # from z up to y up

    face_groups = [mesh.faces[rows] for _, rows in paint] or [mesh.faces]
    primitives = [{"attributes": {"POSITION": 0}, "indices": 1 + k} for k in range(len(face_groups))]
    meshes: list[dict[str, Any]] = [{"primitives": primitives}]
    document: dict[str, Any] = {"scene": 0, "scenes": [{"nodes": [0]}], "nodes": [node], "meshes": meshes}
    arrays: list[FloatArray | IntArray] = [stored(mesh.vertices), *face_groups]
    if paint:
        document["materials"] = [material(color) for color, _ in paint]
        meshes[0]["primitives"] = [{**primitive, "material": k} for k, primitive in enumerate(primitives)]
    if parts:
        primitive = {"attributes": {"POSITION": len(arrays)}, "indices": len(arrays) + 1}
        meshes.append({"name": COLLIDERS, "primitives": [primitive], "extras": {PART_FACES: [len(p.faces) for p in parts]}})
        joined = join_meshes(parts)
        arrays += [stored(joined.vertices), joined.faces]
    return pack(document, arrays)


def material(color: str) -> dict[str, Any]:
    """Returns the glTF material of a display colour (sRGB), ``#rrggbb``; glTF stores linear RGBA."""
    linear = to_linear(np.array([int(color[k : k + 2], 16) / 255 for k in (1, 3, 5)])).tolist()
    factor = [*(round(channel, 5) for channel in linear), 1.0]
    return {"pbrMetallicRoughness": {"baseColorFactor": factor, "metallicFactor": 0.0}}


def pack(document: dict[str, Any], arrays: Sequence[FloatArray | IntArray]) -> bytes:
    """Packs a glTF document whose accessor k is ``arrays[k]``: corners if it holds floats, else faces."""
    accessors: list[dict[str, Any]] = []
    views: list[dict[str, Any]] = []
    chunks: list[bytes] = []
    for k, array in enumerate(arrays):
        is_corners = array.dtype.kind == "f"
        stored = array.astype("<f4" if is_corners else "<u4")
        start = sum(map(len, chunks))
        chunks.append(stored.tobytes())
        target = _VERTICES if is_corners else _INDICES
        views.append({"buffer": 0, "byteOffset": start, "byteLength": len(chunks[-1]), "target": target})
        accessor: dict[str, Any] = {"bufferView": k, "componentType": _FLOAT if is_corners else _UINT}
        if is_corners:
            box = {"min": stored.min(axis=0).tolist(), "max": stored.max(axis=0).tolist()}
            accessors.append(accessor | {"count": len(stored), "type": "VEC3", **box})
        else:
            accessors.append(accessor | {"count": stored.size, "type": "SCALAR"})
    binary = b"".join(chunks)
    document = {"asset": {"version": "2.0", "generator": "stable-data"}, **document}
    document |= {"accessors": accessors, "bufferViews": views, "buffers": [{"byteLength": len(binary)}]}
    text = json.dumps(document, separators=(",", ":")).encode()
    text += b" " * (-len(text) % 4)  # chunks are aligned to 4 bytes
    size = 12 + 8 + len(text) + 8 + len(binary)
    header = struct.pack("<4sII", b"glTF", 2, size)
    return b"".join((header, struct.pack("<I4s", len(text), b"JSON"), text, struct.pack("<I4s", len(binary), b"BIN\0"), binary))
