import pytest
import torch

from models.physics_corrector.training.losses import physics_losses
from models.physics_corrector.training.stage_prefixes import PrefixSettings, drop_empty_slots, prefix, take_prefix
from stable_data.errors import ConfigError
from tests.models.physics_corrector.training.training_scenes import STAGES, training_set

DATA = training_set()
WHOLE = DATA.batch
NONE, ALL = torch.zeros(len(WHOLE), dtype=torch.bool), torch.ones(len(WHOLE), dtype=torch.bool)


def last(stage: int) -> torch.Tensor:
    return torch.full((len(WHOLE),), stage)


@pytest.mark.parametrize("stage", [0, 1, 2])
def test_a_prefix_holds_its_stages_and_the_earlier_ones(stage: int) -> None:
    part = prefix(WHOLE, DATA.stage, last(stage), NONE)
    assert torch.equal(part.mask[:, :5], STAGES.le(stage).expand(len(WHOLE), 5))
    assert not part.is_fixed.any()
    assert not part.mask[:, 5].any()


def test_earlier_stages_can_be_fixed_and_the_last_never_is() -> None:
    part = prefix(WHOLE, DATA.stage, last(2), ALL)
    assert torch.equal(part.is_fixed[:, :5], (STAGES < 2).expand(len(WHOLE), 5))
    assert not prefix(WHOLE, DATA.stage, last(0), ALL).is_fixed.any()


def test_where_a_stage_adds_nothing_everything_may_move() -> None:
    stage = DATA.stage.clone()
    stage[stage == 1] = 0
    part = prefix(WHOLE, stage, last(1), ALL)
    assert part.is_movable.any(1).all()
    assert not part.is_fixed.any()


def test_an_empty_prefix_and_an_unstaged_scene_are_whole() -> None:
    later = torch.where(DATA.stage >= 0, 2, -1)
    assert torch.equal(prefix(WHOLE, later, last(0), NONE).mask, WHOLE.mask)
    assert torch.equal(prefix(WHOLE, torch.full_like(DATA.stage, -1), last(0), ALL).mask, WHOLE.mask)


def test_shares_are_kept() -> None:
    batch, stage = WHOLE.take(torch.zeros(4000, dtype=torch.int64)), DATA.stage[:1].expand(4000, -1)
    part = take_prefix(batch, stage, PrefixSettings(0.2, 0.3, 0.5), torch.Generator().manual_seed(0))
    shares = [float((part.mask.sum(1) == count).float().mean()) for count in (1, 3, 5)]
    assert shares == pytest.approx([0.2, 0.3, 0.5], abs=0.03)
    assert float(part.is_fixed.any(1).float().mean()) == pytest.approx(0.8 * 0.5, abs=0.03)


def test_compacting_changes_nothing_but_the_padding() -> None:
    stage = DATA.stage.clone()
    stage[:, 0], stage[:, 3] = 2, 0  # a gap in front
    part = prefix(WHOLE, stage, last(1), NONE)
    small = drop_empty_slots(part)
    assert small.mask.shape[1] == int(part.mask.sum(1).max()) < part.mask.shape[1]
    assert torch.equal(small.poses[small.mask], part.poses[part.mask])
    assert torch.equal(drop_empty_slots(small).poses, small.poses)
    before, after = (physics_losses(b.poses, b, DATA.geometry) for b in (part, small))
    assert torch.allclose(before.support, after.support)
    whole = drop_empty_slots(WHOLE)
    carried = whole.parent[whole.mask] >= 0
    assert int(carried.sum()) == len(WHOLE)
    assert (whole.parent[:, 1] == 0).all()


def test_parents_follow_their_objects() -> None:
    stage = DATA.stage.clone()
    stage[:, :2], stage[:, 2:5] = 1, 2
    mask = WHOLE.mask.clone()
    part = prefix(WHOLE, stage, last(1), NONE)
    assert (part.parent[:, 1] == 0).all()
    stage[:, 0] = 2  # the carrier is gone: what it carried stands on nothing
    assert (prefix(WHOLE, stage, last(1), NONE).parent[:, 1] == -2).all()
    assert torch.equal(mask, WHOLE.mask)


def test_shares_that_cannot_be_are_refused() -> None:
    with pytest.raises(ConfigError, match="prefixes"):
        PrefixSettings(task=0.7, important=0.5)
