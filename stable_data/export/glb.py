"""Binary glTF: geometry only, the same bytes every time."""

import json
import struct

import numpy as np
import numpy.typing as npt

from stable_data.mesh import Mesh

_FLOAT, _UINT, _VERTICES, _INDICES = 5126, 5125, 34962, 34963  # of the glTF 2.0 specification


def write_glb(mesh: Mesh, *, unit: float = 1.0, is_z_up: bool = False) -> bytes:
    """A mesh as binary glTF: geometry only, the same bytes every time.

    Args:
        mesh: Any unit, z up.
        unit: Mesh units in one unit of the file.
        is_z_up: Keep the coordinates z up, under a node that turns, scales and moves them.

    Returns:
        The file. What it shows is y up, as glTF demands.
    """
    vertices = mesh.vertices / unit
    node: dict[str, object] = {"mesh": 0, "name": "asset"}
    if is_z_up:
        shift = mesh.extents[2] / unit / 2  # stands on its node's origin
        half = np.sqrt(0.5)
        node |= {"rotation": [-half, 0.0, 0.0, half], "scale": [2.0, 2.0, 2.0], "translation": [0.0, shift, 0.0]}
        vertices = vertices / 2
    else:
        vertices = np.c_[vertices[:, 0], vertices[:, 2], -vertices[:, 1]]
    return _pack(vertices.astype("<f4"), mesh.faces.astype("<u4"), node)


def _pack(vertices: npt.NDArray[np.float32], faces: npt.NDArray[np.uint32], node: dict[str, object]) -> bytes:
    positions, indices = vertices.tobytes(), faces.tobytes()
    document = {
        "asset": {"version": "2.0", "generator": "stable-data"},
        "scene": 0,
        "scenes": [{"nodes": [0]}],
        "nodes": [node],
        "meshes": [{"primitives": [{"attributes": {"POSITION": 0}, "indices": 1}]}],
        "accessors": [
            {
                "bufferView": 0,
                "componentType": _FLOAT,
                "count": len(vertices),
                "type": "VEC3",
                "min": vertices.min(axis=0).tolist(),
                "max": vertices.max(axis=0).tolist(),
            },
            {"bufferView": 1, "componentType": _UINT, "count": faces.size, "type": "SCALAR"},
        ],
        "bufferViews": [
            {"buffer": 0, "byteOffset": 0, "byteLength": len(positions), "target": _VERTICES},
            {"buffer": 0, "byteOffset": len(positions), "byteLength": len(indices), "target": _INDICES},
        ],
        "buffers": [{"byteLength": len(positions) + len(indices)}],
    }
    text = json.dumps(document, separators=(",", ":")).encode()
    text += b" " * (-len(text) % 4)
    binary = positions + indices
    size = 12 + 8 + len(text) + 8 + len(binary)
    header = struct.pack("<4sII", b"glTF", 2, size)
    return b"".join((header, struct.pack("<I4s", len(text), b"JSON"), text, struct.pack("<I4s", len(binary), b"BIN\0"), binary))
