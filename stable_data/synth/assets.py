"""Assets of the embedded world: built once, weighed, named by content, written as GLB."""

import hashlib
import json
import struct
from dataclasses import dataclass
from functools import cache

import numpy as np

from stable_data.errors import ConfigError
from stable_data.mesatask.library import AssetAnnotation
from stable_data.mesh import Mesh
from stable_data.scene import FloatArray
from stable_data.synth.catalogue import CATALOGUE, DENSITY, AssetSpec
from stable_data.synth.solids import box, mesh_of, volume

_FLOAT, _UINT, _VERTICES, _INDICES = 5126, 5125, 34962, 34963


@dataclass(frozen=True, slots=True, eq=False)
class Asset:
    """An asset, ready to be placed.

    Attributes:
        uid: 32 hexadecimal digits, a hash of its file.
        spec: How it was made.
        mesh: Closed, outward, metres, z up, centred on its box.
        parts: The convex parts whose union it is, in the same frame.
        mass: Kilograms.
        glb: Its file.
    """

    uid: str
    spec: AssetSpec
    mesh: Mesh
    parts: tuple[Mesh, ...]
    mass: float
    glb: bytes

    @property
    def annotation(self) -> AssetAnnotation:
        """Its entry in Asset_annotation.json."""
        x, y, z = (self.mesh.extents / self.spec.unit).tolist()
        return AssetAnnotation(
            self.uid,
            category=self.spec.category,
            description=self.spec.caption.rstrip(".").lower(),
            caption=self.spec.caption,
            source="synth",
            mass=round(self.mass, 4),
            is_container=self.spec.is_container,
            extents_z_up=(x, y, z),
            raw={"materials": [self.spec.material]},
        )


@cache
def asset(key: str) -> Asset:
    """The asset of that name.

    Args:
        key: ``category/variant``, a key of the catalogue.

    Raises:
        ConfigError: There is none.
    """
    if key not in CATALOGUE:
        raise ConfigError(f"asset {key!r} is not in the catalogue, expected one of {sorted(CATALOGUE)}", "unknown_asset")
    spec = CATALOGUE[key]
    mesh, parts = mesh_of(spec.build())
    glb = write_glb(mesh, unit=spec.unit, is_z_up=spec.is_z_up)
    return Asset(uid_of(glb), spec, mesh, parts, DENSITY[spec.material] * volume(mesh), glb)


def uid_of(glb: bytes) -> str:
    """32 hexadecimal digits that name a file by its content."""
    return hashlib.blake2b(glb, digest_size=16).hexdigest()


def unit_cube() -> Mesh:
    """What the format uses as table top and sink: a cube of edge 1, centred."""
    return mesh_of(box(1.0, 1.0, 1.0))[0]


def write_glb(mesh: Mesh, *, unit: float = 1.0, is_z_up: bool = False) -> bytes:
    """A mesh as binary glTF: geometry only, the same bytes every time.

    Args:
        mesh: Metres, z up.
        unit: Metres in one unit of the file.
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


def _pack(vertices: FloatArray, faces: FloatArray, node: dict[str, object]) -> bytes:
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
