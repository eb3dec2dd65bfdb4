"""Reads one mesh file of a source folder, with its materials and textures, inside the folder's boundary."""

import html
import itertools
import re
from contextlib import suppress
from dataclasses import replace
from pathlib import PurePosixPath
from typing import Any

import numpy as np

from stable_data.errors import MeshError, Notice
from stable_data.geometry.surface import Surface
from stable_data.importers.boundary import Boundary
from stable_data.importers.formats.collada_dae import read_dae
from stable_data.importers.formats.gltf import read_gltf
from stable_data.importers.formats.mesh_file import MeshFile
from stable_data.importers.formats.obj import read_obj, texture_name
from stable_data.importers.formats.scans import read_ply, read_stl
from stable_data.importers.source import Axis
from stable_data.limits import LIMITS, at_most
from stable_data.scene import FloatArray

SUFFIXES = (".glb", ".gltf", ".obj", ".dae", ".ply", ".stl")
"""Mesh files that are read; of several of one name the first of this order has the most of its look."""

_NESTED = (".dae", ".gltf")  # formats that are read as text of nested parts
_ARCHIVES = {
    b"\x1f\x8b": "gzip",
    b"PK\x03\x04": "zip",
    b"BZh": "bzip2",
    b"\xfd7zXZ": "xz",
    b"7z\xbc\xaf": "7z",
    b"\x28\xb5\x2f\xfd": "zstd",
}
_SMALLEST, _LARGEST = 1e-30, 1e30  # squares and cubes of other extents leave the range of a double


class _FilesBeside:
    """The companions of a mesh file: read inside the boundary, refusals noted once, an image read once whatever its names are."""

    def __init__(self, root: Boundary, path: str, asset_id: str, shown: bytes | None) -> None:
        self.root = root
        self.folder = PurePosixPath(path).parent.as_posix()
        self.path = path
        self.asset_id = asset_id
        self.shown = shown
        self.notices: list[Notice] = []
        self._optional: dict[str, bytes | None] = {}
        self._contents: dict[tuple[str, str], bytes] = {}
        self._libraries: set[bytes] = set()
        self._named: set[str] = set()

    def image(self, reference: str) -> bytes | None:
        if self.shown is not None or not reference:
            return self.shown
        return self._asked(reference, "texture", "the surface is drawn without it", "max_bytes", LIMITS.image)

    def material_library(self, reference: str) -> bytes | None:
        self._check_count(reference)
        try:
            self.root.resolve(reference, self.folder)
            names = [reference]
        except MeshError:
            names = reference.split()  # a line may name several files, or one with spaces
        found = dict.fromkeys(
            self._asked(name, "material", "its materials are left out", "max_material_bytes") for name in dict.fromkeys(names)
        )
        new = [content for content in found if content is not None and content not in self._libraries]
        self._libraries.update(new)
        return b"\n".join(new) or None

    def note_lost_look(self, reason: str) -> None:
        message = (
            f"asset {self.asset_id}: the materials of {self.path} cannot be read ({reason:.200}); it is drawn without them"
        )
        self.notices.append(Notice(self.asset_id, "read", "material_invalid", message))

    def part(self, reference: str) -> bytes:
        self._check_count(reference)
        try:
            return self.root.read_bytes(self.root.resolve(reference, self.folder))
        except MeshError as error:
            code = "include_missing" if error.code == "file_missing" else error.code
            raise MeshError(f"{self.path}: {error}", code) from error

    def _check_count(self, reference: str) -> None:
        """Refuses a file that names very many others: each is looked for in several places."""
        self._named.add(reference)
        if len(self._named) > self.root.limits.max_files:
            found = f"{self.path}: names more files, expected {at_most(self.root.limits, 'max_files')}; simplify it"
            raise MeshError(found, "file_too_large")

    def _asked(self, reference: str, what: str, effect: str, limit: str, group: Any = None) -> bytes | None:
        """Content of a file without which the mesh can be used, or a notice."""
        if reference not in self._optional:
            self._check_count(reference)
            try:
                path = self.root.resolve(reference, self.folder)
                if (what, path) not in self._contents:
                    self._contents[what, path] = self.root.read_bytes(path, limit, group)
            except MeshError as error:
                reason = {"path_outside": "outside", "file_too_large": "too_large"}.get(error.code, "missing")
                message = f"asset {self.asset_id}: {self.path} refers to a {what}: {error}; {effect}"
                self.notices.append(Notice(self.asset_id, "read", f"{what}_{reason}", message))
                self._optional[reference] = None
            else:
                self._optional[reference] = self._contents[what, path]
        return self._optional[reference]


def read_mesh_file(
    root: Boundary, path: str, asset_id: str, *, max_faces: int, image: bytes | None = None
) -> tuple[MeshFile, tuple[Notice, ...]]:
    """Reads the surfaces of a GLB, glTF, OBJ, DAE, STL or PLY file.

    Images are the bytes of their files: nothing is decoded. A texture or a material file that is missing, too large or outside of
    the folder costs the look, not the mesh.

    Args:
        root: The boundary of the asset; it counts what is read.
        path: The file, relative to the folder.
        asset_id: The asset's name in notices.
        max_faces: Triangles beyond which the file is refused.
        image: Content of an image that an OBJ or DAE shows in place of its own textures, if it has texture coordinates.

    Returns:
        The content, in the axes and unit of the file, with at least one triangle and finite numbers; and notices about textures
        (``texture_missing``, ``texture_outside``, ``texture_too_large``, and the same with ``material``).

    Raises:
        MeshError: ``mesh_empty``, ``mesh_not_finite``, ``mesh_too_large``, ``model_unreadable``, ``cyclic_reference``,
            ``include_missing``, ``path_outside``, ``file_too_large``, ``file_missing``, or a code of a GLB.
        ConfigError: A package that the format needs is not installed.
    """
    suffix = PurePosixPath(path).suffix.lower()
    if suffix not in SUFFIXES:
        message = (
            f"{path}: the format {suffix or 'without a suffix'} is not read, expected one of {', '.join(SUFFIXES)}; convert it"
        )
        raise MeshError(message, "model_unreadable")
    content = root.read_bytes(path, "max_nested_bytes" if suffix in _NESTED else "max_file_bytes")
    _refuse_archives(content, path)
    beside = _FilesBeside(root, path, asset_id, image)
    if suffix in (".glb", ".gltf"):
        found = read_gltf(content, path, beside, max_faces=max_faces, files=root.limits)
    elif suffix == ".obj":
        found = read_obj(content, path, beside, max_faces=max_faces)
    elif suffix == ".dae":
        found = read_dae(content, path, beside, max_faces=max_faces)
    elif suffix == ".ply":
        found = read_ply(content, path, beside, max_faces=max_faces)
    else:
        found = read_stl(content, path, max_faces=max_faces)
    used = [index for index, surface in enumerate(found.surfaces) if len(surface.triangles)]
    surfaces = tuple(found.surfaces[index].with_valid_look() for index in used)
    _check(surfaces, path)
    names = tuple(found.names[index] for index in used) if found.names else ()
    return replace(found, surfaces=surfaces, names=names), tuple(beside.notices)


_SCANNED = 4 * 2**20  # bytes at the start of a file where names of others are looked for
_NAMES = {
    ".obj": re.compile(rb"^[ \t]*mtllib[ \t]+([^\r\n]{1,1000})", re.MULTILINE),
    ".mtl": re.compile(rb"^[ \t]*map_Kd[ \t]+([^\r\n]{1,1000})", re.MULTILINE | re.IGNORECASE),
    ".dae": re.compile(rb"<init_from>(?:\s{0,99}<ref>)?([^<]{1,1000})<"),
    ".ply": re.compile(rb"^comment[ \t]+TextureFile[ \t]+([^\r\n]{1,1000})", re.MULTILINE | re.IGNORECASE),
    ".gltf": re.compile(rb'"uri"\s{0,99}:\s{0,99}"([^"]{1,1000})"'),
    ".glb": re.compile(rb'"uri"\s{0,99}:\s{0,99}"([^"]{1,1000})"'),
}


def files_beside(root: Boundary, path: str) -> tuple[str, ...]:
    """Lists the files of the folder that a mesh file names, such as materials, buffers and textures, without parsing it.

    Names that no file has are left out: the reader says so.

    Args:
        root: The boundary of the folder.
        path: The mesh file, relative to the folder.
    """
    found: dict[str, None] = {}
    waiting = [path]
    while waiting and len(found) < root.limits.max_files:
        current = waiting.pop(0)
        suffix = PurePosixPath(current).suffix.lower()
        if suffix not in _NAMES:
            continue
        named = dict.fromkeys(_NAMES[suffix].findall(root.read_head(current, _SCANNED)))
        for name in itertools.islice(named, root.limits.max_files):  # a file with more is refused when it is read
            text = html.unescape(name.decode("utf-8", "replace")).strip()
            if text.startswith("data:"):
                continue
            with suppress(MeshError):
                reference = texture_name(text) if suffix == ".mtl" else text
                beside = root.resolve(reference, PurePosixPath(current).parent.as_posix())
                if beside not in found and beside != path:
                    found[beside] = None
                    waiting.append(beside)
    return tuple(found)


def _refuse_archives(content: bytes, path: str) -> None:
    for magic, name in _ARCHIVES.items():
        if content.startswith(magic):
            raise MeshError(f"{path}: is compressed ({name}), expected a plain mesh file; unpack it", "model_unreadable")


def _check(surfaces: tuple[Surface, ...], path: str) -> None:
    """Refuses what no surface can be.

    Raises:
        MeshError: ``mesh_empty`` or ``mesh_not_finite``.
    """
    if not surfaces:
        raise MeshError(f"{path}: has no triangle, expected at least one; is it a point cloud or an empty scene?", "mesh_empty")
    if not all(np.isfinite(surface.triangles).all() for surface in surfaces):
        raise MeshError(f"{path}: a vertex is not finite, expected finite coordinates; export it again", "mesh_not_finite")
    extent = float(np.ptp(joined_triangles(surfaces).reshape(-1, 3), axis=0).max())
    if extent <= _SMALLEST:
        raise MeshError(f"{path}: all its triangles lie in one point, expected a surface; export it again", "mesh_empty")
    if extent >= _LARGEST:
        raise MeshError(
            f"{path}: its largest extent is {extent:.3g}, expected a usual size; export it again", "mesh_not_finite"
        )


def joined_triangles(surfaces: tuple[Surface, ...]) -> FloatArray:
    """All triangles of surfaces, (F, 3, 3)."""
    return np.concatenate([surface.triangles for surface in surfaces])


def transformed(surfaces: tuple[Surface, ...], matrix: FloatArray) -> tuple[Surface, ...]:
    """Returns surfaces moved by a transform (4, 4); a mirrored one keeps its outside."""
    is_mirrored = np.linalg.det(matrix[:3, :3]) < 0
    order = slice(None, None, -1) if is_mirrored else slice(None)

    def ordered(values: FloatArray | None) -> FloatArray | None:
        return None if values is None else values[:, order]

    return tuple(
        replace(
            surface,
            triangles=(surface.triangles @ matrix[:3, :3].T + matrix[:3, 3])[:, order],
            corner_colours=ordered(surface.corner_colours),
            corner_uv=ordered(surface.corner_uv),
        )
        for surface in surfaces
    )


_TO_Z = {
    "x": ((0, -1, 0), (0, 0, -1), (1, 0, 0)),
    "y": ((1, 0, 0), (0, 0, -1), (0, 1, 0)),
    "z": ((1, 0, 0), (0, 1, 0), (0, 0, 1)),
    "-x": ((0, 1, 0), (0, 0, -1), (-1, 0, 0)),
    "-y": ((1, 0, 0), (0, 0, 1), (0, -1, 0)),
    "-z": ((1, 0, 0), (0, -1, 0), (0, 0, -1)),
}
AXES: dict[str, tuple[float, float, float]] = {
    "x": (1.0, 0.0, 0.0),
    "y": (0.0, 1.0, 0.0),
    "z": (0.0, 0.0, 1.0),
    "-x": (-1.0, 0.0, 0.0),
    "-y": (0.0, -1.0, 0.0),
    "-z": (0.0, 0.0, -1.0),
}
"""Unit vectors of the names of axes."""


def z_up(axis: Axis) -> FloatArray:
    """Returns the rotation (4, 4) that turns an axis of a file upward; none for z and for an unknown axis."""
    matrix = np.eye(4)
    matrix[:3, :3] = _TO_Z[axis or "z"]
    return matrix
