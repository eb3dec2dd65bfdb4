"""The stage of a scene in OpenUSD."""

import hashlib
import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from pxr import Gf, Kind, Sdf, Vt
from scipy.spatial.transform import Rotation

from stable_data.export.props import PlacedProp, placed_props, sized_prop
from stable_data.export.scene_files import PICTURE, camera_poses, object_facts, scene_facts, table_box
from stable_data.export.usd_layer import (
    Materials,
    add_box_collider,
    add_prim,
    add_surface,
    label,
    new_layer,
    place,
    put,
    relate,
    write_layer,
)
from stable_data.export.usd_prop import (
    BODY_SCHEMAS,
    GEOMETRY,
    TEXTURE_FOLDER,
    add_physics_material,
    package_path,
    put_image,
    put_mass,
    write_package,
)
from stable_data.geometry.surface import Surface
from stable_data.json_text import json_text
from stable_data.simulation.mujoco_model import SUPPORT
from stable_data.simulation.room import furnish
from stable_data.simulation.scene_geometry import SceneGeometry
from stable_data.simulation.settling import GRAVITY

_PROPS, _FURNITURE = "props", "furniture"
_LENS, _SENSOR = 50.0, 36.0  # millimetres; the sensor's height


def write_stage(geometry: SceneGeometry, out: Path, path: Path, *, is_whole: bool) -> None:
    """Writes the stage of a scene, and what it references as far as that does not exist.

    Args:
        geometry: The scene.
        out: The folder of the export.
        path: The file of the stage.
        is_whole: Whether it has a physics scene, cameras, lights and a room, and its packages the usual size of their assets; else
            it is for a program that makes these itself, and each package has the size of an object.

    Raises:
        MeshError: An object has no solid part.
        OSError: A file cannot be written.
    """
    scene = geometry.scene
    layer = new_layer("World", f"Scene {scene.scene_id} of stable-data", is_text=True)
    world = add_prim(layer, "World", "Xform")
    world.kind = Kind.Tokens.assembly
    world.customData = {"stable_data": _facts(geometry)}
    if is_whole:
        physics = add_prim(world, "PhysicsScene", "PhysicsScene")
        put(physics, "vector3f", {"physics:gravityDirection": Gf.Vec3f(0, 0, -1)})
        put(physics, "float", {"physics:gravityMagnitude": GRAVITY})
    table = add_prim(world, "Table", "Xform", ("MaterialBindingAPI", "SemanticsLabelsAPI:class"))
    label(table, "class", ["table"])
    middle, size = map(np.array, table_box(geometry))
    add_box_collider(table, "Collider", middle - size / 2, middle + size / 2)
    relate(table, "material:binding:physics", add_physics_material(table, "PhysicsMaterial", None))
    _refer(add_prim(world, "Furniture", "Xform"), f"../{_FURNITURE}/{_put_furniture(geometry, out / _FURNITURE, is_whole)}")
    objects = add_prim(world, "Objects", "Xform")
    objects.kind = Kind.Tokens.group
    placed = placed_props(geometry)
    for prop, name in zip(placed, prim_names(placed), strict=True):
        _add_object(objects, prop, name, geometry, out / _PROPS, is_sized=not is_whole)
    if is_whole:
        _add_view(world, geometry)
    path.parent.mkdir(parents=True, exist_ok=True)
    write_layer(layer, path)


def _facts(geometry: SceneGeometry) -> dict[str, Any]:
    """What is known of the scene: task, relations and verdicts."""
    given = scene_facts(geometry)
    known = {name: value for name, value in given["verdicts"].items() if value is not None}
    facts: dict[str, Any] = {
        "scene_id": given["scene_id"],
        "table_type": given["table_type"],
        "relations": [f"{r['subject']} {r['kind']} {r['target']}" for r in given["relations"]],
        "verdicts": known,
        "unknown_verdicts": sorted(given["verdicts"].keys() - known.keys()),
        **(given["task"] or {}),
    }
    return {name: _texts(value) if isinstance(value, list) else value for name, value in facts.items()}


def _texts(values: list[Any]) -> Vt.StringArray:
    """A list as USD can state it; what is no text becomes JSON."""
    return Vt.StringArray([value if isinstance(value, str) else json_text(value) for value in values])


def prim_names(placed: Sequence[PlacedProp]) -> list[str]:
    """Returns the names of the objects as OpenUSD accepts them: letters, digits and ``_``, no digit first; unique in the scene."""
    found: dict[str, None] = {}
    for p in placed:
        name = _prim_name(p.name)
        while name in found:
            name += "_"
        found[name] = None
    return list(found)


def _prim_name(name: str) -> str:
    plain = "".join(c if c.isascii() and c.isalnum() else "_" for c in name)
    return plain if not plain[0].isdigit() else f"_{plain}"


def _add_object(
    parent: Sdf.PrimSpec, placed: PlacedProp, name: str, geometry: SceneGeometry, props: Path, *, is_sized: bool
) -> None:
    prop = sized_prop(placed.prop, placed.factor) if is_sized else placed.prop
    write_package(prop, geometry.store, props)
    body = add_prim(parent, name, "Xform")
    _refer(body, f"../{_PROPS}/{package_path(prop).as_posix()}")
    place(body, placed.position, placed.quat_xyzw)
    facts = object_facts(placed)
    body.customData = {"stable_data": {key: value for key, value in facts.items() if value}}
    if placed.is_fixed:
        body.SetInfo("apiSchemas", Sdf.TokenListOp.Create(deletedItems=list(BODY_SCHEMAS)))
    if not is_sized and placed.factor != 1.0:
        put_mass(body, placed.mass)
        put(add_prim(body, GEOMETRY, is_over=True), "float3", {"xformOp:scale": Gf.Vec3f(placed.factor)})
    if not placed.is_seen:
        shapes = body.nameChildren.get(GEOMETRY) or add_prim(body, GEOMETRY, is_over=True)
        add_prim(shapes, "Visuals", is_over=True).SetInfo("active", False)


def _refer(prim: Sdf.PrimSpec, path: str) -> None:
    prim.referenceList.Prepend(Sdf.Reference(path))


def _put_furniture(geometry: SceneGeometry, folder: Path, has_room: bool) -> str:
    """Writes what is seen of the table and the room, if it does not exist, and returns the name of the file."""
    support = geometry.support
    parts = [(SUPPORT, k, s, SUPPORT) for k, s in enumerate(support.placed())] if support is not None else []
    bounds = None if support is None else support.bounds
    shown = [p for p in furnish(geometry.scene.table, *geometry.seen_bounds, bounds) if has_room or p.is_of_table]
    parts += [(p.name, 0, p.surface, p.material.name) for p in shown]
    key = hashlib.sha256()
    for name, _, surface, made_of in parts:
        key.update(json.dumps([name, made_of, surface.colour, surface.opacity, surface.has_alpha]).encode())
        key.update(surface.triangles.tobytes() + (surface.image or b""))
        for array in (surface.corner_uv, surface.corner_colours):
            key.update(b"" if array is None else array.tobytes())
    file = f"{key.hexdigest()[:24]}.usd"
    if not (folder / file).exists():
        folder.mkdir(parents=True, exist_ok=True)
        _write_furniture(parts, folder, file)
    return file


def _write_furniture(parts: list[tuple[str, int, Surface, str]], folder: Path, file: str) -> None:
    layer = new_layer("Furniture", "A table and its room, of stable-data; nothing here collides", is_text=False)
    root = add_prim(layer, "Furniture", "Xform")
    materials = Materials(root, TEXTURE_FOLDER)
    groups: dict[str, Sdf.PrimSpec] = {}
    for name, number, surface, made_of in parts:
        group = name.partition("/")[0]
        if group not in groups:
            groups[group] = add_prim(root, group, "Xform", ("SemanticsLabelsAPI:class",))
            label(groups[group], "class", [group])
        image = None
        if surface.image is not None and surface.corner_uv is not None:
            image = put_image(surface.image, folder / TEXTURE_FOLDER)
        own = name.partition("/")[2] or "surface"
        add_surface(groups[group], f"{own}_{number}", surface, materials.of(surface, image, made_of))
    write_layer(layer, folder / file)


def _add_view(world: Sdf.PrimSpec, geometry: SceneGeometry) -> None:
    """Adds cameras and lights."""
    cameras = add_prim(world, "Cameras", "Scope")
    for view, position, quat_xyzw in camera_poses(geometry):
        camera = add_prim(cameras, view, "Camera")
        place(camera, position, quat_xyzw)
        width = _SENSOR * PICTURE[0] / PICTURE[1]
        put(camera, "float", {"focalLength": _LENS, "horizontalAperture": width, "verticalAperture": _SENSOR})
        put(camera, "float2", {"clippingRange": Gf.Vec2f(0.01, 1000.0)})
    lights = add_prim(world, "Lights", "Scope")
    put(add_prim(lights, "Sky", "DomeLight"), "float", {"inputs:intensity": 400.0})
    sun = add_prim(lights, "Sun", "DistantLight")
    put(sun, "float", {"inputs:intensity": 1500.0, "inputs:angle": 2.0})
    x, y, z, w = Rotation.align_vectors([[0.45, 0.55, -1.3]], [[0.0, 0.0, -1.0]])[0].as_quat().tolist()  # from the front left
    place(sun, (0.0, 0.0, 0.0), (x, y, z, w))
