"""PhysX on the CPU, as SAPIEN has it: a second opinion, by another family of contact solvers than MuJoCo's."""

import warnings
from collections.abc import Iterable, Sequence
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from stable_data.errors import MeshError
from stable_data.judges.judge import (
    VERDICT_OPTIONS,
    FrictionLayer,
    friction_layers,
    inertial_of,
    judge_samples,
    solid_parts,
)
from stable_data.rotations import wxyz, yaw_quat
from stable_data.scene import FloatArray, QuatXyzw, Tabletop, Vec3
from stable_data.simulation.settling import GRAVITY, TABLE_DEPTH, PhysicsOptions, RigidBody, SettleResult, check_body

with warnings.catch_warnings():
    warnings.simplefilter("ignore")  # it has no graphics driver; nothing is drawn
    import sapien
    from sapien import physx

STEP = 0.004
"""Longest step, seconds; steps divide the interval between samples. Half of it changes no more verdicts than other settings do."""

CONTACT_OFFSET = 0.002
"""Distance at which PhysX begins to compute contacts, metres. With its default, 10 mm, as thick as a pen, it takes twice as long."""

# PhysX leaves out a corner that is less than about 0.7 mm from the hull of the others: a cup with 32 sides would have 16, and its rim
# would rock. So the hulls are computed of parts that are this much larger, and used smaller again.
_ENLARGED = 100.0
_DEPENETRATION = 0.2  # metres a second: what overlaps at the start is pushed apart, but not shot away
# With fewer, what is heavy slips off what is light. More velocity iterations make bodies creep.
_POSITION_ITERATIONS, _VELOCITY_ITERATIONS = 40, 1
_MAX_LAYERS = 32  # bits of a collision group


def settle(bodies: Sequence[RigidBody], table: Tabletop, options: PhysicsOptions = VERDICT_OPTIONS) -> SettleResult:
    """Lets a scene settle in PhysX and watches it, see :class:`stable_data.judges.judge.Judge`."""
    for body in bodies:
        check_body(body)
    own = [None if body.friction is None else body.friction[0] for body in bodies]
    *layers, of_table = friction_layers([*own, None], options.friction[0])
    if len(of_table) > _MAX_LAYERS:
        raise MeshError(
            f"bodies have {len(of_table) - 1} different frictions, PhysX expects at most {_MAX_LAYERS - 1}", "engine"
        )
    world = _new_world()
    half = (table.size_xy[0] / 2, table.size_xy[1] / 2, TABLE_DEPTH / 2)
    _add_static(world, _box_shapes(half, of_table), (half[0], half[1], -half[2]))
    try:
        entities = [_add_body(world, body, copies) for body, copies in zip(bodies, layers, strict=True)]
    except RuntimeError as error:
        raise MeshError(
            f"PhysX refuses the scene: {' '.join(str(error).split())}; repair its convex parts", "engine"
        ) from error
    num_steps = int(np.ceil(options.sample_seconds / STEP - 1e-9))
    world.physx_system.timestep = options.sample_seconds / num_steps

    def advance() -> FloatArray:
        for _ in range(num_steps):
            world.physx_system.step()
        return np.array([(*e.pose.p, *e.pose.q[[1, 2, 3, 0]]) for e in entities], np.float64).reshape(-1, 7)

    return judge_samples(bodies, advance, options, "PhysX")


def _new_world() -> Any:
    """An empty world; the configuration is global, so that of others is put back."""
    others = physx.get_scene_config()
    physx.set_scene_config(
        gravity=(0.0, 0.0, -GRAVITY),
        enable_pcm=False,  # with it, contacts of things of some centimetres are so few that a stack of boxes that leans falls
        enable_tgs=True,
        enable_ccd=False,
        enable_enhanced_determinism=True,
        enable_friction_every_iteration=True,
    )
    try:
        return sapien.Scene([physx.PhysxCpuSystem()])
    finally:
        physx.set_scene_config(others)


def _box_shapes(half: Vec3, copies: Iterable[FrictionLayer]) -> list[Any]:
    return [_in_layer(physx.PhysxCollisionShapeBox(half, _material(copy)), copy) for copy in copies]


def _hull_shapes(body: RigidBody, copies: Iterable[FrictionLayer]) -> list[Any]:
    shapes = []
    for part in solid_parts(body):
        corners = (part.vertices * _ENLARGED).astype(np.float32)
        for copy in copies:
            hull = physx.PhysxCollisionShapeConvexMesh(corners, [1 / _ENLARGED] * 3, _material(copy))
            shapes.append(_in_layer(hull, copy))
    return shapes


def _material(copy: FrictionLayer) -> Any:
    return physx.PhysxMaterial(copy.friction, copy.friction, 0.0)


def _in_layer(shape: Any, copy: FrictionLayer) -> Any:
    """Shapes A and B touch if a bit of the first group of one is in the second group of the other."""
    shape.set_collision_groups([copy.decides << copy.index, 1 << copy.index, 0, 0])
    shape.contact_offset, shape.rest_offset = CONTACT_OFFSET, 0.0
    return shape


def _add_static(world: Any, shapes: Sequence[Any], position: Vec3, quat_xyzw: QuatXyzw = (0.0, 0.0, 0.0, 1.0)) -> Any:
    return _add(world, physx.PhysxRigidStaticComponent(), shapes, position, quat_xyzw)


def _add_body(world: Any, body: RigidBody, copies: Sequence[FrictionLayer]) -> Any:
    shapes, quat_xyzw = _hull_shapes(body, copies), yaw_quat(body.yaw)
    if not body.movable:
        return _add_static(world, shapes, body.position, quat_xyzw)
    component, inertial = physx.PhysxRigidDynamicComponent(), inertial_of(body)
    entity = _add(world, component, shapes, body.position, quat_xyzw)
    moments, axes = np.linalg.eigh(inertial.inertia)
    axes *= np.sign(np.linalg.det(axes))  # a rotation, not a reflection
    component.mass, component.inertia = body.mass, moments
    component.cmass_local_pose = sapien.Pose(inertial.center_of_mass, Rotation.from_matrix(axes).as_quat()[[3, 0, 1, 2]])
    component.sleep_threshold = component.linear_damping = component.angular_damping = 0.0
    component.max_depenetration_velocity = _DEPENETRATION
    component.solver_position_iterations, component.solver_velocity_iterations = _POSITION_ITERATIONS, _VELOCITY_ITERATIONS
    return entity


def _add(world: Any, component: Any, shapes: Sequence[Any], position: Vec3, quat_xyzw: QuatXyzw) -> Any:
    for shape in shapes:
        component.attach(shape)
    entity = sapien.Entity()
    entity.add_component(component)
    entity.pose = sapien.Pose(position, wxyz(quat_xyzw))
    world.add_entity(entity)
    return entity
