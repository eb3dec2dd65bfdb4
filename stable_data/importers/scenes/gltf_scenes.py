"""Reads glTF scenes: nodes that are free bodies by their names or extensions are objects, all other meshes are the surroundings.

A free body is its node with all nodes below it, but for those that are free bodies themselves. Its shape are the colliders that it
states, else its meshes. Poses are those of the nodes; what an animation moves counts as fixed.
"""

import hashlib
import posixpath
from collections import Counter
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from functools import partial
from typing import Any
from urllib.parse import unquote

import numpy as np
from scipy.spatial.transform import Rotation

from stable_data.errors import MeshError, Notice, SceneError
from stable_data.geometry.gltf_reader import PlacedNode, load_meshes, placed_nodes
from stable_data.geometry.mass_properties import usable_inertia
from stable_data.geometry.mesh import Mesh, join_meshes
from stable_data.importers.boundary import Boundary
from stable_data.importers.formats.gltf import codes_of_files, gltf_document, pack_gltf
from stable_data.importers.formats.mesh_file import parsing
from stable_data.importers.scenes import convex_solids, gltf_nodes
from stable_data.importers.scenes.gltf_nodes import PHYSICS
from stable_data.importers.scenes.mesh_solids import fixed_parts, solid_parts
from stable_data.importers.scenes.scene_file import BodyPose, Ground, SceneBody, SceneFile, check_shapes
from stable_data.json_text import number, numbers
from stable_data.limits import LIMITS, at_most
from stable_data.rotations import quat_of, rotation_matrix
from stable_data.scene import FloatArray, QuatXyzw, Vec3

Z_UP = np.array([[1.0, 0.0, 0.0], [0.0, 0.0, -1.0], [0.0, 1.0, 0.0]])
"""The rotation from the axes of a glTF file, y up, to z up, (3, 3)."""

_FARTHEST = 1e7  # metres
_MOST_MESHES = 16  # nodes with a mesh of an object that are cut one by one; more are cut as one
_MOST_FIXED = 4000  # convex parts of the surroundings; what follows is a hull
_MOST_CUT = 300  # different meshes of the surroundings that are cut; likewise
_NEAR = 0.5  # metres beside and above a free body within which the shape of the surroundings counts
_LEVEL = np.cos(np.radians(0.1))  # least vertical component of the normal of a level plane


@dataclass(frozen=True, slots=True, eq=False)
class GltfScene:
    """A glTF scene that was read.

    Attributes:
        file: What it holds; metres, z up. Bodies have the names of their nodes.
        paths: All its files, relative to the source folder.
        content: The file itself.
        document: Its JSON.
        nodes: The nodes of its default scene, each after the node above it.
        free_nodes: Name of each free body -> the number of its node.
    """

    file: SceneFile
    paths: tuple[str, ...]
    content: bytes
    document: dict[str, Any]
    nodes: tuple[PlacedNode, ...]
    free_nodes: Mapping[str, int]


def read_gltf_scene(boundary: Boundary, path: str) -> GltfScene:
    """Reads a glTF scene, ``.gltf`` or ``.glb``.

    Args:
        boundary: The source folder.
        path: The file, relative to it.

    Raises:
        MeshError: The file cannot be read (``model_unreadable``), a file that it names is missing (``file_missing``), lies outside
            of the folder or on a network (``path_outside``), it is too large (``file_too_large``, ``mesh_too_large``), compressed
            (``glb_unsupported``), or its nodes are no tree (``cyclic_reference``, ``glb_invalid``).
        SceneError: No node is a free body with a shape (``no_free_body``), or transforms are not finite or far out (``not_finite``).
    """
    content = boundary.read_bytes(path)
    beside = _FilesBeside(boundary, path)
    if not gltf_nodes.has_free_body(gltf_document(content, path, LIMITS.gltf_scene)):
        raise _no_free_body(path)
    document, packed = pack_gltf(content, path, beside, limits=LIMITS.gltf_scene, files=boundary.limits)
    notices = list(beside.notices)
    with parsing(path, "glTF 2.0"), codes_of_files():
        nodes = placed_nodes(document, path, limits=LIMITS.gltf_scene)
        reader = _SceneReader(path, document, packed, nodes, notices)
        bodies, grounds = reader.read()
    if not any(body.is_free for body in bodies):
        raise _no_free_body(path)
    digest = hashlib.sha256()
    for name, part in sorted({**beside.contents, path: content}.items()):
        digest.update(name.encode() + b"\0" + hashlib.sha256(part).digest())
    file = SceneFile(path, digest.hexdigest(), "initial", tuple(bodies), tuple(grounds), tuple(notices))
    free_nodes = {reader.names[index]: index for index in sorted(reader.free)}
    free_nodes = {body.name: free_nodes[body.name] for body in bodies if body.is_free}
    return GltfScene(file, tuple(sorted({path, *beside.paths})), content, document, nodes, free_nodes)


def _no_free_body(path: str) -> SceneError:
    expected = f"nodes with names that end in -rigid, with {PHYSICS}, or of an export of this library"
    return SceneError(f"{path}: has no free body with a shape, expected {expected}; is it a single asset?", "no_free_body")


class _FilesBeside:
    """The buffers of a glTF file, and the places of its images, which are not read; see ``formats.mesh_file.Companions``."""

    def __init__(self, boundary: Boundary, path: str) -> None:
        self._boundary, self._path = boundary, path
        self.contents: dict[str, bytes] = {}
        self.paths: set[str] = set()
        self.notices: list[Notice] = []

    def part(self, reference: str) -> bytes:
        """The content of a buffer."""
        name = self._place(reference)
        if name not in self.contents:
            self.contents[name] = self._boundary.read_bytes(name)
        return self.contents[name]

    def image(self, reference: str) -> bytes | None:
        """None, because no picture is made; the image is a file of the scene."""
        try:
            self._place(reference)
        except MeshError as error:
            if error.code != "file_missing":
                raise
            self.notices.append(Notice(self._path, "read", error.code, str(error)))
        return None

    def material_library(self, reference: str) -> bytes | None:
        """None: glTF has no such files."""
        return None

    def note_lost_look(self, reason: str) -> None:
        """Does nothing: no look is read."""

    def _place(self, reference: str) -> str:
        base = posixpath.dirname(self._path)
        try:
            found = self._boundary.resolve(reference, base)
        except MeshError as error:
            raise MeshError(f"{self._path}: {error}", error.code) from error
        spelled = {
            posixpath.normpath(posixpath.join(base, r.replace("\\", "/"))) for r in (reference.strip(), unquote(reference))
        }
        if found not in spelled:  # a copy of the scene would lack it
            found = f"{reference!r:.200} is {found} by another spelling or a link"
            raise MeshError(f"{self._path}: {found}, expected its own path", "file_missing")
        self.paths.add(found)
        return found


@dataclass(frozen=True, slots=True, eq=False)
class _Shape:
    """A part of a body's shape, before it is divided into convex parts.

    Attributes:
        node: Where it is.
        mesh: Its triangles, in its own frame.
        key: What it is, for the cache; equal ones have equal triangles.
        is_hull: Whether its convex hull counts.
    """

    node: PlacedNode
    mesh: Mesh
    key: object
    is_hull: bool


@dataclass(frozen=True, slots=True, eq=False)
class _Surroundings:
    """What matters to the parts of a body that does not move.

    Attributes:
        down: The unit vector, (3,), that points down in its frame.
        centers: The centres of the free bodies, (N, 3), in its frame.
    """

    down: FloatArray
    centers: FloatArray


@dataclass(slots=True, eq=False)
class _SceneReader:
    """Reads the bodies of a glTF scene."""

    path: str
    document: dict[str, Any]
    packed: bytes
    nodes: tuple[PlacedNode, ...]
    notices: list[Notice]
    names: dict[int, str] = field(default_factory=dict)
    free: set[int] = field(default_factory=set)
    owners: dict[int, int | None] = field(default_factory=dict)
    meshes: Mapping[int, Mesh] = field(default_factory=dict)
    cache: dict[object, list[Mesh]] = field(default_factory=dict)
    num_cut: int = 0
    coarse: list[str] = field(default_factory=list)
    num_below: int = 0
    solids: dict[int, Mesh | None] = field(default_factory=dict)
    num_faces: int = 0
    bent: dict[int, bool] = field(default_factory=dict)

    def read(self) -> tuple[list[SceneBody], list[Ground]]:
        if not all((np.abs(node.world_from_node) < _FARTHEST).all() for node in self.nodes):
            found = f"has nodes whose transforms are not finite, or beyond {_FARTHEST:g} m"
            raise SceneError(f"{self.path}: {found}, expected usual numbers; export it again", "not_finite")
        self._name_nodes()
        left_out = self._left_out()
        kept = [node for node in self.nodes if node.index not in left_out]
        self.free = {node.index for node in kept if gltf_nodes.is_free(self._entry(node))}
        if len(self.free) > LIMITS.scene_file.max_free_bodies:
            most = at_most(LIMITS.scene_file, "max_free_bodies")
            raise SceneError(f"{self.path}: has {len(self.free)} free bodies, expected {most}; divide it", "file_too_large")
        self.free -= self._held(kept)
        for node in kept:
            above = None if node.parent is None else self.owners.get(node.parent)
            self.owners[node.index] = node.index if node.index in self.free else above
        grounds = dict(self._grounds(kept))
        shapes = self._shapes(kept, grounds)
        bodies = [self._free_body(node, shapes.get(node.index, [])) for node in kept if node.index in self.free]
        free = [body for body in bodies if body is not None]
        corners = [_box_of(np.concatenate([body.placed(part) for part in body.parts])) for body in free]
        boxes = np.array(corners, np.float64).reshape(-1, 2, 3)
        num_parts = 0
        for index, own in shapes.items():
            if index not in self.free:
                is_exact = num_parts < _MOST_FIXED
                body = self._fixed_body(own[0].node, own, boxes, is_exact=is_exact)
                if body is not None:
                    num_parts += len(body.parts)
                    free.append(body)
        if self.coarse:
            found = f"{self.coarse[0]} and all after it ({len(self.coarse)} shapes)"
            self._note("shape_coarse", f"{found} are beyond the number that is followed closely; their hulls count")
        return free, list(grounds.values())

    def _entry(self, node: PlacedNode) -> dict[str, Any]:
        entry: dict[str, Any] = self.document["nodes"][node.index]
        return entry

    def _note(self, code: str, message: str, step: str = "read") -> None:
        self.notices.append(Notice(self.path, step, code, f"{self.path}: {message}"))

    def _name_nodes(self) -> None:
        """Gives each node a name of its own: its name in the file, with its number if that is not unique."""
        given = [name if isinstance(name := self._entry(node).get("name"), str) else "" for node in self.nodes]
        counts = Counter(given)
        for node, name in zip(self.nodes, given, strict=True):
            own = name if name and counts[name] == 1 else f"{name}#{node.index}"
            while own != name and own in counts:
                own += "#"
            self.names[node.index] = own

    def _left_out(self) -> set[int]:
        from stable_data.simulation.room import RESTRICTED_ZONE

        is_own = (self.document.get("asset") or {}).get("generator") == "stable-data"
        found: set[int] = set()
        for node in self.nodes:
            entry = self._entry(node)
            is_mark = is_own and entry.get("name") == RESTRICTED_ZONE  # it is seen on the table and no solid
            if node.parent in found or is_mark or gltf_nodes.is_left_out(entry):
                found.add(node.index)
        return found

    def _held(self, kept: Sequence[PlacedNode]) -> set[int]:
        """Free bodies that count as fixed, because an animation moves them or a joint holds them, and those around them."""
        above = {node.index: node.parent for node in self.nodes}
        is_free = self.free.__contains__

        def lineage(index: int | None) -> Iterator[int]:
            while index is not None:
                yield index
                index = above[index]

        animated = gltf_nodes.animated_nodes(self.document)
        held = {index: "moved by an animation" for index in self.free if animated.intersection(lineage(index))}
        for node in kept:
            joint = gltf_nodes.physics_of(self._entry(node)).get("joint")
            if isinstance(joint, dict):
                for end in (node.index, joint.get("connectedNode")):
                    body = next(filter(is_free, lineage(end)), None) if end in above else None
                    if body is not None:
                        held.setdefault(body, "held by a joint")
        for index in list(held):
            for other in filter(is_free, lineage(index)):
                held.setdefault(other, f"around {self.names[index]}, which is fixed")
        for index in sorted(held):
            self._note("body_held", f"{self.names[index]} is {held[index]}; it counts as fixed", "find")
        return set(held)

    def _shapes(self, kept: Sequence[PlacedNode], grounds: Collection[int]) -> dict[int, list[_Shape]]:
        """The shapes of each body, in file order: by the number of a free body's node, or of the fixed node itself."""
        shown, trees = dict[int, int](), dict[int, list[tuple[int, FloatArray]]]()
        for node in kept:
            if self._is_collider(node):
                trees[node.index] = list(self._collider_meshes(node))
            if not gltf_nodes.is_named_collider(self._entry(node)) and (mesh := self._shown_mesh(node)) is not None:
                shown[node.index] = mesh
        wanted = [*shown.values(), *(mesh for tree in trees.values() for mesh, _ in tree)]
        self.meshes, notices = load_meshes(self.packed, self.path, wanted, limits=LIMITS.gltf_scene)
        self.notices += [Notice(self.path, "read", n.code, n.message.removeprefix("asset ")) for n in notices]
        self.num_faces = sum(len(self.meshes[mesh].faces) for mesh in wanted if mesh in self.meshes)
        above = {node.index: node.parent for node in kept}
        made = {
            node.index: self._collider(node, trees[node.index])
            for node in kept
            if node.index in trees and node.index not in grounds
        }
        stated: set[int] = set()  # bodies, and fixed nodes, whose colliders alone count
        for node_index, collider in [*made.items(), *((ground, None) for ground in grounds)]:
            if collider is None and node_index not in grounds:
                continue
            owner = self.owners[node_index]
            index: int | None = node_index if owner is None else owner
            while index is not None and index not in stated:
                stated.add(index)
                index = above[index] if owner is None else None
        found: dict[int, list[_Shape]] = {}
        for node in kept:
            owner = self.owners[node.index]
            body = node.index if owner is None else owner
            shape = made.get(node.index)
            if body not in stated and shown.get(node.index) in self.meshes:
                shape = _Shape(node, self.meshes[shown[node.index]], shown[node.index], is_hull=False)
            if shape is not None:
                found.setdefault(body, []).append(shape)
        return found

    def _is_collider(self, node: PlacedNode) -> bool:
        entry = self._entry(node)
        return gltf_nodes.collider_of(entry) is not None or gltf_nodes.is_named_collider(entry)

    def _shown_mesh(self, node: PlacedNode) -> int | None:
        """The mesh that a node shows at its place; what is bent by a skeleton or shown many times is not read."""
        entry = self._entry(node)
        if node.mesh is None:
            return None
        extensions = entry.get("extensions") or {}
        for key, what in (("skin", "bent by a skeleton"), ("EXT_mesh_gpu_instancing", "a mesh of many instances")):
            if key in entry or key in extensions:
                self._note("shape_unknown", f"{self.names[node.index]} is {what}, which is not read; it is no obstacle")
                return None
        if node.mesh not in self.bent:  # many nodes may show one mesh of many primitives
            primitives = self.document["meshes"][node.mesh]["primitives"]
            self.bent[node.mesh] = any("targets" in primitive for primitive in primitives)
        if self.bent[node.mesh]:
            self._note("morph_ignored", f"{self.names[node.index]} has morph targets; its plain shape counts")
        return node.mesh

    def _collider_meshes(self, node: PlacedNode) -> Iterator[tuple[int, FloatArray]]:
        """The meshes of a collider, each with its transform in the frame of the node, (4, 4)."""
        geometry = gltf_nodes.collider_of(self._entry(node))
        if geometry is None:
            yield self.document["nodes"][node.index]["mesh"], np.eye(4)
        elif "node" in geometry:
            alone = {**self.document, "scene": 0, "scenes": [{"nodes": [geometry["node"]]}]}
            below = placed_nodes(alone, self.path, limits=LIMITS.gltf_scene)
            self.num_below += len(below)
            if self.num_below > LIMITS.gltf_scene.max_nodes:  # many colliders may name one node with all below it
                most = at_most(LIMITS.gltf_scene, "max_nodes")
                message = f"{self.path}: its colliders name {self.num_below} nodes, expected {most}; simplify it"
                raise MeshError(message, "file_too_large")
            _refuse_endless(below[0].parent_from_node)
            own = np.linalg.pinv(below[0].parent_from_node)
            yield from ((n.mesh, own @ n.world_from_node) for n in below if n.mesh is not None)
        elif "mesh" in geometry:  # an earlier draft of the extension
            yield geometry["mesh"], np.eye(4)

    def _collider(self, node: PlacedNode, tree: Sequence[tuple[int, FloatArray]]) -> _Shape | None:
        """The shape of a collider; None if it is none that is read."""
        entry = self._entry(node)
        geometry = gltf_nodes.collider_of(entry)
        parts = [
            Mesh(_moved(place, self.meshes[mesh].vertices), self.meshes[mesh].faces)
            for mesh, place in tree
            if mesh in self.meshes
        ]
        if parts:
            key = tuple((mesh, place.tobytes()) for mesh, place in tree)
            is_hull = gltf_nodes.is_named_hull(entry) if geometry is None else geometry.get("convexHull") is True
            return _Shape(node, join_meshes(parts), key, is_hull)
        if geometry is not None and "shape" in geometry:
            stated = gltf_nodes.implicit_shape(self.document, geometry["shape"], self.path)
            if geometry["shape"] not in self.solids:
                self.solids[geometry["shape"]] = _implicit_solid(stated)
            if (solid := self.solids[geometry["shape"]]) is not None:
                self.num_faces += len(solid.faces)
                check_shapes(self.path, faces=self.num_faces)
                return _Shape(node, solid, ("shape", geometry["shape"]), is_hull=stated.get("type") != "plane")
        self._note(
            "shape_unknown", f"the collider of {self.names[node.index]} is of a kind that is not read; it is no obstacle"
        )
        return None

    def _grounds(self, kept: Sequence[PlacedNode]) -> Iterator[tuple[int, Ground]]:
        """Unlimited level planes, by the numbers of their nodes."""
        for node in kept:
            geometry = gltf_nodes.collider_of(self._entry(node))
            if geometry is None or "shape" not in geometry or self.owners[node.index] is not None:
                continue
            stated = gltf_nodes.implicit_shape(self.document, geometry["shape"], self.path)
            if stated.get("type") == "plane" and _plane_size(stated) is None:
                normal = Z_UP @ node.world_from_node[:3, 1]
                if normal[2] > _LEVEL * np.linalg.norm(normal):
                    yield node.index, Ground(self.names[node.index], float((Z_UP @ node.world_from_node[:3, 3])[2]))

    def _free_body(self, node: PlacedNode, shapes: Sequence[_Shape]) -> SceneBody | None:
        name = self.names[node.index]
        position, quat = self.pose(node)
        if len(shapes) > _MOST_MESHES and not any(shape.is_hull for shape in shapes):
            placed = [Mesh(_moved(_body_from_shape(s, position, quat), s.mesh.vertices), s.mesh.faces) for s in shapes]
            parts = self._cut(join_meshes(placed), name, solid_parts)
        else:
            parts = [p for shape in shapes for p in self._parts(shape, position, quat, name)]
        if not parts:
            self._note("no_collider", f"{name} is a free body, but nothing of it has a surface; it is left as it is")
            return None
        stated = gltf_nodes.motion_of(self._entry(node))
        turn = rotation_matrix(quat)
        frame = turn.T @ Z_UP @ node.world_from_node[:3, :3]  # from the frame of the node, with its scale
        com = None if stated.center_of_mass is None else _vec3(frame @ np.array(stated.center_of_mass))
        inertia = None
        if stated.moments is not None:
            axes = frame @ Rotation.from_quat(stated.moments_quat_xyzw).as_matrix()
            is_unscaled = np.allclose(frame @ frame.T, np.eye(3), rtol=0, atol=1e-6)
            inertia = usable_inertia(axes @ np.diag(stated.moments) @ axes.T) if is_unscaled else None
            if inertia is None:
                message = (
                    f"{name} states an inertia that no body can have, or that its scale changes; that of its shape is used"
                )
                self._note("inertia_replaced", message)
        return SceneBody(name, position, quat, tuple(parts), True, stated.mass, com, inertia)

    def _fixed_body(self, node: PlacedNode, shapes: Sequence[_Shape], boxes: FloatArray, *, is_exact: bool) -> SceneBody | None:
        """A body of the surroundings.

        Args:
            node: Its node.
            shapes: Its shapes.
            boxes: Least and largest coordinates of the free bodies, (N, 2, 3), metres, z up.
            is_exact: Whether its parts may follow its meshes; else they are hulls.
        """
        name = self.names[node.index]
        position, quat = self.pose(node)
        turn = rotation_matrix(quat)
        down, own_centers = -turn[2], (boxes.mean(axis=1) - np.array(position)) @ turn
        parts: list[Mesh] = []
        for shape in shapes:
            placed = _moved(shape.node.world_from_node, shape.mesh.vertices) @ Z_UP.T
            if not _is_near(_box_of(placed), boxes):
                shape = _Shape(shape.node, shape.mesh, shape.key, is_hull=True)
            elif not shape.is_hull and (not is_exact or self.num_cut >= _MOST_CUT):
                self.coarse.append(name)
                shape = _Shape(shape.node, shape.mesh, shape.key, is_hull=True)
            parts += self._parts(shape, position, quat, name, _Surroundings(down, own_centers))
        return SceneBody(name, position, quat, tuple(parts), is_free=False) if parts else None

    def _parts(
        self, shape: _Shape, position: Vec3, quat: QuatXyzw, name: str, fixed: _Surroundings | None = None
    ) -> list[Mesh]:
        """The convex parts of a shape, metres, in the frame of a body."""
        place = _body_from_shape(shape, position, quat)
        turn, shift = place[:3, :3], place[:3, 3]
        if abs(np.linalg.det(turn)) < 1e-30:  # scaled to nothing
            return []
        faces = shape.mesh.faces if np.linalg.det(turn) > 0 else shape.mesh.faces[:, ::-1]
        mesh = Mesh(shape.mesh.vertices @ turn.T, faces)
        if shape.is_hull:
            hull = convex_solids.hull_of(mesh.vertices[np.unique(mesh.faces)])
            parts = [] if hull is None else [hull]
        else:
            key: tuple[object, ...] = (shape.key, _rounded(turn))
            cut = solid_parts
            if fixed is not None:
                inside = fixed.centers - shift
                inside = inside[((inside > mesh.vertices.min(axis=0)) & (inside < mesh.vertices.max(axis=0))).all(axis=1)]
                key = (*key, _rounded(fixed.down), _rounded(inside))
                cut = partial(fixed_parts, down=fixed.down, inside=inside)
            if key not in self.cache:
                self.num_cut += fixed is not None
                self.cache[key] = self._cut(mesh, name, cut)
            parts = self.cache[key]
        return [Mesh(part.vertices + shift, part.faces) for part in parts]

    def _cut(self, mesh: Mesh, name: str, cut: Callable[[Mesh, str], list[Mesh]]) -> list[Mesh]:
        """Convex parts of a mesh; its hull if that fails, which is noted."""
        try:
            return cut(mesh, name)
        except MeshError as error:
            hull = convex_solids.hull_of(mesh.vertices[np.unique(mesh.faces)])
            what = "it has none and is no obstacle" if hull is None else "its convex hull counts"
            self._note(error.code, f"{name}: {str(error).removeprefix('asset ')}; {what}")
            return [] if hull is None else [hull]

    def pose(self, node: PlacedNode) -> BodyPose:
        """The pose of a node, see :func:`node_pose`."""
        return node_pose(node.world_from_node, is_z_up=gltf_nodes.is_own_object(self._entry(node)))


def _refuse_endless(transform: FloatArray) -> None:
    """Refuses a transform with numbers that are not finite, with which LAPACK would never end."""
    if not np.isfinite(transform).all():
        raise SceneError("a node has a transform that is not finite, expected usual numbers; export it again", "not_finite")


def node_pose(world_from_node: FloatArray, *, is_z_up: bool) -> BodyPose:
    """The pose of a node without its scale, in metres, z up.

    Args:
        world_from_node: Its transform in the axes of the file, (4, 4).
        is_z_up: Whether z is up in the node too, as in exports of this library; else y is, and the axes of the body are turned, so
            that its z axis is what points up in the file.

    Raises:
        SceneError: The transform is not finite (``not_finite``).
    """
    _refuse_endless(world_from_node)
    left, _, right = np.linalg.svd(world_from_node[:3, :3])
    axes = left @ right  # the rotation next to the transform
    if np.linalg.det(axes) < 0:  # a mirrored node: its frame is the mirrored one's
        axes[:, 2] *= -1
    turned = Z_UP @ axes if is_z_up else Z_UP @ axes @ Z_UP.T
    return _vec3(Z_UP @ world_from_node[:3, 3]), quat_of(Rotation.from_matrix(turned))


def _body_from_shape(shape: _Shape, position: Vec3, quat: QuatXyzw) -> FloatArray:
    """The transform from the frame of a shape to that of a body, (4, 4)."""
    turn = rotation_matrix(quat).T
    place = np.eye(4)
    place[:3, :3] = turn @ Z_UP @ shape.node.world_from_node[:3, :3]
    place[:3, 3] = turn @ (Z_UP @ shape.node.world_from_node[:3, 3] - np.array(position))
    return place


def _moved(place: FloatArray, points: FloatArray) -> FloatArray:
    moved: FloatArray = points @ place[:3, :3].T + place[:3, 3]
    return moved


def _rounded(values: FloatArray) -> bytes:
    return np.asarray(np.round(values, 9) + 0.0).tobytes()  # zeros lose their sign


def _box_of(points: FloatArray) -> tuple[FloatArray, FloatArray]:
    return points.min(axis=0), points.max(axis=0)


def _is_near(box: tuple[FloatArray, FloatArray], others: FloatArray) -> bool:
    """Whether a box is beside, around or anywhere below one of others, (N, 2, 3)."""
    low, high = box
    is_below = (low < others[:, 1] + _NEAR).all(axis=1)
    return bool((is_below & (high[:2] > others[:, 0, :2] - _NEAR).all(axis=1)).any())


def _plane_size(shape: Mapping[str, Any]) -> tuple[float, float] | None:
    """The extents of a plane; None if it is unlimited along an axis."""
    plane = shape.get("plane") or {}
    x, z = (number(plane.get(key)) for key in ("sizeX", "sizeZ"))
    return (x, z) if x and z and np.isfinite([x, z]).all() else None


def _implicit_solid(shape: Mapping[str, Any]) -> Mesh | None:
    """A shape of KHR_implicit_shapes as a mesh in its own frame, y up; None if it is none that is read."""
    kind = shape.get("type")
    stated = shape.get(str(kind)) or {}

    def length(key: str, default: float) -> float:
        found = number(stated.get(key, default))
        return found if found is not None and 0 <= found < 1e6 else 0.0

    if kind == "box":
        size = numbers(stated.get("size", (1.0, 1.0, 1.0)), 3)
        points = None if size is None else convex_solids.box(np.array(size) / 2).vertices
    elif kind == "sphere":
        points = convex_solids.ellipsoid(np.full(3, length("radius", 0.5))).vertices
    elif kind in ("cylinder", "capsule"):
        half, low, high = length("height", 0.5) / 2, length("radiusBottom", 0.25), length("radiusTop", 0.25)
        unit = convex_solids.cylinder(1.0, 0.0) if kind == "cylinder" else convex_solids.ellipsoid(np.ones(3))
        ends = [unit.vertices * (r, r, r if kind == "capsule" else 0.0) + (0, 0, z) for r, z in ((low, -half), (high, half))]
        points = np.concatenate(ends) @ Z_UP  # from along z to along y
    elif kind == "plane" and (size_xz := _plane_size(shape)) is not None:
        x, z = np.array(size_xz) / 2
        corners = np.array([[-x, 0.0, -z], [-x, 0.0, z], [x, 0.0, z], [x, 0.0, -z]])
        return Mesh(corners, np.array([[0, 1, 2], [0, 2, 3]]))
    else:
        return None
    return None if points is None else convex_solids.hull_of(points)


def _vec3(values: FloatArray) -> Vec3:
    x, y, z = (float(v) for v in values)
    return x, y, z
