"""MJCF text made safe: includes in place, and no name of a file left that MuJoCo could open by itself."""

import copy
import io
import math
import re
from collections.abc import Collection, Iterator, Mapping
from dataclasses import dataclass
from pathlib import PurePosixPath
from typing import NoReturn
from xml.etree.ElementTree import Element, tostring

from stable_data.errors import MeshError
from stable_data.importers.boundary import Boundary
from stable_data.importers.formats.mesh_file import check_face_count
from stable_data.importers.formats.xml_text import parse_xml
from stable_data.importers.mjcf_files import FILE_ATTRIBUTES, check_names, file_reference
from stable_data.json_text import quote_value
from stable_data.limits import LIMITS, MIB, at_most

_MODEL = re.compile(rb"<mujoco[\s/>]")
_NOT_FINITE = re.compile(r"(?i)nan|inf")
_ASSETS = ("mesh", "texture")
# What could execute code, has files of its own, or makes much out of few words; no rigid object needs it.
_REFUSED = frozenset(
    {"attach", "composite", "deformable", "extension", "flex", "flexcomp", "hfield", "plugin", "replicate", "skin"}
)
# Sections that do not shape a rigid body; some of them reserve memory.
_DROPPED = frozenset(
    {"actuator", "contact", "custom", "equality", "keyframe", "option", "sensor", "size", "statistic", "tendon", "visual"}
)
_COMPILER_DROPPED = ("assetdir", "discardvisual", "fusestatic", "meshdir", "strippath", "texturedir")
_TEXTURE_KEPT = ("name", "type")


@dataclass(frozen=True, slots=True)
class Texture:
    """A texture of a model.

    Attributes:
        reference: The name of its image as it stands in the model, with the directory of textures; empty without a file.
        is_mirrored: Whether the image is mirrored from left to right, and from top to bottom.
        colour: Mean display colour of a texture that is made without a file, red, green, blue; white for others.
    """

    reference: str
    is_mirrored: tuple[bool, bool]
    colour: tuple[float, float, float]


@dataclass(frozen=True, slots=True, eq=False)
class IsolatedModel:
    """A model that MuJoCo compiles without any file.

    Attributes:
        text: The model. Its meshes name entries of ``meshes``; its textures have one pixel.
        meshes: Name -> content of the file.
        textures: Name of a texture -> what the model says about it.
    """

    text: str
    meshes: Mapping[str, bytes]
    textures: Mapping[str, Texture]


@dataclass(frozen=True, slots=True, eq=False)
class MjcfText:
    """A model with all its includes in place.

    Attributes:
        path: Its file, relative to the folder.
        root: The element ``mujoco``.
        includes: The files that were put in place, relative to the folder.
    """

    path: str
    root: Element
    includes: tuple[str, ...]

    @classmethod
    def load(cls, boundary: Boundary, path: str) -> "MjcfText | None":
        """Reads a model and what it includes.

        Returns:
            The model; None if the file is no model, but other XML or a fragment that models include.

        Raises:
            MeshError: ``model_unreadable``, ``cyclic_reference``, ``file_too_large``: it names too many files; or a code of the boundary.
        """
        content = boundary.read_bytes(path, "max_xml_bytes")
        if _MODEL.search(content) is None:
            return None
        root = parse_xml(content, path)
        if root.tag != "mujoco":
            return None
        included: list[str] = []
        _put_includes_in_place(boundary, root, (path,), included)
        model = cls(path, root, tuple(included))
        check_names(path, model._names(), model._compiler, boundary.limits)
        return model

    @property
    def base(self) -> str:
        """The folder that names of files refer to, relative to the source folder."""
        return PurePosixPath(self.path).parent.as_posix()

    @property
    def is_object(self) -> bool:
        """Whether something of the model has a shape."""
        return any(world.find(".//geom") is not None for world in self.root.iter("worldbody"))

    @property
    def says_friction(self) -> bool:
        """Whether the friction of any geom is stated."""
        return any("friction" in geom.attrib for geom in self.root.iter("geom"))

    @property
    def says_total_mass(self) -> bool:
        """Whether the model states the mass of all its bodies together."""
        try:
            return float(self._compiler.get("settotalmass") or -1) > 0
        except ValueError:
            return False

    def statement(self, *names: str) -> str:
        """What the first text of the section ``custom`` with one of these names says; empty if there is none."""
        texts = (text for custom in self.root.iter("custom") for text in custom.iter("text"))
        return next((t.get("data", "").strip()[:1000] for t in texts if t.get("name", "").lower() in names), "")

    def references(self) -> Mapping[tuple[str, str], str]:
        """Kind of a mesh or texture and name of a file as it stands in the model -> the name with its directory."""
        compiler = self._compiler
        return {(kind, name): file_reference(kind, name, compiler) for kind, name in self._names()}

    def isolated(self, boundary: Boundary, max_faces: int) -> IsolatedModel:
        """Reads the meshes and returns the model with all names of files replaced.

        Args:
            boundary: The boundary of the asset.
            max_faces: Triangles of all meshes beyond which the model is refused.

        Raises:
            MeshError: ``model_unsupported``: it has elements that no rigid object needs; ``model_unreadable``: a number is not
                finite; ``mesh_too_large``; or a code of the boundary.
        """
        for element in self.root.iter():
            if any(map(_is_not_finite, element.attrib.values())):
                self._fail(
                    f"has a number that is not finite in an element {quote_value(element.tag)}", "numbers", "model_unreadable"
                )
            if element.tag in _REFUSED or (element.tag == "mesh" and "builtin" in element.attrib):
                self._fail(f"has an element {quote_value(element.tag)} that is not read", "a rigid object", "model_unsupported")
        model = MjcfText(self.path, copy.deepcopy(self.root), self.includes)
        meshes = _Meshes(boundary, max_faces)
        textures: dict[str, Texture] = {}
        assets, references = list(model._assets()), self.references()
        for element in assets:
            if element.tag == "mesh":
                model._replace_mesh(element, meshes, references)
            else:
                model._replace_texture(element, textures, references)
        known = set(map(id, assets))
        if any(name in element.attrib for element in model.root.iter() if id(element) not in known for name in FILE_ATTRIBUTES):
            self._fail("names a file outside of its assets", "files of meshes and textures alone", "model_unsupported")
        for element in model.root.iter("compiler"):
            for name in _COMPILER_DROPPED:
                element.attrib.pop(name, None)
        for section in [child for child in model.root if child.tag in _DROPPED]:
            model.root.remove(section)
        return IsolatedModel(tostring(model.root, encoding="unicode"), meshes.contents, textures)

    def _assets(self) -> Iterator[Element]:
        for asset in self.root.iter("asset"):
            yield from (element for element in asset if element.tag in _ASSETS)

    def _names(self) -> Collection[tuple[str, str]]:
        """Kinds of meshes and textures with the names of files that stand in them, each once."""
        named = ((element, name) for element in self._assets() for name in FILE_ATTRIBUTES if name in element.attrib)
        return dict.fromkeys((element.tag, element.attrib[name]) for element, name in named)

    @property
    def _compiler(self) -> Mapping[str, str]:
        return {name: value for compiler in self.root.iter("compiler") for name, value in compiler.attrib.items()}

    def _replace_mesh(self, element: Element, meshes: "_Meshes", references: Mapping[tuple[str, str], str]) -> None:
        if "file" not in element.attrib:
            return
        name = meshes.name_of(references[element.tag, element.attrib["file"]], self.base)
        element.attrib.setdefault("name", PurePosixPath(element.attrib["file"].replace("\\", "/")).stem)
        element.attrib.pop("content_type", None)
        element.attrib["file"] = name

    def _replace_texture(
        self, element: Element, textures: dict[str, Texture], references: Mapping[tuple[str, str], str]
    ) -> None:
        """Records a texture and replaces it by a pixel: MuJoCo would decode images of any size, and PNG alone."""
        files = [references[element.tag, element.attrib[name]] for name in FILE_ATTRIBUTES if name in element.attrib]
        if "file" in element.attrib:
            element.attrib.setdefault("name", PurePosixPath(element.attrib["file"].replace("\\", "/")).stem)
        mirrored = element.get("hflip", "").lower() == "true", element.get("vflip", "").lower() == "true"
        colour = (1.0, 1.0, 1.0) if files else _mean_colour(element)
        textures[element.get("name", "")] = Texture(files[0] if files else "", mirrored, colour)
        kept = {name: element.attrib[name] for name in _TEXTURE_KEPT if name in element.attrib}
        element.attrib.clear()
        element.attrib.update(kept, builtin="flat", width="1", height="1")

    def _fail(self, found: str, expected: str, code: str) -> NoReturn:
        raise MeshError(f"{quote_value(self.path)} {found}, expected {expected}", code)


class _Meshes:
    """The files of meshes of a model: each is read once, and its triangles are counted as often as it is named."""

    def __init__(self, boundary: Boundary, max_faces: int) -> None:
        self.contents: dict[str, bytes] = {}
        self._boundary, self._max_faces = boundary, max_faces
        self._paths: dict[str, str] = {}
        self._names: dict[str, str] = {}
        self._faces: dict[str, int] = {}
        self._num_faces = 0

    def name_of(self, reference: str, base: str) -> str:
        """Reads a file and returns its name in ``contents``."""
        if reference not in self._paths:
            self._paths[reference] = self._boundary.resolve(reference, base)
        path = self._paths[reference]
        if path not in self._names:
            name = f"{len(self.contents)}{PurePosixPath(path).suffix.lower()}"
            self._names[path], self.contents[name] = name, self._boundary.read_bytes(path)
            self._faces[name] = _num_faces(name, self.contents[name])
        name = self._names[path]
        self._num_faces += self._faces[name]
        check_face_count(quote_value(path), self._num_faces, self._max_faces)
        return name


def _num_faces(name: str, content: bytes) -> int:
    """Triangles of a mesh file, about, without a look at its geometry; MuJoCo has no limit.

    MuJoCo makes a hull of vertices without faces. They count as the triangles that they could be corners of.
    """
    suffix = PurePosixPath(name).suffix
    if suffix == ".obj":
        return _num_obj_faces(content)
    if suffix == ".msh":
        return max(int.from_bytes(content[12:16], "little"), int.from_bytes(content[:4], "little") // 3)
    return max(len(content) - 84, 0) // 50  # a binary STL, the only other format that MuJoCo reads


def _num_obj_faces(content: bytes) -> int:
    """Triangles of an OBJ as MuJoCo reads its lines: blanks may stand before them, and each ends with any line end.

    MuJoCo cuts a polygon in time that grows with the square of its corners, so a large one counts as much.
    """
    num_faces = num_vertices = 0
    for line in io.BytesIO(content.replace(b"\r", b"\n")):
        text = line.lstrip(b" \t")
        if text.startswith((b"f ", b"f\t")):
            num = len(text.split()) - 1 if len(text) < MIB else len(text) // 2  # a list of words takes much memory
            num_faces += max(num - 2, num * num // 64, 1)
        elif text.startswith((b"v ", b"v\t")):
            num_vertices += 1
    return max(num_faces, num_vertices // 3)


def _is_not_finite(value: str) -> bool:
    """Whether an attribute has numbers of which one is not finite. MuJoCo writes a file of its own about them."""
    if _NOT_FINITE.search(value) is None:
        return False
    try:
        return not all(map(math.isfinite, map(float, value.split())))
    except ValueError:
        return False


def _mean_colour(texture: Element) -> tuple[float, float, float]:
    """Mean display colour of a texture that MuJoCo makes: of one colour, or of two."""

    def colour(name: str, default: float) -> list[float]:
        try:
            values = [min(1.0, max(0.0, float(word))) for word in texture.get(name, "").split()]
        except ValueError:
            values = []
        return values if len(values) == 3 else [default] * 3

    one = colour("rgb1", 0.8)
    two = one if texture.get("builtin") == "flat" else colour("rgb2", 0.5)
    red, green, blue = ((a + b) / 2 for a, b in zip(one, two, strict=True))
    return red, green, blue


def _put_includes_in_place(boundary: Boundary, root: Element, trail: tuple[str, ...], included: list[str]) -> None:
    """Replaces each ``include`` below an element by the children of the file's root, as MuJoCo does."""
    for parent in list(root.iter()):
        for include in [child for child in parent if child.tag == "include"]:
            place = list(parent).index(include)
            parent.remove(include)
            path = _included(boundary, include.get("file", ""), trail)
            if path in (*trail, *included) or len(trail) > LIMITS.model.max_levels:
                message = f"{quote_value(trail[-1])} includes {quote_value(path)} again or too deep"
                most = at_most(LIMITS.model, "max_levels", "levels")
                raise MeshError(f"{message}, expected each file once and {most}", "cyclic_reference")
            included.append(path)
            fragment = parse_xml(boundary.read_bytes(path, "max_xml_bytes"), path)
            _put_includes_in_place(boundary, fragment, (*trail, path), included)
            parent[place:place] = list(fragment)
    num = sum(1 for _ in root.iter())
    if num > LIMITS.model.max_elements:
        most = at_most(LIMITS.model, "max_elements")
        message = f"{quote_value(trail[0])} has {num} elements with its includes, expected {most}"
        raise MeshError(message, "model_unreadable")


def _included(boundary: Boundary, reference: str, trail: tuple[str, ...]) -> str:
    """An included file: MuJoCo seeks it from the folder of the model, and other tools from that of the including file."""
    bases = dict.fromkeys(PurePosixPath(path).parent.as_posix() for path in (trail[0], trail[-1]))
    failure: MeshError | None = None
    for base in bases:
        try:
            return boundary.resolve(reference, base)
        except MeshError as error:
            failure = failure or error
    assert failure is not None
    raise failure
