"""Turns scene files into scenes of this library, and the poses of scenes back into poses of the file's bodies."""

import hashlib
import re
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from stable_data.errors import SceneError
from stable_data.geometry.mesh import Mesh, join_meshes
from stable_data.importers.boundary import asset_id_of
from stable_data.importers.scenes.scene_file import BodyPose, SceneBody, SceneFile
from stable_data.importers.scenes.supports import SceneSurface, find_supports
from stable_data.rotations import heading, quat_of, rotation_matrix, tilt_of, yaw_quat
from stable_data.scene import UPRIGHT, FloatArray, QuatXyzw, Scene, SceneObject, SupportFrame, Tabletop, Vec3

_REACH = 0.3  # metres beside a surface within which things that do not move are obstacles
_ABOVE = 0.5  # metres above the highest object within which they are
_TOUCH = 1e-3  # metres above the surface that a thing must reach to be an obstacle
_NO_NOUNS = frozenset(  # of names, such as ``mug_main`` or ``mug-rigid``
    {"body", "col", "colonly", "convcol", "convcolonly", "geom", "link", "main", "obj", "object", "rigid", "root", "world"}
)
_DIGITS = 9  # decimals of a metre in the hash of a shape


@dataclass(frozen=True, slots=True, eq=False)
class SceneAsset:
    """An asset of a scene file.

    Attributes:
        asset_id: Its identifier, made of its first body's name and a hash of its shape.
        category: Words of the name of its first body.
        mesh: Its convex parts as one mesh, metres, in the frame of the body, moved so that its box is centred on the origin.
        parts: The parts, moved likewise.
        body: The body that it was made of, for mass and friction.
        center: What was moved to the origin, (3,) metres, in the frame of the body.
    """

    asset_id: str
    category: str
    mesh: Mesh
    parts: tuple[Mesh, ...]
    body: SceneBody
    center: Vec3


@dataclass(frozen=True, slots=True, eq=False)
class ImportedScene:
    """A surface of a scene file with what stands on it, as a scene.

    Attributes:
        scene: The scene: free bodies are its objects, what does not move is in ``fixed``. ``source`` states the file and the frame.
        assets: The assets of its objects, by identifier.
    """

    scene: Scene
    assets: Mapping[str, SceneAsset]


def scenes_of_file(file: SceneFile, table: str = "") -> list[ImportedScene]:
    """Makes one scene for each surface of a scene file on which free bodies stand.

    Args:
        file: The scene file.
        table: The body that carries all free bodies; empty: for each the surface below it.

    Raises:
        SceneError: As :func:`~stable_data.importers.scenes.supports.find_supports`.
    """
    surfaces = find_supports(file, table)
    stem = asset_id_of(re.sub(r"\.[^./]+$", "", file.path).replace("/", "__"))
    ids = [stem if k == 0 else f"{stem}__{asset_id_of(surface.owner)}_{k}" for k, surface in enumerate(surfaces)]
    return [_scene_on(file, surface, scene_id) for surface, scene_id in zip(surfaces, ids, strict=True)]


def _scene_on(file: SceneFile, surface: SceneSurface, scene_id: str) -> ImportedScene:
    assets: dict[str, SceneAsset] = {}
    objects: list[SceneObject] = []
    counts: dict[str, int] = {}

    def add(body: SceneBody, parts: Sequence[Mesh]) -> SceneObject:
        own = _asset(body, parts)
        asset = assets.setdefault(own.asset_id, own)
        count = counts.get(asset.category, 0)
        counts[asset.category] = count + 1
        made = _object(f"{len(objects)}_{asset.category}_{count}", body, asset, own.center, surface)
        objects.append(made)
        return made

    of_surface = [body for body in file.bodies if body.name in surface.names]
    highest = max(add(body, body.parts).top for body in of_surface)
    num_objects = len(objects)
    for body in file.bodies:
        if body.name not in surface.names:
            for part in body.parts:
                if _is_near(body, part, surface, highest):
                    add(body, (part,))
    x, y, z = surface.origin
    source = {
        "file": file.path,
        "sha256": file.sha256,
        "bodies": list(surface.names),
        "pose_of": file.pose_of,
        "surface": surface.owner,
        "origin": [x, y, z],
        "yaw": surface.yaw,
    }
    table = Tabletop(_category(surface.owner) or "table", surface.size_xy)
    fixed = frozenset(o.instance for o in objects[num_objects:])
    return ImportedScene(Scene(scene_id, table, tuple(objects), source=source, fixed=fixed), assets)


def fixed_scene(scene_id: str, table: Tabletop, frame: SupportFrame, parts: Sequence[Mesh], category: str) -> ImportedScene:
    """Makes a scene without movable objects: a table with what is in the way there.

    Args:
        scene_id: Its identifier.
        table: The table.
        frame: Where it lies on its support.
        parts: Convex bodies that do not move, metres, in the frame of the table.
        category: Words for what they are a part of.
    """
    surface = SceneSurface("", (0.0, 0.0, 0.0), 0.0, table.size_xy)
    assets: dict[str, SceneAsset] = {}
    objects = []
    for k, part in enumerate(parts):
        body = SceneBody(f"part of a {category.replace('_', ' ')}", (0.0, 0.0, 0.0), UPRIGHT, (part,), is_free=False)
        asset = replace(_asset(body, (part,)), category=category)
        asset = replace(asset, asset_id=asset_id_of(f"{category}_part_{asset.asset_id.rpartition('_')[2]}"))
        assets.setdefault(asset.asset_id, asset)
        objects.append(_object(f"fixed_{category}_{k}", body, asset, asset.center, surface))
    fixed = frozenset(o.instance for o in objects)
    plain = tuple(replace(o, source=None) for o in objects)
    return ImportedScene(Scene(scene_id, table, plain, fixed=fixed, frame=frame), assets)


def _is_near(body: SceneBody, part: Mesh, surface: SceneSurface, highest: float) -> bool:
    """Whether a shape that does not move can be in the way of objects on a surface."""
    points = _to_surface(body.placed(part), surface)
    low, high, size = points.min(axis=0), points.max(axis=0), np.array(surface.size_xy)
    beside = (low[:2] > size + _REACH).any() or (high[:2] < -_REACH).any()
    return bool(not beside and high[2] > _TOUCH and low[2] < highest + _ABOVE)


def _to_surface(points: FloatArray, surface: SceneSurface) -> FloatArray:
    moved: FloatArray = (points - np.array(surface.origin)) @ rotation_matrix(yaw_quat(surface.yaw))
    return moved


def _category(name: str) -> str:
    """The words of a body's name, without numbers."""
    words = [word for word in re.split(r"[^a-z]+", asset_id_of(name).lower()) if len(word) > 1]
    return "_".join(word for word in words if word not in _NO_NOUNS) or "_".join(words) or "body"


def _asset(body: SceneBody, parts: Sequence[Mesh]) -> SceneAsset:
    mesh = join_meshes(parts)
    middle = (mesh.vertices.min(axis=0) + mesh.vertices.max(axis=0)) / 2
    x, y, z = middle.tolist()
    # Bodies of one shape are one asset only if they also weigh the same.
    inertia = None if body.inertia is None else body.inertia.tolist()
    physics = repr((body.is_free, body.mass, body.center_of_mass, inertia, body.friction)).encode()
    digest = hashlib.sha256(np.round(mesh.vertices - middle, _DIGITS).tobytes() + mesh.faces.tobytes() + physics).hexdigest()
    category = _category(body.name)
    centred = tuple(Mesh(part.vertices - middle, part.faces) for part in parts)
    centred_mesh = Mesh(mesh.vertices - middle, mesh.faces)
    return SceneAsset(f"{category}_{digest[:12]}", category, centred_mesh, centred, body, (x, y, z))


def _object(instance: str, body: SceneBody, asset: SceneAsset, center: Vec3, surface: SceneSurface) -> SceneObject:
    """The object of a body whose shape has its centre at a point of the body's frame."""
    frame = Rotation.from_euler("z", surface.yaw)
    rotation = quat_of(frame.inv() * Rotation.from_quat(body.quat_xyzw))
    yaw, _ = heading(rotation)
    origin = _to_surface(np.array(body.position)[None], surface)[0]
    tilt = tilt_of(rotation, yaw)
    middle, size = _tilted_box(asset.mesh, tilt)
    offset = -(middle + rotation_matrix(tilt) @ np.array(center))
    x, y, z = (origin - rotation_matrix(yaw_quat(yaw)) @ offset).tolist()
    start = {"position": [x, y, z], "yaw": yaw, "tilt_quat_xyzw": list(tilt)}
    source: dict[str, Any] = {"body": body.name, "center": list(center), "offset": offset.tolist(), "start": start}
    return SceneObject(
        instance, asset.category, (x, y, z), yaw, size, asset.asset_id, (1.0, 1.0, 1.0), tilt, body.name, source=source
    )


def _tilted_box(mesh: Mesh, tilt: QuatXyzw) -> tuple[FloatArray, Vec3]:
    """Centre (3,) of the box of a tilted mesh, from the centre of the mesh's own box, and its extents."""
    tilted = mesh.vertices @ rotation_matrix(tilt).T
    low, high = tilted.min(axis=0), tilted.max(axis=0)
    x, y, z = (high - low).tolist()
    return np.asarray((low + high) / 2), (x, y, z)


def turned_object(o: SceneObject, mesh: Mesh, rotation: Rotation, pivot: FloatArray) -> SceneObject:
    """Turns an object of an imported scene.

    Args:
        o: The object.
        mesh: Its asset's mesh, metres, its box centred on the origin.
        rotation: The rotation after the present one, in the frame of the scene.
        pivot: The point that stays above its place, (3,) metres, frame of the scene.

    Returns:
        The object with its new tilt; its lowest point is as high as before, but not below the table.
    """
    position, quat = _body_in_scene(o)
    origin = pivot + rotation.apply(np.array(position) - pivot)
    turned = _at_pose(o, mesh, origin, rotation * Rotation.from_quat(quat))
    x, y, _ = turned.position
    return turned.moved((x, y, max(0.0, o.bottom) + turned.size[2] / 2), turned.yaw)


def settled_object(o: SceneObject, mesh: Mesh, scene: Scene, pose: BodyPose) -> SceneObject:
    """Returns an object of an imported scene at another pose of its body.

    Args:
        o: The object.
        mesh: Its asset's mesh, metres, its box centred on the origin.
        scene: The scene, for its frame.
        pose: The pose, in the frame of the file.
    """
    frame = scene_source(scene)
    turn = Rotation.from_euler("z", frame["yaw"]).inv()
    return _at_pose(o, mesh, turn.apply(np.array(pose[0]) - np.array(frame["origin"])), turn * Rotation.from_quat(pose[1]))


def _at_pose(o: SceneObject, mesh: Mesh, origin: FloatArray, rotation: Rotation) -> SceneObject:
    """An object whose body has an origin (3,) and a rotation in the frame of the scene."""
    quat = quat_of(rotation)
    yaw, _ = heading(quat)
    tilt = tilt_of(quat, yaw)
    middle, size = _tilted_box(mesh, tilt)
    offset = -(middle + rotation_matrix(tilt) @ np.array(_source(o)["center"]))
    x, y, z = (origin - rotation_matrix(yaw_quat(yaw)) @ offset).tolist()
    source = {**_source(o), "offset": offset.tolist()}
    return replace(o, position=(x, y, z), yaw=yaw, tilt_quat_xyzw=tilt, size=size, source=source)


def _body_in_scene(o: SceneObject) -> BodyPose:
    """The pose of the body of an object, in the frame of the scene."""
    turn = Rotation.from_euler("z", o.yaw)
    x, y, z = (np.array(o.position) + turn.apply(np.array(_source(o)["offset"]))).tolist()
    return (x, y, z), quat_of(turn * Rotation.from_quat(o.tilt_quat_xyzw))


def has_moved(o: SceneObject) -> bool:
    """Whether an object of an imported scene is at another pose than in its file."""
    start = _source(o)["start"]
    return [list(o.position), o.yaw, list(o.tilt_quat_xyzw)] != [start["position"], start["yaw"], start["tilt_quat_xyzw"]]


def moved_bodies(scenes: Iterable[Scene]) -> dict[str, BodyPose]:
    """Returns the new poses of the bodies that the scenes of one file have moved, in the frame of the file.

    Raises:
        SceneError: A scene was not imported from a scene file (``not_imported``), or an object was removed (``object_dropped``).
    """
    found: dict[str, BodyPose] = {}
    for scene in scenes:
        frame = scene_source(scene)
        there = {_source(o)["body"] for o in scene.objects}
        if lost := [name for name in frame["bodies"] if name not in there]:
            raise SceneError(
                f"{scene.scene_id}: {', '.join(lost)} was removed, which a scene file cannot show, expected all its bodies; correct it "
                "with when_full=infeasible",
                "object_dropped",
            )
        turn, origin = Rotation.from_euler("z", frame["yaw"]), np.array(frame["origin"])
        for o in scene.objects:
            if o.instance not in scene.fixed and has_moved(o):
                position, quat = _body_in_scene(o)
                x, y, z = (origin + turn.apply(np.array(position))).tolist()
                found[_source(o)["body"]] = (x, y, z), quat_of(turn * Rotation.from_quat(quat))
    return found


def scene_source(scene: Scene) -> Mapping[str, Any]:
    """What an imported scene states of its file and its frame.

    Raises:
        SceneError: It was not imported from a scene file (``not_imported``).
    """
    source = scene.source or {}
    if not {"file", "origin", "yaw", "pose_of", "bodies"} <= source.keys():
        raise SceneError(f"{scene.scene_id}: was not read from a scene file, expected one of import scenes", "not_imported")
    return source


def _source(o: SceneObject) -> Mapping[str, Any]:
    source = o.source or {}
    if not {"body", "offset", "start"} <= source.keys():
        raise SceneError(f"object {o.instance}: was not read from a scene file, expected one of import scenes", "not_imported")
    return source
