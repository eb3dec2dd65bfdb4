"""The OpenAI protocol of chat completions, both sides of it, as plain data: what is sent, and what an answer says.

The field ``stable_data`` is ours: it carries what the protocol has no word for, and goes to :mod:`.chat_server` alone, since
endpoints refuse fields that they do not know.
"""

import json
import re
from collections.abc import Mapping
from dataclasses import asdict
from typing import Any, TypeAlias

from models.semantic_reasoner.engines.protocol import Completion, Request, Sampling
from models.semantic_reasoner.language.required_objects import ObjectRequirement
from models.semantic_reasoner.replies.grammar import CATEGORY, ReplyGrammar
from models.semantic_reasoner.text.prompt import Message

Fields: TypeAlias = dict[str, Any]
"""A JSON object."""

EXTENSION = "stable_data"
"""Our field of a request: the form of its replies and ``top_k``."""

COMPLETION_FAILED = "completion_failed"
"""``type`` of the error by which a chat server hands on a failure of its engine."""

SPELLINGS: dict[str, tuple[str, ...]] = {
    "response_format": ("json_schema", "json_object", ""),
    "max_tokens": ("max_tokens", "max_completion_tokens"),
    "temperature": ("temperature", ""),
    "top_p": ("top_p", ""),
    "seed": ("seed", ""),
}
"""How a field may be said, the best way first; empty leaves it out. Endpoints differ in what they take."""

LONGEST_SEED = 2**63

_STRICT = {"type", "enum", "pattern", "minimum", "maximum", "minItems", "maxItems", "required", "additionalProperties"}
"""Keywords that OpenAI's strict mode takes; lengths of strings are none of them."""

_FORMAT_WORDS = re.compile(r"response_?format|json_?schema|json_object|structured.output|guided|grammar", re.IGNORECASE)
_UNKNOWN_WORDS = re.compile(r"(un|not )(support|recogni|known|expected|permitted|allowed)|extra (field|input)", re.IGNORECASE)
_SURROGATES = re.compile("[\ud800-\udfff]")

_ANY_TABLE_CM = 500.0  # of a request that says nothing of its table


# --- the side that asks -------------------------------------------------------------------------------------------------------


def request_body(model: str, request: Request, sampling: Sampling, spelt: Mapping[str, str], *, with_form: bool) -> Fields:
    """The body of a POST to ``/chat/completions``.

    Args:
        model: The endpoint's name of the model.
        request: What is to be completed.
        sampling: How.
        spelt: Of each field of :data:`SPELLINGS`, how it is said.
        with_form: Whether our own field is sent.
    """
    values = {
        "max_tokens": sampling.max_tokens,
        "temperature": sampling.temperature,
        "top_p": sampling.top_p,
        "seed": request.seed % LONGEST_SEED,
    }
    body: Fields = {"model": model, "messages": list(request.messages)}
    body |= {spelt[name]: value for name, value in values.items() if spelt[name]}
    if not request.form.binds:
        pass  # it says what it likes
    elif spelt["response_format"] == "json_schema":
        schema = {"name": "layout", "strict": True, "schema": strict_schema(request.form.schema())}
        body["response_format"] = {"type": "json_schema", "json_schema": schema}
    elif spelt["response_format"]:
        body["response_format"] = {"type": spelt["response_format"]}
    if with_form:
        body[EXTENSION] = {"form": asdict(request.form), "top_k": sampling.top_k}
    return body


def strict_schema(schema: Mapping[str, Any]) -> Fields:
    """A schema with nothing but the keywords that OpenAI's strict mode takes."""
    kept = {key: value for key, value in schema.items() if key in _STRICT}
    if "properties" in schema:
        kept["properties"] = {name: strict_schema(of) for name, of in schema["properties"].items()}
    if "items" in schema:
        kept["items"] = strict_schema(schema["items"])
    return kept


def completion_of(answer: Any, prompt_price: float = 0.0, reply_price: float = 0.0) -> Completion:
    """What an answer with status 200 says.

    Args:
        answer: Its JSON.
        prompt_price: Of a million tokens read.
        reply_price: Of a million tokens written.

    Returns:
        The completion; a reply that was cut, filtered, refused or is empty is a failure, and costs nevertheless.

    Raises:
        ValueError: It is no chat completion.
    """
    choices = answer.get("choices") if isinstance(answer, dict) else None
    message = choices[0].get("message") if isinstance(choices, list) and choices and isinstance(choices[0], dict) else None
    if not isinstance(choices, list) or not isinstance(message, dict):
        raise ValueError("answer has no choices[0].message")
    content, refusal = message.get("content"), message.get("refusal")
    if not isinstance(content, str | None):
        raise ValueError(f"choices[0].message.content is {type(content).__name__}, expected text")
    content = _SURROGATES.sub("\ufffd", content or "")  # halves of a pair cannot be written as UTF-8
    failure, code = _flaw(content, choices[0].get("finish_reason"), refusal)
    read, written = tokens_of(answer)
    cost = (read * prompt_price + written * reply_price) / 1e6
    return Completion("" if failure else content, read, written, failure, code, cost=cost)


def _flaw(content: str, finish_reason: Any, refusal: Any) -> tuple[str, str]:
    """Why a reply cannot be used, and its code; both empty where it can."""
    if finish_reason == "length":
        return "reply was cut at the longest allowed; raise max_tokens", "reply_cut"
    if finish_reason == "content_filter":
        return "reply was held back by the endpoint's content filter; reword the instruction", "reply_filtered"
    if refusal:
        return f"model refused: {one_line(str(refusal))}; reword the instruction", "reply_refused"
    if not content.strip():
        return "reply is empty; ask again with another seed", "reply_empty"
    return "", ""


def tokens_of(answer: Any) -> tuple[int, int]:
    """Tokens read and written by an answer's ``usage``; 0 where it does not say."""
    usage = answer.get("usage") if isinstance(answer, dict) else None
    counts = [usage.get(key) if isinstance(usage, dict) else None for key in ("prompt_tokens", "completion_tokens")]
    read, written = (c if isinstance(c, int) and not isinstance(c, bool) and c >= 0 else 0 for c in counts)
    return read, written


def error_of(answer: Any) -> Fields:
    """``message``, ``type``, ``code`` and ``param`` of an error's body, as texts; endpoints differ in how they nest them."""
    error = answer.get("error", answer) if isinstance(answer, dict) else answer
    if not isinstance(error, dict):
        error = {"message": error if isinstance(error, str) else ""}
    message = error.get("message") or error.get("detail") or ""
    words = message if isinstance(message, str) else json.dumps(message)
    return {"message": words, **{key: str(error.get(key) or "") for key in ("type", "code", "param")}}


def refused_field(error: Mapping[str, str]) -> str | None:
    """Which field of :data:`SPELLINGS` an endpoint does not take, by its error with status 400 or 422."""
    param, message, code = error["param"], error["message"], error["code"]
    if param.startswith("response_format") or _FORMAT_WORDS.search(f"{message} {code}"):
        return "response_format"
    named = [name for name in SPELLINGS if name == param or re.search(rf"\b{name}\b", message)]
    is_unknown = code.startswith("unsupported") or _UNKNOWN_WORDS.search(message)
    return named[0] if named and is_unknown else None


def one_line(words: str, longest: int = 300) -> str:
    """Words from outside as one line of limited length."""
    line = " ".join(words.split())
    return line if len(line) <= longest else f"{line[: longest - 3]}..."


# --- the side that answers ----------------------------------------------------------------------------------------------------


def request_of(body: Any, default: Sampling) -> tuple[Request, Sampling]:
    """What a body asks for.

    The form of the replies is what our own field says; without it, as near as the schema's limits tell; without both, any
    layout on a large table.

    Args:
        body: JSON of a POST to ``/chat/completions``.
        default: What holds where the body is silent.

    Returns:
        The request, and its sampling.

    Raises:
        ValueError: It is not in the form of one, or asks for several choices or a stream.
    """
    if not isinstance(body, dict):
        raise ValueError("body is no JSON object")
    if body.get("stream") or body.get("n") not in (None, 1):
        raise ValueError("stream and n > 1 are not supported; ask for one whole reply")
    ours = body.get(EXTENSION, {})
    if not isinstance(ours, dict):
        raise ValueError(f"{EXTENSION} is no JSON object")
    form = _form(ours["form"]) if "form" in ours else _form_of_schema(body.get("response_format"))
    longest = body.get("max_completion_tokens", body.get("max_tokens"))
    sampling = Sampling(
        float(_number(body, "temperature", default.temperature)),
        float(_number(body, "top_p", default.top_p)),
        int(_number(ours, "top_k", default.top_k)),
        int(_number({"max_tokens": longest}, "max_tokens", default.max_tokens)),
    )
    return Request(_messages(body.get("messages")), form, int(_number(body, "seed", 0))), sampling


def _messages(messages: Any) -> tuple[Message, ...]:
    if not isinstance(messages, list) or not messages:
        raise ValueError("messages is missing or empty")
    for m in messages:
        if not isinstance(m, dict) or not isinstance(m.get("role"), str) or not isinstance(m.get("content"), str):
            raise ValueError("a message needs role and content, both text")
    return tuple({"role": m["role"], "content": m["content"]} for m in messages)


def _number(fields: Mapping[str, Any], key: str, default: float) -> float:
    value = fields.get(key)
    if value is None:
        return default
    if not isinstance(value, int | float) or isinstance(value, bool) or not 0 <= value < LONGEST_SEED:
        raise ValueError(f"{key} is {value!r:.80}, expected a number of 0 or more")
    return value


def _form(fields: Any) -> ReplyGrammar:
    try:
        asks = tuple(ObjectRequirement(**{**asked, "categories": tuple(asked["categories"])}) for asked in fields["asks"])
        if not all(CATEGORY.fullmatch(c) for asked in asks for c in asked.categories):
            raise ValueError(f"a category is not {CATEGORY.pattern}")
        form = ReplyGrammar(**{**fields, "names": tuple(fields["names"]), "asks": asks})
        form.grammar()
    except (ArithmeticError, LookupError, TypeError, ValueError) as error:
        raise ValueError(f"{EXTENSION}.form is no form of replies ({error})") from error
    return form


def _form_of_schema(response_format: Any) -> ReplyGrammar:
    """The narrowest form that allows all that a schema of layouts allows."""
    try:
        properties = response_format["json_schema"]["schema"]["properties"]
        objects = properties["objects"]
        side = float(objects["items"]["properties"]["position"]["items"]["maximum"])
        names = tuple(map(str, properties["remove"]["items"]["enum"])) if "remove" in properties else ()
        form = ReplyGrammar(side, side, bool(names), names, int(objects["minItems"]), int(objects["maxItems"]))
        form.grammar()
    except (ArithmeticError, LookupError, TypeError, ValueError):
        return ReplyGrammar(_ANY_TABLE_CM, _ANY_TABLE_CM)
    return form


def answer_body(completion: Completion, model: str, number: int, created: int) -> Fields:
    """The answer that hands on a reply, or the error that hands on a failure; both say the tokens.

    Args:
        completion: What the engine gave.
        model: Its name.
        number: Of the answer, unique in its server.
        created: Seconds since 1970.
    """
    read, written = completion.prompt_tokens, completion.reply_tokens
    usage = {"prompt_tokens": read, "completion_tokens": written, "total_tokens": read + written}
    if completion.failure:
        return {**error_body(completion.failure, COMPLETION_FAILED, completion.code), "usage": usage}
    message = {"role": "assistant", "content": completion.text, "refusal": None}
    return {
        "id": f"chatcmpl-{number}",
        "object": "chat.completion",
        "created": created,
        "model": model,
        "choices": [{"index": 0, "message": message, "finish_reason": "stop", "logprobs": None}],
        "usage": usage,
    }


def error_body(message: str, kind: str, code: str) -> Fields:
    """An error as the protocol has it."""
    return {"error": {"message": message, "type": kind, "code": code, "param": None}}
