"""Both methods: order, padding and whole turns mean nothing; a network that knows the truth leads to it."""

from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import pytest
import torch
from torch import Tensor

from models.physics_corrector.flow.condition import Condition
from models.physics_corrector.flow.flow_matching import Velocity
from models.physics_corrector.flow.pose_coordinates import PoseCoordinates, wrap_angle
from models.rearrangement.noise_schedule import NoiseSchedule
from models.rearrangement.scene_noise import SceneNoise
from models.rearrangement.settings import METHODS, LegoNetSettings, Method, RearrangerSettings, StructDiffusionSettings
from models.rearrangement.weights import method_of
from stable_data.errors import ConfigError
from tests.models.physics_corrector.flow.conditions import condition, padded, permuted
from tests.models.rearrangement.rearrangers import awake, small

TOLERANCE = 2e-3  # metres and radians: weights of random sign and size make large motions of rounding errors


@torch.no_grad()
def moved(settings: RearrangerSettings, network: Velocity, scenes: Condition, seeds: Sequence[int] = (5, 6, 7)) -> Tensor:
    return method_of(settings).sample(network, scenes, SceneNoise(scenes, seeds[: len(scenes)]))


def assert_same(found: Tensor, expected: Tensor, start: Tensor) -> None:
    assert (expected - start).abs().max() > 0.05  # it does something
    torch.testing.assert_close(found[..., :3], expected[..., :3], atol=TOLERANCE, rtol=0)
    assert wrap_angle(found[..., 3] - expected[..., 3]).abs().max() < TOLERANCE


@pytest.mark.parametrize("method", METHODS)
def test_permuting_objects_permutes_poses(method: Method) -> None:
    settings, scenes = small(method), condition(3, 7, real=6)
    network, order = awake(settings), torch.randperm(7, generator=torch.Generator().manual_seed(2))
    wanted = moved(settings, network, scenes)[:, order]
    assert_same(moved(settings, network, permuted(scenes, order)), wanted, scenes.poses[:, order])


@pytest.mark.parametrize("method", METHODS)
def test_padding_and_other_scenes_leak_nothing(method: Method) -> None:
    settings, scenes = small(method), condition(3, 5)
    network = awake(settings)
    alone = moved(settings, network, scenes)
    crowd = moved(settings, network, padded(scenes, 4))
    assert_same(crowd[:, :5], alone, scenes.poses)
    assert not crowd[:, 5:].any()
    one = scenes.take(torch.tensor([1]))
    assert_same(moved(settings, network, one, [6]), alone[1:2], one.poses)


@pytest.mark.parametrize("method", METHODS)
def test_whole_turns_change_nothing(method: Method) -> None:
    settings, scenes = small(method), condition(2, 5)
    network = awake(settings)
    turned = replace(scenes, poses=scenes.poses + torch.tensor([0.0, 0.0, 0.0, 2 * torch.pi]))
    assert_same(moved(settings, network, turned), moved(settings, network, scenes), scenes.poses)


@pytest.mark.parametrize("method", METHODS)
def test_fixed_objects_and_heights_of_geometry_stay(method: Method) -> None:
    settings, scenes = small(method), condition(2, 5)
    fixed = torch.tensor([[True, False, False, False, False]] * 2)
    scenes = replace(scenes, is_fixed=fixed, parent=torch.full_like(scenes.parent, -1))
    found = moved(settings, awake(settings), scenes)
    assert torch.equal(found[:, 0], scenes.poses[:, 0])
    assert torch.equal(found[:, 1:, 2], scenes.sizes[:, 1:, 2] / 2)  # they stand on the table
    learned = moved(replace(settings, heights="learned"), awake(settings), scenes)
    assert (learned[:, 1:, 2] - scenes.poses[:, 1:, 2]).abs().min() > 1e-4


@pytest.mark.parametrize("method", METHODS)
def test_the_seed_of_a_scene_decides(method: Method) -> None:
    settings, scenes = small(method), condition(2, 4)
    network = awake(settings)
    first, again, other = (moved(settings, network, scenes, seeds) for seeds in ((1, 2), (1, 2), (1, 3)))
    assert torch.equal(first, again)
    assert torch.equal(first[0], other[0])
    assert not torch.equal(first[1], other[1])


@pytest.mark.parametrize("method", METHODS)
def test_the_loss_is_0_for_a_network_that_knows_and_it_has_gradients_else(method: Method) -> None:
    settings = small(method)
    clean, coarse = condition(2, 4), condition(2, 4, seed=1)
    coarse = replace(coarse, is_fixed=torch.zeros_like(coarse.is_fixed))
    oracle = Oracle(settings, clean.poses)
    generator = torch.Generator().manual_seed(0)
    assert method_of(settings).loss(oracle, coarse, clean.poses, generator).item() == pytest.approx(0, abs=1e-6)
    network = awake(settings)
    loss = method_of(settings).loss(network, coarse, clean.poses, generator)
    loss.backward()  # type: ignore[no-untyped-call]
    assert loss > 0.1
    assert all(p.grad is not None for p in network.head.parameters())


@dataclass
class Oracle:
    """Says what a perfect network would: the displacement to the clean poses, or the noise in noisy ones."""

    settings: RearrangerSettings
    clean: Tensor
    asked: list[Condition] = field(default_factory=list)

    def __call__(self, y: Tensor, t: Tensor, scenes: Condition, ranks: Tensor, y1_hat: Tensor | None) -> Tensor:
        self.asked.append(scenes)
        target = self.settings.coordinates.encode(self.clean, scenes.poses)
        if self.settings.method == "lego_net":
            return target
        own = self.settings.struct_diffusion
        signal = NoiseSchedule.of(own.times, own.schedule).signal[(t * own.times).round().long()][:, None, None]
        return ((y - signal.sqrt() * target) / (1 - signal).sqrt()).float()


def on_table(scenes: Condition) -> Condition:
    scenes = replace(scenes, is_fixed=torch.zeros_like(scenes.is_fixed), parent=torch.full_like(scenes.parent, -1))
    return scenes.standing()


def distances(poses: Tensor, clean: Tensor) -> tuple[Tensor, Tensor]:
    return (poses - clean)[..., :3].norm(dim=-1), wrap_angle((poses - clean)[..., 3]).abs()


def test_lego_net_ends_where_the_network_sees_no_displacement() -> None:
    settings = replace(small("lego_net"), lego_net=LegoNetSettings())
    clean = on_table(condition(2, 4))
    clean.poses[0, 0, 3], start = 3.1, clean.poses.clone()
    start[..., :2] += 0.1
    start[..., 3] += 0.3  # past π
    oracle = Oracle(settings, clean.poses)
    found = moved(settings, oracle, replace(clean, poses=start))
    lengths, turns = distances(found, clean.poses)
    assert lengths.mean(1).max() < settings.lego_net.still
    assert turns.mean(1).max() < settings.lego_net.still_yaw
    assert 10 < len(oracle.asked) < settings.lego_net.max_steps
    assert torch.equal(oracle.asked[0].poses, start)


def test_a_layout_that_is_still_does_not_move() -> None:
    settings = replace(small("lego_net"), lego_net=LegoNetSettings(still_steps=1))
    clean = on_table(condition(1, 4))
    oracle = Oracle(settings, clean.poses)
    assert torch.equal(moved(settings, oracle, clean), clean.poses)
    assert len(oracle.asked) == 1
    noisy = replace(settings, lego_net=LegoNetSettings(still_steps=3, noise=0.02))
    oracle.asked.clear()
    moved(noisy, oracle, clean)
    assert len(oracle.asked) > 3  # the noise of the first steps moved it


@pytest.mark.parametrize("sampler", ["ancestral", "ddim"])
@pytest.mark.parametrize("steps", [0, 1, 4])
def test_a_diffusion_that_knows_the_noise_gives_the_clean_poses(sampler: str, steps: int) -> None:
    own = StructDiffusionSettings(times=20, sampler=sampler, steps=steps)  # type: ignore[arg-type]
    settings = replace(small("struct_diffusion"), struct_diffusion=own)
    clean, coarse = on_table(condition(2, 4)), on_table(condition(2, 4, seed=1))
    clean = replace(clean, sizes=coarse.sizes).standing()  # the same heights
    found = moved(settings, Oracle(settings, clean.poses), coarse)
    lengths, turns = distances(found, clean.poses)
    assert lengths.max() < 1e-3
    assert turns.max() < 1e-3


def test_a_diffusion_reaches_the_other_end_of_a_table_and_a_half_turn() -> None:
    settings = replace(small("struct_diffusion"), struct_diffusion=StructDiffusionSettings(times=20))
    clean = on_table(condition(1, 3))
    start = clean.poses.clone()
    start[..., 0] += 1.5
    start[..., 3] += 3.0
    found = moved(settings, Oracle(settings, clean.poses), replace(clean, poses=start))
    lengths, turns = distances(found, clean.poses)
    assert lengths.max() < 1e-3
    assert turns.max() < 1e-3


def test_a_diffusion_leaves_nothing_beyond_the_table_whatever_the_network_says() -> None:
    settings, scenes = replace(small("struct_diffusion"), heights="learned"), on_table(condition(2, 4))
    found = moved(settings, lambda y, *_: torch.full_like(y, -5.0), scenes)
    assert (found[..., :2] >= -1e-5).all()
    assert (found[..., :2] <= scenes.table[:, None] + 1e-5).all()
    assert (found[..., 2] <= scenes.table.max() + 1e-5).all()


def test_what_the_methods_cannot_use_is_refused() -> None:
    with pytest.raises(ConfigError, match="expected residual"):
        replace(small("lego_net"), coordinates=PoseCoordinates("absolute"))
    with pytest.raises(ConfigError, match="reads_errors is true, expected false for lego_net"):
        small("lego_net", reads_errors=True)
