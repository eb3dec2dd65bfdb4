"""The preprocess job: nothing lost, the same rows however it was run, every refusal in one clear line."""

import json
import os
import re
import shutil
import subprocess
import sys
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from typer.testing import CliRunner

from pipelines.__main__ import app
from pipelines.execution.ray_executor import WorkerPool
from pipelines.preprocess.job import preprocess
from pipelines.preprocess.report import write_report
from pipelines.preprocess.settings import PreprocessSettings
from pipelines.preprocess.shard import AssetStep, SceneStep
from stable_data.assets.catalog import library_of_run
from stable_data.assets.store import AssetStore
from stable_data.geometry.gltf_writer import write_glb
from stable_data.geometry.mesh import Mesh
from stable_data.mesatask import MesaTaskDataset, to_box_centre, write_text_features, yaw_frame_box
from stable_data.mesatask.asset_catalog import library_of_folder
from stable_data.storage.run_folder import RunFolder
from stable_data.storage.table_rows import scene_from_row
from stable_data.viewer.page import SCRIPT_NAME
from tests.object_store import object_store
from tests.pipelines.runs import ROOT, SMALL, content, run_cli, run_here, used_assets
from tests.scenes import box


def test_every_scene_ends_as_one_row(dataset: Path, clean_run: Path) -> None:
    scenes = RunFolder(str(clean_run)).table("scenes").to_pylist()
    assert sorted(r["scene_id"] for r in scenes) == sorted(p.parent.name for p in dataset.glob("Layout_info/*/*/layout.json"))
    samples = RunFolder(str(clean_run)).table("samples").to_pylist()
    assert len(samples) == 3 * len(scenes)
    for row in scenes:
        scene = scene_from_row(row)
        mine = [s for s in samples if s["scene_id"] == scene.scene_id]
        out = [o["instance"] for s in mine for o in s["objects_out"]]
        assert sorted(out) == sorted(o.instance for o in scene.objects)
        assert scene.task is not None
        assert {o.instance for o in scene.objects if o.stage == "task"} >= set(scene.task.task_objects)


def test_every_used_asset_has_its_geometry(clean_run: Path) -> None:
    run = RunFolder(str(clean_run))
    used = {o["asset_id"] for r in run.table("scenes", ["objects"]).to_pylist() for o in r["objects"]}
    assert {r["asset_id"] for r in run.table("assets", ["asset_id"]).to_pylist()} == used
    assert {r["asset_id"] for r in run.table("meshes", ["asset_id"]).to_pylist()} == used
    for grid in run.table("sdf").to_pylist():
        assert len(grid["values"]) == grid["shape"][0] * grid["shape"][1] * grid["shape"][2]
        assert grid["mean_error"] < 0.01


@pytest.mark.slow
@pytest.mark.ray
@pytest.mark.usefixtures("local_ray")
def test_ray_gives_the_same_bytes_as_this_process(dataset: Path, clean_run: Path, tmp_path: Path) -> None:
    done = run_here(dataset, tmp_path / "ray", "--workers", "2")
    assert done.exit_code == 0, done.output
    assert content(tmp_path / "ray") == content(clean_run)


CLUSTER = """
import sys
from ray.cluster_utils import Cluster
cluster = Cluster(initialize_head=True, head_node_args={"num_cpus": 1})
cluster.add_node(num_cpus=1)
print("at", cluster.address, flush=True)
sys.stdin.read()
cluster.shutdown()
"""


@pytest.mark.ray
@pytest.mark.slow
def test_a_cluster_that_started_elsewhere_gives_the_same_bytes(tiny: Path, tiny_run: Path, tmp_path: Path) -> None:
    here, there = tmp_path / "here", tmp_path / "there"
    here.mkdir()
    there.mkdir()
    (here / "data").symlink_to(tiny)
    cluster = subprocess.Popen(
        [sys.executable, "-c", CLUSTER], cwd=there, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True
    )
    assert cluster.stdout is not None
    try:
        address = next(line.split()[1] for line in cluster.stdout if line.startswith("at "))
        done = run_cli(Path("data"), Path("out"), "--address", address, cwd=here, PYTHONPATH=str(ROOT))
    finally:
        cluster.communicate()
    assert done.returncode == 0, done.stderr
    assert content(here / "out") == content(tiny_run)
    assert not list(there.iterdir())


def test_a_dataset_without_any_mesh_is_audited_as_unknown(bare_run: Path) -> None:
    counts = json.loads((bare_run / "manifest.json").read_text("utf-8"))["counts"]
    assert (counts["scenes"], counts["assets"]) == (1, 0)
    row = RunFolder(str(bare_run)).table("scenes").to_pylist()[0]
    assert row["num_without_mesh"] == row["num_objects"]
    assert row["clean"] is not True


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (("--data", "{tmp}/nothing"), "nothing"),
        (("--data", "{tmp}"), "{tmp}"),
        (("--set", "scenes_per_shart=3"), "did you mean scenes_per_shard"),
        (("--set", "seed=abc"), "expected a whole number"),
        (("--set", "num_points=0"), "expected at least 1"),
        (("--config", "{tmp}/missing.toml"), "cannot be read as TOML"),
        (("--out", "/proc/nowhere"), "cannot be written"),
        (("--set", "task_writer=no.such:thing"), "expected module:function"),
        (("--address", "auto"), "leave out one of them"),
    ],
)
def test_a_run_that_cannot_start_says_why_in_one_line(
    bare: Path, tmp_path: Path, arguments: tuple[str, str], message: str
) -> None:
    base = {"--data": str(bare), "--out": str(tmp_path / "out"), "--workers": "0"}
    option, value = arguments[0], arguments[1].format(tmp=tmp_path)
    command = [part for pair in (base | {option: value}).items() for part in pair]
    done = CliRunner().invoke(app, ["preprocess", *command])
    assert done.exit_code == 2, done.output
    last = done.stderr.strip().splitlines()[-1]
    assert last.startswith("error: ")
    assert message.format(tmp=tmp_path) in last


@pytest.mark.slow
def test_a_run_into_an_object_store_gives_the_same_rows(tiny: Path, tiny_run: Path) -> None:
    with object_store() as uri:
        preprocess(str(tiny), uri, SMALL, WorkerPool())
        stored, local = RunFolder(uri), RunFolder(str(tiny_run))
        for table in {*AssetStep.TABLES, *SceneStep.TABLES}:
            assert stored.table(table).equals(local.table(table)), table
        assert stored.read_bytes("report/index.html") is not None
        manifest = json.loads(stored.read_bytes("manifest.json") or b"")
        write_report(stored, manifest, AssetStore(MesaTaskDataset(tiny)), 1)
        [name] = re.findall(r'href="(scenes/[^"#]*)#scene=0">open', (stored.read_bytes("report/index.html") or b"").decode())
        assert all(stored.read_bytes(f"report/{path}") for path in (name, SCRIPT_NAME))
        preprocess(str(tiny), uri, SMALL, WorkerPool())  # resumes: nothing to do


def test_a_task_writer_writes_the_tasks_and_is_asked_once(bare: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    module = tmp_path / "my_writer.py"
    module.write_text(
        """
calls = 0
def write(scene, relations):
    global calls
    calls += 1
    name = scene.objects[0].category.title().replace("_", "")
    return {"Environment": "A room.", "item_placement_zone": [0, 100, 0, 60], "Task": f"Pick up the {name}.", "Goal": ["Held."],
            "Action Sequence": [f"Pick({name})"], "Objects cluster": [name]}
""",
        "utf-8",
    )
    monkeypatch.syspath_prepend(tmp_path)
    root = tmp_path / "data"
    shutil.copytree(bare, root, ignore=shutil.ignore_patterns("task_info.json"))
    settings = replace(SMALL, task_writer="my_writer:write", task_cache=str(tmp_path / "cache"))
    for number in range(2):
        preprocess(str(root), str(tmp_path / f"out{number}"), settings, WorkerPool())
    rows = RunFolder(str(tmp_path / "out0")).table("scenes", ["task"]).to_pylist()
    assert {r["task"]["origin"] for r in rows} == {"model"}
    assert sys.modules["my_writer"].calls == len(rows)


def test_positions_that_mean_the_mesh_centre_are_converted(tiny: Path, tmp_path: Path) -> None:
    root = tmp_path / "data"
    shutil.copytree(tiny, root)
    path = next(root.glob("Layout_info/*/*/layout.json"))
    dataset = MesaTaskDataset(root)
    scene, store = dataset.read(path.parent.name)[0], AssetStore(dataset)
    layout, lean = json.loads(path.read_text("utf-8")), (float(np.sin(0.2)), 0.0, 0.0, float(np.cos(0.2)))
    for entry, o in zip(layout["objects"], scene.objects, strict=True):  # lean, so that the two centres differ
        entry |= {"rotation": lean, "z_rotation": 0.0}
        if (mesh := store.mesh_of(o)) is not None and o.scale is not None:
            low, high = yaw_frame_box(mesh.vertices, o.scale, lean)
            entry["size"] = (100 * (high - low)).tolist()
    path.write_text(json.dumps(layout), "utf-8")
    preprocess(str(root), str(tmp_path / "out"), replace(SMALL, position_convention="mesh_centre"), WorkerPool())
    row = RunFolder(str(tmp_path / "out")).table("scenes").to_pylist()[0]
    scene, moved = dataset.read(row["scene_id"])[0], 0
    for was, now in zip(scene.objects, row["objects"], strict=True):
        mesh = store.mesh_of(was)
        expected = was if mesh is None else to_box_centre(was, mesh.vertices)
        assert now["position"] == pytest.approx(expected.position)
        moved += now["position"] != pytest.approx(was.position, abs=1e-4)
    assert moved > 0
    lost = RunFolder(str(tmp_path / "out")).table("warnings").to_pylist()
    assert sum(r["code"] == "position_unknown" for r in lost) == sum(store.mesh_of(o) is None for o in scene.objects) > 0


@dataclass(frozen=True)
class Elsewhere(WorkerPool):
    """Workers whose folder is another one than the caller's, as on a cluster."""

    folder: str = ""

    def run(self, work: Any, shards: Sequence[Any]) -> Iterator[Any]:
        os.chdir(self.folder)
        return super().run(work, shards)


def test_relative_paths_are_the_callers(bare: Path, bare_run: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    for name in ("here", "there"):
        (tmp_path / name).mkdir()
    (tmp_path / "here" / "data").symlink_to(bare)
    monkeypatch.chdir(tmp_path / "here")
    preprocess("data", "out", SMALL, Elsewhere(folder=str(tmp_path / "there")))
    assert content(tmp_path / "here" / "out") == content(bare_run)
    assert not list((tmp_path / "there").iterdir())


def test_a_replaced_mesh_is_read_anew_by_a_process_that_knows_the_old_one(tiny: Path, tmp_path: Path) -> None:
    root = tmp_path / "data"
    shutil.copytree(tiny, root)
    settings = replace(SMALL, position_convention="box_centre")
    preprocess(str(root), str(tmp_path / "before"), settings, WorkerPool())
    before = RunFolder(str(tmp_path / "before")).table("assets").to_pylist()[0]
    block = box(1.0, 2.0, 3.0)
    (root / "Assets_library" / f"{before['asset_id']}.glb").write_bytes(write_glb(Mesh(block.vertices, block.faces)))
    preprocess(str(root), str(tmp_path / "after"), settings, WorkerPool())
    after = {r["asset_id"]: r for r in RunFolder(str(tmp_path / "after")).table("assets").to_pylist()}[before["asset_id"]]
    assert after["mesh_sha256"] != before["mesh_sha256"]
    assert after["extents"] == pytest.approx([1.0, 2.0, 3.0])


@pytest.mark.parametrize("wrong", ["--data", "--out"])
def test_a_folder_whose_name_is_not_utf8_is_told(wrong: str, bare: Path, tmp_path: Path) -> None:
    odd = tmp_path / os.fsdecode(b"caf\xe9")
    if wrong == "--data":
        shutil.copytree(bare, odd)
    options = {"--data": str(bare), "--out": str(tmp_path / "out"), "--workers": "0"} | {wrong: str(odd)}
    done = CliRunner().invoke(app, ["preprocess", *(word for pair in options.items() for word in pair)])
    assert done.exit_code == 2, done.output
    assert re.search(r"error: '\S*caf\\udce9' is not UTF-8, expected all names of folders .*; rename", done.stderr)
    assert not (tmp_path / "out").exists()


def test_scene_folders_without_a_layout_are_failures(bare: Path, tmp_path: Path) -> None:
    root, out = tmp_path / "data", tmp_path / "out"
    shutil.copytree(bare, root)
    table_type = next(root.glob("Layout_info/*"))
    (table_type / "empty_1").mkdir()
    (table_type / "empty_2").mkdir()
    manifest = preprocess(str(root), str(out), SMALL, WorkerPool())
    rows = RunFolder(str(out)).table("failures").to_pylist()
    assert [(r["id"], r["code"]) for r in rows] == [("empty_1", "layout_missing"), ("empty_2", "layout_missing")]
    assert (manifest["num_scenes"], manifest["counts"]["scenes"], manifest["counts"]["failed_scenes"]) == (3, 1, 2)
    assert preprocess(str(root), str(out), SMALL, WorkerPool())["counts"] == manifest["counts"]


def test_assets_without_a_mesh_are_warned_of(bare_run: Path, bare: Path) -> None:
    manifest = json.loads((bare_run / "manifest.json").read_text("utf-8"))
    rows = RunFolder(str(bare_run)).table("warnings").to_pylist()
    used = used_assets(bare)
    assert {r["id"] for r in rows if (r["step"], r["code"]) == ("plan", "glb_missing")} == used
    assert manifest["num_assets_without_mesh"] == len(used)


def test_text_features_come_along(tiny: Path, tmp_path: Path) -> None:
    root = tmp_path / "data"
    shutil.copytree(tiny, root)
    uid = min(used_assets(tiny))
    write_text_features(root / "sbert_text_features.pkl", [uid], np.array([[0.6, 0.8]]))
    preprocess(str(root), str(tmp_path / "out"), SMALL, WorkerPool())
    found = {r["asset_id"]: r["text_embedding"] for r in RunFolder(str(tmp_path / "out")).table("assets").to_pylist()}
    assert found.pop(uid) == pytest.approx([0.6, 0.8])
    assert list(found.values()) == [None, None]


def test_a_run_is_a_library_that_leaves_out_what_the_annotators_did(tiny: Path, tmp_path: Path) -> None:
    root = tmp_path / "data"
    shutil.copytree(tiny, root)
    path = root / "Asset_annotation.json"
    annotations = json.loads(path.read_text("utf-8"))
    marked, composite, kept = sorted(p.stem for p in root.glob("Assets_library/*.glb"))
    annotations[marked] |= {"mark_deletion": True, "licence": "CC0-1.0"}
    annotations[composite] |= {"is_composite": "yes", "onTable": 0}
    path.write_text(json.dumps(annotations), "utf-8")
    preprocess(str(root), str(tmp_path / "out"), SMALL, WorkerPool())
    of_run, of_folder = library_of_run(RunFolder(str(tmp_path / "out"))), library_of_folder(root)
    assert {a.asset_id: a.is_offered for a in of_run.assets} == {marked: False, composite: False, kept: True}
    same = {a.asset_id: a for a in of_folder.assets}
    for asset in of_run.assets:
        other = same[asset.asset_id]
        assert asset.extents == pytest.approx(other.extents, rel=1e-3)
        for name in ("category", "words", "licence", "source", "on_table", "mark_deletion", "is_composite"):
            assert getattr(asset, name) == getattr(other, name)


@pytest.mark.slow
def test_real_scenes_are_all_accounted_for(measured_data: Path, tmp_path: Path) -> None:
    num_scenes = len(MesaTaskDataset(measured_data).scene_ids)
    manifest = preprocess(str(measured_data), str(tmp_path / "out"), PreprocessSettings(num_pictures=0), WorkerPool())
    assert manifest["counts"]["scenes"] == manifest["num_scenes"] == num_scenes
    assert manifest["counts"]["failures"] == 0
    assert manifest["counts"]["samples"] == 3 * num_scenes
