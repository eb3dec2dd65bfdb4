"""The benchmark of taste: the command on two runs."""

import json
from pathlib import Path

import pytest
import typer
from PIL import Image
from typer.testing import CliRunner

from benchmarks.taste import main
from stable_data.scene import Scene
from stable_data.scores.taste import POOLED
from stable_data.storage.run_folder import RunFolder
from stable_data.storage.table_rows import scene_row
from tests.stable_data.scores.taste_scenes import scenes

STORED = Path(__file__).parents[1] / "data" / "run_v3"


def command(*arguments: object) -> tuple[int, str]:
    app = typer.Typer()
    app.command()(main)
    done = CliRunner().invoke(app, [str(a) for a in arguments], env={"COLUMNS": "300"})
    return done.exit_code, done.output


def run_with(folder: Path, splits: dict[str, list[Scene]]) -> Path:
    """A run whose rows are those of a stored one, with other scenes."""
    row = RunFolder(STORED / "preprocess").table("scenes").to_pylist()[0]
    rows = [row | scene_row(s) | {"split": split} for split, found in splits.items() for s in found]
    RunFolder(folder).write_shard("scenes", "0", rows)
    return folder


def test_the_command_compares_two_runs(tmp_path: Path) -> None:
    data = scenes(30)
    held_out = run_with(tmp_path / "held_out", {"train": data[:10], "test": data[10:25], "validation": data[25:]})
    generated = run_with(tmp_path / "generated", {"test": data[10:25], "unseen": data[25:]})
    status, output = command(generated, held_out, "--json", tmp_path / "out.json")
    assert status == 0, output
    assert "20 generated scenes, 20 held-out ones (test,validation), 10 of training" in output
    document = json.loads((tmp_path / "out.json").read_text("utf-8"))
    assert document["scenes"] == {"generated": 20, "held_out": 20, "training": 10}
    assert {c["distance"] for c in document["tables"][POOLED].values()} == {0}
    status, output = command(held_out, held_out, "--split", "test", "--generated-split", "train")
    assert status == 0
    assert "10 generated scenes, 15 held-out ones (test)" in output
    assert command(held_out, held_out, "--split", "tset")[0] == 2
    assert "no scenes of the splits unseen" in command(held_out, held_out, "--split", "unseen")[1]


def test_two_scenes_are_unknown_and_are_drawn(tmp_path: Path) -> None:
    sheet = tmp_path / "sheet.png"
    status, output = command(STORED / "generate", STORED / "preprocess", "--split", "train", "--sheet", sheet)
    line = next(line for line in output.splitlines() if line.startswith("objects"))
    assert line.split()[3:] == ["unknown"] * 3
    if not sheet.exists():
        pytest.skip(output.splitlines()[-1])  # this machine cannot render
    assert status == 0
    with Image.open(sheet) as picture:
        assert picture.width > 6 * 384
        assert picture.height > 2 * 320
