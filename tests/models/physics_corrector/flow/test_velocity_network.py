"""Both networks: padding leaks nothing, order means nothing, any number of objects."""

from dataclasses import replace

import pytest
import torch
from torch import Tensor

from models.physics_corrector.flow.condition import Condition
from models.physics_corrector.flow.presets import PRESETS
from models.physics_corrector.flow.velocity_network import VelocityNetwork, VelocityNetworkSettings, time_embedding
from stable_data.errors import ConfigError
from tests.models.physics_corrector.flow.conditions import awake_network, condition, padded, permuted, query, small_settings

BACKBONES = ["unet1d", "set_transformer"]
TOLERANCE = 1e-4  # weights of random sign and size make large velocities


@pytest.fixture(params=BACKBONES)
def network(request: pytest.FixtureRequest) -> VelocityNetwork:
    return awake_network(small_settings(request.param))


def ask(network: VelocityNetwork, scenes: Condition, y: Tensor, t: Tensor, y1_hat: Tensor | None = None) -> Tensor:
    with torch.no_grad():
        velocity: Tensor = network(y, t, scenes, scenes.content_ranks(), y1_hat)
    return velocity


def assert_same(found: Tensor, expected: Tensor) -> None:
    assert expected.abs().max() > 0.01  # it says something
    torch.testing.assert_close(found, expected, atol=TOLERANCE, rtol=0)


def test_padding_leaks_nothing(network: VelocityNetwork) -> None:
    scenes = condition(3, 5)
    y, t = query(scenes)
    more = torch.cat([y, torch.full((3, 6, 4), torch.nan)], 1)
    alone = ask(network, scenes, y, t, y)
    crowd = ask(network, padded(scenes, 6), more, t, more)
    assert_same(crowd[:, :5], alone)
    assert not crowd[:, 5:].any()


def test_padding_between_objects_leaks_nothing(network: VelocityNetwork) -> None:
    scenes = padded(condition(2, 4), 3)
    order = torch.tensor([4, 0, 5, 1, 2, 6, 3])
    y, t = query(scenes)
    assert_same(ask(network, permuted(scenes, order), y[:, order], t), ask(network, scenes, y, t)[:, order])


def test_a_scene_does_not_see_its_batch_mates(network: VelocityNetwork) -> None:
    scenes = condition(3, 6)
    y, t = query(scenes)
    one = replace(scenes, **{name: getattr(scenes, name)[1:2] for name in Condition.__dataclass_fields__})
    assert_same(ask(network, one, y[1:2], t[1:2]), ask(network, scenes, y, t)[1:2])


@pytest.mark.parametrize("num_codes", [0, 64])
@pytest.mark.parametrize("backbone", BACKBONES)
def test_permuting_objects_permutes_velocities(backbone: str, num_codes: int) -> None:
    network = awake_network(small_settings(backbone, num_codes=num_codes))
    scenes = condition(3, 8, real=7)
    y, t = query(scenes)
    order = torch.randperm(8, generator=torch.Generator().manual_seed(2))
    assert_same(ask(network, permuted(scenes, order), y[:, order], t, y[:, order]), ask(network, scenes, y, t, y)[:, order])


@pytest.mark.parametrize("num_objects", [1, 200])
def test_any_number_of_objects(network: VelocityNetwork, num_objects: int) -> None:
    scenes = condition(2, num_objects)
    scenes = replace(scenes, is_fixed=torch.zeros_like(scenes.is_fixed))
    velocity = ask(network, scenes, *query(scenes))
    assert velocity.isfinite().all()
    assert velocity.any()


def test_a_scene_without_objects_gives_zeros_and_finite_gradients(network: VelocityNetwork) -> None:
    scenes = replace(condition(2, 4), mask=torch.tensor([[True] * 4, [False] * 4]))
    y, t = query(scenes)
    velocity: Tensor = network(y, t, Condition.of(scenes), scenes.content_ranks())
    assert not velocity[1].any()
    torch.autograd.backward(velocity.square().sum())
    assert all(p.grad is None or p.grad.isfinite().all() for p in network.parameters())


def test_fixed_objects_have_no_velocity_but_are_seen(network: VelocityNetwork) -> None:
    scenes = condition(1, 4)
    scenes = replace(scenes, is_fixed=torch.tensor([[True, False, False, False]]))
    y, t = query(scenes)
    velocity = ask(network, scenes, y, t)
    assert not velocity[0, 0].any()
    moved = replace(scenes, poses=scenes.poses + torch.tensor([[0.3, 0.0, 0.0, 0.0]] + [[0.0] * 4] * 3))
    with torch.no_grad():
        assert (network(y, t, moved, scenes.content_ranks()) - velocity)[0, 1:].abs().max() > 1e-3


@pytest.mark.parametrize("name", ["poses", "sizes", "features", "table", "zone", "is_fixed", "parent"])
def test_everything_that_conditions_matters(network: VelocityNetwork, name: str) -> None:
    scenes = replace(
        condition(1, 4), is_fixed=torch.tensor([[True, False, False, False]]), parent=torch.tensor([[-1, 0, -1, -1]])
    )
    y, t = query(scenes)
    assert scenes.features is not None
    other = {
        "features": scenes.features.flip(-1),
        "is_fixed": torch.tensor([[False] * 4]),
        "parent": torch.tensor([[-1, -2, -1, -1]]),
    }
    changed = replace(scenes, **{name: other[name] if name in other else getattr(scenes, name) * 1.3 + 0.05})
    ranks = scenes.content_ranks()
    with torch.no_grad():
        assert (network(y, t, changed, ranks) - network(y, t, scenes, ranks))[0, 1:].abs().max() > 1e-4


def test_the_support_is_found_by_index(network: VelocityNetwork) -> None:
    scenes = replace(condition(1, 4), is_fixed=torch.zeros(1, 4, dtype=torch.bool))
    y, t = query(scenes)
    by = [ask(network, replace(scenes, parent=torch.tensor([[-1, -1, -1, parent]])), y, t) for parent in (0, 1)]
    assert (by[0] - by[1])[0, 3].abs().max() > 1e-4


def test_feeding_the_clean_estimate_back_matters_even_where_it_is_zero(network: VelocityNetwork) -> None:
    scenes = condition(1, 4)
    y, t = query(scenes)
    velocities = [ask(network, scenes, y, t, fed) for fed in (None, torch.zeros_like(y), y)]
    assert (velocities[0] - velocities[1]).abs().max() > 1e-3
    assert (velocities[1] - velocities[2]).abs().max() > 1e-3


def test_whole_turns_change_nothing(network: VelocityNetwork) -> None:
    scenes = condition(2, 5)
    y, t = query(scenes)
    turn = torch.tensor([0.0, 0.0, 0.0, 2 * torch.pi])
    turned = replace(scenes, poses=scenes.poses + turn)
    found = ask(network, turned, y + turn / network.coordinates.yaw_unit, t, y - turn / network.coordinates.yaw_unit)
    torch.testing.assert_close(found, ask(network, scenes, y, t, y), atol=1e-4, rtol=0)  # 2π is rounded in float32


def test_time_is_scaled_before_the_sinusoid(network: VelocityNetwork) -> None:
    early, late, later = time_embedding(torch.tensor([0.1, 0.9, 0.901]), 32)
    assert (early - late).norm() > 1
    assert (late - later).norm() > 0.5  # a thousandth is seen: unscaled it would be 1e-3
    scenes = condition(1, 4)
    y, _ = query(scenes)
    velocities = [ask(network, scenes, y, torch.tensor([t])) for t in (0.1, 0.9)]
    assert (velocities[0] - velocities[1]).abs().max() > 1e-3


def test_an_untrained_network_moves_nothing() -> None:
    scenes = condition(2, 5)
    for backbone in BACKBONES:
        network, _ = small_settings(backbone).build()
        assert not ask(network, scenes, *query(scenes)).any()


def test_every_parameter_learns(network: VelocityNetwork) -> None:
    scenes = condition(2, 5)
    y, t = query(scenes)
    torch.autograd.backward(network(y, t, scenes, scenes.content_ranks(), y).square().sum())
    assert [name for name, p in network.named_parameters() if p.grad is None or not p.grad.any()] == []


def test_autocast_gives_nearly_the_same_in_float32(network: VelocityNetwork) -> None:
    scenes = condition(2, 5, real=4)
    y, t = query(scenes)
    exact = ask(network, scenes, y, t)
    with torch.autocast("cpu", torch.bfloat16):
        rough = ask(network, scenes, y, t)
    assert rough.dtype == torch.float32
    torch.testing.assert_close(rough, exact, atol=0.1 * exact.abs().max().item(), rtol=0)


@pytest.mark.parametrize("features", [None, torch.zeros(1, 3, 5)])
def test_features_of_another_encoder_are_refused(network: VelocityNetwork, features: Tensor | None) -> None:
    scenes = replace(condition(1, 3), features=features)
    with pytest.raises(ConfigError, match="point features"):
        ask(network, scenes, *query(scenes))


def test_a_network_without_features_reads_none() -> None:
    network = awake_network(small_settings(num_features=0))
    scenes = condition(1, 3)
    y, t = query(scenes)
    assert_same(ask(network, replace(scenes, features=None), y, t), ask(network, scenes, y, t))


@pytest.mark.parametrize(
    "changes", [{"backbone": "mlp"}, {"channels": 33}, {"levels": 0}, {"channels": 10**9}, {"heads": 2.0}, {"num_codes": -1}]
)
def test_networks_that_cannot_be_built_are_refused(changes: dict[str, object]) -> None:
    with pytest.raises(ConfigError, match=f"{next(iter(changes))} is .* expected"):
        VelocityNetworkSettings(**changes)  # type: ignore[arg-type]


def test_presets_have_the_sizes_that_are_promised() -> None:
    with torch.device("meta"):
        sizes = {name: sum(p.numel() for p in settings.build()[0].parameters()) for name, settings in PRESETS.items()}
    assert PRESETS["paper"].network.channels == 512
    assert 60e6 < sizes["paper"] < 90e6
    assert all(1e6 < sizes[name] < 3e6 for name in ("embedded", "embedded_set"))
