import math
from dataclasses import replace

import pytest
import torch
from torch import Tensor

from models.physics_corrector.geometry.scene_batch import LayoutBatch
from models.physics_corrector.training.perturbation import KINDS, Kind, PerturbationSettings, perturb, reassign_targets
from stable_data.errors import ConfigError
from tests.models.physics_corrector.geometry.shapes import RADIUS
from tests.models.physics_corrector.training.training_scenes import rows, with_fixed

ALONE = PerturbationSettings(together=0.0)
CUBE, ON_CUBE = 0, 1


def generator(seed: int = 0) -> torch.Generator:
    return torch.Generator().manual_seed(seed)


def repeated(count: int) -> LayoutBatch:
    return rows(1).take(torch.zeros(count, dtype=torch.int64))


def moves(batch: LayoutBatch, settings: PerturbationSettings, kind: Kind, seed: int = 0) -> Tensor:
    return perturb(batch, settings, generator(seed), kind).poses - batch.poses


@pytest.mark.parametrize("kind", KINDS)
def test_the_same_seed_gives_the_same_layouts_and_another_seed_others(kind: Kind) -> None:
    batch, settings = repeated(4), PerturbationSettings()
    one, again = moves(batch, settings, kind), moves(batch, settings, kind)
    assert torch.equal(one, again)
    assert not torch.equal(one, moves(batch, settings, kind, seed=1))
    assert one[batch.mask].isfinite().all()


@pytest.mark.parametrize("kind", KINDS)
def test_fixed_objects_and_padding_stay_bit_for_bit(kind: Kind) -> None:
    batch = with_fixed(repeated(64), 2)
    coarse = perturb(batch, PerturbationSettings(), generator(), kind).poses
    assert torch.equal(coarse[~batch.is_movable], batch.poses[~batch.is_movable])
    assert (coarse[batch.is_movable] != batch.poses[batch.is_movable]).any(-1).all()


def test_small_errors_have_the_moments_that_are_asked_for() -> None:
    """|N| times N has the second moment of N: the standard deviation is the scale itself."""
    moved = moves(repeated(4000), ALONE, "small")[:, :5]
    settings = PerturbationSettings()
    scale = torch.tensor([settings.small_xy, settings.small_xy, settings.small_xy / 4, settings.small_yaw])
    assert torch.allclose(moved.flatten(0, 1).std(0), scale, rtol=0.1)
    assert torch.allclose(moved.flatten(0, 1).mean(0), torch.zeros(4), atol=0.05 * float(scale.max()))


def test_large_errors_lie_between_the_scales_and_vary_from_scene_to_scene() -> None:
    moved = moves(repeated(4000), ALONE, "jitter")[:, :5]
    settings = PerturbationSettings()
    deviation = moved.flatten(0, 1).std(0)
    low, high = settings.xy_low, settings.xy_high
    assert torch.allclose(deviation[:2], torch.tensor(math.sqrt((low**2 + low * high + high**2) / 3)), rtol=0.1)
    assert torch.allclose(deviation[2], torch.tensor(settings.z_high / math.sqrt(3)), rtol=0.1)
    of_scene = moved[..., :2].flatten(1).std(1)
    assert of_scene.quantile(0.9) > 5 * of_scene.quantile(0.1)


def test_kinds_are_drawn_by_their_shares() -> None:
    settings = PerturbationSettings(small=0.5, jitter=0.25, swap=0.25, pile=0.0, height=0.0, edge=0.0)
    kinds = perturb(repeated(4000), settings, generator()).kinds
    shares = torch.bincount(kinds, minlength=len(KINDS)) / len(kinds)
    assert torch.allclose(shares, torch.tensor(settings.shares()), atol=0.03)


def still(**changed: float) -> PerturbationSettings:
    """Without jitter, so that only what the kind adds is seen."""
    return PerturbationSettings(xy_low=0.0, xy_high=0.0, z_high=0.0, yaw_low=0.0, yaw_high=0.0, **changed)


def test_two_objects_take_each_others_place_with_what_they_carry() -> None:
    batch = repeated(40)
    coarse = perturb(batch, still(together=1.0), generator(), "swap").poses
    roots = [0, 2, 3, 4]
    before, after = batch.poses[:, roots, :2], coarse[:, roots, :2]
    is_moved = (before - after).abs().sum(-1) > 1e-6
    assert torch.equal(is_moved.sum(1), torch.full((40,), 2))
    assert torch.allclose(before.sum(1), after.sum(1), atol=1e-5)
    assert torch.allclose(coarse[:, ON_CUBE, :2], coarse[:, CUBE, :2], atol=1e-5)


def test_piled_objects_lie_at_one_point() -> None:
    batch = repeated(40)
    coarse = perturb(batch, still(picked=1.0, together=1.0), generator(), "pile").poses
    roots = coarse[:, [0, 2, 3, 4], :2]
    assert torch.allclose(roots, roots[:, :1].expand_as(roots), atol=1e-5)


def test_height_sinks_or_raises_and_does_nothing_else() -> None:
    moved = moves(repeated(400), still(picked=0.5, together=0.0), "height")
    settings = PerturbationSettings()
    assert not moved[..., [0, 1, 3]].any()
    assert -settings.height_low <= float(moved[..., 2].min()) < -0.5 * settings.height_low
    assert 0.5 * settings.height_high < float(moved[..., 2].max()) <= settings.height_high


def test_objects_are_put_over_the_edge() -> None:
    batch = repeated(100)
    coarse = perturb(batch, still(picked=0.0), generator(), "edge").poses
    xy, roots = coarse[..., :2], [0, 2, 3, 4]
    margin = torch.minimum(xy, batch.table[:, None] - xy).amin(-1)[:, roots]
    is_moved = (coarse - batch.poses)[:, roots, :2].abs().sum(-1) > 1e-6
    assert torch.equal(is_moved.sum(1), torch.ones(100, dtype=torch.int64))
    assert (margin[is_moved] < 0.06).all()
    assert (margin[is_moved] < 0).float().mean() > 0.5


def test_what_is_carried_goes_along_rigidly_or_stays_behind() -> None:
    batch = repeated(30)
    coarse = perturb(batch, PerturbationSettings(together=1.0, carried=0.0), generator(), "jitter").poses
    turned = coarse[:, CUBE, 3] - batch.poses[:, CUBE, 3]
    assert torch.allclose(coarse[:, ON_CUBE, :2], coarse[:, CUBE, :2], atol=1e-5)
    assert torch.allclose(coarse[:, ON_CUBE, 2] - coarse[:, CUBE, 2], torch.full((30,), 0.05 + RADIUS), atol=1e-5)
    relative = coarse[:, ON_CUBE, 3] - batch.poses[:, ON_CUBE, 3] - turned
    assert torch.allclose(torch.cos(relative), torch.ones(30), atol=1e-5)
    coarse = perturb(batch, still(together=0.0), generator(), "swap").poses
    assert torch.equal(coarse[:, ON_CUBE], batch.poses[:, ON_CUBE])


def test_yaw_stays_in_its_range() -> None:
    coarse = perturb(repeated(500), PerturbationSettings(), generator(), "jitter").poses
    assert (coarse[..., 3].abs() <= math.pi + 1e-6).all()


def test_equal_objects_that_changed_places_have_nothing_to_correct() -> None:
    batch = repeated(1)
    swapped = batch.poses.clone()
    swapped[:, [2, 3]] = batch.poses[:, [3, 2]]
    assert torch.equal(reassign_targets(swapped, batch), swapped)
    assert torch.equal(reassign_targets(batch.poses, batch), batch.poses)


def test_objects_that_differ_or_are_fixed_or_lie_elsewhere_keep_their_own_targets() -> None:
    batch = repeated(1)
    exchanged = batch.poses.clone()
    exchanged[:, [0, 4]] = batch.poses[:, [4, 0]]  # a cube and a plate
    exchanged[:, [1, 2]] = batch.poses[:, [2, 1]]  # equal balls, on a cube and on the table
    targets = reassign_targets(exchanged, batch)
    assert torch.equal(targets, batch.poses)
    swapped = batch.poses.clone()
    swapped[:, [2, 3]] = batch.poses[:, [3, 2]]
    assert torch.equal(reassign_targets(swapped, with_fixed(batch, 2)), batch.poses)


def test_the_assignment_is_the_cheapest_of_all() -> None:
    batch = repeated(200)
    parent = batch.parent.clone()
    parent[:, ON_CUBE] = -1  # three equal balls on the table
    batch = replace(batch, parent=parent)
    coarse = perturb(batch, PerturbationSettings(), generator(), "jitter").poses
    targets = reassign_targets(coarse, batch)

    def cost(to: Tensor) -> Tensor:
        offset = to - coarse
        return (offset[..., :3].square().sum(-1) + (0.1 * torch.atan2(offset[..., 3].sin(), offset[..., 3].cos())) ** 2).sqrt()

    balls = [1, 2, 3]
    best = cost(targets)[:, balls].sum(1)
    for order in ([1, 2, 3], [1, 3, 2], [2, 1, 3], [2, 3, 1], [3, 1, 2], [3, 2, 1]):
        other = batch.poses.clone()
        other[:, balls] = batch.poses[:, order]
        assert (best <= cost(other)[:, balls].sum(1) + 1e-5).all()
    assert torch.equal(targets[:, balls].sort(1).values, batch.poses[:, balls].sort(1).values)


@pytest.mark.parametrize("changed", [{"small": -0.1}, {"picked": 1.5}, {"xy_high": math.inf}])
def test_settings_that_cannot_be_drawn_are_refused(changed: dict[str, float]) -> None:
    with pytest.raises(ConfigError, match=f"{next(iter(changed))} is .* expected"):
        PerturbationSettings(**changed)
