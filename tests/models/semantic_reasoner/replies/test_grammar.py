import json
import re
from dataclasses import replace
from pathlib import Path
from typing import Any

import jsonschema
import llguidance.hf
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from llguidance import LLMatcher, LLTokenizer

from models.semantic_reasoner.replies.grammar import MOST_NAMES, MOST_OBJECTS, ReplyGrammar, _number_pattern
from models.semantic_reasoner.text.reply_json import LayoutObject, render_objects
from models.semantic_reasoner.text.tokenizer import train_tokenizer
from stable_data.errors import SceneError
from stable_data.metrics.matching import RequiredObject

FORM = ReplyGrammar(112.0, 59.3)
MUG = LayoutObject("mug_0", "a red mug", (9.0, 8.0, 10.0), (20.0, 30.0, 5.0), -15)


@pytest.fixture(scope="module")
def guide() -> LLTokenizer:
    return llguidance.hf.from_tokenizer(train_tokenizer(["put the red mug on the table"], 300))


def accepts(guide: LLTokenizer, form: ReplyGrammar | str, text: str) -> bool:
    """Whether the grammar allows a text, from its first byte to its last."""
    grammar = form if isinstance(form, str) else form.grammar()
    matcher = LLMatcher(guide, LLMatcher.grammar_from_lark(grammar))
    assert not matcher.is_error(), matcher.get_error()
    tokens = guide.tokenize_str(text)
    return bool(matcher.try_consume_tokens(tokens) == len(tokens) and matcher.is_accepting())


@pytest.mark.parametrize("least", [0, 1])
@pytest.mark.parametrize("most", [0.1, 0.5, 1.0, 9.9, 10.0, 59.3, 99.9, 100.0, 112.0, 126.8, 199.9, 200.0, 250.4, 999.9])
def test_patterns_of_numbers_are_exact(most: float, least: int) -> None:
    pattern = re.compile(_number_pattern(most, least))
    found = [n for n in range(12_000) if pattern.fullmatch(f"{n / 10:.1f}")]
    assert found == list(range(least, round(10 * most) + 1))
    assert not any(pattern.fullmatch(text) for text in ("", "1", "01.0", "1.", ".5", "1.00", "-1.0", "1e1"))


@given(st.integers(1, 1120), st.integers(0, 593), st.integers(-179, 180), st.integers(0, 3))
@settings(max_examples=60)
def test_what_we_render_on_the_table_is_allowed(guide: LLTokenizer, x: int, y: int, angle: int, count: int) -> None:
    o = LayoutObject("toy_car_11", "a car, 2 doors; it's «red»", (x / 10, 0.1, 200.0), (x / 10, y / 10, 0.0), angle)
    text = render_objects([o] * count)
    assert accepts(guide, FORM, text)


@pytest.mark.parametrize(
    "text",
    [
        "",
        "{}",
        '{"objects": []}',
        render_objects([MUG]) + " ",
        render_objects([LayoutObject("mug_0", "a mug", (9.0, 8.0, 10.0), (112.1, 30.0, 5.0), 0)]),
        render_objects([LayoutObject("mug_0", "a mug", (9.0, 8.0, 10.0), (20.0, 59.4, 5.0), 0)]),
        render_objects([LayoutObject("mug_0", "a mug", (9.0, 8.0, 10.0), (-0.1, 30.0, 5.0), 0)]),
        render_objects([LayoutObject("mug_0", "a mug", (0.0, 8.0, 10.0), (20.0, 30.0, 5.0), 0)]),
        render_objects([LayoutObject("mug_0", "a mug", (9.0, 8.0, 200.1), (20.0, 30.0, 5.0), 0)]),
        render_objects([MUG]).replace("-15", "181"),
        render_objects([MUG]).replace("-15", "-0"),
        render_objects([MUG]).replace("9.0", "9"),
        render_objects([MUG]).replace("red", "r\\u0000ed"),
        render_objects([MUG], ["mug_0"]),
        render_objects([MUG] * (MOST_OBJECTS + 1)),
    ],
)
def test_what_cannot_be_on_the_table_is_not_allowed(guide: LLTokenizer, text: str) -> None:
    assert not accepts(guide, FORM, text)


def test_an_edit_takes_away_only_what_is_there(guide: LLTokenizer) -> None:
    form = ReplyGrammar(112.0, 59.3, edits=True, names=("mug_0", "pen_1"))
    assert accepts(guide, form, render_objects([MUG], []))
    assert accepts(guide, form, render_objects([], ["pen_1", "mug_0"]))
    assert not accepts(guide, form, render_objects([], ["pen_2"]))
    assert accepts(guide, ReplyGrammar(112.0, 59.3, edits=True), render_objects([MUG], []))


NAMES = st.lists(
    st.text(st.characters(codec="utf-8") | st.sampled_from('"\\\\\n\t|()[]{}.*+?/$^<>%\x00\x7f'), min_size=1),
    min_size=2,
    max_size=4,
)


@given(NAMES.filter(lambda names: len(set(names)) == len(names)))
@settings(max_examples=60)
def test_names_of_any_characters_are_taken_as_they_are(guide: LLTokenizer, names: list[str]) -> None:
    *known, other = names
    form = ReplyGrammar(112.0, 59.3, edits=True, names=tuple(known))
    assert accepts(guide, form, render_objects([MUG], known))
    assert not accepts(guide, form, render_objects([MUG], [other]))


@given(NAMES.filter(lambda names: len(set(names)) == len(names)))
@settings(max_examples=60)
def test_categories_of_any_characters_are_taken_as_they_are(guide: LLTokenizer, categories: list[str]) -> None:
    *known, other = categories
    grammar = FORM.grammar_after("},", tuple(known), 9)
    begun = render_objects([MUG])[:-3]
    for category in (*known, other):
        after = render_objects([MUG, replace(MUG, instance=f"{category}_0")]).removeprefix(begun)
        assert accepts(guide, grammar, after) == (category != other)


def test_names_are_limited_in_number(guide: LLTokenizer) -> None:
    names = tuple(f"thing_{number}" for number in range(MOST_NAMES))
    assert accepts(guide, ReplyGrammar(112.0, 59.3, edits=True, names=names), render_objects([], [names[0], names[-1]]))
    for too_many in ((*names, "mug_0"), ("\ud800",)):
        with pytest.raises(SceneError, match=r"expected at most 1000|not UTF-8"):
            ReplyGrammar(112.0, 59.3, edits=True, names=too_many)


def test_the_number_of_objects_can_be_bounded(guide: LLTokenizer) -> None:
    form = ReplyGrammar(112.0, 59.3, at_least=1, at_most=2)
    assert [accepts(guide, form, render_objects([MUG] * n)) for n in range(4)] == [False, True, True, False]


def test_what_is_asked_for_is_lacking_until_it_is_there() -> None:
    pen = replace(MUG, instance="pen_0")
    form = ReplyGrammar(
        112.0,
        59.3,
        at_most=4,
        asks=(*(RequiredObject(k, ("mug", "teacup")) for k in "ab"), RequiredObject("c", ("pen",))),
    )
    assert form.lacking(render_objects([])) == ("mug", "teacup", "pen")
    assert form.lacking(render_objects([MUG, replace(MUG, instance="teacup_0")])) == ("pen",)
    assert form.lacking(render_objects([MUG, pen])) == ("mug", "teacup")
    assert form.lacking(render_objects([MUG, MUG, pen])) is None
    assert form.lacking(render_objects([pen] * 4)) is None  # there is no room for more
    assert replace(form, asks=()).lacking(render_objects([])) is None
    anything = ReplyGrammar(
        112.0,
        59.3,
        asks=(
            RequiredObject("a", ("mug",)),
            RequiredObject("b", ()),
        ),
    )
    assert anything.lacking(render_objects([MUG])) == ()
    assert anything.lacking(render_objects([MUG, pen])) is None


def test_what_follows_begins_with_what_is_lacking(guide: LLTokenizer) -> None:
    pen, kept = replace(MUG, instance="pen_0"), render_objects([MUG])[:-3]

    def goes_on(objects: list[LayoutObject], categories: tuple[str, ...], at_most: int = 9) -> bool:
        grammar = FORM.grammar_after("},", categories, at_most)
        return accepts(guide, grammar, render_objects([MUG, *objects]).removeprefix(kept))

    assert goes_on([pen], ("cup", "pen"))
    assert goes_on([pen, MUG], ("cup", "pen"), 2)
    assert not goes_on([pen, MUG], ("cup", "pen"), 1)
    assert not goes_on([MUG, pen], ("cup", "pen"))
    assert not goes_on([replace(MUG, instance="red_pen_0")], ("cup", "pen"))
    assert not goes_on([], ("pen",))
    assert goes_on([MUG], ())
    assert not goes_on([], ())


def test_schema_and_grammar_agree(guide: LLTokenizer) -> None:
    import json

    validator = jsonschema.Draft202012Validator(FORM.schema())
    good = render_objects([MUG, MUG])
    validator.validate(json.loads(good))
    for text in (good.replace("mug_0", "Mug 0"), good.replace("-15", "200"), good.replace('"z_rotation":-15', '"turn":1')):
        assert not accepts(guide, FORM, text)
        assert list(validator.iter_errors(json.loads(text)))


STRICT = {"type", "properties", "items", "enum", "pattern", "minimum", "maximum", "minItems", "maxItems", "required"}
STRICT |= {"additionalProperties"}


def test_the_schema_has_no_keyword_that_openai_refuses_and_takes_every_reply() -> None:
    schema = ReplyGrammar(120.0, 60.0, edits=True, names=("mug_0",), at_least=1).schema()
    assert keywords(schema) == STRICT
    assert list(schema["properties"]) == ["remove", "objects"]
    jsonschema.Draft202012Validator.check_schema(schema)
    jsonschema.validate(json.loads(render_objects([MUG], ["mug_0"])), schema)
    with pytest.raises(jsonschema.ValidationError):
        jsonschema.validate(json.loads(render_objects([], ["mug_0"])), schema)


def keywords(schema: dict[str, Any]) -> set[str]:
    inner = [*schema.get("properties", {}).values(), *([schema["items"]] if "items" in schema else [])]
    return set(schema).union(*map(keywords, inner))


def test_checked_in_schema_of_replies_takes_what_we_render() -> None:
    import json

    schema = json.loads((Path(__file__).parents[4] / "schemas/layout_reply.schema.json").read_text("utf-8"))
    jsonschema.validate(json.loads(render_objects([MUG])), schema)
