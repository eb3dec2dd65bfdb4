"""Exports to MJCF, the format of MuJoCo: a folder for each scene, and the meshes of all scenes beside them.

An export::

    assets/<2 digits>/<content>.obj    a convex part, metres; the visible mesh of an asset, mesh units; or a part of the table, metres
    assets/<2 digits>/<content>.png    a texture of the table, or of an asset
    <scene>/scene.xml

The model is that of the stability verdict (:mod:`stable_data.simulation.mujoco_model`): MuJoCo reads exactly the same numbers
from the file. MuJoCo's own writer is not used, because it rounds to six digits.
"""

import hashlib
from collections.abc import Callable
from pathlib import Path
from typing import Any
from xml.etree import ElementTree as ET

import numpy as np

from stable_data.atomic_files import safe_file_name, write_file_atomically
from stable_data.export.mesh_files import obj_file, png_file
from stable_data.export.xml_elements import add, document, text_of
from stable_data.scene import Scene
from stable_data.simulation.mujoco_import import mujoco
from stable_data.simulation.mujoco_model import VISUAL, engine_spec
from stable_data.simulation.scene_geometry import SceneGeometry
from stable_data.simulation.settling import COLLIDER

ABOUT = """MuJoCo models (MJCF): `<scene>/scene.xml`, which `mujoco.MjModel.from_xml_path` and `python -m mujoco.viewer --mjcf=` open.
Bodies have the names of the instances, and their position is the centre of the object's box; the keyframe `home` contains the poses.
Geoms of group 3 collide and are the convex parts of the objects and the geom `table`; geoms of group 2 are visible, among them the
table with its legs (`table/…`) and a floor and walls around it (`room/…`), which nothing collides with. Masses, inertias, friction and
contact settings are those of the stability verdict. Scenes share the folder `assets`: copy it with them, or export a single scene with
`--scene`."""

MESH_FOLDER = "assets"

_RESERVED = frozenset({MESH_FOLDER, "README.md", "export.json", "Asset_annotation.json"})  # other names in the folder

_GEOM_TYPES = {int(mujoco.mjtGeom.mjGEOM_BOX): "box", int(mujoco.mjtGeom.mjGEOM_MESH): "mesh"}
_INERTIAS = {
    int(mujoco.mjtMeshInertia.mjMESH_INERTIA_CONVEX): "convex",
    int(mujoco.mjtMeshInertia.mjMESH_INERTIA_SHELL): "shell",
}


def scene_path(scene: Scene, out: Path) -> Path:
    """Returns the file of a scene: if it exists, the scene is exported."""
    return out / safe_file_name(scene.scene_id, _RESERVED) / "scene.xml"


def export_scene(geometry: SceneGeometry, out: Path) -> None:
    """Writes a scene, and those of its meshes that do not exist yet, see :class:`~stable_data.export.formats.ExportFormat`.

    Raises:
        MeshError: An object has no solid part, or MuJoCo refuses it.
    """
    spec = engine_spec(geometry)
    folder = out / MESH_FOLDER
    files = {mesh.name: _put_mesh(mesh, folder) for mesh in spec.meshes}
    pictures = {t.name: _put_texture(t, folder) for t in spec.textures if t.type == mujoco.mjtTexture.mjTEXTURE_2D}
    path = scene_path(geometry.scene, out)
    path.parent.mkdir(parents=True, exist_ok=True)
    write_file_atomically(path, document(_model(spec, files, pictures)))


def _put_mesh(mesh: mujoco.MjsMesh, folder: Path) -> str:
    """Writes a mesh under a hash of its numbers, which takes less time than its file, and returns its name in the folder."""
    vertices = np.fromiter(mesh.uservert, np.float32, len(mesh.uservert)).reshape(-1, 3)
    faces = np.fromiter(mesh.userface, np.int64, len(mesh.userface)).reshape(-1, 3)
    uv = np.fromiter(mesh.usertexcoord, np.float32, len(mesh.usertexcoord)).reshape(-1, 2)
    corners = np.fromiter(mesh.userfacetexcoord, np.int64, len(mesh.userfacetexcoord)).reshape(-1, 3)
    named = hashlib.sha256(repr((vertices.shape, faces.shape, uv.shape)).encode())
    for array in (vertices, faces, uv, corners):
        named.update(array.tobytes())
    return _put(named, ".obj", folder, lambda: obj_file(vertices, faces, uv if len(uv) else None, corners))


def _put_texture(texture: mujoco.MjsTexture, folder: Path) -> str:
    """Writes an image under a hash of its pixels, which takes less time than its file, and returns its name in the folder."""
    pixels = np.frombuffer(bytes(texture.data), np.uint8).reshape(texture.height, texture.width, texture.nchannel)
    return _put(hashlib.sha256(repr(pixels.shape).encode() + pixels.tobytes()), ".png", folder, lambda: png_file(pixels))


def _put(named: "hashlib._Hash", suffix: str, folder: Path, content: Callable[[], bytes]) -> str:
    """Writes a file under a hash, if it does not exist, and returns its name in the folder."""
    digest = named.hexdigest()[:24]
    path = folder / digest[:2] / f"{digest}{suffix}"
    if not path.exists():
        path.parent.mkdir(parents=True, exist_ok=True)
        write_file_atomically(path, content())
    return f"{digest[:2]}/{digest}{suffix}"


def _model(spec: mujoco.MjSpec, files: dict[str, str], pictures: dict[str, str]) -> ET.Element:
    root = ET.Element("mujoco", model=spec.modelname)
    add(root, "compiler", angle="radian", meshdir=f"../{MESH_FOLDER}", texturedir=f"../{MESH_FOLDER}")
    option = add(root, "option", timestep=spec.option.timestep, cone="elliptic", impratio=spec.option.impratio)
    # By default versions before 4 give two meshes a single contact point, on which objects creep.
    add(option, "flag", autoreset="disable", multiccd="enable")
    add(root, "statistic", center=spec.stat.center, extent=spec.stat.extent)
    _add_visual(root, spec.visual)
    defaults = add(root, "default")
    for name in (COLLIDER, VISUAL):
        geom = spec.find_default(name).geom
        of_class = add(defaults, "default")
        of_class.set("class", name)
        if name == VISUAL:
            add(of_class, "geom", contype=0, conaffinity=0, group=geom.group, mass=0)
        else:
            contact = {key: getattr(geom, key) for key in ("condim", "friction", "solref", "solimp")}
            add(of_class, "geom", group=geom.group, **contact)
    assets = add(root, "asset")
    for texture in spec.textures:
        if texture.name in pictures:
            add(assets, "texture", name=texture.name, type="2d", file=pictures[texture.name])
            continue
        size = {"width": texture.width, "height": texture.height}
        add(assets, "texture", type="skybox", builtin="gradient", rgb1=texture.rgb1, rgb2=texture.rgb2, **size)
    for material in spec.materials:
        texture = material.textures[mujoco.mjtTextureRole.mjTEXROLE_RGB]
        painted = {"rgba": material.rgba} | ({"texture": texture} if texture else {})
        shine = {key: getattr(material, key) for key in ("specular", "shininess", "emission")}
        add(assets, "material", name=material.name, **painted, **shine)
    for mesh in spec.meshes:
        element = add(assets, "mesh", name=mesh.name, file=files[mesh.name], inertia=_INERTIAS[int(mesh.inertia)])
        if not np.array_equal(mesh.scale, (1.0, 1.0, 1.0)):
            element.set("scale", text_of(mesh.scale))
    _add_world(add(root, "worldbody"), spec)
    for key in spec.keys:
        add(add(root, "keyframe"), "key", name=key.name, qpos=key.qpos)
    return root


def _add_visual(root: ET.Element, visual: Any) -> None:
    element = add(root, "visual")
    light, depth, whole = visual.headlight, visual.map, visual.global_
    add(element, "headlight", ambient=light.ambient, diffuse=light.diffuse, specular=light.specular)
    add(element, "map", znear=depth.znear, zfar=depth.zfar, shadowclip=depth.shadowclip)
    add(element, "quality", shadowsize=visual.quality.shadowsize, offsamples=visual.quality.offsamples)
    add(element, "global", offwidth=whole.offwidth, offheight=whole.offheight)


def _add_world(world: ET.Element, spec: mujoco.MjSpec) -> None:
    for light in spec.worldbody.lights:
        shade = "true" if light.castshadow else "false"
        colours = {"diffuse": light.diffuse, "specular": light.specular, "ambient": light.ambient}
        add(world, "light", directional="true", pos=light.pos, dir=light.dir, castshadow=shade, **colours)
    for camera in spec.worldbody.cameras:
        add(world, "camera", name=camera.name, pos=camera.pos, quat=camera.quat, fovy=camera.fovy)
    for geom in spec.worldbody.geoms:
        _add_geom(world, geom)
    for body in spec.bodies[1:]:
        element = add(world, "body", name=body.name, pos=body.pos, quat=body.quat)
        for joint in body.joints:
            add(element, "freejoint", name=joint.name)
        add(element, "inertial", pos=body.ipos, quat=body.iquat, mass=body.mass, diaginertia=body.inertia)
        for geom in body.geoms:
            _add_geom(element, geom)


def _add_geom(parent: ET.Element, geom: mujoco.MjsGeom) -> None:
    kind = _GEOM_TYPES[int(geom.type)]
    element = add(parent, "geom", name=geom.name, type=kind)
    element.set("class", geom.classname.name)
    for key in ("pos", "quat", "rgba", "group", "friction", "priority"):
        if not np.array_equal(value := getattr(geom, key), getattr(geom.classname.geom, key)):
            element.set(key, text_of(value))  # values of the class are not repeated
    if geom.material:
        element.set("material", geom.material)
    if kind == "mesh":
        element.set("mesh", geom.meshname)
        if geom.classname.name == COLLIDER:
            element.set("mass", text_of(geom.mass))
    else:
        element.set("size", text_of(geom.size))
