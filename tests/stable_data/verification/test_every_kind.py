"""A run of every job is found whole, with all verdicts computed again."""

import json
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from typer.testing import CliRunner

from pipelines.correct.job import correct
from pipelines.correct.settings import CorrectSettings
from pipelines.demonstrate.job import demonstrate
from pipelines.demonstrate.settings import DemonstrateSettings
from pipelines.edit.job import edit
from pipelines.edit.settings import EditSettings
from pipelines.evaluate_policy.job import evaluate_policy
from pipelines.evaluate_policy.settings import EvaluatePolicySettings
from pipelines.execution.ray_executor import WorkerPool
from pipelines.rate.job import rate
from pipelines.rate.settings import RateSettings
from pipelines.reach.job import reach
from pipelines.reach.settings import ReachSettings
from pipelines.views.job import draw_views
from pipelines.views.settings import ViewsSettings
from stable_data.cli import app
from stable_data.commands.command_line import DONE
from stable_data.simulation.offscreen import can_render
from stable_data.storage.run_folder import RunFolder
from stable_data.storage.subset import select
from stable_data.verification.verifier import VerifyOptions, verify_run
from tests.stable_data.verification.damages import doubled, without_first
from tests.stable_data.verification.editing import Damage, files_of, flip, hide, recount, rows

HERE = WorkerPool()
Job = Callable[[Path, Path], Any]


def corrected(run: Path, out: Path) -> None:
    correct(str(run), str(out), CorrectSettings(weights="none", scenes_per_shard=2, num_pictures=0, judges="mujoco"), HERE)


def edited(run: Path, out: Path) -> None:
    """One edit that removes an object, one that asks for nothing, and one of a scene that is not there."""
    lines = [
        {"scene_id": "task_0", "instruction": "Take one away.", "reply": json.dumps({"remove": [_first(run)], "objects": []})},
        {"scene_id": "task_2", "instruction": "Leave it.", "reply": '{"remove":[],"objects":[]}'},
        {"scene_id": "task_9", "instruction": "Leave it.", "reply": '{"remove":[],"objects":[]}'},
    ]
    file = out.with_suffix(".jsonl")
    file.write_text("".join(f"{json.dumps(line)}\n" for line in lines))
    edit(str(run), file, str(out), EditSettings(weights="none", scenes_per_shard=2, num_pictures=0), HERE)


def _first(run: Path) -> str:
    rows = RunFolder(str(run)).table("scenes").to_pylist()
    return str(next(row for row in rows if row["scene_id"] == "task_0")["objects"][-1]["instance"])


def demonstrated(run: Path, out: Path) -> None:
    demonstrate(str(run), str(out), DemonstrateSettings(robot="simple", task="pick", max_steps=200), HERE)


def evaluated(run: Path, out: Path) -> None:
    settings = EvaluatePolicySettings(robot="simple", task="pick", max_steps=200)
    evaluate_policy("expert", str(run), str(out), settings, HERE)


JOBS: dict[str, Job] = {
    "correct": corrected,
    "edit": edited,
    "rate": lambda run, out: rate(str(run), str(out), RateSettings(scenes_per_shard=2), HERE),
    "reach": lambda run, out: reach(str(run), str(out), ReachSettings("simple", grasp_tries=1, scenes_per_shard=2), HERE),
    "demonstrate": demonstrated,
    "evaluate-policy": evaluated,
    "views": lambda run, out: draw_views(
        str(run), str(out), ViewsSettings(width=64, height=48, features="gradients", scenes_per_shard=2), HERE
    ),
    "query": lambda run, out: select(RunFolder(str(run)), "num_objects >= 1", RunFolder(str(out))),
}


NOT_FOUND = {
    ("edit", "corrections", "a lost row"),
    ("query", "settled", "a lost row"),
    ("reach", "settled", "a lost row"),
    ("reach", "settled", "a lost file"),
}
"""What docs/publish.md names as not computed again: whether rows are there that nothing else mentions."""


def run_of(job: str, generated: Path, out: Path) -> Path:
    """Runs a job on generated scenes, if this machine can."""
    if job == "views" and not can_render():
        pytest.skip("this machine cannot render")
    JOBS[job](generated, out)
    return out


@pytest.mark.sim
@pytest.mark.parametrize("job", JOBS)
def test_a_run_of_each_job_is_whole(job: str, generated: Path, tmp_path: Path) -> None:
    out = run_of(job, generated, tmp_path / "out")
    told = list[str]()
    options = VerifyOptions(sample=0, source=RunFolder(str(generated)))
    result = verify_run(RunFolder(str(out)), lambda finding: told.append(str(finding)), options)
    assert (result.is_whole, told, result.job) == (True, [], job), str(result)
    assert result.num_checked == result.num_files > 0
    assert sum(result.rows.values()) > 0
    if result.rows.get("scenes"):
        assert result.num_audited == result.rows["scenes"]


def removed(table: str) -> Damage:
    """Deletes the first file of a table; counts, checksums and digest fit."""

    def damage(run: Path) -> None:
        files_of(run, table)[0].unlink()
        recount(run)
        hide(run)

    return damage


@pytest.mark.sim
@pytest.mark.slow
@pytest.mark.parametrize("job", JOBS)
def test_damage_of_each_table_of_each_job_is_found(job: str, generated: Path, tmp_path: Path) -> None:
    out = run_of(job, generated, tmp_path / "out")
    folder, source = RunFolder(str(out)), RunFolder(str(generated))
    not_found = set()
    tables = [table for table in folder.tables() if folder.num_rows(table)]
    for table in tables:
        damages = {
            "a flipped bit": flip(table, 0.5),
            "a lost row": rows(table, without_first, recounts=True),
            "a doubled row": rows(table, doubled, recounts=True),
            "a lost file": removed(table),
        }
        for name, damage in damages.items():
            copy = Path(shutil.copytree(out, tmp_path / "copy"))
            damage(copy)
            if verify_run(RunFolder(str(copy)), lambda _: None, VerifyOptions(verdicts="none", source=source)).is_whole:
                not_found.add((job, table, name))
            shutil.rmtree(copy)
    assert tables
    assert not_found == {found for found in NOT_FOUND if found[0] == job}


@pytest.mark.sim
def test_drafted_edits_belong_to_their_run(clean_run: Path, tmp_path: Path) -> None:
    copy, apart = Path(shutil.copytree(clean_run, tmp_path / "run")), tmp_path / "edits"
    for places in ([str(copy)], [str(copy), str(apart)]):
        assert CliRunner().invoke(app, ["draft-edits", *places, "--per-scene", "1"]).exit_code == DONE
    for run in (copy, apart):
        done = CliRunner().invoke(app, ["verify", str(run), "--verdicts", "none", "--source", str(clean_run)])
        assert done.exit_code == DONE, done.stdout
        assert "edits" in {path.parent.name for path in run.glob("*/part-*")}
