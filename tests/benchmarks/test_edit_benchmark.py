"""The benchmark of edits in free words: what it calls right, and that it runs the edit job."""

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
import typer
from typer.testing import CliRunner

from benchmarks.edit_verdict import faults_of_edit, read_expected_edits
from benchmarks.edits import main
from models.semantic_reasoner.editing import edit_prompt_of
from stable_data.errors import ConfigError
from stable_data.mesatask import MesaTaskDataset
from stable_data.scene import Relation, RelationKind, Scene, SceneObject, Tabletop

DATA = Path(__file__).parents[1] / "data"
SCENE = "coffee_table_0609"


def thing(name: str, x: float, y: float = 0.3, description: str = "a red thing") -> SceneObject:
    return SceneObject(name, name.rpartition("_")[0], (x, y, 0.05), 0.0, (0.1, 0.1, 0.1), description=description)


BEFORE = Scene("one", Tabletop("office_table", (1.2, 0.6)), (thing("mug_0", 0.2), thing("book_0", 0.6), thing("lamp_0", 1.0)))


def after(*objects: SceneObject, **more: Any) -> Scene:
    return replace(BEFORE, objects=objects, **more)


def moved(o: SceneObject, x: float, yaw: float = 0.0) -> SceneObject:
    return replace(o, position=(o.position[0] + x, *o.position[1:]), yaw=yaw)


MUG, BOOK, LAMP = BEFORE.objects
JAR = {"instance": "mug_0", "name": "it", "categories": ["jar"]}


@pytest.mark.parametrize(
    ("expected", "scene", "fault"),
    [
        ({"removed": ["mug_0"]}, after(BOOK, LAMP), ""),
        ({"removed": ["mug_0"]}, BEFORE, "mug_0 is still there"),
        ({"removed": ["mug_0"]}, after(LAMP), "book_0 is gone"),
        ({"moved": ["mug_0"]}, after(moved(MUG, 0.02), BOOK, LAMP), ""),
        ({"moved": ["mug_0"]}, after(moved(MUG, 0.0, 0.1), BOOK, LAMP), ""),
        ({"moved": ["mug_0"]}, after(moved(MUG, 0.009), BOOK, LAMP), "mug_0 has not moved"),
        ({"moved": ["mug_0"]}, after(moved(MUG, 0.02), moved(BOOK, 0.02), LAMP), "book_0 has moved by 2.0 cm"),
        ({"moved": ["mug_0"], "may_change": ["book_0"]}, after(moved(MUG, 0.02), moved(BOOK, 0.2), LAMP), ""),
        ({"may_change": ["mug_0"]}, after(BOOK, LAMP), ""),
        ({"added": [{"name": "new", "categories": ["vase"]}]}, after(*BEFORE.objects, thing("vase_0", 0.4)), ""),
        ({"added": [{"name": "new", "categories": ["vase"]}]}, after(*BEFORE.objects, thing("jar_0", 0.4)), "no new object is new"),
        ({}, after(*BEFORE.objects, thing("jar_0", 0.4)), "jar_0 is new"),
        ({"replaced": [JAR]}, after(thing("jar_0", 0.24), BOOK, LAMP), ""),
        ({"replaced": [JAR]}, after(thing("jar_0", 0.4), BOOK, LAMP), "no new object is it"),
        ({"replaced": [JAR]}, after(MUG, thing("jar_0", 0.2), BOOK, LAMP), "mug_0 is still there"),
        ({"restyled": [{"instance": "mug_0", "words": "blue"}]}, after(replace(MUG, description="a Blue, round mug"), BOOK, LAMP), ""),
        ({"restyled": [{"instance": "mug_0", "words": "blue"}]}, BEFORE, "lacks blue"),
        ({}, after(replace(MUG, description="a blue mug"), BOOK, LAMP), "mug_0 is now 'a blue mug'"),
        ({"relations": [["mug_0", "left of", "book_0"]]}, BEFORE, ""),
        ({"relations": [["mug_0", "right of", "book_0"]]}, BEFORE, "does not hold"),
        ({"broken": [["mug_0", "left of", "book_0"]]}, BEFORE, "still holds"),
        ({"broken": [["mug_0", "left of", "book_0"]], "removed": ["book_0"]}, after(MUG, LAMP), ""),
        ({"relations": [["mug_0", "on", "book_0"]]}, replace(BEFORE, relations=(Relation("mug_0", RelationKind.ON, "book_0"),)), ""),
        ({"relations": [["mug_0", "is at", "middle_left"]]}, BEFORE, ""),
        (
            {"added": [{"name": "new", "categories": ["vase"]}], "relations": [["new", "left of", "mug_0"]]},
            after(*BEFORE.objects, thing("vase_0", 0.4)),
            "vase_0 left of mug_0 does not hold",
        ),
    ],
)  # fmt: skip
def test_an_edited_scene_is_judged_by_what_is_expected(expected: dict[str, Any], scene: Scene, fault: str) -> None:
    faults = faults_of_edit(BEFORE, scene, expected)
    assert fault in faults[0] if fault else faults == []


@pytest.mark.parametrize(
    "expected", [{"removed": ["a_0"], "kept": ["a_0"]}, {"relations": [["a_0", "over", "b_0"]]}, {"gone": ["a_0"]}, None]
)
def test_a_line_that_says_no_expectation_is_refused(tmp_path: Path, expected: Any) -> None:
    line = {"edit_id": "e", "scene_id": "s", "kind": "remove", "instruction": "x", "expected": expected}
    (tmp_path / "edits.jsonl").write_text(json.dumps(line), "utf-8")
    with pytest.raises(ConfigError, match="line 1"):
        read_expected_edits(tmp_path / "edits.jsonl")


@pytest.mark.slow
def test_edits_of_a_folder_are_applied_and_judged(tmp_path: Path) -> None:
    scene = MesaTaskDataset(DATA).read(SCENE)[0]
    gone = "3_mug_0"
    named = edit_prompt_of(scene).names[gone]  # the only mug
    replies = {"away": {"remove": [named], "objects": []}, "nothing": {"remove": [], "objects": []}, "which": "no answer"}
    (tmp_path / "replies.json").write_text(json.dumps(replies), "utf-8")
    common = {"scene_id": SCENE, "kind": "remove"}
    lines = [
        {**common, "edit_id": "a", "instruction": "take it away", "expected": {"removed": [gone]}},
        {**common, "edit_id": "b", "instruction": "do nothing", "expected": {"removed": [gone]}},
        {**common, "edit_id": "c", "instruction": "which one", "expected": {"ambiguous": [gone]}},
    ]
    (tmp_path / "edits.jsonl").write_text("".join(json.dumps(line) + "\n" for line in lines), "utf-8")
    app = typer.Typer()
    app.command()(main)
    command = ["--file", str(tmp_path / "edits.jsonl"), "--scenes", str(DATA), "--json", str(tmp_path / "out.json")]
    others: dict[str, Any] = {"file": "edits.jsonl", "engines": {"planned": {"summary": {}}}}
    (tmp_path / "out.json").write_text(json.dumps(others), "utf-8")
    done = CliRunner().invoke(app, [*command, "--engine", f"scripted:{tmp_path / 'replies.json'}", "--name", "replies"])
    assert done.exit_code == 0, done.output
    document = json.loads((tmp_path / "out.json").read_text("utf-8"))
    assert document["engines"].pop("planned") == others["engines"]["planned"]
    document = document["engines"].pop("replies")
    rows = {row["edit_id"]: row for row in document["edits"]}
    assert "others_moved" not in str(rows["a"])
    assert {name: row["right"] for name, row in rows.items()} == {"a": True, "b": False, "c": False}, rows
    assert document["summary"] | {"seconds": 0} == {
        "right": 1,
        "edits": 3,
        "seconds": 0,
        "right_by_kind": {"remove": 1},
        "edits_by_kind": {"remove": 3},
    }
    assert CliRunner().invoke(app, command[:2]).exit_code == 2
    (tmp_path / "out.json").write_text("[]", "utf-8")
    refused = CliRunner().invoke(app, command)
    assert refused.exit_code == 2
    assert "other content" in " ".join(refused.output.replace("│", " ").split())
