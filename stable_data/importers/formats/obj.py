"""Reads Wavefront OBJ with its material files.

trimesh reads this format too, but it takes relative (negative) indices from the end of the file instead of from the line, knows one
material file only and keeps no opacity.
"""

import io
import re
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field

import numpy as np

from stable_data.errors import MeshError
from stable_data.geometry.mesh_colors import to_linear
from stable_data.geometry.surface import Surface
from stable_data.importers.formats.mesh_file import Companions, MeshFile, check_face_count, fan, parsing, taken
from stable_data.scene import FloatArray, IntArray

_NUMBER = re.compile(r"[-+]?(?:\d+(?:\.\d*)?|\.\d+)(?:[eE][-+]?\d+)?$")
_CHUNK = 65_536  # lines
_WORD_OPTIONS = ("-blendu", "-blendv", "-cc", "-clamp", "-imfchan", "-type")  # of a texture; they take one word, not numbers


@dataclass(slots=True)
class _Material:
    colour: tuple[float, float, float] | None = None
    opacity: float = 1.0
    texture: str = ""


@dataclass(slots=True)
class _Rows:
    """Numbers of lines of one kind, kept as arrays: as text they would take ten times the memory."""

    width: int
    waiting: list[list[str]] = field(default_factory=list)
    chunks: list[FloatArray] = field(default_factory=list)
    count: int = 0

    def add(self, text: str) -> None:
        row = text.split()[: self.width]
        self.waiting.append(row + ["nan"] * (self.width - len(row)))
        self.count += 1
        if len(self.waiting) >= _CHUNK:
            self.flush()

    def flush(self) -> None:
        self.chunks.append(np.array(self.waiting, np.float64).reshape(-1, self.width))
        self.waiting = []

    def array(self) -> FloatArray:
        """All rows, (N, width); NaN where a line has fewer numbers."""
        self.flush()
        return np.concatenate(self.chunks)


@dataclass(slots=True)
class _Faces:
    """The faces of one material: corners one after the other, as indices from 0; -1 where a texture coordinate is not given."""

    corners: list[IntArray] = field(default_factory=list)
    coordinates: list[IntArray] = field(default_factory=list)
    counts: list[IntArray] = field(default_factory=list)
    waiting: list[tuple[list[str], int, int]] = field(default_factory=list)  # words, vertices and coordinates before the line

    def add(self, words: list[str], num_vertices: int, num_coordinates: int, path: str) -> None:
        self.waiting.append((words, num_vertices, num_coordinates))
        if len(self.waiting) >= _CHUNK:
            self.flush(path)

    def flush(self, path: str) -> None:
        counts = np.array([len(words) for words, _, _ in self.waiting], np.int64)
        known = np.repeat(np.array([numbers[1:] for numbers in self.waiting], np.int64).reshape(-1, 2), counts, axis=0)
        parts = [word.split("/") for words, _, _ in self.waiting for word in words]
        self.waiting = []
        self.counts.append(counts)
        self.corners.append(_indices([part[0] for part in parts], known[:, 0], path))
        coordinates = [part[1] if len(part) > 1 and part[1] else "0" for part in parts]
        self.coordinates.append(_indices(coordinates, known[:, 1], path, may_lack=True))


def read_obj(content: bytes, path: str, companions: Companions, *, max_faces: int) -> MeshFile:
    """Reads an OBJ: polygons as fans, materials (``Kd``, ``map_Kd``, ``d``, ``Tr``), colours of vertices.

    Args:
        content: The file; not trusted.
        path: Its name in messages.
        companions: Where material files and textures come from.
        max_faces: Triangles beyond which it is refused.

    Raises:
        MeshError: ``model_unreadable`` or ``mesh_too_large``.
    """
    with parsing(path, "a Wavefront OBJ"):
        vertices, coordinates = _Rows(6), _Rows(2)
        groups: dict[str, _Faces] = {}
        libraries: list[str] = []
        material, num_triangles = "", 0
        for line in _lines(content):
            word, *rest = line.split(None, 1) or [""]
            if not rest:
                continue
            if word == "v":
                vertices.add(rest[0])
            elif word == "vt":
                coordinates.add(rest[0])
            elif word == "f":
                words = rest[0].partition("#")[0].split()
                num_triangles += max(len(words) - 2, 0)
                check_face_count(path, num_triangles, max_faces)
                groups.setdefault(material, _Faces()).add(words, vertices.count, coordinates.count, path)
            elif word == "usemtl":
                material = rest[0].strip()
            elif word == "mtllib":
                libraries.append(rest[0].strip())
        rows, uv = vertices.array(), coordinates.array()
        materials, colours = _materials(libraries, companions), _vertex_colours(rows)
        surfaces = [
            _surface(faces, rows[:, :3], colours, uv, materials.get(name), path, companions) for name, faces in groups.items()
        ]
    return MeshFile(tuple(surfaces))


def _lines(content: bytes) -> Iterator[str]:
    """The lines of a file; those that end with a backslash are joined with the next."""
    begun = ""
    for line in io.TextIOWrapper(io.BytesIO(content), "utf-8", "replace"):
        if line.endswith("\\\n"):
            begun += line[:-2] + " "
        else:
            yield begun + line
            begun = ""
    yield begun


def _vertex_colours(rows: FloatArray) -> FloatArray | None:
    """Linear colours (V, 3) if every vertex has one."""
    colours = rows[:, 3:]
    if not len(colours) or not np.isfinite(colours).all():
        return None
    scale = 255.0 if colours.max() > 1.0 else 1.0  # some programs write bytes
    return to_linear(np.clip(colours / scale, 0.0, 1.0))


def _surface(
    faces: _Faces,
    positions: FloatArray,
    colours: FloatArray | None,
    uv: FloatArray,
    material: _Material | None,
    path: str,
    companions: Companions,
) -> Surface:
    faces.flush(path)
    rows = fan(np.concatenate(faces.counts))
    corners = np.concatenate(faces.corners)[rows]
    triangles = taken(positions, corners, path, "vertex")
    colour, image, corner_uv = None if material is None else material.colour, None, None
    places = np.concatenate(faces.coordinates)[rows]
    if len(places) and (places >= 0).all():
        image = companions.image("" if material is None else material.texture)
    if image is not None:
        corner_uv = taken(uv, places, path, "texture coordinate") * (1.0, -1.0) + (0.0, 1.0)  # its origin is lower left
        corner_uv = np.nan_to_num(corner_uv)  # a line with one number
        colour = (1.0, 1.0, 1.0)  # programs show the image alone, and files often say black beside it
    corner_colours = None if colours is None or image is not None else colours[corners]
    return Surface(triangles, colour, corner_colours, image, corner_uv, 1.0 if material is None else material.opacity)


def _indices(words: Sequence[str], known: IntArray, path: str, *, may_lack: bool = False) -> IntArray:
    """Indices from 0 of the corners of faces; -1 for one that lacks it.

    Raises:
        MeshError: An index is 0, or counts back beyond the first line.
    """
    found = np.array(words, dtype=np.str_).astype(np.int64) if len(words) else np.zeros(0, np.int64)
    indices = np.where(found > 0, found - 1, known + found)  # a negative one counts back from the line of the face
    is_lacking = found == 0
    if (is_lacking.any() and not may_lack) or (indices[~is_lacking] < 0).any():
        raise MeshError(f"{path}: a face refers to index 0 or below the first, expected indices from 1", "model_unreadable")
    return np.where(is_lacking, -1, indices)


def _materials(libraries: Sequence[str], companions: Companions) -> dict[str, _Material]:
    """The materials of all libraries; a later one of the same name does not count."""
    materials: dict[str, _Material] = {}
    for library in dict.fromkeys(libraries):
        content = companions.material_library(library)
        if content is not None:
            for name, material in _parse_library(content).items():
                materials.setdefault(name, material)
    return materials


def _parse_library(content: bytes) -> dict[str, _Material]:
    materials: dict[str, _Material] = {}
    current = _Material()  # what stands before the first material counts for none
    for line in content.decode("utf-8", "replace").splitlines():
        word, *rest = line.split(None, 1) or [""]
        if not rest or word.startswith("#"):
            continue
        key, value = word.lower(), rest[0].strip()
        if key == "newmtl":
            current = materials.setdefault(value, _Material())
        elif key == "map_kd":
            current.texture = texture_name(value)
        elif key == "kd" and (colour := _floats(value, 3)):
            red, green, blue = to_linear(np.clip(colour, 0.0, 1.0)).tolist()
            current.colour = (red, green, blue)
        elif key in ("d", "tr") and (share := _floats(value.removeprefix("-halo"), 1)):
            opacity = min(max(share[0], 0.0), 1.0)
            current.opacity = opacity if key == "d" else 1.0 - opacity
    return materials


def _floats(text: str, count: int) -> list[float]:
    """The first numbers of a text; none if it has fewer."""
    words = text.split()[:count]
    return [float(word) for word in words] if len(words) == count and all(map(_NUMBER.match, words)) else []


def texture_name(text: str) -> str:
    """Returns the file name behind the options of a texture, such as ``-s 1 1 1``; it may contain spaces."""
    rest = text
    while rest.startswith("-"):
        option, _, rest = rest.partition(" ")
        rest = rest.lstrip()
        is_word = option.lower() in _WORD_OPTIONS
        for _ in range(1 if is_word else 3):
            first, _, behind = rest.partition(" ")
            if not is_word and not _NUMBER.match(first):
                break
            rest = behind.lstrip()
    return rest.strip().strip('"')
