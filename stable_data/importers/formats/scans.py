"""Reads STL and PLY, the formats of scans and prints, by trimesh; textures of PLY are not decoded."""

import io
import re
import warnings
from typing import Any

import numpy as np

from stable_data.errors import MeshError
from stable_data.geometry.mesh_colors import to_linear
from stable_data.geometry.surface import Surface
from stable_data.importers.formats.mesh_file import Companions, MeshFile, check_face_count, fan, parsing, taken
from stable_data.limits import LIMITS, at_most
from stable_data.scene import FloatArray, IntArray

_TEXTURE = re.compile(rb"^comment[ \t]+TextureFile[ \t]+([^\r\n]{1,1000})", re.IGNORECASE | re.MULTILINE)
_COORDINATES = (("texture_u", "texture_v"), ("u", "v"), ("s", "t"))  # names of texture coordinates of vertices
_STL_TRIANGLE = np.dtype([("normal", "<f4", 3), ("corners", "<f4", (3, 3)), ("attributes", "<u2")])
_MOST_HEADER = 65_536  # bytes of a PLY header


def read_stl(content: bytes, path: str, *, max_faces: int) -> MeshFile:
    """Reads a binary or ASCII STL.

    Args:
        content: The file; not trusted.
        path: Its name in messages.
        max_faces: Triangles beyond which it is refused.

    Raises:
        MeshError: ``model_unreadable`` or ``mesh_too_large``.
    """
    from trimesh.exchange.stl import load_stl_ascii

    count = int.from_bytes(content[80:84], "little") if len(content) >= 84 else 0
    if b"facet" in content[:1000] and len(content) != 84 + 50 * count:
        _check_text(content, path, is_text=True)
        with parsing(path, "a binary or ASCII STL"), warnings.catch_warnings():
            warnings.simplefilter("error")  # numpy warns where a number cannot be read, and goes on
            loaded: dict[str, Any] = load_stl_ascii(io.BytesIO(content))
            solids = list(loaded["geometry"].values()) if "geometry" in loaded else [loaded]  # several solids, or none
            found = [taken(np.asarray(s["vertices"], np.float64), np.asarray(s["faces"]), path, "vertex") for s in solids]
        check_face_count(path, sum(map(len, found)), max_faces)
        return MeshFile(tuple(map(Surface, found)))
    if len(content) < 84 + 50 * count or len(content) < 84:  # some programs write more bytes behind the triangles
        found_text = f"{path}: says {count} triangles and has {len(content)} bytes"
        raise MeshError(f"{found_text}, expected a whole binary or ASCII STL; copy it again", "model_unreadable")
    check_face_count(path, count, max_faces)
    triangles = np.frombuffer(content, _STL_TRIANGLE, count, 84)["corners"].astype(np.float64)
    return MeshFile((Surface(triangles),))


def read_ply(content: bytes, path: str, companions: Companions, *, max_faces: int) -> MeshFile:
    """Reads a PLY with colours of vertices or faces, and a texture by coordinates of vertices or faces.

    Args:
        content: The file; not trusted.
        path: Its name in messages.
        companions: Where the texture comes from.
        max_faces: Triangles beyond which it is refused.

    Raises:
        MeshError: ``model_unreadable`` (also polygons of different numbers of corners in a binary file) or ``mesh_too_large``.
    """
    from trimesh.exchange.ply import load_ply

    _check_text(content, path, is_text=b"format ascii" in content[:_MOST_HEADER])
    with parsing(path, "a PLY of triangles"), warnings.catch_warnings():
        warnings.simplefilter("error")
        loaded: dict[str, Any] = load_ply(io.BytesIO(content), fix_texture=False, skip_materials=True)
        elements = loaded["metadata"]["_ply_raw"]
        faces = loaded.get("faces")
        if faces is None or "vertices" not in loaded:
            return MeshFile(())
        counts = np.array([len(face) for face in faces], np.int64)
        flat = np.concatenate([np.asarray(face) for face in faces]).astype(np.int64)
        rows = fan(counts)
        check_face_count(path, len(rows), max_faces)
        corners = flat[rows]
        triangles = taken(np.asarray(loaded["vertices"], np.float64), corners, path, "vertex")
        image = corner_uv = None
        if named := _TEXTURE.search(content[:_MOST_HEADER]):
            corner_uv = _corner_uv(elements, counts, rows, corners)
            image = None if corner_uv is None else companions.image(named[1].decode("utf-8", "replace").strip())
        colours = _colours(loaded, counts, corners) if image is None else None
    colour = (1.0, 1.0, 1.0) if image is not None else None
    return MeshFile((Surface(triangles, colour, colours, image, corner_uv if image is not None else None),))


def _check_text(content: bytes, path: str, *, is_text: bool) -> None:
    if is_text and len(content) > LIMITS.file.max_ascii_bytes:
        found = f"{path}: an ASCII file of {len(content)} bytes"
        most = at_most(LIMITS.file, "max_ascii_bytes", "bytes")
        raise MeshError(f"{found}, expected {most}; export it as binary", "mesh_too_large")


def _corner_uv(elements: dict[str, Any], counts: IntArray, rows: IntArray, corners: IntArray) -> FloatArray | None:
    """Texture coordinates (F, 3, 2) of triangles, from the upper left."""
    vertex, face = elements["vertex"]["data"], elements["face"]["data"]
    names = vertex.keys() if isinstance(vertex, dict) else vertex.dtype.names
    uv = None
    for u, v in _COORDINATES:
        if u in names and v in names:
            uv = np.stack([np.ravel(vertex[u]), np.ravel(vertex[v])], axis=1).astype(np.float64)[corners]
            break
    face_names = face.keys() if isinstance(face, dict) else face.dtype.names
    if uv is None and "texcoord" in face_names:
        of_faces = face["texcoord"]
        if not isinstance(face, dict):
            of_faces = of_faces["f1"]
        flat = np.concatenate([np.asarray(row, np.float64) for row in of_faces]).reshape(-1, 2)
        if len(flat) == counts.sum():
            uv = flat[rows]
    return None if uv is None else uv * (1.0, -1.0) + (0.0, 1.0)


def _colours(loaded: dict[str, Any], counts: IntArray, corners: IntArray) -> FloatArray | None:
    """Linear colours (F, 3, 3) of the corners of triangles."""
    of_vertices, of_faces = loaded.get("vertex_colors"), loaded.get("face_colors")
    if of_vertices is None and of_faces is None:
        return None
    found = np.asarray(of_faces if of_vertices is None else of_vertices)[:, :3]
    scale = 1.0 if found.dtype.kind == "f" and found.max(initial=0.0) <= 1.0 else 255.0
    linear = to_linear(np.clip(found / scale, 0.0, 1.0))
    if of_vertices is not None:
        return np.asarray(linear[corners])
    of_triangles = np.repeat(linear, np.maximum(counts - 2, 0), axis=0)
    return np.repeat(of_triangles[:, None], 3, axis=1)
