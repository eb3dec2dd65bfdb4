"""USD assets: units, axes, transforms, shapes and words, and files of other authors."""

import math
from pathlib import Path

import numpy as np
import pytest
from pxr import Gf, Sdf, Usd, UsdGeom, UsdPhysics, UsdShade

from stable_data.errors import ConfigError, Notice
from stable_data.geometry.mesh import is_closed, signed_volumes
from tests.stable_data.importers.usd.stages import (
    NEWTON,
    add_box,
    bind,
    box_of,
    found,
    read,
    read_all,
    refusal,
    save,
    stage_at,
    volume_of,
)


def test_files_of_newton_are_as_usd_sees_them() -> None:
    notices = {ref.item_id: ref.code for ref in found(NEWTON) if isinstance(ref, Notice)}
    assert notices == {}
    plug = read(NEWTON, "rj45_plug.usd")
    stage = Usd.Stage.Open(str(NEWTON / "rj45_plug.usd"))
    corners, num = [], 0
    for prim in stage.Traverse():
        if prim.IsA(UsdGeom.Mesh):
            mesh = UsdGeom.Mesh(prim)
            matrix = np.array(mesh.ComputeLocalToWorldTransform(0))
            corners.append(np.array(mesh.GetPointsAttr().Get(), float) @ matrix[:3, :3] + matrix[3, :3])
            num += len(mesh.GetFaceVertexIndicesAttr().Get()) - 2 * len(mesh.GetFaceVertexCountsAttr().Get())
    every = np.concatenate(corners)
    np.testing.assert_allclose(box_of(plug), [every.min(axis=0), every.max(axis=0)], atol=1e-9)
    assert sum(len(surface.triangles) for surface in plug.surfaces) == num
    assert plug.unit_m == 1.0
    assert plug.is_upright
    assert [notice.code for notice in plug.notices] == ["prim_left_out"], "a curve"


def test_a_mirrored_shape_of_newton_keeps_its_outside() -> None:
    cube = read(NEWTON, "negative_scale_cube.usda")
    assert volume_of(cube) == pytest.approx(0.75)
    assert cube.inertial is not None
    assert (cube.inertial.mass, cube.inertial.is_weighed) == (1.0, True)
    (collider,) = cube.colliders
    assert float(signed_volumes(collider.triangles).sum()) == pytest.approx(0.75)


def test_joints_and_neighbours_of_newton() -> None:
    chain = read(NEWTON, "four_link_chain_articulation.usda")
    assert (chain.num_joints, chain.is_static) == (3, True)
    assert chain.inertial is not None
    assert chain.inertial.mass == 8.0
    assert refusal(NEWTON, "cube_cylinder.usda").code == "composite"


def test_centimetres_grams_and_the_y_axis(tmp_path: Path) -> None:
    stage = stage_at(tmp_path / "thing.usda", "Y", 0.01)
    UsdPhysics.SetStageKilogramsPerUnit(stage, 0.001)
    prim = stage.GetDefaultPrim()
    UsdGeom.XformCommonAPI(prim).SetTranslate((10, 20, 30))
    UsdGeom.XformCommonAPI(prim).SetRotate((0, 90, 0))
    UsdPhysics.RigidBodyAPI.Apply(prim)
    mass = UsdPhysics.MassAPI.Apply(prim)
    mass.CreateMassAttr(250)
    mass.CreateCenterOfMassAttr(Gf.Vec3f(0.5, 1, 2))
    mass.CreateDiagonalInertiaAttr(Gf.Vec3f(1, 2, 2.5))
    mass.CreatePrincipalAxesAttr(Gf.Quatf(math.sqrt(0.5), 0, 0, math.sqrt(0.5)))  # a quarter turn about z
    box = add_box(stage, "/Thing/box").GetPrim()
    UsdPhysics.CollisionAPI.Apply(box)
    UsdPhysics.MeshCollisionAPI.Apply(box).CreateApproximationAttr("convexHull")
    material = UsdShade.Material.Define(stage, "/Thing/rubber")
    UsdPhysics.MaterialAPI.Apply(material.GetPrim()).CreateDynamicFrictionAttr(0.9)
    bind(box, material, "physics")
    save(stage)
    asset = read(tmp_path)
    assert asset.unit_m == 0.01
    assert asset.is_upright
    # Stage: turned by a quarter about y, (x, y, z) -> (z, y, -x), moved; then y becomes z: (x, y, z) -> (x, -z, y).
    np.testing.assert_allclose(box_of(asset), [[10, -30, 20], [14, -29, 22]], atol=1e-6)
    assert volume_of(asset) == pytest.approx(8)
    assert asset.inertial is not None
    assert asset.inertial.mass == pytest.approx(0.25)
    np.testing.assert_allclose(asset.inertial.center_of_mass, [0.12, -0.295, 0.21], atol=1e-8)  # type: ignore[arg-type]
    # Along the body's axes the moments are 2, 1, 2.5; those of x, y, z become those of -y, z, x of the surfaces.
    assert asset.inertial.inertia is not None
    np.testing.assert_allclose(asset.inertial.inertia, np.diag([2.5, 2, 1]) * 1e-7, atol=1e-13)
    assert asset.friction is not None
    assert asset.friction == pytest.approx((0.9, 0.005, 0.0001))
    (collider,) = asset.colliders
    assert is_closed(collider)
    np.testing.assert_allclose([collider.vertices.min(axis=0), collider.vertices.max(axis=0)], box_of(asset))


def test_a_stage_that_states_no_unit_and_no_axis(tmp_path: Path) -> None:
    (tmp_path / "thing.usda").write_text('#usda 1.0\n(defaultPrim = "T")\ndef Cube "T"\n{\n double size = 2\n}\n')
    asset = read(tmp_path)
    assert (asset.unit_m, asset.is_upright) == (None, False)
    assert read(tmp_path, unit_m=0.5, up="z", front="x").unit_m == 0.5
    assert read(tmp_path, up="z", front="x").front == (1.0, 0.0, 0.0)
    assert read(tmp_path, front="z").front == (0.0, -1.0, 0.0)
    with pytest.raises(ConfigError, match="y or z"):
        read(tmp_path, up="x")


def test_a_turned_and_mirrored_mesh_with_left_handed_faces(tmp_path: Path) -> None:
    stage = stage_at(tmp_path / "thing.usda")
    for name, scale, orientation in (("a", (-1, 1, 1), "rightHanded"), ("b", (1, 1, 1), "leftHanded")):
        mesh = add_box(stage, f"/Thing/{name}")
        mesh.AddTranslateOp().Set((5, 0, 0))
        mesh.AddScaleOp().Set(scale)
        mesh.CreateOrientationAttr(orientation)
    save(stage)
    one, two = read(tmp_path).surfaces
    assert float(signed_volumes(one.triangles).sum()) == pytest.approx(8)
    assert float(signed_volumes(two.triangles).sum()) == pytest.approx(-8), "its faces are inside out, as the file says"


@pytest.mark.parametrize("axis", ["X", "Y", "Z"])
def test_simple_shapes(tmp_path: Path, axis: str) -> None:
    stage = stage_at(tmp_path / "thing.usda")
    for name, kind in (("cylinder", UsdGeom.Cylinder), ("capsule", UsdGeom.Capsule)):
        shape = kind.Define(stage, f"/Thing/{name}")
        shape.CreateAxisAttr(axis)
        shape.CreateRadiusAttr(0.5)
        shape.CreateHeightAttr(3)
        UsdPhysics.CollisionAPI.Apply(shape.GetPrim())
    UsdPhysics.CollisionAPI.Apply(UsdGeom.Sphere.Define(stage, "/Thing/sphere").GetPrim())
    cone = UsdGeom.Cone.Define(stage, "/Thing/cone")
    cone.CreateAxisAttr(axis)
    UsdPhysics.CollisionAPI.Apply(cone.GetPrim())
    UsdGeom.Points.Define(stage, "/Thing/points")
    save(stage)
    asset = read(tmp_path)
    along = "XYZ".index(axis)
    sizes = [np.ptp(surface.triangles.reshape(-1, 3), axis=0).round(9).tolist() for surface in asset.surfaces]
    assert sizes == [
        [3.0 if k == along else 1.0 for k in range(3)],
        [4.0 if k == along else 1.0 for k in range(3)],
        [2.0] * 3,
        [2.0] * 3,
    ]
    assert [round(float(signed_volumes(c.triangles).sum()), 1) for c in asset.colliders] == [2.3, 2.9, 4.2, 2.1]
    assert all(is_closed(collider) for collider in asset.colliders)
    assert [notice.code for notice in asset.notices] == ["prim_left_out"]


def test_labels_names_and_licences(tmp_path: Path) -> None:
    stage = stage_at(tmp_path / "thing.usda")
    prim = add_box(stage, "/Thing/box").GetPrim()
    for name, kind, data in (
        ("a", "class", "prop"),
        ("b", "class", "wine_bottle"),
        ("c", "hierarchy", "vessel/wine_bottle"),
        ("d", "qcode", "Q1"),
    ):
        prim.CreateAttribute(f"semantic:{name}:params:semanticType", Sdf.ValueTypeNames.String).Set(kind)
        prim.CreateAttribute(f"semantic:{name}:params:semanticData", Sdf.ValueTypeNames.String).Set(data)
    prim.CreateAttribute("semantics:labels:colour", Sdf.ValueTypeNames.TokenArray).Set(["green"])
    stage.GetDefaultPrim().SetAssetInfo({"name": "Bottle 3", "version": "1.2"})
    stage.GetRootLayer().customLayerData = {
        "creator": "a program",
        "author": "A. Uthor",
        "meta": {"license": "CC-BY-4.0", "sourceUrl": "https://a.b"},
        "description": "A bottle.",
    }
    stage.GetRootLayer().comment = "Licensed under MIT"
    save(stage)
    (tmp_path / "LICENSE.txt").write_text("CC0 1.0")
    (asset,) = read_all(tmp_path).values()
    assert (asset.name, asset.category, asset.author, asset.url) == ("Bottle 3", "wine bottle", "A. Uthor", "https://a.b")
    assert asset.tags == ("prop", "vessel/wine_bottle", "green")
    assert asset.description == "A bottle."
    assert [licence.text for licence in asset.licences] == ["CC-BY-4.0", "Licensed under MIT", "CC0 1.0"]
