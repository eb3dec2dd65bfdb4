"""Physics of USD assets: bodies, joints, masses and collision shapes."""

from collections.abc import Callable
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from pxr import Gf, Usd, UsdGeom, UsdPhysics, UsdShade

from stable_data.geometry.mesh import signed_volumes
from tests.stable_data.importers.usd.stages import add_box, bind, read, refusal, save, stage_at


def two_bodies(path: Path, join: Callable[[Any], Any] | None) -> None:
    """Two cubes with side 2 at x = 0 and 10, of 1 and 3 kg, joined by what ``join`` makes."""
    stage = stage_at(path)
    for k, mass in enumerate((1, 3)):
        cube = UsdGeom.Cube.Define(stage, f"/Thing/b{k}")
        cube.AddTranslateOp().Set((10 * k, 0, 0))
        UsdPhysics.RigidBodyAPI.Apply(cube.GetPrim())
        UsdPhysics.CollisionAPI.Apply(cube.GetPrim())
        api = UsdPhysics.MassAPI.Apply(cube.GetPrim())
        api.CreateMassAttr(mass)
        api.CreateCenterOfMassAttr(Gf.Vec3f(0, 0, 0))
        api.CreateDiagonalInertiaAttr(Gf.Vec3f(1, 1, 1))
    if join is not None:
        joint = join(stage)
        joint.CreateBody0Rel().SetTargets(["/Thing/b0"])
        joint.CreateBody1Rel().SetTargets(["/Thing/b1"])
    save(stage)


def locked(stage: Any) -> Any:
    joint = UsdPhysics.Joint.Define(stage, "/Thing/joint")
    for axis in ("transX", "transY", "transZ", "rotX", "rotY", "rotZ"):
        limit = UsdPhysics.LimitAPI.Apply(joint.GetPrim(), axis)
        limit.CreateLowAttr(1)
        limit.CreateHighAttr(-1)
    return joint


@pytest.mark.parametrize("join", [lambda stage: UsdPhysics.FixedJoint.Define(stage, "/Thing/joint"), locked])
def test_fixed_bodies_are_one(tmp_path: Path, join: Callable[[Any], Any]) -> None:
    two_bodies(tmp_path / "thing.usda", join)
    asset = read(tmp_path)
    assert (asset.num_joints, asset.is_static) == (0, False)
    given = asset.inertial
    assert given is not None
    assert given.mass == 4
    np.testing.assert_allclose(given.center_of_mass, [7.5, 0, 0])  # type: ignore[arg-type]
    assert given.inertia is not None
    np.testing.assert_allclose(given.inertia, np.diag([2, 77, 77]))


def test_bodies_that_are_not_joined_are_refused_and_joints_counted(tmp_path: Path) -> None:
    two_bodies(tmp_path / "thing.usda", None)
    assert refusal(tmp_path).code == "composite"
    two_bodies(tmp_path / "hinged.usda", lambda stage: UsdPhysics.RevoluteJoint.Define(stage, "/Thing/joint"))
    assert read(tmp_path, "hinged.usda").num_joints == 1


def test_a_body_that_is_fixed_to_the_world(tmp_path: Path) -> None:
    stage = stage_at(tmp_path / "thing.usda")
    UsdPhysics.RigidBodyAPI.Apply(add_box(stage, "/Thing/box").GetPrim())
    joint = UsdPhysics.FixedJoint.Define(stage, "/Thing/joint")
    joint.CreateBody1Rel().SetTargets(["/Thing/box"])
    save(stage)
    assert read(tmp_path).is_static


@pytest.mark.parametrize(
    ("body_density", "material_density", "collider_mass", "mass", "is_weighed"),
    [(0, 0, 0, None, False), (100, 900, 0, 800.0, False), (0, 900, 0, 7200.0, False), (0, 900, 5, 5.0, True)],
)
def test_what_a_mass_rests_on(
    tmp_path: Path, body_density: float, material_density: float, collider_mass: float, mass: float | None, is_weighed: bool
) -> None:
    stage = stage_at(tmp_path / "thing.usda")
    UsdPhysics.RigidBodyAPI.Apply(stage.GetDefaultPrim())
    UsdPhysics.MassAPI.Apply(stage.GetDefaultPrim()).CreateDensityAttr(body_density)
    box = add_box(stage, "/Thing/box").GetPrim()
    UsdPhysics.CollisionAPI.Apply(box)
    UsdPhysics.MassAPI.Apply(box).CreateMassAttr(collider_mass)
    material = UsdShade.Material.Define(stage, "/Thing/m")
    UsdPhysics.MaterialAPI.Apply(material.GetPrim()).CreateDensityAttr(material_density)
    bind(box, material)
    save(stage)
    stated = read(tmp_path).inertial
    if mass is None:
        assert stated is None
    else:
        assert stated is not None
        assert stated.mass == pytest.approx(mass)
        assert stated.is_weighed is is_weighed


STATED = st.sampled_from([0.0, 0.0, 3.0, 500.0])


@settings(max_examples=30, deadline=None)
@given(STATED, STATED, st.tuples(STATED, STATED), st.tuples(STATED, STATED), STATED, st.booleans())
def test_mass_properties_are_those_that_usd_computes(
    mass: float,
    density: float,
    masses: tuple[float, float],
    densities: tuple[float, float],
    material_density: float,
    has_center: bool,
) -> None:
    stage = Usd.Stage.CreateInMemory()
    UsdGeom.SetStageUpAxis(stage, "Z")
    UsdGeom.SetStageMetersPerUnit(stage, 1.0)
    thing = UsdGeom.Xform.Define(stage, "/Thing").GetPrim()
    stage.SetDefaultPrim(thing)
    UsdPhysics.RigidBodyAPI.Apply(thing)
    material = UsdShade.Material.Define(stage, "/Thing/m")
    UsdPhysics.MaterialAPI.Apply(material.GetPrim()).CreateDensityAttr(material_density)
    own = UsdPhysics.MassAPI.Apply(thing)
    own.CreateMassAttr(mass)
    own.CreateDensityAttr(density)
    for k in (0, 1):
        box = add_box(stage, f"/Thing/box{k}")
        box.AddTranslateOp().Set((3 * k, k, 0))
        box.AddRotateZOp().Set(90 * k)
        UsdPhysics.CollisionAPI.Apply(box.GetPrim())
        api = UsdPhysics.MassAPI.Apply(box.GetPrim())
        api.CreateMassAttr(masses[k])
        api.CreateDensityAttr(densities[k])
        if k == 0:
            bind(box.GetPrim(), material, "physics")
            if has_center:
                api.CreateCenterOfMassAttr(Gf.Vec3f(0.2, 1.5, 1.0))
                api.CreateDiagonalInertiaAttr(Gf.Vec3f(2, 3, 4))

    def solid(prim: Any) -> Any:
        of_box = UsdPhysics.RigidBodyAPI.MassInformation()
        place = UsdGeom.Xformable(prim).GetLocalTransformation()
        of_box.volume, of_box.centerOfMass = 8.0, Gf.Vec3f(0.5, 1, 2)
        of_box.inertia = Gf.Matrix3f(*(np.diag([20.0, 17.0, 5.0]) * 8 / 12).ravel().tolist())
        of_box.localPos = Gf.Vec3f(place.ExtractTranslation())
        of_box.localRot = Gf.Quatf(place.ExtractRotation().GetQuat())
        return of_box

    with TemporaryDirectory() as folder:
        stage.Export(str(Path(folder, "thing.usda")))
        found = read(Path(folder)).inertial
    expected, moments, center, axes = UsdPhysics.RigidBodyAPI(thing).ComputeMassProperties(solid)
    if not any((mass, density, *masses, *densities, material_density)):
        assert found is None
        return
    assert found is not None
    assert found.mass == pytest.approx(expected, rel=1e-5)
    if found.center_of_mass is None:
        assert not any((density, *masses, *densities, material_density)), "nothing is known of the colliders"
        return
    np.testing.assert_allclose(found.center_of_mass, center, rtol=1e-5)
    assert found.inertia is not None
    turn = np.array(Gf.Matrix3d(Gf.Rotation(axes))).T
    np.testing.assert_allclose(found.inertia, turn @ np.diag(moments) @ turn.T, rtol=1e-3, atol=1e-3 * max(moments))


@pytest.mark.parametrize(
    ("approximation", "closed", "volume"),
    [
        ("none", True, 8),
        ("convexDecomposition", True, 8),
        ("none", False, None),
        ("convexHull", False, 8),
        ("boundingCube", False, 8),
    ],
)
def test_collision_shapes(tmp_path: Path, approximation: str, closed: bool, volume: float | None) -> None:
    stage = stage_at(tmp_path / "thing.usda")
    mesh = add_box(stage, "/Thing/box")
    if not closed:
        mesh.CreateHoleIndicesAttr([0])
    UsdPhysics.CollisionAPI.Apply(mesh.GetPrim())
    UsdPhysics.MeshCollisionAPI.Apply(mesh.GetPrim()).CreateApproximationAttr(approximation)
    save(stage)
    colliders = read(tmp_path).colliders
    assert [float(signed_volumes(c.triangles).sum()) for c in colliders] == ([] if volume is None else [pytest.approx(volume)])
