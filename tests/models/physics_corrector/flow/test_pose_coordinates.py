"""Coordinates: inverses of each other, yaw a circle."""

import math

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from models.physics_corrector.flow.pose_coordinates import PoseCoordinates, wrap_angle
from stable_data.errors import ConfigError

BOTH = [PoseCoordinates(), PoseCoordinates("absolute", 1.0, 1.0)]
angles = st.floats(-20.0, 20.0)


def pose(x: float, yaw: float) -> torch.Tensor:
    return torch.tensor([[[x, 2 * x, -x, yaw]]], dtype=torch.float64)


def turn_between(a: torch.Tensor, b: torch.Tensor) -> float:
    return math.remainder((a[..., 3] - b[..., 3]).item(), 2 * math.pi)


@given(angles)
def test_a_wrapped_angle_lies_in_range_and_is_the_same_angle(angle: float) -> None:
    wrapped = wrap_angle(torch.tensor(angle, dtype=torch.float64)).item()
    assert -math.pi < wrapped <= math.pi + 1e-14
    assert abs(math.remainder(wrapped - angle, 2 * math.pi)) < 1e-12


def test_half_a_turn_is_plus_pi() -> None:
    for dtype in (torch.float32, torch.float64):
        pi = torch.tensor(math.pi, dtype=dtype)
        torch.testing.assert_close(wrap_angle(torch.stack([pi, -pi, 3 * pi, -3 * pi])), pi.expand(4))


@given(st.floats(-3.125, 3.125, width=32))
def test_an_angle_in_range_comes_back_bit_for_bit(angle: float) -> None:
    assert wrap_angle(torch.tensor(angle)).item() == angle


@pytest.mark.parametrize("coordinates", BOTH, ids=lambda c: c.form)
@given(x=st.floats(-2, 2), yaw=angles, coarse_x=st.floats(-2, 2), coarse_yaw=angles)
def test_decoding_undoes_encoding(
    coordinates: PoseCoordinates, x: float, yaw: float, coarse_x: float, coarse_yaw: float
) -> None:
    poses, coarse = pose(x, yaw), pose(coarse_x, coarse_yaw)
    back = coordinates.decode(coordinates.encode(poses, coarse), coarse)
    torch.testing.assert_close(back[..., :3], poses[..., :3], atol=1e-12, rtol=0)
    assert abs(turn_between(back, poses)) < 1e-12


def test_the_coarse_pose_is_the_origin_of_residual_coordinates() -> None:
    coarse = pose(0.3, 3.0)
    assert not PoseCoordinates().encode(coarse, coarse).any()


@pytest.mark.parametrize("coordinates", BOTH, ids=lambda c: c.form)
@given(a=angles, b=angles, turns=st.integers(-3, 3))
def test_a_difference_takes_the_short_way_round(coordinates: PoseCoordinates, a: float, b: float, turns: int) -> None:
    coarse = pose(0.0, 1.0)
    start, end = coordinates.encode(pose(0.1, a), coarse), coordinates.encode(pose(0.2, b + 2 * math.pi * turns), coarse)
    difference = coordinates.difference(start, end)
    assert abs(difference[..., 3].item()) * coordinates.yaw_unit <= math.pi + 1e-12
    assert abs(turn_between(coordinates.decode(start + difference, coarse), pose(0.2, b))) < 1e-12


def test_what_a_network_reads_of_yaw_is_continuous_across_pi() -> None:
    coordinates = PoseCoordinates("absolute", 1.0, 1.0)
    below, above = (coordinates.on_circle(pose(0.0, yaw)) for yaw in (math.pi - 1e-6, -math.pi + 1e-6))
    torch.testing.assert_close(below, above, atol=1e-5, rtol=0)


@pytest.mark.parametrize("values", [("polar", 1.0, 1.0), ("residual", 0.0, 1.0), ("residual", 1.0, math.nan)])
def test_coordinates_without_an_inverse_are_refused(values: tuple[str, float, float]) -> None:
    with pytest.raises(ConfigError, match=r"(form|unit) is .* expected"):
        PoseCoordinates(*values)  # type: ignore[arg-type]
