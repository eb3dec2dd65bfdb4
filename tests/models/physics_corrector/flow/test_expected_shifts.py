"""Where objects are expected by the errors of their coarse poses alone."""

import math

import torch

from models.physics_corrector.flow.condition import Condition
from models.physics_corrector.flow.flow_matching import FlowMatching, FlowSettings
from models.physics_corrector.flow.object_encoding import expected_shifts
from tests.models.physics_corrector.flow.conditions import condition, padded, permuted

SIGMA = torch.tensor([0.1])


def scene(*objects: tuple[float, float, int], size: float = 0.1, error: float = math.nan) -> Condition:
    """Cubes at (x, y) with a parent on a table of 1 m by 1 m."""
    count = len(objects)
    xy = torch.tensor([[x, y] for x, y, _ in objects])
    return Condition(
        poses=torch.cat([xy, torch.full((count, 1), size / 2), torch.zeros(count, 1)], 1)[None],
        mask=torch.ones(1, count, dtype=torch.bool),
        sizes=torch.full((1, count, 3), size),
        is_fixed=torch.zeros(1, count, dtype=torch.bool),
        parent=torch.tensor([[parent for _, _, parent in objects]]),
        table=torch.ones(1, 2),
        zone=torch.zeros(1, 4),
        has_zone=torch.zeros(1, dtype=torch.bool),
        error=torch.tensor([[error, math.nan]]),
    )


def test_in_the_middle_nothing_is_expected_elsewhere_and_at_the_edge_it_is_farther_inside() -> None:
    alone, together = expected_shifts(scene((0.5, 0.5, -1), (0.05, 0.5, -1), (-0.1, 1.3, -1)), SIGMA)
    assert torch.equal(alone, together)  # bodies of one object
    assert alone[0, 0].abs().max() < 1e-4
    # At the edge of a half normal distribution the mean is σ √(2 / π) inside.
    torch.testing.assert_close(alone[0, 1], torch.tensor([0.1 * math.sqrt(2 / math.pi), 0.0]), atol=1e-3, rtol=0)
    inside = torch.tensor([-0.1, 1.3]) + alone[0, 2]
    assert (inside > 0.05).all()
    assert (inside < 0.95).all()


def test_the_mean_of_draws_is_the_expected_place() -> None:
    """Objects that stood anywhere on the table and were displaced: those that are now near a place stood there on average."""
    generator = torch.Generator().manual_seed(0)
    stood = 0.05 + 0.9 * torch.rand(4_000_000, generator=generator)
    now = stood + 0.1 * torch.randn(len(stood), generator=generator)
    for place in (0.0, 0.1, 0.2):
        near = (now - place).abs() < 0.005
        shift = expected_shifts(scene((place, 0.5, -1)), SIGMA)[0][0, 0, 0]
        assert abs(float((stood - now)[near].mean() - shift)) < 4e-3


def test_contents_that_strayed_and_their_carrier_tell_of_each_other() -> None:
    alone, together = expected_shifts(scene((0.4, 0.5, -1), (0.6, 0.5, 0)), SIGMA)
    assert alone.abs().max() < 2e-3
    carrier, content = together[0]
    assert 0.08 < carrier[0] < 0.1  # nearly half way
    assert -0.12 < content[0] < -0.08
    assert together[0, :, 1].abs().max() < 1e-3


def test_contents_that_are_still_on_their_carrier_go_with_it() -> None:
    _, together = expected_shifts(scene((0.0, 0.5, -1), (0.03, 0.52, 0)), SIGMA)
    torch.testing.assert_close(together[0, 0], together[0, 1])
    assert together[0, 0, 0] > 0.05


def test_order_padding_and_fixed_objects() -> None:
    scenes, sigma = condition(4, 7), torch.full((4,), 0.05)
    found = expected_shifts(scenes, sigma)
    order = torch.randperm(7, generator=torch.Generator().manual_seed(1))
    for shift, other, more in zip(
        found, expected_shifts(permuted(scenes, order), sigma), expected_shifts(padded(scenes, 2), sigma), strict=True
    ):
        torch.testing.assert_close(other, shift[:, order])
        torch.testing.assert_close(more[:, :7], shift)
        assert not shift[~scenes.is_movable].any()
        assert not more[:, 7:].any()


def test_the_path_starts_there_if_errors_are_known() -> None:
    flow = FlowMatching(FlowSettings(source="expected", sigma=0.0))
    known, unknown = (scene((0.05, 0.5, -1), error=error) for error in (0.1, math.nan))
    assert not flow.start(unknown).any()
    start = flow.poses(flow.start(known), known)
    shift = expected_shifts(known, SIGMA)[1]
    torch.testing.assert_close(start[..., :2], known.poses[..., :2] + shift)
    still = flow.sample(lambda y, *_: torch.zeros_like(y), known)
    torch.testing.assert_close(still, start)  # a network that does nothing leaves things there
