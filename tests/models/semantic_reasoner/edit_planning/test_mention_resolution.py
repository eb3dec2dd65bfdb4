"""Which objects of a layout are meant; the readings are made by hand."""

import pytest

from models.instruction_reader.lexicon import Lexicon
from models.instruction_reader.nouns import read_nouns
from models.instruction_reader.reading import InstructionReading, MentionedObject, MentionedRelation
from models.semantic_reasoner.edit_planning.candidates import Candidates
from models.semantic_reasoner.edit_planning.mention_resolution import AMBIGUOUS, MISSING, MentionResolver, gap_between
from stable_data.errors import SceneError
from stable_data.scene import SceneObject, Tabletop

TABLE = Tabletop("office_table", (1.2, 0.6))
LEXICON = Lexicon.of(read_nouns(), read_nouns().nouns)


def box(instance: str, x: float, y: float, bottom: float = 0.0, height: float = 0.1, words: str = "") -> SceneObject:
    category = instance.rpartition("_")[0]
    size = (0.3, 0.2, 0.02) if category == "serving_tray" else (0.08, 0.08, height)
    return SceneObject(instance, category, (x, y, bottom + size[2] / 2), 0.0, size, description=words or f"a {category}")


LAYOUT = (
    box("mug_0", 0.2, 0.3, words="a red mug"),
    box("mug_1", 0.7, 0.3, bottom=0.02, words="a blue mug"),
    box("serving_tray_0", 0.7, 0.3),
    box("candle_0", 1.0, 0.5, height=0.1),
    box("candle_1", 1.1, 0.1, height=0.2),
    box("can_0", 0.4, 0.1, words="a can of pickled gherkins"),
)


def mentioned(words: str, *categories: str, name: int = 0, text: str = "", **more: object) -> MentionedObject:
    start = text.find(words)
    mentions = ((start, start + len(words)),) if start >= 0 and text else ()
    return MentionedObject(words, categories, name=name, mentions=mentions, **more)  # type: ignore[arg-type]


def resolve(*objects: MentionedObject, start: tuple[tuple[int, str, int], ...] = (), text: str = "") -> tuple[str, ...]:
    reading = InstructionReading(objects, tuple(MentionedRelation(*r) for r in start))
    return MentionResolver(text, reading, LAYOUT, TABLE, Candidates(LAYOUT, LEXICON)).resolve([0], {0})[0]


def test_an_object_is_found_by_its_category_colour_place_and_relations() -> None:
    tray = mentioned("tray", "serving_tray", "decor_tray", name=1)
    assert resolve(tray) == ("serving_tray_0",)
    assert resolve(mentioned("red mug", "mug")) == ("mug_0",)
    assert resolve(mentioned("mug", "mug"), tray, start=((0, "on", 1),)) == ("mug_1",)
    assert resolve(mentioned("mug", "mug", region="middle_left")) == ("mug_0",)
    assert resolve(mentioned("candle", "candle", region="front_right")) == ("candle_1",)


@pytest.mark.parametrize(
    ("words", "meant"), [("taller candle", "candle_1"), ("shortest candle", "candle_0"), ("left candle", "candle_0")]
)
def test_a_superlative_picks_one_of_several(words: str, meant: str) -> None:
    assert resolve(mentioned(words, "candle")) == (meant,)


@pytest.mark.parametrize(
    ("text", "meant"),
    [("Remove the candle that is farthest to the left.", "candle_0"), ("Remove the tallest candle.", "candle_1")],
)
def test_words_around_a_mention_pick_one_too(text: str, meant: str) -> None:
    assert resolve(mentioned("candle", "candle", text=text), text=text) == (meant,)


def test_a_noun_without_a_category_is_looked_for_in_descriptions() -> None:
    assert resolve(mentioned("gherkins")) == ("can_0",)


def test_a_plural_without_a_number_means_all() -> None:
    assert resolve(mentioned("mugs", "mug", is_one_of_many=True)) == ("mug_0", "mug_1")
    assert resolve(mentioned("mug", "mug"), mentioned("mug", "mug")) == ("mug_0", "mug_1")


def test_several_that_fit_are_named_and_any_is_enough_for_an_indefinite_article() -> None:
    with pytest.raises(SceneError, match="mug_0, mug_1") as caught:
        resolve(mentioned("mug", "mug"))
    assert caught.value.code == AMBIGUOUS
    assert resolve(mentioned("mug", "mug", text="Remove a mug."), text="Remove a mug.") == ("mug_0",)


def test_what_is_not_there_is_said() -> None:
    with pytest.raises(SceneError, match="no object of the layout is 'violin'; it has mug_0") as caught:
        resolve(mentioned("violin"))
    assert caught.value.code == MISSING


def test_fewer_than_are_mentioned_are_said() -> None:
    with pytest.raises(SceneError, match="3 objects are 'mugs', but the layout has only mug_0, mug_1") as caught:
        resolve(*[mentioned("mugs", "mug")] * 3)
    assert caught.value.code == MISSING


def test_the_gap_of_boxes() -> None:
    assert gap_between(LAYOUT[0], LAYOUT[1]) == pytest.approx(0.42)
    assert gap_between(LAYOUT[1], LAYOUT[2]) == 0.0


def test_categories_that_the_reader_does_not_know_are_found_by_their_own_nouns() -> None:
    ball, ketchup = box("racquetball_0", 0.1, 0.1, words="racquetball (scanned)"), box("ketchup_0", 0.3, 0.1)
    spray = box("spray_bottle_0", 0.5, 0.1)
    layout = (ball, ketchup, spray)

    def found(one: MentionedObject) -> tuple[str, ...]:
        return MentionResolver("", InstructionReading((one,)), layout, TABLE, Candidates(layout, LEXICON)).resolve([0], {0})[0]

    assert found(mentioned("ball", "ball")) == ("racquetball_0",)
    assert found(mentioned("ketchup bottle", "sauce_bottle")) == ("ketchup_0",)
    assert found(mentioned("spray bottle")) == ("spray_bottle_0",)


def test_a_thing_and_what_carries_it_are_meant_together() -> None:
    mug, tray = mentioned("blue mug", "mug"), mentioned("tray", "serving_tray", name=1)
    layout = (*LAYOUT, box("serving_tray_1", 0.2, 0.5))
    reading = InstructionReading((mug, tray))
    resolver = MentionResolver("the blue mug, tray and all", reading, layout, TABLE, Candidates(layout, LEXICON))
    assert resolver.resolve([0, 1], {0, 1}) == {0: ("mug_1",), 1: ("serving_tray_0",)}
    onto = InstructionReading((mug, tray), goal=(MentionedRelation(0, "on", 1),))
    with pytest.raises(SceneError) as caught:  # the mug is on one of the trays already, so another one is meant, or not
        MentionResolver("", onto, layout, TABLE, Candidates(layout, LEXICON)).resolve([0, 1], {0})
    assert caught.value.code == AMBIGUOUS


def test_of_what_an_edit_only_points_at_fewer_may_be_there() -> None:
    several = InstructionReading((mentioned("candles", "candle"),) * 3)
    resolver = MentionResolver("", several, LAYOUT, TABLE, Candidates(LAYOUT, LEXICON))
    assert resolver.resolve([0], set())[0] == ("candle_0", "candle_1")
    with pytest.raises(SceneError) as caught:
        resolver.resolve([0], {0, 1, 2})
    assert caught.value.code == MISSING


def test_unknown_things_around_the_table_are_not_looked_for() -> None:
    resolver = MentionResolver(
        "", InstructionReading((mentioned("washbasin"), mentioned("mug", "mug"))), LAYOUT, TABLE, Candidates(LAYOUT, LEXICON)
    )
    assert resolver.is_unknown(0)
    assert not resolver.is_unknown(1)
