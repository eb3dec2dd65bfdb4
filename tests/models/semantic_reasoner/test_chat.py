"""Chats beside questions for layouts: the same engine, the same tries, one failure each."""

from typing import Any

import llguidance
import pytest
from llguidance import LLMatcher

from models.semantic_reasoner.chat import ChatQuestion, ChatReply
from models.semantic_reasoner.engines.incremental_batches import collect_answers
from models.semantic_reasoner.engines.openai_engine import request_fields
from models.semantic_reasoner.engines.protocol import Completion, Request, Sampling
from models.semantic_reasoner.engines.response_cache import CachedEngine, ResponseCache
from models.semantic_reasoner.engines.scripted_engine import ScriptedEngine
from models.semantic_reasoner.reasoner import Proposal, SemanticReasoner
from models.semantic_reasoner.replies.json_form import JsonForm, closed_object
from stable_data.errors import SceneError
from tests.models.semantic_reasoner.test_reasoner import ASK, GOOD, Told, faults

FORM = JsonForm.of("colours", closed_object({"colours": {"type": "array", "items": {"type": "string"}, "maxItems": 3}}))


def colours(document: Any) -> tuple[str, ...]:
    found = document.get("colours") if isinstance(document, dict) else None
    if not isinstance(found, list):
        raise SceneError("there are no colours; name some", "reply_malformed")
    return tuple(found)


CHAT = ChatQuestion(({"role": "user", "content": "Which colours?"},), FORM, colours)


def told(engine: Any, tries: int = 3, tells_reasons: bool = True) -> ChatReply:
    reasoner = SemanticReasoner(engine, faults, tries, tells_reasons)
    (found,) = collect_answers(reasoner.converse([(CHAT, 7)]), 1)
    assert isinstance(found, ChatReply)
    return found


def test_a_chat_is_answered_beside_a_question_for_a_layout() -> None:
    engine = Told(['{"colours":["red"]}', GOOD])
    both = collect_answers(SemanticReasoner(engine, faults).converse([(CHAT, 1), (ASK, 1)]), 2)
    assert isinstance(both[0], ChatReply)
    assert both[0].content == ("red",)
    assert (both[0].tries, both[0].prompt_tokens, both[0].reply_tokens, both[0].cost) == (1, 10, 5, 0.5)
    assert isinstance(both[1], Proposal)
    assert both[1].failure == ""


@pytest.mark.parametrize(
    "answer",
    [
        'Sure! Here they are:\n```json\n{"colours": ["red", "blue"],}\n```',
        'A set such as {red} is fine. {"colours":["red","blue"]}',
        '{"colours":["red","blue"],"note":"two"}',
    ],
)
def test_what_surrounds_the_document_is_skipped(answer: str) -> None:
    assert told(Told([answer])).content == ("red", "blue")


@pytest.mark.parametrize(
    ("answer", "code"),
    [
        ("I would rather not.", "reply_not_json"),
        ("", "reply_not_json"),
        ('{"colours": ["red", ', "reply_not_json"),
        ('{"colors": ["red"]}', "reply_malformed"),
        (Completion("", failure="cut at max_tokens", code="reply_cut"), "reply_cut"),
        ("x" * 2**19, "reply_too_long"),
    ],
)
def test_a_faulty_answer_is_refused_and_asked_for_again_with_the_reason(answer: str | Completion, code: str) -> None:
    engine = Told([answer], ['{"colours":[]}'])
    found = told(engine)
    assert found.content == ()
    assert (found.tries, [r.faults[0].code for r in found.refused]) == (2, [code])
    first, second = engine.asked[0][0], engine.asked[1][0]
    assert len(second.messages) == len(first.messages) + 2
    assert second.seed != first.seed
    found = told(Told([answer] * 1, [answer] * 1), tries=2, tells_reasons=False)
    assert found.content is None
    assert (found.code, found.tries) == ("reply_unusable", 2)
    assert "2 answers could not be used" in found.failure


def test_an_engine_that_is_off_is_not_asked_again() -> None:
    engine = Told([Completion("", failure="down", code="endpoint_down")])
    found = told(engine)
    assert (found.code, found.failure, found.refused, found.tries) == ("endpoint_down", "down", (), 1)


def test_equal_chats_are_read_from_the_cache(tmp_path: Any) -> None:
    script = ScriptedEngine(lambda _: '{"colours":["red"]}')
    cached = CachedEngine(script, ResponseCache(tmp_path), Sampling())
    assert told(cached).content == told(cached).content == ("red",)
    assert len(script.requests) == 1


def test_endpoints_are_asked_for_the_form_by_its_name() -> None:
    fields = request_fields(Request(CHAT.messages, FORM, 3), Sampling())
    assert fields["response_format"]["json_schema"] == {"name": "colours", "strict": True, "schema": FORM.schema()}


@pytest.mark.parametrize(
    ("text", "is_allowed"),
    [
        ('{"colours":["red","blue"]}', True),
        ('{"colours":[]}', True),
        ('{"colours":["a","b","c","d"]}', False),
        ('{"colors":[]}', False),
        ('{ "colours":[]}', False),
    ],
)
def test_local_models_are_bound_to_the_form(text: str, is_allowed: bool) -> None:
    tokenizer = llguidance.LLTokenizer("byte")
    matcher = LLMatcher(tokenizer, LLMatcher.grammar_from_lark(FORM.grammar()))
    assert not matcher.is_error(), matcher.get_error()
    tokens = tokenizer.tokenize_str(text)
    assert (matcher.try_consume_tokens(tokens) == len(tokens) and matcher.is_accepting()) == is_allowed
