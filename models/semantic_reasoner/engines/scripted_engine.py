"""An engine that answers what it was told to: for tests, and to try a pipeline without a model."""

import json
import threading
from collections import deque
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import TypeAlias

from models.semantic_reasoner.engines.protocol import Completion, Request
from stable_data.errors import ConfigError, StableDataError

Reply: TypeAlias = str | Completion
"""A text, or a whole completion: this is how failures are injected, by code."""

Script: TypeAlias = Mapping[str, Reply] | Sequence[Reply] | Callable[[Request], Reply]
"""Where replies come from; see :class:`ScriptedEngine`."""

_MOST_KEPT = 1000


class ScriptedEngine:
    """Answers from a script.

    Args:
        script: By words: the first key that is within the last message, such as its instruction, has the reply. In order: one
            reply after another, over all calls. Or a function of the request; an error of the toolkit that it raises becomes
            a failure with its code.
        name: Of the engine.

    Attributes:
        repeats: Whether the same request has the same reply: not where replies come in order.
        requests: What it was asked last, a thousand at most: runs of many scenes ask it too.
    """

    def __init__(self, script: Script, name: str = "scripted") -> None:
        self.name, self._script = name, script
        self.repeats = callable(script) or isinstance(script, Mapping)
        self.requests: deque[Request] = deque(maxlen=_MOST_KEPT)
        self._num_asked = 0
        self._lock = threading.Lock()

    @classmethod
    def from_file(cls, path: Path) -> "ScriptedEngine":
        """Reads a script.

        Args:
            path: JSON: a list of replies, or an object of replies by words; a reply is a text or is itself JSON.

        Raises:
            ConfigError: It cannot be read, or is neither (``script_invalid``).
        """
        try:
            script = json.loads(path.read_bytes())
        except (OSError, ValueError, RecursionError) as error:
            raise ConfigError(
                f"{path}: cannot be read as JSON ({error}); expected a list or an object", "script_invalid"
            ) from error
        if isinstance(script, list):
            return cls([_text(reply) for reply in script])
        if isinstance(script, dict):
            return cls({words: _text(reply) for words, reply in script.items()})
        raise ConfigError(f"{path} is {type(script).__name__}, expected a list or an object of replies", "script_invalid")

    def complete(self, requests: Sequence[Request]) -> list[Completion]:
        """One completion for each request, in their order."""
        with self._lock:  # replies in order stay in order
            return [self._complete(request) for request in requests]

    def _complete(self, request: Request) -> Completion:
        at = self._num_asked
        self._num_asked += 1
        self.requests.append(request)
        try:
            reply = self._reply(request, at)
        except StableDataError as error:
            return Completion("", failure=str(error), code=error.code)
        return reply if isinstance(reply, Completion) else Completion(reply)

    def _reply(self, request: Request, at: int) -> Reply:
        if callable(self._script):
            return self._script(request)
        if isinstance(self._script, Mapping):
            question = request.messages[-1]["content"]
            for words, reply in self._script.items():
                if words in question:
                    return reply
            raise ConfigError(f"script has no words of {question[-80:]!r}; add some to it", "script_silent")
        if at >= len(self._script):
            raise ConfigError(
                f"script has {len(self._script)} replies, and this is request {at + 1}; add more", "script_silent"
            )
        return self._script[at]


def _text(reply: object) -> str:
    return reply if isinstance(reply, str) else json.dumps(reply, ensure_ascii=False, separators=(",", ":"))
