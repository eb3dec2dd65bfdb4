"""Looks of USD assets: materials, textures, colours, and which prims are seen."""

from pathlib import Path

import numpy as np
import pytest
from pxr import Sdf, UsdGeom, UsdPhysics, UsdShade

from tests.stable_data.importers.usd.stages import add_box, add_material, bind, box_of, read, read_all, save, stage_at


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
