"""Stages of USD that the tests of its reader write and read."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from pxr import Gf, Sdf, Usd, UsdGeom, UsdShade

from stable_data.errors import MeshError, Notice
from stable_data.geometry.mesh import signed_volumes
from stable_data.importers.boundary import Boundary
from stable_data.importers.source import ReaderOptions, SourceAsset, SourceRef
from stable_data.importers.usd import UsdReader

NEWTON = Path(__file__).parents[3] / "data" / "import" / "newton"
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
