"""The edit job: what is asked is done and nothing else, nothing is lost, the same rows however it was run."""

import json
import os
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
from typer.testing import CliRunner

import stable_data.storage.run_folder as shards
from models.semantic_reasoner.editing import apply_edit, edit_prompt_of
from models.semantic_reasoner.engines.http_settings import HttpSettings
from models.semantic_reasoner.engines.registry import EngineSettings
from models.semantic_reasoner.text.reply_json import LayoutReply, render_objects
from pipelines.__main__ import app
from pipelines.edit.assets import AssetFinder
from pipelines.edit.job import edit
from pipelines.edit.shard import EditWork
from pipelines.execution.shard_step import Shard, ShardTask, ShardWriter
from pipelines.sources.assets import AssetLibraries
from pipelines.sources.edits import EditRequest, read_edits
from pipelines.sources.scenes import FolderSource
from stable_data.errors import ConfigError
from stable_data.mesatask import MesaTaskDataset
from stable_data.mesatask.lint import lint_folder
from stable_data.scene import SceneObject
from stable_data.storage.run_folder import RunFolder
from stable_data.storage.schemas import Row
from stable_data.storage.table_rows import object_from_row, scene_from_row
from tests.bounds import limit
from tests.pipelines.edit.edit_runs import ALONE, SMALL, file_of, rows_of
from tests.pipelines.runs import ROOT, content, set_options


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
    edit(str(clean_run), edits, str(tmp_path / "out"), SMALL, ALONE, report=False)
    one, other = rows_of(tmp_path / "out", "edits", "edit_id"), rows_of(edited, "edits", "edit_id")
    assert {k: (r["kind"], r["removed"]) for k, r in one.items()} == {k: (r["kind"], r["removed"]) for k, r in other.items()}
    assert RunFolder(str(tmp_path / "out")).table("meshes") == RunFolder(str(clean_run)).table("meshes")


# --- correction ---------------------------------------------------------------------------------------------------------------


def onto_another(dataset: Path, scene_id: str) -> tuple[dict[str, Any], str]:
    """A line that moves a thing into its neighbour, and the name of the neighbour's instance."""
    scene = MesaTaskDataset(dataset).read(scene_id)[0]
    shown = edit_prompt_of(scene)
    standing = [o for o in shown.layout if abs(o.position_cm[2] - o.size_cm[2] / 2) <= 0.1]
    big, small = standing[0], standing[-1]
    there = replace(small, position_cm=(big.position_cm[0], big.position_cm[1], small.position_cm[2]))
    (instance,) = [i for i, name in shown.names.items() if name == big.instance]
    return {"scene_id": scene_id, "instruction": "Move it there.", "reply": render_objects([there], ())}, instance


def test_what_is_put_into_another_thing_is_parted_from_it_and_the_other_stays(dataset: Path, tmp_path: Path) -> None:
    source = MesaTaskDataset(dataset)
    told = [onto_another(dataset, scene_id) for scene_id in source.scene_ids[:2]]
    path = file_of([line for line, _ in told], tmp_path / "e.jsonl")
    edit(str(dataset), path, str(tmp_path / "out"), SMALL, ALONE, report=False)
    edit(str(dataset), path, str(tmp_path / "raw"), replace(SMALL, correct=False), ALONE, report=False)
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
    shown = edit_prompt_of(scene)
    last = shown.layout[-1]  # carries nothing
    (instance,) = [i for i, name in shown.names.items() if name == last.instance]
    x, y, z = (s * f for s, f in zip(scene[instance].size, factors, strict=True))
    resized = replace(last, size_cm=(round(100 * x, 1), round(100 * y, 1), round(100 * z, 1)))
    done = AssetFinder(source, AssetLibraries(scenes=str(dataset))).assign(
        apply_edit(scene, LayoutReply((resized,))), "edit", 0
    )
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
    [({"others": "gone"}, "expected fixed, free or fixed_first"), ({"when_full": "x"}, "setting edit.when_full is 'x'")],
)  # fmt: skip
def test_settings_that_make_no_sense_are_refused(change: dict[str, Any], message: str) -> None:
    with pytest.raises(ConfigError, match=message):
        replace(SMALL, **change)


def test_a_file_without_a_usable_edit_is_all_failures(dataset: Path, tmp_path: Path) -> None:
    manifest = edit(str(dataset), file_of(["{"], tmp_path / "e.jsonl"), str(tmp_path / "out"), SMALL, ALONE)
    assert (manifest["counts"]["scenes"], manifest["counts"]["failures"]) == (0, 1)


# --- resume -------------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("table", [EditWork.TABLES[0], EditWork.TABLES[-1]])
def test_a_shard_that_is_missing_is_made_again(dataset: Path, edits: Path, edited: Path, tmp_path: Path, table: str) -> None:
    out = tmp_path / "out"
    shutil.copytree(edited, out, symlinks=True)
    sorted((out / table).glob("part-*.parquet"))[0].unlink()
    edit(str(dataset), edits, str(out), SMALL, ALONE, report=False)
    assert content(out) == content(edited)


@pytest.mark.slow
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
        edit(str(dataset), edits, str(out), SMALL, ALONE)
    monkeypatch.undo()
    assert 0 < len(content(out)) < len(content(edited))
    edit(str(dataset), edits, str(out), SMALL, ALONE, report=False)
    assert content(out) == content(edited)


def arguments(dataset: Path, edits: Path, out: Path, workers: int) -> list[str]:
    where = ["--scenes", str(dataset), "--edits", str(edits), "--out", str(out), "--engine", "scripted:not_opened"]
    return ["edit", *where, "--assets", "none", "--workers", str(workers), *set_options(SMALL.shaping())]


@pytest.mark.slow
def test_a_run_that_is_killed_goes_on(dataset: Path, edits: Path, edited: Path, tmp_path: Path) -> None:
    out = tmp_path / "out"
    killed = 0
    for enough in (4, 9):  # files in place
        command_line = [sys.executable, "-m", "pipelines", *arguments(dataset, edits, out, 0)]
        with subprocess.Popen(command_line, cwd=ROOT, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL) as process:
            while process.poll() is None and len(content(out)) < enough:
                time.sleep(0.01)
            if process.poll() is None:
                os.kill(process.pid, signal.SIGKILL)
                killed += 1
    assert killed > 0
    edit(str(dataset), edits, str(out), SMALL, ALONE, report=False)
    assert content(out) == content(edited)


def test_another_configuration_is_refused(dataset: Path, edits: Path, edited: Path, tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match="others: fixed_first -> free"):
        edit(str(dataset), edits, str(edited), replace(SMALL, others="free"), ALONE)
    fewer = file_of(edits.read_text("utf-8").splitlines()[:2], tmp_path / "e.jsonl")
    with pytest.raises(ConfigError, match=r"inputs\.edits: "):
        edit(str(dataset), fewer, str(edited), SMALL, ALONE)


@pytest.mark.slow
@pytest.mark.ray
@pytest.mark.usefixtures("local_ray")
def test_ray_gives_the_same_bytes_as_this_process(dataset: Path, edits: Path, edited: Path, tmp_path: Path) -> None:
    out = tmp_path / "out"
    done = CliRunner().invoke(app, arguments(dataset, edits, out, 2))
    assert done.exit_code == 0, done.output
    assert "9 of 9 edits" in done.stdout
    assert content(out) == content(edited)


def test_edits_with_replies_need_no_engine(dataset: Path) -> None:
    scene_id = MesaTaskDataset(dataset).scene_ids[0]
    replied = EditRequest("e", scene_id, "leave it", reply='{"remove": [], "objects": []}')
    nobody = HttpSettings("http://127.0.0.1:1/v1", "gpt", tries=1)
    work = EditWork(str(dataset), replace(SMALL, engine=EngineSettings("openai:gpt", http=nobody)))
    assert [row["scene_id"] for row in work.shard(Shard("0" * 16, (replied,))).rows["scenes"]] == ["e"]
    with pytest.raises(ConfigError, match="base_url"):
        work.shard(Shard("0" * 16, (replace(replied, reply=None),)))


@pytest.mark.slow
def test_an_edit_in_a_process_of_its_own_gives_the_same_rows(dataset: Path, edits: Path, edited: Path, tmp_path: Path) -> None:
    found = read_edits(edits, set(MesaTaskDataset(dataset).scene_ids))
    write = ShardWriter(str(tmp_path), (EditWork(str(dataset), SMALL),))
    write(ShardTask(0, Shard("0" * 16, found.edits[:1])), isolated=True)
    edit_id = found.edits[0].edit_id
    for table, key in (("scenes", "scene_id"), ("edits", "edit_id")):
        assert rows_of(tmp_path, table, key) == {edit_id: rows_of(edited, table, key)[edit_id]}


# --- the command --------------------------------------------------------------------------------------------------------------


def test_the_command_says_what_it_would_do_and_what_failed(dataset: Path, wanted: list[dict[str, Any]], tmp_path: Path) -> None:
    path = file_of([wanted[-1], "{"], tmp_path / "e.jsonl")
    given = ["edit", "--scenes", str(dataset), "--edits", str(path), "--out", str(tmp_path / "out")]
    given += ["--assets", "none", "--workers", "0", "--set=weights=none", "--set=num_pictures=0"]
    plan = json.loads(CliRunner().invoke(app, [*given, "--dry-run"]).stdout)
    assert (plan["num_edits"], plan["num_lost"], plan["num_shards"]) == (2, 1, 1)
    assert not (tmp_path / "out").exists()
    done = CliRunner().invoke(app, given)
    assert done.exit_code == 1
    assert "1 of 2 edits (1 none), 1 warnings, 1 failures" in done.stdout


def test_edits_are_numbered_by_scene(tmp_path: Path) -> None:
    lines = [{"scene_id": s, "instruction": f" {s} {k} "} for k, s in enumerate(("a", "b", "a"))]
    found = read_edits(file_of([*lines, ""], tmp_path / "e.jsonl"), {"a", "b"})
    assert found.edits == (
        EditRequest("a_edit1", "a", "a 0"),
        EditRequest("b_edit1", "b", "b 1"),
        EditRequest("a_edit2", "a", "a 2"),
    )
    assert found.ids == ["a_edit1", "b_edit1", "a_edit2"]
    for nothing in (tmp_path / "no.jsonl", file_of([""], tmp_path / "empty.jsonl")):
        with pytest.raises(ConfigError):
            read_edits(nothing, {"a"})


def test_each_line_is_one_edit_or_one_failure_of_its_own_name(tmp_path: Path) -> None:
    lines: list[Any] = [
        {"scene_id": "nowhere", "instruction": "Do it.", "edit_id": "mine"},
        {"scene_id": "a", "instruction": "Do it.", "edit_id": "mine"},
        {"scene_id": "a", "instruction": "Do it.", "edit_id": "line_000005"},
        {"scene_id": "a", "instruction": "Do it.", "edit_id": "a"},
        {"scene_id": "a", "instruction": "Do it.", "edit_id": "a"},
        {"scene_id": "a", "instruction": "Do it.", "edit_id": "line 000005"},
    ]
    found = read_edits(file_of(lines, tmp_path / "e.jsonl"), {"a"})
    assert found.ids == ["mine", "line_000005", "line 000001", "line 000004", "line 000005", "line 000006"]


@pytest.mark.parametrize(
    "line",
    [
        r'{"scene_id": "a", "instruction": "Do \ud800 it."}',
        r'{"scene_id": "\udfff", "instruction": "Do it."}',
        r'{"scene_id": "a", "instruction": "Do it.", "\ud800": 1}',
        r'{"scene_id": "a", "instruction": "Do it.", "reply": "\ud800"}',
        r'{"scene_id": "a", "instruction": "Do it.", "reply": {"objects": ["\ud800"]}}',
        '{"scene_id": "a", "instruction": "Do it.", "reply": {"objects": [NaN]}}',
        '{"scene_id": "a", "instruction": "Do it.", "reply": ' + "[" * 900 + "]" * 900 + "}",
        '{"scene_id": "a", "instruction": "Do it.", "reply": ' + "1" * 5000 + "}",
        '{"scene_id": ' + "1" * 4000 + ', "instruction": "Do it."}',
        '{"scene_id": "a", "instruction": ["Do it."]}',
        '{"scene_id": "a", "instruction": "Do it.", "edit_id": {}}',
        "[]",
        "[" * 100_000,
        "\udcff",
    ],
    ids=range(14),
)
def test_a_bad_line_is_a_failure_of_its_own(line: str, tmp_path: Path) -> None:
    good = json.dumps({"scene_id": "a", "instruction": "Do it\u2028now."}, ensure_ascii=False)
    path = tmp_path / "e.jsonl"
    path.write_bytes("\n".join([good, line, good]).encode("utf-8", "surrogateescape"))
    found = read_edits(path, {"a"})
    assert [edit.instruction for edit in found.edits] == ["Do it\u2028now."] * 2
    (failure,) = found.failures
    assert failure.item_id == "line 000002"
    assert len(failure.message.encode()) < 300


def test_hostile_lines_are_failures_of_their_lines(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    limit(monkeypatch, "text", max_line=20_000)
    good = json.dumps({"scene_id": "a", "instruction": "Move the mug."})
    hostile = [
        '{"scene_id": "a", "instruction": "\\ud800"}',
        '{"scene_id": ' + "9" * 6000 + ', "instruction": "x"}',
        json.dumps({"scene_id": "a", "instruction": "pour water on " * 1000}),
        '{"scene_id": "a", "instruction": "' + "x" * 30_000,
        "[" * 10_000,
    ]
    path = tmp_path / "e.jsonl"
    path.write_text("\n".join([good, *hostile, good]) + "\n")
    found = read_edits(path, {"a"})
    assert len(found.edits) == 2
    assert [notice.item_id for notice in found.failures] == [f"line {k:06d}" for k in range(2, 7)]
