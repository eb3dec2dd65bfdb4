"""Mass, friction and joints of a composed USD stage, as UsdPhysics states them."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Any

import networkx as nx
import numpy as np

from stable_data.geometry.mesh import Mesh, double_areas, signed_volumes
from stable_data.importers.source import GivenInertial
from stable_data.rotations import normalise_quat, rotation_matrix
from stable_data.scene import FloatArray, Vec3

_TORSIONAL, _ROLLING = 0.005, 0.0001  # m; MuJoCo's defaults: USD states sliding friction alone
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
    """The mass of an asset: of all its bodies, or of its root without any.

    The mass of a body is the one that it states, else the sum of those that its colliders state, else what follows from a density
    that it, its colliders or their physics materials state. Without any of these, or if one body has none, it is not known.
    """
    parts: list[GivenInertial] = []
    for body in bodies or [root]:
        path = body.GetPath()
        part = _inertial(body, [one for one in colliders if one.prim.GetPath().HasPrefix(path)], frame, cache)
        if part is None:
            return None
        parts.append(part)
    if len(parts) == 1:
        return parts[0]
    mass = sum(part.mass for part in parts)
    is_weighed = all(part.is_weighed for part in parts)
    known = [(part.mass, np.array(part.center_of_mass), part.inertia) for part in parts if part.center_of_mass is not None]
    if len(known) < len(parts):
        return GivenInertial(mass, is_weighed=is_weighed)
    centre = sum(one * place for one, place, _ in known) / mass
    x, y, z = np.asarray(centre).tolist()
    inertia = np.zeros((3, 3))
    for one, place, tensor in known:
        if tensor is None:
            return GivenInertial(mass, (x, y, z), is_weighed=is_weighed)
        offset = place - centre
        inertia += tensor + one * (offset @ offset * np.eye(3) - np.outer(offset, offset))
    return GivenInertial(mass, (x, y, z), inertia, is_weighed)


def _inertial(body: Any, colliders: Sequence[Collider], frame: StageFrame, cache: Any) -> GivenInertial | None:
    from pxr import UsdPhysics

    mass = _stated_mass(body)
    if mass is None:
        masses = [_stated_mass(collider.prim) for collider in colliders]
        if masses and None not in masses:
            return GivenInertial(sum(filter(None, masses)) * frame.unit_kg)
        return _of_densities(body, colliders, frame)
    if frame.unit_m is None or not body.HasAPI(UsdPhysics.MassAPI):
        return GivenInertial(mass * frame.unit_kg)
    api, world = UsdPhysics.MassAPI(body), frame.world(body, cache)
    stated = np.array(api.GetCenterOfMassAttr().Get(), float)
    centre: Vec3 | None = None
    if api.GetCenterOfMassAttr().HasAuthoredValue() and np.isfinite(stated).all():
        x, y, z = ((world[:3, :3] @ stated + world[:3, 3]) * frame.unit_m).tolist()
        centre = x, y, z
    diagonal = np.array(api.GetDiagonalInertiaAttr().Get(), float)
    if not (np.isfinite(diagonal).all() and (diagonal > 0).all()):
        return GivenInertial(mass * frame.unit_kg, centre)
    # Inertia is not scaled with the body: only the rotation of its frame counts.
    left, _, right = np.linalg.svd(world[:3, :3])
    axes = left @ right @ _rotation(api.GetPrincipalAxesAttr().Get())
    inertia = axes @ np.diag(diagonal) @ axes.T * frame.unit_kg * frame.unit_m**2
    return GivenInertial(mass * frame.unit_kg, centre, inertia)


def _stated_mass(prim: Any) -> float | None:
    from pxr import UsdPhysics

    if not prim.HasAPI(UsdPhysics.MassAPI):
        return None
    mass = float(UsdPhysics.MassAPI(prim).GetMassAttr().Get())
    return mass if 0 < mass < float("inf") else None


def _of_densities(body: Any, colliders: Sequence[Collider], frame: StageFrame) -> GivenInertial | None:
    """The mass that follows from stated densities; None if a collider has none or is not closed."""
    mass = 0.0
    for collider in colliders:
        density = _stated_density(body) or _stated_density(collider.prim) or _material_density(collider.prim)
        if density is None or collider.mesh is None:
            return None
        mass += density * abs(float(signed_volumes(collider.mesh.triangles).sum())) * frame.unit_kg
    return GivenInertial(mass, is_weighed=False) if mass > 0 else None


def _stated_density(prim: Any) -> float | None:
    from pxr import UsdPhysics

    if not prim.HasAPI(UsdPhysics.MassAPI):
        return None
    density = float(UsdPhysics.MassAPI(prim).GetDensityAttr().Get())
    return density if 0 < density < float("inf") else None


def _material_density(prim: Any) -> float | None:
    from pxr import UsdPhysics, UsdShade

    material, _ = UsdShade.MaterialBindingAPI(prim).ComputeBoundMaterial("physics")
    if not material or not material.GetPrim().HasAPI(UsdPhysics.MaterialAPI):
        return None
    density = float(UsdPhysics.MaterialAPI(material.GetPrim()).GetDensityAttr().Get())
    return density if 0 < density < float("inf") else None


def _rotation(quat: Any) -> FloatArray:
    """The rotation (3, 3) of a quaternion of USD; none for zeros, which mean that nothing is stated."""
    w, (x, y, z) = float(quat.GetReal()), (float(part) for part in quat.GetImaginary())
    norm = x * x + y * y + z * z + w * w
    return rotation_matrix(normalise_quat((x, y, z, w))) if 0 < norm < float("inf") else np.eye(3)
