"""``schemas/layout_reply.schema.json`` is the form of the replies that the reasoner reads."""

import json
from pathlib import Path
from typing import Any

import jsonschema
import pytest
from hypothesis import given
from hypothesis import strategies as st

from models.semantic_reasoner.replies.grammar import ReplyGrammar
from models.semantic_reasoner.text.reply_json import parse_reply, sanitise_words
from stable_data.errors import SceneError
from stable_data.storage.json_schemas import MOST_ENTRIES

SCHEMA = json.loads((Path(__file__).parents[4] / "schemas/layout_reply.schema.json").read_text("utf-8"))
VALIDATOR = jsonschema.Draft202012Validator(SCHEMA)
MUG = {"instance": "mug_0", "description": "a mug", "size": [8.0, 8.0, 9.5], "position": [30, 20.0, 4.75], "z_rotation": 90}

NAMES = (
    "mug_0",
    "coffee_mug_12",
    "mug",
    "mug_",
    "_0",
    "0_mug_0",
    "_mug_0",
    "Mug_0",
    "mug 2_0",
    "чашка_3",
    "mug_x",
    "",
    "mug_0 ",
)
WORDS = ("a mug", "", " ", "\n\t", "\u0000", "\x7f", "\x1f a", "чашка", "<|im_end|>")
NUMBERS = (0, -0.0, 0.05, 0.049, 0.1, -1, 7.5, 1e-9, 1e6, -1e6, 999999.9, -999999.9, 10**9, True, None, "1", [1])

value = st.sampled_from(NUMBERS) | st.floats(-2e6, 2e6) | st.integers(-(10**7), 10**7)
vector = st.lists(value, min_size=2, max_size=4) | value
side = st.floats(0.1, 200.0)


@st.composite
def entries(draw: st.DrawFn) -> Any:
    """An object of a reply, as it should be but for one key at most."""
    entry = dict(MUG) | {"size": draw(st.lists(side, min_size=3, max_size=3))}
    key = draw(st.sampled_from(["", *MUG, "more"]))
    wrong = {"instance": st.sampled_from(NAMES) | value, "description": st.sampled_from(WORDS) | value, "z_rotation": value}
    if key and draw(st.booleans()):
        entry[key] = draw(wrong.get(key, vector))
    elif key:
        entry.pop(key, None)
    return entry


replies = st.fixed_dictionaries(
    {"objects": st.lists(entries(), max_size=2) | value},
    optional={"remove": st.lists(st.sampled_from(NAMES), max_size=2) | st.lists(value, max_size=2) | value, "more": value},
)


def is_accepted(reply: Any) -> bool:
    try:
        parse_reply(json.dumps(reply, ensure_ascii=False))
    except SceneError:
        return False
    return True


@given(replies)
def test_the_reasoner_accepts_what_the_schema_does(reply: Any) -> None:
    """Both ways, but for characters of a name that no pattern of JSON Schema tells from letters."""
    if is_accepted(reply):
        VALIDATOR.validate(reply)
    elif VALIDATOR.is_valid(reply):
        assert any(name in ("mug 2_0", "mug_0 ") for name in [o["instance"] for o in reply["objects"]]), reply


@pytest.mark.parametrize(
    "reply",
    [
        [],
        {},
        {"objects": {}},
        {"objects": [MUG], "remove": None},
        {"objects": [MUG], "remove": [1]},
        {"objects": [MUG] * (MOST_ENTRIES + 1)},
        {"objects": [], "remove": ["mug_0"] * (MOST_ENTRIES + 1)},
        *({"objects": [{k: v for k, v in MUG.items() if k != key}]} for key in MUG),
        *({"objects": [MUG | {"instance": name}]} for name in ("mug", "mug_", "_0", "0_mug_0", "", "mug_x", 7)),
        *({"objects": [MUG | {"description": words}]} for words in ("", " \n", "\u0000", None)),
        *({"objects": [MUG | {"size": size}]} for size in ([8, 8], [8, 8, 8, 8], [8, 8, 0], [8, 8, -1], [8, 8, "8"], 8)),
        *({"objects": [MUG | {"position": at}]} for at in ([1, 2], [1, 2, 1e6], [1, 2, True], None)),
        *({"objects": [MUG | {"z_rotation": angle}]} for angle in ("90", None, True, 1e6, [90])),
    ],
)
def test_what_the_schema_refuses_the_reasoner_refuses(reply: Any) -> None:
    assert not VALIDATOR.is_valid(reply)
    assert not is_accepted(reply)


@given(st.data())
def test_the_form_of_a_request_narrows_the_schema(data: st.DataObject) -> None:
    form = ReplyGrammar(120.0, 60.0, edits=True, names=("mug_0", "чашка_1"))
    narrow = form.schema()
    entry = narrow["properties"]["objects"]["items"]
    whole = SCHEMA["properties"]["objects"]["items"]
    assert list(entry["properties"]) == entry["required"] == whole["required"]
    assert set(narrow["properties"]) == set(SCHEMA["properties"])
    reply = {"remove": [data.draw(st.sampled_from(form.names))], "objects": [data.draw(entries())]}
    if jsonschema.Draft202012Validator(narrow).is_valid(reply) and sanitise_words(reply["objects"][0]["description"]):
        VALIDATOR.validate(reply)
        assert is_accepted(reply)
