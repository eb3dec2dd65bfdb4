"""GLB files for tests: plain ones, and ones whose JSON is another."""

import json
import struct
from collections.abc import Callable
from typing import Any

from stable_data.geometry.mesh import Mesh


def glb_bytes(mesh: Mesh) -> bytes:
    """A plain GLB: accessor 0 holds the indices, accessor 1 the corners, y up."""
    corners = (mesh.vertices[:, [0, 2, 1]] * (1.0, 1.0, -1.0)).astype("<f4")
    indices = mesh.faces.astype("<u4").tobytes()
    document = {
        "asset": {"version": "2.0"},
        "scenes": [{"nodes": [0]}],
        "nodes": [{"mesh": 0}],
        "meshes": [{"primitives": [{"attributes": {"POSITION": 1}, "indices": 0}]}],
        "accessors": [
            {"bufferView": 0, "componentType": 5125, "count": mesh.faces.size, "type": "SCALAR"},
            {"bufferView": 1, "componentType": 5126, "count": len(corners), "type": "VEC3"},
        ],
        "bufferViews": [
            {"buffer": 0, "byteOffset": 0, "byteLength": len(indices)},
            {"buffer": 0, "byteOffset": len(indices), "byteLength": corners.nbytes},
        ],
        "buffers": [{"byteLength": len(indices) + corners.nbytes}],
    }
    return rebuilt(document, indices + corners.tobytes())


def document_of(data: bytes) -> tuple[dict[str, Any], bytes]:
    """The JSON and the binary chunk of a GLB."""
    length = struct.unpack_from("<I", data, 12)[0]
    return json.loads(data[20 : 20 + length]), data[28 + length :]


def rebuilt(document: dict[str, Any] | bytes, binary: bytes) -> bytes:
    """The GLB of a JSON, or of its text, and a binary chunk."""
    text = document if isinstance(document, bytes) else json.dumps(document).encode()
    text += b" " * (-len(text) % 4)
    head = struct.pack("<5I", 0x46546C67, 2, 28 + len(text) + len(binary), len(text), 0x4E4F534A)
    return head + text + struct.pack("<2I", len(binary), 0x004E4942) + binary


def edited(data: bytes, edit: Callable[[dict[str, Any]], object]) -> bytes:
    """A GLB whose JSON a function changed in place."""
    document, binary = document_of(data)
    edit(document)
    return rebuilt(document, binary)
