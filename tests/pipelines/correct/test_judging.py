"""Jobs with several judges: columns, warnings, the report, conditions that name judges, and the same rows on Ray."""

from dataclasses import replace
from pathlib import Path
from typing import Any

import pyarrow.parquet as pq
import pytest
from typer.testing import CliRunner

from pipelines.correct.job import correct
from pipelines.correct.settings import CorrectSettings
from pipelines.execution.ray_executor import WorkerPool
from pipelines.generate.settings import GenerateSettings
from stable_data.cli import app
from stable_data.errors import ConfigError
from stable_data.judges import registry
from stable_data.storage.run_folder import RunFolder
from tests.pipelines.runs import content

pytestmark = pytest.mark.sim

JUDGED = CorrectSettings(
    weights="none",
    scenes_per_shard=2,
    num_pictures=0,
    position_convention="box_centre",
    judge_raw=False,
    judges="mujoco,sapien",
    robust_rest=1,
)


@pytest.fixture(scope="module")
def judged(clean_run: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    out = tmp_path_factory.mktemp("judged") / "out"
    correct(str(clean_run), str(out), JUDGED, WorkerPool())
    return out


def rows_of(out: Path, table: str) -> list[dict[str, Any]]:
    rows: list[dict[str, Any]] = RunFolder(str(out)).table(table).to_pylist()
    return rows


def test_each_judge_has_its_columns(judged: Path) -> None:
    rows = rows_of(judged, "scenes")
    assert len(rows) == 4
    for row in rows:
        assert row["stable"] is True
        assert row["sapien_stable"] is True
        assert 0 <= row["sapien_move_max_mm"] <= 10
        assert 0 <= row["sapien_turn_max_deg"] <= 5
        assert 0 <= row["stable_share"] <= 1
        assert row["drake_stable"] is row["drake_move_max_mm"] is None
    page = (judged / "report" / "index.html").read_text("utf-8")
    assert "stable in both" in page
    assert "Robust rest" in page


@pytest.mark.slow
@pytest.mark.ray
@pytest.mark.usefixtures("local_ray")
def test_ray_gives_the_same_verdicts_as_this_process(clean_run: Path, judged: Path, tmp_path: Path) -> None:
    correct(str(clean_run), str(tmp_path / "out"), JUDGED, WorkerPool(2))
    assert content(tmp_path / "out") == content(judged)


def test_a_disagreement_is_a_warning_with_each_reason_and_is_in_the_report(
    clean_run: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    ask = registry.judge

    def say(name: str, *about: Any) -> Any:
        found = ask(name, *about)
        return replace(found, stable=False, reason="cup_0 moved 12.0 mm") if name == "sapien" else found

    monkeypatch.setattr(registry, "judge", say)
    correct(str(clean_run), str(tmp_path), replace(JUDGED, robust_rest=0), WorkerPool())
    told = [row for row in rows_of(tmp_path, "warnings") if row["code"] == "judges_disagree"]
    assert len(told) == 4
    assert told[0]["message"].endswith("mujoco: stable; sapien: not stable (cup_0 moved 12.0 mm)")
    assert "Scenes on which judges disagree (4)" in (tmp_path / "report" / "index.html").read_text("utf-8")


def test_an_engine_that_cannot_judge_is_unknown_and_said(
    clean_run: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def fail(*_: object) -> None:
        raise RuntimeError("broken")

    monkeypatch.setattr("stable_data.judges.sapien._new_world", fail)
    correct(str(clean_run), str(tmp_path), replace(JUDGED, robust_rest=0), WorkerPool())
    assert [(row["stable"], row["sapien_stable"]) for row in rows_of(tmp_path, "scenes")] == [(True, None)] * 4
    assert sum(row["code"] == "judge_unknown" for row in rows_of(tmp_path, "warnings")) == 4


def test_without_judges_nothing_is_simulated(clean_run: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(registry, "judge", None)
    correct(str(clean_run), str(tmp_path), replace(JUDGED, judges="", robust_rest=0), WorkerPool())
    assert {row["stable"] for row in rows_of(tmp_path, "scenes")} == {None}


@pytest.mark.parametrize(
    ("changed", "says"),
    [
        (
            {"accept": "stable and sapien_stable"},
            "nothing fills the column sapien_stable: judges is 'mujoco'; add sapien to it",
        ),
        ({"judges": "sapien"}, "nothing fills the column stable: judges is 'sapien'; add mujoco"),
        ({"accept": "stable_share >= 0.9"}, "robust_rest is 0; set it to 8"),
        ({"judges": "mujoco,bullet"}, "'bullet', expected some of mujoco, sapien, drake"),
        ({"arbiter": "sapien"}, "one further judge beside at least two"),
    ],
)
def test_a_condition_on_a_judge_that_does_not_run_is_refused_at_the_start(changed: dict[str, str], says: str) -> None:
    with pytest.raises(ConfigError, match=says):
        GenerateSettings(**changed)  # type: ignore[arg-type]
    both = GenerateSettings(judges="mujoco,sapien", accept="clean and stable and sapien_stable")
    assert both.judge_names == ("mujoco", "sapien")


def test_a_stored_run_is_judged_by_a_command(clean_run: Path, tmp_path: Path) -> None:
    table = tmp_path / "verdicts.parquet"
    done = CliRunner().invoke(app, ["judge", str(clean_run), "--limit", "2", "--out", str(table)])
    assert done.exit_code == 0, done.output
    assert "mujoco, sapien: stable, stable: 2 scenes" in done.output
    rows = pq.read_table(table).to_pylist()
    assert [(row["stable"], row["sapien_stable"], row["sapien_reason"]) for row in rows] == [(True, True, "")] * 2


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (["--judges", ""], "names no judge"),
        (["--where", "num_objects > 1000"], "no scene is selected"),
        (["--limit", "0"], "no scene is selected"),
    ],
)
def test_judging_nothing_is_refused(options: list[str], message: str, clean_run: Path) -> None:
    done = CliRunner().invoke(app, ["judge", str(clean_run), *options])
    assert done.exit_code == 2
    assert message in done.stderr
