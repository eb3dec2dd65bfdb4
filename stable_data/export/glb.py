"""A whole scene as binary glTF: one node an object, named by its instance, with its pose; objects of one asset share its mesh."""

from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from stable_data.atomic_files import safe_file_name, write_file_atomically
from stable_data.geometry.gltf_writer import material, pack
from stable_data.geometry.mesh import Mesh
from stable_data.geometry.mesh_colors import Paint
from stable_data.geometry.shape import Shape
from stable_data.rotations import quat_of
from stable_data.scene import TABLE, FloatArray, IntArray, QuatXyzw, Scene, Tabletop, Vec3
from stable_data.simulation.render import SINK_COLOUR, SINK_RISE, TABLE_COLOUR, TABLE_THICKNESS, object_colour
from stable_data.simulation.scene_geometry import SceneGeometry

ABOUT = """Binary glTF, one file a scene: `<scene>.glb`, metres. As the format demands, y is up and -z is away from the viewer; below
the node `scene`, which turns them, all coordinates are those of stable-data. Nodes have the names of the instances, and
`extras` say category, asset and description."""

_Y_UP = (-float(np.sqrt(0.5)), 0.0, 0.0, float(np.sqrt(0.5)))  # turns z up into y up


def scene_path(scene: Scene, out: Path) -> Path:
    """Where a scene's file is: once it is there, the scene is exported."""
    return out / f"{safe_file_name(scene.scene_id)}.glb"


def export_scene(solid: SceneGeometry, out: Path) -> None:
    """Writes a scene.

    Args:
        solid: The scene with its geometry.
        out: The folder of the export.

    Raises:
        OSError: The folder cannot be written.
    """
    write_file_atomically(scene_path(solid.scene, out), scene_glb(solid))


def scene_glb(solid: SceneGeometry) -> bytes:
    """The content of a scene's file."""
    document = _Document()
    unit = Shape.box((1.0, 1.0, 1.0))
    box = Mesh(unit.vertices, unit.faces)
    for name, colour, position, size in _table_boxes(solid.scene.table):
        document.add(name, document.mesh(name, box, _all_of(box, colour)), position, (0.0, 0.0, 0.0, 1.0), size)
    for k, (o, mesh) in enumerate(zip(solid.scene.objects, solid.meshes, strict=True)):
        turn = Rotation.from_euler("z", o.yaw)
        extras = {"category": o.category, "description": o.description, "asset_id": o.asset_id}
        if mesh is None or o.scale is None:  # its box stands in
            number = document.mesh("box", box, _all_of(box, object_colour(o)))
            document.add(o.instance, number, o.position, quat_of(turn), o.size, extras)
            continue
        x, y, z = (o.position + turn.apply(solid.offset(k))).tolist()
        number = document.mesh(str(o.asset_id), mesh, solid.paint(k))
        document.add(o.instance, number, (x, y, z), quat_of(turn * Rotation.from_quat(o.tilt_quat_xyzw)), o.scale, extras)
    return document.content(solid.scene.scene_id)


class _Document:
    """A glTF document that grows."""

    def __init__(self) -> None:
        self._nodes: list[dict[str, Any]] = []
        self._meshes: list[dict[str, Any]] = []
        self._materials: list[dict[str, Any]] = []
        self._arrays: list[FloatArray | IntArray] = []
        self._numbers: dict[tuple[str, ...], int] = {}

    def mesh(self, name: str, mesh: Mesh, paint: Paint) -> int:
        """Number of a mesh in its colours; one that is there already is used again."""
        key = (name, *(colour for colour, _ in paint))
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

    def content(self, name: str) -> bytes:
        """The file."""
        root = {"name": "scene", "rotation": _Y_UP, "children": list(range(1, len(self._nodes) + 1))}
        document = {
            "scene": 0,
            "scenes": [{"name": name, "nodes": [0]}],
            "nodes": [root, *self._nodes],
            "meshes": self._meshes,
            "materials": self._materials,
        }
        return pack(document, self._arrays)


def _all_of(mesh: Mesh, colour: str) -> Paint:
    return ((colour, np.arange(len(mesh.faces))),)


def _table_boxes(table: Tabletop) -> list[tuple[str, str, Vec3, Vec3]]:
    """Name, colour, centre and size of the table and of what may not be stood on."""
    x, y = table.size_xy
    boxes = [(TABLE, TABLE_COLOUR, (x / 2, y / 2, -TABLE_THICKNESS / 2), (x, y, TABLE_THICKNESS))]
    if table.restricted_zone is not None:
        x_min, x_max, y_min, y_max = table.restricted_zone
        size = (x_max - x_min, y_max - y_min, 2 * SINK_RISE)
        boxes.append(("restricted_zone", SINK_COLOUR, ((x_min + x_max) / 2, (y_min + y_max) / 2, 0.0), size))
    return boxes
