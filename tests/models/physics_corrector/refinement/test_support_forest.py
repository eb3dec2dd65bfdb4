"""Which object carries which, over several scenes."""

from dataclasses import replace

import torch

from models.physics_corrector.refinement.support_forest import SupportForest
from tests.models.physics_corrector.geometry.shapes import scene, thing
from tests.models.physics_corrector.refinement.layouts import problem_of

STACK = scene(
    thing("plate", (0.3, 0.3, 0.005, 0), support="table"),
    thing("cube", (0.3, 0.3, 0.06, 0), support="plate"),
    thing("ball", (0.3, 0.3, 0.16, 0), support="cube"),
)
ALONE = scene(thing("cube", (0.3, 0.3, 0.05, 0)))


def test_supports_are_chains_of_flat_indices() -> None:
    forest = problem_of(ALONE, STACK).forest
    assert forest.parent.tolist() == [0, 1, 2, 3, 3, 4]  # two slots of padding, then the stack
    assert forest.root.tolist() == [0, 1, 2, 3, 3, 3]
    assert forest.level.tolist() == [0, 0, 0, 0, 1, 2]
    assert forest.carries(torch.tensor([3, 4, 5, 0]), torch.tensor([5, 5, 4, 5])).tolist() == [True, True, False, False]


def test_the_nearest_marked_object_of_a_chain() -> None:
    forest = problem_of(STACK).forest
    assert forest.nearest(torch.tensor([False, True, False])).tolist() == [-1, 1, 1]
    assert forest.nearest(torch.tensor([True, False, True])).tolist() == [0, 0, 2]


def test_supports_in_a_circle_stand_on_the_table() -> None:
    layout = problem_of(STACK).layout
    circle = replace(layout, parent=torch.tensor([[2, 0, 1]]))
    forest = SupportForest.of(circle)
    assert forest.level.tolist() == [0, 0, 0]
