"""Watches the free bodies of a MuJoCo scene file in its own physics: which of them stay where the file puts them.

Robots and other joints are held where they are, because nothing controls them here.
"""

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import Rotation

from stable_data.errors import MeshError
from stable_data.geometry.mass_properties import mass_properties
from stable_data.geometry.mesh import join_meshes
from stable_data.importers.mjcf_files import compile_model
from stable_data.importers.scenes.mjcf_scenes import MjcfScene
from stable_data.importers.scenes.scene_file import BodyPose, SceneFile
from stable_data.limits import LIMITS, at_most
from stable_data.rotations import quat_of, wxyz
from stable_data.scene import FloatArray
from stable_data.simulation.collision_bodies import DENSITY
from stable_data.simulation.mujoco_import import mujoco, without_log_file
from stable_data.simulation.settling import MOVE_LIMIT, TURN_LIMIT, PhysicsOptions, has_exploded, hull_volume

WATCH_SECONDS = 4.0
"""How long a file is watched: as long as the verdict ``stable`` of this library."""

_SAMPLE_SECONDS = 0.02


@dataclass(frozen=True, slots=True)
class BodyMotion:
    """How a body moved.

    Attributes:
        move: Largest distance from its start, metres; infinite if the simulation diverged.
        turn: Largest rotation from its start, degrees; likewise.
        end: Its last pose.
    """

    move: float
    turn: float
    end: BodyPose

    @property
    def is_at_rest(self) -> bool:
        """Whether it stayed within the limits of a stable scene."""
        return self.move <= MOVE_LIMIT and self.turn <= TURN_LIMIT


def watch_file(
    scene: MjcfScene, model: mujoco.MjModel | None = None, qpos: FloatArray | None = None, seconds: float = WATCH_SECONDS
) -> Mapping[str, BodyMotion]:
    """Simulates a scene file and watches its free bodies.

    Args:
        scene: The file.
        model: Another version of its model, such as that of the repaired file.
        qpos: Its joint positions; None: those of the scene.
        seconds: Simulated time.

    Returns:
        Name of each free body -> its motion.
    """
    model = scene.model if model is None else model
    data = mujoco.MjData(model)
    if scene.key >= 0:
        mujoco.mj_resetDataKeyframe(model, data, scene.key)
    return _watch(model, data, scene.qpos if qpos is None else qpos, scene.free_bodies, seconds)


def watch_shapes(file: SceneFile, poses: Mapping[str, BodyPose], seconds: float = WATCH_SECONDS) -> Mapping[str, BodyMotion]:
    """Simulates the shapes of a scene file of another format in MuJoCo and watches its free bodies.

    Args:
        file: The file.
        poses: Name of a body -> its pose, where it is another one than in the file.
        seconds: Simulated time.

    Returns:
        Name of each free body -> its motion.
    """
    model = model_of_shapes(file, poses)
    data = mujoco.MjData(model)
    free = {body.name: index for index, body in enumerate(file.bodies, 1) if body.is_free}
    return _watch(model, data, np.array(data.qpos), free, seconds)


def model_of_shapes(file: SceneFile, poses: Mapping[str, BodyPose]) -> mujoco.MjModel:
    """Makes a MuJoCo model of the shapes of a scene file; body k + 1 is its body k.

    A body without a mass has the density of this library; friction is that of its verdicts.

    Args:
        file: The file.
        poses: Name of a body -> its pose, where it is another one than in the file.

    Raises:
        MeshError: MuJoCo refuses the model (``model_unreadable``).
    """
    spec = mujoco.MjSpec()
    options = PhysicsOptions()
    spec.option.timestep, spec.option.impratio = options.timestep, options.impratio
    spec.option.cone = mujoco.mjtCone.mjCONE_ELLIPTIC
    geom = spec.default.geom
    geom.friction, geom.solref, geom.condim = list(options.friction), list(options.solref), 4
    geom.solimp = [*options.solimp, 0.5, 2.0]
    for ground in file.grounds:
        spec.worldbody.add_geom(type=mujoco.mjtGeom.mjGEOM_PLANE, size=[0, 0, 1], pos=[0, 0, ground.height])
    for index, body in enumerate(file.bodies, 1):
        position, quat = poses.get(body.name, (body.position, body.quat_xyzw))
        added = spec.worldbody.add_body(pos=list(position), quat=wxyz(quat))
        volumes = [hull_volume(part) for part in body.parts]
        mass = body.mass if body.mass is not None else max(1e-3, DENSITY * sum(volumes))
        if body.is_free:
            added.add_freejoint()
        for k, (part, volume) in enumerate(zip(body.parts, volumes, strict=True)):
            if volume > 0:
                mesh = spec.add_mesh(name=f"{index}_{k}", inertia=mujoco.mjtMeshInertia.mjMESH_INERTIA_CONVEX)
                mesh.uservert = part.vertices.ravel()
                share = mass * volume / sum(volumes)
                added.add_geom(type=mujoco.mjtGeom.mjGEOM_MESH, meshname=mesh.name, mass=share)
        if body.center_of_mass is not None and sum(volumes) > 0:
            tensor = body.inertia
            if tensor is None:  # that of homogeneous parts
                solids = [part for part, volume in zip(body.parts, volumes, strict=True) if volume > 0]
                tensor = mass_properties(join_meshes(solids), mass=mass).inertia
            added.explicitinertial, added.mass, added.ipos = True, mass, body.center_of_mass
            added.fullinertia = [*tensor.diagonal(), tensor[0, 1], tensor[0, 2], tensor[1, 2]]
    return compile_model(spec, file.path)


def _watch(
    model: mujoco.MjModel, data: mujoco.MjData, start: FloatArray, bodies: Mapping[str, int], seconds: float
) -> Mapping[str, BodyMotion]:
    """Simulates a model from joint positions; all joints but those of the given bodies are held."""
    data.qpos[:] = start
    data.qvel[:] = 0.0
    joints = {name: int(model.body_jntadr[body]) for name, body in bodies.items()}
    free = {name: (int(model.jnt_qposadr[joint]), int(model.jnt_dofadr[joint])) for name, joint in joints.items()}
    held_q, held_v = np.ones(model.nq, bool), np.ones(model.nv, bool)
    for q, v in free.values():
        held_q[q : q + 7], held_v[v : v + 6] = False, False
    steps = max(1, round(seconds / model.opt.timestep))
    if steps > LIMITS.scene_file.max_steps:  # a shorter watch would not show what falls slowly
        found = f"its time step of {model.opt.timestep:g} s needs {steps} steps for {seconds:g} s"
        most = at_most(LIMITS.scene_file, "max_steps")
        raise MeshError(f"{found}, expected {most}; use a longer time step", "time_step_too_short")
    stride = max(1, round(_SAMPLE_SECONDS / model.opt.timestep))
    moves, turns = dict.fromkeys(free, 0.0), dict.fromkeys(free, 0.0)
    flags = int(model.opt.disableflags)
    model.opt.disableflags |= mujoco.mjtDisableBit.mjDSBL_AUTORESET
    try:
        with without_log_file():
            for step in range(steps):
                mujoco.mj_step(model, data)
                data.qpos[held_q], data.qvel[held_v] = start[held_q], 0.0
                if step % stride and step + 1 < steps:
                    continue
                if has_exploded(data) or not np.isfinite(data.qpos).all():
                    return {name: BodyMotion(np.inf, np.inf, _pose(start, q)) for name, (q, _) in free.items()}
                for name, (q, _) in free.items():
                    moves[name] = max(moves[name], float(np.linalg.norm(data.qpos[q : q + 3] - start[q : q + 3])))
                    turn = _rotation(data.qpos, q) * _rotation(start, q).inv()
                    turns[name] = max(turns[name], float(np.degrees(turn.magnitude())))
    finally:
        model.opt.disableflags = flags
    return {name: BodyMotion(moves[name], turns[name], _pose(data.qpos, q)) for name, (q, _) in free.items()}


def _rotation(qpos: FloatArray, at: int) -> Rotation:
    w, x, y, z = qpos[at + 3 : at + 7]
    return Rotation.from_quat([x, y, z, w])


def _pose(qpos: FloatArray, at: int) -> BodyPose:
    x, y, z = qpos[at : at + 3].tolist()
    return (x, y, z), quat_of(_rotation(qpos, at))
