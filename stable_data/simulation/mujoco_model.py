"""A complete MuJoCo model of a scene: names, appearance, cameras, a ``home`` keyframe.

Collision geometry, contact settings and masses are those of the stability verdict: both use
:func:`stable_data.simulation.settling.spec_of`.
"""

import numpy as np

from stable_data.atomic_files import safe_file_name
from stable_data.geometry.mesh import Mesh, double_areas, drop_unused_vertices
from stable_data.rotations import wxyz
from stable_data.scene import TABLE
from stable_data.simulation.look_meshes import ObjectLook, add_look_material, look_meshes
from stable_data.simulation.mujoco_import import mujoco
from stable_data.simulation.render import (
    View,
    add_camera,
    add_lights,
    add_room,
    object_colour,
    rgba,
    set_lighting,
)
from stable_data.simulation.room import RESTRICTED_ZONE, furnish
from stable_data.simulation.scene_geometry import SceneGeometry
from stable_data.simulation.settling import COLLIDER, compile_spec, spec_of

VISUAL = "visual"
"""Default class of the geoms that are only visible."""

HOME = "home"
"""Name of the keyframe in which every object has its pose in the scene."""

CAMERAS: tuple[View, ...] = ("front", "top")
"""The cameras, named by the side from which they look."""

COLLIDER_GROUP, VISUAL_GROUP = 3, 2
"""Groups of geoms: MuJoCo's viewer hides the first and shows the second."""

SUPPORT = "support"
"""Name of what is seen of the support on which the table lies."""

_RESERVED = frozenset({TABLE, "world", "hand", RESTRICTED_ZONE, SUPPORT})
_FLATTEST = 1e-14  # a face of less area is not visible, m²
_PICTURE = (640, 480)  # default size of the largest picture that can be rendered off screen, pixels


def body_name(instance: str) -> str:
    """Returns the name of an instance in MuJoCo."""
    return safe_file_name(instance, _RESERVED)


def engine_spec(geometry: SceneGeometry, picture: tuple[int, int] = _PICTURE) -> mujoco.MjSpec:
    """Describes a scene for MuJoCo.

    The geom ``table`` is the collider of the verdict. What is seen of the table and its room are geoms that collide with nothing,
    named ``table/…``, ``restricted_zone`` and ``room/…``. Body k + 1 is object k; the body, its free joint and its geoms have the
    object's name (:func:`body_name`); a fixed object has no joint. Mass and inertia of a body are explicit: those that are known of
    its asset, or those that MuJoCo derives from its convex parts.

    Args:
        geometry: The scene with its geometry.
        picture: Width and height of the largest picture that can be rendered off screen, pixels.

    Returns:
        The description, a ``mujoco.MjSpec``.

    Raises:
        MeshError: An object has no solid part, or MuJoCo refuses it.
    """
    spec = spec_of(geometry.bodies, geometry.scene.table)
    spec.modelname = safe_file_name(geometry.scene.scene_id)
    model = compile_spec(spec)  # once before the names are added, to read masses, inertias and hulls from it
    for number, mesh in enumerate(spec.meshes):
        # The convex hull that MuJoCo made: exported files then have faces and still give exactly the same model.
        start = model.mesh_faceadr[number]
        mesh.userface = model.mesh_face[start : start + model.mesh_facenum[number]].ravel()
    visual = spec.add_default(VISUAL, spec.default)
    spec.find_default(COLLIDER).geom.group, visual.geom.group = COLLIDER_GROUP, VISUAL_GROUP
    visual.geom.contype, visual.geom.conaffinity, visual.geom.mass = 0, 0, 0.0
    spec.geom(TABLE).group = COLLIDER_GROUP
    meshes: dict[object, str] = {}
    for k, o in enumerate(geometry.scene.objects):
        body, name = spec.bodies[k + 1], body_name(o.instance)
        body.explicitinertial, body.mass = True, model.body_mass[k + 1]
        body.fullinertia = [np.nan, 0, 0, 0, 0, 0]  # not given, because MuJoCo takes only one form of the inertia
        body.ipos, body.iquat, body.inertia = model.body_ipos[k + 1], model.body_iquat[k + 1], model.body_inertia[k + 1]
        body.name = name
        for joint in body.joints:  # a fixed object has none
            joint.name = name
        for number, geom in enumerate(body.geoms):
            geom.name, geom.group = f"{name}/part_{number}", COLLIDER_GROUP
        if not geometry.is_seen(k):
            continue
        look = None if geometry.meshes[k] is None else geometry.look(k)
        if look is None or not _add_look(spec, body, visual, look, name, (o.asset_id, look.scale), meshes):
            _add_visuals(spec, body, visual, geometry, k, meshes)
    _add_environment(spec, geometry, picture)
    spec.add_key(name=HOME, qpos=model.qpos0)
    return spec


def _add_look(
    spec: mujoco.MjSpec,
    body: mujoco.MjsBody,
    visual: mujoco.MjsDefault,
    look: ObjectLook,
    owner: str,
    asset: object,
    meshes: dict[object, str],
) -> bool:
    """Adds a look with its textures to a body; returns whether there is anything to see."""
    found = look_meshes(look.surfaces)
    for number, mesh in enumerate(found):
        name = f"{owner}/visual_{number}" if number else f"{owner}/visual"
        key = (asset, number)
        if key not in meshes:  # objects of one asset share its look
            meshes[key] = name
            corners = np.arange(3 * len(mesh.faces), dtype=np.int32)
            uv = {} if mesh.corner_uv is None else {"usertexcoord": mesh.corner_uv.ravel(), "userfacetexcoord": corners}
            spec.add_mesh(
                name=name,
                uservert=mesh.vertices.ravel(),
                userface=mesh.faces.ravel(),
                scale=list(look.scale),
                inertia=mujoco.mjtMeshInertia.mjMESH_INERTIA_SHELL,
                **uv,
            )
            if mesh.pixels is not None:
                add_look_material(spec, mesh, name)
        body.add_geom(
            visual,
            name=name,
            type=mujoco.mjtGeom.mjGEOM_MESH,
            meshname=meshes[key],
            pos=list(look.offset),
            quat=wxyz(look.tilt_quat_xyzw),
            **({"rgba": list(mesh.rgba)} if mesh.pixels is None else {"material": meshes[key]}),
        )
    return bool(found)


def _add_visuals(
    spec: mujoco.MjSpec,
    body: mujoco.MjsBody,
    visual: mujoco.MjsDefault,
    geometry: SceneGeometry,
    index: int,
    meshes: dict[object, str],
) -> None:
    """Adds the visible mesh of an object, or its transparent box if there is no mesh."""
    o, mesh, name = geometry.scene.objects[index], geometry.meshes[index], f"{body.name}/visual"
    if mesh is not None and o.scale is not None:
        is_visible = double_areas(Mesh(mesh.vertices * o.scale, mesh.faces)) > 2 * _FLATTEST
        colours = [(colour, seen) for colour, rows in geometry.paint(index) if len(seen := rows[is_visible[rows]])]
        for number, (colour, rows) in enumerate(colours):
            own = f"{name}_{number}" if number else name
            key = (o.asset_id, o.scale, colour)
            if key not in meshes:  # objects of one asset share its visible mesh
                meshes[key] = own
                vertices, faces = drop_unused_vertices(mesh.vertices, mesh.faces[rows])
                inertia = mujoco.mjtMeshInertia.mjMESH_INERTIA_SHELL  # a visible mesh may be open or flat
                spec.add_mesh(name=own, uservert=vertices.ravel(), userface=faces.ravel(), scale=list(o.scale), inertia=inertia)
            body.add_geom(
                visual,
                name=own,
                type=mujoco.mjtGeom.mjGEOM_MESH,
                meshname=meshes[key],
                pos=geometry.offset(index).tolist(),
                quat=wxyz(o.tilt_quat_xyzw),
                rgba=rgba(colour),
            )
        if colours:
            return
    half = (np.maximum(o.size, 2e-4) / 2).tolist()  # MuJoCo refuses a box without thickness
    body.add_geom(visual, name=name, type=mujoco.mjtGeom.mjGEOM_BOX, size=half, rgba=rgba(object_colour(o), 0.45))


def _add_environment(spec: mujoco.MjSpec, geometry: SceneGeometry, picture: tuple[int, int]) -> None:
    """Adds table, room, lights, background and cameras."""
    (low, high), table, support, visual = (
        geometry.seen_bounds,
        geometry.scene.table,
        geometry.support,
        spec.find_default(VISUAL),
    )
    if support is not None:
        _add_look(spec, spec.worldbody, visual, support, SUPPORT, SUPPORT, {})
    add_room(spec, furnish(table, low, high, None if support is None else support.bounds), visual)
    set_lighting(spec, picture)
    add_lights(spec, low, high)
    for view in CAMERAS:
        add_camera(spec, low, high, view, picture, table, view)
