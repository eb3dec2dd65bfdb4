"""Replies in the forms in which models that were not trained on our prompts give them.

They were written by hand: none was recorded from a real endpoint. The file keeps a reply of millions of characters as parts, each
repeated so many times.
"""

import json
from dataclasses import dataclass
from pathlib import Path
from typing import Any

FILE = Path(__file__).with_suffix(".json")


@dataclass(frozen=True, slots=True)
class EndpointReply:
    """One of them.

    Attributes:
        name: What is odd about it.
        content: The text of the message; None if the endpoint gives none.
        finish_reason: As in a chat completion.
        refusal: As in a chat completion.
        instances: The instances that are read from it; None if it is refused.
        code: Code of the fault for which it is refused.
        says: Words of that fault.
    """

    name: str
    content: str | None
    finish_reason: str = "stop"
    refusal: str | None = None
    instances: tuple[str, ...] | None = None
    code: str = ""
    says: str = ""

    def completion(self) -> dict[str, Any]:
        """The reply as an endpoint's answer to a request."""
        message = {"role": "assistant", "content": self.content, "refusal": self.refusal}
        choice = {"index": 0, "message": message, "finish_reason": self.finish_reason}
        return {"choices": [choice], "usage": {"prompt_tokens": 1400, "completion_tokens": 300}}


def task_replies() -> list[EndpointReply]:
    """Replies to the question for the task objects of "Move the mug next to the plate."."""
    return [_reply(**entry) for entry in _file()["task"]]


def good_replies(kind: str) -> list[str]:
    """Good replies, in their order: ``stages`` of one scene, the ``whole`` scene, or an ``edit`` of it."""
    return list(_file()[kind])


def _file() -> Any:
    return json.loads(FILE.read_text("utf-8"))


def _reply(content: str | list[Any] | None, instances: list[str] | None = None, **fields: str) -> EndpointReply:
    if isinstance(content, list):
        content = "".join(part * times for part, times in content)
    return EndpointReply(content=content, instances=None if instances is None else tuple(instances), **fields)
