"""The noise levels: identities of DDPM and DDIM."""

import itertools
import math

import pytest
import torch

from models.rearrangement.noise_schedule import NoiseSchedule, Schedule

KINDS: list[tuple[Schedule, int]] = [("cosine", 200), ("linear", 200), ("published", 1000), ("cosine", 1), ("linear", 7)]
G = torch.Generator().manual_seed(0)
Y0, NOISE, DRAWN = (torch.randn(3, 4, 4, generator=G, dtype=torch.float64) for _ in range(3))


@pytest.fixture(params=KINDS, ids=lambda kind: f"{kind[0]} {kind[1]}")
def schedule(request: pytest.FixtureRequest) -> NoiseSchedule:
    kind, times = request.param
    return NoiseSchedule.of(times, kind)


def noised(schedule: NoiseSchedule, level: int) -> torch.Tensor:
    return schedule.noised(Y0, NOISE, torch.full((3,), level))


def test_the_signal_falls_from_all_to_nearly_none(schedule: NoiseSchedule) -> None:
    assert schedule.signal[0] == 1
    assert (schedule.signal.diff() < 0).all()
    assert 0 < schedule.signal[-1] < 0.01
    assert torch.equal(noised(schedule, 0), Y0)


def test_the_published_rates_leave_signal_at_the_last_of_200_levels() -> None:
    found = NoiseSchedule.of(200, "published").signal
    assert float(1 - found[1]) == pytest.approx(1e-4)
    assert float(1 - found[-1] / found[-2]) == pytest.approx(0.02)
    assert float(found[-1]) == pytest.approx(0.13, abs=0.005)


def test_the_estimates_are_inverse_to_each_other(schedule: NoiseSchedule) -> None:
    for level in {1, (schedule.times + 1) // 2, schedule.times}:
        y = noised(schedule, level)
        torch.testing.assert_close(schedule.clean(y, NOISE, level), Y0, atol=1e-8, rtol=0)
        torch.testing.assert_close(schedule.noise(y, Y0, level), NOISE, atol=1e-8, rtol=0)


@pytest.mark.parametrize("drawn", [None, DRAWN], ids=["ddim", "ancestral"])
def test_a_step_to_level_0_gives_the_clean_coordinates(schedule: NoiseSchedule, drawn: torch.Tensor | None) -> None:
    for level in {1, schedule.times}:
        torch.testing.assert_close(schedule.step(noised(schedule, level), Y0, level, 0, drawn), Y0)


def test_a_step_of_ddim_with_the_true_noise_stays_on_its_path(schedule: NoiseSchedule) -> None:
    levels = schedule.levels(3)
    y = noised(schedule, levels[0])
    for level, lower in itertools.pairwise(levels):
        y = schedule.step(y, Y0, level, lower)
        torch.testing.assert_close(y, noised(schedule, lower), atol=1e-8, rtol=0)


def test_ancestral_steps_keep_the_variance(schedule: NoiseSchedule) -> None:
    """The old noise and the drawn one are independent: the squares of their shares add up to 1 − ᾱ_j."""
    for level, lower in ((schedule.times, schedule.times - 1), (schedule.times, schedule.times // 2)):
        noise, drawn = torch.tensor([[[1.0, 0.0]]], dtype=torch.float64), torch.tensor([[[0.0, 1.0]]], dtype=torch.float64)
        y = math.sqrt(1 - float(schedule.signal[level])) * noise
        moved = schedule.step(y, torch.zeros_like(y), level, lower, drawn)
        assert float(moved.square().sum()) == pytest.approx(1 - float(schedule.signal[lower]))


@pytest.mark.parametrize("steps", [0, 1, 3, 200, 1000])
def test_the_visited_levels_fall_from_the_last_to_0(schedule: NoiseSchedule, steps: int) -> None:
    levels = schedule.levels(steps)
    assert (levels[0], levels[-1]) == (schedule.times, 0)
    assert all(a > b for a, b in itertools.pairwise(levels))
    assert len(levels) == 1 + min(steps or schedule.times, schedule.times)
