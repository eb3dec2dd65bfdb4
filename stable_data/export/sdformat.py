"""Exports to SDFormat 1.9, the format of Gazebo and Drake: a world for each scene, and a model for each object at a size.

An export::

    worlds/<scene>.sdf                          a world, complete but for the meshes
    models/<model>/model.sdf, model.config      an object, for worlds of one's own
    meshes/<prop>/collision, visual             meshes, see :mod:`stable_data.export.mesh_files`, at the usual size
    meshes/<table>/visual                       what is seen of a table

Worlds contain their models and name meshes by relative paths, which Gazebo, Drake and libsdformat resolve without settings;
``model://`` would need one in each of them. OBJ with MTL is the one mesh format whose textures Gazebo Fortress, whose version of
SDFormat this is, and Drake both show: the first has no glTF, the second no COLLADA.
"""

import json
from pathlib import Path
from xml.etree import ElementTree as ET

from scipy.spatial.transform import Rotation

from stable_data.atomic_files import safe_file_name, write_file_atomically
from stable_data.export.mesh_files import MeshFiles, put_furniture_meshes, put_prop_meshes
from stable_data.export.props import PlacedProp, Prop, placed_props, sized_prop
from stable_data.export.scene_files import camera_poses, object_facts, scene_facts, sliding_friction, table_box
from stable_data.export.xml_elements import add, document
from stable_data.rotations import quat_of
from stable_data.scene import QuatXyzw, Scene, Vec3
from stable_data.simulation.scene_geometry import SceneGeometry
from stable_data.simulation.settling import GRAVITY, PhysicsOptions

ABOUT = """SDFormat 1.9 for Gazebo (Fortress and later) and Drake: `worlds/<scene>.sdf` is a world with gravity, time step, light and a
camera; a model for each object, named after its instance, with mass, full inertia, convex parts and friction; and the static model
`table`. Task, relations, verdicts and what is known of the
objects are JSON in the element `stable_data:scene`. `models/<model>` is each object at its size, for other
worlds. Meshes (OBJ with MTL and PNG) are found by relative paths: copy the folder `meshes` with `worlds` and `models`."""

MESH_FOLDER, MODEL_FOLDER = "meshes", "models"

_VERSION = "1.9"
_NAMESPACES = {"xmlns:drake": "http://drake.mit.edu", "xmlns:stable_data": "urn:stable-data"}
_CAMERA_AXES = Rotation.from_matrix([[0.0, -1.0, 0.0], [0.0, 0.0, 1.0], [-1.0, 0.0, 0.0]])  # +x of a camera here looks along -z


def scene_path(scene: Scene, out: Path) -> Path:
    """Returns the file of a scene: if it exists, the scene is exported."""
    return out / "worlds" / f"{safe_file_name(scene.scene_id)}.sdf"


def export_scene(geometry: SceneGeometry, out: Path) -> None:
    """Writes a scene, and those of its models and meshes that do not exist yet.

    Raises:
        MeshError: An object has no solid part.
    """
    path = scene_path(geometry.scene, out)
    root = ET.Element("sdf", {"version": _VERSION, **_NAMESPACES})
    world = add(root, "world", name=path.stem)
    objects = placed_props(geometry)
    facts = scene_facts(geometry) | {"objects": {p.name: object_facts(p) for p in objects}}
    add(world, "stable_data:scene", json.dumps(facts, allow_nan=False))
    _add_surroundings(world, geometry)
    _add_table(world, geometry, out / MESH_FOLDER)
    for placed in objects:
        meshes = put_prop_meshes(placed.prop, geometry.store, out / MESH_FOLDER / placed.prop.name)
        model = add(world, "model", name=placed.name)
        add(model, "static", placed.is_fixed)
        _add_pose(model, placed.position, placed.quat_xyzw)
        _add_link(model, placed, meshes, "..", is_seen=placed.is_seen)
        _put_model(placed, meshes, out / MODEL_FOLDER)
    path.parent.mkdir(parents=True, exist_ok=True)
    write_file_atomically(path, document(root))


def _add_surroundings(world: ET.Element, geometry: SceneGeometry) -> None:
    physics = add(world, "physics", name="default", type="ode")
    add(physics, "max_step_size", PhysicsOptions().timestep)
    add(physics, "real_time_factor", 1.0)
    add(world, "gravity", (0.0, 0.0, -GRAVITY))
    scene = add(world, "scene")
    add(scene, "ambient", "0.5 0.5 0.5 1")
    add(scene, "background", "0.8 0.85 0.9 1")
    light = add(world, "light", type="directional", name="sun")
    add(light, "pose", "0 0 5 0 0 0")
    add(light, "cast_shadows", True)
    add(light, "diffuse", "0.7 0.7 0.7 1")
    add(light, "specular", "0.1 0.1 0.1 1")
    add(light, "direction", "0.3 0.4 -0.9")
    (name, position, quat_xyzw), *_ = camera_poses(geometry)
    camera = add(add(world, "gui"), "camera", name=name)
    _add_pose(camera, position, quat_of(Rotation.from_quat(quat_xyzw) * _CAMERA_AXES))


def _add_pose(parent: ET.Element, position: Vec3, quat_xyzw: QuatXyzw) -> None:
    add(parent, "pose", (*position, *quat_xyzw), rotation_format="quat_xyzw")


def _add_table(world: ET.Element, geometry: SceneGeometry, folder: Path) -> None:
    name, meshes = put_furniture_meshes(geometry, folder)
    model = add(world, "model", name="table")
    add(model, "static", True)
    link = add(model, "link", name="link")
    collision = add(link, "collision", name="top")
    centre, size = table_box(geometry)
    add(collision, "pose", (*centre, 0.0, 0.0, 0.0))
    add(add(add(collision, "geometry"), "box"), "size", size)
    _add_friction(collision, sliding_friction(None))
    _add_visuals(link, meshes, f"../{MESH_FOLDER}/{name}", 1.0)


def _add_link(model: ET.Element, placed: PlacedProp, meshes: MeshFiles, root: str, *, is_seen: bool) -> None:
    """Adds the link of an object; ``root`` is the folder of the export, relative to the file."""
    folder, mass = f"{root}/{MESH_FOLDER}/{placed.prop.name}", placed.mass
    link = add(model, "link", name="link")
    inertial = add(link, "inertial")
    add(inertial, "pose", (*mass.center_of_mass, 0.0, 0.0, 0.0))
    add(inertial, "mass", mass.mass)
    inertia = add(inertial, "inertia")
    (xx, xy, xz), (_, yy, yz), (_, _, zz) = mass.inertia.tolist()
    for name, value in {"ixx": xx, "ixy": xy, "ixz": xz, "iyy": yy, "iyz": yz, "izz": zz}.items():
        add(inertia, name, value)
    if is_seen:
        _add_visuals(link, meshes, folder, placed.factor)
    for number, file in enumerate(meshes.collision):
        collision = add(link, "collision", name=f"part_{number}")
        add(_add_mesh(collision, f"{folder}/{file}", placed.factor), "drake:declare_convex")
        _add_friction(collision, sliding_friction(placed))


def _add_visuals(link: ET.Element, meshes: MeshFiles, folder: str, factor: float) -> None:
    for number, visual in enumerate(meshes.visual):
        element = add(link, "visual", name=f"visual_{number}")
        if visual.rgba[3] < 1:
            add(element, "transparency", 1 - visual.rgba[3])
        _add_mesh(element, f"{folder}/{visual.mesh}", factor)  # without a material, that of the MTL file is taken


def _add_mesh(parent: ET.Element, uri: str, factor: float) -> ET.Element:
    mesh = add(add(parent, "geometry"), "mesh")
    add(mesh, "uri", uri)
    if factor != 1.0:
        add(mesh, "scale", [factor] * 3)
    return mesh


def _add_friction(collision: ET.Element, friction: float) -> None:
    coefficients = add(add(collision, "surface"), "friction")
    ode, bullet = add(coefficients, "ode"), add(coefficients, "bullet")
    for element, names in ((ode, ("mu", "mu2")), (bullet, ("friction", "friction2"))):
        for name in names:
            add(element, name, friction)


def _put_model(placed: PlacedProp, meshes: MeshFiles, folder: Path) -> None:
    """Writes the model of an object, if it does not exist."""
    prop = sized_prop(placed.prop, placed.factor)
    path = folder / prop.name / "model.sdf"
    if path.exists():
        return
    path.parent.mkdir(parents=True, exist_ok=True)
    write_file_atomically(path.with_name("model.config"), document(_config(prop)))
    root = ET.Element("sdf", {"version": _VERSION, **_NAMESPACES})
    _add_link(add(root, "model", name=prop.name), placed, meshes, "../..", is_seen=True)
    write_file_atomically(path, document(root))


def _config(prop: Prop) -> ET.Element:
    root = ET.Element("model")
    add(root, "name", prop.name)
    add(root, "version", "1.0")
    add(root, "sdf", "model.sdf", version=_VERSION)
    known = prop.annotation
    author = None if known is None else known.raw.get("author")
    add(add(root, "author"), "name", _plain(author or "unknown"))
    licence = None if known is None else known.licence
    add(root, "description", _plain(f"{prop.category}; asset {prop.asset_id}; licence {licence or 'unknown'}"))
    return root


def _plain(text: object) -> str:
    """Text on one line, without characters that XML does not allow."""
    return " ".join("".join(c if c.isprintable() else " " for c in str(text)).split())
