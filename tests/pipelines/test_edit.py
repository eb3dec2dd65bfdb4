"""The edit job: what is asked is done and nothing else, nothing is lost, the same rows however it was run."""

import json
import os
import shutil
import signal
import subprocess
import sys
import time
from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import pytest
from typer.testing import CliRunner

import stable_data.shards as shards
from models.semantic_reasoner.editing import apply_edit, editing
from models.semantic_reasoner.engine import Completion, Request, Sampling
from models.semantic_reasoner.examples import edit_example_of
from models.semantic_reasoner.layout_text import Reply, render_objects
from pipelines.__main__ import app
from pipelines.edit import edit
from pipelines.edit_assets import AssetFinder
from pipelines.edit_engine import EngineChoice, engine_choice
from pipelines.edit_file import WantedEdit, read_edits
from pipelines.edit_settings import EditSettings
from pipelines.edit_step import EDIT_TABLES, EditShard, EditWork
from pipelines.runner import Workers
from pipelines.scene_source import FolderSource
from stable_data.errors import ConfigError
from stable_data.lint import lint_folder
from stable_data.mesatask import MesaTaskDataset
from stable_data.scene import SceneObject
from stable_data.shards import RunFolder
from stable_data.synth.drafting import KINDS
from stable_data.synth.edit_table import edit_rows
from stable_data.tables import Row, object_from_row, scene_from_row
from tests.pipelines.runs import ROOT, content, used_assets
from tests.stable_data.synth.edit_scenes import made_scenes, row_of

SMALL = EditSettings(weights="none", scenes_per_shard=4, num_pictures=0, position_convention="box_centre")
ALONE = Workers()
EMPTY = '{"remove":[],"objects":[]}'


@pytest.fixture(scope="module", autouse=True)
def own_cache(tmp_path_factory: pytest.TempPathFactory) -> Iterator[None]:
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("XDG_CACHE_HOME", str(tmp_path_factory.mktemp("cache")))
        yield


@pytest.fixture(scope="module")
def drafted(dataset: Path) -> list[Row]:
    """Edits of the scenes of ``dataset``: two each, of the kinds in turn, with assets that its library has."""
    there, count, found = used_assets(dataset), Counter[str](), list[Row]()
    for made in made_scenes(0, 1, 2, 3, seed=3):
        usable = [t for t in edit_rows(row_of(made), 60) if {o["asset_id"] for o in t["objects_out"]} <= there]
        for _ in range(2):
            found.append(usable.pop(min(range(len(usable)), key=lambda k: count[usable[k]["kind"]])))
            count[found[-1]["kind"]] += 1
    assert set(count) == set(KINDS)
    return found


@pytest.fixture(scope="module")
def wanted(drafted: list[Row]) -> list[dict[str, Any]]:
    """Lines of a file of edits, each with its reply; the last asks for nothing."""
    lines = [
        {"scene_id": told["scene_id"], "instruction": told["instruction"], "reply": json.loads(edit_example_of(told).answer)}
        for told in drafted
    ]
    return [
        *lines,
        {"scene_id": drafted[0]["scene_id"], "instruction": "Leave it as it is.", "reply": EMPTY, "edit_id": "same"},
    ]


def file_of(lines: Sequence[Any], path: Path) -> Path:
    path.write_text("".join(f"{line if isinstance(line, str) else json.dumps(line)}\n" for line in lines), "utf-8")
    return path


@pytest.fixture(scope="module")
def edits(wanted: list[dict[str, Any]], tmp_path_factory: pytest.TempPathFactory) -> Path:
    return file_of(wanted, tmp_path_factory.mktemp("edits") / "edits.jsonl")


@pytest.fixture(scope="module")
def edited(dataset: Path, edits: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    out = tmp_path_factory.mktemp("edited") / "out"
    manifest = edit(str(dataset), edits, str(out), SMALL, ALONE, "none")
    assert manifest["counts"]["scenes"] == manifest["num_edits"] == 9
    assert manifest["counts"]["failures"] == 0
    return out


def rows_of(out: Path, table: str, key: str = "scene_id") -> dict[str, Row]:
    return {row[key]: row for row in RunFolder(str(out)).table(table).to_pylist()}


def poses(objects: Sequence[SceneObject]) -> dict[str, tuple[Any, ...]]:
    return {o.instance: (o.position, o.yaw, o.size, o.scale, o.asset_id, o.tilt_quat_xyzw) for o in objects}


def test_what_is_asked_is_done_and_the_rest_is_where_it_was(dataset: Path, edited: Path, drafted: list[Row]) -> None:
    source = MesaTaskDataset(dataset)
    scenes, done = rows_of(edited, "scenes"), rows_of(edited, "edits", "edit_id")
    for k, told in enumerate(drafted):
        edit_id = f"{told['scene_id']}_edit{k % 2 + 1}"
        was, now = source.read(told["scene_id"])[0], scene_from_row(scenes[edit_id])
        assert done[edit_id]["kind"] == told["kind"]
        assert done[edit_id]["instruction"] == told["instruction"]
        assert done[edit_id]["removed"] == told["removed"]
        assert {o["instance"] for o in done[edit_id]["objects_out"]} == {o["instance"] for o in told["objects_out"]}
        named = {o["instance"] for o in told["objects_out"]} | {*told["removed"]}
        before, after = poses(was.objects), poses(now.objects)
        assert {n: p for n, p in after.items() if n not in named} == {n: p for n, p in before.items() if n not in named}
        assert scenes[edit_id]["clean"]
        assert scenes[edit_id]["split"] == done[edit_id]["split"]


def test_new_things_have_the_assets_that_they_were_drafted_with(edited: Path, drafted: list[Row]) -> None:
    done = rows_of(edited, "edits", "edit_id")
    pairs = []
    for k, told in enumerate(drafted):
        found = {o["instance"]: o for o in done[f"{told['scene_id']}_edit{k % 2 + 1}"]["objects_out"]}
        known = {o["instance"]: o["asset_id"] for o in told["objects_in"]}
        new = [o for o in told["objects_out"] if o["asset_id"] != known.get(o["instance"])]
        pairs += [(found[o["instance"]], o) for o in new]
    assert pairs
    assert all(one["asset_id"] is not None for one, _ in pairs)
    assert all(one["category"] == o["category"] for one, o in pairs)


def test_before_and_what_changed_are_after(edited: Path) -> None:
    scenes = rows_of(edited, "scenes")
    for edit_id, row in rows_of(edited, "edits", "edit_id").items():
        new = {o["instance"]: object_from_row(o) for o in row["objects_out"]}
        kept = [object_from_row(o) for o in row["objects_in"] if o["instance"] not in {*row["removed"], *new}]
        assert poses([*kept, *new.values()]) == poses(scene_from_row(scenes[edit_id]).objects)


def test_an_empty_edit_changes_nothing(dataset: Path, edited: Path, drafted: list[Row]) -> None:
    was = MesaTaskDataset(dataset).read(drafted[0]["scene_id"])[0]
    row = rows_of(edited, "scenes")["same"]
    assert poses(scene_from_row(row).objects) == poses(was.objects)
    assert rows_of(edited, "edits", "edit_id")["same"]["objects_out"] == []
    warnings = RunFolder(str(edited)).table("warnings").to_pylist()
    assert [w["code"] for w in warnings if w["id"] == "same"] == ["nothing_changed"]


def test_the_edited_folder_is_clean_by_lint(edited: Path) -> None:
    result = lint_folder(edited / "dataset")
    assert [bool(row["clean"]) for row in result.rows] == [True] * 9
    assert not result.failures


def test_a_run_is_edited_as_its_folder_is_and_carries_its_assets(
    clean_run: Path, edits: Path, edited: Path, tmp_path: Path
) -> None:
    edit(str(clean_run), edits, str(tmp_path / "out"), SMALL, ALONE, "none", report=False)
    one, other = rows_of(tmp_path / "out", "edits", "edit_id"), rows_of(edited, "edits", "edit_id")
    assert {k: (r["kind"], r["removed"]) for k, r in one.items()} == {k: (r["kind"], r["removed"]) for k, r in other.items()}
    assert RunFolder(str(tmp_path / "out")).table("meshes") == RunFolder(str(clean_run)).table("meshes")


# --- the reasoner -------------------------------------------------------------------------------------------------------------


class Told:
    """Says no JSON first, then what it was told."""

    name, repeats = "told", True

    def __init__(self, replies: dict[str, str]) -> None:
        self.replies, self.asked = replies, list[Request]()

    def complete(self, requests: Sequence[Request]) -> list[Completion]:
        self.asked += requests
        return [self._complete(request) for request in requests]

    def _complete(self, request: Request) -> Completion:
        question = request.messages[1]["content"]
        (reply,) = [reply for words, reply in self.replies.items() if words in question]
        if reply == "down":
            return Completion("", failure="nobody answers", code="endpoint_down")
        return Completion(reply if len(request.messages) > 2 else "Sure! I have moved it.")


def asking(engine: Told) -> EngineChoice:
    return EngineChoice("told", "0", partial(_same, engine))


def _same(engine: Told) -> Told:
    return engine


def test_the_reasoner_is_asked_again_until_its_reply_can_be_used(
    dataset: Path, wanted: list[dict[str, Any]], edited: Path, tmp_path: Path
) -> None:
    asked = [{k: v for k, v in line.items() if k != "reply"} for line in wanted]
    engine = Told({line["instruction"]: json.dumps(line["reply"]) for line in wanted[:-1]} | {"Leave it": EMPTY})
    out = tmp_path / "out"
    path = file_of(asked, tmp_path / "edits.jsonl")
    edit(str(dataset), path, str(out), SMALL, ALONE, asking(engine), report=False)
    assert {k: r["objects"] for k, r in rows_of(out, "scenes").items()} == {
        k: r["objects"] for k, r in rows_of(edited, "scenes").items()
    }
    assert [len(request.messages) for request in engine.asked] == ([2] * 4 + [4] * 4) * 2 + [2, 4]
    assert all(request.form.edits for request in engine.asked)
    assert "reply is no JSON" in engine.asked[4].messages[-1]["content"]


def test_replies_that_cannot_be_used_are_failures_and_nothing_is_lost(
    dataset: Path, wanted: list[dict[str, Any]], tmp_path: Path
) -> None:
    scene_id = wanted[0]["scene_id"]
    lines: list[Any] = [
        {"scene_id": scene_id, "instruction": "Never JSON.", "edit_id": "never"},
        {"scene_id": scene_id, "instruction": "Engine is down.", "edit_id": "down"},
        {"scene_id": scene_id, "instruction": "Said.", "reply": "no json", "edit_id": "said"},
        {"scene_id": scene_id, "instruction": "Unknown.", "reply": '{"remove":["zebra_0"],"objects":[]}', "edit_id": "zebra"},
        {"scene_id": scene_id, "instruction": "x" * 3000, "edit_id": "long"},
        {"scene_id": scene_id, "instruction": "Good.", "reply": EMPTY, "edit_id": "good"},
        {"scene_id": "nowhere_0001", "instruction": "Move it."},
        {"scene_id": scene_id, "instruction": " "},
        {"scene_id": scene_id, "instruction": "Again.", "reply": EMPTY, "edit_id": "good"},
        {"scene_id": scene_id, "instruction": "Out.", "reply": EMPTY, "edit_id": "../good"},
        {"scene_id": scene_id, "instruction": "More.", "replies": EMPTY},
        "no json at all",
        "[1]",
        "",
    ]
    engine = Told({"Never JSON.": "still not", "Engine is down.": "down"})
    out = tmp_path / "out"
    manifest = edit(str(dataset), file_of(lines, tmp_path / "e.jsonl"), str(out), SMALL, ALONE, asking(engine))
    failures = rows_of(out, "failures", "id")
    assert {k: (r["step"], r["code"]) for k, r in failures.items()} == {
        "never": ("reply", "reply_not_json"),
        "down": ("reply", "endpoint_down"),
        "said": ("reply", "reply_not_json"),
        "zebra": ("reply", "edit_refused"),
        "long": ("reply", "instruction_invalid"),
        "nowhere_0001_edit1": ("edits", "scene_unknown"),
        "line_000008": ("edits", "instruction_invalid"),
        "line_000009": ("edits", "edit_invalid"),
        "line_000010": ("edits", "edit_invalid"),
        "line_000011": ("edits", "edit_invalid"),
        "line_000012": ("edits", "edit_invalid"),
        "line_000013": ("edits", "edit_invalid"),
    }
    assert rows_of(out, "scenes").keys() == {"good"}
    assert manifest["num_edits"] == 13
    assert all("\n" not in row["message"] for row in failures.values())
    assert len([r for r in engine.asked if "Never JSON." in r.messages[1]["content"]]) == SMALL.attempts
    assert len([r for r in engine.asked if "Engine is down." in r.messages[1]["content"]]) == 1
    assert "zebra_0" in (out / "report" / "index.html").read_text("utf-8")


def test_a_file_without_a_usable_edit_is_all_failures(dataset: Path, tmp_path: Path) -> None:
    manifest = edit(str(dataset), file_of(["{"], tmp_path / "e.jsonl"), str(tmp_path / "out"), SMALL, ALONE, "none")
    assert (manifest["counts"]["scenes"], manifest["counts"]["failures"]) == (0, 1)


def test_an_engine_is_named_or_refused(tmp_path: Path, dataset: Path, wanted: list[dict[str, Any]]) -> None:
    assert engine_choice("none", Sampling()) is None
    with pytest.raises(ConfigError, match=r"holds no config\.json"):
        engine_choice(str(tmp_path), Sampling())
    (tmp_path / "config.json").write_text("{}")
    one = engine_choice(str(tmp_path), Sampling())
    (tmp_path / "model.safetensors").write_bytes(b"0")
    other = engine_choice(str(tmp_path), Sampling())
    assert one is not None
    assert other is not None
    assert one.fingerprint != other.fingerprint
    path = file_of([{"scene_id": wanted[0]["scene_id"], "instruction": "Move it."}], tmp_path / "e.jsonl")
    with pytest.raises(ConfigError, match="have no reply and the engine is none"):
        edit(str(dataset), path, str(tmp_path / "out"), SMALL, ALONE, "none")
    assert not (tmp_path / "out" / "manifest.json").exists()


# --- correction ---------------------------------------------------------------------------------------------------------------


def onto_another(dataset: Path, scene_id: str) -> tuple[dict[str, Any], str]:
    """A line that moves a thing into its neighbour, and the name of the neighbour's instance."""
    scene = MesaTaskDataset(dataset).read(scene_id)[0]
    shown = editing(scene)
    standing = [o for o in shown.layout if abs(o.position_cm[2] - o.size_cm[2] / 2) <= 0.1]
    big, small = standing[0], standing[-1]
    there = replace(small, position_cm=(big.position_cm[0], big.position_cm[1], small.position_cm[2]))
    (instance,) = [i for i, name in shown.names.items() if name == big.instance]
    return {"scene_id": scene_id, "instruction": "Move it there.", "reply": render_objects([there], ())}, instance


def test_what_is_put_into_another_thing_is_parted_from_it_and_the_other_stays(dataset: Path, tmp_path: Path) -> None:
    source = MesaTaskDataset(dataset)
    told = [onto_another(dataset, scene_id) for scene_id in source.scene_ids[:2]]
    path = file_of([line for line, _ in told], tmp_path / "e.jsonl")
    edit(str(dataset), path, str(tmp_path / "out"), SMALL, ALONE, "none", report=False)
    edit(str(dataset), path, str(tmp_path / "raw"), replace(SMALL, correct=False), ALONE, "none", report=False)
    moved = {
        row["id"] for row in RunFolder(str(tmp_path / "out")).table("warnings").to_pylist() if row["code"] == "others_moved"
    }
    raw, out = rows_of(tmp_path / "raw", "scenes"), rows_of(tmp_path / "out", "scenes")
    assert not any(row["clean"] for row in raw.values())
    for (line, instance), edit_id in zip(told, raw, strict=True):
        was = source.read(line["scene_id"])[0]
        assert out[edit_id]["clean"]
        if edit_id not in moved:
            assert poses(scene_from_row(out[edit_id]).objects)[instance] == poses(was.objects)[instance]
    assert len(moved) < len(told)


@pytest.mark.parametrize(("factors", "is_even"), [((1.2, 1.2, 1.2), True), ((1.0, 1.0, 1.3), False)])
def test_a_thing_of_another_size_is_the_same_mesh_scaled(
    dataset: Path, factors: tuple[float, float, float], is_even: bool
) -> None:
    source = FolderSource(dataset)
    scene = source.dataset.read(source.dataset.scene_ids[0])[0]
    shown = editing(scene)
    last = shown.layout[-1]  # carries nothing
    (instance,) = [i for i, name in shown.names.items() if name == last.instance]
    x, y, z = (s * f for s, f in zip(scene[instance].size, factors, strict=True))
    resized = replace(last, size_cm=(round(100 * x, 1), round(100 * y, 1), round(100 * z, 1)))
    done = AssetFinder(source).with_assets(apply_edit(scene, Reply((resized,))), "edit", 0)
    now, was = done.scene[instance], scene[instance]
    assert (now.asset_id, now.tilt_quat_xyzw) == (was.asset_id, was.tilt_quat_xyzw)
    assert now.scale is not None
    assert was.scale is not None
    assert now.size == pytest.approx((x, y, z), abs=1e-3)
    assert now.position[2] - now.size[2] / 2 == pytest.approx(was.position[2] - was.size[2] / 2, abs=1e-9)
    ratios = [a / b for a, b in zip(now.scale, was.scale, strict=True)]
    assert (max(ratios) < 1.001 * min(ratios)) == is_even
    assert done.kept >= {o.instance for o in scene.objects} - {instance}
    shape, odd = source.store.shape(now)
    assert shape.size == pytest.approx(now.size)
    assert not odd


@pytest.mark.parametrize(
    ("change", "message"),
    [({"others": "gone"}, "expected one of fixed, free, fixed_first"), ({"attempts": 0}, "edit.attempts is 0"),
     ({"temperature": -1.0}, "expected 0 to 2"), ({"when_full": "x"}, "setting edit.when_full is x")],
)  # fmt: skip
def test_settings_that_make_no_sense_are_refused(change: dict[str, Any], message: str) -> None:
    with pytest.raises(ConfigError, match=message):
        replace(SMALL, **change)


# --- resume -------------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("table", [EDIT_TABLES[0], EDIT_TABLES[-1]])
def test_a_shard_that_is_missing_is_made_again(dataset: Path, edits: Path, edited: Path, tmp_path: Path, table: str) -> None:
    out = tmp_path / "out"
    shutil.copytree(edited, out, symlinks=True)
    sorted((out / table).glob("part-*.parquet"))[0].unlink()
    edit(str(dataset), edits, str(out), SMALL, ALONE, "none", report=False)
    assert content(out) == content(edited)


def test_a_run_that_was_broken_off_goes_on(
    dataset: Path, edits: Path, edited: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    write, written = shards._write_local, 0

    def fills_up(path: Path, data: bytes) -> None:
        nonlocal written
        written += 1
        if written > 10:
            raise OSError(28, "No space left on device")
        write(path, data)

    out = tmp_path / "out"
    monkeypatch.setattr(shards, "_write_local", fills_up)
    with pytest.raises(ConfigError, match="No space left on device"):
        edit(str(dataset), edits, str(out), SMALL, ALONE, "none")
    monkeypatch.undo()
    assert 0 < len(content(out)) < len(content(edited))
    edit(str(dataset), edits, str(out), SMALL, ALONE, "none", report=False)
    assert content(out) == content(edited)


def command(dataset: Path, edits: Path, out: Path, workers: int) -> list[str]:
    settings = [f"--set={k}={json.dumps(v)}" for k, v in (SMALL.shaping() | {"num_pictures": 0}).items()]
    where = ["--scenes", str(dataset), "--edits", str(edits), "--out", str(out), "--engine", "none"]
    return [sys.executable, "-m", "pipelines", "edit", *where, "--workers", str(workers), *settings]


@pytest.mark.slow
def test_a_run_that_is_killed_goes_on(dataset: Path, edits: Path, edited: Path, tmp_path: Path) -> None:
    out = tmp_path / "out"
    killed = 0
    for enough in (4, 9):  # files in place
        command_line = command(dataset, edits, out, 0)
        with subprocess.Popen(command_line, cwd=ROOT, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL) as process:
            while process.poll() is None and len(content(out)) < enough:
                time.sleep(0.01)
            if process.poll() is None:
                os.kill(process.pid, signal.SIGKILL)
                killed += 1
    assert killed > 0
    edit(str(dataset), edits, str(out), SMALL, ALONE, "none", report=False)
    assert content(out) == content(edited)


def test_another_configuration_is_refused(dataset: Path, edits: Path, edited: Path, tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match="others: fixed_first -> free"):
        edit(str(dataset), edits, str(edited), replace(SMALL, others="free"), ALONE, "none")
    fewer = file_of(edits.read_text("utf-8").splitlines()[:2], tmp_path / "e.jsonl")
    with pytest.raises(ConfigError, match=r"inputs\.edits: "):
        edit(str(dataset), fewer, str(edited), SMALL, ALONE, "none")


@pytest.mark.ray
def test_ray_gives_the_same_bytes_as_this_process(dataset: Path, edits: Path, edited: Path, tmp_path: Path) -> None:
    out = tmp_path / "out"
    done = subprocess.run(command(dataset, edits, out, 2), capture_output=True, text=True, cwd=ROOT)
    assert done.returncode == 0, done.stderr
    assert "9 of 9 edits" in done.stdout
    assert content(out) == content(edited)


@pytest.mark.slow
def test_an_edit_in_a_process_of_its_own_gives_the_same_rows(dataset: Path, edits: Path, edited: Path, tmp_path: Path) -> None:
    found = read_edits(edits, set(MesaTaskDataset(dataset).scene_ids))
    work = EditWork(str(dataset), str(tmp_path), SMALL)
    work(EditShard("0" * 16, found.edits[:1]), isolated=True)
    edit_id = found.edits[0].edit_id
    for table, key in (("scenes", "scene_id"), ("edits", "edit_id")):
        assert rows_of(tmp_path, table, key) == {edit_id: rows_of(edited, table, key)[edit_id]}


# --- the command --------------------------------------------------------------------------------------------------------------


def test_the_command_says_what_it_would_do_and_what_failed(dataset: Path, wanted: list[dict[str, Any]], tmp_path: Path) -> None:
    path = file_of([wanted[-1], "{"], tmp_path / "e.jsonl")
    given = ["edit", "--scenes", str(dataset), "--edits", str(path), "--out", str(tmp_path / "out"), "--engine", "none"]
    given += ["--workers", "0", "--set=weights=none", "--set=num_pictures=0"]
    plan = json.loads(CliRunner().invoke(app, [*given, "--dry-run"]).stdout)
    assert (plan["num_edits"], plan["num_unusable"], plan["num_shards"]) == (1, 1, 1)
    assert not (tmp_path / "out").exists()
    done = CliRunner().invoke(app, given)
    assert done.exit_code == 1
    assert "1 of 2 edits (1 none), 1 warnings, 1 failures" in done.stdout


def test_edits_are_numbered_by_scene(tmp_path: Path) -> None:
    lines = [{"scene_id": s, "instruction": f" {s} {k} "} for k, s in enumerate(("a", "b", "a"))]
    found = read_edits(file_of([*lines, ""], tmp_path / "e.jsonl"), {"a", "b"})
    assert found.edits == (
        WantedEdit("a_edit1", "a", "a 0"),
        WantedEdit("b_edit1", "b", "b 1"),
        WantedEdit("a_edit2", "a", "a 2"),
    )
    assert found.ids == ["a_edit1", "b_edit1", "a_edit2"]
    for nothing in (tmp_path / "no.jsonl", file_of([""], tmp_path / "empty.jsonl")):
        with pytest.raises(ConfigError):
            read_edits(nothing, {"a"})
