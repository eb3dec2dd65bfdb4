"""The flow against its closed form, across ±π, with what is fixed held."""

import math
from collections.abc import Callable
from dataclasses import replace

import pytest
import torch
from torch import Tensor

from models.physics_corrector.flow.condition import Condition
from models.physics_corrector.flow.flow_matching import FlowMatching, FlowSettings, Solver, Source
from models.physics_corrector.flow.pose_coordinates import PoseCoordinates
from stable_data.errors import ConfigError
from tests.models.physics_corrector.flow.conditions import (
    NUM_FEATURES,
    awake_network,
    condition,
    padded,
    permuted,
    small_settings,
)

ABSOLUTE = PoseCoordinates("absolute", 1.0, 1.0)
_SOURCES: tuple[tuple[Source, float], ...] = (("coarse", 0.5), ("gaussian", 0.0))
FLOWS = [
    FlowMatching(FlowSettings(coordinates=coordinates, source=source, self_condition=p))
    for coordinates in (PoseCoordinates(), ABSOLUTE)
    for source, p in _SOURCES
]
flows = pytest.mark.parametrize("flow", FLOWS, ids=lambda f: f"{f.settings.coordinates.form}-{f.settings.source}")


def seeded(seed: int = 3) -> torch.Generator:
    return torch.Generator().manual_seed(seed)


def targets_of(scenes: Condition, seed: int = 9) -> Tensor:
    return scenes.poses + 0.3 * torch.randn(scenes.poses.shape, generator=seeded(seed))


def assert_same_poses(found: Tensor, expected: Tensor, atol: float = 1e-4) -> None:
    torch.testing.assert_close(found[..., :3], expected[..., :3], atol=atol, rtol=0)
    turn = (found - expected)[..., 3]
    torch.testing.assert_close(torch.atan2(turn.sin(), turn.cos()), torch.zeros_like(turn), atol=atol, rtol=0)


def exact(flow: FlowMatching, targets: Tensor) -> Callable[[Tensor, Tensor, Condition, Tensor, Tensor | None], Tensor]:
    """The conditional velocity of the linear path that ends at the targets: (y_1 − y_t) / (1 − t)."""

    def velocity(y: Tensor, t: Tensor, scenes: Condition, ranks: Tensor, y1_hat: Tensor | None) -> Tensor:
        coordinates = flow.settings.coordinates
        rest = coordinates.difference(y, coordinates.encode(targets, scenes.poses))
        return torch.where(scenes.is_movable[..., None], rest / (1 - t).clamp_min(1e-9)[:, None, None], 0)

    return velocity


@flows
def test_the_path_runs_from_the_source_to_the_target(flow: FlowMatching) -> None:
    scenes = condition(2, 5)
    targets = torch.where(scenes.is_movable[..., None], targets_of(scenes), scenes.poses)
    at = [flow.path(scenes, targets, seeded(), torch.full((2,), t)) for t in (0.0, 0.5, 1.0)]
    torch.testing.assert_close(at[0].y, flow.start(scenes, seeded()))
    torch.testing.assert_close(at[1].y, (at[0].y + at[2].y) / 2)
    assert_same_poses(flow.poses(at[2].y, scenes), targets)


def test_the_source_is_the_coarse_pose_with_noise() -> None:
    scenes = replace(condition(64, 64), is_fixed=torch.zeros(64, 64, dtype=torch.bool))
    for coordinates in (PoseCoordinates(), ABSOLUTE):
        flow = FlowMatching(FlowSettings(coordinates=coordinates, sigma=0.2))
        noise = coordinates.difference(flow.start(scenes, draw=False), flow.start(scenes, seeded()))
        assert noise.mean().abs() < 0.01
        assert abs(noise.std().item() - 0.2) < 0.01
        assert_same_poses(flow.poses(flow.start(scenes, draw=False), scenes), scenes.poses)


def test_the_other_source_is_standard_gaussian() -> None:
    scenes = replace(condition(64, 64), is_fixed=torch.zeros(64, 64, dtype=torch.bool))
    start = FlowMatching(FlowSettings(source="gaussian")).start(scenes, seeded())
    assert start.mean().abs() < 0.02
    assert abs(start.std().item() - 1) < 0.02


@flows
def test_the_exact_velocity_recovers_the_target_from_anywhere(flow: FlowMatching) -> None:
    scenes = condition(3, 5)
    targets = torch.where(scenes.is_movable[..., None], targets_of(scenes), scenes.poses)
    path = flow.path(scenes, targets, seeded())
    assert_same_poses(flow.poses(flow.clean(path.y, path.t, path.velocity), scenes), targets)


@flows
@pytest.mark.parametrize("solver", ["euler", "midpoint"])
@pytest.mark.parametrize("steps", [1, 2, 7])
def test_following_the_exact_velocity_reaches_the_target_in_any_number_of_steps(
    flow: FlowMatching, solver: Solver, steps: int
) -> None:
    scenes = condition(2, 5)
    targets = torch.where(scenes.is_movable[..., None], targets_of(scenes), scenes.poses)
    found = flow.sample(exact(flow, targets), scenes, generator=seeded(), steps=steps, solver=solver)
    assert_same_poses(found, targets)
    assert (found[..., 3] > -math.pi).all()
    assert (found[..., 3] <= math.pi + 1e-6).all()


@pytest.mark.parametrize(("solver", "order"), [("euler", 1), ("midpoint", 2), ("heun", 2)])
def test_solvers_converge_with_their_order(solver: Solver, order: int) -> None:
    flow = FlowMatching(FlowSettings(coordinates=ABSOLUTE))
    scenes = replace(condition(1, 1), is_fixed=torch.zeros(1, 1, dtype=torch.bool))
    poses = torch.tensor([[[1.0, 1.0, 1.0, 0.0]]])
    scenes = replace(scenes, poses=poses)

    def growth(y: Tensor, t: Tensor, scenes: Condition, ranks: Tensor, y1_hat: Tensor | None) -> Tensor:
        return y  # e^t

    errors = [(flow.sample(growth, scenes, steps=k, solver=solver)[0, 0, 0] - math.e).abs().item() for k in (4, 8)]
    assert errors[0] / errors[1] == pytest.approx(2**order, rel=0.25)


@pytest.mark.parametrize("coordinates", [PoseCoordinates(), ABSOLUTE], ids=lambda c: c.form)
def test_a_path_crosses_half_a_turn_the_short_way(coordinates: PoseCoordinates) -> None:
    flow = FlowMatching(FlowSettings(coordinates=coordinates, sigma=0.0))
    scenes = replace(condition(1, 1), is_fixed=torch.zeros(1, 1, dtype=torch.bool))
    scenes = replace(scenes, poses=torch.tensor([[[0.5, 0.5, 0.0, math.pi - 0.1]]]))
    targets = torch.tensor([[[0.5, 0.5, 0.0, -math.pi + 0.3]]])
    path = flow.path(scenes, targets, t=torch.tensor([0.5]))
    assert path.velocity[0, 0, 3].item() * coordinates.yaw_unit == pytest.approx(0.4, abs=1e-5)
    assert flow.poses(path.y, scenes)[0, 0, 3].item() == pytest.approx(-math.pi + 0.1, abs=1e-5)
    found = flow.sample(exact(flow, targets), scenes, steps=3)
    assert found[0, 0, 3].item() == pytest.approx(-math.pi + 0.3, abs=1e-5)


@flows
@pytest.mark.parametrize("of", ["targets", "coarse"])
def test_the_loss_is_unchanged_by_whole_turns(flow: FlowMatching, of: str) -> None:
    scenes = condition(3, 5)
    targets, turn = targets_of(scenes), torch.tensor([0.0, 0.0, 0.0, 2 * math.pi])
    turned = scenes if of == "targets" else replace(scenes, poses=scenes.poses + turn)
    network = awake_network(small_settings(flow=flow.settings))

    def loss(scenes: Condition, targets: Tensor) -> float:
        path = flow.path(scenes, targets, seeded())
        return (flow.predict(network, path, scenes, seeded()).velocity - path.velocity).square().sum().item()

    assert loss(turned, targets + turn if of == "targets" else targets) == pytest.approx(loss(scenes, targets), rel=1e-4)


@flows
def test_fixed_objects_never_move(flow: FlowMatching) -> None:
    scenes = condition(4, 6)
    fixed = scenes.is_fixed
    assert fixed.any()
    path = flow.path(scenes, targets_of(scenes), seeded())
    assert not path.velocity[fixed].any()

    def push(y: Tensor, t: Tensor, scenes: Condition, ranks: Tensor, y1_hat: Tensor | None) -> Tensor:
        return torch.ones_like(y)  # a field that ignores who is fixed

    for solver in ("euler", "midpoint", "heun"):
        found = flow.sample(push, scenes, generator=seeded(), solver=solver)
        assert torch.equal(found[fixed], scenes.poses[fixed])
        assert not torch.equal(found[~fixed], scenes.poses[~fixed])
    prediction = flow.predict(push, path, scenes, seeded())
    assert torch.equal(prediction.poses[fixed], scenes.poses[fixed])


@flows
def test_targets_of_padding_are_not_looked_at(flow: FlowMatching) -> None:
    scenes = padded(condition(2, 3), 2)
    targets = torch.cat([targets_of(condition(2, 3)), torch.full((2, 2, 4), math.nan)], 1)
    path = flow.path(scenes, targets, seeded())
    assert path.y.isfinite().all()
    assert not path.velocity[:, 3:].any()


@pytest.mark.parametrize("backbone", ["unet1d", "set_transformer"])
def test_correcting_does_not_depend_on_order_or_padding(backbone: str) -> None:
    settings = small_settings(backbone, FlowSettings(steps=3))
    network, flow = awake_network(settings), FlowMatching(settings.flow)
    scenes = condition(2, 6)
    order = torch.tensor([3, 1, 5, 0, 2, 4])
    found = flow.sample(network, scenes)
    assert (found - scenes.poses)[..., :3].abs().max() > 1e-3
    # One velocity agrees to 1e-5; three in a row through a network of noise amplify the rounding.
    assert_same_poses(flow.sample(network, permuted(scenes, order)), found[:, order])
    assert_same_poses(flow.sample(network, padded(scenes, 5))[:, :6], found)


def test_self_conditioning_asks_once_without_gradient_and_feeds_the_clean_estimate_back() -> None:
    scenes = condition(2, 3)
    asked: list[tuple[Tensor | None, bool]] = []

    def field(y: Tensor, t: Tensor, scenes: Condition, ranks: Tensor, y1_hat: Tensor | None) -> Tensor:
        asked.append((y1_hat, torch.is_grad_enabled()))
        return torch.ones_like(y)

    flow = FlowMatching(FlowSettings(self_condition=1.0))
    path = flow.path(scenes, targets_of(scenes), seeded())
    flow.predict(field, path, scenes, seeded())
    assert [(fed is None, gradient) for fed, gradient in asked] == [(True, False), (False, True)]
    assert asked[1][0] is not None
    torch.testing.assert_close(asked[1][0], path.y + (1 - path.t)[:, None, None])

    generator = seeded()
    half, calls = FlowMatching(FlowSettings(self_condition=0.5)), 200
    asked.clear()
    for _ in range(calls):
        half.predict(field, path, scenes, generator)
    assert 0.4 < (len(asked) - calls) / calls < 0.6

    asked.clear()
    half.sample(field, scenes, steps=3)
    assert [fed is None for fed, _ in asked] == [True, False, False]
    asked.clear()
    FlowMatching(FlowSettings(self_condition=0.0)).sample(field, scenes, steps=3)
    assert all(fed is None for fed, _ in asked)


def test_gradients_flow_through_as_many_of_the_last_steps_as_asked() -> None:
    settings = small_settings(num_codes=0)
    network, flow = awake_network(settings), FlowMatching(settings.flow)
    scenes = condition(2, 4)
    assert not flow.sample(network, scenes).requires_grad
    norms = []
    for gradient_steps in (1, 3):
        network.zero_grad()
        torch.autograd.backward(flow.sample(network, scenes, steps=3, gradient_steps=gradient_steps).square().sum())
        norms.append(torch.cat([p.grad.flatten() for p in network.parameters() if p.grad is not None]).norm().item())
    assert norms[0] > 0
    assert norms[1] != pytest.approx(norms[0], rel=1e-3)


def test_the_gradient_through_the_sampler_is_the_difference_quotient() -> None:
    flow = FlowMatching(FlowSettings(self_condition=0.5))
    scenes = condition(1, 2)
    scale = torch.tensor(0.7, requires_grad=True)

    def field(y: Tensor, t: Tensor, scenes: Condition, ranks: Tensor, y1_hat: Tensor | None) -> Tensor:
        return scale * (torch.cos(y) + (0 if y1_hat is None else y1_hat))

    def total(gradient_steps: int) -> Tensor:
        return flow.sample(field, scenes, steps=4, gradient_steps=gradient_steps)[..., :3].double().sum()

    torch.autograd.backward(total(4))
    assert scale.grad is not None
    step = 1e-2
    with torch.no_grad():
        scale += step
        above = total(0)
        scale -= 2 * step
        quotient = (above - total(0)) / (2 * step)
    assert scale.grad.item() == pytest.approx(quotient.item(), rel=1e-2)


@pytest.mark.parametrize(
    "changes",
    [{"source": "uniform"}, {"solver": "rk4"}, {"sigma": math.nan}, {"sigma": -1.0}, {"self_condition": 1.5}, {"steps": 0}],
)
def test_flows_that_cannot_be_drawn_are_refused(changes: dict[str, object]) -> None:
    with pytest.raises(ConfigError, match=f"{next(iter(changes))} is .* expected"):
        FlowSettings(**changes)  # type: ignore[arg-type]


def discs(num_scenes: int, seed: int) -> tuple[Condition, Tensor]:
    """Two discs of radius 5 cm that overlap, and where they would touch if each gave way by half."""
    g = seeded(seed)
    angle = 2 * math.pi * torch.rand(num_scenes, 1, generator=g)
    along = torch.stack([angle.cos(), angle.sin()], -1)  # (B, 1, 2)
    middle = 0.3 + 0.4 * torch.rand(num_scenes, 1, 2, generator=g)
    apart = 0.02 + 0.06 * torch.rand(num_scenes, 1, 1, generator=g)
    sides = torch.tensor([-0.5, 0.5])[None, :, None]
    rest = torch.tensor([0.02, 0.0]).expand(num_scenes, 2, 2)
    coarse, clean = (torch.cat([middle + sides * gap * along, rest], -1) for gap in (apart, 0.1))
    lead = (num_scenes, 2)
    scenes = Condition(
        poses=coarse,
        mask=torch.ones(lead, dtype=torch.bool),
        sizes=torch.tensor([0.1, 0.1, 0.04]).expand(*lead, 3),
        is_fixed=torch.zeros(lead, dtype=torch.bool),
        parent=torch.full(lead, -1),
        table=torch.ones(num_scenes, 2),
        zone=torch.zeros(num_scenes, 4),
        has_zone=torch.zeros(num_scenes, dtype=torch.bool),
        features=torch.zeros(*lead, NUM_FEATURES),
    )
    return scenes, clean


@pytest.mark.parametrize("backbone", [pytest.param("unet1d", marks=pytest.mark.slow), "set_transformer"])
def test_a_small_network_learns_to_push_two_discs_apart(backbone: str) -> None:
    torch.manual_seed(0)
    network, flow = small_settings(backbone, FlowSettings(sigma=0.1)).build()
    generator, steps = seeded(0), 150
    optimiser = torch.optim.Adam(network.parameters(), lr=5e-3, betas=(0.9, 0.99))
    schedule = torch.optim.lr_scheduler.OneCycleLR(optimiser, 5e-3, total_steps=steps)
    scenes, clean = discs(16, 1)
    for _ in range(steps):
        path = flow.path(scenes, clean, generator)
        loss = (flow.predict(network, path, scenes, generator).velocity - path.velocity).square().mean()
        optimiser.zero_grad()
        torch.autograd.backward(loss)
        optimiser.step()
        schedule.step()
    found = flow.sample(network, scenes)
    before, after = ((poses - clean)[..., :2].norm(dim=-1).mean().item() for poses in (scenes.poses, found))
    assert after < 0.2 * before
    gaps = (found[:, 1] - found[:, 0])[:, :2].norm(dim=-1)  # the discs touch at 0.1
    assert gaps.median() > 0.095


def test_heights_that_follow_from_geometry_are_those_of_the_supports() -> None:
    settings = small_settings("set_transformer", FlowSettings(heights="geometry", steps=3))
    scenes, network, flow = condition(4, 6), awake_network(settings), FlowMatching(settings.flow)
    scenes = replace(scenes, is_fixed=torch.zeros_like(scenes.is_fixed))
    poses = flow.sample(network, scenes)
    on_table, carried = scenes.parent == -1, scenes.parent >= 0
    torch.testing.assert_close(poses[on_table][:, 2], scenes.sizes[on_table][:, 2] / 2)
    index = scenes.parent.clamp_min(0)
    above, before = (p[..., 2] - p[..., 2].gather(1, index) for p in (poses, scenes.poses))
    torch.testing.assert_close(above[carried], before[carried])
    assert (poses[..., :2] - scenes.poses[..., :2]).abs().max() > 0.01
    path = flow.path(scenes, scenes.poses + 0.1, torch.Generator().manual_seed(0))
    assert not path.velocity[..., 2].any()


def test_fixed_objects_keep_their_height() -> None:
    flow = FlowMatching(FlowSettings(heights="geometry"))
    scenes = condition(4, 6)
    standing = flow.prepared(scenes)
    assert torch.equal(standing.poses[scenes.is_fixed], scenes.poses[scenes.is_fixed])
