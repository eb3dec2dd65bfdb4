"""An export in the MesaTask-10K format, as our own reader and the slow reference beside the checkout read it."""

import os
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from stable_data.assets.store import AssetStore
from stable_data.export.exporter import export_run
from stable_data.mesatask import MesaTaskDataset
from stable_data.scene import Scene
from stable_data.simulation.collision_bodies import asset_parts
from stable_data.simulation.run_reader import SceneSelection
from stable_data.simulation.scene_geometry import SceneGeometry
from stable_data.storage.run_folder import RunFolder
from tests.stable_data.export.runs import at_rest, falling, weighed, write_run

PLAIN = replace(
    at_rest(), scene_id="plain", objects=(replace(at_rest().objects[1], instance="1_mug_0"), *at_rest().objects[2:])
)


@pytest.fixture(scope="module")
def plain_run(tmp_path_factory: pytest.TempPathFactory) -> RunFolder:
    return write_run(tmp_path_factory.mktemp("plain") / "run", (PLAIN, falling()))


@pytest.fixture(scope="module")
def folder(plain_run: RunFolder, tmp_path_factory: pytest.TempPathFactory) -> Path:
    out = tmp_path_factory.mktemp("out") / "dataset"
    assert export_run(plain_run, out, "mesatask", SceneSelection()).num_written == 2
    return out


@pytest.mark.parametrize("scene", [PLAIN, falling()], ids=["plain", "falling"])
def test_our_reader_reads_the_same_scene(scene: Scene, folder: Path) -> None:
    dataset = MesaTaskDataset(folder)
    found = SceneGeometry.of(dataset.read(scene.scene_id)[0], AssetStore(dataset)).scene
    assert [o.instance for o in found.objects] == [o.instance for o in scene.objects]
    assert found.table == scene.table
    assert found.task == (scene.task and replace(scene.task, relations=()))
    for one, other in zip(found.objects, scene.objects, strict=True):
        np.testing.assert_allclose((*one.position, one.yaw), (*other.position, other.yaw), atol=1e-12)
        np.testing.assert_allclose(one.tilt_quat_xyzw, other.tilt_quat_xyzw, atol=1e-12)
        assert one.asset_id == other.asset_id
        np.testing.assert_allclose(one.size, other.size, atol=1e-6)
        assert one.description == other.description


def test_meshes_keep_their_parts_and_assets_their_licence(plain_run: RunFolder, folder: Path, store: AssetStore) -> None:
    dataset = MesaTaskDataset(folder)
    again = AssetStore(dataset)
    used = {o.asset_id for scene in (PLAIN, falling()) for o in scene.objects if o.asset_id}
    assert set(dataset.asset_ids) == set(dataset.annotations) == used
    for asset_id in sorted(used):
        assert dataset.annotation(asset_id).licence == "CC0"
        mesh = store.asset(asset_id).mesh
        np.testing.assert_allclose(again.asset(asset_id).mesh.extents, mesh.extents, rtol=1e-6)
        kept, parts = asset_parts(asset_id, mesh, store), again.colliders(asset_id)
        assert len(kept) == len(parts)
        for one, other in zip(kept, parts, strict=True):
            np.testing.assert_allclose(one.vertices.min(axis=0), other.vertices.min(axis=0), atol=1e-6)


def test_the_annotation_of_an_asset_has_its_mass(tmp_path: Path) -> None:
    run = weighed(write_run(tmp_path / "run", (falling(),)), "mug/0")
    export_run(run, tmp_path / "out", "mesatask", SceneSelection())
    masses = {a.category: a.mass for a in MesaTaskDataset(tmp_path / "out").annotations.values()}
    assert masses == {"mug": 0.118, "can": None}


def test_the_slow_reference_judges_it(plain_run: RunFolder, tmp_path: Path) -> None:
    """It knows neither boxes nor anything of ours: every object of the scene has a mesh."""
    judge = Path(__file__).resolve().parents[4] / "shared" / "judge" / "folder.py"
    if not judge.is_file():
        pytest.skip("the reference beside the checkout (../shared/judge) is absent")
    export_run(plain_run, tmp_path / "out", "mesatask", SceneSelection(scene_ids=("falling",), settled=True))
    command = [sys.executable, str(judge), str(tmp_path / "out")]
    environment = os.environ | {"JUDGE_TOLERANCE_M": "0.001"}
    done = subprocess.run(command, capture_output=True, text=True, env=environment)
    assert done.stdout.startswith("1 of 1 scenes clean"), done.stdout + done.stderr
