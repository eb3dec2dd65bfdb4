import math

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from models.physics_corrector.geometry.scene_batch import LayoutBatch
from models.physics_corrector.training.movement_losses import _linked, movement_loss, order_loss
from stable_data.scene import RelationKind
from stable_data.scene_graph.relations import scene_graph
from tests.models.physics_corrector.geometry.shapes import RADIUS, SIDE, batch_of, scene, thing
from tests.models.physics_corrector.training.training_scenes import rows, with_fixed

BATCH = rows(3)


def test_a_layout_that_stays_costs_nothing() -> None:
    assert movement_loss(BATCH.poses, BATCH.poses, BATCH).tolist() == [0.0] * 3
    assert order_loss(BATCH.poses, BATCH.poses, BATCH).tolist() == [0.0] * 3


@pytest.mark.parametrize(("shift", "turn"), [((0.3, 0.4), 0.0), ((0.0, 0.0), 2.0), ((-0.3, 0.0), -2.0)])
def test_movement_is_length_and_turn_but_for_the_ease(shift: tuple[float, float], turn: float) -> None:
    poses = BATCH.poses.clone()
    poses[1, 2] += torch.tensor([*shift, 0.0, turn])
    moved = movement_loss(poses, BATCH.poses, BATCH)
    assert moved[1] == pytest.approx(math.hypot(*shift, 0.1 * turn), abs=2e-3)
    assert moved[[0, 2]].tolist() == [0.0, 0.0]


def test_a_whole_turn_and_a_height_cost_nothing() -> None:
    poses = BATCH.poses + torch.tensor([0.0, 0.0, 0.2, 2 * math.pi])
    assert movement_loss(poses, BATCH.poses, BATCH).tolist() == pytest.approx([0.0] * 3, abs=1e-6)


def test_what_is_fixed_or_padding_does_not_move() -> None:
    poses = BATCH.poses.clone()
    poses[:, [2, 5]] += 1.0
    assert movement_loss(poses, BATCH.poses, with_fixed(BATCH, 2)).tolist() == [0.0] * 3


def test_movement_does_not_care_who_goes() -> None:
    """Far from zero one that goes all the way costs what two cost that go half of it."""
    one, two = BATCH.poses.clone(), BATCH.poses.clone()
    one[:, 2, 0] += 0.8
    two[:, 2:4, 0] += 0.4
    assert movement_loss(one, BATCH.poses, BATCH) == pytest.approx(movement_loss(two, BATCH.poses, BATCH), abs=3e-3)


def balls(*places: tuple[float, float]) -> LayoutBatch:
    return batch_of([scene(*(thing(f"ball_{n}", (x, y, RADIUS, 0.0)) for n, (x, y) in enumerate(places)))])[0]


def test_an_order_is_missed_from_the_margin_on() -> None:
    batch = balls((0.2, 0.2), (0.4, 0.22))  # holds by 180 mm
    poses = batch.poses.clone()
    for step, missing in ((0.17, 0.0), (0.175, 0.0), (0.18, 0.005), (0.2, 0.025)):
        poses[0, 0, 0] = batch.poses[0, 0, 0] + step
        assert order_loss(poses, batch.poses, batch).tolist() == pytest.approx([missing**2], abs=1e-7)


def test_what_held_by_less_is_asked_for_no_more() -> None:
    batch = balls((0.2, 0.2), (0.3, 0.299))  # holds by 1 mm
    poses = batch.poses.clone()
    poses[0, 1, 0] -= 0.001
    assert order_loss(poses, batch.poses, batch).tolist() == pytest.approx([1e-6], abs=1e-8)


def test_what_carries_another_has_no_order_with_it() -> None:
    layout = scene(
        thing("cube", (0.5, 0.5, SIDE / 2, 0.0), support="table"), thing("ball_1", (0.51, 0.5, SIDE, 0.0), support="cube")
    )
    batch = batch_of([layout])[0]
    poses = batch.poses.clone()
    poses[0, 1, 0] -= 0.05
    assert order_loss(poses, batch.poses, batch).tolist() == [0.0]


PLACE = st.tuples(st.integers(10, 90), st.integers(10, 70))


@settings(max_examples=30, deadline=None)
@given(st.lists(PLACE, min_size=2, max_size=7, unique=True))
def test_pairs_are_those_of_the_scene_graph(places: list[tuple[int, int]]) -> None:
    """Where distances tie the graph takes the first of them, and where x and y do neither side is named."""
    spread = [(0.01 * x + 1e-4 * n, 0.01 * y + 3e-5 * n * n) for n, (x, y) in enumerate(places)]
    layout = scene(*(thing(f"ball_{n}", (x, y, RADIUS, 0.0)) for n, (x, y) in enumerate(spread)))
    kinds = {RelationKind.LEFT_OF, RelationKind.RIGHT_OF, RelationKind.IN_FRONT_OF, RelationKind.BEHIND}
    wanted = {frozenset((s, t)) for s, t, kind in scene_graph(layout, {}).edges(keys=True) if kind in kinds}
    batch = batch_of([layout])[0]
    _, first, second = _linked(batch.poses.double(), batch)
    linked = {frozenset((f"ball_{i}", f"ball_{j}")) for i, j in zip(first.tolist(), second.tolist(), strict=True)}
    assert linked == wanted
