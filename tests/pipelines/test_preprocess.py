"""The preprocess job: nothing lost, the same rows however it was run, every refusal in one clear line."""

import json
import os
import random
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import boto3
import polars as pl
import pytest

from pipelines.plan import PreprocessSettings
from pipelines.preprocess import ASSET_TABLES, SCENE_TABLES, preprocess
from pipelines.runner import Workers
from stable_data.errors import ConfigError
from stable_data.shards import RunFolder
from stable_data.synth import write_embedded_set
from stable_data.tables import scene_from_row

ROOT = Path(__file__).resolve().parents[2]
TABLES = tuple(dict.fromkeys((*ASSET_TABLES, *SCENE_TABLES)))
SMALL = PreprocessSettings(scenes_per_shard=2, assets_per_shard=4, num_points=64, num_pictures=0, all_assets=False)


@pytest.fixture(scope="module")
def dataset(tmp_path_factory: pytest.TempPathFactory) -> Path:
    root = tmp_path_factory.mktemp("embedded") / "data"
    write_embedded_set(root, 4, seed=3, pictures=False)
    return root


@pytest.fixture(scope="module")
def tiny(dataset: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The dataset's scene with the fewest objects, alone."""
    root = tmp_path_factory.mktemp("tiny") / "data"
    shutil.copytree(dataset, root)
    layouts = sorted(root.glob("Layout_info/*/*/layout.json"), key=lambda p: len(json.loads(p.read_text("utf-8"))["objects"]))
    for layout in layouts[1:]:
        shutil.rmtree(layout.parent)
    return root


@pytest.fixture(scope="module")
def tiny_run(tiny: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    out = tmp_path_factory.mktemp("tiny_run") / "out"
    preprocess(str(tiny), str(out), SMALL, Workers())
    return out


@pytest.fixture(scope="module")
def clean_run(dataset: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    out = tmp_path_factory.mktemp("run") / "out"
    preprocess(str(dataset), str(out), SMALL, Workers())
    return out


def content(out: Path) -> dict[str, bytes]:
    """Every shard of a run, byte for byte."""
    return {p.relative_to(out).as_posix(): p.read_bytes() for p in sorted(out.glob("*/part-*.parquet"))}


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


def test_a_complete_run_is_left_alone(dataset: Path, clean_run: Path) -> None:
    before = {p: p.stat().st_mtime_ns for p in clean_run.glob("*/part-*.parquet")}
    preprocess(str(dataset), str(clean_run), SMALL, Workers())
    assert {p: p.stat().st_mtime_ns for p in clean_run.glob("*/part-*.parquet")} == before


@pytest.mark.ray
def test_ray_gives_the_same_bytes_as_this_process(dataset: Path, clean_run: Path, tmp_path: Path) -> None:
    done = run_cli(dataset, tmp_path / "ray", "--workers", "2")
    assert done.returncode == 0, done.stderr
    assert content(tmp_path / "ray") == content(clean_run)


def test_the_report_names_the_scenes(clean_run: Path) -> None:
    page = (clean_run / "report" / "index.html").read_text("utf-8")
    assert "Audit" in page
    assert "scenes usable" in page


def test_what_is_missing_is_done_again(tiny: Path, tiny_run: Path, tmp_path: Path) -> None:
    out = tmp_path / "out"
    shutil.copytree(tiny_run, out)
    for table in ("scenes", "assets"):  # the last tables of a shard
        next(iter(sorted((out / table).glob("part-*")))).unlink()
    preprocess(str(tiny), str(out), SMALL, Workers())
    assert content(out) == content(tiny_run)


def test_a_changed_setting_stops_with_was_and_now(dataset: Path, clean_run: Path) -> None:
    changed = PreprocessSettings(**(SMALL.shaping() | {"important_threshold": 0.05}), num_pictures=0)
    with pytest.raises(ConfigError, match=r"important_threshold: 0\.02 -> 0\.05"):
        preprocess(str(dataset), str(clean_run), changed, Workers())


def test_a_changed_input_stops(tiny: Path, tiny_run: Path, tmp_path: Path) -> None:
    copied, out = tmp_path / "data", tmp_path / "out"
    shutil.copytree(tiny, copied)
    shutil.copytree(tiny_run, out)
    layout = next(copied.glob("Layout_info/*/*/layout.json"))
    layout.write_text(layout.read_text("utf-8") + "\n", "utf-8")
    with pytest.raises(ConfigError, match="input_fingerprint"):
        preprocess(str(copied), str(out), SMALL, Workers())


def test_a_second_run_into_the_same_folder_is_refused(dataset: Path, clean_run: Path) -> None:
    with RunFolder(str(clean_run)).locked(), pytest.raises(ConfigError, match="another run is writing here"):
        preprocess(str(dataset), str(clean_run), SMALL, Workers())


def test_a_full_disk_ends_with_one_line_and_the_run_can_go_on(
    tiny: Path, tiny_run: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    import stable_data.shards as shards

    write, written = shards._write_local, 0

    def fills_up(path: Path, data: bytes) -> None:
        nonlocal written
        written += 1
        if written > 4:
            raise OSError(28, "No space left on device")
        write(path, data)

    out = tmp_path / "out"
    monkeypatch.setattr(shards, "_write_local", fills_up)
    with pytest.raises(ConfigError, match="No space left on device"):
        preprocess(str(tiny), str(out), SMALL, Workers())
    monkeypatch.undo()
    preprocess(str(tiny), str(out), SMALL, Workers())
    assert content(out) == content(tiny_run)


def test_a_dataset_without_any_mesh_is_audited_as_unknown(tiny: Path, tmp_path: Path) -> None:
    bare = tmp_path / "data"
    shutil.copytree(tiny, bare)
    shutil.rmtree(bare / "Assets_library")
    manifest = preprocess(str(bare), str(tmp_path / "out"), SMALL, Workers())
    assert (manifest["counts"]["scenes"], manifest["counts"]["assets"]) == (1, 0)
    row = RunFolder(str(tmp_path / "out")).table("scenes").to_pylist()[0]
    assert row["num_without_mesh"] == row["num_objects"]
    assert row["clean"] is not True


def test_a_manifest_that_is_no_object_is_refused(tiny: Path, tmp_path: Path) -> None:
    (tmp_path / "manifest.json").write_text("[1]", "utf-8")
    with pytest.raises(ConfigError, match="not a JSON object"):
        preprocess(str(tiny), str(tmp_path), SMALL, Workers())


def test_an_older_table_is_refused(dataset: Path, clean_run: Path, tmp_path: Path) -> None:
    out = tmp_path / "out"
    shutil.copytree(clean_run, out)
    manifest = json.loads((out / "manifest.json").read_text("utf-8"))
    (out / "manifest.json").write_text(json.dumps(manifest | {"table_version": 0}), "utf-8")
    with pytest.raises(ConfigError, match="table_version: 0 -> 1"):
        preprocess(str(dataset), str(out), SMALL, Workers())


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (("--data", "{tmp}/nothing"), "nothing"),
        (("--data", "{tmp}"), "{tmp}"),
        (("--set", "scenes_per_shart=3"), "did you mean scenes_per_shard"),
        (("--set", "seed=abc"), "expected int"),
        (("--set", "num_points=0"), "expected a positive number"),
        (("--config", "{tmp}/missing.toml"), "cannot be read as TOML"),
        (("--out", "/proc/nowhere"), "cannot be written"),
        (("--set", "task_writer=no.such:thing"), "expected module:function"),
    ],
)
def test_a_run_that_cannot_start_says_why_in_one_line(
    dataset: Path, tmp_path: Path, arguments: tuple[str, str], message: str
) -> None:
    base = {"--data": str(dataset), "--out": str(tmp_path / "out"), "--workers": "0"}
    option, value = arguments[0], arguments[1].format(tmp=tmp_path)
    command = [part for pair in (base | {option: value}).items() for part in pair]
    done = subprocess.run([sys.executable, "-m", "pipelines", "preprocess", *command], capture_output=True, text=True, cwd=ROOT)
    assert done.returncode == 2, done.stderr
    last = done.stderr.strip().splitlines()[-1]
    assert last.startswith("error: ")
    assert message.format(tmp=tmp_path) in last
    assert "Traceback" not in done.stderr


def run_cli(dataset: Path, out: Path, *more: str) -> subprocess.CompletedProcess[str]:
    return subprocess.run(command_of(dataset, out, *more), capture_output=True, text=True, cwd=ROOT)


def command_of(dataset: Path, out: Path, *more: str) -> list[str]:
    settings = [f"--set={k}={json.dumps(v)}" for k, v in SMALL.shaping().items()]
    where = ["--data", str(dataset), "--out", str(out)]
    return [sys.executable, "-m", "pipelines", "preprocess", *where, "--set=num_pictures=0", *settings, *more]


def test_a_run_into_an_object_store_gives_the_same_rows(tiny: Path, tiny_run: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    from moto.server import ThreadedMotoServer

    monkeypatch.setenv("AWS_ACCESS_KEY_ID", "test")
    monkeypatch.setenv("AWS_SECRET_ACCESS_KEY", "test")
    server = ThreadedMotoServer(ip_address="127.0.0.1", port=0)
    server.start()
    try:
        host, port = server.get_host_and_port()
        endpoint = f"http://{host}:{port}"
        boto3.client("s3", endpoint_url=endpoint, region_name="us-east-1").create_bucket(Bucket="preprocess")
        uri = f"s3://preprocess/run?endpoint_override={host}%3A{port}&scheme=http&region=us-east-1"
        preprocess(str(tiny), uri, SMALL, Workers())
        stored, local = RunFolder(uri), RunFolder(str(tiny_run))
        for table in TABLES:
            assert stored.table(table).equals(local.table(table)), table
        assert stored.read_bytes("report/index.html") is not None
        preprocess(str(tiny), uri, SMALL, Workers())  # resumes: nothing to do
    finally:
        server.stop()


def test_a_task_writer_writes_the_tasks_and_is_asked_once(tiny: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
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
    bare = tmp_path / "data"
    shutil.copytree(tiny, bare)
    for task in bare.glob("Layout_info/*/*/task_info.json"):
        task.unlink()
    settings = replace(SMALL, task_writer="my_writer:write", task_cache=str(tmp_path / "cache"))
    for number in range(2):
        preprocess(str(bare), str(tmp_path / f"out{number}"), settings, Workers())
    rows = RunFolder(str(tmp_path / "out0")).table("scenes", ["task"]).to_pylist()
    assert {r["task"]["origin"] for r in rows} == {"model"}
    assert sys.modules["my_writer"].calls == len(rows)


def test_positions_that_mean_the_mesh_centre_are_converted(tiny: Path, tiny_run: Path, tmp_path: Path) -> None:
    out = tmp_path / "out"
    preprocess(str(tiny), str(out), replace(SMALL, position_convention="mesh_centre"), Workers())
    moved = {r["scene_id"]: r for r in RunFolder(str(out)).table("scenes").to_pylist()}
    for row in RunFolder(str(tiny_run)).table("scenes").to_pylist():
        for was, now in zip(row["objects"], moved[row["scene_id"]]["objects"], strict=True):
            upright = was["tilt_quat_xyzw"] == [0.0, 0.0, 0.0, 1.0]
            assert not upright or now["position"] == pytest.approx(was["position"], abs=1e-6)


@pytest.mark.ray
@pytest.mark.slow
@pytest.mark.timeout(900)
@pytest.mark.parametrize("victim", ["driver", "worker"])
def test_ten_kills_at_random_moments_lose_nothing(dataset: Path, clean_run: Path, tmp_path: Path, victim: str) -> None:
    out, moments = tmp_path / "out", random.Random(victim)  # noqa: S311 - moments, not secrets
    for _ in range(10):
        process = subprocess.Popen(
            command_of(dataset, out, "--workers", "2"),
            cwd=ROOT,
            start_new_session=True,
            stdout=subprocess.DEVNULL,
            stderr=subprocess.DEVNULL,
        )
        time.sleep(moments.uniform(2.0, 14.0))
        if victim == "driver":
            os.killpg(process.pid, signal.SIGKILL)
            process.wait()
        else:
            for pid in workers_of(process.pid):
                os.kill(pid, signal.SIGKILL)
                break
            process.wait(timeout=300)
            assert process.returncode == 0
            if _ < 9:
                shutil.rmtree(out)
    done = run_cli(dataset, out, "--workers", "2")
    assert done.returncode == 0, done.stderr
    assert content(out) == content(clean_run)


def workers_of(pid: int) -> Iterator[int]:
    """Ray worker processes below a process that are busy with a shard."""
    listing = subprocess.run(["ps", "-eo", "pid,sid,args"], capture_output=True, text=True, check=True).stdout
    for line in listing.splitlines():
        number, _, command = line.strip().split(maxsplit=2)
        if command.startswith("ray::_call"):
            yield int(number)


@pytest.mark.slow
@pytest.mark.timeout(1800)
def test_mesa_real_is_accounted_for(shared_data: Path, tmp_path: Path) -> None:
    manifest = preprocess(str(shared_data / "mesa_real"), str(tmp_path / "out"), PreprocessSettings(num_pictures=0), Workers())
    assert manifest["counts"]["scenes"] == manifest["num_scenes"] == 120
    assert manifest["counts"]["failures"] == 0
    assert manifest["counts"]["samples"] == 360


@pytest.fixture(scope="module")
def broken_run(shared_data: Path, tmp_path_factory: pytest.TempPathFactory) -> subprocess.CompletedProcess[str]:
    out = tmp_path_factory.mktemp("broken") / "out"
    done = run_cli(shared_data / "mesa_broken", out, "--workers", "0")
    done.args = out
    return done


def test_mesa_broken_is_handled_case_by_case(shared_data: Path, broken_run: subprocess.CompletedProcess[str]) -> None:
    root = shared_data / "mesa_broken"
    assert broken_run.returncode == 1, broken_run.stderr
    run = RunFolder(str(broken_run.args))
    scenes = set(run.table("scenes", ["scene_id"])["scene_id"].to_pylist())
    failures = pl.DataFrame(pl.from_arrow(run.table("failures")))
    warnings = pl.DataFrame(pl.from_arrow(run.table("warnings")))
    expected = json.loads((root / "expected.json").read_text("utf-8"))
    assert scenes | (set(failures["id"]) & set(expected)) == set(expected)
    codes: dict[str, str] = {}
    for scene_id, case in expected.items():
        if case["action"] == "reject":
            assert scene_id not in scenes, case
            rows = failures.filter(pl.col("id") == scene_id)
            assert rows.height == 1, case
            codes[scene_id] = rows["code"].item()
        else:
            assert scene_id in scenes, case
            rows = warnings.filter(pl.col("id") == scene_id)
            assert (rows.height > 0) == (case["action"] == "keep_with_warning"), (case, rows)
            if rows.height:
                codes[scene_id] = rows["code"][0]
    assert len(set(codes.values())) >= len(codes) - 1, "each case has its own reason"


def test_objects_with_a_broken_mesh_are_kept_as_boxes_of_unknown_verdict(broken_run: subprocess.CompletedProcess[str]) -> None:
    rows = {r["scene_id"]: r for r in RunFolder(str(broken_run.args)).table("scenes").to_pylist()}
    assert rows["dining_table_0017"]["num_without_mesh"] == 1
    assert rows["coffee_table_0052"]["num_without_mesh"] == 0
    assert rows["bathroom_vanity_0003"]["num_without_mesh"] == 0
