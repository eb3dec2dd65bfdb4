"""The reach job, and the columns of a robot in the jobs that make scenes."""

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
from typer.testing import CliRunner

from models.semantic_reasoner.engines.registry import EngineSettings
from models.semantic_reasoner.staged_layout import LayoutTask
from pipelines.__main__ import app
from pipelines.correct.job import correct
from pipelines.correct.settings import CorrectSettings
from pipelines.execution.ray_executor import WorkerPool
from pipelines.generate.job import generate
from pipelines.generate.settings import GenerateSettings
from pipelines.reach.job import ReachJob, reach
from pipelines.reach.settings import ReachSettings
from pipelines.sources.assets import AssetLibraries
from pipelines.sources.generation_tasks import TaskSource
from stable_data.cli import app as stable_data
from stable_data.errors import ConfigError
from stable_data.metrics.reach_columns import REACH_COLUMNS
from stable_data.robot.arm.robots import Robot
from stable_data.scene import Scene, Tabletop, TaskInfo
from stable_data.storage.run_folder import RunFolder
from tests.pipelines.scripts import one_thing_a_stage
from tests.stable_data.export.runs import thing, write_run
from tests.stable_data.robot.tables import BOX, CAN, laid_table

pytestmark = pytest.mark.sim

QUICK = ReachSettings("simple", "front", grasp_tries=1, scenes_per_shard=2)


def rows_of(run: Path, table: str) -> list[dict[str, Any]]:
    rows: list[dict[str, Any]] = RunFolder(str(run)).table(table).to_pylist()
    return sorted(rows, key=lambda row: str(row.get("scene_id", "")))


@pytest.fixture(scope="module")
def tables(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Three scenes: a task that a robot can carry out, one that it cannot, and one whose goal is unknown."""
    laid = laid_table()
    wide = TaskInfo("", "Lift the box.", action_sequence=("Pick(Cereal box)",), task_objects=(BOX,))
    odd = Scene("odd", Tabletop("desk", (0.8, 0.6)), (thing("can/0", CAN, 0.4, 0.3, 0.0),))
    scenes = (laid, replace(laid, scene_id="wide", task=wide), odd)
    return Path(write_run(tmp_path_factory.mktemp("tables") / "run", scenes).root)


@pytest.fixture(scope="module")
def surveyed(tables: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    out = tmp_path_factory.mktemp("surveyed") / "out"
    reach(str(tables), str(out), QUICK, WorkerPool())
    return out


def test_every_scene_keeps_its_row_and_gets_its_verdict(tables: Path, surveyed: Path) -> None:
    rows = rows_of(surveyed, "scenes")
    assert [(row["scene_id"], row["task_reachable"], row["task_graspable"], row["task_kind"]) for row in rows] == [
        ("laid", True, True, "pick"),
        ("odd", None, None, None),
        ("wide", False, False, "pick"),
    ]
    assert [row["task_reason"] for row in rows] == [None, rows[1]["task_reason"], f"too_wide: {BOX}"]
    assert rows[1]["task_reason"].startswith("no_task: ")
    assert {row["robot_mount"] for row in rows} == {"front:0.5"}
    before = [{k: v for k, v in row.items() if k not in REACH_COLUMNS} for row in rows_of(tables, "scenes")]
    assert [{k: v for k, v in row.items() if k not in REACH_COLUMNS} for row in rows] == before
    (grasp,) = rows_of(surveyed, "grasps")
    assert (grasp["scene_id"], grasp["instance"], grasp["outcome"]) == ("laid", CAN, "held")
    assert not rows_of(surveyed, "failures")
    counts = json.loads((surveyed / "manifest.json").read_text())["counts"]
    assert (counts["scenes"], counts["task_reachable"], counts["task_graspable"], counts["grasps"]) == (3, 1, 1, 1)
    page = (surveyed / "report" / "index.html").read_text("utf-8")
    assert "too_wide" in page
    assert "1 of 3, 1 unknown" in page


def test_a_run_is_continued_and_holds_what_it_needs(tables: Path, surveyed: Path, tmp_path: Path) -> None:
    out = tmp_path / "out"
    reach(str(tables), str(out), QUICK, WorkerPool(), report=False)
    gone = next((out / "scenes").glob("*.parquet"))
    gone.unlink()
    reach(str(tables), str(out), QUICK, WorkerPool(), report=False)
    for table in ("scenes", "grasps", "assets", "settled"):
        assert rows_of(out, table) == rows_of(surveyed, table)
    with pytest.raises(ConfigError, match=r"mount: .*front.* -> .*left"):
        reach(str(tables), str(out), replace(QUICK, mount="left"), WorkerPool())


def test_conditions_select_by_the_columns(tables: Path, surveyed: Path, tmp_path: Path) -> None:
    done = CliRunner().invoke(stable_data, ["query", str(surveyed), "task_graspable", "--to", str(tmp_path / "good")])
    assert done.exit_code == 0, done.output
    assert [row["scene_id"] for row in rows_of(tmp_path / "good", "scenes")] == ["laid"]
    assert {row["task_reachable"] for row in rows_of(tables, "scenes")} == {None}  # no robot was asked


def test_the_command_counts_and_refuses(tables: Path, tmp_path: Path) -> None:
    shared = ["reach", "--scenes", str(tables), "--out", str(tmp_path / "out"), "--workers", "0"]
    done = CliRunner().invoke(app, [*shared, "--robot", "simple", "--set", "grasp_tries=0", "--set", "mount=front"])
    assert done.exit_code == 0, done.output
    assert "3 of 3 scenes surveyed, 1 tasks reachable, 0 graspable, 0 grasps tried" in done.output
    for options, message in (
        (["--robot", "crane"], "expected one of panda, panda_2f85, simple, so101"),
        (["--robot", "simple", "--set", "mount=above"], "expected auto or one of front"),
    ):
        done = CliRunner().invoke(app, [*shared, *options])
        assert done.exit_code == 2
        assert message in " ".join(done.stderr.split())


def test_a_missing_package_is_said_at_the_start(tables: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(Robot, "is_there", property(lambda _: False))
    for start in (
        lambda: ReachJob(str(tables), ReachSettings()),
        lambda: GenerateSettings(robot="panda"),
        lambda: CorrectSettings(robot="panda"),
    ):
        with pytest.raises(ConfigError, match="fetch them with: stable-data robots --fetch panda") as error:
            start()
        assert error.value.code == "robot_missing"


@pytest.mark.parametrize(
    ("changed", "says"),
    [
        ({"accept": "clean and task_reachable"}, "nothing fills the column task_reachable: robot is empty; set it to panda"),
        ({"accept": "task_graspable", "robot": "simple", "grasp_tries": 0}, "grasp_tries is 0; set it to 3"),
        ({"robot": "simple", "mount": "front:2"}, "with a share from 0 to 1"),
    ],
)
def test_a_condition_that_nothing_fills_is_refused_at_the_start(changed: dict[str, Any], says: str) -> None:
    with pytest.raises(ConfigError, match=says):
        GenerateSettings(**changed)


def test_what_no_robot_can_do_is_rejected_with_the_reason(dataset: Path, tmp_path: Path) -> None:
    assets = AssetLibraries([str(dataset)]).libraries[0].assets[1:4]
    (tmp_path / "script.json").write_text(json.dumps(one_thing_a_stage(assets)))
    settings = GenerateSettings(
        EngineSettings(f"scripted:{tmp_path / 'script.json'}"),
        weights="none",
        num_pictures=0,
        robot="simple",
        mount="front",
        grasp_tries=1,
        accept="clean and task_reachable",
    )
    asked = TaskSource("tasks", [LayoutTask("task_0", "Lift it.", Tabletop("office_table", (1.2, 0.6)))])
    generate(asked, str(tmp_path / "out"), settings, WorkerPool(), [str(dataset)])
    (row,) = rows_of(tmp_path / "out", "rejected")  # without a reader of instructions no goal is known
    assert (row["robot"], row["task_reachable"]) == ("simple", None)
    assert "task_reachable is unknown" in row["reason"]
    assert row["reason"].endswith(row["task_reason"])
    assert row["reach"][0]["role"] == "other"
    assert "Reach and grasps: simple" in (tmp_path / "out" / "report" / "index.html").read_text("utf-8")


def test_corrected_scenes_have_the_columns_too(tables: Path, tmp_path: Path) -> None:
    settings = CorrectSettings(weights="none", judge_raw=False, num_pictures=0, robot="simple", mount="front", grasp_tries=1)
    correct(str(tables), str(tmp_path), settings, WorkerPool())
    rows = {row["scene_id"]: row["task_graspable"] for row in rows_of(tmp_path, "scenes")}
    assert rows == {"laid": True, "wide": False, "odd": None}
    assert len(rows_of(tmp_path, "grasps")) == 1
