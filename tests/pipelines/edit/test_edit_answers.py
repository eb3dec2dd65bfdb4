"""Edits whose answers come from a reasoner: it is asked again, nothing is lost, the same requests however edits are cut."""

import json
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
from typer.testing import CliRunner

import models.semantic_reasoner.factory as assembly
from models.semantic_reasoner.editing import edit_prompt_of
from models.semantic_reasoner.engines.protocol import Completion, Request
from models.semantic_reasoner.engines.registry import EMBEDDED, EngineSettings
from models.semantic_reasoner.factory import ReasonerSettings
from models.semantic_reasoner.reasoner import SemanticReasoner
from models.semantic_reasoner.replies.grammar import ReplyGrammar
from models.semantic_reasoner.text.reply_json import render_objects
from pipelines.__main__ import app
from pipelines.edit.job import edit
from pipelines.edit.settings import EditSettings
from pipelines.edit.shard import seed_of
from pipelines.sources.edits import EditRequest, read_edits
from stable_data.errors import ConfigError
from stable_data.mesatask import MesaTaskDataset
from stable_data.storage.run_folder import RunFolder
from tests.models.semantic_reasoner.engines.endpoint import Act, endpoint, said
from tests.models.semantic_reasoner.language.known_categories import ask
from tests.pipelines.edit.edit_runs import ALONE, EMPTY, SMALL, file_of, rows_of


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
    assert all(isinstance(request.form, ReplyGrammar) and request.form.edits for request in engine.asked)
    assert "reply is not JSON" in engine.asked[4].messages[-1]["content"]
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
        "line 000005": ("edits", "instruction_invalid"),
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
    with pytest.raises(ConfigError, match=r"^5: nobody answers; finished shards are kept, run again to continue$") as caught:
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
    thing = edit_prompt_of(MesaTaskDataset(dataset).read(scene_id)[0]).layout[-1]
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
    one = EditRequest("a_edit1", "a", "Move it.")
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


def first_seed(wanted: EditRequest) -> int:
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


def test_the_command_asks_the_engine_that_is_named(dataset: Path, wanted: list[dict[str, Any]], tmp_path: Path) -> None:
    path = file_of([{"scene_id": wanted[0]["scene_id"], "instruction": "Do it."}], tmp_path / "e.jsonl")
    (tmp_path / "script.json").write_text(json.dumps({"Do it.": wanted[0]["reply"]}), "utf-8")
    given = [
        "edit",
        "--assets",
        "none",
        "--scenes",
        str(dataset),
        "--edits",
        str(path),
        "--out",
        str(tmp_path / "out"),
        "--workers",
        "0",
    ]
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
