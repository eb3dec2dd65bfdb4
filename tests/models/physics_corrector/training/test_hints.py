from dataclasses import replace

import torch

from models.physics_corrector.geometry.scene_batch import LayoutBatch
from models.physics_corrector.training.hints import HintSettings, give_hints
from tests.models.physics_corrector.training.training_scenes import rows

ALL = HintSettings(errors=1.0, order=1.0, pairs=1.0, features=1.0, texts=1.0)
NONE = HintSettings(errors=0.0, order=0.0, features=0.0, texts=0.0)


def batch(count: int = 200) -> LayoutBatch:
    found = rows(1).take(torch.zeros(count, dtype=torch.int64))
    lead = found.mask.shape
    return replace(found, features=torch.ones(*lead, 3), texts=torch.ones(*lead, 2), table_text=torch.ones(count, 2))


def hints(settings: HintSettings, seed: int = 0) -> LayoutBatch:
    scenes = batch()
    error = torch.full((len(scenes), 2), 0.05)
    return give_hints(scenes, scenes.poses, error, settings, torch.Generator().manual_seed(seed))


def test_what_is_told_is_told_whole_and_what_is_withheld_not_at_all() -> None:
    told, withheld = hints(ALL), hints(NONE)
    assert told.error is not None
    assert (told.error == 0.05).all()
    assert withheld.error is not None
    assert withheld.error.isnan().all()
    for name in ("features", "texts", "table_text"):
        assert (getattr(told, name) == 1).all()
        assert (getattr(withheld, name) == 0).all()
    assert withheld.order is not None
    assert not withheld.order.any()


def test_directions_are_true_and_told_in_both_ways() -> None:
    told = hints(ALL)
    assert told.order is not None
    assert told.order.any()
    assert torch.equal(told.order, -told.order.transpose(1, 2))
    apart = told.poses[:, None, :, :2] - told.poses[:, :, None, :2]
    is_known = told.order != 0
    assert (told.order.sign()[is_known] == apart.sign()[is_known]).all()
    assert (apart.abs()[is_known] > apart.flip(-1).abs()[is_known]).all()
    assert not told.order[~(told.mask[:, :, None] & told.mask[:, None])].any()


def test_shares_are_those_that_are_asked_for() -> None:
    half = hints(HintSettings(errors=0.5, order=0.5, pairs=1.0, features=0.5, texts=0.5))
    assert half.error is not None
    assert half.features is not None
    assert half.texts is not None
    assert half.order is not None
    assert 0.35 < float(half.error[:, 0].isfinite().float().mean()) < 0.65
    assert 0.35 < float(half.features[:, 0, 0].mean()) < 0.65
    assert 0.4 < float(half.texts[..., 0].mean()) < 0.6
    assert 0.3 < float(half.order.flatten(1).any(1).float().mean()) < 0.6
