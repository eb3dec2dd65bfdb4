"""Scenes as padded tensors."""

import torch

from models.physics_corrector.geometry.scene_batch import LayoutBatch
from models.physics_corrector.geometry.scene_tensors import NO_PARENT, ON_TABLE
from tests.models.physics_corrector.geometry.shapes import batch_of, scene, table, thing

SMALL = scene(thing("ball", (0.1, 0.2, 0.05, 0.3), support="table"))
LARGE = scene(
    thing("ball_1", (0.5, 0.5, 0.2, 1.0), support="bowl"),
    thing("bowl", (0.5, 0.5, 0.04, 0.0), support="table"),
    thing("cube", (0.2, 0.2, 0.05, -1.0), support="gone"),
    zone=(0.0, 0.1, 0.2, 0.3),
)


def test_a_scene_is_as_it_was_and_the_rest_is_padding() -> None:
    batch, geometry = batch_of([SMALL, LARGE], is_fixed=lambda o: o.category == "bowl")
    assert batch.mask.tolist() == [[True, False, False], [True, True, True]]
    torch.testing.assert_close(batch.poses[1], torch.from_numpy(LARGE.poses()).float())
    assert batch.poses[0, 1:].abs().sum() == 0
    torch.testing.assert_close(batch.sizes[1, 2], torch.full((3,), 0.1))
    assert batch.parent.tolist() == [[ON_TABLE, NO_PARENT, NO_PARENT], [1, ON_TABLE, NO_PARENT]]
    assert batch.is_movable.tolist() == [[True, False, False], [True, False, True]]
    assert batch.has_zone.tolist() == [False, True]
    torch.testing.assert_close(batch.zone, torch.tensor([[0.0, 0.0, 0.0, 0.0], [0.0, 0.1, 0.2, 0.3]]))
    torch.testing.assert_close(batch.table, torch.tensor([[1.0, 0.8], [1.0, 0.8]]))
    assert batch.shape_index[0, 0] == batch.shape_index[1, 0]
    assert batch.shape_index.max() < len(geometry)


def test_minibatches_are_cut_by_index_and_by_mask() -> None:
    batch, _ = batch_of([SMALL, LARGE])
    by_index, by_mask = batch.take(torch.tensor([1])), batch.take(torch.tensor([False, True]))
    assert len(by_index) == len(by_mask) == 1
    torch.testing.assert_close(by_index.poses, by_mask.poses)
    assert by_index.features is None


def test_there_may_be_more_slots_than_objects_and_no_scene_at_all() -> None:
    assert batch_of([SMALL, LARGE], num_slots=7)[0].mask.shape == (2, 7)
    assert LayoutBatch.from_scenes([], table(), num_slots=4).poses.shape == (0, 4, 4)
    assert LayoutBatch.from_scenes([scene()], table()).poses.shape == (1, 0, 4)
