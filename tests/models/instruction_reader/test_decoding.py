"""From scores to a reading; the scores are those of a network that is certain."""

import numpy as np
import pytest

from models.instruction_reader.decoding import decode, spans_of
from models.instruction_reader.lexicon import Lexicon
from models.instruction_reader.network import CELLS, GOAL, GROUPS, SAID, START
from models.instruction_reader.nouns import read_nouns
from models.instruction_reader.reading import InstructionReading
from models.instruction_reader.spoken_cells import Scores

LEXICON = Lexicon.of(read_nouns(), read_nouns().nouns)


def read(
    *phrases: str,
    start: str = "",
    goal: str = "",
    counts: dict[int, int] | None = None,
    said: dict[int, tuple[str, int]] | None = None,
    more: str = "",
) -> InstructionReading:
    """Decodes mentions, and more words, with facts such as ``0 in 1, 2 same 0``."""
    words = [word for phrase in (*phrases, more) for word in (*phrase.split(), ",")]
    spans, first = [], 0
    for phrase in phrases:
        spans.append((first, first + len(phrase.split()) - 1))
        first += len(phrase.split()) + 1
    size = len(phrases)
    scores = {name: np.zeros((size, classes), np.float32) for name, classes in SAID.items()}
    for name, values in scores.items():
        values[:, 1 if name == "count" else 0] = 1
    for k, count in (counts or {}).items():
        scores["count"][k] = np.eye(SAID["count"])[count]
    for k, (name, value) in (said or {}).items():
        scores[name][k] = np.eye(SAID[name])[value]
    return decode(words, spans, scores, _pairs(size, start, START), _pairs(size, goal, GOAL), LEXICON)


def _pairs(size: int, facts: str, classes: tuple[str, ...]) -> Scores:
    found = np.zeros((size, size, len(classes)), np.float32)
    found[:, :, 0] = 1
    for fact in filter(None, facts.split(", ")):
        a, kind, b = fact.split()
        for one, other in ((a, b), (b, a)) if kind == "same" else ((a, b),):
            found[int(one), int(other)] = 0.9 * np.eye(len(classes))[classes.index(kind)]
    return found


def facts_of(reading: InstructionReading) -> set[tuple[int, str, int]]:
    return {(r.subject, r.kind, r.target) for r in reading.start}


def test_mentions_follow_from_tags() -> None:
    assert spans_of([0, 1, 2, 2, 0, 1, 1, 2]) == [(1, 3), (5, 5), (6, 7)]
    assert spans_of([2, 0, 0, 2, 2]) == [(0, 0), (3, 4)]
    assert spans_of([]) == []


def test_a_pronoun_is_the_object_that_it_means() -> None:
    found = read("red mug", "tray", "it", start="0 on 1, 2 same 0", goal="2 near 1")
    assert [o.words for o in found.objects] == ["red mug", "tray"]
    assert facts_of(found) == {(0, "on", 1)}
    assert [(r.subject, r.kind, r.target) for r in found.goal] == [(0, "near", 1)]


def test_counts_give_objects_and_their_relations() -> None:
    found = read("pencils", "cup", start="0 in 1", counts={0: 3})
    assert len(found.objects) == 4
    assert facts_of(found) == {(0, "in", 3), (1, "in", 3), (2, "in", 3)}
    assert len(read("mugs", counts={0: 0}).objects) == 2  # a plural without a number
    assert len(read("scissors", counts={0: 0}).objects) == 1


def test_one_and_the_other_are_parts_of_a_plural() -> None:
    found = read("mugs", "one", "tray", "the other", "book", counts={0: 2}, start="1 part 0, 3 part 0, 1 on 2, 3 on 4")
    assert [o.words for o in found.objects].count("mugs") == 2
    (one, tray), (other, book) = sorted((r.subject, r.target) for r in found.start)
    assert one != other
    assert {found.objects[tray].words, found.objects[book].words} == {"tray", "book"}


def test_the_rest_is_what_is_left() -> None:
    found = read("books", "one", "the rest", "tray", counts={0: 4, 2: 0}, start="1 part 0, 2 part 0, 2 on 3")
    assert len(found.objects) == 5
    assert len(found.start) == 3


def test_all_three_of_different_objects_are_no_objects_of_their_own() -> None:
    found = read("mug", "bowl", "both", "tray", counts={2: 2}, start="0 part 2, 1 part 2, 2 on 3")
    assert sorted(o.words for o in found.objects) == ["bowl", "mug", "tray"]
    assert len(found.start) == 2


@pytest.mark.parametrize(("group", "kind"), [("stack", "on"), ("nest", "in")])
def test_a_group_is_a_chain(group: str, kind: str) -> None:
    found = read("plates", counts={0: 3}, said={0: ("group", GROUPS.index(group))})
    assert facts_of(found) == {(0, kind, 1), (1, kind, 2)}


def test_an_object_has_one_carrier_and_no_circle() -> None:
    assert len(read("mug", "tray", "book", start="0 on 1, 0 on 2").start) == 1
    assert len(read("mug", "tray", start="0 on 1, 1 on 0").start) == 1
    assert len(read("box", "tray", "book", start="0 on 1, 1 on 2, 2 in 0").start) == 2


def test_what_is_said_twice_is_no_contradiction() -> None:
    """Behind the comb and the mirror is a box, and behind "both" too."""
    found = read("comb", "mirror", "both", "jewelry box", start="0 part 2, 1 part 2, 2 front 3, 1 front 3", counts={2: 2})
    assert facts_of(found) == {(0, "front", 2), (1, "front", 2)}
    assert not found.contradictions


def test_each_on_its_own() -> None:
    found = read("cups", "saucers", counts={0: 2, 1: 2}, start="0 on 1")
    assert facts_of(found) == {(0, "on", 2), (1, "on", 3)}


def test_unlike_nouns_are_not_one_object() -> None:
    found = read("mug", "keyboard", start="0 same 1")
    assert len(found.objects) == 2
    assert len(read("desk lamp", "lamp", start="0 same 1").objects) == 1


def test_regions_and_unknown_objects() -> None:
    found = read("violin", "mug", said={1: ("region", CELLS.index("back_left"))}, more="at the back left")
    assert [o.words for o in found.unknown] == ["violin"]
    assert found.objects[1].region == "back_left"


@pytest.mark.parametrize(
    ("words", "cell"),
    [
        ("in the back left corner", "back_left"),
        ("at the middle of the front edge", "front_middle"),
        ("in the bottom left corner", "front_left"),
        ("in the top right - hand corner", "back_right"),
        ("in the far right corner at the back", "back_right"),
        ("on the right . it goes to the back", "middle_right"),
        ("near it", ""),
        ("", ""),
    ],
)
def test_a_cell_is_one_that_the_words_mean(words: str, cell: str) -> None:
    found = read("violin", "mug", said={1: ("region", CELLS.index("middle_right"))}, more=words)
    assert found.objects[1].region == cell


def test_words_of_one_clause_may_mean_one_cell() -> None:
    found = read(
        "violin", "mug", said={1: ("region", CELLS.index("back_right"))}, more="on the right , all the way at the back"
    )
    assert found.objects[1].region == "back_right"


def test_no_mention_is_no_object() -> None:
    assert read() == InstructionReading(())
    assert read("it") == InstructionReading(())


def sentence(text: str, start: str = "", said: dict[int, tuple[str, int]] | None = None) -> InstructionReading:
    """Decodes a sentence whose mentions are in brackets."""
    words: list[str] = []
    spans: list[tuple[int, int]] = []
    for word in text.split():
        if word.startswith("["):
            spans.append((len(words), 0))
        words.append(word.strip("[]"))
        if word.endswith("]"):
            spans[-1] = spans[-1][0], len(words) - 1
    size = len(spans)
    scores = {name: np.zeros((size, classes), np.float32) for name, classes in SAID.items()}
    for name, values in scores.items():
        values[:, 1 if name == "count" else 0] = 1
    for k, (name, value) in (said or {}).items():
        scores[name][k] = np.eye(SAID[name])[value]
    return decode(words, spans, scores, _pairs(size, start, START), _pairs(size, "", GOAL), LEXICON)


@pytest.mark.parametrize(
    ("text", "count"),
    [
        ("the [glass] that is farthest to the left is empty . fill the [glass] that is farthest to the left", 1),
        ("fill the [glass] that is farthest to the left . dry the [glass] that is farthest to the left .", 1),
        ("fill the [glass] that is farthest to the left . dry the [glass] that is farthest to the right", 2),
        ("fill the [glass] that is in the front left corner and the [glass] that is in the front left", 2),
        ("fill the [glass] that is farthest to the left and the [glass]", 2),
        ("the [right - hand glass] is empty . fill the [right - hand glass]", 1),
        ("the [leftmost glass] is empty . fill the [leftmost glass] and the [rightmost glass]", 2),
        ("put the [blue glass] here and the [blue glass] there", 2),  # only the network can tell
        ("put a [taller glass] here and a [taller glass] there", 2),
        ("put the [taller glasses] here and the [taller glasses] there", 4),
    ],
)
def test_what_is_singled_out_with_the_same_words_is_one_object(text: str, count: int) -> None:
    plural = dict.fromkeys(range(2), ("count", 2)) if "glasses" in text else {}
    assert len(sentence(text, said=plural).objects) == count


@pytest.mark.parametrize(
    ("text", "kind"),
    [
        ("remove the [toothbrush] from the [mug]", "in"),
        ("remove the [toothbrush] from the [tray]", "on"),
        ("remove the [toothbrush] that lies on the [mug]", "on"),
        ("take the [toothbrush] off the top of the [mug] , away from the [mug]", "on"),
    ],
)
def test_what_is_taken_from_something_hollow_was_in_it(text: str, kind: str) -> None:
    assert facts_of(sentence(text, "0 on 1, 1 same 2" if text.count("[mug]") == 2 else "0 on 1")) == {(0, kind, 1)}


@pytest.mark.parametrize(
    ("text", "cell"),
    [
        ("the [pot] is beside the right - hand [cup]", ""),
        ("the [pot] is on the right - hand side", "middle_right"),
        ("take the [pot] that is farther back", ""),
        ("take the [pot] that is closest to the left", ""),
        ("take the [pot] that is at the back", "back_middle"),
    ],
)
def test_words_that_single_an_object_out_are_no_cell_of_the_table(text: str, cell: str) -> None:
    found = sentence(text, said={0: ("region", CELLS.index("middle_right" if "right" in text else "back_middle"))})
    assert found.objects[0].region == cell


def test_the_pot_of_pens_is_a_pen_pot() -> None:
    pot, _ = read("the pot", "two pens", start="1 in 0", counts={1: 2}).objects[:2]
    assert pot.categories == ("pen_holder",)
    assert "pen_holder" not in read("the pot", "two potatoes", start="1 in 0", counts={1: 2}).objects[0].categories


def test_each_has_its_own_carrier() -> None:
    found = read("three cups", "its own saucer", start="0 on 1", counts={0: 3})
    saucers = [k for k, o in enumerate(found.objects) if o.categories == ("saucer",)]
    assert len(saucers) == 3
    assert {target for _, _, target in facts_of(found)} == set(saucers)


def test_things_beside_a_content_are_contents_too() -> None:
    found = read("the pen pot", "a ruler", "a pencil", "a marker", start="1 in 0, 1 between 2, 1 between 3")
    assert {(2, "in", 0), (3, "in", 0)} <= facts_of(found)


@pytest.mark.parametrize("clause", ["that is in the back left corner", "which sits in the rear left - hand corner"])
def test_a_clause_says_the_corner(clause: str) -> None:
    mug, plate = read("the mug", "the plate", more=f"{clause} is mine").objects
    assert (mug.region, plate.region) == ("", "back_left")


def test_a_pile_of_plates_is_a_stack() -> None:
    def stacked(*before: str) -> set[tuple[int, str, int]]:
        words = [*before, "plates"]
        scores = {name: np.eye(classes)[[0]].astype(np.float32) for name, classes in SAID.items()}
        scores["count"] = np.eye(SAID["count"])[[3]].astype(np.float32)
        last = len(words) - 1
        return facts_of(decode(words, [(last, last)], scores, _pairs(1, "", START), _pairs(1, "", GOAL), LEXICON))

    assert stacked("a", "pile", "of", "three") == {(0, "on", 1), (1, "on", 2)}
    assert stacked("make", "a", "pile", "of", "three") == set()
    assert stacked("three") == set()


def test_a_mention_has_its_adjectives_and_no_article() -> None:
    scores = {name: np.eye(classes)[[0]].astype(np.float32) for name, classes in SAID.items()}
    scores["count"] = np.eye(SAID["count"])[[1]].astype(np.float32)
    for words, span in ((["the", "red", "mug"], (2, 2)), (["the", "red", "mug"], (0, 2))):
        (mug,) = decode(words, [span], scores, _pairs(1, "", START), _pairs(1, "", GOAL), LEXICON).objects
        assert mug.words == "red mug"
