"""Conditions: padding cleared, ranks that do not know the order of the objects."""

from dataclasses import replace

import torch
from hypothesis import given
from hypothesis import strategies as st

from models.physics_corrector.flow.condition import Condition
from tests.models.physics_corrector.flow.conditions import condition, padded, permuted


def test_ranks_number_the_objects_and_put_padding_last() -> None:
    scenes = condition(3, 9, real=6)
    ranks = scenes.content_ranks()
    assert torch.equal(ranks.sort(1).values, torch.arange(9).expand(3, 9))
    assert (ranks[:, 6:] >= 6).all()


@given(st.permutations(range(7)))
def test_permuting_objects_permutes_their_ranks(order: list[int]) -> None:
    scenes = condition(2, 7)
    # Equal in x and y: sorting must go on to the weaker keys.
    scenes = replace(scenes, poses=scenes.poses * torch.tensor([0.0, 0.0, 1.0, 1.0]))
    assert torch.equal(permuted(scenes, torch.tensor(order)).content_ranks(), scenes.content_ranks()[:, order])


def test_ranks_ignore_whole_turns_and_rounding() -> None:
    scenes = condition(2, 7)
    level = scenes.poses * torch.tensor([0.0, 0.0, 0.0, 1.0])
    turned = level + torch.tensor([1e-7, 0.0, 0.0, 2 * torch.pi])
    assert torch.equal(replace(scenes, poses=level).content_ranks(), replace(scenes, poses=turned).content_ranks())


def test_random_ranks_are_different_within_a_scene_and_repeat_with_their_generator() -> None:
    scenes = condition(4, 30)
    first, again = (scenes.random_ranks(torch.Generator().manual_seed(5)) for _ in range(2))
    assert torch.equal(first, again)
    assert all(len(set((row % 64).tolist())) == 30 for row in first)  # injective into a table of codes that is large enough
    assert not torch.equal(first[0] - first[0].min(), first[1] - first[1].min())


def test_whatever_padding_holds_is_cleared() -> None:
    scenes = padded(condition(2, 3), 4)
    assert torch.equal(scenes.content_ranks()[:, :3], condition(2, 3).content_ranks())
    assert not scenes.poses[:, 3:].any()
    assert scenes.features is not None
    assert not scenes.features[:, 3:].any()
    assert not scenes.is_fixed[:, 3:].any()
    assert (scenes.parent[:, 3:] == -2).all()


def test_zones_of_scenes_without_one_are_cleared() -> None:
    scenes = Condition.of(condition(2, 3))
    assert scenes.zone[0].any()
    assert not scenes.zone[1].any()
