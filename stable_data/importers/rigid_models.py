"""Rigid models of links, shapes and joints, as SDFormat and URDF describe them, and how one becomes an asset."""

import math
import xml.etree.ElementTree as ET
from collections import Counter
from collections.abc import Callable, Collection, Iterator, Sequence
from dataclasses import dataclass, field, replace
from itertools import chain
from pathlib import PurePosixPath
from typing import Literal, TypeAlias

import numpy as np

from stable_data.errors import MeshError, Notice
from stable_data.geometry.mesh import Mesh, is_closed
from stable_data.geometry.primitive_shapes import box_triangles, capsule_triangles, cylinder_triangles, sphere_triangles
from stable_data.geometry.surface import Surface
from stable_data.importers.boundary import Boundary
from stable_data.importers.formats.mesh_file import MeshFile, check_face_count
from stable_data.importers.mesh_files import files_beside, joined_triangles, read_mesh_file, transformed, z_up
from stable_data.importers.source import GivenInertial, SourceAsset, SourceRef
from stable_data.importers.stated_licences import LicenceFiles
from stable_data.limits import LIMITS, at_most
from stable_data.scene import FloatArray, Vec3

WORLD = "world"
"""The frame to which a joint fixes a static model."""

ShapeKind: TypeAlias = Literal["mesh", "box", "cylinder", "sphere", "capsule", "ellipsoid"]

_AGREE = 1.1  # ratio of the boxes of what is seen and what collides
_PARTS = ("link", "joint", "frame", "model", "include")
_TORSIONAL, _ROLLING = 0.005, 0.0001  # m; MuJoCo's defaults: neither format states friction of these kinds in its units
_WELD = 1e-6  # corners nearer than this share of the largest extent are one vertex
_IS_MOVABLE_TO_NOTHING = ("floating", "free")
_STATED_IMAGE = b"\0the image that the model states"  # stands for it in a file that many shapes show with images of their own


@dataclass(frozen=True, slots=True)
class Geometry:
    """The form of a visual or collision shape, in its own frame.

    Attributes:
        kind: Which form.
        size: Metres: of a box its sides, of a cylinder or a capsule radius and length (a capsule's without its ends), of a sphere
            its radius, of an ellipsoid its radii.
        path: File of a mesh, relative to the source folder.
        scale: Factors of a mesh along its axes.
        submesh: Name of the only part of a mesh that counts; empty for all.
        is_centred: Whether that part is moved to the origin.
    """

    kind: ShapeKind
    size: tuple[float, ...] = ()
    path: str = ""
    scale: Vec3 = (1.0, 1.0, 1.0)
    submesh: str = ""
    is_centred: bool = False


@dataclass(frozen=True, slots=True, eq=False)
class LinkShape:
    """A visual or a collision of a link.

    Attributes:
        link_from_shape: (4, 4).
        geometry: Its form.
        colour: Linear colour; it counts where a mesh has none of its own.
        image: File of a texture, relative to the source folder; empty for none.
        opacity: From 0 (not seen) to 1.
        friction: Coefficient of sliding friction; None if not stated.
    """

    link_from_shape: FloatArray
    geometry: Geometry
    colour: tuple[float, float, float] | None = None
    image: str = ""
    opacity: float = 1.0
    friction: float | None = None


@dataclass(frozen=True, slots=True, eq=False)
class Link:
    """A rigid body of a model.

    Attributes:
        name: Unique in the model.
        model_from_link: (4, 4).
        visuals: What is seen.
        collisions: What collides.
        mass: Kilograms; None if not stated.
        link_from_inertial: Frame of the centre of mass, (4, 4); None if not stated.
        inertia: Tensor about the centre of mass along the axes of that frame (of the link without one), (3, 3), kg m²; None if not
            stated.
    """

    name: str
    model_from_link: FloatArray
    visuals: tuple[LinkShape, ...] = ()
    collisions: tuple[LinkShape, ...] = ()
    mass: float | None = None
    link_from_inertial: FloatArray | None = None
    inertia: FloatArray | None = None

    @property
    def is_empty(self) -> bool:
        """Whether it is a frame only."""
        return not self.visuals and not self.collisions and self.mass is None


@dataclass(frozen=True, slots=True)
class Joint:
    """A connection of two links; ``parent`` may be :data:`WORLD`."""

    name: str
    kind: str
    parent: str
    child: str


@dataclass(frozen=True, slots=True)
class RigidModel:
    """A model before its meshes are read.

    Attributes:
        name: As the file states it.
        links: Its bodies.
        joints: What connects them.
        is_static: Whether the file fixes it to the world.
        notices: Remarks on what was left out.
    """

    name: str
    links: tuple[Link, ...]
    joints: tuple[Joint, ...] = ()
    is_static: bool = False
    notices: tuple[Notice, ...] = ()


def check_parts(root: ET.Element, path: str) -> None:
    """Refuses a model with very many parts, before they are read: each is looked up among the others.

    Args:
        root: The outermost element of its file.
        path: The file, for the message.

    Raises:
        MeshError: ``mesh_too_large``.
    """
    count = Counter(element.tag for element in root.iter())
    shapes = {"visual": "max_shapes", "collision": "max_shapes"}
    for tag, limit in {**dict.fromkeys(_PARTS, "max_links"), **shapes}.items():
        if count[tag] > getattr(LIMITS.model, limit):
            most = at_most(LIMITS.model, limit)
            raise MeshError(f"{path}: has {count[tag]} elements {tag}, expected {most}; simplify it", "mesh_too_large")


def assemble(model: RigidModel, root: Boundary, asset_id: str, *, max_faces: int) -> SourceAsset:
    """Reads the meshes of a model and joins its links, at zero of all joints, to one asset.

    Units of COLLADA files apply. Their upward axis does not, because Gazebo does not know it and files state it wrongly; it does if
    what is seen then fits to what collides, and does not otherwise (``up_axis_ignored``). glTF is turned from y up, as its
    specification demands, under the same rule.

    Args:
        model: The model; its frame becomes that of the asset.
        root: The boundary of the asset.
        asset_id: Its name in messages.
        max_faces: Triangles beyond which it is refused.

    Returns:
        The asset in metres; texts and licences are not filled in.

    Raises:
        MeshError: ``composite``: bodies that nothing connects; ``mesh_empty``; or a code of
            :func:`stable_data.importers.mesh_files.read_mesh_file`.
    """
    num_joints, is_static = _connections(model, asset_id)
    reading = _Reading(root, asset_id, max_faces, list(model.notices))
    visuals = [(link, shape) for link in model.links for shape in link.visuals]
    collisions = [(link, shape) for link in model.links for shape in link.collisions]
    if len(visuals) + len(collisions) > LIMITS.model.max_shapes:
        found = f"asset {asset_id}: has {len(visuals) + len(collisions)} shapes"
        raise MeshError(f"{found}, expected {at_most(LIMITS.model, 'max_shapes')}; simplify it", "mesh_too_large")
    solid = reading.surfaces(collisions)
    surfaces = _seen(reading, visuals, solid)
    colliders, refused = _colliders(collisions, solid)
    if refused:
        reading.note("collider_refused", f"{refused} of {len(solid)} collision meshes are not closed; they are left out")
    frictions = [shape.friction for _, shape in collisions if shape.friction is not None]
    if len(set(frictions)) > 1:
        reading.note(
            "friction_differs", f"its shapes state friction from {min(frictions)} to {max(frictions)}; the least counts"
        )
    return SourceAsset(
        asset_id,
        model.name,
        surfaces,
        unit_m=1.0,
        is_upright=True,
        colliders=colliders,
        inertial=_inertial(model.links, reading),
        friction=(min(frictions), _TORSIONAL, _ROLLING) if frictions else None,
        num_joints=num_joints,
        is_static=model.is_static or is_static,
        notices=tuple(reading.notices),
    )


def _connections(model: RigidModel, asset_id: str) -> tuple[int, bool]:
    """Number of joints that can move, and whether one fixes the model to the world.

    Raises:
        MeshError: ``composite``, ``mesh_too_large``, or ``model_unreadable`` for a joint of a link that is not there.
    """
    if len(model.links) > LIMITS.model.max_links:
        most = at_most(LIMITS.model, "max_links")
        raise MeshError(f"asset {asset_id}: has {len(model.links)} links, expected {most}; simplify it", "mesh_too_large")
    group = {name: name for name in (WORLD, *(link.name for link in model.links))}

    def root_of(name: str) -> str:
        while group[name] != name:
            group[name] = group[group[name]]
            name = group[name]
        return name

    num_movable = 0
    for joint in model.joints:
        for end in (joint.parent, joint.child):
            if end not in group:
                message = f"asset {asset_id}: joint {joint.name} refers to link {end}, which does not exist; correct the name"
                raise MeshError(message, "model_unreadable")
        if joint.kind in _IS_MOVABLE_TO_NOTHING:
            continue
        num_movable += joint.kind != "fixed"
        group[root_of(joint.child)] = root_of(joint.parent)
    bodies = [link.name for link in model.links if not link.is_empty]
    parts = {root_of(name) for name in bodies}
    if len(parts) > 1:
        message = f"asset {asset_id}: has {len(parts)} bodies that no joint connects, expected one thing; split it or join them"
        raise MeshError(message, "composite")
    fixed = [joint for joint in model.joints if joint.kind == "fixed" and WORLD in (joint.parent, joint.child)]
    return num_movable, bool(fixed)


@dataclass(slots=True)
class _Reading:
    """Reads shapes: every mesh file once, and once more if the model states an image for it."""

    root: Boundary
    asset_id: str
    max_faces: int
    notices: list[Notice]
    files: dict[tuple[str, bool], MeshFile] = field(default_factory=dict)  # by path, and whether it shows _STATED_IMAGE
    images: dict[str, bytes | None] = field(default_factory=dict)
    divided: dict[tuple[str, bool], int] = field(default_factory=dict)  # triangles of files of which a shape shows a part

    def note(self, code: str, message: str) -> None:
        self.notices.append(Notice(self.asset_id, "read", code, f"asset {self.asset_id}: {message}"))

    def surfaces(self, shapes: Sequence[tuple[Link, LinkShape]], *, is_turned: bool = False) -> list[tuple[Surface, ...]]:
        """The triangles of all that is seen, or of all that collides: those of each shape in the frame of the model, metres.

        Args:
            shapes: What to read, each with its link.
            is_turned: Take the other reading of a mesh's upward axis.
        """
        made, num_faces = [], 0
        for link, shape in shapes:
            geometry, matrix = shape.geometry, link.model_from_link @ shape.link_from_shape
            found = self._mesh(shape, is_turned) if geometry.kind == "mesh" else (Surface(_primitive(geometry)),)
            num_faces += sum(len(surface.triangles) for surface in found)
            check_face_count(f"asset {self.asset_id}: its shapes", num_faces, self.max_faces)
            made.append(transformed(tuple(_with_look(surface, shape) for surface in found), matrix))
        return made

    def _mesh(self, shape: LinkShape, is_turned: bool) -> tuple[Surface, ...]:
        geometry = shape.geometry
        image = self._image(shape.image) if shape.image else None
        place = geometry.path, image is not None
        file = self._file(*place)
        turn = z_up(file.up) if is_turned != _is_gltf(geometry.path) else np.eye(4)
        scale = np.diag((*(factor * (file.unit_m or 1.0) for factor in geometry.scale), 1.0))
        surfaces = file.surfaces
        if geometry.submesh:
            self.divided[place] = sum(len(surface.triangles) for surface in surfaces)
            check_face_count(
                f"asset {self.asset_id}: meshes that are shown in part", sum(self.divided.values()), self.max_faces
            )
            surfaces = tuple(s for s, names in zip(surfaces, file.names, strict=False) if geometry.submesh in names)
            if not surfaces:
                message = f"{geometry.path}: has no part {geometry.submesh}, expected the submesh that the model names"
                raise MeshError(message, "include_missing")
        matrix = scale @ turn
        if geometry.is_centred:
            points = joined_triangles(surfaces).reshape(-1, 3)
            matrix = matrix.copy()
            matrix[:3, 3] = -(matrix[:3, :3] @ ((points.min(axis=0) + points.max(axis=0)) / 2))
        moved = transformed(surfaces, matrix)
        return tuple(replace(surface, image=image) if surface.image == _STATED_IMAGE else surface for surface in moved)

    def _file(self, path: str, has_stated_image: bool) -> MeshFile:
        key = path, has_stated_image
        if key not in self.files:
            shown = _STATED_IMAGE if has_stated_image else None
            file, notices = read_mesh_file(self.root, path, self.asset_id, max_faces=self.max_faces, image=shown)
            self.notices += notices
            self.files[key] = file
        return self.files[key]

    def _image(self, path: str) -> bytes | None:
        """The content of an image that the model states; None if it cannot be read, which is noted."""
        if path not in self.images:
            try:
                self.images[path] = self.root.read_bytes(path)
            except MeshError as error:
                self.note("texture_missing", f"texture {path}: {error}; the surface is drawn without it")
                self.images[path] = None
        return self.images[path]

    def other_axis(self, shapes: Sequence[tuple[Link, LinkShape]]) -> str:
        """The first file of shapes whose upward axis can be read in two ways; empty if there is none."""
        paths = [shape.geometry.path for _, shape in shapes if shape.geometry.kind == "mesh"]
        return next((path for (path, _), file in self.files.items() if path in paths and file.up in ("x", "y")), "")


def _seen(
    reading: _Reading, visuals: Sequence[tuple[Link, LinkShape]], solid: Sequence[tuple[Surface, ...]]
) -> tuple[Surface, ...]:
    """The surfaces of what is seen."""
    hard = tuple(surface for group in solid for surface in group)
    seen = tuple(chain.from_iterable(reading.surfaces(visuals)))
    if not seen and not hard:
        found = f"asset {reading.asset_id}: has no visual and no collision shape"
        raise MeshError(f"{found}, expected one; is it a frame, a light or a plugin?", "mesh_empty")
    if not seen:
        reading.note("visual_missing", "has no visual shape; its collision shapes are shown")
        return hard
    path = reading.other_axis(visuals)
    if path and hard and not _boxes_agree(seen, hard):
        turned = tuple(chain.from_iterable(reading.surfaces(visuals, is_turned=True)))
        if _boxes_agree(turned, hard):
            how = "is not turned to z up" if _is_gltf(path) else "is turned to z up"
            reading.note(
                "up_axis_ignored", f"{path} {how}, unlike other files of its format: so it fits to the collision shapes"
            )
            return turned
    return seen


def _is_gltf(path: str) -> bool:
    return PurePosixPath(path).suffix.lower() in (".glb", ".gltf")


def _boxes_agree(a: tuple[Surface, ...], b: tuple[Surface, ...]) -> bool:
    """Whether the boxes of surfaces have nearly the same sides."""
    sides = [np.ptp(joined_triangles(surfaces).reshape(-1, 3), axis=0) for surfaces in (a, b)]
    slack = 0.01 * max(sides[0].max(), sides[1].max())  # a sheet has no thickness to compare
    return bool(((sides[0] <= _AGREE * sides[1] + slack) & (sides[1] <= _AGREE * sides[0] + slack)).all())


def _with_look(surface: Surface, shape: LinkShape) -> Surface:
    """A surface with the look that the model states, where the mesh has none of its own."""
    has_own = surface.colour is not None or surface.corner_colours is not None or surface.image is not None
    colour = surface.colour if has_own else shape.colour
    return replace(surface, colour=colour, opacity=surface.opacity * shape.opacity)


def _colliders(
    collisions: Sequence[tuple[Link, LinkShape]], solid: Sequence[tuple[Surface, ...]]
) -> tuple[tuple[Mesh, ...], int]:
    """The closed ones of collision shapes, and the number of the others."""
    meshes = [welded(joined_triangles(surfaces)) for surfaces in solid]
    closed = tuple(mesh for mesh in meshes if len(mesh.faces) and is_closed(mesh))
    return closed, len(meshes) - len(closed)


def welded(triangles: FloatArray) -> Mesh:
    """Returns triangles (F, 3, 3) as a mesh whose corners at one place are one vertex; collapsed faces are dropped."""
    points = triangles.reshape(-1, 3)
    cell = _WELD * float(np.ptp(points, axis=0).max())
    grid = np.round((points - points.min(axis=0)) / cell).astype(np.int64)
    key = (grid[:, 0] << 42) | (grid[:, 1] << 21) | grid[:, 2]  # 21 bits hold 1 / _WELD cells
    _, first, index = np.unique(key, return_index=True, return_inverse=True)
    faces = index.reshape(-1, 3)
    a, b, c = faces.T
    return Mesh(points[first], faces[(a != b) & (b != c) & (c != a)])


def _inertial(links: Sequence[Link], reading: _Reading) -> GivenInertial | None:
    """Mass properties of all links together, in the frame of the model.

    A centre of mass or tensor that one link with mass does not state is not known for the whole either.
    """
    heavy = []
    for link in links:
        if link.mass is not None and (not math.isfinite(link.mass) or link.mass <= 0):
            reading.note(
                "mass_implausible", f"link {link.name} states a mass of {link.mass} kg, expected more than 0; it does not count"
            )
        elif link.mass is not None:
            heavy.append(link)
    if not heavy:
        return None
    mass = math.fsum(link.mass or 0.0 for link in heavy)
    frames = [
        link.model_from_link @ (np.eye(4) if link.link_from_inertial is None else link.link_from_inertial) for link in heavy
    ]
    is_placed = all(link.link_from_inertial is not None for link in heavy)
    if not is_placed and len(heavy) > 1:
        return GivenInertial(mass)
    places = np.array([frame[:3, 3] for frame in frames])
    center = np.array([link.mass for link in heavy]) @ places / mass
    tensors = [link.inertia for link in heavy if link.inertia is not None]
    inertia: FloatArray | None = None
    if len(tensors) == len(heavy):
        inertia = np.zeros((3, 3))
        for link, frame, place, tensor in zip(heavy, frames, places, tensors, strict=True):
            arm = place - center
            own = tensor if np.array_equal(frame[:3, :3], np.eye(3)) else frame[:3, :3] @ tensor @ frame[:3, :3].T
            inertia += own + (link.mass or 0.0) * (arm @ arm * np.eye(3) - np.outer(arm, arm))
    x, y, z = center.tolist()
    return GivenInertial(mass, (x, y, z) if is_placed else None, inertia)


def _primitive(geometry: Geometry) -> FloatArray:
    """Triangles (F, 3, 3) of a form about the origin, axis z."""
    size = geometry.size
    if geometry.kind == "box":
        return np.asarray(box_triangles() * np.array(size))
    if geometry.kind == "cylinder":
        return cylinder_triangles(size[0], size[1])
    if geometry.kind == "capsule":
        return capsule_triangles(size[0], size[1])
    return np.asarray(sphere_triangles() * np.array(size))


def found_model(
    root: Boundary,
    path: str,
    asset_id: str,
    licences: LicenceFiles,
    read: Callable[[Boundary, str, str], RigidModel],
    name: str = "",
    listed: Collection[str] = (),
) -> SourceRef:
    """Returns a model that was found as an item, with all its files that are known without a look at geometry.

    Args:
        root: The boundary of the source folder.
        path: Its main file, relative to the folder.
        asset_id: Its identifier.
        licences: The licence files of the folder.
        read: Reads a model, given a boundary, its main file and its identifier.
        name: Its name, if that is known; the entry ``name`` of the item.
        listed: Further files of it; what lies beside them is among them.
    """
    own, known, files = Boundary(root.root, root.limits), {"name": name} if name else {}, dict.fromkeys((path, *listed))
    if (licence := licences.nearest(path)) is not None:
        known["licence_file"] = licence
        files[licence] = None
    try:
        model = read(own, path, asset_id)
    except MeshError:  # it is read again, and then it is the failure of this asset
        return SourceRef(asset_id, path, tuple(files), known)
    beside = set(listed)
    for mesh in dict.fromkeys(_mesh_paths(model)):
        if mesh not in beside:
            files |= dict.fromkeys((mesh, *files_beside(own, mesh)))
    files |= dict.fromkeys(sorted(own.opened))
    return SourceRef(asset_id, path, tuple(files), known)


def _mesh_paths(model: RigidModel) -> Iterator[str]:
    """The mesh files and textures of a model."""
    for link in model.links:
        for shape in (*link.visuals, *link.collisions):
            yield from (path for path in (shape.geometry.path, shape.image) if path)
