"""Mass, friction and joints of a composed USD stage, as UsdPhysics states them."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Any

import networkx as nx
import numpy as np

from stable_data.geometry.mass_properties import mass_properties
from stable_data.geometry.mesh import Mesh, double_areas, signed_volumes
from stable_data.importers.source import GivenInertial
from stable_data.rotations import normalise_quat, rotation_matrix
from stable_data.scene import FloatArray, Vec3

_TORSIONAL, _ROLLING = 0.005, 0.0001  # m; MuJoCo's defaults: USD states sliding friction alone
_ASSUMED_DENSITY = 1000.0  # kg/m³, of UsdPhysics
_FIXED_AXES = ("transX", "transY", "transZ", "rotX", "rotY", "rotZ")


@dataclass(frozen=True, slots=True, eq=False)
class Collider:
    """A prim that collides.

    Attributes:
        prim: The prim.
        mesh: Its shape in the frame and unit of the asset's surfaces; None if it is not closed.
    """

    prim: Any
    mesh: Mesh | None


@dataclass(frozen=True, slots=True, eq=False)
class StageFrame:
    """From the frame of a stage to that of the asset's surfaces, and its units.

    Attributes:
        turn: Rotation (3, 3) that makes z the upward axis.
        unit_m: Metres for each unit; None if the stage does not state it.
        unit_kg: Kilograms for each unit.
    """

    turn: FloatArray
    unit_m: float | None
    unit_kg: float

    def world(self, prim: Any, cache: Any) -> FloatArray:
        """The transform (4, 4) of a prim's points to the frame of the surfaces: columns, so that it stands left of a point."""
        matrix = np.eye(4)
        matrix[:3, :3] = self.turn
        placed: FloatArray = matrix @ np.array(cache.GetLocalToWorldTransform(prim)).T
        return placed


@dataclass(frozen=True, slots=True)
class Joints:
    """What joins the bodies.

    Attributes:
        num_movable: Joints that can move.
        num_groups: Groups of bodies that are fixed to each other.
        is_static: Whether a body is fixed to the world, or moved by no physics.
    """

    num_movable: int
    num_groups: int
    is_static: bool


def bodies_of(root: Any) -> list[Any]:
    """The rigid bodies at and below a prim, in order."""
    from pxr import UsdPhysics

    bodies = [prim for prim in prims_of(root) if prim.HasAPI(UsdPhysics.RigidBodyAPI)]
    return [prim for prim in bodies if UsdPhysics.RigidBodyAPI(prim).GetRigidBodyEnabledAttr().Get() is not False]


def prims_of(root: Any) -> Iterator[Any]:
    """A prim and all below it, with those of instances; not those that a point instancer copies, since it is not read."""
    from pxr import Usd, UsdGeom

    prims = iter(Usd.PrimRange(root, Usd.TraverseInstanceProxies()))
    for prim in prims:
        if prim.IsA(UsdGeom.PointInstancer):
            prims.PruneChildren()
        yield prim


def joints_of(root: Any, bodies: Sequence[Any]) -> Joints:
    """Reads the joints at and below a prim."""
    from pxr import UsdPhysics

    groups: nx.Graph[str] = nx.Graph()
    groups.add_nodes_from(str(body.GetPath()) for body in bodies)
    num_movable, is_static = 0, False
    for body in bodies:
        is_static |= bool(UsdPhysics.RigidBodyAPI(body).GetKinematicEnabledAttr().Get())
    for prim in prims_of(root):
        if not prim.IsA(UsdPhysics.Joint) or UsdPhysics.Joint(prim).GetJointEnabledAttr().Get() is False:
            continue
        if not _is_fixed(prim):
            num_movable += 1
            continue
        one, other = [
            _body_of(prim, relation.GetTargets(), groups)
            for relation in (prim.GetRelationship(f"physics:body{k}") for k in (0, 1))
        ]
        if one is None or other is None:
            is_static = True
        else:
            groups.add_edge(one, other)
    return Joints(num_movable, nx.number_connected_components(groups), is_static)


def _is_fixed(joint: Any) -> bool:
    """Whether a joint leaves no motion: a fixed one, or one whose six axes are locked (the lower limit above the upper)."""
    from pxr import UsdPhysics

    if joint.IsA(UsdPhysics.FixedJoint):
        return True
    if joint.GetTypeName() != "PhysicsJoint":
        return False
    for axis in _FIXED_AXES:
        limit = UsdPhysics.LimitAPI.Get(joint, axis)
        if not joint.HasAPI(UsdPhysics.LimitAPI, axis) or not limit.GetLowAttr().Get() > limit.GetHighAttr().Get():
            return False
    return True


def _body_of(joint: Any, targets: Sequence[Any], bodies: Any) -> str | None:
    """The body at one end of a joint, at or above its target; None for the world."""
    path = targets[0] if targets else None
    while path is not None and not path.isEmpty and str(path) not in bodies and str(path) != "/":
        path = path.GetParentPath()
    return str(path) if path is not None and str(path) in bodies else None


def friction_of(colliders: Sequence[Collider]) -> tuple[Vec3 | None, bool]:
    """Friction of the colliders.

    Returns:
        The friction, the mean by surface if they differ, None if none states it; and whether they differ.
    """
    from pxr import UsdPhysics, UsdShade

    found: list[tuple[float, float]] = []
    for collider in colliders:
        material, _ = UsdShade.MaterialBindingAPI(collider.prim).ComputeBoundMaterial("physics")
        if not material or not material.GetPrim().HasAPI(UsdPhysics.MaterialAPI):
            continue
        api = UsdPhysics.MaterialAPI(material.GetPrim())
        for attribute in (api.GetDynamicFrictionAttr(), api.GetStaticFrictionAttr()):
            if attribute.HasAuthoredValue() and 0 <= (value := float(attribute.Get())) < float("inf"):
                found.append((value, 0.0 if collider.mesh is None else float(double_areas(collider.mesh).sum())))
                break
    if not found:
        return None, False
    values, areas = np.array(found).T
    if (values == values[0]).all():
        return (float(values[0]), _TORSIONAL, _ROLLING), False
    mean = float(np.average(values, weights=areas if areas.sum() > 0 else None))
    return (mean, _TORSIONAL, _ROLLING), True


def inertial_of(
    root: Any, bodies: Sequence[Any], colliders: Sequence[Collider], frame: StageFrame, cache: Any
) -> GivenInertial | None:
    """The mass of an asset: of all its bodies, or of its root without any. If one body has none, it is not known.

    What a body states wins. The rest follows from its colliders, if one of these has a mass or a density: each has the mass that it
    states, else that of a density, which it, its body or its physics material states, in this order, else that of the density which
    UsdPhysics assumes. A collider is homogeneous, unless it states its centre of mass and inertia.
    """
    parts: list[GivenInertial] = []
    for body in bodies or [root]:
        path = body.GetPath()
        part = _inertial(body, [one for one in colliders if one.prim.GetPath().HasPrefix(path)], frame, cache)
        if part is None:
            return None
        parts.append(part)
    whole, length = _joined(parts), frame.unit_m
    if length is None:
        return GivenInertial(whole.mass * frame.unit_kg, is_weighed=whole.is_weighed)
    return GivenInertial(
        whole.mass * frame.unit_kg,
        None if whole.center_of_mass is None else _vec3(np.multiply(whole.center_of_mass, length)),
        None if whole.inertia is None else whole.inertia * frame.unit_kg * length**2,
        whole.is_weighed,
    )


def _joined(parts: Sequence[GivenInertial]) -> GivenInertial:
    """The mass properties of what is fixed to each other, in any units."""
    if len(parts) == 1:
        return parts[0]
    mass = sum(part.mass for part in parts)
    is_weighed = all(part.is_weighed for part in parts)
    known = [(part.mass, np.array(part.center_of_mass), part.inertia) for part in parts if part.center_of_mass is not None]
    if len(known) < len(parts):
        return GivenInertial(mass, is_weighed=is_weighed)
    centre = np.asarray(sum(one * place for one, place, _ in known) / mass)
    inertia = np.zeros((3, 3))
    for one, place, tensor in known:
        if tensor is None:
            return GivenInertial(mass, _vec3(centre), is_weighed=is_weighed)
        offset = place - centre
        inertia += tensor + one * (offset @ offset * np.eye(3) - np.outer(offset, offset))
    return GivenInertial(mass, _vec3(centre), inertia, is_weighed)


def _inertial(body: Any, colliders: Sequence[Collider], frame: StageFrame, cache: Any) -> GivenInertial | None:
    """The mass properties of a body, in the units of the stage; None if its mass is not known."""
    own, found = _stated(body, frame, cache), _of_colliders(body, colliders, frame, cache)
    if own.mass is not None:
        whole = GivenInertial(own.mass)
        if found is not None:
            inertia = None if found.inertia is None else found.inertia * (own.mass / found.mass)
            whole = GivenInertial(own.mass, found.center_of_mass, inertia)
    elif found is not None:
        whole = found
    else:
        return None
    if own.center is not None:  # an inertia about another centre does not count
        whole = replace(whole, center_of_mass=own.center, inertia=None)
    return whole if own.inertia is None else replace(whole, inertia=own.inertia)


def _of_colliders(body: Any, colliders: Sequence[Collider], frame: StageFrame, cache: Any) -> GivenInertial | None:
    """What the colliders of a body give; None if nothing is stated, or a volume that is needed is not known."""
    of_body = _stated(body, frame, cache).density
    states = [_stated(collider.prim, frame, cache) for collider in colliders]
    densities = [
        state.density or of_body or _material_density(collider.prim) for state, collider in zip(states, colliders, strict=True)
    ]
    if not any(state.mass or density for state, density in zip(states, densities, strict=True)):
        return None
    parts: list[GivenInertial] = []
    for collider, state, density in zip(colliders, states, densities, strict=True):
        assumed = None if frame.unit_m is None else _ASSUMED_DENSITY * frame.unit_m**3 / frame.unit_kg
        part = _of_collider(collider, state, density or assumed)
        if part is None:
            return None
        parts.append(part)
    return _joined(parts)


def _of_collider(collider: Collider, state: "_Stated", density: float | None) -> GivenInertial | None:
    mesh = collider.mesh
    volume = 0.0 if mesh is None else float(signed_volumes(mesh.triangles).sum())
    if mesh is None or not 0 < abs(volume) < float("inf"):
        return None if state.mass is None else GivenInertial(state.mass, state.center, state.inertia)
    mass = state.mass
    if mass is None:
        if density is None:
            return None
        mass = density * abs(volume)
    solid = mesh if volume > 0 else Mesh(mesh.vertices, mesh.faces[:, ::-1])
    even = mass_properties(solid, mass=mass)
    if state.center is None:
        center, inertia = _vec3(even.center_of_mass), even.inertia
    else:
        center, inertia = state.center, None
    return GivenInertial(mass, center, inertia if state.inertia is None else state.inertia, state.mass is not None)


@dataclass(frozen=True, slots=True, eq=False)
class _Stated:
    """What the mass API of a prim states, in the frame of the asset's surfaces and the units of the stage; None if it does not."""

    mass: float | None = None
    density: float | None = None
    center: Vec3 | None = None
    inertia: FloatArray | None = None


def _stated(prim: Any, frame: StageFrame, cache: Any) -> _Stated:
    from pxr import UsdPhysics

    if not prim.HasAPI(UsdPhysics.MassAPI):
        return _Stated()
    api, world = UsdPhysics.MassAPI(prim), frame.world(prim, cache)
    stated = np.array(api.GetCenterOfMassAttr().Get(), float)
    is_placed = api.GetCenterOfMassAttr().HasAuthoredValue() and np.isfinite(stated).all()
    diagonal, inertia = np.array(api.GetDiagonalInertiaAttr().Get(), float), None
    # LAPACK never ends with numbers that are infinite.
    if np.isfinite(diagonal).all() and (diagonal > 0).all() and np.isfinite(world).all():
        # Inertia is not scaled with the prim: only the rotation of its frame counts.
        left, _, right = np.linalg.svd(world[:3, :3])
        axes = left @ right @ _rotation(api.GetPrincipalAxesAttr().Get())
        inertia = axes @ np.diag(diagonal) @ axes.T
    return _Stated(
        _positive(api.GetMassAttr()),
        _positive(api.GetDensityAttr()),
        _vec3(world[:3, :3] @ stated + world[:3, 3]) if is_placed else None,
        inertia,
    )


def _positive(attribute: Any) -> float | None:
    """A number above 0; None for others, which state nothing."""
    value = float(attribute.Get())
    return value if 0 < value < float("inf") else None


def _material_density(prim: Any) -> float | None:
    from pxr import UsdPhysics, UsdShade

    material, _ = UsdShade.MaterialBindingAPI(prim).ComputeBoundMaterial("physics")
    if not material or not material.GetPrim().HasAPI(UsdPhysics.MaterialAPI):
        return None
    return _positive(UsdPhysics.MaterialAPI(material.GetPrim()).GetDensityAttr())


def _rotation(quat: Any) -> FloatArray:
    """The rotation (3, 3) of a quaternion of USD; none for zeros, which mean that nothing is stated."""
    w, (x, y, z) = float(quat.GetReal()), (float(part) for part in quat.GetImaginary())
    norm = x * x + y * y + z * z + w * w
    return rotation_matrix(normalise_quat((x, y, z, w))) if 0 < norm < float("inf") else np.eye(3)


def _vec3(values: FloatArray) -> Vec3:
    x, y, z = (float(value) for value in values)
    return x, y, z
