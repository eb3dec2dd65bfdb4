"""USD assets: units, axes, transforms, materials, physics; and no layer outside of the folder is composed."""

import io
import math
import zipfile
from collections.abc import Callable
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from pxr import Gf, Sdf, Usd, UsdGeom, UsdPhysics, UsdShade, UsdUtils

from stable_data.errors import ConfigError, MeshError, Notice
from stable_data.geometry.mesh import area_vectors, is_closed, signed_volumes
from stable_data.importers.boundary import Boundary
from stable_data.importers.source import ReaderOptions, SourceAsset, SourceRef
from stable_data.importers.usd import UsdReader
from stable_data.importers.usd.scan import LayerScanner
from stable_data.importers.usd.shapes import triangulate

NEWTON = Path(__file__).parents[2] / "data" / "import" / "newton"
BOX = [(x, y, z) for z in (0, 4) for y in (0, 2) for x in (0, 1)]
BOX_FACES = [(0, 2, 3, 1), (4, 5, 7, 6), (0, 1, 5, 4), (2, 6, 7, 3), (0, 4, 6, 2), (1, 3, 7, 5)]


def found(folder: Path) -> list[SourceRef | Notice]:
    return list(UsdReader().find(Boundary(folder), ReaderOptions()))


def read_all(folder: Path, **options: Any) -> dict[str, SourceAsset]:
    """Reads every asset, and checks that all files that were opened had been planned."""
    assets = {}
    for ref in found(folder):
        assert isinstance(ref, SourceRef), ref
        boundary = Boundary(folder)
        assets[ref.asset_id] = UsdReader().read(boundary, ref, ReaderOptions(**options))
        assert boundary.opened <= set(ref.files)
    return assets


def read(folder: Path, path: str = "thing.usda", **options: Any) -> SourceAsset:
    return UsdReader().read(Boundary(folder), SourceRef("thing", path, (path,)), ReaderOptions(**options))


def refusal(folder: Path, path: str = "thing.usda", **options: Any) -> MeshError:
    with pytest.raises(MeshError) as caught:
        read(folder, path, **options)
    assert "\n" not in str(caught.value)
    return caught.value


def stage_at(path: Path, up: str = "Z", unit: float | None = 1.0) -> Any:
    """A stage whose default prim is ``/Thing``."""
    stage = Usd.Stage.CreateNew(str(path))
    UsdGeom.SetStageUpAxis(stage, up)
    if unit is not None:
        UsdGeom.SetStageMetersPerUnit(stage, unit)
    stage.SetDefaultPrim(UsdGeom.Xform.Define(stage, "/Thing").GetPrim())
    return stage


def add_box(stage: Any, path: str) -> Any:
    """A box of 1 x 2 x 4 units with a corner at the origin, as six polygons."""
    mesh = UsdGeom.Mesh.Define(stage, path)
    mesh.CreatePointsAttr(BOX)
    mesh.CreateFaceVertexCountsAttr([4] * 6)
    mesh.CreateFaceVertexIndicesAttr([k for face in BOX_FACES for k in face])
    mesh.CreateSubdivisionSchemeAttr("none")
    return mesh


def save(stage: Any) -> None:
    stage.GetRootLayer().Save()


def box_of(asset: SourceAsset) -> np.ndarray[Any, Any]:
    corners = np.concatenate([surface.triangles.reshape(-1, 3) for surface in asset.surfaces])
    return np.stack([corners.min(axis=0), corners.max(axis=0)])


def volume_of(asset: SourceAsset) -> float:
    return sum(float(signed_volumes(surface.triangles).sum()) for surface in asset.surfaces)


def add_material(stage: Any, path: str, texture: str = "", colour: tuple[float, float, float] = (0.2, 0.4, 0.6)) -> Any:
    """A preview surface, with a texture whose coordinates are moved by a half to the right, if one is named."""
    material = UsdShade.Material.Define(stage, path)
    shader = UsdShade.Shader.Define(stage, f"{path}/surface")
    shader.CreateIdAttr("UsdPreviewSurface")
    shader.CreateInput("opacity", Sdf.ValueTypeNames.Float).Set(0.75)
    diffuse = shader.CreateInput("diffuseColor", Sdf.ValueTypeNames.Color3f)
    diffuse.Set(colour)
    material.CreateSurfaceOutput().ConnectToSource(shader.ConnectableAPI(), "surface")
    if texture:
        reader = UsdShade.Shader.Define(stage, f"{path}/reader")
        reader.CreateIdAttr("UsdPrimvarReader_float2")
        name = material.CreateInput("uv_name", Sdf.ValueTypeNames.String)
        name.Set("map1")
        reader.CreateInput("varname", Sdf.ValueTypeNames.String).ConnectToSource(name)
        moved = UsdShade.Shader.Define(stage, f"{path}/moved")
        moved.CreateIdAttr("UsdTransform2d")
        moved.CreateInput("translation", Sdf.ValueTypeNames.Float2).Set(Gf.Vec2f(0.5, 0))
        moved.CreateInput("in", Sdf.ValueTypeNames.Float2).ConnectToSource(reader.ConnectableAPI(), "result")
        image = UsdShade.Shader.Define(stage, f"{path}/image")
        image.CreateIdAttr("UsdUVTexture")
        image.CreateInput("file", Sdf.ValueTypeNames.Asset).Set(texture)
        image.CreateInput("st", Sdf.ValueTypeNames.Float2).ConnectToSource(moved.ConnectableAPI(), "result")
        diffuse.ConnectToSource(image.ConnectableAPI(), "rgb")
    return material


def bind(prim: Any, material: Any, purpose: str = "") -> None:
    api = UsdShade.MaterialBindingAPI.Apply(prim)
    if purpose:
        api.Bind(material, materialPurpose=purpose)
    else:
        api.Bind(material)


# Files of other authors


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


# Units and axes


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


# Looks


def test_materials_textures_and_subsets(tmp_path: Path) -> None:
    (tmp_path / "textures").mkdir()
    (tmp_path / "textures" / "t.png").write_bytes(b"bytes of an image")
    stage = stage_at(tmp_path / "thing.usda")
    mesh = add_box(stage, "/Thing/box")
    uv = UsdGeom.PrimvarsAPI(mesh).CreatePrimvar("map1", Sdf.ValueTypeNames.TexCoord2fArray, UsdGeom.Tokens.faceVarying)
    uv.Set([(0, 0), (1, 0), (1, 1)])
    uv.SetIndices([0, 1, 2, 0] * 6)
    bind(mesh.GetPrim(), add_material(stage, "/Thing/textured", "./textures/t.png"))
    subset = UsdGeom.Subset.CreateGeomSubset(mesh, "top", UsdGeom.Tokens.face, [1], "materialBind")
    bind(subset.GetPrim(), add_material(stage, "/Thing/plain"))
    save(stage)
    (asset,) = read_all(tmp_path).values()
    plain, textured = asset.surfaces
    assert len(plain.triangles) == 2
    assert (plain.triangles[..., 2] == 4).all()
    assert plain.colour == pytest.approx((0.2, 0.4, 0.6))
    assert plain.opacity == textured.opacity == 0.75
    assert (plain.image, textured.image) == (None, b"bytes of an image")
    assert textured.colour is None
    assert textured.corner_uv is not None
    assert textured.corner_uv.shape == (10, 3, 2)
    np.testing.assert_allclose(textured.corner_uv[0], [[0.5, 1], [1.5, 1], [1.5, 0]])


def test_colours_of_corners_faces_and_prims(tmp_path: Path) -> None:
    stage = stage_at(tmp_path / "thing.usda")
    for name, interpolation, num in (("a", "constant", 1), ("b", "uniform", 6), ("c", "vertex", 8), ("d", "faceVarying", 24)):
        mesh = add_box(stage, f"/Thing/{name}")
        colours = mesh.CreateDisplayColorPrimvar(interpolation)
        colours.Set([(k / num, 0.5, 0) for k in range(num)])
    mesh.CreateDisplayOpacityPrimvar("constant").Set([0.25])
    save(stage)
    one, uniform, vertex, varying = read(tmp_path).surfaces
    assert one.colour == (0, 0.5, 0)
    assert one.corner_colours is None
    for surface in (uniform, vertex, varying):
        assert surface.corner_colours is not None
    assert uniform.corner_colours is not None
    np.testing.assert_allclose(uniform.corner_colours[2:4, :, 0], 1 / 6)
    assert vertex.corner_colours is not None
    np.testing.assert_allclose(vertex.corner_colours[0, :, 0], np.array([0, 2, 3]) / 8)
    assert varying.corner_colours is not None
    np.testing.assert_allclose(varying.corner_colours[1, :, 0], np.array([0, 2, 3]) / 24)
    assert varying.opacity == 0.25


@pytest.mark.parametrize(
    ("texture", "code"),
    [
        ("../secret.png", "texture_outside"),
        ("/etc/hostname", "texture_outside"),
        ("https://a.b/c.png", "texture_outside"),
        ("none.png", "texture_missing"),
        ("t.<UDIM>.png", "texture_missing"),
    ],
)
def test_a_texture_that_cannot_be_read_costs_the_texture_alone(tmp_path: Path, texture: str, code: str) -> None:
    folder = tmp_path / "inside"
    folder.mkdir()
    (tmp_path / "secret.png").write_bytes(b"secret")
    stage = stage_at(folder / "thing.usda")
    mesh = add_box(stage, "/Thing/box")
    UsdGeom.PrimvarsAPI(mesh).CreatePrimvar("map1", Sdf.ValueTypeNames.TexCoord2fArray, "vertex").Set([(0, 0)] * 8)
    bind(mesh.GetPrim(), add_material(stage, "/Thing/m", texture))
    save(stage)
    asset = read(folder)
    assert asset.surfaces[0].image is None
    assert [notice.code for notice in asset.notices] == [code]


def test_surfaces_of_omniverse(tmp_path: Path) -> None:
    (tmp_path / "t.png").write_bytes(b"image")
    stage = stage_at(tmp_path / "thing.usda")
    mesh = add_box(stage, "/Thing/box")
    UsdGeom.PrimvarsAPI(mesh).CreatePrimvar("st", Sdf.ValueTypeNames.TexCoord2fArray, "vertex").Set([(0.25, 0.25)] * 8)
    material = UsdShade.Material.Define(stage, "/Thing/m")
    shader = UsdShade.Shader.Define(stage, "/Thing/m/s")
    shader.SetSourceAsset("OmniPBR.mdl", "mdl")
    shader.CreateInput("diffuse_color_constant", Sdf.ValueTypeNames.Color3f).Set((0.1, 0.1, 0.1))
    shader.CreateInput("diffuse_texture", Sdf.ValueTypeNames.Asset).Set("t.png")
    shader.CreateInput("diffuse_tint", Sdf.ValueTypeNames.Color3f).Set((1, 0.5, 1))
    material.CreateSurfaceOutput("mdl").ConnectToSource(shader.ConnectableAPI(), "out")
    bind(mesh.GetPrim(), material)
    save(stage)
    (surface,) = read(tmp_path).surfaces
    assert (surface.image, surface.colour) == (b"image", (1.0, 0.5, 1.0))
    assert surface.corner_uv is not None
    np.testing.assert_allclose(surface.corner_uv, np.broadcast_to([0.25, 0.75], (12, 3, 2)))


def test_purposes_visibility_and_instances(tmp_path: Path) -> None:
    stage = stage_at(tmp_path / "part.usda")
    add_box(stage, "/Thing/box")
    save(stage)
    stage = stage_at(tmp_path / "thing.usda")
    for k in range(2):
        copy = stage.OverridePrim(f"/Thing/copy{k}")
        copy.GetReferences().AddReference("part.usda")
        copy.SetInstanceable(True)
        UsdGeom.Xformable(copy).AddTranslateOp().Set((10 * k, 0, 0))
    UsdGeom.Imageable(add_box(stage, "/Thing/hidden")).MakeInvisible()
    add_box(stage, "/Thing/proxy").CreatePurposeAttr("proxy")
    guide = add_box(stage, "/Thing/guide")
    guide.CreatePurposeAttr("guide")
    UsdPhysics.CollisionAPI.Apply(guide.GetPrim())
    save(stage)
    assets = read_all(tmp_path)
    assert list(assets) == ["thing"], "the part is no asset"
    np.testing.assert_allclose(box_of(assets["thing"]), [[0, 0, 0], [11, 2, 4]])
    assert len(assets["thing"].surfaces) == 2
    assert len(assets["thing"].colliders) == 1
    stage.RemovePrim("/Thing/copy0")
    stage.RemovePrim("/Thing/copy1")
    save(stage)
    assert len(read(tmp_path).surfaces) == 1, "without another look the proxy is seen"


# Physics


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


# Words


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


# Layers


def test_layers_in_other_folders_with_their_textures(tmp_path: Path) -> None:
    (tmp_path / "parts" / "maps").mkdir(parents=True)
    (tmp_path / "parts" / "maps" / "t.png").write_bytes(b"image")
    stage = stage_at(tmp_path / "parts" / "look.usdc")
    mesh = add_box(stage, "/Thing/box")
    UsdGeom.PrimvarsAPI(mesh).CreatePrimvar("map1", Sdf.ValueTypeNames.TexCoord2fArray, "vertex").Set([(0, 0)] * 8)
    bind(mesh.GetPrim(), add_material(stage, "/Thing/m", "maps/t.png"))
    save(stage)
    stage = stage_at(tmp_path / "thing.usda")
    stage.GetDefaultPrim().GetPayloads().AddPayload("./parts/look.usdc")
    save(stage)
    (ref,) = found(tmp_path)
    assert isinstance(ref, SourceRef)
    assert ref.files == ("thing.usda", "parts/look.usdc", "parts/maps/t.png")
    (asset,) = read_all(tmp_path).values()
    assert asset.surfaces[0].image == b"image"


def test_packages(tmp_path: Path) -> None:
    source = tmp_path / "source"
    (source / "maps").mkdir(parents=True)
    (source / "maps" / "t.png").write_bytes(b"image")
    stage = stage_at(source / "look.usda")
    mesh = add_box(stage, "/Thing/box")
    UsdGeom.PrimvarsAPI(mesh).CreatePrimvar("map1", Sdf.ValueTypeNames.TexCoord2fArray, "vertex").Set([(0, 0)] * 8)
    bind(mesh.GetPrim(), add_material(stage, "/Thing/m", "maps/t.png"))
    save(stage)
    folder = tmp_path / "folder"
    folder.mkdir()
    assert UsdUtils.CreateNewUsdzPackage(str(source / "look.usda"), str(folder / "mug.usdz"))
    assert read(folder, "mug.usdz").surfaces[0].image == b"image"
    stage = stage_at(folder / "with.usda")
    stage.OverridePrim("/Thing/part").GetReferences().AddReference("mug.usdz")
    save(stage)
    assets = read_all(folder)
    assert list(assets) == ["with"]
    assert assets["with"].surfaces[0].image == b"image"


def archive(members: dict[str, bytes], compression: int = zipfile.ZIP_STORED) -> bytes:
    buffer = io.BytesIO()
    with zipfile.ZipFile(buffer, "w", compression) as file:
        for name, content in members.items():
            file.writestr(name, content)
    return buffer.getvalue()


@pytest.mark.parametrize(
    ("content", "code"),
    [
        (archive({"a.usda": b"#usda 1.0\n" + b" " * 2**20}, zipfile.ZIP_DEFLATED), "archive_bomb"),
        (archive({}), "model_unreadable"),
        (archive({"a.txt": b"x"}), "model_unreadable"),
        (archive({f"{k}.usda": b"" for k in range(2001)}), "model_unreadable"),
        (b"PK but no archive", "model_unreadable"),
    ],
)
def test_packages_that_are_none(tmp_path: Path, content: bytes, code: str) -> None:
    (tmp_path / "thing.usdz").write_bytes(content)
    assert refusal(tmp_path, "thing.usdz").code == code
    assert [notice.code for notice in found(tmp_path) if isinstance(notice, Notice)] == [code]


@pytest.fixture
def outside(tmp_path: Path) -> Path:
    """The source folder; beside it is a layer that must not be read."""
    folder = tmp_path / "inside"
    folder.mkdir()
    stage = stage_at(tmp_path / "secret.usda")
    add_box(stage, "/Thing/secret")
    save(stage)
    (folder / "link.usda").symlink_to(tmp_path / "secret.usda")
    return folder


@pytest.mark.parametrize(
    "name", ["../secret.usda", "{parent}/secret.usda", "https://example.org/a.usda", "link.usda", "file:{parent}/secret.usda"]
)
@pytest.mark.parametrize("arc", ["references", "payload", "subLayers"])
def test_no_layer_outside_of_the_folder_is_composed(outside: Path, name: str, arc: str) -> None:
    name = name.format(parent=outside.parent)
    layers = f"subLayers = [@{name}@]" if arc == "subLayers" else ""
    arcs = "" if layers else f"(prepend {arc} = @{name}@)"
    text = f'#usda 1.0\n(defaultPrim = "T"\n{layers})\ndef Xform "T" {arcs}\n{{\ndef Cube "c" {{}}\n}}\n'
    (outside / "thing.usda").write_text(text)
    assert refusal(outside).code == "path_outside"
    if arc == "payload":
        (ref,) = found(outside)
        assert isinstance(ref, SourceRef)
        assert ref.files == ("thing.usda",)


def test_a_package_does_not_lead_outside(outside: Path) -> None:
    layer = b'#usda 1.0\n(defaultPrim = "T")\ndef "T" (references = @%s@) {\ndef Cube "c" {}\n}\n'
    for name in (b"../secret.usda", b"../../secret.usda", str(outside.parent / "secret.usda").encode()):
        (outside / "thing.usdz").write_bytes(archive({"a.usda": layer % name}))
        assert refusal(outside, "thing.usdz").code == "path_outside"


def test_clips_and_computed_names_are_not_followed(outside: Path) -> None:
    secret = outside.parent / "secret.usda"
    clips = f'clips = {{ dictionary default = {{ string templateAssetPath = "{secret}.###.usd"\nasset[] assetPaths = [@{secret}@] }} }}'
    (outside / "thing.usda").write_text(f'#usda 1.0\n(defaultPrim = "T")\ndef Xform "T" ({clips}) {{\ndef Cube "c" {{}}\n}}\n')
    assert len(read(outside).surfaces) == 1
    computed = '#usda 1.0\n(defaultPrim = "T"\nexpressionVariables = { string A = "../secret" })\n'
    (outside / "thing.usda").write_text(computed + 'def "T" (references = @`"${A}.usda"`@) {\ndef Cube "c" {}\n}\n')
    assert refusal(outside).code == "path_outside"
    (outside / "thing.usda").write_text((outside / "thing.usda").read_text().replace("../secret", "./part"))
    stage = stage_at(outside / "part.usda")
    add_box(stage, "/Thing/box")
    save(stage)
    assert len(read(outside).surfaces) == 2, "the layer's own variables count"


@pytest.mark.parametrize(
    "files",
    [
        {"thing.usda": "thing.usda"},
        {"thing.usda": "b.usda", "b.usda": "thing.usda"},
        {"a.usda": "b.usda", "b.usda": "a.usda", "thing.usda": "a.usda"},
    ],
)
def test_layers_that_are_part_of_themselves(tmp_path: Path, files: dict[str, str]) -> None:
    for name, part in files.items():
        text = f'#usda 1.0\n(defaultPrim = "T")\ndef Xform "T" (references = @{part}@</T>) {{\ndef Cube "c" {{}}\n}}\n'
        (tmp_path / name).write_text(text)
    assert refusal(tmp_path).code == "cyclic_reference"
    assert len(found(tmp_path)) == 1, "one failure for all of them"


@pytest.mark.parametrize(("target", "code"), [("/T", "cyclic_reference"), ("/None", "composition_incomplete")])
def test_references_within_a_layer_that_lead_nowhere(tmp_path: Path, target: str, code: str) -> None:
    text = f'#usda 1.0\n(defaultPrim = "T")\ndef Xform "T"\n{{\ndef Cube "c" (references = <{target}>) {{}}\n}}\n'
    (tmp_path / "thing.usda").write_text(text)
    if code == "cyclic_reference":
        assert refusal(tmp_path).code == code
    else:
        assert [notice.code for notice in read(tmp_path).notices] == [code]


def test_what_a_point_instancer_copies_is_left_out(tmp_path: Path) -> None:
    stage = stage_at(tmp_path / "thing.usda")
    add_box(stage, "/Thing/box")
    UsdGeom.PointInstancer.Define(stage, "/Thing/many")
    add_box(stage, "/Thing/many/proto").AddTranslateOp().Set((9, 9, 9))
    save(stage)
    asset = read(tmp_path)
    assert len(asset.surfaces) == 1
    assert [notice.code for notice in asset.notices] == ["prim_left_out"]


def test_few_words_that_ask_for_many_prims(tmp_path: Path) -> None:
    levels = "".join(
        f'class "L{k}" {{ ' + "".join(f'def "c{i}" (references = </L{k + 1}>) {{}}\n' for i in range(10)) + "}\n"
        for k in range(12)
    )
    text = f'#usda 1.0\n(defaultPrim = "T")\ndef Xform "T" (references = </L0>) {{}}\n{levels}class "L12" {{}}\n'
    (tmp_path / "thing.usda").write_text(text)
    assert refusal(tmp_path).code == "mesh_too_large"
    hidden = text.replace("references = </L1>", "references = </Wrap/part>") + 'class "Wrap" (references = </Deep>) {}\n'
    (tmp_path / "thing.usda").write_text(hidden + 'class "Deep" {\ndef "part" (references = </L1>) {}\n}\n')
    assert refusal(tmp_path).code == "mesh_too_large"


def test_sublayers_that_multiply(tmp_path: Path) -> None:
    for k in range(12):
        names = ", ".join(f"@l{k + 1}{side}.usda@" for side in "ab")
        for side in "ab":
            (tmp_path / f"l{k}{side}.usda").write_text(f"#usda 1.0\n(subLayers = [{names}])\n" if k < 11 else "#usda 1.0\n")
    (tmp_path / "thing.usda").write_text(
        '#usda 1.0\n(defaultPrim = "T"\nsubLayers = [@l0a.usda@, @l0b.usda@])\ndef Cube "T" {}\n'
    )
    assert refusal(tmp_path).code == "mesh_too_large"


def test_meshes_with_too_many_triangles_are_refused(tmp_path: Path) -> None:
    stage = stage_at(tmp_path / "thing.usda")
    add_box(stage, "/Thing/box")
    save(stage)
    assert refusal(tmp_path, max_faces=11).code == "mesh_too_large"
    assert len(read(tmp_path, max_faces=12).surfaces) == 1


@pytest.mark.parametrize(
    ("attribute", "value", "code"),
    [
        ("faceVertexCounts", [4] * 7, "model_unreadable"),
        ("faceVertexCounts", [4] * 5 + [-4], "model_unreadable"),
        ("faceVertexIndices", [99] * 24, "model_unreadable"),
        ("faceVertexIndices", [-1] * 24, "model_unreadable"),
        ("points", [(math.nan, 0, 0)] * 8, "mesh_not_finite"),
        ("points", [], "model_unreadable"),
    ],
)
def test_arrays_that_do_not_fit(tmp_path: Path, attribute: str, value: Any, code: str) -> None:
    stage = stage_at(tmp_path / "thing.usda")
    add_box(stage, "/Thing/box").GetPrim().GetAttribute(attribute).Set(value)
    save(stage)
    assert refusal(tmp_path).code == code


def test_layers_without_an_asset(tmp_path: Path) -> None:
    (tmp_path / "thing.usda").write_text('#usda 1.0\ndef Cube "a" {}\ndef Cube "b" {}\n')
    (tmp_path / "broken.usda").write_text("#usda 1.0\ndef Cube {")
    (tmp_path / "overs.usda").write_text('#usda 1.0\nover "a" {}\n')
    (tmp_path / "single.usda").write_text('#usda 1.0\ndef Cube "a" {}\n')
    (tmp_path / "empty.usda").write_text('#usda 1.0\n(defaultPrim = "a")\ndef "a" {}\n')
    codes = {ref.item_id: ref.code for ref in found(tmp_path) if isinstance(ref, Notice)}
    assert codes == {"thing": "default_prim_missing", "broken": "model_unreadable"}
    assert [ref.asset_id for ref in found(tmp_path) if isinstance(ref, SourceRef)] == ["empty", "single"]
    assert refusal(tmp_path, "empty.usda").code == "mesh_empty"
    assert len(read(tmp_path, "single.usda").surfaces) == 1


def test_a_layer_that_ends_the_parser_costs_that_layer_alone(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "good.usda").write_text('#usda 1.0\n(defaultPrim = "a")\ndef Cube "a" {}\n')
    with LayerScanner(Boundary(tmp_path)) as scan:
        assert scan("good.usda").has_default
        process = scan._process
        assert process is not None
        process.kill()
        process.wait()
        with pytest.raises(MeshError, match="ends the process"):
            scan("good.usda")
        assert scan("good.usda").has_default, "the next one is read by a new process"
    monkeypatch.setattr("stable_data.importers.usd.scan._SECONDS", 0.0)
    with LayerScanner(Boundary(tmp_path)) as scan, pytest.raises(MeshError, match="was not read"):
        scan("good.usda")


# Polygons


@settings(max_examples=60, deadline=None)
@given(st.integers(3, 12), st.integers(0, 2**32 - 1))
def test_triangles_cover_a_polygon_with_inner_corners_once(count: int, seed: int) -> None:
    rng = np.random.default_rng(seed)
    angle = np.sort(rng.uniform(0, 2 * np.pi, count)) if count > 4 else np.arange(count) * 2 * np.pi / count
    assume_star = np.diff(np.append(angle, angle[0] + 2 * np.pi)).max() < 3
    radius = rng.uniform(0.2, 1, count)
    flat = np.stack([radius * np.cos(angle), radius * np.sin(angle), np.zeros(count)], axis=1)
    turn = np.linalg.qr(rng.normal(size=(3, 3)))[0]
    points = flat @ turn.T + rng.normal(size=3)
    triangles, polygons = triangulate(points, np.array([count]), np.arange(count))
    assert triangles.shape == (count - 2, 3)
    assert (polygons == 0).all()
    if not assume_star:
        return
    area = abs(np.sum(flat[:, 0] * np.roll(flat[:, 1], -1) - flat[:, 1] * np.roll(flat[:, 0], -1))) / 2
    areas = np.linalg.norm(area_vectors(points[triangles]), axis=1) / 2
    assert float(areas.sum()) == pytest.approx(area, rel=1e-6)


def test_polygons_of_all_sizes_keep_their_order() -> None:
    counts = np.array([4, 2, 3, 5, 0, 4])
    points = np.random.default_rng(0).normal(size=(18, 3))
    triangles, polygons = triangulate(points, counts, np.arange(18))
    assert polygons.tolist() == [0, 0, 2, 3, 3, 3, 5, 5]
    assert set(triangles[polygons == 3].ravel()) == {9, 10, 11, 12, 13}
