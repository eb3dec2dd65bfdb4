"""The edit job: what is asked is done and nothing else, nothing is lost, the same rows however it was run."""

import json
import os
import shutil
import signal
import subprocess
import sys
import time
from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
from typer.testing import CliRunner

import models.semantic_reasoner.assembly as assembly
import stable_data.shards as shards
from models.semantic_reasoner.assembly import ReasonerSettings
from models.semantic_reasoner.editing import apply_edit, editing
from models.semantic_reasoner.engine import Completion, Request
from models.semantic_reasoner.engines import EMBEDDED, EngineSettings
from models.semantic_reasoner.examples import edit_example_of
from models.semantic_reasoner.layout_text import Reply, render_objects
from models.semantic_reasoner.reasoner import SemanticReasoner
from pipelines.__main__ import app
from pipelines.edit import edit
from pipelines.edit_assets import AssetFinder
from pipelines.edit_file import WantedEdit, read_edits
from pipelines.edit_settings import EditSettings
from pipelines.edit_step import EditWork, seed_of
from pipelines.runner import Workers
from pipelines.scene_source import FolderSource
from pipelines.scene_work import SceneShard
from stable_data.errors import ConfigError
from stable_data.lint import lint_folder
from stable_data.mesatask import MesaTaskDataset
from stable_data.scene import SceneObject
from stable_data.shards import RunFolder
from stable_data.synth.drafting import KINDS
from stable_data.synth.edit_table import edit_rows
from stable_data.tables import Row, object_from_row, scene_from_row
from tests.models.semantic_reasoner.endpoint import Act, endpoint, said
from tests.models.semantic_reasoner.known_categories import ask
from tests.pipelines.runs import ROOT, content, used_assets
from tests.stable_data.synth.edit_scenes import made_scenes, row_of

pytestmark = pytest.mark.usefixtures("own_cache")

SMALL = EditSettings(weights="none", scenes_per_shard=4, num_pictures=0, position_convention="box_centre")
ALONE = Workers()
EMPTY = '{"remove":[],"objects":[]}'


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
    manifest = edit(str(dataset), edits, str(out), SMALL, ALONE)
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
    edit(str(clean_run), edits, str(tmp_path / "out"), SMALL, ALONE, report=False)
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


@pytest.fixture
def asked(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Callable[[Told], EditSettings]:
    """Settings under which an engine of ours is asked."""

    def settings(engine: Told) -> EditSettings:
        monkeypatch.setattr(assembly, "load_engine", lambda _: engine)
        return scripted([], tmp_path / "none.json")

    return settings


def scripted(replies: Any, path: Path, **reasoner: Any) -> EditSettings:
    """Settings under which replies come from a file."""
    path.write_text(json.dumps(replies), "utf-8")
    return replace(SMALL, engine=EngineSettings(f"scripted:{path}"), reasoner=ReasonerSettings(**{"tries": 3, **reasoner}))


def test_the_reasoner_is_asked_again_until_its_reply_can_be_used(
    dataset: Path, wanted: list[dict[str, Any]], edited: Path, tmp_path: Path, asked: Callable[[Told], EditSettings]
) -> None:
    lines = [{k: v for k, v in line.items() if k != "reply"} for line in wanted]
    engine = Told({line["instruction"]: json.dumps(line["reply"]) for line in wanted[:-1]} | {"Leave it": EMPTY})
    out = tmp_path / "out"
    path = file_of(lines, tmp_path / "edits.jsonl")
    edit(str(dataset), path, str(out), asked(engine), ALONE, report=False)
    assert {k: r["objects"] for k, r in rows_of(out, "scenes").items()} == {
        k: r["objects"] for k, r in rows_of(edited, "scenes").items()
    }
    assert [len(request.messages) for request in engine.asked] == ([2] * 4 + [4] * 4) * 2 + [2, 4, 6]
    assert all(request.form.edits for request in engine.asked)
    assert "reply is no JSON" in engine.asked[4].messages[-1]["content"]
    assert "nothing is changed" in engine.asked[-1].messages[-1]["content"]
    assert [w["code"] for w in RunFolder(str(out)).table("warnings").to_pylist() if w["id"] == "same"] == ["nothing_changed"]


def test_replies_that_cannot_be_used_are_failures_and_nothing_is_lost(
    dataset: Path, wanted: list[dict[str, Any]], tmp_path: Path, asked: Callable[[Told], EditSettings]
) -> None:
    scene_id = wanted[0]["scene_id"]
    unknown = '{"remove":["zebra_0"],"objects":[]}'
    lines: list[Any] = [
        {"scene_id": scene_id, "instruction": "Never JSON.", "edit_id": "never"},
        {"scene_id": scene_id, "instruction": "Zoo.", "edit_id": "zoo"},
        {"scene_id": scene_id, "instruction": "Said.", "reply": "no json", "edit_id": "said"},
        {"scene_id": scene_id, "instruction": "Unknown.", "reply": unknown, "edit_id": "zebra"},
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
    engine = Told({"Never JSON.": "still not", "Zoo.": unknown})
    out = tmp_path / "out"
    manifest = edit(str(dataset), file_of(lines, tmp_path / "e.jsonl"), str(out), asked(engine), ALONE)
    failures = rows_of(out, "failures", "id")
    assert {k: (r["step"], r["code"]) for k, r in failures.items()} == {
        "never": ("reply", "reply_unusable"),
        "zoo": ("reply", "reply_unusable"),
        "said": ("reply", "reply_not_json"),
        "zebra": ("reply", "edit_refused"),
        "long": ("reply", "instruction_invalid"),
        "line 000007": ("edits", "scene_unknown"),
        "line 000008": ("edits", "instruction_invalid"),
        "line 000009": ("edits", "edit_invalid"),
        "line 000010": ("edits", "edit_invalid"),
        "line 000011": ("edits", "edit_invalid"),
        "line 000012": ("edits", "edit_invalid"),
        "line 000013": ("edits", "edit_invalid"),
    }
    assert rows_of(out, "scenes").keys() == {"good"}
    assert manifest["num_edits"] == 13
    assert all("\n" not in row["message"] for row in failures.values())
    assert "3 answers could not be used, the last because zebra_0 is to be removed" in failures["zoo"]["message"]
    assert len([r for r in engine.asked if "Never JSON." in r.messages[1]["content"]]) == 3
    assert "zebra_0" in (out / "report" / "index.html").read_text("utf-8")


def test_an_endpoint_that_is_down_stops_the_run_and_costs_no_edit(
    dataset: Path, wanted: list[dict[str, Any]], tmp_path: Path, asked: Callable[[Told], EditSettings]
) -> None:
    lines = [{"scene_id": wanted[0]["scene_id"], "instruction": f"{k} is asked.", "edit_id": str(k)} for k in range(6)]
    path, out = file_of(lines, tmp_path / "e.jsonl"), tmp_path / "out"
    engine = Told({f"{k} is asked.": "down" if k == 5 else "still not" for k in range(6)})  # shards are of four
    with pytest.raises(ConfigError, match=r"^5: nobody answers; what is done is kept, run again to go on$") as caught:
        edit(str(dataset), path, str(out), asked(engine), ALONE, report=False)
    assert caught.value.code == "engine_off"
    engine.replies["5 is asked."] = "nor is this"
    before = len(engine.asked)
    assert edit(str(dataset), path, str(out), asked(engine), ALONE, report=False)["status"] == "complete"
    assert len(engine.asked) == before + 2 * 3  # the second shard alone, every edit three times
    assert {k: r["code"] for k, r in rows_of(out, "failures", "id").items()} == dict.fromkeys("012345", "reply_unusable")


def test_what_is_known_of_categories_keeps_bad_replies_out_and_odd_ones_are_named(
    dataset: Path, clean_run: Path, wanted: list[dict[str, Any]], tmp_path: Path
) -> None:
    scene_id = wanted[0]["scene_id"]
    thing = editing(MesaTaskDataset(dataset).read(scene_id)[0]).layout[-1]
    away = replace(thing, position_cm=(900.0, 10.0, thing.position_cm[2]))
    odd = replace(thing, instance="zeppelin_0", description="a zeppelin", position_cm=(10.0, 10.0, thing.size_cm[2] / 2))
    lines = [{"scene_id": scene_id, "instruction": f"{words} it.", "edit_id": words} for words in ("Away", "Odd")]
    replies = {"Away it.": render_objects([away], ()), "Odd it.": render_objects([odd], ())}
    settings = scripted(replies, tmp_path / "script.json", tries=1, statistics=str(clean_run))
    edit(str(dataset), file_of(lines, tmp_path / "e.jsonl"), str(tmp_path / "out"), settings, ALONE, report=False)
    failures = rows_of(tmp_path / "out", "failures", "id")
    assert failures["Away"]["code"] == "reply_unusable"
    assert "leaves the table" in failures["Away"]["message"]
    warnings = RunFolder(str(tmp_path / "out")).table("warnings").to_pylist()
    assert "category_unknown" in {w["code"] for w in warnings if w["id"] == "Odd"}


def test_a_run_goes_on_with_the_same_reasoner_alone(dataset: Path, wanted: list[dict[str, Any]], tmp_path: Path) -> None:
    lines = [{"scene_id": wanted[0]["scene_id"], "instruction": "Leave it.", "edit_id": "one"}]
    path, out = file_of(lines, tmp_path / "e.jsonl"), str(tmp_path / "out")
    settings = scripted({"Leave it": EMPTY}, tmp_path / "script.json", tries=1)
    edit(str(dataset), path, out, settings, ALONE, report=False)
    edit(str(dataset), path, out, replace(settings, engine=replace(settings.engine, num_slots=7)), ALONE, report=False)
    with pytest.raises(ConfigError, match=r"inputs\.reasoner\.tries: 1 -> 2"):
        edit(str(dataset), path, out, replace(settings, reasoner=ReasonerSettings(tries=2)), ALONE)
    with pytest.raises(ConfigError, match=r"inputs\.reasoner\.model: \w+ -> \w+"):
        edit(str(dataset), path, out, scripted({"Leave": EMPTY}, tmp_path / "script.json", tries=1), ALONE)


def test_what_was_said_once_is_kept_and_said_again(dataset: Path, wanted: list[dict[str, Any]], tmp_path: Path) -> None:
    lines = [{"scene_id": wanted[0]["scene_id"], "instruction": "Leave it.", "edit_id": "one"}]
    path = file_of(lines, tmp_path / "e.jsonl")
    replies = [json.dumps(wanted[0]["reply"])]  # one alone: a second request would fail
    settings = scripted(replies, tmp_path / "script.json")
    settings = replace(settings, engine=replace(settings.engine, cache=str(tmp_path / "kept")))
    for name in ("one", "other"):
        edit(str(dataset), path, str(tmp_path / name), settings, ALONE, report=False)
        scripted([], tmp_path / "script.json")
    assert len(rows_of(tmp_path / "one", "scenes")) == 1
    assert rows_of(tmp_path / "one", "scenes") == rows_of(tmp_path / "other", "scenes")


def test_an_endpoint_is_asked_with_a_key_that_is_nowhere_on_disk(
    dataset: Path, wanted: list[dict[str, Any]], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("A_KEY", "very-secret")
    lines = [{"scene_id": wanted[0]["scene_id"], "instruction": wanted[0]["instruction"], "edit_id": "one"}]
    path, out = file_of(lines, tmp_path / "e.jsonl"), tmp_path / "out"

    def plan(words: str, number: int, body: dict[str, Any]) -> Act:
        was_refused = len(body["messages"]) > 2
        return Act(body=said(json.dumps(wanted[0]["reply"]) if was_refused else '{"remove":["zebra_0"],"objects":[]}'))

    with endpoint(plan) as server:
        engine = EngineSettings("openai:large", http=server.settings(key_variable="A_KEY"), cache=str(tmp_path / "kept"))
        edit(str(dataset), path, str(out), replace(SMALL, engine=engine), ALONE, report=False)
    assert rows_of(out, "scenes").keys() == {"one"}
    assert [len(body["messages"]) for body in server.bodies] == [2, 4]
    assert "zebra_0 is to be removed, but is not in the layout" in server.bodies[1]["messages"][-1]["content"]
    assert {body["model"] for body in server.bodies} == {"large"}
    assert all("very-secret" in headers["Authorization"] for headers in server.headers)
    assert not [f for f in tmp_path.rglob("*") if f.is_file() and b"very-secret" in f.read_bytes()]
    edit(str(dataset), path, str(tmp_path / "again"), replace(SMALL, engine=engine), ALONE, report=False)  # nobody is there
    assert rows_of(tmp_path / "again", "scenes") == rows_of(out, "scenes")


def test_a_seed_is_of_the_edit_and_not_of_its_shard() -> None:
    one = WantedEdit("a_edit1", "a", "Move it.")
    assert seed_of(one, 0) == seed_of(replace(one, reply=EMPTY), 0)
    others = [replace(one, edit_id="b"), replace(one, scene_id="b"), replace(one, instruction="Move them.")]
    assert len({seed_of(one, 0), seed_of(one, 1), *(seed_of(other, 0) for other in others)}) == 5


@pytest.mark.parametrize("per_shard", [1, 3])
def test_requests_are_the_same_however_edits_are_cut(
    dataset: Path, wanted: list[dict[str, Any]], tmp_path: Path, asked: Callable[[Told], EditSettings], per_shard: int
) -> None:
    lines = [{"scene_id": w["scene_id"], "instruction": f"Leave {k}."} for k, w in enumerate(wanted[:3])]
    engine = Told({"Leave": EMPTY})
    settings = replace(asked(engine), scenes_per_shard=per_shard)
    path = file_of(lines, tmp_path / "e.jsonl")
    edit(str(dataset), path, str(tmp_path / "out"), settings, ALONE, report=False)
    seeds = {r.messages[1]["content"]: r.seed for r in engine.asked if len(r.messages) == 2}
    found = read_edits(path, set(MesaTaskDataset(dataset).scene_ids)).edits
    firsts = [r for r in engine.asked if len(r.messages) == 2]
    assert len(seeds) == 3
    assert sorted(r.seed for r in firsts) == sorted(first_seed(e) for e in found)


def first_seed(wanted: WantedEdit) -> int:
    """Of the first try, as the reasoner makes it of the seed of a question."""
    engine = Told({"": EMPTY})
    SemanticReasoner(engine, tries=1).propose(
        [replace(ask(), instruction="Move it.", wanted="edit")], [seed_of(wanted, SMALL.seed)]
    )
    return engine.asked[0].seed


EMBEDDED_IS_HERE = pytest.mark.skipif(not (EMBEDDED / "config.json").is_file(), reason="the embedded reasoner is not here")


@EMBEDDED_IS_HERE
def test_the_embedded_reasoner_is_asked(dataset: Path, wanted: list[dict[str, Any]], tmp_path: Path) -> None:
    lines = [{"scene_id": wanted[0]["scene_id"], "instruction": wanted[0]["instruction"], "edit_id": "one"}]
    settings = replace(SMALL, reasoner=ReasonerSettings(tries=2))
    manifest = edit(str(dataset), file_of(lines, tmp_path / "e.jsonl"), str(tmp_path / "out"), settings, ALONE, report=False)
    assert manifest["engine"] == "embedded"
    assert manifest["counts"]["scenes"] + manifest["counts"]["failures"] == 1


def test_a_file_without_a_usable_edit_is_all_failures(dataset: Path, tmp_path: Path) -> None:
    manifest = edit(str(dataset), file_of(["{"], tmp_path / "e.jsonl"), str(tmp_path / "out"), SMALL, ALONE)
    assert (manifest["counts"]["scenes"], manifest["counts"]["failures"]) == (0, 1)


def test_an_engine_that_is_not_there_is_refused_before_anything_is_written(
    tmp_path: Path, dataset: Path, wanted: list[dict[str, Any]], monkeypatch: pytest.MonkeyPatch
) -> None:
    path = file_of([{"scene_id": wanted[0]["scene_id"], "instruction": "Move it."}], tmp_path / "e.jsonl")
    monkeypatch.delenv("A_KEY", raising=False)
    http = replace(SMALL.engine.http, key_variable="A_KEY")
    for engine, message in (
        (EngineSettings(f"transformers:{tmp_path}"), "config.json: cannot be read"),
        (EngineSettings("openai:large", http=http), "A_KEY is not set"),
    ):
        with pytest.raises(ConfigError, match=message):
            edit(str(dataset), path, str(tmp_path / "out"), replace(SMALL, engine=engine), ALONE)
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
    [({"others": "gone"}, "expected one of fixed, free, fixed_first"), ({"when_full": "x"}, "setting edit.when_full is x")],
)  # fmt: skip
def test_settings_that_make_no_sense_are_refused(change: dict[str, Any], message: str) -> None:
    with pytest.raises(ConfigError, match=message):
        replace(SMALL, **change)


# --- resume -------------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("table", [EditWork.TABLES[0], EditWork.TABLES[-1]])
def test_a_shard_that_is_missing_is_made_again(dataset: Path, edits: Path, edited: Path, tmp_path: Path, table: str) -> None:
    out = tmp_path / "out"
    shutil.copytree(edited, out, symlinks=True)
    sorted((out / table).glob("part-*.parquet"))[0].unlink()
    edit(str(dataset), edits, str(out), SMALL, ALONE, report=False)
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
        edit(str(dataset), edits, str(out), SMALL, ALONE)
    monkeypatch.undo()
    assert 0 < len(content(out)) < len(content(edited))
    edit(str(dataset), edits, str(out), SMALL, ALONE, report=False)
    assert content(out) == content(edited)


def command(dataset: Path, edits: Path, out: Path, workers: int) -> list[str]:
    settings = [f"--set={k}={json.dumps(v)}" for k, v in (SMALL.shaping() | {"num_pictures": 0}).items()]
    where = ["--scenes", str(dataset), "--edits", str(edits), "--out", str(out), "--engine", "scripted:not_opened"]
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
    edit(str(dataset), edits, str(out), SMALL, ALONE, report=False)
    assert content(out) == content(edited)


def test_another_configuration_is_refused(dataset: Path, edits: Path, edited: Path, tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match="others: fixed_first -> free"):
        edit(str(dataset), edits, str(edited), replace(SMALL, others="free"), ALONE)
    fewer = file_of(edits.read_text("utf-8").splitlines()[:2], tmp_path / "e.jsonl")
    with pytest.raises(ConfigError, match=r"inputs\.edits: "):
        edit(str(dataset), fewer, str(edited), SMALL, ALONE)


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
    work(SceneShard("0" * 16, found.edits[:1]), isolated=True)
    edit_id = found.edits[0].edit_id
    for table, key in (("scenes", "scene_id"), ("edits", "edit_id")):
        assert rows_of(tmp_path, table, key) == {edit_id: rows_of(edited, table, key)[edit_id]}


# --- the command --------------------------------------------------------------------------------------------------------------


def test_the_command_says_what_it_would_do_and_what_failed(dataset: Path, wanted: list[dict[str, Any]], tmp_path: Path) -> None:
    path = file_of([wanted[-1], "{"], tmp_path / "e.jsonl")
    given = ["edit", "--scenes", str(dataset), "--edits", str(path), "--out", str(tmp_path / "out")]
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


def test_the_command_asks_the_engine_that_is_named(dataset: Path, wanted: list[dict[str, Any]], tmp_path: Path) -> None:
    path = file_of([{"scene_id": wanted[0]["scene_id"], "instruction": "Do it."}], tmp_path / "e.jsonl")
    (tmp_path / "script.json").write_text(json.dumps({"Do it.": wanted[0]["reply"]}), "utf-8")
    given = ["edit", "--scenes", str(dataset), "--edits", str(path), "--out", str(tmp_path / "out"), "--workers", "0"]
    given += ["--set=weights=none", "--set=num_pictures=0", "--set=engine.sampling.temperature=0.2", "--set=reasoner.tries=2"]
    done = CliRunner().invoke(app, [*given, "--engine", f"scripted:{tmp_path / 'script.json'}"])
    assert done.exit_code == 0, done.stderr
    inputs = json.loads((tmp_path / "out" / "manifest.json").read_text("utf-8"))["inputs"]
    assert (inputs["reasoner.engine"], inputs["reasoner.sampling.temperature"], inputs["reasoner.tries"]) == (
        "scripted",
        0.2,
        2,
    )
    refused = CliRunner().invoke(app, [*given, "--engine", "magic"])
    assert refused.exit_code == 2
    assert "engine is 'magic', expected embedded, transformers:FOLDER" in refused.stderr
