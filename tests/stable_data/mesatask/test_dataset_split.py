"""Splits: shares are met, a group stays where it is, and what nobody trains on is unseen."""

from dataclasses import replace

import pytest

from stable_data.mesatask import TABLE_TYPES
from stable_data.mesatask.dataset_split import SplitShares, split_of
from stable_data.mesatask.near_duplicates import duplicate_group
from stable_data.scene import Scene, SceneObject, Tabletop

GROUPS = [f"{k:016x}" for k in range(4000)]


def test_the_shares_are_met() -> None:
    shares = SplitShares(train=0.7, validation=0.2)
    found = [split_of(group, TABLE_TYPES[0], shares) for group in GROUPS]
    for name, share in (("train", 0.7), ("validation", 0.2), ("test", 0.1)):
        assert found.count(name) / len(GROUPS) == pytest.approx(share, abs=0.03)


def test_more_training_takes_no_group_from_it_and_another_seed_deals_anew() -> None:
    small, large = ({g for g in GROUPS if split_of(g, TABLE_TYPES[0], SplitShares(train=t)) == "train"} for t in (0.5, 0.8))
    assert small < large
    assert small != {g for g in GROUPS if split_of(g, TABLE_TYPES[0], SplitShares(1, 0.5)) == "train"}


def test_a_type_of_table_that_is_not_trained_on_is_unseen() -> None:
    assert {split_of(group, "workbench", SplitShares(train=1.0)) for group in GROUPS[:50]} == {"unseen"}


def test_near_duplicates_share_a_group_wherever_their_objects_stand() -> None:
    cup = SceneObject("0_cup_0", "cup", (0.2, 0.2, 0.05), 0.0, (0.1, 0.1, 0.1), "a" * 32)
    fork = SceneObject("1_fork_0", "fork", (0.5, 0.2, 0.01), 1.0, (0.02, 0.2, 0.02), "b" * 32)
    scene = Scene("one", Tabletop("office_table", (1.2, 0.6)), (cup, fork))
    elsewhere = replace(scene, scene_id="two", objects=(fork, cup.moved((0.7, 0.3, 0.05), 0.3)))
    assert duplicate_group(scene) == duplicate_group(elsewhere)
    for other in (
        replace(scene, objects=(cup,)),
        replace(scene, objects=(replace(cup, asset_id="c" * 32), fork)),
        replace(scene, table=replace(scene.table, table_type="dining_table")),
    ):
        assert duplicate_group(other) != duplicate_group(scene)
