"""Mesh files for formats that reference them: OBJ with MTL and PNG, which the readers of SDFormat, URDF and MJCF all open.

The files of a prop, or of the furniture of a scene, are in one folder::

    collision/part_<number>.obj       a convex part
    visual/surface_<number>.obj       what is seen in one texture or colour, with surface_<number>.mtl
    visual/<content>.png              a texture
    meshes.json                       the list of them, written last

Metres, z up. Texture coordinates are from 0 to 1 where the size of the image allows it. An OBJ file has one material at most: some
readers take only the first of a file.
"""

import hashlib
import io
import json
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image

from stable_data.assets.store import AssetStore
from stable_data.atomic_files import write_file_atomically
from stable_data.export.props import Prop, prop_parts, prop_surfaces
from stable_data.geometry.mesh import Mesh, area_vectors
from stable_data.geometry.surface import Surface
from stable_data.scene import FloatArray
from stable_data.simulation.look_meshes import LookMesh, look_meshes
from stable_data.simulation.mujoco_model import SUPPORT
from stable_data.simulation.offscreen import Picture
from stable_data.simulation.room import furnish
from stable_data.simulation.scene_geometry import SceneGeometry

LIST_FILE = "meshes.json"
_VERSION = 1
_EDGE = 1e-4  # share of an image by which coordinates may be beyond it
_LARGEST_IMAGE = 3 * 4096**2  # bytes, of an image that is put side by side


@dataclass(frozen=True, slots=True)
class VisualFile:
    """What is seen in one texture or colour.

    Attributes:
        mesh: The OBJ file, relative to the folder.
        texture: The PNG file, relative to the folder; None without one.
        rgba: Display colour and opacity, 0 to 1; multiplies the texture.
    """

    mesh: str
    texture: str | None
    rgba: tuple[float, float, float, float]


@dataclass(frozen=True, slots=True)
class MeshFiles:
    """The mesh files of a folder.

    Attributes:
        collision: The convex parts, relative to the folder.
        visual: What is seen.
    """

    collision: tuple[str, ...]
    visual: tuple[VisualFile, ...]


def put_prop_meshes(prop: Prop, store: AssetStore, folder: Path) -> MeshFiles:
    """Writes the mesh files of a prop at its usual size, if they do not exist.

    Args:
        prop: The prop.
        store: Its meshes.
        folder: The folder, of this prop alone.

    Raises:
        MeshError: None of its convex parts is solid.
        OSError: The folder cannot be written.
    """
    if (known := _read(folder)) is not None:
        return known
    parts = prop_parts(prop, store)
    surfaces = look_meshes(tuple(prop_surfaces(prop, store))) or look_meshes(tuple(Surface(p.triangles) for p in parts))
    return _write(folder, parts, surfaces)


def put_furniture_meshes(geometry: SceneGeometry, folder: Path) -> tuple[str, MeshFiles]:
    """Writes what is seen of the table, without the room, if it does not exist.

    Args:
        geometry: The scene.
        folder: The folder of the furniture of all scenes.

    Returns:
        The name of the furniture, which is also that of its folder, and its files.

    Raises:
        OSError: The folder cannot be written.
    """
    support, table = geometry.support, geometry.scene.table
    shown = list(support.placed()) if support is not None else []
    bounds = None if support is None else support.bounds
    shown += [p.surface for p in furnish(table, *geometry.seen_bounds, bounds) if p.is_of_table]
    key = hashlib.sha256(json.dumps([SUPPORT, table.size_xy]).encode())
    for s in shown:
        key.update(json.dumps([s.colour, s.opacity, s.has_alpha, len(s.triangles)]).encode())
        for array in (s.triangles, s.corner_uv, s.corner_colours):
            key.update(b"" if array is None else array.tobytes())
        key.update(s.image or b"")
    name = f"table_{key.hexdigest()[:12]}"
    if (known := _read(folder / name)) is not None:
        return name, known
    return name, _write(folder / name, (), look_meshes(tuple(shown)) if shown else ())


def _read(folder: Path) -> MeshFiles | None:
    """The files that exist; None if they are not complete."""
    try:
        known = json.loads((folder / LIST_FILE).read_bytes())
        if known["version"] != _VERSION:
            return None
        visual = (VisualFile(v["mesh"], v["texture"], tuple(v["rgba"])) for v in known["visual"])
        return MeshFiles(tuple(known["collision"]), tuple(visual))
    except (OSError, ValueError, TypeError, LookupError):
        return None


def _write(folder: Path, parts: Sequence[Mesh], surfaces: Sequence[LookMesh]) -> MeshFiles:
    for kind in ("collision", "visual"):
        (folder / kind).mkdir(parents=True, exist_ok=True)
    collision = []
    for number, part in enumerate(parts):
        collision.append(f"collision/part_{number}.obj")
        write_file_atomically(folder / collision[-1], obj_file(part.vertices, part.faces))
    visual = [_write_surface(folder, number, surface) for number, surface in enumerate(surfaces)]
    known = {
        "version": _VERSION,
        "collision": collision,
        "visual": [{"mesh": v.mesh, "texture": v.texture, "rgba": v.rgba} for v in visual],
    }
    write_file_atomically(folder / LIST_FILE, (json.dumps(known, indent=1) + "\n").encode())
    return MeshFiles(tuple(collision), tuple(visual))


def _write_surface(folder: Path, number: int, surface: LookMesh) -> VisualFile:
    name = f"surface_{number}"
    texture = uv = rows = None
    if surface.pixels is not None and surface.corner_uv is not None:
        corner_uv, pixels = _within_image(surface.corner_uv, surface.pixels)
        uv, rows = np.unique(corner_uv.reshape(-1, 2), axis=0, return_inverse=True)
        rows = rows.reshape(-1, 3)
        key = hashlib.sha256(repr(pixels.shape).encode() + pixels.tobytes())
        texture = f"{key.hexdigest()[:16]}.png"
        if not (folder / "visual" / texture).exists():
            write_file_atomically(folder / "visual" / texture, png_file(pixels))
    red, green, blue, opacity = (float(v) for v in surface.rgba)
    lines = [f"newmtl {name}", "Ka 0 0 0", f"Kd {red:.6g} {green:.6g} {blue:.6g}", "Ks 0.05 0.05 0.05", "Ns 20"]
    lines += [f"d {opacity:.6g}", "illum 2"]
    lines += [f"map_Kd {texture}"] if texture else []
    write_file_atomically(folder / "visual" / f"{name}.mtl", ("\n".join(lines) + "\n").encode())
    content = obj_file(surface.vertices, surface.faces, uv, rows, _vertex_normals(surface.vertices, surface.faces), name)
    write_file_atomically(folder / "visual" / f"{name}.obj", content)
    texture = None if texture is None else f"visual/{texture}"
    return VisualFile(f"visual/{name}.obj", texture, (red, green, blue, opacity))


def _within_image(corner_uv: FloatArray, pixels: Picture) -> tuple[FloatArray, Picture]:
    """Texture coordinates (F, 3, 2) from 0 to 1, and the image as often side by side as that needs: not every reader repeats it.

    An image that would become too large stays as it is, with coordinates beyond it.
    """
    own = corner_uv - np.floor(corner_uv.min(axis=1, keepdims=True) + _EDGE)
    columns, rows = np.maximum(np.ceil(own.max(axis=(0, 1)) - _EDGE), 1).astype(int).tolist()
    if columns * rows > 1 and columns * rows * pixels.size > _LARGEST_IMAGE:
        return corner_uv, pixels
    return np.clip(own / (columns, rows), 0.0, 1.0), np.tile(pixels, (rows, columns, 1))


def _vertex_normals(vertices: FloatArray, faces: Any) -> FloatArray:
    """Normals (V, 3) of length 1; up where a vertex has no face with an area."""
    sums = np.zeros_like(vertices, dtype=np.float64)
    np.add.at(sums, faces.ravel(), area_vectors(vertices[faces]).repeat(3, axis=0))
    length = np.linalg.norm(sums, axis=1, keepdims=True)
    return np.asarray(np.divide(sums, length, out=np.tile([0.0, 0.0, 1.0], (len(sums), 1)), where=length > 0))


def obj_file(
    vertices: Any, faces: Any, uv: Any = None, uv_rows: Any = None, normals: Any = None, material: str | None = None
) -> bytes:
    """Returns the content of a Wavefront OBJ file; nine digits represent single precision exactly.

    Args:
        vertices: (V, 3).
        faces: (F, 3).
        uv: Texture coordinates from the upper left, (T, 2).
        uv_rows: Their rows at the corners, (F, 3).
        normals: Normals of the vertices, (V, 3).
        material: Name of the material, in an MTL file of this name beside the file.
    """
    lines = [] if material is None else [f"mtllib {material}.mtl", f"usemtl {material}"]
    lines += [f"v {x:.9g} {y:.9g} {z:.9g}" for x, y, z in vertices.tolist()]
    columns, corner = [faces + 1], "{}"
    if uv is not None:
        lines += [f"vt {u:.9g} {1 - v:.9g}" for u, v in uv.tolist()]  # the format counts from below
        columns, corner = [*columns, uv_rows + 1], "{}/{}"
    if normals is not None:
        lines += [f"vn {x:.5g} {y:.5g} {z:.5g}" for x, y, z in (np.round(normals, 5) + 0.0).tolist()]
        columns, corner = [*columns, faces + 1], "{}/{}/{}" if uv is not None else "{}//{}"
    face = f"f {corner} {corner} {corner}"
    lines += [face.format(*row) for row in np.stack(columns, axis=2).reshape(len(faces), -1).tolist()]
    return ("\n".join(lines) + "\n").encode()


def png_file(pixels: Picture) -> bytes:
    """Returns the content of a PNG file; MuJoCo reads no JPEG."""
    stream = io.BytesIO()
    Image.fromarray(pixels).save(stream, "png")
    return stream.getvalue()
