"""What a soak says of its samples: flat, growing, falling or unknown."""

import json
from dataclasses import asdict
from pathlib import Path

import numpy as np
import pytest

from benchmarks.faults.processes import Usage
from benchmarks.soak import Sample, SoakedRun, trend, trends
from stable_data.errors import ConfigError

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


def test_few_blocks_say_nothing() -> None:
    assert trend("memory", blocks(100.0, 0.0, count=7, sessions=1), SCENES).verdict == "unknown"
    assert trend("memory", [], SCENES).verdict == "unknown"


def test_growth_after_the_start_is_found_and_growth_at_the_start_is_not() -> None:
    samples = []
    for number in range(1200):
        scenes = 5 * number
        starting = min(2500.0, 20.0 * scenes)  # reached after 125 scenes
        used = Usage(starting, 100, 2, 20, 2.0 * scenes)
        leaking = Usage(400.0 + scenes / 10, 50 + scenes // 100, 1, 8, 0.0)
        samples.append(Sample(0, 10.0 * number, scenes, leaking, used, Usage(300.0, 60, 5, 50, 0.0)))
    runs = [SoakedRun(6000, is_complete=True, is_whole=True, samples=samples)]
    found = {one.name: one.verdict for one in trends(runs, warm_up=400)}
    assert found["driver memory, MB"] == found["driver open files"] == "grows"
    assert found["workers' memory, MB"] == found["Ray's memory, MB"] == found["processes"] == "flat"
    assert found["processor seconds a scene"] == found["seconds a scene"] == "flat"
    assert {one.name: one.mean for one in trends(runs, warm_up=400)}["processor seconds a scene"] == pytest.approx(2.0)


def test_runs_are_summed_with_a_height_of_their_own(tmp_path: Path) -> None:
    runs = []
    for seed in range(2):
        of_run = []
        for number in range(600):
            driver = Usage(400.0 + 100 * seed + number / 1000, 50, 1, 8, 0.0)
            of_run.append(Sample(0, 10.0 * number, 5 * number, driver, Usage(500.0, 90, 2, 20, 10.0 * number), driver))
        path = tmp_path / f"{seed}.json"
        path.write_text(json.dumps({"run": asdict(SoakedRun(3000, is_complete=True, is_whole=True, samples=of_run))}))
        runs.append(SoakedRun.read(path))
        assert runs[-1].samples == of_run
    found = {one.name: one for one in trends(runs, warm_up=400)}["driver memory, MB"]
    assert found.verdict == "flat"
    assert found.slope == pytest.approx(0.2, abs=0.01)
    assert found.change == pytest.approx(0.2 * 6 / found.mean, abs=0.001)


def test_another_file_is_refused(tmp_path: Path) -> None:
    (tmp_path / "other.json").write_text('{"trends": []}')
    with pytest.raises(ConfigError, match="expected the output of --json"):
        SoakedRun.read(tmp_path / "other.json")
