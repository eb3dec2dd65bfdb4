import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from torch import Tensor

from models.point_encoder.serialization import CURVES, MAX_DEPTH, SpaceFillingCurve, bit_length, encode


def cube(depth: int) -> Tensor:
    return torch.cartesian_prod(*[torch.arange(2**depth)] * 3)


def codes_of(coords: Tensor, depth: int, curve: SpaceFillingCurve) -> Tensor:
    return encode(coords, torch.full((len(coords),), depth), curve)


@pytest.mark.parametrize("curve", CURVES)
@pytest.mark.parametrize("depth", [1, 2, 3, 4])
def test_a_curve_visits_every_place_of_a_cube_once(curve: SpaceFillingCurve, depth: int) -> None:
    assert codes_of(cube(depth), depth, curve).sort().values.equal(torch.arange(8**depth))


@pytest.mark.parametrize("curve", [SpaceFillingCurve.HILBERT, SpaceFillingCurve.HILBERT_TRANS])
@pytest.mark.parametrize("depth", [1, 2, 3, 4])
def test_a_hilbert_curve_never_leaps(curve: SpaceFillingCurve, depth: int) -> None:
    path = cube(depth)[codes_of(cube(depth), depth, curve).argsort()]
    assert path.diff(dim=0).abs().sum(1).eq(1).all()


def test_z_order_visits_the_octants_with_x_first() -> None:
    assert codes_of(torch.tensor([[0, 0, 1], [0, 1, 0], [1, 0, 0], [3, 0, 0]]), 2, SpaceFillingCurve.Z).tolist() == [
        1,
        2,
        4,
        36,
    ]


@pytest.mark.parametrize(
    ("curve", "other"),
    [(SpaceFillingCurve.Z, SpaceFillingCurve.Z_TRANS), (SpaceFillingCurve.HILBERT, SpaceFillingCurve.HILBERT_TRANS)],
)
def test_a_transposed_curve_exchanges_x_and_y(curve: SpaceFillingCurve, other: SpaceFillingCurve) -> None:
    coords = cube(3)
    assert codes_of(coords[:, [1, 0, 2]], 3, curve).equal(codes_of(coords, 3, other))


@given(
    coords=st.lists(st.tuples(*[st.integers(0, 2**MAX_DEPTH - 1)] * 3), min_size=1, max_size=20), curve=st.sampled_from(CURVES)
)
def test_a_code_without_its_last_three_bits_is_that_of_the_parent(
    coords: list[tuple[int, int, int]], curve: SpaceFillingCurve
) -> None:
    places = torch.tensor(coords)
    assert (codes_of(places, MAX_DEPTH, curve) >> 3).equal(codes_of(places >> 1, MAX_DEPTH - 1, curve))


def test_a_hilbert_curve_turns_with_the_depth_of_its_own_cloud_alone() -> None:
    small, large = cube(2), cube(4)
    depth = torch.cat([torch.full((len(small),), 2), torch.full((len(large),), 4)])
    together = encode(torch.cat([small, large]), depth, SpaceFillingCurve.HILBERT)
    assert together[: len(small)].equal(codes_of(small, 2, SpaceFillingCurve.HILBERT))
    assert together[len(small) :].equal(codes_of(large, 4, SpaceFillingCurve.HILBERT))


@given(st.integers(0, 2**16))
def test_bit_lengths_are_those_of_whole_numbers(value: int) -> None:
    assert int(bit_length(torch.tensor(value))) == value.bit_length()
