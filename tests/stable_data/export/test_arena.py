"""Layouts for Isaac Lab-Arena."""

import json
from dataclasses import replace
from pathlib import Path

import pytest
from pxr import Usd, UsdPhysics

from stable_data.assets.store import AssetStore
from stable_data.export import arena
from stable_data.export.props import placed_props
from stable_data.simulation.scene_geometry import SceneGeometry
from tests.stable_data.export.runs import at_rest

pytestmark = pytest.mark.sim


def test_a_line_has_the_poses_that_are_replayed_and_the_packages(store: AssetStore, tmp_path: Path) -> None:
    geometry = SceneGeometry.of(replace(at_rest(), fixed=frozenset({"2_plate_0"})), store)
    arena.export_scene(geometry, tmp_path)
    path = arena.scene_path(geometry.scene, tmp_path)
    [line] = path.read_text("utf-8").splitlines()
    record = json.loads(line)
    placement, ours = record["variations"]["scene.relation_placement"], record["stable_data"]
    movable = [p for p in placed_props(geometry) if not p.is_fixed]
    assert list(placement["poses"]) == [entry["id"] for entry in ours["objects"]]
    for placed, (name, pose), entry in zip(movable, placement["poses"].items(), ours["objects"], strict=True):
        assert pose == {"position_xyz": list(placed.position), "rotation_xyzw": list(placed.quat_xyzw)}
        assert name.isidentifier()
        assert entry["stable_data"]["instance"] == placed.object.instance
        stage = Usd.Stage.Open(str(path.parent / entry["params"]["usd_path"]))
        mass = UsdPhysics.MassAPI(stage.GetDefaultPrim()).GetMassAttr().Get()
        assert mass == pytest.approx(placed.mass.mass, rel=1e-5)
    stage = Usd.Stage.Open(str(path.parent / ours["background"]["usd_path"]))
    assert len(ours["background"]["prims"]) == 3  # table, furniture, plate
    assert all(stage.GetPrimAtPath(prim) for prim in ours["background"]["prims"])
