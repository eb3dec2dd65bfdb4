"""Exports to URDF: a file for each object, and a JSON file with the poses for each scene, because URDF describes a single tree.

An export::

    objects/<prop>/<prop at a size>.urdf       one rigid body
    objects/<prop>/collision, visual           its meshes, see :mod:`stable_data.export.mesh_files`, at the usual size
    tables/<table>/<table>.urdf                the table, in the frame of the world
    scenes/<scene>.json                        the poses
"""

from pathlib import Path
from xml.etree import ElementTree as ET

from stable_data.atomic_files import safe_file_name, write_file_atomically
from stable_data.export.mesh_files import MeshFiles, put_furniture_meshes, put_prop_meshes
from stable_data.export.props import MassDistribution, PlacedProp, sized_prop
from stable_data.export.scene_files import put_layout, sliding_friction, table_box
from stable_data.export.xml_elements import add, document
from stable_data.scene import UPRIGHT, Scene
from stable_data.simulation.collision_bodies import DENSITY
from stable_data.simulation.scene_geometry import SceneGeometry

ABOUT = """URDF: `scenes/<scene>.json` gives the pose of every object and of the table, and the URDF file of each, one rigid body with
mass, full inertia, convex parts as `<collision>` meshes, and visible meshes (OBJ with MTL and PNG). Quaternions are xyzw; a pose is
that of the root link. `fixed` objects do not move; task, relations, verdicts and cameras are in the same file. Friction is in the URDF
for Drake, PyBullet and Gazebo, and in the JSON file for all others. Copy the folders `objects` and `tables` with the scenes."""

_DRAKE = "http://drake.mit.edu"
_UNSEEN_SIDE = 1e-6  # metres


def scene_path(scene: Scene, out: Path) -> Path:
    """Returns the file of a scene: if it exists, the scene is exported."""
    return out / "scenes" / f"{safe_file_name(scene.scene_id)}.json"


def export_scene(geometry: SceneGeometry, out: Path) -> None:
    """Writes a scene, and those of its objects that do not exist yet, see :class:`~stable_data.export.formats.ExportFormat`.

    Raises:
        MeshError: An object has no solid part.
    """
    put_layout(geometry, scene_path(geometry.scene, out), out, "urdf", _put_object, _put_table)


def _put_object(placed: PlacedProp, geometry: SceneGeometry, folder: Path) -> str:
    """Writes the file of an object, if it does not exist, and returns its path in the folder."""
    prop = placed.prop
    name = sized_prop(prop, placed.factor).name + ("" if placed.is_seen else "_unseen")
    path = folder / prop.name / f"{name}.urdf"
    if not path.exists():
        meshes = put_prop_meshes(prop, geometry.store, path.parent)
        robot = _robot(name, meshes, placed.mass, placed.factor, sliding_friction(placed), is_seen=placed.is_seen)
        write_file_atomically(path, document(robot))
    return f"{prop.name}/{path.name}"


def _robot(
    name: str, meshes: MeshFiles, mass: MassDistribution, factor: float, friction: float, *, is_seen: bool = True
) -> ET.Element:
    root = ET.Element("robot", {"name": name, "xmlns:drake": _DRAKE})
    link = add(root, "link", name=name)
    inertial = add(link, "inertial")
    add(inertial, "origin", xyz=mass.center_of_mass, rpy="0 0 0")
    add(inertial, "mass", value=mass.mass)
    (xx, xy, xz), (_, yy, yz), (_, _, zz) = mass.inertia.tolist()
    add(inertial, "inertia", ixx=xx, ixy=xy, ixz=xz, iyy=yy, iyz=yz, izz=zz)
    if not is_seen:  # PyBullet shows the colliders of a link where nothing else is to be seen
        nothing = add(link, "visual", name="nothing")
        add(add(nothing, "geometry"), "box", size=[_UNSEEN_SIDE] * 3)
        add(add(nothing, "material", name="nothing"), "color", rgba=[0.0] * 4)
    for number, visual in enumerate(meshes.visual if is_seen else ()):
        element = add(link, "visual", name=f"visual_{number}")
        _add_mesh(element, visual.mesh, factor)
        if visual.texture is None:  # readers let this colour replace a texture of the MTL file, which has the colour too
            add(add(element, "material", name=f"{name}_{number}"), "color", rgba=visual.rgba)
    for number, file in enumerate(meshes.collision):
        element = add(link, "collision", name=f"part_{number}")
        add(_add_mesh(element, file, factor), "drake:declare_convex")
        _add_friction(element, friction)
    add(add(link, "contact"), "lateral_friction", value=friction)
    gazebo = add(root, "gazebo", reference=name)
    add(gazebo, "mu1", friction)
    add(gazebo, "mu2", friction)
    return root


def _add_mesh(parent: ET.Element, file: str, factor: float) -> ET.Element:
    return add(add(parent, "geometry"), "mesh", filename=file, **({} if factor == 1.0 else {"scale": [factor] * 3}))


def _add_friction(collision: ET.Element, friction: float) -> None:
    drake = add(collision, "drake:proximity_properties")
    add(drake, "drake:mu_static", value=friction)
    add(drake, "drake:mu_dynamic", value=friction)


def _put_table(geometry: SceneGeometry, folder: Path) -> str:
    """Writes the file of the table, if it does not exist, and returns its path in the folder."""
    name, meshes = put_furniture_meshes(geometry, folder)
    path = folder / name / f"{name}.urdf"
    if not path.exists():
        friction = sliding_friction(None)
        root = _robot(name, meshes, _table_mass(geometry), 1.0, friction)
        link = root.find("link")
        assert link is not None
        centre, size = table_box(geometry)
        collision = add(link, "collision", name="top")
        add(collision, "origin", xyz=centre, rpy="0 0 0")
        add(add(collision, "geometry"), "box", size=size)
        _add_friction(collision, friction)
        write_file_atomically(path, document(root))
    return f"{name}/{path.name}"


def _table_mass(geometry: SceneGeometry) -> MassDistribution:
    """The mass of the box that collides: readers ask for one, although the table does not move."""
    centre, (x, y, z) = table_box(geometry)
    mass = DENSITY * x * y * z
    a, b, c = (mass / 12 * (u**2 + v**2) for u, v in ((y, z), (x, z), (x, y)))
    return MassDistribution(mass, centre, (a, b, c), UPRIGHT)
