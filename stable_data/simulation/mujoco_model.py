"""A scene for the physics engine as a person would want it: names, looks, cameras, a ``home`` keyframe.

What collides, how and with what mass is what the stability verdict was given, not another reading of it: the same
:func:`stable_data.simulation.settling.spec_of`.
"""

import numpy as np

from stable_data.atomic_files import safe_file_name
from stable_data.geometry.mesh import Mesh, double_areas, drop_unused_vertices
from stable_data.rotations import wxyz
from stable_data.scene import TABLE
from stable_data.simulation.mujoco_import import mujoco
from stable_data.simulation.render import (
    SINK_COLOUR,
    SINK_RISE,
    TABLE_COLOUR,
    View,
    add_camera,
    add_lights,
    object_colour,
    rgba,
    scene_bounds,
    set_lighting,
)
from stable_data.simulation.scene_geometry import SceneGeometry
from stable_data.simulation.settling import COLLIDER, compile_spec, spec_of

VISUAL = "visual"
"""Default class of the geoms that are only seen."""

HOME = "home"
"""Name of the keyframe in which every object is where the scene has it."""

CAMERAS: tuple[View, ...] = ("front", "top")
"""The cameras: each has the name of where it looks from."""

COLLIDER_GROUP, VISUAL_GROUP = 3, 2
"""Groups of geoms: the engine's viewer shows the second and hides the first."""

_RESERVED = frozenset({TABLE, "world", "hand", "restricted_zone"})
_FLATTEST = 1e-14  # a face of less area is not seen, m²
_PICTURE = (640, 480)  # the largest that is drawn off screen, where nobody says otherwise


def body_name(instance: str) -> str:
    """The name that an instance has in the engine."""
    return safe_file_name(instance, _RESERVED)


def engine_spec(solid: SceneGeometry, picture: tuple[int, int] = _PICTURE) -> mujoco.MjSpec:
    """A scene as a description for the engine.

    Body k + 1 is object k, and it, its free joint and its geoms have its name (:func:`body_name`). Mass and inertia of a body
    are written out, as the engine finds them from its convex parts.

    Args:
        solid: The scene with its geometry.
        picture: Width and height of the largest picture that can be drawn off screen, pixels.

    Returns:
        The description, a ``mujoco.MjSpec``.

    Raises:
        MeshError: An object has no solid part, or the engine refuses it.
    """
    spec = spec_of(solid.bodies, solid.scene.table)
    spec.modelname = safe_file_name(solid.scene.scene_id)
    model = compile_spec(spec)
    for number, mesh in enumerate(spec.meshes):
        # The hull as the engine made it, so that files of it have faces and still give the same model to the last bit.
        start = model.mesh_faceadr[number]
        mesh.userface = model.mesh_face[start : start + model.mesh_facenum[number]].ravel()
    visual = spec.add_default(VISUAL, spec.default)
    spec.find_default(COLLIDER).geom.group, visual.geom.group = COLLIDER_GROUP, VISUAL_GROUP
    visual.geom.contype, visual.geom.conaffinity, visual.geom.mass = 0, 0, 0.0
    table = spec.geom(TABLE)
    table.group, table.rgba = VISUAL_GROUP, rgba(TABLE_COLOUR)
    meshes: dict[object, str] = {}
    for k, o in enumerate(solid.scene.objects):
        body, name = spec.bodies[k + 1], body_name(o.instance)
        body.explicitinertial, body.mass = True, model.body_mass[k + 1]
        body.ipos, body.iquat, body.inertia = model.body_ipos[k + 1], model.body_iquat[k + 1], model.body_inertia[k + 1]
        body.name = body.joints[0].name = name
        for number, geom in enumerate(body.geoms):
            geom.name, geom.group = f"{name}/part_{number}", COLLIDER_GROUP
        _add_looks(spec, body, visual, solid, k, meshes)
    _add_surroundings(spec, solid, picture)
    spec.add_key(name=HOME, qpos=model.qpos0)
    return spec


def _add_looks(
    spec: mujoco.MjSpec,
    body: mujoco.MjsBody,
    visual: mujoco.MjsDefault,
    solid: SceneGeometry,
    index: int,
    meshes: dict[object, str],
) -> None:
    """The mesh of an object as it is seen, or its box, see-through, where there is none."""
    o, mesh, name = solid.scene.objects[index], solid.meshes[index], f"{body.name}/visual"
    if mesh is not None and o.scale is not None:
        is_seen = double_areas(Mesh(mesh.vertices * o.scale, mesh.faces)) > 2 * _FLATTEST
        coats = [(colour, seen) for colour, rows in solid.paint(index) if len(seen := rows[is_seen[rows]])]
        for number, (colour, rows) in enumerate(coats):
            own = f"{name}_{number}" if number else name
            key = (o.asset_id, o.scale, colour)
            if key not in meshes:  # objects of one asset share its looks
                meshes[key] = own
                vertices, faces = drop_unused_vertices(mesh.vertices, mesh.faces[rows])
                inertia = mujoco.mjtMeshInertia.mjMESH_INERTIA_SHELL  # what is only seen may be open or flat
                spec.add_mesh(name=own, uservert=vertices.ravel(), userface=faces.ravel(), scale=list(o.scale), inertia=inertia)
            body.add_geom(
                visual,
                name=own,
                type=mujoco.mjtGeom.mjGEOM_MESH,
                meshname=meshes[key],
                pos=solid.offset(index).tolist(),
                quat=wxyz(o.tilt_quat_xyzw),
                rgba=rgba(colour),
            )
        if coats:
            return
    half = (np.maximum(o.size, 2e-4) / 2).tolist()
    body.add_geom(visual, name=name, type=mujoco.mjtGeom.mjGEOM_BOX, size=half, rgba=rgba(object_colour(o), 0.45))


def _add_surroundings(spec: mujoco.MjSpec, solid: SceneGeometry, picture: tuple[int, int]) -> None:
    """Light, background and cameras."""
    low, high = scene_bounds(solid.scene, [Mesh(shape.vertices, shape.faces) for shape in solid.shapes])
    if solid.scene.table.restricted_zone is not None:
        x_min, x_max, y_min, y_max = solid.scene.table.restricted_zone
        spec.worldbody.add_geom(
            spec.find_default(VISUAL),
            name="restricted_zone",
            type=mujoco.mjtGeom.mjGEOM_BOX,
            pos=[(x_min + x_max) / 2, (y_min + y_max) / 2, 0.0],
            size=[(x_max - x_min) / 2, (y_max - y_min) / 2, SINK_RISE],
            rgba=rgba(SINK_COLOUR),
        )
    set_lighting(spec, picture)
    add_lights(spec, low, high)
    for view in CAMERAS:
        add_camera(spec, low, high, view, picture, name=view)
