"""Exports a scene as binary glTF: one node for each object, with its instance and pose; objects of one asset share its mesh."""

from collections import defaultdict
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from stable_data.atomic_files import safe_file_name, write_file_atomically
from stable_data.geometry.gltf_writer import SurfaceParts, material, pack
from stable_data.geometry.mesh import Mesh
from stable_data.geometry.mesh_colors import Paint
from stable_data.geometry.shading import corner_normals
from stable_data.geometry.shape import Shape
from stable_data.geometry.surface import Surface
from stable_data.rotations import quat_of
from stable_data.scene import TABLE, UPRIGHT, QuatXyzw, Scene, Vec3
from stable_data.simulation.mujoco_model import SUPPORT
from stable_data.simulation.render import object_colour
from stable_data.simulation.room import furnish
from stable_data.simulation.scene_geometry import SceneGeometry

ABOUT = """Binary glTF, one file for each scene: `<scene>.glb`, metres. The format requires that y is up and -z is away from the
viewer; the node `scene` turns all nodes below it, whose coordinates are those of stable-data. Nodes have the names of the
instances, and their `extras` give category, asset and description, and `fixed` for what does not move. The node `table` is the
table with its legs, or `support` the piece of furniture on which the scene stands; the surface is at z = 0."""

_Y_UP = (-float(np.sqrt(0.5)), 0.0, 0.0, float(np.sqrt(0.5)))  # turns z up into y up


def scene_path(scene: Scene, out: Path) -> Path:
    """Returns the file of a scene: if it exists, the scene is exported."""
    return out / f"{safe_file_name(scene.scene_id)}.glb"


def export_scene(geometry: SceneGeometry, out: Path) -> None:
    """Writes a scene, see :class:`~stable_data.export.formats.ExportFormat`."""
    write_file_atomically(scene_path(geometry.scene, out), scene_glb(geometry))


def scene_glb(geometry: SceneGeometry) -> bytes:
    """Returns the content of a scene's file."""
    document = _Document(_table(geometry))
    for k, o in enumerate(geometry.scene.objects):
        if geometry.is_seen(k):
            document.add_object(geometry, k, o.position, o.yaw)
    return document.content(geometry.scene.scene_id, _Y_UP)


def table_glb(geometry: SceneGeometry) -> bytes:
    """Returns what is seen of a scene without its objects: the table or the support. As a file with z up, metres."""
    return _Document(_table(geometry)).content(TABLE, UPRIGHT)


def object_glb(geometry: SceneGeometry, index: int) -> bytes:
    """Returns what is seen of one object as a file with z up, metres, yaw frame; the origin is the centre of its box."""
    document = _Document({})
    document.add_object(geometry, index, (0.0, 0.0, 0.0), 0.0)
    return document.content(geometry.scene.objects[index].instance, UPRIGHT)


def surfaces_glb(name: str, surfaces: Sequence[Surface]) -> bytes:
    """Returns surfaces in their own frame as a file with one node of this name."""
    return _Document({name: surfaces}).content(name, UPRIGHT)


def _table(geometry: SceneGeometry) -> Mapping[str, Sequence[Surface]]:
    """What is seen of the table, of the support on which it lies and of the restricted zone, by the name of its node."""
    table, support = defaultdict[str, list[Surface]](list), geometry.support
    if support is not None:
        table[SUPPORT] += support.placed()
    for part in furnish(geometry.scene.table, *geometry.seen_bounds, None if support is None else support.bounds):
        if part.is_of_table:
            table[part.name.split("/")[0]].append(part.surface)
    return table


class _Document:
    """A glTF document under construction."""

    def __init__(self, table: Mapping[str, Sequence[Surface]]) -> None:
        self._parts = SurfaceParts()
        self._meshes: list[dict[str, Any]] = []
        self._nodes: list[dict[str, Any]] = [
            {"name": name, "mesh": self.look(name, surfaces)} for name, surfaces in table.items()
        ]
        self._materials: list[dict[str, Any]] = self._parts.materials
        self._arrays = self._parts.arrays
        self._numbers: dict[tuple[str, ...], int] = {}

    def look(self, name: str, surfaces: Sequence[Surface]) -> int:
        """Number of a mesh with colours and textures, which is added."""
        primitives = [self._parts.primitive(s, normals=corner_normals(s.triangles)) for s in surfaces]
        self._meshes.append({"name": name, "primitives": primitives})
        return len(self._meshes) - 1

    def mesh(self, name: str, mesh: Mesh, paint: Paint, look: Sequence[Surface] | None = None) -> int:
        """Number of a mesh with its look, or in its colours; an equal mesh is added only once."""
        key = (name, *(colour for colour, _ in paint))
        if key not in self._numbers and look is not None:
            self._numbers[key] = self.look(name, look)
        if key not in self._numbers:
            self._numbers[key] = len(self._meshes)
            corners, first = len(self._arrays), len(self._materials)
            primitives = [
                {"attributes": {"POSITION": corners}, "indices": corners + 1 + n, "material": first + n}
                for n in range(len(paint))
            ]
            self._meshes.append({"name": name, "primitives": primitives})
            self._materials += [material(colour) for colour, _ in paint]
            self._arrays += [mesh.vertices, *(mesh.faces[rows] for _, rows in paint)]
        return self._numbers[key]

    def add(
        self, name: str, mesh: int, position: Vec3, quat_xyzw: QuatXyzw, scale: Vec3, extras: dict[str, Any] | None = None
    ) -> None:
        """Adds a node that shows a mesh."""
        node = {"name": name, "mesh": mesh, "translation": position, "rotation": quat_xyzw, "scale": scale}
        self._nodes.append(node | ({"extras": extras} if extras else {}))

    def add_object(self, geometry: SceneGeometry, index: int, position: Vec3, yaw: float) -> None:
        """Adds an object of a scene at a pose."""
        o, mesh, turn = geometry.scene.objects[index], geometry.meshes[index], Rotation.from_euler("z", yaw)
        extras: dict[str, Any] = {"category": o.category, "description": o.description, "asset_id": o.asset_id}
        if o.instance in geometry.scene.fixed:
            extras["fixed"] = True
        if mesh is None or o.scale is None:  # its box replaces it
            unit = Shape.box((1.0, 1.0, 1.0))
            box = Mesh(unit.vertices, unit.faces)
            number = self.mesh("box", box, _all_of(box, object_colour(o)))
            self.add(o.instance, number, position, quat_of(turn), o.size, extras)
            return
        x, y, z = (position + turn.apply(geometry.offset(index))).tolist()
        asset_id, look = str(o.asset_id), geometry.look(index)
        number = self.mesh(asset_id, mesh, geometry.paint(index), None if look is None else look.surfaces)
        self.add(o.instance, number, (x, y, z), quat_of(turn * Rotation.from_quat(o.tilt_quat_xyzw)), o.scale, extras)

    def content(self, name: str, turn: QuatXyzw) -> bytes:
        root = {"name": "scene", "rotation": turn, "children": list(range(1, len(self._nodes) + 1))}
        document = {
            "scene": 0,
            "scenes": [{"name": name, "nodes": [0]}],
            "nodes": [root, *self._nodes],
            "meshes": self._meshes,
            **self._parts.document(self._parts.embedded_images()),
        }
        return pack(document, self._arrays, self._parts.images)


def _all_of(mesh: Mesh, colour: str) -> Paint:
    return ((colour, np.arange(len(mesh.faces))),)
