"""What a run with many shards costs the driver: the whole job runs against the simulated store, with little memory a scene."""

import pytest

from benchmarks.plan_scale import figures_of


@pytest.mark.slow
def test_a_run_is_planned_resumed_ended_and_listed() -> None:
    found = {figure.part: figure for figure in figures_of(20000, 0.0)}
    assert list(found) == ["plan", "resume", "end", "list"]
    shards = -(-20000 // 128)
    assert found["end"].files > found["resume"].files >= 7 * int(0.9 * shards)
    assert found["list"].requests >= found["list"].files == found["end"].files
    assert all(figure.peak_mb < 100 for figure in found.values())
