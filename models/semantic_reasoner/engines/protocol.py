"""The protocol of engines: requests in, one completion each out, in their order.

An engine never raises for a single request: an unanswered one gives a completion with a failure, and the others continue. The
constructor raises a ConfigError if the engine cannot work at all (a folder without a model, a missing extra).
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Protocol, TypeAlias, runtime_checkable

from models.semantic_reasoner.engines.incremental_batches import Conversation, batch_conversation
from models.semantic_reasoner.replies.grammar import ReplyGrammar
from models.semantic_reasoner.replies.json_form import JsonForm
from models.semantic_reasoner.text.prompt import Message
from models.semantic_reasoner.text.reply_json import LayoutObject
from models.settings import Count, NonNegative, PositiveCount, Settings, Share

OFF = (
    "certificate_refused",
    "endpoint_down",
    "key_refused",
    "model_unknown",
    "quota_spent",
    "redirect_refused",
)
"""Codes of failures of the engine itself: it would not answer another request either."""

UNANSWERED = ("connection_failed", "endpoint_error", "endpoint_timeout", "rate_limited")
"""Codes of failures of an endpoint for one request, which say nothing of its model."""


@dataclass(frozen=True, slots=True)
class Sampling(Settings):
    """How tokens are drawn; the defaults are those of MesaTask's released model."""

    temperature: NonNegative = 0.7
    """Temperature of the softmax; 0 takes the likeliest token."""

    top_p: Share = 0.9
    """Tokens are drawn from the smallest set that has at least this probability."""

    top_k: Count = 50
    """Tokens are drawn from this many likeliest ones; 0 sets no bound."""

    max_tokens: PositiveCount = 4096
    """Tokens; the longest reply."""

    redraws: Count = 8
    """How often the place of an object is drawn again, at most, while it is refused as soon as it is written; 0 refuses none."""


ReplyForm: TypeAlias = ReplyGrammar | JsonForm
"""The form of a reply: a layout, or another JSON document."""


@dataclass(frozen=True, slots=True)
class Request:
    """A chat to complete.

    Attributes:
        messages: The chat, as :func:`models.semantic_reasoner.text.prompt.messages` makes it.
        form: The form of the reply; engines that can constrain decoding use it.
        seed: Seed of the draws: with a reproducible engine the same request and seed give the same completion.
        refuses: Judges the last of the objects that a reply has so far. An engine in this process draws the place of a refused
            object again; other engines do not use it. None refuses nothing.
        pictures: PNG files, which the model sees after the text of the first message of the user. Only the ``openai`` engine sends
            pictures; a request with pictures is a failure in the engines in this process (``pictures_unsupported``).
    """

    messages: tuple[Message, ...]
    form: ReplyForm
    seed: int = 0
    refuses: Callable[[Sequence[LayoutObject]], bool] | None = None
    pictures: tuple[bytes, ...] = ()


@dataclass(frozen=True, slots=True)
class Completion:
    """The answer to a request.

    Attributes:
        text: The reply; empty after a failure.
        prompt_tokens: Tokens read; None if the endpoint did not say.
        reply_tokens: Tokens written; None likewise.
        failure: Why there is no reply, one line; empty if there is one.
        code: Short machine-readable reason of the failure, such as ``endpoint_down``; empty if there is none.
        is_cached: Whether it was read from a cache.
        cost: Cost in the currency of the engine's prices: 0 without prices, None if tokens with a price were not counted.
    """

    text: str
    prompt_tokens: int | None = 0
    reply_tokens: int | None = 0
    failure: str = ""
    code: str = ""
    is_cached: bool = False
    cost: float | None = 0.0


def is_too_long(num_prompt: int, longest: int) -> Completion:
    """Returns the completion of a request of ``num_prompt`` tokens for a model that reads ``longest``."""
    failure = f"the question has {num_prompt:,} tokens, the model reads {longest:,}; shorten it"
    return Completion("", num_prompt, failure=failure, code="prompt_too_long")


def reads_no_pictures(engine: str) -> Completion:
    """Returns the completion of a request with pictures for an engine, by its name, that reads text alone."""
    failure = f"{engine} reads text alone, but the question has pictures; use the openai engine with a model that sees"
    return Completion("", failure=failure, code="pictures_unsupported")


class Engine(Protocol):
    """A language model or a service that completes chats. Several threads may call it.

    Attributes:
        name: Name of the engine and its model, such as ``embedded`` or ``openai:gpt-4o``; part of cache keys and provenance.
        repeats: Whether the engine is reproducible: the same request and seed give the same text on one kind of machine.
    """

    name: str
    repeats: bool

    def complete(self, requests: Sequence[Request]) -> list[Completion]:
        """Returns one completion for each request, in their order."""
        ...


@runtime_checkable
class ClosableEngine(Protocol):
    """An engine with processes or memory of its own."""

    def close(self) -> None:
        """Ends them; further requests fail."""
        ...


def close_engine(engine: Engine) -> None:
    """Ends what an engine has started, if it has."""
    if isinstance(engine, ClosableEngine):
        engine.close()


@runtime_checkable
class ConversationEngine(Protocol):
    """An engine that accepts further requests while it completes others."""

    def converse(self, requests: Sequence[Request]) -> Conversation[Completion, Request]:
        """Yields completions and is sent the requests that follow; the order depends on the requests alone."""
        ...


def conversation(engine: Engine, requests: Sequence[Request]) -> Conversation[Completion, Request]:
    """Starts a conversation with an engine; one that cannot accept further requests meanwhile answers batch by batch."""
    if isinstance(engine, ConversationEngine):
        return engine.converse(requests)
    return batch_conversation(engine.complete, requests)
