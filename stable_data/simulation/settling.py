"""Settles a scene in MuJoCo, watches it, and judges whether its objects stayed at their poses.

Colliders are the convex parts of the objects; the table is a box whose top is z = 0. World frame, metres, kilograms, seconds.
"""

import hashlib
import struct
from collections import deque
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import lru_cache

import numpy as np
import numpy.typing as npt

from stable_data.errors import MeshError
from stable_data.geometry.mesh import Mesh
from stable_data.rotations import wxyz, yaw_quat
from stable_data.scene import TABLE, FloatArray, QuatXyzw, Tabletop, Vec3
from stable_data.simulation.mujoco_import import mujoco, without_log_file

MOVE_LIMIT = 0.010
"""Largest movement of an object in a stable scene, from its start at any time, metres."""

TURN_LIMIT = 5.0
"""Largest rotation of an object in a stable scene, from its start at any time, degrees."""

DRIFT_LIMIT = 0.050
"""Largest movement of an object in a stable scene after the settling, metres."""

COLLIDER = "collider"
"""Default class of the geoms that collide, in a MuJoCo model."""

TABLE_DEPTH = 0.1
"""Thickness of the box that is the table's collider, below z = 0, metres."""

GRAVITY = 9.81
"""Acceleration of gravity, along -z, m/s²."""

_JITTER_SECONDS = 1.0
_REST_SECONDS = 0.1
_TURN_ARM = 0.05  # metres; turning counts as the speed of a point at this distance
# A simulation ends early by the movement of the objects in this time, if all are within this share of the limits: an object that
# creeps may suddenly slip by a few millimetres.
_CALM_SECONDS, _CALM_SHARE = 0.2, 0.5
# In this time after the start contacts take up the weights; that is no movement that becomes slower.
_IMPACT_SECONDS = 0.1
_MAX_CACHED_BYTES = 64 * 2**20  # hulls that MuJoCo keeps for further models: about 5,000
_FLATTEST = 1e-6  # parts thinner than this share of their length (or 1 µm) have no volume to collide with, and are left out


@dataclass(frozen=True, slots=True)
class PhysicsOptions:
    """Settings of MuJoCo. The defaults are those of the stability verdict.

    Attributes:
        timestep: Seconds.
        settle_seconds: Longest time of settling.
        watch_seconds: How long the scene is watched after settling.
        sample_seconds: Interval between samples of the poses.
        rest_speed: Settling ends early if no object moved faster than this for a tenth of a second, metres a second (0: never).
            Turning counts as the speed of a point 5 cm away.
        friction: Sliding, torsional (metres) and rolling (metres) coefficients of every contact of bodies without their own.
        solref: Time constant (seconds) and damping ratio of contacts.
        solimp: Impedance of contacts at depth 0 and beyond the width, and the width (metres).
        impratio: Ratio of the stiffness of friction to that of the normal direction; it prevents creeping with elliptic cones.
        sleep_speed: In the watch, objects slower than this, metres a second, are not simulated, with all that they touch, until
            another object touches them (0: all are simulated). They could creep a third of a millimetre in the watch.
        rest_move: Settling and watch end early if the objects, as they moved in the last fifth of a second, would not come this
            far, metres, in the time that is left, if they did not become faster than a fifth of a second before, and if no object
            came half as far as a stable scene allows (0: never). Turning counts as for ``rest_speed``. Later moves, drift and
            jitter are then not seen.
        stops_early: The scene is not watched if an object exceeded a limit in the settling: it is not stable in any case. Rest
            poses, drift and jitter are then unknown.
    """

    timestep: float = 0.002
    settle_seconds: float = 1.0
    watch_seconds: float = 3.0
    sample_seconds: float = 0.02
    rest_speed: float = 0.0
    friction: Vec3 = (0.8, 0.005, 0.0001)
    solref: tuple[float, float] = (0.008, 1.0)
    solimp: Vec3 = (0.95, 0.99, 0.001)
    impratio: float = 10.0
    sleep_speed: float = 1e-4
    rest_move: float = 1e-3
    stops_early: bool = False


@dataclass(frozen=True, slots=True, eq=False)
class Inertial:
    """How the mass of a body is distributed.

    Attributes:
        center_of_mass: (3,) float64, metres, yaw frame, from the centre of the object's box.
        inertia: About the centre of mass, (3, 3) float64, kg m², axes of the yaw frame.
    """

    center_of_mass: FloatArray
    inertia: FloatArray


@dataclass(frozen=True, slots=True, eq=False)
class RigidBody:
    """An object for the physics engine.

    Attributes:
        name: Its name in reasons.
        parts: Convex colliders, metres, yaw frame, centred on the object's box. Their convex hulls collide.
        mass: Kilograms, distributed over the parts by volume if there is no ``inertial``.
        position: Centre of its box in its yaw frame, metres, world frame.
        yaw: Rotation about +z, radians.
        movable: False if it is fixed to the world.
        inertial: Distribution of the mass; None: that of the parts.
        friction: Sliding, torsional (metres) and rolling (metres) coefficients of its contacts with the table and with bodies that
            have none; for two bodies that have some, the larger of each. None: those of :class:`PhysicsOptions`. Contacts have
            no rolling friction, so that the third is stored only.
    """

    name: str
    parts: tuple[Mesh, ...]
    mass: float
    position: Vec3
    yaw: float = 0.0
    movable: bool = True
    inertial: Inertial | None = None
    friction: Vec3 | None = None


@dataclass(frozen=True, slots=True, eq=False)
class SettleResult:
    """Poses after settling, and the verdict (docs/generate.md). None is unknown, and never a pass.

    Attributes:
        names: The bodies, in the given order.
        positions: Final positions of the centres that the boxes had at the start, (N, 3) float64, metres, world frame.
        quats_xyzw: Final rotations, (N, 4) float64, unit, world from yaw frame at yaw 0; for a body upright at the start only
            the yaw.
        moves: Largest distance of each body from its start at any time, (N,) float64, metres. If the simulation diverged, it is
            inf for the bodies that had exceeded a limit before (for all, if none had), and NaN, unknown, for the others.
        turns: Largest rotation of each body from its start at any time, (N,) float64, degrees, with inf and NaN as in
            ``moves``.
        engine_penetration_mm: Deepest contact at t = 0; None if the engine does not tell.
        settle_move_max_mm: Largest of ``moves``.
        settle_turn_max_deg: Largest of ``turns``.
        drift_mm: Largest distance of a body in the watch from its position at the end of the settling.
        jitter_mm: Largest distance of a body from its own mean position in the last second of the watch, or in all of it if it
            was shorter; 0 for a sleeping body.
        stable: No body moved more than 10 mm or turned more than 5 degrees in all, and none drifted 50 mm.
        reason: Why ``stable`` is not True; empty if it is.
    """

    names: tuple[str, ...]
    positions: FloatArray
    quats_xyzw: FloatArray
    moves: FloatArray
    turns: FloatArray
    engine_penetration_mm: float | None
    settle_move_max_mm: float | None
    settle_turn_max_deg: float | None
    drift_mm: float | None
    jitter_mm: float | None
    stable: bool | None
    reason: str = ""

    def pose(self, index: int) -> tuple[Vec3, QuatXyzw]:
        """Final position and quaternion of a body, see ``positions`` and ``quats_xyzw``."""
        x, y, z = self.positions[index].tolist()
        a, b, c, d = self.quats_xyzw[index].tolist()
        return (x, y, z), (a, b, c, d)

    @property
    def unsteady(self) -> tuple[str, ...]:
        """The bodies that exceeded a limit; if the simulation diverged, those that caused it."""
        exceeds = _exceed_limits(self.moves, self.turns).tolist()
        return tuple(name for name, is_unsteady in zip(self.names, exceeds, strict=True) if is_unsteady)

    @property
    def num_restless(self) -> int:
        """Number of bodies that are not known to stay: the unsteady ones, and all if the simulation diverged or did not run."""
        return int((~((self.moves <= MOVE_LIMIT) & (self.turns <= TURN_LIMIT))).sum())


def settle(
    bodies: Sequence[RigidBody],
    table: Tabletop,
    options: PhysicsOptions = PhysicsOptions(),
    velocities: FloatArray | None = None,
) -> SettleResult:
    """Lets a scene settle under gravity and watches it.

    Args:
        bodies: The objects.
        table: The table that supports them.
        options: Settings of MuJoCo; by default 2 ms steps, 1 s of settling, 3 s of watching.
        velocities: Velocity of each body at the start, (N, 6) float64: linear in the world frame, metres a second, then angular
            in the yaw frame, radians a second. Those of bodies that are not movable are not used. None: all are at rest.

    Returns:
        Final poses and the verdict. ``stable`` is None if the scene could not be simulated (a body without a solid part), False
        if a body moved or fell or the simulation diverged.
    """
    if not bodies:
        return judge_motion(bodies, 0.0, lambda *_: np.zeros((1, 0, 7)), options)
    try:
        model = compile_bodies(bodies, table, options)
    except MeshError as error:
        return unknown_result(bodies, str(error))
    with without_log_file():
        data = mujoco.MjData(model)
        if velocities is not None:
            data.qvel[:] = velocities[[body.movable for body in bodies]].ravel()
        mujoco.mj_forward(model, data)
        penetration = float(max(0.0, -data.contact.dist.min())) if data.ncon else 0.0

        def simulate(seconds: float, calm: Calm, is_watch: bool) -> FloatArray:
            if is_watch:
                enable_sleeping(model, options)  # not before: a body that begins to fall is as slow as one at rest
            return _simulate(model, data, seconds, options, 0.0 if is_watch else options.rest_speed, calm)

        return judge_motion(bodies, penetration, simulate, options)


def judge_motion(
    bodies: Sequence[RigidBody],
    penetration: float | None,
    simulate: Callable[[float, "Calm", bool], FloatArray],
    options: PhysicsOptions,
) -> SettleResult:
    """Simulates settling and watch with any engine, and judges how the bodies moved.

    Args:
        bodies: The objects.
        penetration: Deepest contact at the start, metres; None if it is not known.
        simulate: Continues the simulation: takes how long, seconds, what ends it early, and whether it is the watch; gives the
            poses of the bodies at each sample, (T, N, 7) float64, T > 0: position in metres, quaternion xyzw. A sample that is
            not finite, which must be the last one, says that the simulation diverged.
        options: Times, and rules of ending early.
    """
    names, start = tuple(body.name for body in bodies), start_poses(bodies)
    path = np.concatenate([start[None], simulate(options.settle_seconds, Calm.of_settling(start, options), False)])
    if not np.isfinite(path).all() or (options.stops_early and _instability_reason(names, *_largest_movement(path), 0.0)):
        watched = path[:0]
    else:
        watched = simulate(options.watch_seconds, Calm.of_watch(path, options), True)
    if not (np.isfinite(path).all() and np.isfinite(watched).all()):
        return _diverged(names, np.concatenate([path, watched])[:-1], penetration)  # the last sample is NaN
    return _verdict(names, path, watched, penetration, options)


def start_poses(bodies: Sequence[RigidBody]) -> FloatArray:
    """Returns the poses of bodies at the start, (N, 7) float64: position in metres, quaternion xyzw."""
    return np.array([(*b.position, *yaw_quat(b.yaw)) for b in bodies], np.float64).reshape(-1, 7)


def compile_bodies(bodies: Sequence[RigidBody], table: Tabletop, options: PhysicsOptions = PhysicsOptions()) -> mujoco.MjModel:
    """Compiles the MuJoCo model that :func:`spec_of` describes, a ``mujoco.MjModel``.

    Raises:
        MeshError: A body has no solid part (code ``no_collider``), no mass or no friction, or MuJoCo refuses the model
            (``engine``).
    """
    cache = mujoco.mj_getCache()
    if mujoco.mj_getCacheSize(cache) > _MAX_CACHED_BYTES:
        mujoco.mj_clearCache(cache)  # when it is full, it would keep the old hulls and take no new ones
    files: dict[str, bytes] = {}
    spec = _spec_of(bodies, table, options, files)
    spec.assets = files
    spec.compiler.usethread = False  # threads cost more than they save
    return compile_spec(spec)


def spec_of(bodies: Sequence[RigidBody], table: Tabletop, options: PhysicsOptions = PhysicsOptions()) -> mujoco.MjSpec:
    """Describes a scene for MuJoCo; exports add names and appearance to the description.

    Args:
        bodies: The objects; body k + 1 of the model is ``bodies[k]`` (0 is the world with the table). Their geoms are their
            solid parts, in order.
        table: The table, the geom ``table`` of the world.
        options: Settings of MuJoCo.

    Returns:
        The description, a ``mujoco.MjSpec``; geoms that collide are of the class ``collider``.

    Raises:
        MeshError: A body has no solid part (code ``no_collider``), no mass or no friction.
    """
    return _spec_of(bodies, table, options, None)


def _spec_of(
    bodies: Sequence[RigidBody], table: Tabletop, options: PhysicsOptions, files: dict[str, bytes] | None
) -> mujoco.MjSpec:
    """The description of a scene; its meshes are added to ``files``, name -> content, if that is not None.

    The model is the same. But MuJoCo keeps the hulls of files for further models, and else computes them for each.
    """
    spec = mujoco.MjSpec()
    _configure(spec, options)
    collider = spec.add_default(COLLIDER, spec.default)
    collider.geom.friction, collider.geom.solref = list(options.friction), list(options.solref)
    # Midpoint 0.5 and power 2 are MuJoCo's defaults; condim 4 adds torsional friction.
    collider.geom.solimp, collider.geom.condim = [*options.solimp, 0.5, 2.0], 4
    x, y = table.size_xy
    half = TABLE_DEPTH / 2
    spec.worldbody.add_geom(
        collider, name=TABLE, type=mujoco.mjtGeom.mjGEOM_BOX, size=[x / 2, y / 2, half], pos=[x / 2, y / 2, -half]
    )
    meshes: dict[int, str] = {}
    for body in bodies:
        _add_body(spec, body, meshes, collider, files)
    return spec


def compile_spec(spec: mujoco.MjSpec) -> mujoco.MjModel:
    """Compiles a description to a MuJoCo model.

    Raises:
        MeshError: MuJoCo refuses it (``engine``).
    """
    try:
        return spec.compile()
    except (ValueError, mujoco.FatalError) as error:
        raise MeshError(
            f"MuJoCo refuses the scene: {' '.join(str(error).split())}; repair its convex parts", "engine"
        ) from error


def enable_sleeping(model: mujoco.MjModel, options: PhysicsOptions) -> None:
    """Lets MuJoCo skip bodies slower than ``options.sleep_speed`` from now on, if that is more than 0."""
    if options.sleep_speed:
        model.opt.enableflags |= mujoco.mjtEnableBit.mjENBL_SLEEP
        model.opt.sleep_tolerance = options.sleep_speed


def _configure(spec: mujoco.MjSpec, options: PhysicsOptions) -> None:
    spec.option.timestep, spec.option.gravity = options.timestep, [0.0, 0.0, -GRAVITY]
    spec.option.cone = mujoco.mjtCone.mjCONE_ELLIPTIC
    spec.option.impratio = options.impratio
    # By default MuJoCo resets a scene that diverges to its first pose, which would look like a scene that never moved.
    spec.option.disableflags |= mujoco.mjtDisableBit.mjDSBL_AUTORESET


def _add_body(
    spec: mujoco.MjSpec,
    body: RigidBody,
    meshes: dict[int, str],
    collider: mujoco.MjsDefault,
    files: dict[str, bytes] | None,
) -> None:
    check_body(body)
    added = spec.worldbody.add_body(pos=list(body.position), quat=wxyz(yaw_quat(body.yaw)))
    if body.movable:
        added.add_freejoint()
    if body.inertial is not None:
        added.explicitinertial, added.mass, added.ipos = True, body.mass, body.inertial.center_of_mass.tolist()
        added.fullinertia = body.inertial.inertia[[0, 1, 2, 0, 0, 1], [0, 1, 2, 1, 2, 2]].tolist()
    # MuJoCo takes the friction of the geom with the higher priority, and the maximum of both at the same priority.
    own = {} if body.friction is None else {"friction": list(body.friction), "priority": 1}
    volumes = [hull_volume(part) for part in body.parts]
    for part, volume in zip(body.parts, volumes, strict=True):
        if volume > 0:
            if id(part) not in meshes:  # objects of one asset share its parts
                meshes[id(part)] = f"part_{len(meshes)}"
                mesh = spec.add_mesh(name=meshes[id(part)], inertia=mujoco.mjtMeshInertia.mjMESH_INERTIA_CONVEX)
                if files is None:
                    mesh.uservert = part.vertices.ravel()
                else:
                    mesh.file, content = _mesh_file(part)
                    files[mesh.file] = content
            mass = body.mass * volume / sum(volumes)
            added.add_geom(collider, type=mujoco.mjtGeom.mjGEOM_MESH, meshname=meshes[id(part)], mass=mass, **own)


def check_body(body: RigidBody) -> None:
    """Refuses a body that no engine can simulate.

    Raises:
        MeshError: It has no solid part (code ``no_collider``), no mass (``no_mass``) or no friction (``no_friction``), or its pose
            or inertial is not finite (``not_finite``).
    """
    if not np.isfinite((*body.position, body.yaw)).all():
        raise MeshError(f"body {body.name}: its pose is {body.position}, yaw {body.yaw}, expected finite numbers", "not_finite")
    if not 0 < body.mass < np.inf:
        raise MeshError(f"body {body.name}: mass is {body.mass} kg, expected a finite value above 0", "no_mass")
    if body.friction is not None and not all(0 <= value < np.inf for value in body.friction):
        raise MeshError(f"body {body.name}: friction is {body.friction}, expected finite values of at least 0", "no_friction")
    own = body.inertial
    if own is not None and not (np.isfinite(own.center_of_mass).all() and np.isfinite(own.inertia).all()):
        raise MeshError(f"body {body.name}: its inertial is not finite, expected finite numbers", "not_finite")
    if not any(hull_volume(part) > 0 for part in body.parts):
        raise MeshError(
            f"body {body.name}: none of its {len(body.parts)} convex parts is solid; decompose its mesh again", "no_collider"
        )


def _mesh_file(part: Mesh) -> tuple[str, bytes]:
    """The vertices of a part as a file of MuJoCo's format MSH: its name, a hash of the content, and the content."""
    content = struct.pack("=4i", len(part.vertices), 0, 0, 0) + part.vertices.astype(np.float32).tobytes()
    return f"{hashlib.sha256(content).hexdigest()}.msh", content


@lru_cache(maxsize=1024)
def hull_volume(part: Mesh) -> float:
    """Computes the volume of a closed convex part, cubic metres; 0 if it is too flat to collide with."""
    vertices = part.vertices - part.vertices.mean(axis=0)
    if len(vertices) < 4 or not np.isfinite(vertices).all():
        return 0.0
    spread = np.linalg.svd(vertices, compute_uv=False)  # the smallest value measures the thickness
    if spread[2] < max(_FLATTEST * spread[0], 1e-6):
        return 0.0
    a, b, c = (vertices[part.faces[:, k]] for k in range(3))
    return max(0.0, float(np.einsum("ij,ij->i", a, np.cross(b, c)).sum()) / 6)


class Calm:
    """Decides when a simulation can end, because its verdict will hardly change any more: see ``PhysicsOptions.rest_move``.

    Args:
        path: Poses so far, (T, N, 7) float64, from the start: position in metres, quaternion in any order.
        options: Settings.
        seconds: Simulated time from now to the end.
        ignored: Time from now whose movement does not tell how fast objects become, seconds.
    """

    def __init__(self, path: FloatArray, options: PhysicsOptions, seconds: float, ignored: float = 0.0) -> None:
        self._start, self._rest_move, self._interval = path[0], options.rest_move, options.sample_seconds
        self._seconds_left = seconds
        self._window = round(_CALM_SECONDS / options.sample_seconds)
        self._moves, self._turns = _largest_movement(path)
        self._wait = round(ignored / options.sample_seconds)
        self._recent: deque[FloatArray] = deque(maxlen=self._window + 1)
        self._shifts: deque[float] = deque(maxlen=self._window + 1)

    @classmethod
    def of_settling(cls, start: FloatArray, options: PhysicsOptions, seconds: float | None = None) -> "Calm":
        """For a simulation that begins at poses (N, 7) and takes so many seconds; by default those of settling and watch."""
        whole = options.settle_seconds + options.watch_seconds
        return cls(start[None], options, whole if seconds is None else seconds, _IMPACT_SECONDS)

    @classmethod
    def of_watch(cls, path: FloatArray, options: PhysicsOptions) -> "Calm":
        """For the watch after a path (T, N, 7)."""
        return cls(path, options, options.watch_seconds)

    def has_come(self, pose: FloatArray) -> bool:
        """Whether the simulation can end; called once a sample, with the latest poses (N, 7)."""
        self._seconds_left -= self._interval
        moves, turns = _largest_movement(np.stack([self._start, pose]))
        self._moves, self._turns = np.maximum(self._moves, moves), np.maximum(self._turns, turns)
        is_near = (self._moves < _CALM_SHARE * MOVE_LIMIT).all() and (self._turns < _CALM_SHARE * TURN_LIMIT).all()
        if not (self._rest_move and is_near):  # neither comes back
            return False
        self._wait -= 1
        if self._wait < 0:
            self._recent.append(pose)
        if len(self._recent) <= self._window:
            return False
        # How far bodies came in the window, not how fast they are: contacts jitter without moving anything.
        moves, turns = _largest_movement(np.stack([pose, *self._recent]))
        self._shifts.append(float(np.maximum(moves, _TURN_ARM * np.radians(turns)).max(initial=0.0)))
        return (
            len(self._shifts) > self._window
            and self._shifts[-1] / _CALM_SECONDS * self._seconds_left < self._rest_move
            and self._shifts[-1] <= self._shifts[0]  # what begins to fall is slow, but becomes faster
        )


def _simulate(
    model: mujoco.MjModel,
    data: mujoco.MjData,
    seconds: float,
    options: PhysicsOptions,
    rest_speed: float = 0.0,
    calm: Calm | None = None,
) -> FloatArray:
    """Poses of all bodies at every sample, (T, N, 7) float64: position, quaternion xyzw; NaN from the sample that diverged.

    Ends early once no body has moved faster than ``rest_speed`` for a while, or when ``calm`` has come.
    """
    patience = round(_REST_SECONDS / options.sample_seconds)
    num_still = 0
    stride = max(1, round(options.sample_seconds / options.timestep))
    samples: list[FloatArray] = []
    num_samples = max(1, round(seconds / options.timestep / stride))
    # Whole strides are simulated in one call, because each call from Python has a cost.
    while len(samples) < num_samples:
        mujoco.mj_step(model, data, nstep=stride)
        # mj_step leaves the poses of the bodies as they were before its last step; the joints are up to date.
        mujoco.mj_kinematics(model, data)
        pose = np.concatenate([data.xpos[1:], data.xquat[1:][:, [1, 2, 3, 0]]], axis=1)
        if has_exploded(data) or not np.isfinite(pose).all():
            samples.append(np.full_like(pose, np.nan))
            break
        samples.append(pose)
        if data.ntree_awake == 0:  # nothing moves any more: the samples that are left are equal, bit for bit
            samples += [pose] * (num_samples - len(samples))
            break
        num_still = num_still + 1 if _speed(data) < rest_speed else 0
        if num_still > patience or (calm is not None and calm.has_come(pose)):
            break
    return np.stack(samples)


def _speed(data: mujoco.MjData) -> float:
    """Speed of the fastest body, metres a second."""
    motion = data.qvel.reshape(-1, 6) * ([1.0] * 3 + [_TURN_ARM] * 3)
    return float(np.abs(motion).max(initial=0.0))


def has_exploded(data: mujoco.MjData) -> bool:
    """Returns whether MuJoCo has found invalid positions, velocities or accelerations."""
    bad = (mujoco.mjtWarning.mjWARN_BADQPOS, mujoco.mjtWarning.mjWARN_BADQVEL, mujoco.mjtWarning.mjWARN_BADQACC)
    return any(data.warning[int(kind)].number > 0 for kind in bad)


def _verdict(
    names: tuple[str, ...], settled: FloatArray, watched: FloatArray, penetration: float | None, options: PhysicsOptions
) -> SettleResult:
    """Judges trajectories (T, N, 7): the start and the settling, then the watch."""
    path = np.concatenate([settled, watched])
    moves, turns = _largest_movement(path)
    drift, jitter = 0.0, None
    if len(watched):
        drift = float(np.linalg.norm(watched[:, :, :3] - settled[-1:, :, :3], axis=2).max(initial=0.0))
        last = watched[-max(1, round(_JITTER_SECONDS / options.sample_seconds)) :, :, :3]
        jitter = 1e3 * float(np.linalg.norm(last - last.mean(axis=0), axis=2).max(initial=0.0))
    reason = _instability_reason(names, moves, turns, drift)
    move, turn = float(moves.max(initial=0.0)), float(turns.max(initial=0.0))
    figures = (_millimetres(penetration), 1e3 * move, turn, 1e3 * drift if len(watched) else None, jitter)
    return SettleResult(names, path[-1, :, :3], path[-1, :, 3:], moves, turns, *figures, stable=not reason, reason=reason)


def _largest_movement(path: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Largest distance of each body from its start on a trajectory (T, N, 7), (N,) metres, and largest rotation, (N,) degrees."""
    moves = np.linalg.norm(path[:, :, :3] - path[:1, :, :3], axis=2).max(axis=0)
    return moves, np.degrees(_angles(path[:1, :, 3:], path[:, :, 3:])).max(axis=0)


def _instability_reason(names: tuple[str, ...], moves: FloatArray, turns: FloatArray, drift: float) -> str:
    if moves.max(initial=0.0) > MOVE_LIMIT:
        return f"{names[int(moves.argmax())]} moved {1e3 * moves.max():.1f} mm"
    if turns.max(initial=0.0) > TURN_LIMIT:
        return f"{names[int(turns.argmax())]} turned {turns.max():.1f} degrees"
    return f"an object drifted {1e3 * drift:.1f} mm" if drift > DRIFT_LIMIT else ""


def unknown_result(bodies: Sequence[RigidBody], reason: str) -> SettleResult:
    """Returns the result for a scene that could not be simulated, with the reason; ``stable`` is None."""
    names, start = tuple(body.name for body in bodies), start_poses(bodies)
    unknown = np.full(len(names), np.nan)
    figures = (None, None, None, None, None)
    return SettleResult(names, start[:, :3], start[:, 3:], unknown, unknown, *figures, stable=None, reason=reason)


def _diverged(names: tuple[str, ...], known: FloatArray, penetration: float | None) -> SettleResult:
    """The verdict on a simulation that diverged after a trajectory (T, N, 7), with its start.

    Bodies that exceeded a limit before are the cause, because bodies at rest do not make a simulation diverge. If none had, all
    may be.
    """
    moves, turns = _largest_movement(known)
    exceeds = _exceed_limits(moves, turns)
    blamed = np.where(exceeds | ~exceeds.any(), np.inf, np.nan)
    after = _instability_reason(names, moves, turns, 0.0)
    reason = "the simulation diverged" + (f" after {after}" if after else "; separate objects that penetrate each other deeply")
    figures = (_millimetres(penetration), None, None, None, None)
    return SettleResult(names, known[0, :, :3], known[0, :, 3:], blamed, blamed, *figures, stable=False, reason=reason)


def _millimetres(metres: float | None) -> float | None:
    return None if metres is None else 1e3 * metres


def _exceed_limits(moves: FloatArray, turns: FloatArray) -> npt.NDArray[np.bool_]:
    """Which bodies exceeded a limit, (N,) bool."""
    return (moves > MOVE_LIMIT) | (turns > TURN_LIMIT)


def _angles(first: FloatArray, second: FloatArray) -> FloatArray:
    """Angle between rotations (..., 4), radians."""
    # The chord, because the arccosine of the product cannot resolve angles below 1e-4 rad.
    sign = np.where((first * second).sum(axis=-1, keepdims=True) < 0, -1.0, 1.0)
    chord = np.linalg.norm(first - sign * second, axis=-1)
    return np.asarray(4 * np.arcsin(np.minimum(chord / 2, 1.0)))
