"""An engine with given replies: for tests, and to try a pipeline without a model."""

import json
import threading
from collections import deque
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import TypeAlias

from models.semantic_reasoner.engines.protocol import Completion, Request
from stable_data.errors import ConfigError, StableDataError
from stable_data.json_text import read_json

Reply: TypeAlias = str | Completion
"""A text, or a whole completion, with which tests inject failures."""

Script: TypeAlias = Mapping[str, Reply] | Sequence[Reply] | Callable[[Request], Reply]
"""The source of replies; see :class:`ScriptedEngine`."""

_MAX_REQUESTS = 1000


class ScriptedEngine:
    """An engine that answers from a script.

    Args:
        script: A mapping: the first key that the last message contains, such as its instruction, gives the reply. A sequence:
            one reply after another, over all calls. A function of the request: if it raises an error of the toolkit, the
            completion is a failure with its code.
        name: Name of the engine.

    Attributes:
        repeats: Whether the same request has the same reply; False for a sequence.
        requests: The last thousand requests; the limit bounds the memory in runs of many scenes.
    """

    def __init__(self, script: Script, name: str = "scripted") -> None:
        self.name, self._script = name, script
        self.repeats = callable(script) or isinstance(script, Mapping)
        self.requests: deque[Request] = deque(maxlen=_MAX_REQUESTS)
        self._num_asked = 0
        self._lock = threading.Lock()

    @classmethod
    def from_file(cls, path: Path) -> "ScriptedEngine":
        """Reads a script from a JSON file: a list of replies, or an object of replies by key; a reply is a text or JSON.

        Raises:
            ConfigError: The file cannot be read, or has neither (``script_invalid``).
        """
        try:
            script = read_json(path)
        except (OSError, ValueError) as error:
            raise ConfigError(
                f"{path}: cannot be read as JSON ({error}); expected a list or an object", "script_invalid"
            ) from error
        if isinstance(script, list):
            return cls([_text(reply) for reply in script])
        if isinstance(script, dict):
            return cls({words: _text(reply) for words, reply in script.items()})
        raise ConfigError(f"{path} is {type(script).__name__}, expected a list or an object of replies", "script_invalid")

    def complete(self, requests: Sequence[Request]) -> list[Completion]:
        """Returns one completion for each request, in their order."""
        with self._lock:  # so that a sequence of replies stays in order
            return [self._complete(request) for request in requests]

    def _complete(self, request: Request) -> Completion:
        number = self._num_asked
        self._num_asked += 1
        self.requests.append(request)
        try:
            reply = self._reply(request, number)
        except StableDataError as error:
            return Completion("", failure=str(error), code=error.code)
        return reply if isinstance(reply, Completion) else Completion(reply)

    def _reply(self, request: Request, number: int) -> Reply:
        if callable(self._script):
            return self._script(request)
        if isinstance(self._script, Mapping):
            question = request.messages[-1]["content"]
            for words, reply in self._script.items():
                if words in question:
                    return reply
            raise ConfigError(f"script has no key within {question[-80:]!r}; add one to it", "script_silent")
        if number >= len(self._script):
            raise ConfigError(
                f"script has {len(self._script)} replies, and this is request {number + 1}; add more", "script_silent"
            )
        return self._script[number]


def _text(reply: object) -> str:
    return reply if isinstance(reply, str) else json.dumps(reply, ensure_ascii=False, separators=(",", ":"))
