"""The protocol as plain data: nothing that an endpoint or a client may say is more than an error, and both sides agree."""

import json
from typing import Any

import jsonschema
import pytest
from hypothesis import given
from hypothesis import strategies as st

from models.semantic_reasoner.engines.chat_protocol import (
    SPELLINGS,
    answer_body,
    completion_of,
    error_of,
    refused_field,
    request_body,
    request_of,
    strict_schema,
)
from models.semantic_reasoner.engines.protocol import Completion, Request, Sampling
from models.semantic_reasoner.language.required_objects import ObjectRequirement
from models.semantic_reasoner.replies.grammar import ReplyGrammar
from models.semantic_reasoner.text.reply_json import LayoutObject, render_objects

BEST = {name: ways[0] for name, ways in SPELLINGS.items()}
KEYS = ["choices", "message", "content", "refusal", "finish_reason", "usage", "prompt_tokens", "error", "code", "param", "type"]
KEYS += ["messages", "role", "stable_data", "form", "names", "seed", "temperature", "max_tokens", "response_format"]
JSON = st.recursive(
    st.none() | st.booleans() | st.integers() | st.floats() | st.text(max_size=8) | st.sampled_from(["length", "user"]),
    lambda inner: st.lists(inner, max_size=3) | st.dictionaries(st.sampled_from(KEYS) | st.text(max_size=3), inner, max_size=5),
    max_leaves=20,
)
FORMS = st.builds(
    ReplyGrammar,
    st.integers(100, 3000).map(lambda mm: mm / 10),
    st.integers(100, 3000).map(lambda mm: mm / 10),
    st.booleans(),
    st.lists(st.sampled_from(["mug_0", "plate_1"]), unique=True).map(tuple),
    st.integers(0, 2),
    st.integers(2, 9),
    st.sampled_from([(), (ObjectRequirement("both mugs", ("mug", "teacup"), 2), ObjectRequirement("in it", ()))]),
)


MESSAGES = st.fixed_dictionaries({}, optional={"content": st.text() | JSON, "refusal": JSON})
CHOICES = st.fixed_dictionaries({"message": MESSAGES | JSON}, optional={"finish_reason": JSON})
USAGES = st.fixed_dictionaries({"prompt_tokens": JSON, "completion_tokens": st.integers() | JSON})
ANSWERS = st.fixed_dictionaries({"choices": st.lists(CHOICES | JSON, min_size=1)}, optional={"usage": USAGES | JSON})
BODIES = st.fixed_dictionaries(
    {"messages": st.lists(st.fixed_dictionaries({"role": st.text(), "content": st.text() | JSON}), min_size=1)},
    optional={"seed": JSON, "temperature": JSON, "max_tokens": JSON, "response_format": JSON, "stable_data": JSON, "n": JSON},
)


@given(ANSWERS | JSON)
def test_any_answer_is_a_completion_or_a_clear_error(answer: Any) -> None:
    try:
        completion = completion_of(answer, 1.0, 1.0)
    except ValueError:
        return
    assert bool(completion.text) != bool(completion.failure)
    assert bool(completion.failure) == bool(completion.code)
    completion.text.encode()


@given(JSON)
def test_any_error_has_words(answer: Any) -> None:
    error = error_of(answer)
    assert all(isinstance(words, str) for words in error.values())
    assert refused_field(error) in {None, *SPELLINGS}


@given(BODIES | JSON)
def test_any_body_is_a_request_or_a_clear_error(body: Any) -> None:
    try:
        request, sampling = request_of(body, Sampling())
    except ValueError:
        return
    assert request.messages
    assert sampling.max_tokens >= 0


@given(FORMS, st.integers(0, 2**63 - 1), st.floats(0, 2), st.floats(0, 1), st.integers(0, 100), st.integers(1, 9999))
def test_what_is_sent_with_its_form_arrives(
    form: ReplyGrammar, seed: int, temperature: float, top_p: float, top_k: int, longest: int
) -> None:
    request = Request(({"role": "system", "content": "s"}, {"role": "user", "content": "é"}), form, seed)
    sampling = Sampling(temperature, top_p, top_k, longest)
    for spelling in SPELLINGS["max_tokens"]:
        body = request_body("m", request, sampling, {**BEST, "max_tokens": spelling}, with_form=True)
        assert request_of(json.loads(json.dumps(body)), Sampling()) == (request, sampling)


@given(FORMS)
def test_without_the_form_the_schema_gives_one_that_is_no_narrower(form: ReplyGrammar) -> None:
    request = Request(({"role": "user", "content": "x"},), form)
    arrived = request_of(request_body("m", request, Sampling(), BEST, with_form=False), Sampling())[0].form
    assert (arrived.at_least, arrived.at_most) == (form.at_least, form.at_most)
    assert arrived.width_cm >= form.width_cm
    assert arrived.depth_cm >= form.depth_cm
    if form.edits and form.names:
        assert (arrived.edits, arrived.names) == (True, form.names)


@pytest.mark.parametrize("asks", [None, [{}], [{"words": "x", "categories": ["a|b"], "at_least": 1}]])
def test_a_form_that_asks_for_what_is_no_category_is_refused(asks: Any) -> None:
    body = request_body(
        "m", Request(({"role": "user", "content": "x"},), ReplyGrammar(90.0, 60.0)), Sampling(), BEST, with_form=True
    )
    body["stable_data"]["form"]["asks"] = asks
    with pytest.raises(ValueError, match="form"):
        request_of(body, Sampling())


def test_a_request_without_a_form_may_have_any_layout() -> None:
    body = {"model": "m", "messages": [{"role": "user", "content": "x"}]}
    form = request_of(body, Sampling())[0].form
    assert min(form.width_cm, form.depth_cm) >= 300
    form.grammar()


def test_the_strict_schema_has_no_keyword_that_openai_refuses_and_takes_every_reply() -> None:
    form = ReplyGrammar(120.0, 60.0, edits=True, names=("mug_0",), at_least=1)
    schema = strict_schema(form.schema())
    assert {"minLength", "maxLength"}.isdisjoint(_keywords(schema))
    assert {"minItems", "maximum", "pattern", "enum", "additionalProperties", "required"} <= _keywords(schema)
    assert list(schema["properties"]) == ["remove", "objects"]
    jsonschema.Draft202012Validator.check_schema(schema)
    mug = LayoutObject("mug_1", "a white mug", (8.0, 8.0, 9.5), (20.0, 30.0, 4.8), 90)
    jsonschema.validate(json.loads(render_objects([mug], ["mug_0"])), schema)
    with pytest.raises(jsonschema.ValidationError):
        jsonschema.validate(json.loads(render_objects([], ["mug_0"])), schema)


def _keywords(schema: dict[str, Any]) -> set[str]:
    found = set(schema)
    for inner in [*schema.get("properties", {}).values(), *([schema["items"]] if "items" in schema else [])]:
        found |= _keywords(inner)
    return found


@pytest.mark.parametrize("completion", [Completion('{"objects":[]}', 7, 3), Completion("", 7, 3, "too long", "reply_cut")])
def test_an_answer_hands_on_what_an_engine_gave(completion: Completion) -> None:
    body = json.loads(json.dumps(answer_body(completion, "m", 0, 0)))
    if completion.failure:
        assert error_of(body)["message"] == "too long"
    else:
        assert completion_of(body) == completion


REFUSALS = [
    ("Invalid schema for response_format 'layout': 'minItems' is not permitted.", "response_format", "response_format"),
    ("guided decoding is not enabled", "", "response_format"),
    ("Unsupported parameter: 'seed'", "", "seed"),
    ("Extra inputs are not permitted: top_p", "", "top_p"),
    ("This model's maximum context length is 4096 tokens", "", None),
    ("temperature must be at most 1", "temperature", None),
]


@pytest.mark.parametrize(("message", "param", "field"), REFUSALS)
def test_which_field_an_endpoint_does_not_take(message: str, param: str, field: str | None) -> None:
    assert refused_field(error_of({"error": {"message": message, "param": param}})) == field


def test_details_of_a_validation_error_are_its_words() -> None:
    error = error_of({"detail": [{"loc": ["body", "seed"], "msg": "Extra inputs are not permitted"}]})
    assert refused_field(error) == "seed"
