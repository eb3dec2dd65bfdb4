"""Reads Gazebo model folders and SDFormat files."""

import itertools
import math
import xml.etree.ElementTree as ET
from collections.abc import Iterator
from dataclasses import dataclass, field, replace
from pathlib import PurePosixPath

import numpy as np

from stable_data.errors import MeshError, Notice
from stable_data.importers.asset_ids import AssetIds
from stable_data.importers.boundary import Boundary, asset_id_of, renamed_notice
from stable_data.importers.formats.model_xml import (
    inertia_of,
    linear_colour,
    numbers,
    pose_matrix,
    positive,
    rotation_of_rpy,
    text_of,
)
from stable_data.importers.formats.xml_text import parse_xml
from stable_data.importers.mesh_files import SUFFIXES
from stable_data.importers.rigid_models import (
    WORLD,
    Geometry,
    Joint,
    Link,
    LinkShape,
    RigidModel,
    assemble,
    check_parts,
    found_model,
)
from stable_data.importers.source import ReaderOptions, SourceAsset, SourceRef
from stable_data.importers.stated_licences import LicenceFiles, licence_of_text, licences_of_file
from stable_data.json_text import is_unicode, quote_value
from stable_data.limits import LIMITS, at_most
from stable_data.rotations import normalise_quat, rotation_matrix
from stable_data.scene import FloatArray

CONFIG = "model.config"
_OF_A_MODEL = (
    *SUFFIXES,
    ".mtl",
    ".bin",
    ".png",
    ".jpg",
    ".jpeg",
    ".webp",
    ".tga",
    ".bmp",
    ".gif",
    ".tif",
    ".tiff",
    ".sdf",
    ".config",
)
_REFUSED = ("plane", "heightmap", "polyline", "image", "cone")
_MODEL = "__model__"
_MOST_NAME = 1_000  # characters of a name with those of the models around it


class SdformatReader:
    """Reads folders of Gazebo models: each with a ``model.config``, or loose ``.sdf`` files."""

    def find(self, root: Boundary, options: ReaderOptions) -> Iterator[SourceRef | Notice]:
        """Lists the models; see :class:`stable_data.importers.source.Reader`."""
        ids, licences, models = AssetIds(), LicenceFiles(root), set[PurePosixPath]()
        paths = (PurePosixPath(path) for path in root.files((".config", ".sdf")))
        for folder, group in itertools.groupby(paths, lambda path: path.parent):
            files = [path.as_posix() for path in group]
            config = next((path for path in files if PurePosixPath(path).name.lower() == CONFIG), None)
            if not all(map(is_unicode, files)):
                name = asset_id_of(folder.name)
                message = f"{quote_value(files[0])}: the name is no UTF-8, expected letters; rename the folder or file"
                yield Notice(name, "find", "name_not_unicode", message)
            elif config is not None:
                models.add(folder)
                yield _found(root, config, ids, licences)
            elif models.isdisjoint((folder, *folder.parents)):
                for path in files:
                    if path.lower().endswith(".sdf"):
                        yield _found(root, path, ids, licences)

    def read(self, root: Boundary, ref: SourceRef, options: ReaderOptions) -> SourceAsset:
        """Reads a model; see :class:`stable_data.importers.source.Reader`."""
        config = _Config.read(root, ref.path) if PurePosixPath(ref.path).name.lower() == CONFIG else _Config(ref.path)
        model = read_model(root, config.model, ref.asset_id)
        asset = assemble(model, root, ref.asset_id, max_faces=options.max_faces)
        name = config.name or model.name or ref.entry["name"]
        stated = licence_of_text(config.description, CONFIG)
        beside = ref.entry.get("licence_file")
        licences = (*(() if stated is None else (stated,)), *(licences_of_file(root, beside) if beside else ()))
        renamed = renamed_notice(ref.asset_id, ref.entry["name"])
        return replace(
            asset,
            name=name,
            description=config.description,
            author=config.author,
            licences=licences,
            notices=(*(() if renamed is None else (renamed,)), *asset.notices),
        )


@dataclass(frozen=True, slots=True)
class _Config:
    """What a ``model.config`` says.

    Attributes:
        model: The SDFormat file, relative to the source folder.
        name: Of the model.
        author: Names of its authors.
        description: Free text.
    """

    model: str
    name: str = ""
    author: str = ""
    description: str = ""

    @classmethod
    def read(cls, root: Boundary, path: str) -> "_Config":
        """Reads the file; of several versions of the model the highest is taken.

        Raises:
            MeshError: ``model_unreadable`` or ``include_missing``.
        """
        element = parse_xml(root.read_bytes(path, "max_xml_bytes"), path)
        files = [(_version(sdf.get("version", "")), (sdf.text or "").strip()) for sdf in element.findall("sdf")]
        if not files:
            raise MeshError(f"{path}: names no SDFormat file, expected <sdf>model.sdf</sdf>; add it", "model_unreadable")
        _, name = max(files, key=lambda file: file[0])
        authors = [text for author in element.findall("author") if (text := text_of(author, "name"))]
        return cls(_included(root, name, path), text_of(element, "name"), ", ".join(authors), text_of(element, "description"))


def _found(root: Boundary, path: str, ids: AssetIds, licences: LicenceFiles) -> SourceRef:
    """A model as an item: its name, and the files beside it."""
    place = PurePosixPath(path)
    if place.name.lower() != CONFIG:
        return found_model(root, path, ids.of_path(place.stem, path), licences, read_model, place.stem)
    name = place.parent.name or root.root.name
    folder = Boundary(root.root / place.parent, root.limits)
    inside = itertools.islice(folder.files(_OF_A_MODEL), root.limits.max_files)
    listed = [(place.parent / file).as_posix() for file in inside if is_unicode(file)]

    def read(own: Boundary, config: str, asset_id: str) -> RigidModel:
        return read_model(own, _Config.read(own, config).model, asset_id)

    return found_model(root, path, ids.of_path(name, place.parent.as_posix()), licences, read, name, listed)


def read_model(root: Boundary, path: str, asset_id: str) -> RigidModel:
    """Reads the one model of an SDFormat file, with the models that it includes; no mesh is read.

    Args:
        root: The boundary of the asset.
        path: The file, relative to the folder.
        asset_id: The asset's name in messages.

    Raises:
        MeshError: ``model_unreadable``, ``composite``, ``cyclic_reference``, ``include_missing`` or ``path_outside``.
    """
    return _SdfFile(root, path, asset_id, ()).model()


@dataclass(slots=True)
class _SdfFile:
    """Reads one file; ``trail`` are the files that include it."""

    root: Boundary
    path: str
    asset_id: str
    trail: tuple[str, ...]
    notices: list[Notice] = field(default_factory=list)
    read: list[int] = field(default_factory=list)  # bytes of the files that were read for the whole model, one for each time
    configs: dict[str, str] = field(default_factory=dict)  # a model.config that was read -> the file that it names

    def fail(self, found: str, expected: str, code: str = "model_unreadable") -> MeshError:
        return MeshError(f"{self.path}: {found}, expected {expected}", code)

    def model(self) -> RigidModel:
        if self.path in self.trail:
            raise self.fail("includes itself", "models that do not include each other", "cyclic_reference")
        if len(self.trail) >= LIMITS.model.max_levels:
            most = at_most(LIMITS.model, "max_levels", "levels")
            raise self.fail("is included over more levels", f"{most}; write the models out", "cyclic_reference")
        content = self.root.read_bytes(self.path, "max_xml_bytes")
        self.read.append(len(content))
        if len(self.read) > LIMITS.model.max_links:
            found = "is one of the files that are included, each as often as it is named"
            raise self.fail(found, at_most(LIMITS.model, "max_links"), "mesh_too_large")
        if sum(self.read) > LIMITS.file.max_nested_bytes:
            found = f"is the last of {len(self.read)} files that are included"
            raise self.fail(found, f"{at_most(LIMITS.file, 'max_nested_bytes', 'bytes')} in all", "mesh_too_large")
        root = parse_xml(content, self.path)
        if root.tag != "sdf":
            raise self.fail(f"starts with <{root.tag[:40]}>", "<sdf>; is it another format?")
        check_parts(root, self.path)
        places = [root, *root.findall("world")]
        models = [(place, model) for place in places for model in place.findall("model")]
        included = [include for place in places for include in place.findall("include")]
        if len(models) + len(included) != 1:
            count = len(models) + len(included)
            raise self.fail(f"holds {count} models", "one thing; split the file", "composite" if count else "mesh_empty")
        model = self._included(included[0]) if included else _ModelElement(self, models[0][1]).model()
        return replace(model, notices=(*self.notices, *model.notices))

    def _included(self, include: ET.Element) -> RigidModel:
        """A model of another file, in its own frame."""
        uri = text_of(include, "uri")
        if not uri:
            raise self.fail("an <include> has no <uri>", "the model that it means; add it")
        if include.find("placement_frame") is not None:
            raise self.fail("an <include> has a <placement_frame>, which is not understood", "a <pose>; write the model out")
        if PurePosixPath(uri).suffix.lower() in (".sdf", ".urdf"):
            path = _included(self.root, uri, self.path)
        else:
            config = _included(self.root, f"{uri.rstrip('/')}/{CONFIG}", self.path)
            if config not in self.configs:
                self.configs[config] = _Config.read(self.root, config).model
            path = self.configs[config]
        if not path.lower().endswith(".sdf"):
            raise self.fail(f"includes {path}", "an .sdf file; other formats are not read here")
        trail = (*self.trail, self.path)
        model = _SdfFile(self.root, path, self.asset_id, trail, read=self.read, configs=self.configs).model()
        is_static = _is_true(text_of(include, "static")) or model.is_static
        return replace(model, name=text_of(include, "name") or model.name, is_static=is_static)


@dataclass(frozen=True, slots=True)
class _Frame:
    pose: FloatArray
    relative_to: str


class _ModelElement:
    """Reads a ``<model>``."""

    def __init__(self, file: _SdfFile, element: ET.Element) -> None:
        self.file = file
        self.element = element
        self.frames: dict[str, _Frame] = {}
        self.nested: list[tuple[str, RigidModel]] = []
        self.num_nested_links = self.num_nested_joints = 0
        self.attached = {frame.get("name", ""): frame.get("attached_to", "") for frame in element.findall("frame")}

    def model(self) -> RigidModel:
        for link in self.element.findall("link"):
            self._add_frame(link, _MODEL)
        for frame in self.element.findall("frame"):
            self._add_frame(frame, frame.get("attached_to") or _MODEL)
        for joint in self.element.findall("joint"):
            if joint.get("name") not in self.frames:  # before version 1.7 a joint could have the name of a link
                self._add_frame(joint, text_of(joint, "child"))
        for include in self.element.findall("include"):
            self._add_nested(self.file._included(include), include)
        for inner in self.element.findall("model"):
            self._add_nested(_ModelElement(self.file, inner).model(), inner)
        links = [self._link(link) for link in self.element.findall("link")]
        joints = [self._joint(joint) for joint in self.element.findall("joint")]
        self._check_links(len(links))
        notices: list[Notice] = []
        is_static = _is_true(text_of(self.element, "static"))
        for name, model in self.nested:
            matrix = self._in_model(name, ())
            links += [
                replace(k, name=self._inner_name(name, k.name), model_from_link=matrix @ k.model_from_link) for k in model.links
            ]
            joints += [
                replace(
                    j,
                    parent=j.parent if j.parent == WORLD else self._inner_name(name, j.parent),
                    child=self._inner_name(name, j.child),
                )
                for j in model.joints
            ]
            notices += model.notices
            is_static = is_static or model.is_static
        names = [link.name for link in links]
        if len(set(names)) < len(names):
            raise self.file.fail("has two links of one name", "unique names; rename one")
        return RigidModel(self.element.get("name", ""), tuple(links), tuple(joints), is_static, tuple(notices))

    def _add_nested(self, model: RigidModel, element: ET.Element) -> None:
        name = element.get("name") or model.name
        self.nested.append((name, model))
        self.num_nested_links += len(model.links)
        self.num_nested_joints += len(model.joints)
        self._check_links(0)  # before more of them are read
        self.frames[name] = self._frame_of(element, _MODEL)

    def _check_links(self, num_own: int) -> None:
        if max(num_own + self.num_nested_links, self.num_nested_joints) > LIMITS.model.max_links:
            raise self.file.fail(
                "has more links or joints with its parts", at_most(LIMITS.model, "max_links"), "mesh_too_large"
            )

    def _inner_name(self, model: str, name: str) -> str:
        """The name of a part of a nested model. A long one would be copied for every link and both ends of every joint."""
        if len(model) + len(name) > _MOST_NAME:
            found = f"has a part with a name of {len(model) + len(name)} characters in its model {quote_value(model)}"
            raise self.file.fail(found, f"at most {_MOST_NAME}; rename it")
        return f"{model}::{name}"

    def _add_frame(self, element: ET.Element, default: str) -> None:
        name = element.get("name", "")
        if not name or name in self.frames:
            raise self.file.fail(
                f"has a <{element.tag}> {'without a name' if not name else f'{name} twice'}", "unique names; rename"
            )
        self.frames[name] = self._frame_of(element, default)

    def _frame_of(self, element: ET.Element, default: str) -> _Frame:
        pose = element.find("pose")
        matrix = self._pose(pose)
        if pose is None:
            return _Frame(matrix, default)
        if pose.get("frame"):  # of versions before 1.7, where its meaning was never settled
            raise self.file.fail(
                "a <pose> has the attribute frame, which is not understood", "relative_to; convert it to SDFormat 1.7"
            )
        return _Frame(matrix, pose.get("relative_to") or default)

    def _pose(self, pose: ET.Element | None) -> FloatArray:
        if pose is None or not (pose.text or "").strip():
            return np.eye(4)
        path = self.file.path
        if pose.get("rotation_format", "euler_rpy") == "quat_xyzw":
            x, y, z, *quat = numbers(pose.text, 7, "a pose", path).tolist()
            if not math.fsum(q * q for q in quat) > 0:
                raise self.file.fail("a pose has a quaternion of length 0", "a rotation; correct it")
            return pose_matrix(np.array([x, y, z]), rotation_matrix(normalise_quat((quat[0], quat[1], quat[2], quat[3]))))
        values = numbers(pose.text, 6, "a pose", path)
        angles = np.radians(values[3:]) if _is_true(pose.get("degrees", "")) else values[3:]
        return pose_matrix(values[:3], rotation_of_rpy(*angles.tolist()))

    def _in_model(self, name: str, trail: tuple[str, ...]) -> FloatArray:
        """Pose of a frame in the frame of the model, (4, 4)."""
        if name == _MODEL:
            return np.eye(4)
        if name in trail or len(trail) > LIMITS.model.max_frames:
            found = f"frame {name} is relative to itself, or at the end of a long row"
            expected = f"{at_most(LIMITS.model, 'max_frames')} frames that end at the model"
            raise self.file.fail(found, expected, "cyclic_reference")
        if name not in self.frames:
            raise self.file.fail(
                f"a pose is relative to {name}, which is not in the model", "a link, joint or frame; correct the name"
            )
        frame = self.frames[name]
        return self._in_model(frame.relative_to, (*trail, name)) @ frame.pose

    def _of_link(self, element: ET.Element, link: str) -> FloatArray:
        """Pose of a part of a link in the frame of the link, (4, 4)."""
        frame = self._frame_of(element, link)
        if frame.relative_to == link:
            return frame.pose
        model_from_part = self._in_model(frame.relative_to, ()) @ frame.pose
        return np.asarray(np.linalg.inv(self._in_model(link, ())) @ model_from_part)

    def _link(self, element: ET.Element) -> Link:
        name = element.get("name", "")
        mass, link_from_inertial, inertia = None, None, None
        inertial = element.find("inertial")
        if inertial is not None and inertial.find("mass") is not None:
            mass = float(numbers(text_of(inertial, "mass"), 1, f"the mass of link {name}", self.file.path)[0])
            if inertial.find("pose") is not None:
                link_from_inertial = self._of_link(inertial, name)
            inertia = self._inertia(inertial.find("inertia"), name)
        visuals = [shape for visual in element.findall("visual") if (shape := self._shape(visual, name)) is not None]
        collisions = [shape for part in element.findall("collision") if (shape := self._shape(part, name)) is not None]
        return Link(name, self._in_model(name, ()), tuple(visuals), tuple(collisions), mass, link_from_inertial, inertia)

    def _inertia(self, element: ET.Element | None, link: str) -> FloatArray | None:
        """The tensor of a link; None if a moment is not stated. Products that are not stated are zero."""
        if element is None or any(element.find(name) is None for name in ("ixx", "iyy", "izz")):
            return None
        names = ("ixx", "ixy", "ixz", "iyy", "iyz", "izz")
        texts = {name: text_of(element, name) or "0" for name in names}
        return inertia_of({k: float(numbers(v, 1, f"{k} of link {link}", self.file.path)[0]) for k, v in texts.items()})

    def _shape(self, element: ET.Element, link: str) -> LinkShape | None:
        """A visual or collision; None if it is empty."""
        geometry = self._geometry(element.find("geometry"))
        if geometry is None:
            return None
        material = element.find("material")
        colour, image, opacity = None, "", 1.0
        if element.tag == "visual":
            opacity -= min(
                max(float(numbers(text_of(element, "transparency") or "0", 1, "a transparency", self.file.path)[0]), 0.0), 1.0
            )
            if material is not None:
                colour = linear_colour(text_of(material, "diffuse") or None)
                image = self._image(text_of(material, "pbr/metal/albedo_map") or text_of(material, "pbr/specular/albedo_map"))
        return LinkShape(self._of_link(element, link), geometry, colour, image, opacity, self._friction(element))

    def _image(self, reference: str) -> str:
        """File of a texture; empty if it is missing or refused, which is noted."""
        if not reference:
            return ""
        try:
            return self.file.root.resolve(reference, PurePosixPath(self.file.path).parent.as_posix())
        except MeshError as error:
            code = "texture_outside" if error.code == "path_outside" else "texture_missing"
            message = (
                f"asset {self.file.asset_id}: {self.file.path} refers to a texture: {error}; the surface is drawn without it"
            )
            self.file.notices.append(Notice(self.file.asset_id, "read", code, message))
            return ""

    def _friction(self, element: ET.Element) -> float | None:
        for place in (
            "surface/friction/ode/mu",
            "drake:proximity_properties/drake:mu_static",
            "drake:proximity_properties/drake:mu_dynamic",
        ):
            if text := text_of(element, place):
                value = float(numbers(text, 1, "a coefficient of friction", self.file.path)[0])
                return value if value >= 0 else None
        return None

    def _geometry(self, element: ET.Element | None) -> Geometry | None:
        """The form of a shape; None for ``<empty/>``."""
        kinds = [] if element is None else list(element)
        if len(kinds) != 1:
            raise self.file.fail(f"a <geometry> holds {len(kinds)} forms", "one; correct it")
        form, path = kinds[0], self.file.path

        def size(name: str, count: int = 1) -> list[float]:
            found: list[float] = numbers(text_of(form, name), count, f"the {name} of a {form.tag}", path).tolist()
            return found

        match form.tag.removeprefix("drake:"):
            case "empty":
                return None
            case "box":
                return Geometry("box", positive(size("size", 3), "box", path))
            case "sphere":
                return Geometry("sphere", positive(size("radius"), "sphere", path))
            case "ellipsoid":
                return Geometry("ellipsoid", positive(size("radii", 3), "ellipsoid", path))
            case "cylinder" | "capsule" as kind:
                return Geometry(kind, positive([*size("radius"), *size("length")], kind, path))
            case "mesh":
                return self._mesh(form)
        if form.tag in _REFUSED:
            raise self.file.fail(
                f"has a <{form.tag}>, which is no form of a thing that can be moved", "a mesh, box, cylinder or sphere"
            )
        raise self.file.fail(f"has a form <{form.tag[:40]}>, which is not understood", "a mesh, box, cylinder or sphere")

    def _mesh(self, form: ET.Element) -> Geometry:
        path = _included(self.file.root, text_of(form, "uri"), self.file.path)
        x, y, z = numbers(text_of(form, "scale") or "1 1 1", 3, "the scale of a mesh", self.file.path).tolist()
        if x * y * z == 0:
            raise self.file.fail("a mesh has a scale of 0", "factors other than 0; correct it")
        centred = _is_true(text_of(form, "submesh/center"))
        return Geometry("mesh", (), path, (x, y, z), text_of(form, "submesh/name"), centred)

    def _joint(self, element: ET.Element) -> Joint:
        name, kind = element.get("name", ""), element.get("type", "")
        parent, child = text_of(element, "parent"), text_of(element, "child")
        if kind in ("revolute", "prismatic"):  # files older than the fixed joint have one without a range
            limits = [text_of(element, f"axis/limit/{end}") for end in ("lower", "upper")]
            if all(limits):
                low, high = (float(numbers(limit, 1, "a limit", self.file.path)[0]) for limit in limits)
                kind = "fixed" if low == high else kind
        return Joint(name, kind, self._link_of(parent), self._link_of(child))

    def _link_of(self, name: str) -> str:
        """The link to which a frame belongs; a name of a link or of the world stays as it is."""
        seen = set[str]()
        while name in self.attached and name not in seen:
            seen.add(name)
            name = self.attached[name]
        return name


def _included(root: Boundary, reference: str, path: str) -> str:
    """The path of a file without which a model cannot be read.

    Raises:
        MeshError: ``include_missing`` or ``path_outside``.
    """
    try:
        return root.resolve(reference, PurePosixPath(path).parent.as_posix())
    except MeshError as error:
        code = "include_missing" if error.code == "file_missing" else error.code
        raise MeshError(f"{path}: {error}", code) from error


def _is_true(text: str) -> bool:
    return text.strip().lower() in ("1", "true")


def _version(text: str) -> tuple[int, ...]:
    return tuple(int(word) for word in text.split(".") if word.isdigit())


READER = SdformatReader()
