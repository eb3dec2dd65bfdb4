"""Reads MuJoCo scene files: free bodies are objects, all other bodies are the surroundings.

The shapes are those with which MuJoCo lets bodies collide: primitives, and the convex hulls of meshes. What is only seen does not
count, because a repaired scene must be at rest in MuJoCo.
"""

import functools
import hashlib
import re
from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import Rotation

from stable_data.errors import Notice, SceneError
from stable_data.geometry.mesh import Mesh
from stable_data.importers.boundary import Boundary
from stable_data.importers.mjcf_files import ModelFiles, collect_files, compile_model, read_spec
from stable_data.importers.scenes import convex_solids
from stable_data.importers.scenes.scene_file import Ground, SceneBody, SceneFile, check_shapes
from stable_data.limits import LIMITS, at_most
from stable_data.rotations import quat_of
from stable_data.scene import FloatArray, QuatXyzw, Vec3
from stable_data.simulation.mujoco_import import mujoco, without_log_file

INITIAL = "initial"
"""Stands for the poses that a file states at its bodies, where a keyframe's name is expected."""

_MOST_QUATS = 16  # other rotations of a body that are kept
_HOME = "home"  # the keyframe that is used if a file has it
_LEVEL = np.cos(np.radians(0.1))  # least vertical component of the normal of a level plane


@dataclass(frozen=True, slots=True, eq=False)
class MjcfScene:
    """A MuJoCo scene file, compiled.

    Attributes:
        file: What it holds.
        files: Its files.
        model: The model.
        qpos: The joint positions of the poses.
        key: Index of the keyframe of the poses; -1 for the initial poses.
        free_bodies: Name of each free body -> its index in the model.
    """

    file: SceneFile
    files: ModelFiles
    model: mujoco.MjModel
    qpos: FloatArray
    key: int
    free_bodies: dict[str, int]

    def address(self, name: str) -> int:
        """Where the pose of a free body begins in the joint positions."""
        return int(self.model.jnt_qposadr[self.model.body_jntadr[self.free_bodies[name]]])


def read_mjcf_scene(boundary: Boundary, path: str, key: str = "") -> MjcfScene:
    """Reads a MuJoCo scene file.

    Args:
        boundary: The source folder.
        path: The file, relative to it.
        key: Keyframe of the poses, by its name or as ``#`` with its number, or ``initial``; empty: the keyframe ``home`` if there is
            one, else the initial poses.

    Raises:
        MeshError: The files cannot be read, or MuJoCo refuses them.
        SceneError: There is no such keyframe (``key_unknown``), no free body collides with anything (``no_free_body``), or gravity is
            not along -z (``gravity_odd``), poses are not finite (``not_finite``), or it is too large (``file_too_large``).
    """
    files = collect_files(boundary, path)
    with files.placed() as place:
        model = compile_model(read_spec(place, path), path)
    num_free = int((model.jnt_type == mujoco.mjtJoint.mjJNT_FREE).sum())
    sizes = {"max_memory_bytes": model.narena, "max_free_bodies": num_free, "max_poses": model.nkey}
    for limit, count in sizes.items():
        if count > getattr(LIMITS.scene_file, limit):
            said, most = limit.removeprefix("max_").replace("_", " "), at_most(LIMITS.scene_file, limit)
            raise SceneError(f"{path}: has {count} {said}, expected {most}; divide it", "file_too_large")
    x, y, z = model.opt.gravity
    if z >= 0 or max(abs(x), abs(y)) > 0.01 * abs(z):
        raise SceneError(f"{path}: gravity is {x:g} {y:g} {z:g}, expected downwards, along -z; turn the scene", "gravity_odd")
    number, pose_of = _keyframe(model, path, key)
    data = mujoco.MjData(model)
    if number >= 0:
        mujoco.mj_resetDataKeyframe(model, data, number)
    with without_log_file():
        mujoco.mj_kinematics(model, data)
        mujoco.mj_comPos(model, data)
    if not (np.isfinite(data.xpos).all() and np.isfinite(data.xquat).all()):
        raise SceneError(f"{path}: poses of {pose_of} are not finite, expected numbers; correct them", "not_finite")
    notices: list[Notice] = []
    free = _free_bodies(model, path, notices)
    bodies = tuple(_bodies(model, data, free, path, notices))
    names = {body.name for body in bodies}
    free = {name: index for name, index in free.items() if name in names}
    if not free:
        found = "has no free body with a shape that collides, expected objects with a free joint"
        raise SceneError(f"{path}: {found}; is it part of another file?", "no_free_body")
    digest = hashlib.sha256()
    for name in sorted(files.contents):
        digest.update(name.encode() + b"\0" + hashlib.sha256(files.contents[name]).digest())
    grounds = tuple(_grounds(model, data))
    file = SceneFile(path, digest.hexdigest(), pose_of, bodies, grounds, tuple(notices))
    return MjcfScene(file, files, model, np.array(data.qpos), number, free)


def _keyframe(model: mujoco.MjModel, path: str, key: str) -> tuple[int, str]:
    """Index and name of the keyframe of the poses; -1 and ``initial`` for the initial poses."""
    names = [model.key(k).name for k in range(model.nkey)]
    wanted = key or (_HOME if _HOME in names else INITIAL)
    if re.fullmatch(r"#\d+", wanted) and int(wanted[1:]) < len(names):
        return int(wanted[1:]), wanted
    if wanted in names:
        return names.index(wanted), wanted
    if wanted != INITIAL:
        there = ", ".join(n for n in names if n) or "none"
        raise SceneError(f"{path}: no keyframe {wanted!r}, expected one of its own ({there}) or {INITIAL}", "key_unknown")
    return -1, INITIAL


def body_name(model: mujoco.MjModel, index: int) -> str:
    """The name of a body, or ``#`` with its index if it has none."""
    return model.body(index).name or f"#{index}"


def _free_bodies(model: mujoco.MjModel, path: str, notices: list[Notice]) -> dict[str, int]:
    """Bodies with a free joint that nothing holds."""
    held = {
        int(body)
        for kind, *pair in zip(model.eq_type, model.eq_obj1id, model.eq_obj2id, strict=True)
        if int(kind) in (int(mujoco.mjtEq.mjEQ_WELD), int(mujoco.mjtEq.mjEQ_CONNECT))
        for body in pair
    }
    driven = {
        int(model.jnt_bodyid[pair[0]])
        for kind, pair in zip(model.actuator_trntype, model.actuator_trnid, strict=True)
        if int(kind) == int(mujoco.mjtTrn.mjTRN_JOINT)
    }
    found = {}
    for joint in np.flatnonzero(model.jnt_type == mujoco.mjtJoint.mjJNT_FREE):
        index = int(model.jnt_bodyid[joint])
        name = body_name(model, index)
        members = np.flatnonzero(model.body_rootid == index)
        moving = [m for m in members if model.body_jntnum[m] and m != index]
        if not held.isdisjoint(members.tolist()):
            notices.append(
                Notice(path, "find", "body_held", f"{path}: {name} is held by an equality constraint; it counts as fixed")
            )
        elif not driven.isdisjoint(members.tolist()):
            notices.append(Notice(path, "find", "body_driven", f"{path}: {name} has motors, as a robot; it counts as fixed"))
        else:
            found[name] = index
            if moving:
                message = f"{path}: {name} has {len(moving)} parts on joints; it is moved as one piece, its joints as they are"
                notices.append(Notice(path, "find", "articulated", message))
    return found


def _bodies(
    model: mujoco.MjModel, data: mujoco.MjData, free: dict[str, int], path: str, notices: list[Notice]
) -> Iterator[SceneBody]:
    """The bodies that collide: free ones with all that hangs on them, the others one by one."""
    of_root = {index: name for name, index in free.items()}
    parts: dict[int, list[Mesh]] = {}
    collides = (model.geom_contype != 0) | (model.geom_conaffinity != 0)
    shapes = _Shapes(model)
    without_volume = set[int]()
    num_faces = hfields = 0
    for geom in np.flatnonzero(collides):
        body = int(model.geom_bodyid[geom])
        owner = int(model.body_rootid[body]) if int(model.body_rootid[body]) in of_root else body
        hfields += model.geom_type[geom] == mujoco.mjtGeom.mjGEOM_HFIELD
        try:
            mesh = shapes.of_geom(int(geom))
        except SceneError as error:
            raise SceneError(f"{path}: {body_name(model, body)}: {error}", error.code) from error
        is_mesh = int(model.geom_type[geom]) == int(mujoco.mjtGeom.mjGEOM_MESH)
        if mesh is None and is_mesh and body not in without_volume:
            without_volume.add(body)
            message = f"{path}: a mesh of {body_name(model, body)} has no volume; it is no obstacle"
            notices.append(Notice(path, "read", "mesh_empty", message))
        if mesh is not None:
            num_faces += len(mesh.faces)
            check_shapes(path, faces=num_faces)
            turn = data.xmat[owner].reshape(3, 3)
            placed = mesh.vertices @ data.geom_xmat[geom].reshape(3, 3).T + data.geom_xpos[geom]
            parts.setdefault(owner, []).append(Mesh((placed - data.xpos[owner]) @ turn, mesh.faces))
    if hfields:
        notices.append(
            Notice(path, "read", "height_field", f"{path}: {hfields} height fields are not read; they are no obstacles")
        )
    for owner, name in of_root.items():
        if owner not in parts:
            message = f"{path}: {name} has a free joint, but nothing of it collides; it is left as it is"
            notices.append(Notice(path, "read", "no_collider", message))
    for owner in sorted(parts):
        is_free = owner in of_root
        position, quat = _vec3(data.xpos[owner]), _xyzw(data.xquat[owner])
        if not is_free:
            yield SceneBody(body_name(model, owner), position, quat, tuple(parts[owner]), is_free=False)
            continue
        mass, com, inertia = _inertial(model, data, owner)
        geoms = np.flatnonzero(collides & (model.body_rootid[model.geom_bodyid] == owner))
        friction = _vec3(model.geom_friction[geoms].max(axis=0))
        known = _known_quats(model, owner, quat)
        yield SceneBody(of_root[owner], position, quat, tuple(parts[owner]), True, mass, com, inertia, friction, known)


class _Shapes:
    """The convex shapes of geoms; each is made once, however many geoms have it."""

    def __init__(self, model: mujoco.MjModel) -> None:
        self.model = model
        self.known: dict[tuple[int, int, bytes], Mesh | None] = {}

    def of_geom(self, geom: int) -> Mesh | None:
        """The shape of a geom in its own frame; None for what is no solid."""
        model = self.model
        key = int(model.geom_type[geom]), int(model.geom_dataid[geom]), bytes(model.geom_size[geom])
        if key not in self.known:
            self.known[key] = _geom_mesh(model, geom)
        return self.known[key]


def _geom_mesh(model: mujoco.MjModel, geom: int) -> Mesh | None:
    """The convex shape of a geom in its own frame; None for what is no solid."""
    kinds, size = mujoco.mjtGeom, np.array(model.geom_size[geom], np.float64)
    kind = mujoco.mjtGeom(int(model.geom_type[geom]))
    if kind == kinds.mjGEOM_BOX:
        return convex_solids.box(size)
    if kind == kinds.mjGEOM_SPHERE:
        return convex_solids.ellipsoid(np.repeat(size[:1], 3))
    if kind == kinds.mjGEOM_ELLIPSOID:
        return convex_solids.ellipsoid(size)
    if kind == kinds.mjGEOM_CYLINDER:
        return convex_solids.cylinder(float(size[0]), float(size[1]))
    if kind == kinds.mjGEOM_CAPSULE:
        return convex_solids.capsule(float(size[0]), float(size[1]))
    if kind in (kinds.mjGEOM_MESH, kinds.mjGEOM_SDF):
        mesh = int(model.geom_dataid[geom])
        first, count = int(model.mesh_vertadr[mesh]), int(model.mesh_vertnum[mesh])
        return convex_solids.hull_of(np.array(model.mesh_vert[first : first + count], np.float64))
    return None


def _grounds(model: mujoco.MjModel, data: mujoco.MjData) -> Iterator[Ground]:
    name_of = functools.cache(functools.partial(body_name, model))  # a body may have a long name and very many planes
    for geom in np.flatnonzero(model.geom_type == mujoco.mjtGeom.mjGEOM_PLANE):
        collides = model.geom_contype[geom] or model.geom_conaffinity[geom]
        if collides and data.geom_xmat[geom][8] >= _LEVEL:
            yield Ground(name_of(int(model.geom_bodyid[geom])), float(data.geom_xpos[geom][2]))


def _inertial(model: mujoco.MjModel, data: mujoco.MjData, root: int) -> tuple[float, Vec3, FloatArray]:
    """Mass, centre of mass and inertia of a body with all that hangs on it, in its frame."""
    members = np.flatnonzero(model.body_rootid == root)
    masses = model.body_mass[members]
    total = float(masses.sum())
    centre = data.subtree_com[root]
    inertia, turn = np.zeros((3, 3)), data.xmat[root].reshape(3, 3)
    with np.errstate(over="ignore", invalid="ignore"):  # what is not finite then is refused with the pose of the body
        for m, mass in zip(members, masses, strict=True):
            axes, apart = data.ximat[m].reshape(3, 3), data.xipos[m] - centre
            inertia += axes @ np.diag(model.body_inertia[m]) @ axes.T
            inertia += mass * (apart @ apart * np.eye(3) - np.outer(apart, apart))
        return total, _vec3((centre - data.xpos[root]) @ turn), turn.T @ inertia @ turn


def _known_quats(model: mujoco.MjModel, body: int, present: QuatXyzw) -> tuple[QuatXyzw, ...]:
    """Other rotations that the file states for a free body: in its keyframes and at the body itself."""
    at = int(model.jnt_qposadr[model.body_jntadr[body]]) + 3
    stated = np.vstack([model.qpos0[None], model.key_qpos])[:, at : at + 4]
    _, first = np.unique(stated, axis=0, return_index=True)
    found: list[QuatXyzw] = []
    for quat in stated[np.sort(first)]:
        norm = np.linalg.norm(quat)
        if norm > 1e-9 and len(found) < _MOST_QUATS:
            other = _xyzw(quat / norm)
            if all((Rotation.from_quat(other) * Rotation.from_quat(q).inv()).magnitude() > 1e-3 for q in (present, *found)):
                found.append(other)
    return tuple(found)


def _vec3(values: Sequence[float] | FloatArray) -> Vec3:
    x, y, z = (float(v) for v in values)
    return x, y, z


def _xyzw(wxyz: FloatArray) -> QuatXyzw:
    w, x, y, z = (float(v) for v in wxyz)
    return quat_of(Rotation.from_quat([x, y, z, w]))
