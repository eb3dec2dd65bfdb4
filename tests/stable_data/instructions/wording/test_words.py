"""Words of types, one and many, lists and sentences."""

import pytest

from stable_data.instructions.wording.vocabulary import answers_to, classes_of, control_part, nouns_of
from stable_data.instructions.wording.words import is_plural, join_words, plural, sentences, type_name, type_words


@pytest.mark.parametrize(
    ("name", "words"),
    [("NestingCup", ("nesting", "cup")), ("nesting_cup", ("nesting", "cup")), ("TVRemote 2", ("tv", "remote", "2"))],
)
def test_types_and_categories_are_the_same_words(name: str, words: tuple[str, ...]) -> None:
    assert type_words(name) == words


def test_a_category_becomes_a_type() -> None:
    assert type_name("nesting_cup") == "NestingCup"


@pytest.mark.parametrize(
    ("one", "many"),
    [
        ("mug", "mugs"),
        ("table knife", "table knives"),
        ("wine glass", "wine glasses"),
        ("box", "boxes"),
        ("strawberry", "strawberries"),
        ("potato", "potatoes"),
        ("tray", "trays"),
        ("mouse", "mice"),
        ("dice", "dice"),
    ],
)
def test_several_things_of_a_kind(one: str, many: str) -> None:
    assert plural(one) == many


@pytest.mark.parametrize(
    ("noun", "many"), [("scissors", True), ("glass", False), ("cactus", False), ("box of crackers", False), ("mug", False)]
)
def test_some_single_things_are_many_to_grammar(noun: str, many: bool) -> None:
    assert is_plural(noun) is many


def test_lists_and_sentences() -> None:
    assert [join_words(x) for x in (["a"], ["a", "b"], ["a", "b", "c"])] == ["a", "a and b", "a, b and c"]
    assert sentences("take it. then go") == "Take it. Then go."
    assert sentences("could you go?") == "Could you go?"


def test_a_category_has_the_classes_of_its_longest_known_end() -> None:
    assert "drinkware" in classes_of("coffee_mug")
    assert "drinkware" not in classes_of("toothbrush_cup")
    assert "cutlery" not in classes_of("kitchen_knife")
    assert classes_of("gizmo") == frozenset()
    assert (control_part("kitchen_soap_dispenser"), control_part("gizmo")) == ("the pump", None)


def test_nouns_and_who_answers_to_them() -> None:
    assert nouns_of("mug")[:2] == ("mug", "cup")
    assert nouns_of("##") == ()
    assert answers_to("wine_glass", "glass")
    assert answers_to("mug", "cup")
    assert answers_to("nesting_cup", "cup")
    assert answers_to("wooden_blocks", "wooden block")
    assert not answers_to("cup", "nesting cup")
    assert not answers_to("saucer", "cup")
