import pickle

import pytest

from models.semantic_reasoner.replies.checks import CheckSettings
from models.semantic_reasoner.replies.object_check import ObjectCheck
from models.semantic_reasoner.text.prompt import ReasonerQuestion
from models.semantic_reasoner.text.reply_json import LayoutObject
from stable_data.scene import Stage
from tests.models.semantic_reasoner.language.known_categories import ask, interpreter, thing

MUG, PLATE = thing("mug_0", 30, 30), thing("plate_0", 70, 30)


def refuses(*objects: LayoutObject, of: ReasonerQuestion | None = None) -> bool:
    return ObjectCheck.of_question(of or ask("Lift the mug."), interpreter(), CheckSettings())(objects)


@pytest.mark.parametrize(
    "objects",
    [
        [MUG],
        [MUG, PLATE],
        [PLATE, thing("mug_0", 70, 30, bottom=2.0)],  # on the plate
        [MUG, thing("mug_1", 30, 37.3)],  # their boxes overlap by less than 1 cm
        [MUG, thing("mug_0", 70, 30)],  # the number is that of another object, which renumbering mends
    ],
)
def test_a_good_place_is_kept(objects: list[LayoutObject]) -> None:
    assert not refuses(*objects)


@pytest.mark.parametrize(
    "objects",
    [
        [thing("mug_0", 119, 30)],  # off the table
        [PLATE, thing("mug_0", 30, 30, bottom=10.0)],  # in the air
        [MUG, thing("mug_1", 30, 30)],  # the same place
        [MUG, thing("mug_1", 33, 30)],  # deep in one another
    ],
)
def test_only_the_last_object_is_judged(objects: list[LayoutObject]) -> None:
    assert refuses(*objects)
    assert not refuses(*objects, thing("apple_0", 100, 50))


def test_the_layout_so_far_counts() -> None:
    later = ask("Lift the mug.", wanted=Stage.SECONDARY, layout=[MUG])
    assert refuses(thing("apple_0", 32, 30), of=later)
    assert not refuses(thing("apple_0", 70, 30), of=later)


def test_a_relation_is_judged_once_its_objects_are_there() -> None:
    told = ask("The mug is to the left of the plate. Lift the mug.")
    assert not refuses(thing("mug_0", 90, 30), of=told)
    assert refuses(thing("mug_0", 90, 30), PLATE, of=told)
    assert not refuses(MUG, PLATE, of=told)
    assert not refuses(thing("mug_0", 90, 30), PLATE, thing("apple_0", 20, 50), of=told)  # not of this object
    stacked = ask("The mug is on the plate. Lift the mug.")
    assert refuses(PLATE, MUG, of=stacked)
    assert not refuses(PLATE, thing("mug_0", 70, 30, bottom=2.0), of=stacked)


def test_later_stages_do_not_judge_relations() -> None:
    told = ask("The mug is to the left of the plate. Lift the mug.", wanted=Stage.SECONDARY, layout=[thing("mug_0", 90, 30)])
    assert not refuses(PLATE, of=told)


def test_a_check_goes_to_other_processes() -> None:
    check = ObjectCheck.of_question(ask("The mug is on the plate."), interpreter(), CheckSettings())
    again = pickle.loads(pickle.dumps(check))
    assert again == check
    assert len(pickle.dumps(check)) < 5_000
