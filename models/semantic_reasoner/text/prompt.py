"""The prompts of the reasoner: one chat template for the three stages, the one-shot variant and edits.

The system message with the frame and its units is the same in every request. Then follow the instruction I, the table T, the
layout so far (as corrected) and the wanted stage. The answer is JSON (:mod:`models.semantic_reasoner.text.reply_json`) without
a chain of thought, as in the paper's Sec. "Semantic Reasoner". The fixed parts are constants, each of which a tokenizer can
make one token.
"""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Literal, TypeAlias

from models.semantic_reasoner.text.reply_json import DECIMALS, LayoutObject, render_objects, sanitise_words
from stable_data.errors import SceneError
from stable_data.json_text import is_unicode
from stable_data.limits import LIMITS, at_most
from stable_data.scene import Relation, Stage, Tabletop, TaskInfo

PROMPT_VERSION = 1
"""Raised whenever a fixed part changes, since models are trained on one version."""

Message: TypeAlias = dict[str, str]
"""``role`` and ``content``, as in chat templates and endpoints."""

Wanted: TypeAlias = Stage | Literal["whole", "edit"]
"""A stage, the whole layout at once (the paper's one-shot ablation), or an edit."""

ANY_TABLE = "table"
"""The table type of prompts that do not state one."""

SYSTEM = """You lay out tabletop scenes for robots. Frame: centimetres, the origin is the table's near left corner, x to the right, \
y away from the viewer, z up, the table top is z = 0. An object is {"instance":"mug_0","description":"a white mug with a blue rim",\
"size":[11.0,8.0,9.5],"position":[40.0,25.0,4.8],"z_rotation":90}: instance is its category and a running number, unique in the \
scene; size is the width, depth and height of its box before it is turned; position is the centre of the box; z_rotation is in \
degrees, counter-clockwise seen from above, 0 faces the viewer. Everything rests on the table, on another object or in one; nothing \
overlaps, nothing leaves the table. Larger objects come first, each followed at once by what it carries. Lengths have one decimal. \
Answer with JSON alone: {"objects":[...]}."""

INSTRUCTION, TABLE, BY, CM = "Instruction: ", "\nTable: ", " x ", " cm"
ZONE = ", where nothing may stand: "
DETAILS = "\nDetails: "
LAYOUT = "\nLayout so far: "

WANTED: dict[Wanted, str] = {
    Stage.TASK: "\nWanted: the task objects, all that the instruction names and what carries it, as they stand before it is begun.",
    Stage.IMPORTANT: "\nWanted: the important background, objects in contact with the task objects or close beside them; "
    "none is a fair answer. Repeat nothing.",
    Stage.SECONDARY: "\nWanted: the rest of the background, what else stands on such a table away from the task objects. "
    "Repeat nothing.",
    "whole": "\nWanted: the whole scene at once, as it stands before the task is begun.",
    "edit": '\nWanted: the change that the instruction asks for and nothing else: {"remove":[instances that go],"objects":[objects '
    "that are new, and those that change under the instance that they have]}.",
}
"""The last line of a request."""

FIXED: tuple[str, ...] = (SYSTEM, INSTRUCTION, TABLE, BY, CM, ZONE, DETAILS, LAYOUT, *WANTED.values())
"""All fixed parts, for tokenizers."""

RETRY = "That answer cannot be used: {reason}. Answer again, JSON alone."
"""The user message after a refused answer."""

_LONGEST_SHOWN = 20_000  # characters of a refused answer that are sent back; a layout of 60 objects fits
_NO_ANSWER = "(no answer)"  # some endpoints refuse empty messages


@dataclass(frozen=True, slots=True)
class ReasonerQuestion:
    """A question to the reasoner.

    Attributes:
        instruction: The task instruction I, or the edit.
        table: The tabletop T.
        wanted: A stage, the whole layout or an edit.
        layout: The layout so far.
        details: The task info, if the prompt holds all of it and the model was trained on that.
        required: What the answer must have, in canonical form, if the model was trained on that: names such as ``mug_0``, then
            relations such as ``mug_0 on plate_0``.
    """

    instruction: str
    table: Tabletop
    wanted: Wanted
    layout: tuple[LayoutObject, ...] = ()
    details: TaskInfo | None = None
    required: tuple[str, ...] = ()

    @property
    def edits(self) -> bool:
        """Whether the question asks for an edit."""
        return self.wanted == "edit"

    @property
    def asks_for_task(self) -> bool:
        """Whether the objects that the instruction names are among the wanted ones."""
        return self.wanted in (Stage.TASK, "whole")


def messages(question: ReasonerQuestion, refused: Sequence[tuple[str, str]] = (), system: str = SYSTEM) -> list[Message]:
    """Returns the chat of a question: a system and a user message, then each refused answer with its reason.

    Raises:
        SceneError: The instruction is empty or too long (``instruction_invalid``).
    """
    chat = [{"role": "system", "content": system}, {"role": "user", "content": user_message(question)}]
    return chat + refusal_messages(refused)


def refusal_messages(refused: Sequence[tuple[str, str]]) -> list[Message]:
    """Returns two messages for each refused answer: the answer, of which the end is cut if it is long, and the reason."""
    chat = []
    for answer, reason in refused:
        chat.append({"role": "assistant", "content": answer[:_LONGEST_SHOWN] if answer.strip() else _NO_ANSWER})
        chat.append({"role": "user", "content": RETRY.format(reason=sanitise_words(reason))})
    return chat


def user_message(question: ReasonerQuestion) -> str:
    """Returns the user's message."""
    instruction = check_instruction(question.instruction)
    width, depth = (f"{100 * s:.{DECIMALS}f}" for s in question.table.size_xy)
    zone = question.table.restricted_zone
    table_type = sanitise_words(question.table.table_type) or ANY_TABLE
    parts = [INSTRUCTION, instruction, TABLE, table_type, ", ", width, BY, depth, CM]
    if zone is not None:
        x_min, x_max, y_min, y_max = (f"{100 * v:.{DECIMALS}f}" for v in zone)
        parts += [ZONE, f"[{x_min},{x_max},{y_min},{y_max}]"]
    if question.details is not None and (details := sanitise_words(details_of(question.details))):
        parts += [DETAILS, details]
    elif question.required:
        parts += [DETAILS, "; ".join(question.required)]
    if question.layout:
        parts += [LAYOUT, render_objects(question.layout)]
    return "".join([*parts, WANTED[question.wanted]])


def required_phrases(names: Mapping[str, str], relations: Iterable[Relation]) -> tuple[str, ...]:
    """Returns required objects and relations in canonical form.

    Args:
        names: The name in the answer of each required object.
        relations: Relations between them, or of one of them to its place.
    """

    def target(r: Relation) -> str:
        return " and ".join(names.get(name, name.replace("_", " ")) for name in r.target.split(", "))

    return (*names.values(), *(f"{names[r.subject]} {str(r.kind).removeprefix('is ')} {target(r)}" for r in relations))


def check_instruction(words: str) -> str:
    """Returns an instruction as the prompt contains it.

    Raises:
        SceneError: It is empty, too long, or no text that UTF-8 can encode (``instruction_invalid``).
    """
    instruction = sanitise_words(words)
    if not instruction:
        raise SceneError("instruction is empty, expected what is to be done on the table", "instruction_invalid")
    if len(instruction) > LIMITS.text.max_instruction:
        most = at_most(LIMITS.text, "max_instruction")
        raise SceneError(f"instruction has {len(instruction):,} characters, expected {most}; shorten it", "instruction_invalid")
    if not is_unicode(instruction):
        raise SceneError("instruction is not UTF-8, expected whole characters; type it again", "instruction_invalid")
    return instruction


def assistant_message(objects: Sequence[LayoutObject], removed: Sequence[str] | None = None) -> str:
    """Returns the assistant's message on which a model is trained."""
    return render_objects(objects, removed)


def details_of(task: TaskInfo) -> str:
    """Returns the fields of a task info except the instruction, in one line."""
    parts = (
        ("Environment", (task.environment,)),
        ("Goal", task.goal),
        ("Actions", task.action_sequence),
        ("Objects", task.objects_cluster),
    )
    return "; ".join(f"{name}: {' | '.join(words)}" for name, words in parts if any(words))
