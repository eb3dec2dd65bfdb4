import itertools

from hypothesis import given, settings
from hypothesis import strategies as st

from models.semantic_reasoner.language.noun_lookup import NounLookup, words_of
from models.semantic_reasoner.language.noun_phrases import find_noun_phrases, number_phrases
from models.semantic_reasoner.language.stop_words import FUNCTION_WORDS, is_verb
from stable_data.instructions.claims import StatedRelation, read_claims
from stable_data.scene import RelationKind
from tests.models.semantic_reasoner.language.known_categories import SIZES_CM, STATISTICS

NOUNS = STATISTICS.nouns


def read(text: str) -> list[tuple[str, bool]]:
    return [(m.noun, m.is_plural) for m in NOUNS.read(words_of(text))]


@settings(deadline=None)
@given(st.text())
def test_words_are_where_they_say(text: str) -> None:
    words = words_of(text)
    assert [w.text for w in words] == [text[w.start : w.end].lower() for w in words]
    assert all(a.end <= b.start for a, b in itertools.pairwise(words))


def test_words_know_what_stands_between_them() -> None:
    assert [(w.text, w.is_first) for w in words_of("Take it; the mug's lid.")] == [
        ("take", True), ("it", False), ("the", True), ("mug", False), ("s", False), ("lid", False),
    ]  # fmt: skip
    assert [w.text for w in words_of("Ask Anna. Then go") if w.is_name] == ["anna"]


def test_the_longest_noun_is_read() -> None:
    assert read("the wine glass and the glasses") == [("wine glass", False), ("glass", True)]
    assert read("serving trays, TEACUPS and table knives") == [("serving tray", True), ("teacup", True), ("table knife", True)]
    assert read("the orange cutting board") == [("cutting board", False)]
    assert read("orange, cutting, board") == [("orange", False), ("board", False)]
    assert read("the right-hand mug, the pen-holder and the penholder")[1:] == [("pen holder", False)] * 2


def test_every_category_is_called_by_its_own_words() -> None:
    for category in SIZES_CM:
        assert category in NOUNS.categories_of(category.replace("_", " "))


def test_a_noun_means_what_it_names_and_else_what_ends_in_it() -> None:
    assert NOUNS.categories_of("can") == ("can",)
    assert NOUNS.categories_of("soda can") == ("soda_can",)
    assert NOUNS.categories_of("knife") == ("table_knife",)  # which the vocabulary calls a knife
    assert NOUNS.categories_of("holder") == ("pen_holder",)
    assert set(NOUNS.categories_of("cup")) >= {"cup", "teacup"}  # which the vocabulary calls a cup too


def test_nothing_is_read_where_nothing_is_known() -> None:
    assert NounLookup(()).read(words_of("the mug")) == []


def test_phrases_are_marked_for_the_reader_of_claims() -> None:
    text = "Take the small red mug out of my large serving tray."
    words = words_of(text)
    spoken = list(find_noun_phrases(words, NOUNS))
    assert [p.modifiers for p in spoken] == [("small", "red"), ("large",)]
    assert number_phrases(text, words, spoken) == "take <0> out of <1>."
    assert read_claims(number_phrases(text, words, spoken)) == (StatedRelation(0, RelationKind.IN, 1),)


def test_verbs_are_known_in_their_forms() -> None:
    assert all(map(is_verb, ("wipe", "wipes", "wiped", "wiping", "grabbed", "grabbing", "touches", "stuck")))
    assert not any(map(is_verb, ("mug", "plates", "vintage", "beaker", "king")))


def test_no_thing_of_the_small_world_is_a_word_of_grammar() -> None:
    assert not {w for c in SIZES_CM for w in c.split("_")} & FUNCTION_WORDS - {"can"}
