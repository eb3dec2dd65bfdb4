"""Drake with its solver SAP and hydroelastic contacts: the arbiter where other judges disagree. It is slow."""

from collections import defaultdict
from collections.abc import Sequence
from itertools import combinations
from typing import Any

import numpy as np
from pydrake import geometry
from pydrake.common.eigen_geometry import Quaternion
from pydrake.math import RigidTransform
from pydrake.multibody.plant import AddMultibodyPlant, CoulombFriction, MultibodyPlant, MultibodyPlantConfig
from pydrake.multibody.tree import SpatialInertia, UnitInertia
from pydrake.systems.analysis import Simulator
from pydrake.systems.framework import DiagramBuilder

from stable_data.errors import MeshError
from stable_data.judges import judge as shared
from stable_data.judges.judge import VERDICT_OPTIONS, FrictionLayer
from stable_data.rotations import wxyz, yaw_quat
from stable_data.scene import FloatArray, Tabletop
from stable_data.simulation.settling import GRAVITY, TABLE_DEPTH, PhysicsOptions, RigidBody, SettleResult, check_body

STEP = 0.004
"""Longest step, seconds; steps divide the interval between samples."""

MODULUS = 2e6
"""Hydroelastic modulus of what moves, Pa: bodies sink in by hundredths of a millimetre. The table and fixed bodies are rigid. Stiffer
bodies stay on slopes that are too steep for their friction; softer towers fall."""

# Drake refuses small faces, by area. So a scene is simulated larger: lengths, gravity and speeds grow, pressures fall by this.
_ENLARGED = 100.0

_RIGID_HINT = 0.1  # metres; hulls and boxes have their own faces, whatever it is
_FLATTEST = 1e-4  # lowest height of a tetrahedron, share of the extent of its part; parts with flatter ones touch at points

_STICTION = 1e-3  # metres a second: slower contacts count as sticking; the default of Drake

_DISSIPATION = 10.0  # seconds a metre, of Hunt and Crossley


def settle(bodies: Sequence[RigidBody], table: Tabletop, options: PhysicsOptions = VERDICT_OPTIONS) -> SettleResult:
    """Lets a scene settle in Drake and watches it, see :class:`stable_data.judges.judge.Judge`."""
    for body in bodies:
        check_body(body)
    num_steps = int(np.ceil(options.sample_seconds / STEP - 1e-9))
    builder = DiagramBuilder()
    config = MultibodyPlantConfig(
        time_step=options.sample_seconds / num_steps,
        contact_model="hydroelastic_with_fallback",
        discrete_contact_approximation="lagged",
        stiction_tolerance=_STICTION * _ENLARGED,
    )
    plant, graph = AddMultibodyPlant(config, builder)
    plant.mutable_gravity_field().set_gravity_vector([0.0, 0.0, -GRAVITY * _ENLARGED])
    own = [None if body.friction is None else body.friction[0] for body in bodies]
    *layers, of_table = shared.friction_layers([*own, None], options.friction[0])
    colliders: dict[FrictionLayer, list[geometry.GeometryId]] = defaultdict(list)
    x, y, z = (_ENLARGED * side for side in (*table.size_xy, TABLE_DEPTH))
    place = RigidTransform([x / 2, y / 2, -z / 2])
    for copy in of_table:
        shape = geometry.Box(x, y, z)
        colliders[copy].append(
            plant.RegisterCollisionGeometry(plant.world_body(), place, shape, f"table_{copy.index}", _properties(copy, None))
        )
    try:
        for number, (body, copies) in enumerate(zip(bodies, layers, strict=True)):
            _add_body(plant, number, body, copies, colliders)
        _separate(graph.collision_filter_manager(), colliders)
        plant.Finalize()
        diagram = builder.Build()
        context = diagram.CreateDefaultContext()
        own_context = plant.GetMyMutableContextFromRoot(context)
        movable = [(k, plant.GetBodyByName(f"body_{k}")) for k, body in enumerate(bodies) if body.movable]
        for number, made in movable:
            plant.SetFreeBodyPose(own_context, made, _pose(bodies[number]))
        simulator = Simulator(diagram, context)
        simulator.Initialize()
    except RuntimeError as error:
        raise MeshError(
            f"Drake refuses the scene: {' '.join(str(error).split())}; repair its convex parts", "engine"
        ) from error
    poses = np.zeros((len(bodies), 7))

    def advance() -> FloatArray:
        try:
            simulator.AdvanceTo(round(context.get_time() / options.sample_seconds + 1) * options.sample_seconds)
        except RuntimeError:  # the solver found no solution
            return np.full_like(poses, np.nan)
        for number, made in movable:
            pose = plant.EvalBodyPoseInWorld(own_context, made)
            turn = pose.rotation().ToQuaternion()
            poses[number] = (*pose.translation() / _ENLARGED, turn.x(), turn.y(), turn.z(), turn.w())
        return poses.copy()

    return shared.judge_samples(bodies, advance, options, "Drake")


def _add_body(
    plant: MultibodyPlant,
    number: int,
    body: RigidBody,
    copies: Sequence[FrictionLayer],
    colliders: dict[FrictionLayer, list[geometry.GeometryId]],
) -> None:
    made, place = plant.world_body(), _pose(body)
    if body.movable:
        own = shared.inertial_of(body)
        inertia, centre = own.inertia / body.mass * _ENLARGED**2, own.center_of_mass * _ENLARGED
        unit = UnitInertia(*inertia.diagonal(), inertia[0, 1], inertia[0, 2], inertia[1, 2]).ShiftFromCenterOfMass(centre)
        made, place = plant.AddRigidBody(f"body_{number}", SpatialInertia(body.mass, centre, unit)), RigidTransform()
    for part_number, part in enumerate(shared.solid_parts(body)):
        corners, is_regular = part.vertices * _ENLARGED, shared.has_volume_everywhere(part, _FLATTEST)
        extent = float(np.ptp(corners, axis=0).min()) if body.movable else None
        for copy in copies:
            name = f"body_{number}_{part_number}_{copy.index}"
            hull = geometry.Convex(points=corners.T, label=name)
            found = _properties(copy, extent, has_pressure=is_regular)
            colliders[copy].append(plant.RegisterCollisionGeometry(made, place, hull, name, found))


def _pose(body: RigidBody) -> RigidTransform:
    return RigidTransform(Quaternion(wxyz(yaw_quat(body.yaw))), [_ENLARGED * c for c in body.position])


def _properties(copy: FrictionLayer, extent: float | None, *, has_pressure: bool = True) -> geometry.ProximityProperties:
    """Those of a part of this thickness; None: it is rigid. Without pressure it touches at points."""
    found = geometry.ProximityProperties()
    geometry.AddContactMaterial(_DISSIPATION / _ENLARGED, None, CoulombFriction(copy.friction, copy.friction), found)
    if not has_pressure:
        return found
    if extent is None:
        geometry.AddRigidHydroelasticProperties(_RIGID_HINT * _ENLARGED, found)
    else:
        geometry.AddCompliantHydroelasticProperties(extent, MODULUS / _ENLARGED, found)
    return found


def _separate(filters: Any, colliders: dict[FrictionLayer, list[geometry.GeometryId]]) -> None:
    """Lets colliders touch only in their layer, and there only where one of them decides."""
    rules = geometry.CollisionFilterDeclaration()
    for copy, found in colliders.items():
        if not copy.decides:
            rules.ExcludeWithin(geometry.GeometrySet(found))
    for (a, of_a), (b, of_b) in combinations(colliders.items(), 2):
        if a.index != b.index:
            rules.ExcludeBetween(geometry.GeometrySet(of_a), geometry.GeometrySet(of_b))
    filters.Apply(rules)
