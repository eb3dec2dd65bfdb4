"""The prompts of Holodeck-Table and I-Design-Table, written anew from the descriptions of the two systems.

Holodeck (Yang et al., CVPR 2024) asks one model for the objects, then for the relations. I-Design (Çelen et al., 2024) lets several agents
talk: an interior designer chooses objects, an architect arranges them in a graph, and a corrector mends the conflicts that rules find in
it. Both are adapted to tables: what concerns rooms, walls and doors is left out.
"""

from collections.abc import Sequence

from models.baselines.layout.draft import FACINGS, OBJECTS_FORM, RELATIONS_FORM, RelationText
from models.baselines.placement.problem import PlacementRelation
from models.semantic_reasoner.staged_layout import LayoutTask
from models.semantic_reasoner.text.prompt import ANY_TABLE, Message, check_instruction
from models.semantic_reasoner.text.reply_json import LayoutObject, sanitise_words
from stable_data.content_id import content_id
from stable_data.scene import Tabletop
from stable_data.scene_graph.relations import CELLS

OBJECTS_WANTED = "Wanted: the objects."
"""Last line of a question for objects."""

RELATIONS_WANTED = "Wanted: the relations."
"""Last line of a question for relations."""

CORRECTION_WANTED = "Wanted: all relations, corrected."
"""Last line of a question for corrected relations."""

_MOST_SHOWN = 20  # conflicts in one question

_FRAME = """The viewer, a robot, stands in front of the table. Left, right, in front and behind are the viewer's; an object that faces \
"front" faces the viewer. The scene is as it stands BEFORE the robot begins: what the instruction says about where things are holds, and \
what it asks the robot to do is not done yet."""

_OBJECT_LIST = """Answer with JSON alone: {"objects":[{"category":"mug","description":"a white mug","size":[11.0,8.0,9.5],"number":2}]}
- category: an English noun in the singular, small letters, underscores for spaces.
- description: a short phrase with kind, colour, material and shape.
- size: width, depth and height in centimetres of one such object that faces the viewer. A real size, not a scaled one.
- number: how many of exactly this kind.
List first what the instruction names, each in the number that it names, and what carries those; then a few things that usually stand on \
such a table. At most 60 objects in all."""

_VOCABULARY = f"""Answer with JSON alone: {{"relations":[{{"subject":"mug_0","relation":"left of","target":"laptop_0"}}]}}
Subjects and targets are names of the list, such as mug_0. The relations are:
- on, in: the subject stands on the target, or is in it. Without one of these an object stands on the table.
- left of, right of, in front of, behind: as the viewer sees them. The difference in this direction is clearly larger than the one across.
- near: their distance is at most a hand's breadth. aligned with: their centres are in one line, across or along the table.
- facing: the front of the subject is turned to the target.
- face to: the front of the subject is turned to a side; the target is one of {", ".join(FACINGS)}.
- is at: the subject is in a part of the table; the target is one of {", ".join(CELLS)}.
What the instruction says about the start comes first. State no relation twice, and none that contradicts another one."""

HOLODECK_OBJECTS = f"""You choose the objects of a tabletop scene for robot simulation. {_FRAME}
{_OBJECT_LIST}"""

HOLODECK_RELATIONS = f"""You say how the objects of a tabletop scene stand to each other; a search then finds places for them. {_FRAME}
{_VOCABULARY}
Place the most important object by a part of the table and the others by their relation to it. Keep objects off the edges."""

DESIGNER = f"""You are the interior designer of a team that furnishes a table for robot simulation. You choose what is on it. {_FRAME}
{_OBJECT_LIST}"""

ARCHITECT = f"""You are the architect of a team that furnishes a table for robot simulation. The designer has chosen the objects; you \
arrange them in a graph of relations. {_FRAME}
{_VOCABULARY}
Every object has a relation. Begin with the objects that stand by themselves, each in a part of the table; let every other one have a \
relation to one that comes before it. Two objects that stand close to each other are also near."""

CORRECTOR = f"""You check the graph of a team that furnishes a table for robot simulation. Rules have found conflicts in it. Give the \
whole list of relations again, with as few changes as the conflicts need, and no new conflict. {_FRAME}
{_VOCABULARY}"""


def objects_chat(system: str, task: LayoutTask) -> tuple[Message, ...]:
    """Returns the chat that asks for objects.

    Raises:
        SceneError: The instruction is empty or too long (``instruction_invalid``).
    """
    return _chat(system, f"{_task_text(task)}\n{OBJECTS_WANTED}")


def relations_chat(system: str, task: LayoutTask, objects: Sequence[LayoutObject]) -> tuple[Message, ...]:
    """Returns the chat that asks for relations between objects.

    Raises:
        SceneError: As for :func:`objects_chat`.
    """
    return _chat(system, f"{_task_text(task)}\n{_list_text(objects)}\n{RELATIONS_WANTED}")


def correction_chat(
    task: LayoutTask, objects: Sequence[LayoutObject], relations: Sequence[RelationText], conflicts: Sequence[str]
) -> tuple[Message, ...]:
    """Returns the chat that asks for relations without conflicts.

    Raises:
        SceneError: As for :func:`objects_chat`.
    """
    graph = "\n".join(f"- {r}" for r in relations) or "- none"
    faults = "\n".join(f"- {sanitise_words(text)}" for text in conflicts[:_MOST_SHOWN])
    return _chat(
        CORRECTOR,
        f"{_task_text(task)}\n{_list_text(objects)}\nRelations:\n{graph}\nConflicts:\n{faults}\n{CORRECTION_WANTED}",
    )


def _chat(system: str, text: str) -> tuple[Message, ...]:
    return {"role": "system", "content": system}, {"role": "user", "content": text}


def _task_text(task: LayoutTask) -> str:
    table = task.shown_table
    width, depth = (f"{100 * s:.1f}" for s in table.size_xy)
    kind = sanitise_words(table.table_type).replace("_", " ") or ANY_TABLE
    text = f"Instruction: {check_instruction(task.instruction)}\nTable: {kind}, {width} cm wide, {depth} cm deep"
    if table.restricted_zone is not None:
        x_min, x_max, y_min, y_max = (f"{100 * v:.1f}" for v in table.restricted_zone)
        text += (
            f"; nothing may stand from {x_min} to {x_max} cm from its left edge and {y_min} to {y_max} cm from its front edge"
        )
    return text


def _list_text(objects: Sequence[LayoutObject]) -> str:
    lines = (f"- {o.instance}: {o.description}, {' x '.join(f'{s:.1f}' for s in o.size_cm)} cm" for o in objects)
    return "Objects:\n" + "\n".join(lines)


def _fingerprint() -> str:
    task = LayoutTask("scene", "Do it.", Tabletop("table", (1.0, 1.0), (0.0, 0.1, 0.0, 0.1)))
    objects, stated = (
        [LayoutObject("mug_0", "a mug", (1.0, 1.0, 1.0), (0.0, 0.0, 0.0), 0)],
        [RelationText("mug_0", "on", "tray_0")],
    )
    systems = (HOLODECK_OBJECTS, HOLODECK_RELATIONS, DESIGNER, ARCHITECT)
    chats = objects_chat("", task), relations_chat("", task, objects), correction_chat(task, objects, stated, ["conflict"])
    return content_id(systems, chats, OBJECTS_FORM.text, RELATIONS_FORM.text, list(map(str, PlacementRelation)))


FINGERPRINT = _fingerprint()
"""Hash of all texts, and of the forms of the answers."""
