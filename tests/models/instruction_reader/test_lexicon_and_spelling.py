"""Nouns of categories, and words with typing errors."""

import pytest
from hypothesis import given
from hypothesis import strategies as st

from models.instruction_reader.frames import read_texts
from models.instruction_reader.lexicon import Lexicon
from models.instruction_reader.nouns import read_nouns
from models.instruction_reader.sentences import split_words
from models.instruction_reader.spelling import Spelling

NOUNS = read_nouns()
LEXICON = Lexicon.of(NOUNS, NOUNS.nouns)
SPELLING = Spelling.of(read_texts(), NOUNS, {"beautiful", "paperclip"})


def test_a_category_is_found_by_each_of_its_nouns() -> None:
    for category, nouns in NOUNS.nouns.items():
        for noun in nouns:
            assert category in LEXICON.categories(split_words(noun))


@pytest.mark.parametrize(
    ("phrase", "category"),
    [
        ("my red coffee mug", "mug"),
        ("two wine glasses", "wine_glass"),
        ("tisue box", "tissue_box"),
        ("puzzle cub", "puzzle_cube"),
        ("mug of hot tea", "mug"),
        ("tv remote", "remote_control"),
        ("scissors", "scissors"),
    ],
)
def test_the_end_of_a_phrase_decides(phrase: str, category: str) -> None:
    assert category in LEXICON.categories(SPELLING.mend(phrase.split()))


@pytest.mark.parametrize("phrase", ["stethoscope", "pan flute", "", "x", "of"])
def test_what_is_unknown_has_no_category(phrase: str) -> None:
    assert LEXICON.categories(phrase.split()) == ()


def test_a_lexicon_holds_the_categories_that_it_is_given() -> None:
    small = Lexicon.of(NOUNS, ["mug", "cat_tree"])
    assert small.categories(["cat", "tree"]) == ("cat_tree",)
    assert small.categories(["bowl"]) == ()


@pytest.mark.parametrize(
    ("wrong", "right"),
    [
        ("scisors", "scissors"),
        ("teh", "the"),
        ("behnd", "behind"),
        ("candels", "candles"),
        ("moniter", "monitor"),
        ("notbok", "notebook"),
    ],
)
def test_typing_errors_are_mended(wrong: str, right: str) -> None:
    assert SPELLING.mend([wrong]) == [right]


@pytest.mark.parametrize(
    "word", ["beautiful", "paperclips", "theyre", "mug", "mugs", "42", "qzxwvj", "cub", "stacked", "peonies", "!"]
)
def test_other_words_stay(word: str) -> None:
    assert SPELLING.mend([word]) == [word]


@given(st.lists(st.text(max_size=12), max_size=8))
def test_any_words_can_be_mended_and_looked_up(words: list[str]) -> None:
    assert len(SPELLING.mend(words)) == len(words)
    assert isinstance(LEXICON.categories(words), tuple)


@pytest.mark.parametrize("phrase", ["loo roll", "music box", "tabletop", "the old tool box"])
def test_a_compound_need_not_be_what_its_last_word_is(phrase: str) -> None:
    assert LEXICON.categories(phrase.split()) == ()
    assert LEXICON.is_unknown(phrase.split())


@pytest.mark.parametrize(
    ("phrase", "category"),
    [
        ("a little cup of egg", "egg_cup"),
        ("wooden cup for a boiled egg", "egg_cup"),
        ("slice of cake", "cake"),
        ("monitor base", "monitor"),
        ("can of peaches", "can"),
        ("saucr", "saucer"),
    ],
)
def test_a_phrase_is_what_its_words_together_mean(phrase: str, category: str) -> None:
    assert category in LEXICON.categories(SPELLING.mend(phrase.split()))


def test_contents_say_what_holds_them() -> None:
    assert LEXICON.of_contents(["pot"], ["makeup", "brushes"]) == ("brush_holder",)
    assert LEXICON.of_contents(["pot"], ["potatoes"]) == ()
    assert LEXICON.of_contents(["egg", "cup"], ["brushes"]) == ()  # its noun says it


def test_the_last_word_of_a_category_is_its_name() -> None:
    assert LEXICON.is_name("mugs")
    assert LEXICON.is_noun("coffee")
    assert not LEXICON.is_name("coffee")


def test_usual_categories_of_a_noun() -> None:
    found = LEXICON.categories(["tray"])
    assert {"serving_tray", "decor_tray", "oven_dish"} <= {*found}
    assert {*LEXICON.usual(["dusty", "tray"], found)} == {"serving_tray", "decor_tray"}
    assert LEXICON.usual(["jug"], LEXICON.categories(["jug"])) == ("pitcher",)
    assert LEXICON.usual(["jugs"], LEXICON.categories(["jugs"])) == ("pitcher",)
    assert LEXICON.usual(["violin"], ("tray",)) == ("tray",)


def test_plurals_that_mean_one_object() -> None:
    one = {noun: LEXICON.is_one_thing([noun], LEXICON.categories([noun])) for noun in ("scales", "cornflakes", "mugs", "pens")}
    assert one == {"scales": True, "cornflakes": True, "mugs": False, "pens": False}


def test_a_size_is_no_part_of_a_noun() -> None:
    assert {*LEXICON.categories(["small", "plate"])} == {"saucer", "plate"}
    assert LEXICON.categories(["side", "plate"]) == LEXICON.categories(["plate"])


def test_letters_in_another_order_are_mended() -> None:
    assert SPELLING.mend(["pichter", "cuter"]) == ["pitcher", "cuter"]
