"""Exports to MJCF with a file for each object, in the way of robosuite and RoboCasa, and a JSON file with the poses for each scene.

An export::

    objects/<prop>/model.xml                   the prop at its usual size
    objects/<prop>/model_<name>.xml            the prop at another size
    objects/<prop>/collision, visual           its meshes, see :mod:`stable_data.export.mesh_files`, at the usual size
    tables/<table>/model.xml                   the table
    layouts/<scene>.json                       the poses

A file has the body ``object`` in a body without a name, the sites ``bottom_site``, ``top_site`` and ``horizontal_radius_site``
beside it (robosuite), and in it the geom ``reg_bbox`` (RoboCasa); geoms of group 0 collide and those of group 1 are seen.
"""

from pathlib import Path
from xml.etree import ElementTree as ET

from stable_data.atomic_files import safe_file_name, write_file_atomically
from stable_data.export.mesh_files import MeshFiles, put_furniture_meshes, put_prop_meshes
from stable_data.export.props import MassDistribution, PlacedProp, sized_prop
from stable_data.export.scene_files import put_layout, table_box
from stable_data.export.xml_elements import add, document
from stable_data.rotations import wxyz
from stable_data.scene import Scene, Vec3
from stable_data.simulation.scene_geometry import SceneGeometry
from stable_data.simulation.settling import PhysicsOptions

ABOUT = """MJCF objects in the way of robosuite and RoboCasa: `objects/<prop>/model.xml` is an object at its usual size, `model_<name>.xml`
in the same folder at another size; robosuite's `MujocoXMLObject(path, name, duplicate_collision_geoms=False)` and MuJoCo open them.
`layouts/<scene>.json` gives the file and the pose of each object and of the table, with task, relations, verdicts and cameras; a pose
is that of the body `object`, quaternions are xyzw. Mass and inertia are explicit. Copy the folders `objects` and `tables` with the
layouts; a folder of an object is complete."""

_COLLISION, _VISUAL, _REGION = "collision", "visual", "region"


def scene_path(scene: Scene, out: Path) -> Path:
    """Returns the file of a scene: if it exists, the scene is exported."""
    return out / "layouts" / f"{safe_file_name(scene.scene_id)}.json"


def export_scene(geometry: SceneGeometry, out: Path) -> None:
    """Writes a scene, and those of its objects that do not exist yet, see :class:`~stable_data.export.formats.ExportFormat`.

    Raises:
        MeshError: An object has no solid part.
    """
    put_layout(geometry, scene_path(geometry.scene, out), out, "mjcf", _put_object, _put_table)


def _put_object(placed: PlacedProp, geometry: SceneGeometry, folder: Path) -> str:
    """Writes the file of an object, if it does not exist, and returns its path in the folder."""
    prop, sized = placed.prop, sized_prop(placed.prop, placed.factor)
    name = sized.name + ("" if placed.is_seen else "_unseen")
    path = folder / prop.name / ("model.xml" if name == prop.name else f"model_{name}.xml")
    if not path.exists():
        meshes = put_prop_meshes(prop, geometry.store, path.parent)
        if not placed.is_seen:
            meshes = MeshFiles(meshes.collision, ())
        z = sized.size[2]
        model = _model(name, meshes, placed.factor, placed.mass, placed.friction, (0.0, 0.0, z / 2), sized.size)
        write_file_atomically(path, document(model))
    return f"{prop.name}/{path.name}"


def _put_table(geometry: SceneGeometry, folder: Path) -> str:
    """Writes the file of the table, if it does not exist, and returns its path in the folder."""
    name, meshes = put_furniture_meshes(geometry, folder)
    path = folder / name / "model.xml"
    if not path.exists():
        centre, size = table_box(geometry)
        model = _model(name, meshes, 1.0, None, None, centre, size)
        body = model.find(".//body[@name='object']")
        assert body is not None
        add(body, "geom", name="top", type="box", pos=centre, size=[side / 2 for side in size], class_=_COLLISION)
        write_file_atomically(path, document(model))
    return f"{name}/{path.name}"


def _model(
    name: str,
    meshes: MeshFiles,
    factor: float,
    mass: MassDistribution | None,
    friction: Vec3 | None,
    centre: Vec3,
    size: Vec3,
) -> ET.Element:
    """A model of one body.

    Args:
        name: Its name.
        meshes: Its meshes.
        factor: Size relative to the meshes.
        mass: Its mass; None: it does not move.
        friction: Sliding, torsional and rolling coefficients; None: those of the stability verdict.
        centre: Centre of its box, metres.
        size: Its box, metres.
    """
    physics = PhysicsOptions()
    root = ET.Element("mujoco", model=name)
    add(root, "compiler", angle="radian")
    defaults = add(root, "default")
    contact = {"friction": physics.friction, "solref": physics.solref, "solimp": physics.solimp, "condim": 4}
    add(add(defaults, "default", class_=_COLLISION), "geom", group=0, rgba="0.5 0.5 0.5 0", **contact)
    seen = {"group": 1, "contype": 0, "conaffinity": 0, "mass": 0}
    add(add(defaults, "default", class_=_VISUAL), "geom", **seen)
    add(add(defaults, "default", class_=_REGION), "geom", **seen, rgba="0 1 0 0")
    assets = add(root, "asset")
    outer = add(add(root, "worldbody"), "body")
    body = add(outer, "body", name="object")
    if mass is not None:
        axes = wxyz(mass.axes_quat_xyzw)
        add(body, "inertial", pos=mass.center_of_mass, quat=axes, mass=mass.mass, diaginertia=mass.moments)
    scale = {} if factor == 1.0 else {"scale": [factor] * 3}
    textures = {v.texture for v in meshes.visual if v.texture is not None}
    for texture in sorted(textures):
        add(assets, "texture", name=Path(texture).stem, type="2d", file=texture)
    for number, visual in enumerate(meshes.visual):
        own = f"visual_{number}"
        painted = {} if visual.texture is None else {"texture": Path(visual.texture).stem}
        add(assets, "material", name=own, rgba=visual.rgba, specular=0.1, shininess=0.2, **painted)
        add(assets, "mesh", name=own, file=visual.mesh, inertia="shell", **scale)
        add(body, "geom", name=own, type="mesh", mesh=own, material=own, class_=_VISUAL)
    own_friction = {} if friction is None else {"friction": friction, "priority": 1}
    for number, file in enumerate(meshes.collision):
        own = f"part_{number}"
        add(assets, "mesh", name=own, file=file, inertia="convex", **scale)
        add(body, "geom", name=own, type="mesh", mesh=own, class_=_COLLISION, **own_friction)
    half = tuple(side / 2 for side in size)
    add(body, "geom", name="reg_bbox", type="box", pos=centre, size=half, class_=_REGION)
    x, y, z = centre
    sites = {"bottom": (x, y, z - half[2]), "top": (x, y, z + half[2]), "horizontal_radius": (x + half[0], y + half[1], z)}
    for site, position in sites.items():
        add(outer, "site", name=f"{site}_site", pos=position, size=0.005, rgba="0 0 0 0")
    return root
