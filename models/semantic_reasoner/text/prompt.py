"""What the reasoner is asked, in words: one chat template for the three stages, the one-shot variant and edits.

The frame and its units are the same for every request, then come the instruction, the table, the layout so far (as corrected)
and which stage is wanted; the answer is JSON (:mod:`models.semantic_reasoner.text.reply_json`) without a chain of thought, as
the paper's Sec. "Semantic Reasoner" has it. The fixed parts are constants, so that a tokenizer can make one token of each.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal, TypeAlias

from models.semantic_reasoner.text.reply_json import DECIMALS, LayoutObject, render_objects, sanitise_words
from stable_data.errors import SceneError
from stable_data.scene import MAX_INSTRUCTION, Stage, Tabletop, TaskInfo

PROMPT_VERSION = 1
"""Raised whenever a fixed part changes: models are trained on one version."""

Message: TypeAlias = dict[str, str]
"""``role`` and ``content``, as chat templates and endpoints take them."""

Wanted: TypeAlias = Stage | Literal["whole", "edit"]
"""A stage, the whole layout at once (the paper's one-shot ablation), or an edit."""

ANY_TABLE = "table"
"""The table type where none is to be said."""

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
"""Every fixed part, for tokenizers."""

RETRY = "That answer cannot be used: {reason}. Answer again, JSON alone."
"""What is said when an answer was refused."""


@dataclass(frozen=True, slots=True)
class ReasonerQuestion:
    """One thing to ask of the reasoner.

    Attributes:
        instruction: What is to be done on the table, or the edit.
        table: The table.
        wanted: What is asked for.
        layout: The layout so far.
        details: The task info, where the rest of it is to be said too and the model was trained on that.
    """

    instruction: str
    table: Tabletop
    wanted: Wanted
    layout: tuple[LayoutObject, ...] = ()
    details: TaskInfo | None = None

    @property
    def edits(self) -> bool:
        """Is an edit asked for?"""
        return self.wanted == "edit"


def messages(ask: ReasonerQuestion, refused: Sequence[tuple[str, str]] = ()) -> list[Message]:
    """The chat that asks for a stage.

    Args:
        ask: What is asked.
        refused: Earlier answers to it and why each could not be used.

    Returns:
        A system and a user message, then each refused answer with its reason.

    Raises:
        SceneError: The instruction is empty or too long (``instruction_invalid``).
    """
    chat = [{"role": "system", "content": SYSTEM}, {"role": "user", "content": user_message(ask)}]
    for answer, reason in refused:
        chat.append({"role": "assistant", "content": answer})
        chat.append({"role": "user", "content": RETRY.format(reason=sanitise_words(reason))})
    return chat


def user_message(ask: ReasonerQuestion) -> str:
    """The user's message."""
    instruction = check_instruction(ask.instruction)
    width, depth = (f"{100 * s:.{DECIMALS}f}" for s in ask.table.size_xy)
    zone = ask.table.restricted_zone
    parts = [INSTRUCTION, instruction, TABLE, sanitise_words(ask.table.table_type) or ANY_TABLE, ", ", width, BY, depth, CM]
    if zone is not None:
        x_min, x_max, y_min, y_max = (f"{100 * v:.{DECIMALS}f}" for v in zone)
        parts += [ZONE, f"[{x_min},{x_max},{y_min},{y_max}]"]
    if ask.details is not None and (details := sanitise_words(details_of(ask.details))):
        parts += [DETAILS, details]
    if ask.layout:
        parts += [LAYOUT, render_objects(ask.layout)]
    return "".join([*parts, WANTED[ask.wanted]])


def check_instruction(words: str) -> str:
    """An instruction as it is said.

    Raises:
        SceneError: It is empty or too long (``instruction_invalid``).
    """
    instruction = sanitise_words(words)
    if not instruction:
        raise SceneError("instruction is empty, expected what is to be done on the table", "instruction_invalid")
    if len(instruction) > MAX_INSTRUCTION:
        raise SceneError(
            f"instruction has {len(instruction):,} characters, expected at most {MAX_INSTRUCTION:,}; shorten it",
            "instruction_invalid",
        )
    return instruction


def assistant_message(objects: Sequence[LayoutObject], removed: Sequence[str] | None = None) -> str:
    """The assistant's message that a model is trained on."""
    return render_objects(objects, removed)


def details_of(task: TaskInfo) -> str:
    """What a task info says beside the instruction, in one line."""
    parts = (
        ("Environment", (task.environment,)),
        ("Goal", task.goal),
        ("Actions", task.action_sequence),
        ("Objects", task.objects_cluster),
    )
    return "; ".join(f"{name}: {' | '.join(words)}" for name, words in parts if any(words))
