"""A Lance dataset has the rows, the columns and their meanings of the table; it is opened by Lance itself."""

from pathlib import Path

import pytest
from typer.testing import CliRunner

from stable_data.cli import app
from stable_data.export.lance_table import write_lance
from stable_data.storage.run_folder import RunFolder
from stable_data.storage.schemas import SCHEMAS
from tests.stable_data.storage.small_run import IDS, write_run

lance = pytest.importorskip("lance", reason="the extra lance is not installed")


@pytest.fixture
def run(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> RunFolder:
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    return RunFolder(write_run(tmp_path / "run"))


def test_rows_and_metadata_are_those_of_the_table(run: RunFolder, tmp_path: Path) -> None:
    assert write_lance(run, tmp_path / "out") == len(IDS)
    dataset, table = lance.dataset(str(tmp_path / "out" / "scenes.lance")), run.table("scenes")
    assert dataset.schema.equals(SCHEMAS["scenes"], check_metadata=True)
    assert dataset.to_table().equals(table)
    assert dataset.take([30, 2, 9]).equals(table.take([30, 2, 9]))
    where = "num_objects = 2 and split = 'train'"
    assert dataset.count_rows(where) == sum(row["num_objects"] == 2 and row["split"] == "train" for row in table.to_pylist())


def test_selections_are_those_of_other_exports(run: RunFolder, tmp_path: Path) -> None:
    def names(folder: str) -> list[str]:
        return list(lance.dataset(str(tmp_path / folder / "scenes.lance")).to_table(["scene_id"])["scene_id"].to_pylist())

    where = "split == 'train'"
    chosen = run.table("scenes", where=None).to_pylist()
    train = [row["scene_id"] for row in chosen if row["split"] == "train"]
    assert write_lance(run, tmp_path / "some", where) == len(train)
    assert names("some") == train
    write_lance(run, tmp_path / "first", where, limit=5)
    assert names("first") == train[:5]
    write_lance(run, tmp_path / "named", None, (IDS[9], IDS[3]))
    assert names("named") == [IDS[3], IDS[9]]


def test_the_command_writes_and_refuses(run: RunFolder, tmp_path: Path) -> None:
    out = tmp_path / "out"
    done = CliRunner().invoke(app, ["export", run.root, str(out), "--format", "lance", "--limit", "3"])
    assert done.exit_code == 0, done.stderr
    assert "3 scenes in scenes.lance" in done.stdout
    same = CliRunner().invoke(
        app, ["query", run.root, "num_objects >= 0", "--to", str(tmp_path / "query"), "--format", "lance"]
    )
    assert same.exit_code == 0, same.stderr
    for arguments, said in (
        ([str(out)], "exists already"),
        ([str(tmp_path / "x"), "--settled"], "leave out --settled"),
        ([str(tmp_path / "x"), "--scene", "none"], r"has no scenes ['none']"),
        ([str(tmp_path / "x"), "--where", "num_objects > 99"], "no scene is selected"),
        ([str(tmp_path / "x"), "--where", "num_objects >"], "cannot be read"),
    ):
        refused = CliRunner().invoke(app, ["export", run.root, *arguments, "--format", "lance"])
        assert refused.exit_code == 2
        assert said in refused.stderr
        assert not (tmp_path / "x").exists()
