"""Reads scenes of TabletopGen (arXiv 2512.01204) as it writes them, and writes them in the MesaTask-10K format.

A scene is a folder. Its ``output_assets/layout_json`` has ``layout_pose.json`` (sizes and centres in centimetres) and
``layout_rotation.json`` (degrees about the vertical), its ``output_assets/centered_mesh`` a GLB for each object, whose box is centred on
the origin. Each mesh is scaled to its size along its own axes, then turned, then moved. One object, the ``main_object``, is the table.

Coordinates are z up, those in the GLB files too. x points to the left and y to the viewer of the picture that a scene was made of, and
things show him their y axis. So all is turned by half a turn here.
"""

import math
import re
from collections import Counter
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from stable_data.assets.annotation import AssetAnnotation
from stable_data.errors import ConfigError, MeshError, Notice
from stable_data.geometry.gltf_writer import write_glb
from stable_data.geometry.reduction import join_triangles
from stable_data.importers.boundary import Boundary, asset_id_of
from stable_data.importers.mesh_files import read_mesh_file, transformed
from stable_data.json_text import ReadLog, are_finite, number, numbers, parse_object, quote_value
from stable_data.limits import LIMITS, at_most
from stable_data.mesatask.writing import write_asset, write_scene
from stable_data.rotations import rotation_matrix, yaw_quat
from stable_data.scene import Scene, SceneObject, Tabletop, Vec3

SOURCE = "TabletopGen"
"""The source that annotations of the assets name."""

_LAYOUTS = "output_assets/layout_json"
_MESHES = "output_assets/centered_mesh"
_HALF_TURN = np.diag([-1.0, -1.0, 1.0, 1.0])
_FARTHEST = 1e5  # centimetres
_NUMBER = re.compile(r"[\s_]*\d+$")  # what ends a name: "book_1"


@dataclass(frozen=True, slots=True)
class WrittenScene:
    """A scene that was written.

    Attributes:
        annotations: Those of its assets, by their identifiers.
        notices: Remarks: what is not on the table, or has no mesh, was left out.
    """

    annotations: Mapping[str, AssetAnnotation]
    notices: tuple[Notice, ...]


def scene_folders(root: Path) -> list[str]:
    """Lists the folders of scenes, by the numbers that end their names.

    Raises:
        ConfigError: There is none (``source_missing``).
    """
    found = [path.name for path in root.iterdir() if (path / _LAYOUTS).is_dir()] if root.is_dir() else []
    if not found:
        raise ConfigError(
            f"{root}: no folder in it has {_LAYOUTS}, expected the folder output_scene of TabletopGen; check the path",
            "source_missing",
        )
    return sorted(found, key=lambda name: (number_of(name) or 0, name))


def number_of(folder: str) -> int | None:
    """The number that TabletopGen has given to a scene, ``scene_7``; None for other names."""
    match = re.fullmatch(r"scene_(\d{1,9})", folder)
    return None if match is None else int(match[1])


def convert_scene(root: Path, folder: str, scene_id: str, out: Path) -> WrittenScene:
    """Writes a scene and its meshes in the MesaTask-10K format.

    Args:
        root: The folder of the scenes.
        folder: The scene's own folder in it.
        scene_id: The identifier that it gets.
        out: The dataset's folder.

    Raises:
        StableDataError: A file of it is missing or cannot be read, or it has no object on its table.
    """
    log = ReadLog(scene_id)
    boundary = Boundary(root / folder)
    layout = _Layout(boundary, log)
    objects, extents, annotations = list[SceneObject](), dict[str, Vec3](), dict[str, AssetAnnotation]()
    meshes: dict[str, bytes] = {}
    counts: Counter[str] = Counter()
    for name in layout.names_on_table():
        category = _category(name) or "thing"
        instance, words = f"{len(objects)}_{category}_{counts[category]}", category.replace("_", " ")
        asset_id = asset_id_of(f"{scene_id}_{instance}")  # names may differ in signs alone that no identifier has
        try:
            glb, own, center = _turned_mesh(boundary, name, asset_id)
        except MeshError as error:
            if error.code != "file_missing":
                raise log.error(error.code, str(error)) from error
            log.warn("mesh_missing", f"{quote_value(name)} has no mesh and is left out: {error}")
            continue
        origin, yaw, size = layout.placed(name)
        scale = _scale(size, own)
        shift = rotation_matrix(yaw_quat(yaw)) @ (np.array(center) * scale)
        position = (origin[0] + float(shift[0]), origin[1] + float(shift[1]), origin[2] + float(shift[2]))
        objects.append(SceneObject(instance, category, position, yaw, size, asset_id, scale, description=words))
        counts[category] += 1
        meshes[asset_id], extents[asset_id] = glb, own
        annotations[asset_id] = AssetAnnotation(asset_id, category, words, source=SOURCE)
    if not objects:
        raise log.error("no_objects", "no object is on its table, expected some")
    for asset_id, glb in meshes.items():  # only now: a scene that cannot be read leaves nothing
        write_asset(out, asset_id, glb)
    write_scene(out, Scene(scene_id, layout.table, tuple(objects)), extents=extents)
    return WrittenScene(annotations, tuple(log.notices))


class _Layout:
    """The layout of a scene, in the frame of its table: metres, origin at the front left corner, y from front to back.

    Args:
        boundary: The folder of the scene.
        log: Its log.

    Attributes:
        table: The table.

    Raises:
        StableDataError: A file is missing or has other content than expected.
    """

    def __init__(self, boundary: Boundary, log: ReadLog) -> None:
        self._log = log
        document = self._read(boundary, "layout_pose.json")
        self._turns = self._read(boundary, "layout_rotation.json")
        self._below = self._read(boundary, "placement_order.json") if self._has(boundary, "placement_order.json") else None
        entries = document.get("objects")
        main = document.get("main_object")
        if not isinstance(entries, dict) or not isinstance(main, str) or main not in entries:
            raise log.error("layout_invalid", "layout_pose.json lacks objects or the main_object among them, expected both")
        if len(entries) > LIMITS.layout.max_objects:
            expected = at_most(LIMITS.layout, "max_objects")
            raise log.error(
                "too_many_objects", f"{len(entries)} objects, expected {expected}; raise it if the scene is correct"
            )
        self._main, self._entries = main, dict[str, Any](entries)
        center, size = self._vector(self._main, "pose"), self._vector(self._main, "size")
        turn = self._turn(self._main)
        # A table that is turned by a quarter is one of other proportions: the viewer stays where he is.
        self._yaw = turn - math.pi / 2 * round(turn / (math.pi / 2))
        is_across = round(turn / (math.pi / 2)) % 2 == 1
        width, depth = (size[1], size[0]) if is_across else (size[0], size[1])
        self.table = Tabletop(_category(self._main) or "table", (width, depth))
        self._origin = np.array([center[0], center[1], center[2] + size[2] / 2])

    def names_on_table(self) -> list[str]:
        """The names of the objects that stand on the table or on what does; all of them if the scene does not say it."""
        found = []
        for name in self._entries:
            if name == self._main:
                continue
            if self._is_on_table(name):
                found.append(name)
            else:
                self._log.warn("not_on_table", f"{quote_value(name)} is not on the table and is left out")
        return found

    def placed(self, name: str) -> tuple[Vec3, float, Vec3]:
        """The place of the origin of an object's mesh, its yaw in radians, and its size."""
        size = self._vector(name, "size")
        away = rotation_matrix(yaw_quat(-self._yaw)) @ (np.array(self._vector(name, "pose")) - self._origin)
        width, depth = self.table.size_xy
        return (width / 2 - float(away[0]), depth / 2 - float(away[1]), float(away[2])), self._turn(name) - self._yaw, size

    def _is_on_table(self, name: str) -> bool:
        if self._below is None:
            return True
        seen: set[str] = set()
        waiting = [name]
        while waiting:
            current = waiting.pop()
            if current == self._main:
                return True
            if current not in seen:
                seen.add(current)
                entry = self._below.get(current)
                below = entry.get("on_top_of") if isinstance(entry, dict) else None
                waiting += [one for one in (below if isinstance(below, list) else [below]) if isinstance(one, str)]
        return False

    def _turn(self, name: str) -> float:
        if name not in self._turns:
            if name != self._main:  # tables are not turned in most scenes
                self._log.warn("rotation_missing", f"{quote_value(name)} has no rotation; it is not turned")
            return 0.0
        degrees = number(self._turns[name])
        if degrees is None or not math.isfinite(degrees):
            raise self._log.error("layout_invalid", f"the rotation of {quote_value(name)} is no number, expected degrees")
        return math.radians(math.remainder(degrees, 360.0))

    def _vector(self, name: str, key: str) -> Vec3:
        entry = self._entries[name]
        found = numbers(entry.get(key), 3) if isinstance(entry, dict) else None
        if found is None or not are_finite(found) or max(map(abs, found)) > _FARTHEST or (key == "size" and min(found) <= 0):
            expected = f"three lengths in centimetres{' above 0' * (key == 'size')}, at most {_FARTHEST:,.0f}"
            raise self._log.error("layout_invalid", f"{key} of {quote_value(name)} is not known, expected {expected}")
        return _vec3(value / 100 for value in found)

    def _has(self, boundary: Boundary, file: str) -> bool:
        return (boundary.root / _LAYOUTS / file).is_file()

    def _read(self, boundary: Boundary, file: str) -> dict[str, Any]:
        try:
            content = boundary.read_bytes(f"{_LAYOUTS}/{file}", "max_bytes", LIMITS.layout)
        except MeshError as error:
            raise self._log.error(error.code, str(error)) from error
        return parse_object(content, file, self._log)


def _category(name: str) -> str:
    """The words of a name such as ``coffee cup_3``, joined by ``_``; empty if it has none."""
    return re.sub(r"[^a-z0-9]+", "_", _NUMBER.sub("", name).lower()).strip("_")


def _turned_mesh(boundary: Boundary, name: str, asset_id: str) -> tuple[bytes, Vec3, Vec3]:
    """The mesh of an object after half a turn, as GLB with its textures; the extents of its box along x, y and z (up), and its centre."""
    path = f"{_MESHES}/{name}.glb"
    file, _ = read_mesh_file(boundary, path, asset_id, max_faces=LIMITS.mesh.max_faces)
    surfaces = transformed(file.surfaces, _HALF_TURN)
    mesh, _ = join_triangles([surface.triangles for surface in surfaces], asset_id)
    low, high = mesh.vertices.min(axis=0), mesh.vertices.max(axis=0)
    glb = write_glb(mesh, surfaces=[surface for surface in surfaces if len(surface.triangles)])
    return glb, _vec3(high - low), _vec3((low + high) / 2)


def _scale(size: Vec3, extents: Vec3) -> Vec3:
    """Metres for each unit of a mesh; along an axis without extent, the mean of the others, as TabletopGen does."""
    known = [side / extent for side, extent in zip(size, extents, strict=True) if extent > 1e-6]
    return _vec3(known if len(known) == 3 else [sum(known) / len(known) if known else 1.0] * 3)


def _vec3(values: Iterable[float]) -> Vec3:
    x, y, z = (float(value) for value in values)
    return x, y, z
