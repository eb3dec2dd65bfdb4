"""Questions that are not about a layout in this project's form: a chat, and how its answer is read.

They go through the same engine as the questions for layouts, so that batches, the response cache, prices and limits serve them too.
"""

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

from models.semantic_reasoner.engines.protocol import Completion, Request
from models.semantic_reasoner.replies.checks import ReplyFault
from models.semantic_reasoner.replies.json_form import JsonForm
from models.semantic_reasoner.replies.refused_reply import RefusedReply
from models.semantic_reasoner.text.prompt import Message, refusal_messages
from models.semantic_reasoner.text.reply_json import json_of_reply
from stable_data.errors import SceneError
from stable_data.random_seeds import named_seed
from stable_data.totals import total


@dataclass(frozen=True, slots=True, eq=False)
class ChatQuestion:
    """A chat to which a language model answers with a JSON document.

    Attributes:
        messages: The chat.
        form: The form of the answer.
        read: Reads the document; raises a SceneError that states what is wrong with it, for a model or a person.
        pictures: PNG files that the model sees with the first message of the user.
    """

    messages: tuple[Message, ...]
    form: JsonForm
    read: Callable[[Any], object]
    pictures: tuple[bytes, ...] = ()


@dataclass(frozen=True, slots=True)
class ChatReply:
    """The answer to a chat.

    Attributes:
        content: What ``read`` returned; None if no answer could be used.
        refused: The refused answers, in the order of the tries.
        failure: Why there is no content, one line; empty if there is.
        code: Short machine-readable reason of the failure.
        tries: How often the engine was asked.
        prompt_tokens: Tokens read, over all tries; None if the engine did not count them.
        reply_tokens: Tokens written, over all tries; None likewise.
        cost: Cost of all tries, in the currency of the engine's prices; None if it is not known.
    """

    content: object = None
    refused: tuple[RefusedReply, ...] = ()
    failure: str = ""
    code: str = ""
    tries: int = 0
    prompt_tokens: int | None = 0
    reply_tokens: int | None = 0
    cost: float | None = 0.0


@dataclass(slots=True, eq=False)
class PendingChat:
    """A chat without an accepted answer.

    Attributes:
        question: The chat.
        seed: Seed of the draws.
        most_tries: How often it is asked, at most.
        tells_reasons: Whether a retry shows the refused answers and the reasons.
        refused: The refused answers so far.
        tries: How often it was asked.
    """

    question: ChatQuestion
    seed: int
    most_tries: int
    tells_reasons: bool
    refused: list[RefusedReply] = field(default_factory=list)
    tries: int = 0
    prompt_tokens: int | None = 0
    reply_tokens: int | None = 0
    cost: float | None = 0.0

    def request(self) -> Request:
        """Returns the next request."""
        refused = [(r.answer, r.reason) for r in self.refused] if self.tells_reasons else []
        chat = (*self.question.messages, *refusal_messages(refused))
        seed = named_seed(self.seed, self.question.form.name, self.tries)
        return Request(chat, self.question.form, seed, pictures=self.question.pictures)

    def judge(self, completion: Completion) -> ChatReply | None:
        """Returns the reply that an answer gives; None if the chat has to be asked again."""
        self.tries += 1
        self.prompt_tokens = total((self.prompt_tokens, completion.prompt_tokens))
        self.reply_tokens = total((self.reply_tokens, completion.reply_tokens))
        self.cost = total((self.cost, completion.cost))
        if completion.code.startswith("reply_"):  # the engine answered, but the answer cannot be used
            return self._refuse(completion.text, completion.code, completion.failure)
        if completion.failure:
            return self._reply(failure=completion.failure, code=completion.code)
        try:
            keys = list(self.question.form.schema()["properties"])
            return self._reply(self.question.read(json_of_reply(completion.text, keys)))
        except SceneError as error:
            return self._refuse(completion.text, error.code, str(error))

    def _refuse(self, answer: str, code: str, reason: str) -> ChatReply | None:
        self.refused.append(RefusedReply(answer, (ReplyFault(code, reason),)))
        if self.tries < self.most_tries:
            return None
        failure = f"{self.tries} answers could not be used, the last because {reason}"
        return self._reply(failure=failure, code="reply_unusable")

    def _reply(self, content: object = None, failure: str = "", code: str = "") -> ChatReply:
        counts = (self.tries, self.prompt_tokens, self.reply_tokens, self.cost)
        return ChatReply(content, tuple(self.refused), failure, code, *counts)
