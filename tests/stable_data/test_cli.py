"""The command line: every end that was not meant is one line and status 2."""

import re
import shutil
import subprocess
import sys
from pathlib import Path

import pytest
import typer
from typer.testing import CliRunner, Result

import stable_data.mesatask.lint
from stable_data.cli import app
from stable_data.commands.command_line import DEBUG, INTERRUPTED, NOT_STARTED, with_clear_errors
from stable_data.extras import EXTRA_OF_MODULE
from stable_data.mesatask.lint import LintResult
from stable_data.storage.run_folder import RunFolder

ROOT = Path(__file__).parents[2]


def run(*arguments: object) -> Result:
    return CliRunner().invoke(app, [str(a) for a in arguments])


def nothing_found(root: Path, *, progress: bool) -> LintResult:
    return LintResult(root, (), (), ())


def test_an_error_that_nobody_foresaw_is_one_line_and_status_2(monkeypatch: pytest.MonkeyPatch) -> None:
    @with_clear_errors
    def fail() -> None:
        raise IndexError("list index\nout of range")

    monkeypatch.delenv(DEBUG, raising=False)
    with pytest.raises(typer.Exit) as caught:
        fail()
    assert caught.value.exit_code == NOT_STARTED
    monkeypatch.setenv(DEBUG, "1")
    with pytest.raises(IndexError):
        fail()


def test_the_line_says_what_and_how_to_see_more(monkeypatch: pytest.MonkeyPatch) -> None:
    def fail(root: Path, *, progress: bool) -> LintResult:
        raise IndexError("list index\nout of range")

    monkeypatch.delenv(DEBUG, raising=False)
    monkeypatch.setattr(stable_data.mesatask.lint, "lint_folder", fail)
    result = run("lint", "anywhere")
    assert (result.exit_code, result.stdout) == (NOT_STARTED, "")
    assert result.stderr == f"error: unexpected IndexError: list index; please report it with what {DEBUG}=1 shows\n"


@pytest.mark.parametrize("end", [typer.Exit(1), typer.Abort(), BrokenPipeError()])
def test_an_end_that_was_meant_stays(end: BaseException) -> None:
    @with_clear_errors
    def stop() -> None:
        raise end

    with pytest.raises(type(end)) as caught:
        stop()
    assert caught.value is end


def test_ctrl_c_is_one_line(monkeypatch: pytest.MonkeyPatch) -> None:
    def stop(root: Path, *, progress: bool) -> LintResult:
        raise KeyboardInterrupt

    monkeypatch.setattr(stable_data.mesatask.lint, "lint_folder", stop)
    result = run("lint", "anywhere")
    assert (result.exit_code, result.stderr) == (INTERRUPTED, "interrupted; finished files stay\n")


@pytest.mark.parametrize("arguments", [["lint", "anywhere"], ["synth", "somewhere"]])
def test_without_the_extras_a_command_says_what_to_install(arguments: list[str], tmp_path: Path) -> None:
    code = (
        f"import sys; sys.modules.update(dict.fromkeys({list(EXTRA_OF_MODULE)})); "
        f"from stable_data.cli import app; app({arguments})"
    )
    done = subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, cwd=tmp_path, env={"PYTHONPATH": str(ROOT)}
    )
    assert done.returncode == NOT_STARTED
    assert re.fullmatch(
        r"error: this command needs \w+, which is not installed: pip install 'stable-data\[geometry,sim\]'\n", done.stderr
    )


def test_a_place_that_cannot_be_written_is_refused_before_the_audit(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    audited: list[Path] = []
    monkeypatch.setattr(stable_data.mesatask.lint, "lint_folder", lambda root, progress: audited.append(root))
    (tmp_path / "file").touch()
    for table in (tmp_path / "file" / "lint.parquet", tmp_path):
        result = run("lint", "anywhere", "--table", table)
        assert result.exit_code == NOT_STARTED
        assert f"{table}: cannot be written" in result.stderr
    assert not audited


def test_a_table_that_cannot_be_written_leaves_the_page(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def fill_the_place(root: Path, *, progress: bool) -> LintResult:
        table.mkdir()
        return nothing_found(root, progress=progress)

    table = tmp_path / "out" / "lint.parquet"
    monkeypatch.setattr(stable_data.mesatask.lint, "lint_folder", fill_the_place)
    result = run("lint", "anywhere", "--table", table)
    assert result.exit_code == NOT_STARTED
    assert "anywhere: 0 scenes" in result.stdout
    assert "cannot be written" in result.stderr


def test_inspect_counts_rows_and_names_a_shard_that_broke(tmp_path: Path) -> None:
    folder = RunFolder(str(tmp_path))
    folder.write_bytes("manifest.json", b"{}")
    for shard_id in ("00", "01"):
        folder.write_shard("warnings", shard_id, [{"id": "a", "step": "read", "code": "odd", "message": "a: odd"}])
    result = run("inspect", tmp_path)
    assert result.exit_code == 0
    assert "warnings          2 rows in 2 files" in result.stdout
    path = Path(folder.files("warnings")[1])
    path.write_bytes(path.read_bytes()[:-40])
    result = run("inspect", tmp_path)
    assert result.exit_code == NOT_STARTED
    assert f"{path} cannot be read" in result.stderr
    assert result.stderr.count("\n") == 1


def test_runs_are_joined_pruned_and_upgraded_on_the_command_line(tmp_path: Path) -> None:
    stored = Path(__file__).parents[1] / "data"
    made = Path(shutil.copytree(stored / "run_v3" / "generate", tmp_path / "made"))
    result = run("join", made, stored / "run_v3" / "preprocess", "--to", tmp_path / "joined")
    assert result.exit_code == 0
    count = RunFolder(tmp_path / "joined").num_rows("scenes")
    assert f"{count} scenes, " in result.stdout
    assert run("join", made, made, "--to", tmp_path / "twice").stdout.endswith(" scenes were in several runs\n")
    assert "which is one of the runs or within one" in run("join", made, "--to", Path(made) / "scenes" / "x").stderr
    refused = run("join", made, "--to", made)
    assert refused.exit_code == 2
    assert "is one of the runs" in refused.stderr
    assert "deleted 0 rows of assets" in run("prune", made).stdout
    old = shutil.copytree(stored / "run_v1", tmp_path / "old")
    assert "files were of an older version" in run("upgrade", old).stdout
    assert "is up to date" in run("upgrade", old).stdout
    assert run("upgrade", tmp_path / "none").exit_code == 2
