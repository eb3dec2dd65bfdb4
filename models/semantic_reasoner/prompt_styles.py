"""Styles of prompts: this project's own, the same explained to models that were not trained on it, and MesaTask's."""

import json
from collections.abc import Sequence
from dataclasses import replace
from typing import Protocol

from models.semantic_reasoner.language.interpreter import InstructionInterpreter
from models.semantic_reasoner.replies.grammar import ReplyGrammar
from models.semantic_reasoner.text.prompt import (
    SYSTEM,
    Message,
    ReasonerQuestion,
    check_instruction,
    messages,
    refusal_messages,
)
from models.semantic_reasoner.text.reply_json import LayoutReply, parse_reply, sanitise_words
from models.semantic_reasoner.text.zero_shot_prompt import ZERO_SHOT_SYSTEM
from stable_data.errors import ConfigError, SceneError
from stable_data.mesatask.task_info import write_task_info
from stable_data.metrics.matching import RequiredObject
from stable_data.scene import Stage, TaskInfo


class PromptStyle(Protocol):
    """The form of questions and answers."""

    def messages(self, question: ReasonerQuestion, refused: Sequence[tuple[str, str]] = ()) -> list[Message]:
        """Returns the chat that asks a question, with refused answers and the reason for each."""
        ...

    def form(self, question: ReasonerQuestion) -> ReplyGrammar:
        """Returns the grammar of the answer."""
        ...

    def parse(self, text: str) -> LayoutReply:
        """Returns the objects of an answer."""
        ...


class StagedPromptStyle:
    """This project's own style; see :mod:`models.semantic_reasoner.text.prompt`.

    Args:
        interpret: Interprets instructions, so that an answer must contain the required objects; None requires nothing.
        rewords: Whether the engine knows only some words, so that a prompt has the interpreter's wording and a known table.
        system: The system message; by default the one on which models are trained.
        requires: Whether the model was trained on questions that state the required objects and relations.
    """

    def __init__(
        self,
        interpret: InstructionInterpreter | None = None,
        rewords: bool = False,
        system: str = SYSTEM,
        requires: bool = False,
    ) -> None:
        self._interpret, self._rewords, self._system, self._requires = interpret, rewords, system, requires

    def messages(self, question: ReasonerQuestion, refused: Sequence[tuple[str, str]] = ()) -> list[Message]:
        """Returns the chat that asks for a stage, a whole layout or an edit."""
        instruction = question.instruction
        if self._interpret is not None and self._rewords:
            check_instruction(question.instruction)
            wording = self._interpret(question.instruction, question.edits).wording
            table_type, _ = self._interpret.table_type(question.table.table_type)
            question = replace(question, instruction=wording, table=replace(question.table, table_type=table_type))
        if self._interpret is not None and self._requires and question.wanted in (Stage.TASK, "whole"):
            question = replace(question, required=self._interpret(instruction).phrases)
        return messages(question, refused, self._system)

    def form(self, question: ReasonerQuestion) -> ReplyGrammar:
        """Returns a grammar bound to the table, to the required objects and, in an edit, to the names of the layout."""
        names = tuple(o.instance for o in question.layout) if question.edits else ()
        asks: tuple[RequiredObject, ...] = ()
        if self._interpret is not None and question.wanted in (Stage.TASK, "whole"):
            reference = self._interpret(question.instruction).reference
            asks = () if reference is None else reference.required
        return ReplyGrammar.of_table(question.table, edits=question.edits, names=names, asks=asks)

    def parse(self, text: str) -> LayoutReply:
        """Returns the objects of a JSON reply."""
        return parse_reply(text)


_FINAL = "**Final Answer**"
"""The line before the layout in an answer of MesaTask's model."""

MESATASK_TEXT = """Lay out a tabletop scene for the task below. Frame: the table's front left corner is the origin, x to the right, y to \
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
    """The style of MesaTask's released model: one question, and one answer with reasons, scene graph and layout.

    The model was trained with MesaTask's own text, which may not be shipped here: give it as ``wording``. The default text has
    the same meaning.

    Args:
        wording: The text before the task information; empty uses the default text.
    """

    def __init__(self, wording: str = "") -> None:
        self._wording = wording or MESATASK_TEXT

    def messages(self, question: ReasonerQuestion, refused: Sequence[tuple[str, str]] = ()) -> list[Message]:
        """Returns the chat that asks for a whole layout.

        Raises:
            SceneError: The question is not for a whole layout (``stage_unknown``), or the instruction is empty or too long
                (``instruction_invalid``).
        """
        if question.wanted != "whole":
            raise SceneError(
                f"{question.wanted}: MesaTask's model answers with whole layouts only; ask for those (one shot)",
                "stage_unknown",
            )
        task = question.details or TaskInfo("", check_instruction(question.instruction))
        document = write_task_info(TaskInfo(*_prompt_fields(task)), question.table)
        text = f"{self._wording}\n{json.dumps(document, indent=2, ensure_ascii=False)}"
        return [{"role": "user", "content": text}, *refusal_messages(refused)]

    def form(self, question: ReasonerQuestion) -> ReplyGrammar:
        """Returns a grammar that does not bind, since reasons precede the JSON."""
        return ReplyGrammar.of_table(question.table, binds=False)

    def parse(self, text: str) -> LayoutReply:
        """Returns the objects of the layout after the reasons.

        Raises:
            SceneError: There is no final answer (``reply_malformed``), or it is not a layout.
        """
        _, found, layout = text.rpartition(_FINAL)
        if not found:
            raise SceneError(f"reply has no line {_FINAL}, expected one before the layout; ask again", "reply_malformed")
        return parse_reply(layout.partition("<|im_end|>")[0])


def _prompt_fields(task: TaskInfo) -> tuple[str, str, tuple[str, ...], tuple[str, ...], tuple[str, ...]]:
    """The fields of a task that a prompt may contain: not its instances nor their relations, which are the answer."""
    lists = (tuple(map(sanitise_words, words)) for words in (task.goal, task.action_sequence, task.objects_cluster))
    return sanitise_words(task.environment), sanitise_words(task.task), *lists  # type: ignore[return-value]


def prompt_style_of(
    name: str,
    wording: str = "",
    interpret: InstructionInterpreter | None = None,
    rewords: bool = False,
    requires: bool = False,
) -> PromptStyle:
    """Returns a prompt style by name.

    Args:
        name: ``stages``, ``zero_shot`` or ``mesatask``.
        wording: Text of MesaTask's question; empty uses the default text.
        interpret: Interprets instructions; not used by ``mesatask``.
        rewords: See :class:`StagedPromptStyle`.
        requires: See :class:`StagedPromptStyle`; a question in the style ``zero_shot`` always states what is required.

    Raises:
        ConfigError: The name is unknown.
    """
    if name == "stages":
        return StagedPromptStyle(interpret, rewords, requires=requires)
    if name == "zero_shot":
        return StagedPromptStyle(interpret, rewords, ZERO_SHOT_SYSTEM, requires=True)
    if name == "mesatask":
        return MesaTaskPromptStyle(wording)
    raise ConfigError(f"dialect is {name!r}, expected stages, zero_shot or mesatask", "config_invalid")
