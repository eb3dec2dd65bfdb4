"""Requests with pictures: endpoints get them as data URLs, caches tell them apart, and engines that read text alone say so."""

import base64
import json
from pathlib import Path

import llguidance
import pytest
from llguidance import LLMatcher

from models.semantic_reasoner.engines.openai_engine import OpenAIEngine
from models.semantic_reasoner.engines.protocol import Request, Sampling, reads_no_pictures
from models.semantic_reasoner.engines.registry import EngineSettings, load_engine
from models.semantic_reasoner.engines.response_cache import CachedEngine, ResponseCache
from models.semantic_reasoner.replies.json_form import JsonForm
from tests.models.semantic_reasoner.engines.endpoint import FORM, Act, ask, endpoint, error, said, words_of

SCHEMA = {
    "type": "object",
    "properties": {"mugs": {"type": "integer", "enum": [1, 2]}},
    "required": ["mugs"],
    "additionalProperties": False,
}
COUNT = JsonForm.of("count", SCHEMA)
SYSTEM, USER = {"role": "system", "content": "Count."}, {"role": "user", "content": "how many mugs"}
PICTURES = (b"\x89PNG one", b"\x89PNG two")
SEEN = Request((SYSTEM, USER), COUNT, 3, pictures=PICTURES)


def test_pictures_follow_the_text_of_the_first_message_of_the_user_as_data_urls() -> None:
    again = (SYSTEM, USER, {"role": "assistant", "content": "many"}, {"role": "user", "content": "a number"})
    with endpoint(lambda *_: Act(body=said('{"mugs":2}'))) as server:
        engine = OpenAIEngine(server.settings())
        assert engine.complete([SEEN])[0].text == '{"mugs":2}'
        engine.complete([Request(again, COUNT, pictures=PICTURES), ask("x")])
        sent, *both = server.bodies
    plain, retried = sorted(both, key=lambda body: len(body["messages"]))  # they were sent at the same time
    assert sent["messages"][0] == SYSTEM
    text, *pictures = sent["messages"][1]["content"]
    assert text == {"type": "text", "text": "how many mugs"}
    found = [part["image_url"]["url"].partition("data:image/png;base64,")[2] for part in pictures]
    assert tuple(base64.b64decode(url) for url in found) == PICTURES
    assert sent["response_format"]["json_schema"] == {"name": "count", "strict": True, "schema": SCHEMA}
    assert [words_of(m["content"]) for m in retried["messages"]] == [m["content"] for m in again]
    assert [type(m["content"]) for m in retried["messages"]] == [str, list, str, str]
    assert plain["messages"] == [{"role": "user", "content": "x"}]
    assert plain["response_format"]["json_schema"]["name"] == "layout"


def test_a_refusal_of_pictures_is_one_requests_failure_and_says_what_may_be_wrong() -> None:
    with endpoint(lambda words, *_: Act(400, error("image input is not supported")) if "mugs" in words else None) as server:
        with_pictures, without = OpenAIEngine(server.settings()).complete([SEEN, ask("x")])
    assert (with_pictures.code, without.text) == ("request_refused", "echo x")
    assert "image input is not supported" in with_pictures.failure
    assert with_pictures.failure.endswith("or the model reads no pictures")


def test_caches_tell_pictures_apart_and_keep_the_keys_of_requests_without(tmp_path: Path) -> None:
    sampling = Sampling()
    others = [
        Request(SEEN.messages, COUNT, 3),
        Request(SEEN.messages, COUNT, 3, pictures=PICTURES[:1]),
        Request(SEEN.messages, COUNT, 3, pictures=PICTURES[::-1]),
        Request(SEEN.messages, JsonForm.of("count", {**SCHEMA, "title": "n"}), 3, pictures=PICTURES),
        Request(SEEN.messages, FORM, 3, pictures=PICTURES),
    ]
    keys = {ResponseCache.key("e", sampling, request) for request in (SEEN, *others)}
    assert len(keys) == 6
    assert ResponseCache.key("e", sampling, ask("x")).startswith("df8dc820750719f1")  # as before requests had pictures
    with endpoint(lambda *_: Act(body=said('{"mugs":2}'))) as server:
        for _ in range(2):
            engine = CachedEngine(OpenAIEngine(server.settings()), ResponseCache(tmp_path), sampling)
            assert [c.text for c in engine.complete([SEEN, others[1]])] == ['{"mugs":2}'] * 2
        assert len(server.bodies) == 2


def test_an_engine_that_reads_text_alone_refuses_pictures() -> None:
    engine = load_engine(EngineSettings())
    (found,) = engine.complete([SEEN])
    assert found == reads_no_pictures("embedded")
    assert found.code == "pictures_unsupported"


def test_a_form_by_a_schema_binds_the_replies_of_engines_in_this_process() -> None:
    tokenizer = llguidance.LLTokenizer("byte")
    for text, fits in (('{"mugs":2}', True), ('{"mugs":3}', False), ('{"cups":2}', False)):
        matcher = LLMatcher(tokenizer, LLMatcher.grammar_from_lark(COUNT.grammar()))
        assert not matcher.get_error()
        assert (matcher.try_consume_tokens(tokenizer.tokenize_str(text)) == len(text)) is fits, text


@pytest.mark.parametrize("binds", [True, False])
def test_only_a_form_that_binds_is_asked_of_the_endpoint(binds: bool) -> None:
    with endpoint() as server:
        OpenAIEngine(server.settings()).complete([Request((USER,), JsonForm("count", json.dumps(SCHEMA), binds))])
        assert ("response_format" in server.bodies[0]) is binds
