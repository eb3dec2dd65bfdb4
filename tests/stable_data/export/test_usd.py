"""Scenes as OpenUSD, as OpenUSD's own library composes them."""

import json
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from pxr import Gf, Usd, UsdGeom, UsdPhysics, UsdShade, UsdValidation
from scipy.spatial.transform import Rotation

from stable_data.assets.store import AssetStore
from stable_data.condition import ConditionKind, GoalCondition, condition_of
from stable_data.export.props import placed_props, prop_parts
from stable_data.export.usd import UsdFormat
from stable_data.scene import Scene, TaskInfo
from stable_data.simulation.run_reader import RunScenes, SceneSelection
from stable_data.simulation.scene_geometry import SceneGeometry
from stable_data.storage.run_folder import RunFolder
from stable_data.storage.table_rows import scene_from_row
from tests.stable_data.export.runs import EMPTY, ODD_INSTANCE, at_rest, falling, posed
from tests.textured_assets import picture_box, scene_of, textured, thing, write_run

pytestmark = pytest.mark.sim


def opened(geometry: SceneGeometry, out: Path, flavour: Any = "neutral") -> Usd.Stage:
    usd = UsdFormat(flavour)
    usd.export_scene(geometry, out)
    stage = Usd.Stage.Open(str(usd.scene_path(geometry.scene, out)))
    assert not stage.GetCompositionErrors()
    return stage


def objects(stage: Usd.Stage) -> list[Usd.Prim]:
    return list(stage.GetPrimAtPath("/World/Objects").GetChildren())


def descendants(prim: Usd.Prim, schema: Any) -> Iterator[Any]:
    return (p for p in Usd.PrimRange(prim) if p.HasAPI(schema))


@pytest.mark.parametrize("scene", [at_rest(), falling(), EMPTY], ids=lambda scene: scene.scene_id)
@pytest.mark.parametrize("flavour", ["neutral", "isaaclab"])
def test_bodies_have_their_mass_pose_and_colliders(flavour: str, scene: Scene, store: AssetStore, tmp_path: Path) -> None:
    geometry = SceneGeometry.of(scene, store)
    stage = opened(geometry, tmp_path, flavour)
    assert UsdGeom.GetStageMetersPerUnit(stage) == 1.0
    assert UsdGeom.GetStageUpAxis(stage) == "Z"
    found = objects(stage)
    for prim, placed in zip(found, placed_props(geometry), strict=True):
        assert prim.GetCustomData()["stable_data"]["instance"] == placed.object.instance
        assert [body.GetPath() for body in descendants(prim, UsdPhysics.RigidBodyAPI)] == [prim.GetPath()]
        assert not list(descendants(prim, UsdPhysics.ArticulationRootAPI))
        mass = UsdPhysics.MassAPI(prim)
        assert mass.GetMassAttr().Get() == pytest.approx(placed.mass.mass, rel=1e-6)
        np.testing.assert_allclose(mass.GetCenterOfMassAttr().Get(), placed.mass.center_of_mass, atol=1e-7)
        axes = mass.GetPrincipalAxesAttr().Get()
        turn = Rotation.from_quat([*axes.GetImaginary(), axes.GetReal()]).as_matrix()
        tensor = (turn * np.array(mass.GetDiagonalInertiaAttr().Get())) @ turn.T
        np.testing.assert_allclose(tensor, placed.mass.inertia, atol=1e-6 * np.trace(placed.mass.inertia))
        world = UsdGeom.Xformable(prim).ComputeLocalToWorldTransform(Usd.TimeCode.Default())
        np.testing.assert_allclose(world.ExtractTranslation(), placed.position, atol=1e-9)
        parts = [p for p in descendants(prim, UsdPhysics.CollisionAPI) if p.IsA(UsdGeom.Mesh)]
        assert len(parts) == len(prop_parts(placed.prop, store))
        for part in parts:
            assert UsdGeom.Imageable(part).ComputePurpose() == "guide"
            assert UsdPhysics.MeshCollisionAPI(part).GetApproximationAttr().Get() == "convexHull"
            material, _ = UsdShade.MaterialBindingAPI(part).ComputeBoundMaterial("physics")
            friction = UsdPhysics.MaterialAPI(material.GetPrim())
            assert friction.GetStaticFrictionAttr().Get() == pytest.approx(0.8)


@pytest.mark.parametrize("flavour", ["neutral", "isaaclab"])
def test_what_is_seen_is_where_the_object_is(flavour: str, store: AssetStore, tmp_path: Path) -> None:
    geometry = SceneGeometry.of(at_rest(), store)
    stage = opened(geometry, tmp_path, flavour)
    cache = UsdGeom.BBoxCache(Usd.TimeCode.Default(), ["default"], useExtentsHint=False)
    for prim, o in zip(objects(stage), geometry.scene.objects, strict=True):
        points = []
        for mesh in Usd.PrimRange(prim):
            if mesh.IsA(UsdGeom.Mesh) and UsdGeom.Imageable(mesh).ComputePurpose() == "default":
                world = UsdGeom.Xformable(mesh).ComputeLocalToWorldTransform(Usd.TimeCode.Default())
                points += [world.Transform(Gf.Vec3d(p)) for p in UsdGeom.Mesh(mesh).GetPointsAttr().Get()]
        expected = posed(geometry, o.instance).vertices
        np.testing.assert_allclose(np.min(points, axis=0), expected.min(axis=0), atol=1e-6)
        np.testing.assert_allclose(np.max(points, axis=0), expected.max(axis=0), atol=1e-6)
        # The extents in the files are right: a box that only uses them contains the object.
        box = cache.ComputeWorldBound(prim).ComputeAlignedRange()
        assert np.all(np.array(box.GetMin()) <= expected.min(axis=0) + 1e-6)
        assert np.all(np.array(box.GetMax()) >= expected.max(axis=0) - 1e-6)


def test_the_stage_says_what_the_scene_is(run: RunFolder, tmp_path: Path) -> None:
    scenes = RunScenes(run, SceneSelection(where="num_objects == 6"))
    [row] = scenes.rows()
    scene = scene_from_row(row)
    stage = opened(scenes.geometry(scene, row), tmp_path)
    facts = stage.GetDefaultPrim().GetCustomData()["stable_data"]
    assert facts["instruction"] == "Put the can on the plate."
    assert facts["scene_id"] == scene.scene_id
    assert list(facts["task_objects"]) == ["0_can_0"]
    assert facts["verdicts"]["clean"] is True
    assert facts["verdicts"]["num_objects"] == 6
    assert "stable" in facts["unknown_verdicts"]
    physics = UsdPhysics.Scene(stage.GetPrimAtPath("/World/PhysicsScene"))
    assert physics.GetGravityMagnitudeAttr().Get() == pytest.approx(9.81)
    assert tuple(physics.GetGravityDirectionAttr().Get()) == (0, 0, -1)
    assert {p.GetName() for p in stage.GetPrimAtPath("/World/Cameras").GetChildren()} == {"front", "top"}
    table = stage.GetPrimAtPath("/World/Table/Collider")
    assert not table.GetParent().HasAPI(UsdPhysics.RigidBodyAPI)
    box = UsdGeom.BBoxCache(Usd.TimeCode.Default(), ["guide"]).ComputeWorldBound(table).ComputeAlignedRange()
    np.testing.assert_allclose(box.GetMax(), [*scene.table.size_xy, 0.0], atol=1e-7)
    [odd] = [p for p in objects(stage) if p.GetCustomData()["stable_data"]["instance"] == ODD_INSTANCE]
    assert odd.GetName().isidentifier()


def test_the_conditions_of_a_task_are_texts_of_json(store: AssetStore, tmp_path: Path) -> None:
    condition = GoalCondition("0_can_0", ConditionKind.ON, "2_plate_0")
    task = TaskInfo("", "Put the can on the plate.", conditions=(condition,))
    stage = opened(SceneGeometry.of(replace(at_rest(), task=task), store), tmp_path)
    [found] = stage.GetDefaultPrim().GetCustomData()["stable_data"]["conditions"]
    assert condition_of(json.loads(found)) == condition


def test_isaac_lab_makes_its_own_world(store: AssetStore, tmp_path: Path) -> None:
    geometry = SceneGeometry.of(falling(), store)
    stage = opened(geometry, tmp_path, "isaaclab")
    assert not [p for p in stage.Traverse() if p.GetTypeName() in ("PhysicsScene", "Camera", "DomeLight", "DistantLight")]
    assert not stage.GetPrimAtPath("/World/Furniture/room")
    for prim, o in zip(objects(stage), geometry.scene.objects, strict=True):
        # Nothing but the pose is stated on the stage, so that the file can be spawned as it is.
        authored = {p.GetName() for p in prim.GetAuthoredProperties() if p.GetPropertyStack()[0].layer == stage.GetRootLayer()}
        assert authored == {"xformOp:translate", "xformOp:orient", "xformOpOrder"}
        [package] = (tmp_path / "props").glob(f"{o.category}_*/usd/*.usd")
        metadata = Usd.Stage.Open(str(package)).GetRootLayer().customLayerData["SimReady_Metadata"]
        assert metadata["mass"] == pytest.approx(UsdPhysics.MassAPI(prim).GetMassAttr().Get())


def test_a_fixed_object_is_a_static_collider(store: AssetStore, tmp_path: Path) -> None:
    scene = replace(at_rest(), fixed=frozenset({"2_plate_0"}))
    stage = opened(SceneGeometry.of(scene, store), tmp_path)
    for prim in objects(stage):
        is_fixed = prim.GetCustomData()["stable_data"]["instance"] == "2_plate_0"
        assert bool(list(descendants(prim, UsdPhysics.RigidBodyAPI))) is not is_fixed
        assert list(descendants(prim, UsdPhysics.CollisionAPI))


def test_textures_lie_in_the_package_and_stand_upright(tmp_path: Path) -> None:
    run = write_run(tmp_path / "run", [textured("box", picture_box())], scene_of(thing("0_box_0", "box", 0.4, 0.3)))
    scenes = RunScenes(run)
    stage = opened(scenes.geometry(next(iter(scenes))), tmp_path / "out")
    readers = [p for p in stage.Traverse() if p.GetAttribute("inputs:file") and "Objects" in str(p.GetPath())]
    assert readers
    for reader in readers:
        resolved = Path(reader.GetAttribute("inputs:file").Get().resolvedPath)
        assert resolved.is_file()
        assert resolved.parent.parent.parent.parent == tmp_path / "out" / "props"
    [mesh] = [p for p in Usd.PrimRange(objects(stage)[0]) if p.IsA(UsdGeom.Mesh) and p.HasAttribute("primvars:st")]
    points, st = (np.array(mesh.GetAttribute(name).Get()) for name in ("points", "primvars:st"))
    sides = points[:, 2] > points[:, 2].mean()
    front = points[:, 1] == points[:, 1].min()
    # On the front the texture's upper edge, where t is 1, is up.
    assert st[front & sides][:, 1].max() == pytest.approx(1.0)


@pytest.mark.parametrize("flavour", ["neutral", "isaaclab"])
def test_openusds_own_validators_find_nothing(flavour: str, store: AssetStore, tmp_path: Path) -> None:
    stage = opened(SceneGeometry.of(at_rest(), store), tmp_path, flavour)
    registry = UsdValidation.ValidationRegistry()
    context = UsdValidation.ValidationContext(registry.GetOrLoadAllValidators())
    errors = [e for e in context.Validate(stage) if e.GetType() == UsdValidation.ValidationErrorType.Error]
    assert [f"{e.GetName()}: {e.GetMessage()}" for e in errors] == []
