"""``stable-data synth``: what it makes, in this process and on Ray, and what it says of bad input."""

import json
from pathlib import Path

import pytest
from typer.testing import CliRunner

from pipelines.__main__ import app as jobs
from stable_data.cli import app
from stable_data.commands.command_line import NOT_STARTED
from stable_data.mesatask import MesaTaskDataset

pytestmark = pytest.mark.sim

QUICK = ("--no-pictures", "--table", "nightstand", "--table", "coffee_table", "--seed", "4")


def told(*arguments: str) -> tuple[int, str]:
    result = CliRunner().invoke(app, ["synth", *arguments])
    return result.exit_code, result.output


def test_it_makes_scenes_on_the_tables_that_are_asked_for(tmp_path: Path) -> None:
    status, output = told(str(tmp_path / "out"), "--scenes", "2", "--edits", *QUICK)
    assert status == 0
    assert "2 of 2 scenes made, 0 failed" in output
    assert MesaTaskDataset(tmp_path / "out").scene_ids == ("coffee_table_00001", "nightstand_00000")
    manifest = json.loads((tmp_path / "out/synth.json").read_text())
    assert manifest["tables"] == ["nightstand", "coffee_table"]
    assert (tmp_path / "out/edits.jsonl").is_file()


def test_card_shows_a_sheet_of_pictures_where_there_are_any(tmp_path: Path) -> None:
    status, _ = told(str(tmp_path / "out"), "--scenes", "1", "--table", "nightstand")
    assert status == 0
    if not list((tmp_path / "out").glob("Layout_info/*/*/front.png")):
        pytest.skip("this machine draws nothing")
    assert "![scenes of the set](sheet.png)" in (tmp_path / "out/README.md").read_text()
    assert (tmp_path / "out/sheet.png").stat().st_size > 1000


@pytest.mark.slow
@pytest.mark.ray
def test_workers_make_the_same(tmp_path: Path) -> None:
    assert told(str(tmp_path / "one"), "--scenes", "2", *QUICK)[0] == 0
    assert told(str(tmp_path / "two"), "--scenes", "2", "--workers", "1", *QUICK)[0] == 0
    kept = [
        {p.relative_to(root): p.read_bytes() for p in root.rglob("*.json")} for root in (tmp_path / "one", tmp_path / "two")
    ]
    assert kept[0] == kept[1]


@pytest.mark.parametrize(
    ("arguments", "reason"),
    [
        (("--scenes", "0"), "number of scenes is 0, expected at least 1"),
        (("--table", "bar"), "table is 'bar', expected one of"),
        (("--seed", "-1"), "seed is -1, expected at least 0"),
    ],
)
def test_bad_input_is_one_line(arguments: tuple[str, ...], reason: str, tmp_path: Path) -> None:
    status, output = told(str(tmp_path / "out"), *arguments)
    assert status == NOT_STARTED
    assert reason in output
    assert not (tmp_path / "out").exists()


def test_no_process_and_a_cluster_do_not_go_together(tmp_path: Path) -> None:
    result = CliRunner().invoke(jobs, ["synth", str(tmp_path / "out"), "--workers", "0", "--address", "auto"])
    assert result.exit_code == NOT_STARTED
    assert "leave out one of them" in result.output
