"""Evaluations of policies: counted once, the same in one process and with Ray, and kept in a leaderboard."""

from dataclasses import replace
from pathlib import Path

import polars as pl
import pytest

from benchmarks import leaderboard
from models.policy.chunk_policy import open_policy
from models.policy.network import PolicyShape
from models.policy.training import PolicyTrainingSettings
from pipelines.demonstrate.job import demonstrate
from pipelines.demonstrate.settings import DemonstrateSettings
from pipelines.evaluate_policy.job import EvaluatePolicyJob, evaluate_policy, settings_for
from pipelines.evaluate_policy.settings import EvaluatePolicySettings
from pipelines.execution.ray_executor import WorkerPool
from stable_data.errors import ConfigError
from stable_data.simulation.offscreen import can_render
from stable_data.storage.run_folder import RunFolder
from tests.pipelines.policy import policies
from tests.pipelines.policy.test_train_policy import train

POLICIES = "tests.pipelines.policy.policies"
SIMPLE = EvaluatePolicySettings(robot="simple", task="pick", max_steps=6)


def test_a_policy_that_does_nothing_never_succeeds(two_scenes: Path, tmp_path: Path) -> None:
    manifest = evaluate_policy(f"{POLICIES}:StayingPolicy", str(two_scenes), str(tmp_path / "out"), SIMPLE, WorkerPool())
    counts = manifest["counts"]
    assert (counts["successes"], counts["attempts"], counts["by_reason"]) == (0, 2, {"too_long": 2})
    assert counts["by_assets"] == {"not known": [0, 2]}
    rows = RunFolder(str(tmp_path / "out")).table("episodes", ["policy", "num_steps", "reason"]).to_pylist()
    assert [(row["policy"], row["num_steps"]) for row in rows] == [(f"{POLICIES}:StayingPolicy", 6)] * 2
    assert "0% – 66%" in (tmp_path / "out/report/index.html").read_text("utf-8")


@pytest.mark.slow
def test_what_was_shown_is_repeated(two_scenes: Path, demonstrations: Path, tmp_path: Path) -> None:
    shape = PolicyShape(width=96, depth=2, modes=1, dropout=0.0)
    policy = train(demonstrations, tmp_path / "policy", PolicyTrainingSettings(shape, steps=600, batch=32, held_out=0.0))
    settings = EvaluatePolicySettings(robot="simple", task="pick", max_steps=150)  # the same seeds as the demonstrations
    counts = evaluate_policy(str(policy), str(two_scenes), str(tmp_path / "out"), settings, WorkerPool())["counts"]
    assert counts["by_assets"] == {"seen in training": [2, 2]}


@pytest.mark.slow
def test_what_was_shown_in_pictures_is_repeated(two_scenes: Path, tmp_path: Path) -> None:
    if not can_render():
        pytest.skip("this machine cannot render")
    seen = DemonstrateSettings(robot="simple", task="pick", cameras=frozenset({"front"}), image_width=64, image_height=64)
    demonstrate(str(two_scenes), str(tmp_path / "demonstrations"), seen, WorkerPool(), report=False)
    shape = PolicyShape(width=96, depth=2, modes=1, dropout=0.0, sees_objects=False, cameras=("front",), picture_size=32)
    policy = train(
        tmp_path / "demonstrations", tmp_path / "policy", PolicyTrainingSettings(shape, steps=600, batch=32, held_out=0.0)
    )
    settings = replace(settings_for(str(policy)), task="pick", max_steps=150)
    assert (settings.cameras, settings.image_width) == (frozenset({"front"}), 64)
    counts = evaluate_policy(str(policy), str(two_scenes), str(tmp_path / "out"), settings, WorkerPool())["counts"]
    assert counts["successes"] == 2


@pytest.mark.slow
def test_the_expert_is_a_line_of_reference(two_scenes: Path, tmp_path: Path) -> None:
    settings = EvaluatePolicySettings(robot="simple", task="pick")
    counts = evaluate_policy("expert", str(two_scenes), str(tmp_path / "out"), settings, WorkerPool())["counts"]
    assert counts["successes"] == counts["attempts"] == 2


@pytest.mark.parametrize(
    ("name", "code", "words"),
    [
        ("BrokenPolicy", "policy_failed", "act.. raised RuntimeError: no idea"),
        ("ShortPolicy", "policy_invalid", "gave shape .3,., expected finite numbers of shape .7,."),
        ("nothing", "policy_invalid", "expected module:function"),
        ("lost", "policy_invalid", "lost.. raised FileNotFoundError: no weights here"),
    ],
)
def test_a_policy_that_fails_ends_the_run(name: str, code: str, words: str, two_scenes: Path, tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match=words) as caught:
        evaluate_policy(f"{POLICIES}:{name}", str(two_scenes), str(tmp_path / "out"), SIMPLE, WorkerPool())
    assert caught.value.code == code


def test_a_trained_policy_fits_its_robot_alone(two_scenes: Path, demonstrations: Path, tmp_path: Path) -> None:
    out = train(demonstrations, tmp_path / "policy")
    counts = evaluate_policy(str(out), str(two_scenes), str(tmp_path / "out"), SIMPLE, WorkerPool())["counts"]
    assert counts["attempts"] == 2
    assert sum(total for _, total in counts["by_assets"].values()) == 2
    assert "not known" not in counts["by_assets"]
    with pytest.raises(ConfigError, match=r"its control is ee_delta, but setting evaluate_policy.control is joint"):
        EvaluatePolicyJob(str(out), str(two_scenes), EvaluatePolicySettings(robot="simple", control="joint"))


@pytest.mark.slow
@pytest.mark.ray
def test_with_ray_the_same(two_scenes: Path, demonstrations: Path, tmp_path: Path) -> None:
    out = train(demonstrations, tmp_path / "policy")
    tables = []
    for name, workers in (("alone", WorkerPool()), ("ray", WorkerPool(2))):
        evaluate_policy(str(out), str(two_scenes), str(tmp_path / name), SIMPLE, workers, report=False)
        tables.append(pl.read_parquet(f"{tmp_path}/{name}/episodes/*.parquet").sort("episode_id"))
    assert tables[0].equals(tables[1])


def test_a_policy_may_say_what_its_source_does_not(monkeypatch: pytest.MonkeyPatch) -> None:
    first = open_policy(f"{POLICIES}:weighed").fingerprint
    assert open_policy(f"{POLICIES}:weighed").fingerprint == first
    monkeypatch.setattr(policies, "WEIGHTS", ["second"])
    assert open_policy(f"{POLICIES}:weighed").fingerprint != first


def test_settings_that_change_no_episode_make_no_other_block(two_scenes: Path, tmp_path: Path) -> None:
    found = []
    for name, settings in (("a", SIMPLE), ("b", replace(SIMPLE, num_pictures=0, seconds_per_item=60.0, scenes_per_shard=1))):
        evaluate_policy(
            f"{POLICIES}:StayingPolicy", str(two_scenes), str(tmp_path / name), settings, WorkerPool(), report=False
        )
        found.append(leaderboard.line_of(str(tmp_path / name)).episodes_fingerprint)
    assert found[0] == found[1]


def test_the_leaderboard_keeps_the_newest_line_of_a_policy(
    two_scenes: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    run, file = str(tmp_path / "out"), tmp_path / "leaderboard.csv"
    evaluate_policy(f"{POLICIES}:StayingPolicy", str(two_scenes), run, SIMPLE, WorkerPool(), report=False)
    for name in ("still", "still again"):
        leaderboard.main(["--file", str(file), "add", run, "--name", name, "--scenes", "two tables"])
    (line,) = leaderboard.read_lines(file)
    assert (line.policy, line.successes, line.attempts, line.scenes) == ("still again", 0, 2, "two tables")
    assert str(tmp_path) not in line.command  # a published line names no folder of the machine
    leaderboard.write_lines(tmp_path / "again.csv", [line])
    assert (tmp_path / "again.csv").read_bytes() == file.read_bytes()
    leaderboard.main(["--file", str(file), "show"])
    assert "0/2" in capsys.readouterr().out
    with pytest.raises(SystemExit, match="2"):
        leaderboard.main(["--file", str(file), "add", str(two_scenes)])
    file.write_text("a,b\n", "utf-8")
    with pytest.raises(ConfigError, match="has columns"):
        leaderboard.read_lines(file)
