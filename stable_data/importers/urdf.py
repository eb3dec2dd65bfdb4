"""Reads URDF files."""

import xml.etree.ElementTree as ET
from collections.abc import Iterator
from dataclasses import dataclass, field, replace
from pathlib import PurePosixPath

import numpy as np

from stable_data.errors import MeshError, Notice
from stable_data.importers.asset_ids import AssetIds
from stable_data.importers.boundary import Boundary, asset_id_of, renamed_notice
from stable_data.importers.formats.model_xml import (
    child_of,
    inertia_of,
    linear_colour,
    numbers,
    pose_matrix,
    positive,
    rotation_of_rpy,
)
from stable_data.importers.formats.xml_text import parse_xml
from stable_data.importers.rigid_models import (
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
from stable_data.importers.stated_licences import LicenceFiles, licences_of_file
from stable_data.json_text import is_unicode, quote_value
from stable_data.scene import FloatArray

_XACRO = "it must be expanded first, which runs code of the file: xacro FILE.xacro > FILE.urdf"


class UrdfReader:
    """Reads every ``.urdf`` file of a folder as an asset."""

    def find(self, root: Boundary, options: ReaderOptions) -> Iterator[SourceRef | Notice]:
        """Lists the files; see :class:`stable_data.importers.source.Reader`."""
        ids, licences = AssetIds(), LicenceFiles(root)
        for path in root.files((".urdf", ".xacro")):
            name = PurePosixPath(path).stem
            if not is_unicode(path):
                message = f"{quote_value(path)}: the name is no UTF-8, expected letters; rename the file"
                yield Notice(asset_id_of(name), "find", "name_not_unicode", message)
            elif path.lower().endswith(".xacro"):
                yield Notice(
                    asset_id_of(name), "find", "model_unreadable", f"{path}: is a xacro macro, expected a URDF; {_XACRO}"
                )
            else:
                yield found_model(root, path, ids.of_path(name, path), licences, read_model)

    def read(self, root: Boundary, ref: SourceRef, options: ReaderOptions) -> SourceAsset:
        """Reads a file; see :class:`stable_data.importers.source.Reader`."""
        model = read_model(root, ref.path, ref.asset_id)
        asset = assemble(model, root, ref.asset_id, max_faces=options.max_faces)
        stem, beside = PurePosixPath(ref.path).stem, ref.entry.get("licence_file")
        renamed = renamed_notice(ref.asset_id, stem)
        return replace(
            asset,
            name=stem,
            licences=licences_of_file(root, beside) if beside else (),
            notices=(*(() if renamed is None else (renamed,)), *asset.notices),
        )


def read_model(root: Boundary, path: str, asset_id: str) -> RigidModel:
    """Reads a URDF; no mesh is read.

    Args:
        root: The boundary of the asset.
        path: The file, relative to the folder.
        asset_id: The asset's name in messages.

    Returns:
        The model with all joints at zero; its frame is that of the root link.

    Raises:
        MeshError: ``model_unreadable``, ``cyclic_reference``, ``include_missing`` or ``path_outside``.
    """
    return _UrdfFile(root, path, asset_id).model()


@dataclass(slots=True)
class _UrdfFile:
    root: Boundary
    path: str
    asset_id: str
    notices: list[Notice] = field(default_factory=list)
    materials: dict[str, ET.Element] = field(default_factory=dict)
    friction: dict[str, float] = field(default_factory=dict)
    colours: dict[ET.Element, tuple[tuple[float, float, float] | None, float]] = field(default_factory=dict)  # of materials

    def fail(self, found: str, expected: str, code: str = "model_unreadable") -> MeshError:
        return MeshError(f"{self.path}: {found}, expected {expected}", code)

    def model(self) -> RigidModel:
        robot = parse_xml(self.root.read_bytes(self.path, "max_xml_bytes"), self.path)
        if any(element.tag.startswith("xacro:") for element in robot.iter()):
            raise self.fail("holds xacro macros", f"a URDF; {_XACRO}")
        if robot.tag != "robot":
            raise self.fail(f"starts with <{robot.tag[:40]}>", "<robot>; is it another format?")
        check_parts(robot, self.path)
        self.materials = {m.get("name", ""): m for m in robot.iter("material") if len(m)}
        self.friction = self._gazebo_friction(robot)
        elements = {link.get("name", ""): link for link in robot.findall("link")}
        if len(elements) < len(robot.findall("link")) or "" in elements:
            raise self.fail("has two links of one name or one without", "unique names; rename one")
        joints = [(self._joint(joint), self._origin(joint)) for joint in robot.findall("joint")]
        parents: dict[str, tuple[str, FloatArray]] = {}
        for joint, origin in joints:
            if joint.child in parents:
                raise self.fail(f"link {joint.child} has two parents", "a tree of links; correct it")
            parents[joint.child] = (joint.parent, origin)
        links = [self._link(name, element, self._placed(name, parents)) for name, element in elements.items()]
        return RigidModel(robot.get("name", ""), tuple(links), tuple(joint for joint, _ in joints), False, tuple(self.notices))

    def _placed(self, name: str, parents: dict[str, tuple[str, FloatArray]]) -> FloatArray:
        """Pose of a link in the frame of the root link, (4, 4)."""
        matrix, seen = np.eye(4), {name}
        while name in parents:
            name, origin = parents[name]
            if name in seen:
                raise self.fail(f"link {name} is its own parent", "a tree of links; correct it", "cyclic_reference")
            seen.add(name)
            matrix = origin @ matrix
        return matrix

    def _joint(self, element: ET.Element) -> Joint:
        parent, child = element.find("parent"), element.find("child")
        if parent is None or child is None:
            raise self.fail(f"joint {element.get('name', '')} lacks its parent or child", "both; add them")
        return Joint(element.get("name", ""), element.get("type", ""), parent.get("link", ""), child.get("link", ""))

    def _origin(self, element: ET.Element) -> FloatArray:
        origin = element.find("origin")
        if origin is None:
            return np.eye(4)
        xyz = numbers(origin.get("xyz") or "0 0 0", 3, "the xyz of an origin", self.path)
        rpy = numbers(origin.get("rpy") or "0 0 0", 3, "the rpy of an origin", self.path)
        return pose_matrix(xyz, rotation_of_rpy(*rpy.tolist()))

    def _link(self, name: str, element: ET.Element, matrix: FloatArray) -> Link:
        mass, link_from_inertial, inertia = None, None, None
        inertial = element.find("inertial")
        if inertial is not None and (stated := inertial.find("mass")) is not None:
            mass = float(numbers(stated.get("value"), 1, f"the mass of link {name}", self.path)[0])
            if inertial.find("origin") is not None:
                link_from_inertial = self._origin(inertial)
            inertia = self._inertia(inertial.find("inertia"), name)
        friction = self._value(element.find("contact/lateral_friction"), "value")
        friction = self.friction.get(name) if friction is None else friction
        visuals = [self._shape(visual, None) for visual in element.findall("visual")]
        collisions = [self._shape(collision, friction) for collision in element.findall("collision")]
        return Link(name, matrix, tuple(visuals), tuple(collisions), mass, link_from_inertial, inertia)

    def _inertia(self, element: ET.Element | None, link: str) -> FloatArray | None:
        """The tensor of a link as it stands in the file; None if a moment is not stated."""
        if element is None or any(element.get(name) is None for name in ("ixx", "iyy", "izz")):
            return None
        names = ("ixx", "ixy", "ixz", "iyy", "iyz", "izz")
        return inertia_of({n: float(numbers(element.get(n) or "0", 1, f"{n} of link {link}", self.path)[0]) for n in names})

    def _value(self, element: ET.Element | None, name: str) -> float | None:
        """A number from 0 in an attribute; None if it is not there."""
        if element is None or element.get(name) is None:
            return None
        value = float(numbers(element.get(name), 1, f"{name} of {element.tag}", self.path)[0])
        return value if value >= 0 else None

    def _gazebo_friction(self, robot: ET.Element) -> dict[str, float]:
        """Friction of links in the elements that Gazebo reads."""
        found: dict[str, float] = {}
        for extension in robot.findall("gazebo"):
            mu, link = extension.find("mu1"), extension.get("reference", "")
            if mu is not None and link:
                found[link] = float(numbers(mu.get("value") or mu.text, 1, "mu1", self.path)[0])
        return {link: value for link, value in found.items() if value >= 0}

    def _shape(self, element: ET.Element, friction: float | None) -> LinkShape:
        own = [
            self._value(child_of(element, f"drake:proximity_properties/drake:{n}"), "value")
            for n in ("mu_static", "mu_dynamic")
        ]
        stated = next((value for value in own if value is not None), friction)
        colour, image, opacity = self._look(element.find("material"))
        return LinkShape(self._origin(element), self._geometry(element.find("geometry")), colour, image, opacity, stated)

    def _look(self, material: ET.Element | None) -> tuple[tuple[float, float, float] | None, str, float]:
        """Colour, texture and opacity of a material; one without content is defined elsewhere in the file."""
        if material is None:
            return None, "", 1.0
        material = material if len(material) else self.materials.get(material.get("name", ""), material)
        if material not in self.colours:  # many visuals may name one whose text is very long
            self.colours[material] = self._colour(material.find("color"))
        texture, (colour, opacity) = material.find("texture"), self.colours[material]
        return colour, self._image("" if texture is None else texture.get("filename", "")), opacity

    def _colour(self, element: ET.Element | None) -> tuple[tuple[float, float, float] | None, float]:
        """Linear colour and opacity that a material states."""
        text = "" if element is None else element.get("rgba", "")
        words = text.split()
        opacity = 1.0
        if len(words) == 4:
            opacity = min(max(float(numbers(words[3], 1, "the opacity of a colour", self.path)[0]), 0.0), 1.0)
        return linear_colour(text), opacity

    def _image(self, reference: str) -> str:
        """File of a texture; empty if it is missing or refused, which is noted."""
        if not reference:
            return ""
        try:
            return self.root.resolve(reference, PurePosixPath(self.path).parent.as_posix())
        except MeshError as error:
            code = "texture_outside" if error.code == "path_outside" else "texture_missing"
            message = f"asset {self.asset_id}: {self.path} refers to a texture: {error}; the surface is drawn without it"
            self.notices.append(Notice(self.asset_id, "read", code, message))
            return ""

    def _geometry(self, element: ET.Element | None) -> Geometry:
        forms = [] if element is None else list(element)
        if len(forms) != 1:
            raise self.fail(f"a <geometry> holds {len(forms)} forms", "one; correct it")
        form, path = forms[0], self.path

        def size(name: str, count: int = 1) -> list[float]:
            found: list[float] = numbers(form.get(name), count, f"the {name} of a {form.tag}", path).tolist()
            return found

        match form.tag.removeprefix("drake:"):
            case "box":
                return Geometry("box", positive(size("size", 3), "box", path))
            case "sphere":
                return Geometry("sphere", positive(size("radius"), "sphere", path))
            case "ellipsoid":
                return Geometry("ellipsoid", positive([*size("a"), *size("b"), *size("c")], "ellipsoid", path))
            case "cylinder" | "capsule" as kind:
                return Geometry(kind, positive([*size("radius"), *size("length")], kind, path))
            case "mesh":
                return self._mesh(form)
            case "plane":
                raise self.fail("has a plane, which is no form of a thing that can be moved", "a mesh, box, cylinder or sphere")
        raise self.fail(f"has a form <{form.tag[:40]}>, which is not understood", "a mesh, box, cylinder or sphere")

    def _mesh(self, form: ET.Element) -> Geometry:
        try:
            path = self.root.resolve(form.get("filename", ""), PurePosixPath(self.path).parent.as_posix())
        except MeshError as error:
            code = "include_missing" if error.code == "file_missing" else error.code
            raise MeshError(f"{self.path}: {error}", code) from error
        words = (form.get("scale") or "1").split()
        x, y, z = numbers(" ".join(words * 3 if len(words) == 1 else words), 3, "the scale of a mesh", self.path).tolist()
        if x * y * z == 0:
            raise self.fail("a mesh has a scale of 0", "factors other than 0; correct it")
        return Geometry("mesh", (), path, (x, y, z))


READER = UrdfReader()
