"""How a model is spoken to: in our own words, stage by stage, or as MesaTask's released model was trained."""

import json
from collections.abc import Callable, Sequence
from typing import Protocol

from models.semantic_reasoner.language.required_objects import ObjectRequirement
from models.semantic_reasoner.replies.grammar import ReplyGrammar
from models.semantic_reasoner.text.prompt import RETRY, Message, ReasonerQuestion, check_instruction, messages
from models.semantic_reasoner.text.reply_json import LayoutReply, parse_reply, sanitise_words
from stable_data.errors import ConfigError, SceneError
from stable_data.mesatask.task_info import write_task_info
from stable_data.scene import TaskInfo


class PromptStyle(Protocol):
    """The words of questions and answers."""

    def messages(self, ask: ReasonerQuestion, refused: Sequence[tuple[str, str]] = ()) -> list[Message]:
        """The chat that asks, after answers that were refused and why."""
        ...

    def form(self, ask: ReasonerQuestion) -> ReplyGrammar:
        """What the answer may look like."""
        ...

    def parse(self, text: str) -> LayoutReply:
        """The answer's objects."""
        ...


class StagedPromptStyle:
    """Our own words; see :mod:`models.semantic_reasoner.text.prompt`.

    Args:
        asks: What must be among the objects of an answer; None demands nothing.
    """

    def __init__(self, asks: Callable[[ReasonerQuestion], tuple[ObjectRequirement, ...]] | None = None) -> None:
        self._asks = asks

    def messages(self, ask: ReasonerQuestion, refused: Sequence[tuple[str, str]] = ()) -> list[Message]:
        """The chat that asks for a stage, a whole layout or an edit."""
        return messages(ask, refused)

    def form(self, ask: ReasonerQuestion) -> ReplyGrammar:
        """Bound to the table, to what must be there and, in an edit, to the names that there are."""
        names = tuple(o.instance for o in ask.layout) if ask.edits else ()
        return ReplyGrammar.of_table(ask.table, edits=ask.edits, names=names, asks=self._asks(ask) if self._asks else ())

    def parse(self, text: str) -> LayoutReply:
        """The objects of JSON."""
        return parse_reply(text)


_FINAL = "**Final Answer**"
"""What stands before the layout in an answer of MesaTask's model."""

_MESATASK = """Lay out a tabletop scene for the task below. Frame: the table's front left corner is the origin, x to the right, y to \
the back, z up from the table top; lengths are centimetres, z_rotation degrees, 0 faces the observer. First reason in one paragraph \
about the core task objects and the environment objects and where each belongs (left, middle, right; front, middle, back). Then \
write the scene graph, one triple (a, relation, b) a line: left of, right of, in front of, behind, above, below, in, is at, face to. \
Then write, each on a line of its own,
Therefore, the scene layout is:
**Final Answer**
and the layout as JSON: {"item_placement_zone":[x_min,x_max,y_min,y_max],"objects":[{"instance":"pen_0","description":"...",\
"z_rotation":0.0,"size":[w,d,h],"position":[x,y,z]}]}, large objects first, "sink_zone" only where the task has one.
Task information:"""


class MesaTaskPromptStyle:
    """One question, one answer with reasons, scene graph and layout, as MesaTask's released model writes it.

    The model was trained on the project's own wording, which is not ours to ship: give it as ``wording``. Ours says the same.

    Args:
        wording: The text before the task information; ours by default.
    """

    def __init__(self, wording: str = "") -> None:
        self._wording = wording or _MESATASK

    def messages(self, ask: ReasonerQuestion, refused: Sequence[tuple[str, str]] = ()) -> list[Message]:
        """The chat that asks for a whole layout.

        Raises:
            SceneError: Something else is asked for (``stage_unknown``), or the instruction cannot be asked
                (``instruction_invalid``).
        """
        if ask.wanted != "whole":
            raise SceneError(
                f"{ask.wanted}: MesaTask's model knows whole layouts alone; ask for those (one shot)", "stage_unknown"
            )
        task = ask.details or TaskInfo("", check_instruction(ask.instruction))
        document = write_task_info(TaskInfo(*_said(task)), ask.table)
        text = f"{self._wording}\n{json.dumps(document, indent=2, ensure_ascii=False)}"
        chat = [{"role": "user", "content": text}]
        for answer, reason in refused:
            chat += [
                {"role": "assistant", "content": answer},
                {"role": "user", "content": RETRY.format(reason=sanitise_words(reason))},
            ]
        return chat

    def form(self, ask: ReasonerQuestion) -> ReplyGrammar:
        """Free: reasons come before the JSON."""
        return ReplyGrammar.of_table(ask.table, binds=False)

    def parse(self, text: str) -> LayoutReply:
        """The objects of the layout that follows the reasons.

        Raises:
            SceneError: There is no final answer (``reply_malformed``), or it is no layout.
        """
        _, found, layout = text.rpartition(_FINAL)
        if not found:
            raise SceneError(f"reply has no line {_FINAL}, expected one before the layout; ask again", "reply_malformed")
        return parse_reply(layout.partition("<|im_end|>")[0])


def _said(task: TaskInfo) -> tuple[str, str, tuple[str, ...], tuple[str, ...], tuple[str, ...]]:
    """What a model may be told of a task: not which instances it is about, nor what holds of them."""
    lists = (tuple(map(sanitise_words, words)) for words in (task.goal, task.action_sequence, task.objects_cluster))
    return sanitise_words(task.environment), sanitise_words(task.task), *lists  # type: ignore[return-value]


def prompt_style_of(
    name: str, wording: str = "", asks: Callable[[ReasonerQuestion], tuple[ObjectRequirement, ...]] | None = None
) -> PromptStyle:
    """A dialect by name.

    Args:
        name: ``stages`` or ``mesatask``.
        wording: Of MesaTask's question; empty takes ours.
        asks: What must be among the objects of an answer; of ``stages`` alone.

    Raises:
        ConfigError: There is none of that name.
    """
    if name == "stages":
        return StagedPromptStyle(asks)
    if name == "mesatask":
        return MesaTaskPromptStyle(wording)
    raise ConfigError(f"dialect is {name!r}, expected stages or mesatask", "config_invalid")
