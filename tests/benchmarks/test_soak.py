"""What a soak says of its samples: flat, growing, falling or unknown."""

import json
import subprocess
import sys
from collections.abc import Mapping
from dataclasses import asdict, replace
from pathlib import Path

import numpy as np
import pytest

from benchmarks.chaos import NOT_COMPLETE
from benchmarks.faults.processes import ROOT, Usage
from benchmarks.same_shard import Pass, is_steady, make_passes, trends_of
from benchmarks.soak import (
    DRIVER_TIME,
    KEPT_MEMORY,
    WALL_TIME,
    WORKER_TIME,
    FinishedShard,
    Sample,
    SoakedRun,
    Trend,
    is_good,
    outcomes,
    show,
    trend,
    trends,
)
from pipelines.generate.job import GenerateJob
from pipelines.generate.settings import GenerateSettings
from pipelines.sources.generation_tasks import sample_tasks
from stable_data.errors import ConfigError
from stable_data.storage.manifest import write_manifest
from stable_data.storage.run_folder import RunFolder

SCENES = 20000


def blocks(slope: float, noise: float, count: int = 150, sessions: int = 3) -> list[tuple[int, float, float]]:
    """Blocks of some sessions, each with a height of its own; the slope is per 1,000 scenes."""
    rng, found = np.random.default_rng(0), list[tuple[int, float, float]]()
    for number in range(count):
        scenes, session = 100.0 * number, number * sessions // count
        found.append((session, scenes, 1000.0 + 50 * session + slope * scenes / 1000 + float(rng.normal(0, noise))))
    return found


@pytest.mark.parametrize(
    ("slope", "noise", "verdict"),
    [
        (0.0, 5.0, "flat"),
        (1.0, 0.1, "flat"),
        (20.0, 5.0, "grows"),
        (-20.0, 5.0, "falls"),
        (0.0, 2000.0, "unknown"),
        (1.0, 800.0, "unknown"),
    ],
)
def test_a_slope_is_found_beneath_the_heights_of_sessions(slope: float, noise: float, verdict: str) -> None:
    found = trend("memory", blocks(slope, noise), SCENES)
    assert found.verdict == verdict
    assert found.slope is not None
    assert found.low is not None
    assert found.high is not None
    assert found.low <= found.slope <= found.high
    if noise < 10:
        assert found.slope == pytest.approx(slope, abs=1)
        assert found.change == pytest.approx(slope * SCENES / 1000 / found.mean, abs=0.02)


@pytest.mark.parametrize(
    ("slope", "noise", "verdict"),
    [(0.0, 15.0, "flat"), (2.0, 10.0, "flat"), (10.0, 30.0, "grows"), (-10.0, 30.0, "falls"), (0.0, 400.0, "unknown")],
)
def test_memory_has_an_allowance_that_does_not_depend_on_its_mean(slope: float, noise: float, verdict: str) -> None:
    found = [(session, scenes, 9000.0 + value) for session, scenes, value in blocks(slope, noise)]
    assert trend("memory", found, SCENES, allowed=5.0).verdict == verdict
    assert trend("memory", blocks(10.0, 1.0), SCENES, allowed=5.0).verdict == "grows"


def test_noise_that_lasts_makes_a_slope_less_certain() -> None:
    rng, level = np.random.default_rng(1), 0.0
    slow, fast = list[tuple[int, float, float]](), list[tuple[int, float, float]]()
    for number in range(200):
        level = 0.9 * level + float(rng.normal(0, 10))
        slow.append((0, 100.0 * number, 1000.0 + level))
    values = [value for *_, value in slow]
    fast = [(0, scenes, values[k]) for (_, scenes, _), k in zip(slow, rng.permutation(200), strict=True)]
    widths = [
        found.high - found.low for found in (trend("memory", one, SCENES) for one in (slow, fast)) if found.high and found.low
    ]
    assert widths[0] > 2 * widths[1]


def test_outcomes_are_those_of_the_manifest_and_faults_of_the_toolkit_are_told(
    tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    folder = RunFolder(str(tmp_path / "run"))
    assert outcomes(folder) == {"accepted": 0, "failures": {}, "code_versions": []}
    counts = {"scenes": 90, "failures_by_code": {"rejected": 8, "crashed": 1}}
    write_manifest(folder, {"counts": counts, "code_versions": ["0.1.0+a", "0.1.0+b"]})
    bad = SoakedRun(99, True, True, [], **outcomes(folder))
    assert (bad.accepted, bad.failures) == (90, {"rejected": 8, "crashed": 1})
    good = SoakedRun(99, True, True, [], 91, {"rejected": 8})
    flat, grows, wall = (trend("m", blocks(slope, 1.0), SCENES, 5.0) for slope in (0.0, 50.0, 50.0))
    assert is_good([flat], [good])
    assert not is_good([flat], [good, bad])
    assert not is_good([flat], [SoakedRun(99, True, False, [])])
    assert not is_good([flat, grows], [good])
    assert is_good([flat, replace(wall, name=WALL_TIME)], [good])
    show([flat], [good, bad])
    shown = capfd.readouterr().out
    assert "181 accepted, 17 failed: rejected 16, crashed 1\n" in shown
    assert "failed through the toolkit itself: crashed 1\n" in shown
    assert "code: 0.1.0+a, 0.1.0+b\n" in shown


def test_few_blocks_say_nothing() -> None:
    assert trend("memory", blocks(100.0, 0.0, count=7, sessions=1), SCENES).verdict == "unknown"
    assert trend("memory", [], SCENES).verdict == "unknown"


def of_shards(more_kept: float | None = 0.0, more_seconds: float = 0.0, count: int = 1200) -> list[Sample]:
    """Looks at a job with a shard of five scenes each; a worker keeps, and takes, that much more for each 1,000 scenes."""
    rng, samples = np.random.default_rng(0), list[Sample]()
    for number in range(count):
        scenes = 5 * number
        starting = min(2500.0, 20.0 * scenes)  # reached after 125 scenes
        used = Usage(starting, 100, 2, 20, 2.0 * scenes)
        leaking = Usage(400.0 + scenes / 10, 50 + scenes // 100, 1, 8, scenes / 100)
        tokens = rng.lognormal(5, 1, 5).astype(int)
        squared = int((tokens**2).sum())
        seconds = 5.0 + tokens.sum() / 100 + squared / 1e5 + 5 * more_seconds * scenes / 1000
        kept = None if more_kept is None or number < 20 else 800.0 + 50 * (number % 2) + more_kept * scenes / 1000
        shard = FinishedShard(str(number), 5, float(seconds + rng.normal(0, 0.2)), kept, int(tokens.sum()), squared)
        samples.append(Sample(0, 10.0 * number, scenes, leaking, used, Usage(300.0, 60, 5, 50, 0.0), [shard]))
    return samples


def judged(samples: list[Sample], scenes: int = 6000) -> dict[str, Trend]:
    run = SoakedRun(scenes, is_complete=True, is_whole=True, samples=samples)
    return {one.name: one for one in trends([run], warm_up=400, warm_up_of_times=200)}


def test_growth_after_the_start_is_found_and_growth_at_the_start_is_not() -> None:
    found = {name: one.verdict for name, one in judged(of_shards()).items()}
    assert found["driver memory, MB"] == found["driver open files"] == "grows"
    assert found["memory of workers at work, MB"] == found["Ray's memory, MB"] == found["processes"] == "flat"
    assert found[KEPT_MEMORY] == found[WORKER_TIME] == found[WALL_TIME] == found[DRIVER_TIME] == "flat"
    assert len(found) == 12


@pytest.mark.parametrize(("more", "verdict"), [(1.0, "flat"), (50.0, "grows"), (-50.0, "falls"), (None, "unknown")])
def test_what_a_worker_keeps_is_judged_shard_by_shard(more: float | None, verdict: str) -> None:
    usual, found = judged(of_shards()), judged(of_shards(more_kept=more))
    assert found.pop(KEPT_MEMORY).verdict == verdict
    assert found == {name: one for name, one in usual.items() if name != KEPT_MEMORY}


@pytest.mark.parametrize(("more", "verdict"), [(0.0, "flat"), (0.5, "grows"), (-0.5, "falls")])
def test_the_time_of_a_scene_is_judged_at_equal_replies(more: float, verdict: str) -> None:
    samples = of_shards(more_seconds=more)
    found = judged(samples)[WORKER_TIME]
    assert found.verdict == verdict
    assert found.slope == pytest.approx(more, abs=0.02)
    shards = [(0, float(sample.scenes), shard.seconds / 5) for sample in samples for shard in sample.finished]
    unequal = trend(WORKER_TIME, shards, 6000)
    assert unequal.high is not None
    assert unequal.low is not None
    assert found.high is not None
    assert found.low is not None
    assert unequal.high - unequal.low > 5 * (found.high - found.low)


@pytest.mark.parametrize(("more", "verdict"), [(0.01, "flat"), (0.1, "grows"), (-0.1, "falls")])
def test_the_time_of_the_driver_is_judged_as_a_part_of_that_of_a_scene(more: float, verdict: str) -> None:
    """``more`` seconds a scene for each 1,000 scenes; a worker takes some three seconds."""
    samples = [
        replace(one, driver=replace(one.driver, cpu_seconds=one.scenes + more * one.scenes**2 / 2000)) for one in of_shards()
    ]
    found = judged(samples)
    assert 2 < found[WORKER_TIME].mean < 5
    assert found[DRIVER_TIME].slope == pytest.approx(more, abs=0.001)
    assert found[DRIVER_TIME].verdict == verdict


def test_one_shard_that_does_not_tell_makes_a_trend_unknown() -> None:
    usual, samples = judged(of_shards()), of_shards()
    (last,) = samples[-2].finished
    samples[-2] = replace(samples[-2], finished=[replace(last, kept_mb=None, tokens=None, tokens_squared=None)])
    found = judged(samples)
    assert found[KEPT_MEMORY].verdict == found[WORKER_TIME].verdict == "unknown"
    rest = usual.keys() - {KEPT_MEMORY, WORKER_TIME}
    assert {name: found[name] for name in rest} == {name: usual[name] for name in rest}


def test_runs_are_summed_with_a_height_of_their_own(tmp_path: Path) -> None:
    runs = []
    for seed in range(2):
        of_run = []
        for number in range(600):
            driver = Usage(400.0 + 100 * seed + number / 1000, 50, 1, 8, 0.0)
            used, shard = Usage(500.0, 90, 2, 20, 10.0 * number), FinishedShard(str(number), 5, 1.0, None, 900, 90000)
            of_run.append(Sample(0, 10.0 * number, 5 * number, driver, used, driver, [shard]))
        path = tmp_path / f"{seed}.json"
        path.write_text(json.dumps({"run": asdict(SoakedRun(3000, is_complete=True, is_whole=True, samples=of_run))}))
        runs.append(SoakedRun.read(path))
        assert runs[-1].samples == of_run
    found = {one.name: one for one in trends(runs, 400, 400)}["driver memory, MB"]
    assert found.verdict == "flat"
    assert found.slope == pytest.approx(0.2, abs=0.01)
    assert found.change == pytest.approx(0.2 * 6 / found.mean, abs=0.001)


def test_another_file_is_refused(tmp_path: Path) -> None:
    (tmp_path / "other.json").write_text('{"trends": []}')
    with pytest.raises(ConfigError, match="expected the output of --json"):
        SoakedRun.read(tmp_path / "other.json")


@pytest.mark.ray
@pytest.mark.slow
def test_a_soak_goes_on_and_sixteen_scenes_say_nothing(dataset: Path, tmp_path: Path) -> None:
    settings = [f"--set={s}" for s in ("schedule=task", "settle=false", "judges=", "accept=clean")]
    out = ["--out", str(tmp_path / "work"), "--json", str(tmp_path / "soak.json")]

    def soak(*more: str) -> subprocess.CompletedProcess[str]:
        command = [sys.executable, "-m", "benchmarks.soak", str(dataset), *out, "--scenes=16", "--per-shard=4", *more, "--"]
        return subprocess.run([*command, *settings], cwd=ROOT, capture_output=True, text=True)

    first = soak("--minutes=0.4")
    assert (first.returncode, first.stderr) == (NOT_COMPLETE, "")
    assert soak("--seed=1").returncode == 2  # another run
    second = soak()
    assert second.returncode == 1, second.stderr
    assert "scenes in 1 runs and 2 sessions" in second.stdout
    assert second.stdout.count("unknown") > 9
    run = SoakedRun.read(tmp_path / "soak.json")
    assert (run.is_complete, run.is_whole, run.accepted + sum(run.failures.values())) == (True, True, 16)
    assert {sample.session for sample in run.samples} == {0, 1}
    assert len(run.code_versions) == 1
    assert run.command[:3] == ["generate", "--count", "16"]
    assert 0 < max(sample.scenes for sample in run.samples) <= 16  # the last look is up to ten seconds before the end
    assert {sample.driver.processes for sample in run.samples} == {1}
    assert any(sample.ray.memory_mb > 0 for sample in run.samples)  # Ray ends before the command
    assert any(sample.workers.cpu_seconds > 1 for sample in run.samples)
    shards = [shard for sample in run.samples for shard in sample.finished]
    assert len(shards) == len({shard.shard_id for shard in shards}) > 1  # of four; the last look is before the end
    assert all(shard.scenes == 4 and shard.seconds > 0 and (shard.tokens or 0) > 100 for shard in shards)
    assert max(shard.kept_mb or 0.0 for shard in shards) > 100


# --- the same scenes again ----------------------------------------------------------------------------------------------------


def passes(
    more_mb: float = 0.0, more_seconds: float = 0.0, files: Mapping[int, str] | None = None, accepted: int = 32
) -> list[Pass]:
    """Thirty passes of 32 scenes, each with a little more than the one before."""
    rng, found = np.random.default_rng(0), list[Pass]()
    for k in range(30):
        kept, seconds = (
            float(mean + k * more + rng.normal(0, 0.05)) for mean, more in ((1000.0, more_mb), (40.0, more_seconds))
        )
        found.append(Pass(kept, seconds, accepted, {"scenes/part-0.parquet": (files or {}).get(k, "same")}))
    return found


@pytest.mark.parametrize(
    ("made", "verdicts", "expected"),
    [
        (passes(), ["flat", "flat"], True),
        (passes(more_mb=0.3), ["grows", "flat"], False),  # 9 MB per 1,000 scenes
        (passes(more_seconds=1.0), ["flat", "grows"], False),
        (passes(files={7: "other"}), ["flat", "flat"], False),
        (passes(accepted=0), ["flat", "flat"], False),
    ],
)
def test_what_grows_while_nothing_is_new_is_lost(made: list[Pass], verdicts: list[str], expected: bool) -> None:
    found = trends_of(made, 32, 5)
    assert [one.verdict for one in found] == verdicts
    assert is_steady(made, found) is expected


def test_passes_share_no_engines(dataset: Path) -> None:
    job = GenerateJob(sample_tasks(1), GenerateSettings(engines=1), [str(dataset)])
    with pytest.raises(ConfigError, match="engines is 1, but a single process"):
        make_passes(job, 1)


@pytest.mark.slow
def test_passes_of_a_shard_give_the_same_files(dataset: Path) -> None:
    settings = GenerateSettings(num_pictures=0, schedule="task", settle=False, judges="", accept="clean", scenes_per_shard=1)
    first, second = make_passes(GenerateJob(sample_tasks(1), settings, [str(dataset)]), 2)
    assert first.files == second.files
    assert "scenes" in {name.partition("/")[0] for name in first.files}
    assert first.accepted == 1
    assert min(first.seconds, second.seconds) > 0
    assert (second.kept_mb or 0.0) > 100
