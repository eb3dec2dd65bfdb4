import json
import math
import time
from dataclasses import replace

import pytest
from hypothesis import given
from hypothesis import strategies as st

from models.semantic_reasoner.text.reply_json import (
    LayoutObject,
    LayoutReply,
    layout_names,
    layout_objects,
    parse_reply,
    render_objects,
    renumber_instances,
    sanitise_words,
)
from stable_data.errors import SceneError
from stable_data.limits import LIMITS
from stable_data.scene import SceneObject
from stable_data.storage.json_schemas import MOST_ENTRIES

words = st.text(min_size=1, max_size=60).map(sanitise_words).filter(bool)
tenths = st.integers(-3000, 3000).map(lambda n: n / 10 + 0.0)
sides = st.integers(1, 3000).map(lambda n: n / 10)
names = st.builds(lambda c, n: f"{c}_{n}", st.from_regex(r"[a-z][a-z_]{0,12}", fullmatch=True), st.integers(0, 30))
objects = st.builds(
    LayoutObject, names, words, st.tuples(sides, sides, sides), st.tuples(tenths, tenths, tenths), st.integers(-179, 180)
)


MUG = LayoutObject("mug_0", "a mug", (1.0, 2.0, 3.0), (1.0, 2.0, 3.0), 0)


@given(st.lists(objects, max_size=5), st.lists(names, max_size=3))
def test_text_and_objects_are_inverses(layout: list[LayoutObject], removed: list[str]) -> None:
    text = render_objects(layout, removed)
    reply = parse_reply(text)
    assert reply == LayoutReply(tuple(layout), tuple(removed))
    assert render_objects(reply.objects, reply.removed) == text
    assert json.loads(text)["remove"] == removed


@given(st.lists(objects, max_size=5))
def test_fences_and_words_before_a_reply_are_passed_over(layout: list[LayoutObject]) -> None:
    text = render_objects(layout)
    assert parse_reply(f"Here it is:\n```json\n{text}\n```\n").objects == tuple(layout)


@given(st.lists(objects, min_size=1, max_size=5))
def test_words_after_a_reply_and_commas_before_brackets_are_passed_over(layout: list[LayoutObject]) -> None:
    text = json.dumps(json.loads(render_objects(layout)), indent=2).replace("\n  ]", ",\n  ]").replace("\n    }", ",\n    }")
    for said in (
        f"{text}\n\nEach of them rests on the table.",
        f"In the form {{...}}: {text}",
        f"First {text}\nand now {text}",
    ):
        assert parse_reply(said).objects == tuple(layout)


def test_commas_in_words_stay() -> None:
    mug = replace(MUG, description='a mug, ] with the words "a,]" and a \\')
    text = render_objects([mug]).replace("]}", ",]}")
    assert parse_reply(text).objects == (mug,)


@given(st.floats(-20, 20), st.floats(0.001, 2), st.floats(-3, 3))
def test_an_object_keeps_its_place_to_half_a_millimetre(yaw: float, side: float, x: float) -> None:
    o = SceneObject("7_mug_0", "mug", (x, 0.2, 0.05), yaw, (side, 0.1, 0.1), description="a mug")
    (told,) = layout_objects([o])
    back = told.to_scene_object()
    assert math.isclose(back.position[0], x, abs_tol=5.01e-4)
    assert math.isclose(back.size[0], side, abs_tol=5.01e-4)
    assert abs(math.remainder(back.yaw - yaw, 2 * math.pi)) <= math.radians(0.501)
    assert layout_objects([back]) == (told,)


def test_names_are_numbered_by_category_in_the_order_given() -> None:
    things = [
        SceneObject(f"{k}_x", c, (0, 0, 0), 0, (1, 1, 1)) for k, c in enumerate(["mug", "Toy Car", "mug", "3d print", ""])
    ]
    assert list(layout_names(things).values()) == ["mug_0", "toy_car_0", "mug_1", "object_3d_print_0", "object_0"]
    assert all(parse_reply(render_objects([o])).objects == (o,) for o in layout_objects(things))


@given(st.lists(objects, max_size=12), st.lists(names, max_size=6))
def test_names_that_are_taken_get_the_next_free_number(layout: list[LayoutObject], taken: list[str]) -> None:
    found = renumber_instances(layout, taken)
    assert len({*taken, *(o.instance for o in found)}) == len(set(taken)) + len(layout)
    assert [o.category for o in found] == [o.category for o in layout]
    assert renumber_instances(found, taken) == found


@pytest.mark.parametrize(
    ("text", "code"),
    [
        ("", "reply_not_json"),
        ("no", "reply_not_json"),
        ('{"objects":[', "reply_not_json"),
        ("[" * 100_000, "reply_not_json"),
        ("[]", "reply_malformed"),
        ('{"objects":{}}', "reply_malformed"),
        ('{"objects":[1]}', "reply_malformed"),
        ('{"objects":[],"remove":[1]}', "reply_malformed"),
        (json.dumps({"objects": [1] * (MOST_ENTRIES + 1)}), "reply_malformed"),
        (json.dumps({"objects": [], "remove": ["a_1"] * (MOST_ENTRIES + 1)}), "reply_malformed"),
        ('{"objects":[]}' + " " * LIMITS.text.max_reply_bytes, "reply_too_long"),
        ("é" * (LIMITS.text.max_reply_bytes // 2 + 1), "reply_too_long"),
        (json.dumps({"objects": [], "remove": ["\ud800"]}), "reply_not_json"),
        (render_objects([replace(MUG, description="a mug")]).replace("a mug", r"a \udfff mug"), "reply_not_json"),
        (json.dumps({"objects": [], "more": json.loads("[" * 100 + "]" * 100)}), "reply_not_json"),
        ('{"objects":[],"more":' + "1" * 5000 + "}", "reply_not_json"),
        (json.dumps({"objects": [{"instance": "x" * 10_000}]}), "reply_malformed"),
        (json.dumps({"objects": [{"instance": "x_1", "description": [0] * 10_000}]}), "reply_malformed"),
    ],
)
def test_what_is_no_reply_is_refused(text: str, code: str) -> None:
    with pytest.raises(SceneError) as caught:
        parse_reply(text)
    assert caught.value.code == code
    assert "\n" not in str(caught.value)
    assert len(str(caught.value)) < 300


@pytest.mark.parametrize(
    "text",
    [
        '{"objects":[' + "\n" * 60_000 + "x",
        "```" + " " * 100_000 + "```",
        "\n" * 100_000 + '{"objects":[]' + "\n" * 100_000,
        '{"objects":[' + "[]," * 30_000,
        render_objects([MUG] * 2_000),
        render_objects([MUG] * 60_000),
        render_objects([], ["mug_0", "mug_1"] * 10_000),
        '{"objects":["' + '\\"' * 120_000,
        "{" + '\\"' * 120_000,
        "{" + ", " * 120_000,
        "{" + "," + " " * 240_000,
        "{" * 240_000,
        '{"objects":[' * 20_000,
    ],
    ids=[
        *("lines", "fences", "blanks", "lists", "objects", "bytes", "removed"),
        *("quotes", "more quotes", "commas", "a comma", "braces", "openings"),
    ],
)
def test_a_hostile_reply_is_refused_at_once(text: str) -> None:
    start = time.process_time()
    with pytest.raises(SceneError):
        parse_reply(text)
    assert time.process_time() - start < 2  # a garbage collection may take half a second; quadratic time takes minutes


def test_many_objects_of_one_name_are_renumbered_at_once() -> None:
    count = 20_000
    start = time.process_time()
    found = renumber_instances([MUG] * count, ["mug_1"])
    assert time.process_time() - start < 1
    assert [o.instance for o in found] == [f"mug_{n}" for n in range(count + 1) if n != 1]
    assert renumber_instances([MUG, replace(MUG, instance="mug_1"), MUG], ["mug_2"])[-1].instance == "mug_3"


@pytest.mark.parametrize(
    ("key", "value"),
    [
        ("instance", "mug"),
        ("instance", 4),
        ("instance", "0_1"),
        ("description", " "),
        ("description", None),
        ("size", [1, 2]),
        ("size", [1, 2, "3"]),
        ("size", [0, 1, 1]),
        ("size", [1, 1, True]),
        ("position", [1, 2, 1e300]),
        ("position", "here"),
        ("z_rotation", "90"),
        ("z_rotation", None),
    ],
)
def test_a_malformed_object_is_named(key: str, value: object) -> None:
    entry = {"instance": "mug_0", "description": "a mug", "size": [1, 2, 3], "position": [1, 2, 3], "z_rotation": 0, key: value}
    with pytest.raises(SceneError, match=f'"{key}"|{key}') as caught:
        parse_reply(json.dumps({"objects": [entry]}))
    assert caught.value.code == "reply_malformed"


def test_numbers_that_are_none_are_refused() -> None:
    with pytest.raises(SceneError, match="not JSON"):
        parse_reply('{"objects":[{"size":[NaN,1,1]}]}')
