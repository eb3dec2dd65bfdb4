"""What every engine is: requests in, one completion each out, in their order.

An engine never raises for one request: what could not be answered comes back as a completion with a failure, so that the
others go on. It raises a ConfigError when it is made, where it cannot work at all (a folder that is no model, an extra that is
missing).
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Protocol, runtime_checkable

from models.semantic_reasoner.engines.incremental_batches import Conversation, batch_conversation
from models.semantic_reasoner.replies.grammar import ReplyGrammar
from models.semantic_reasoner.text.prompt import Message
from models.settings import Count, NonNegative, PositiveCount, Settings, Share

OFF = (
    "certificate_refused",
    "endpoint_down",
    "key_refused",
    "model_unknown",
    "quota_spent",
    "redirect_refused",
)
"""Codes of failures that are the engine's and not the question's: no other question would be answered either."""


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


@dataclass(frozen=True, slots=True)
class Request:
    """One thing to be completed.

    Attributes:
        messages: The chat, as :func:`models.semantic_reasoner.text.prompt.messages` makes it.
        form: What replies may look like; engines that can, decode under it.
        seed: Of its draws: the same request with the same seed has the same completion, where the engine can repeat itself.
    """

    messages: tuple[Message, ...]
    form: ReplyGrammar
    seed: int = 0


@dataclass(frozen=True, slots=True)
class Completion:
    """What came back for a request.

    Attributes:
        text: The reply; empty where there is a failure.
        prompt_tokens: Tokens read.
        reply_tokens: Tokens written.
        failure: Why there is no reply, one line; empty where there is one.
        code: Short machine-readable reason of the failure, such as ``endpoint_down``; empty where there is none.
        is_cached: Whether it was replayed from a cache.
        cost: What it cost, in the currency of the engine's prices; 0 where they are not known.
    """

    text: str
    prompt_tokens: int = 0
    reply_tokens: int = 0
    failure: str = ""
    code: str = ""
    is_cached: bool = False
    cost: float = 0.0


def is_too_long(num_prompt: int, longest: int) -> Completion:
    """What comes back for a question that the model cannot read.

    Args:
        num_prompt: Tokens of the question.
        longest: Tokens that the model reads.
    """
    failure = f"the question has {num_prompt:,} tokens, the model reads {longest:,}; shorten it"
    return Completion("", num_prompt, failure=failure, code="prompt_too_long")


class Engine(Protocol):
    """Something that completes chats.

    Attributes:
        name: Names the engine and its model, such as ``embedded`` or ``openai:gpt-4o``; part of cache keys and provenance.
        repeats: Whether the same request and seed give the same text on one kind of machine.
    """

    name: str
    repeats: bool

    def complete(self, requests: Sequence[Request]) -> list[Completion]:
        """One completion for each request, in their order."""
        ...


@runtime_checkable
class ConversationEngine(Protocol):
    """An engine that takes further requests while it completes others."""

    def converse(self, requests: Sequence[Request]) -> Conversation[Completion, Request]:
        """Completions as they come, and requests that come of them; in an order that depends on nothing but the requests."""
        ...


def conversation(engine: Engine, requests: Sequence[Request]) -> Conversation[Completion, Request]:
    """Requests, and those that come of their completions: as they come where the engine can, else batch by batch.

    Args:
        engine: Any engine.
        requests: Those to begin with.
    """
    return (
        engine.converse(requests) if isinstance(engine, ConversationEngine) else batch_conversation(engine.complete, requests)
    )
