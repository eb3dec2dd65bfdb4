"""Training examples of the reasoner: questions and answers from rows of the tables ``samples`` and ``edits``."""

from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass, replace

import numpy as np

from models.semantic_reasoner.text.prompt import (
    ANY_TABLE,
    Message,
    ReasonerQuestion,
    Wanted,
    assistant_message,
    messages,
    required_phrases,
)
from models.semantic_reasoner.text.reply_json import LayoutObject, layout_names, layout_objects
from stable_data.metrics.alignment import members
from stable_data.scene import RelationKind, Scene, Stage, Tabletop, TaskInfo
from stable_data.scene_graph.relations import CELLS, relations_of, scene_graph
from stable_data.scene_graph.stage_samples import generation_order
from stable_data.storage.schemas import Row
from stable_data.storage.table_rows import object_from_row, task_from_row

_STATED = frozenset(RelationKind) - {RelationKind.ABOVE, RelationKind.BELOW, RelationKind.FACE_TO, RelationKind.EQUALLY_SPACED}
_MOST_FURTHER = 3


@dataclass(frozen=True, slots=True)
class TrainingExample:
    """A question and its answer.

    Attributes:
        scene_id: The scene.
        question: The question.
        objects: The answer's objects.
        removed: The removed instances of an edit; None if it is not an edit.
        required: What a question for O^t or for the whole layout states as required; empty if it states nothing.
    """

    scene_id: str
    question: ReasonerQuestion
    objects: tuple[LayoutObject, ...]
    removed: tuple[str, ...] | None = None
    required: tuple[str, ...] = ()

    @property
    def prompt(self) -> list[Message]:
        """The chat up to the answer."""
        return messages(self.question)

    @property
    def answer(self) -> str:
        """The text of the answer."""
        return assistant_message(self.objects, self.removed)

    def on_any_table(self) -> "TrainingExample":
        """Returns the example without the type of the table, so that a model learns to use the table's size."""
        return replace(self, question=replace(self.question, table=replace(self.question.table, table_type=ANY_TABLE)))


def example_of(row: Row, with_details: bool = False, rng: np.random.Generator | None = None) -> TrainingExample:
    """Returns the example of a row of ``samples``.

    Args:
        row: The row.
        with_details: Whether the prompt holds all of the task info.
        rng: Draws the relations that the prompt states beside those of the instruction; None states nothing as required.
    """
    objects_in, objects_out = ([object_from_row(o) for o in row[key]] for key in ("objects_in", "objects_out"))
    names = layout_names([*objects_in, *objects_out])
    task, stage, table = task_from_row(row["task"]), Stage(row["stage"]), _table_of(row)
    required: tuple[str, ...] = ()
    if rng is not None and task is not None:
        required = _required_of(task, Scene(row["scene_id"], table, (*objects_in, *objects_out)), names, rng)
    question = ReasonerQuestion(
        "" if task is None else task.task,  # an empty instruction is invalid; such examples are left out and counted
        table,
        stage,
        layout_objects(objects_in, names),
        task if with_details else None,
        required if stage is Stage.TASK else (),
    )
    return TrainingExample(row["scene_id"], question, layout_objects(objects_out, names), required=required)


def _required_of(task: TaskInfo, layout: Scene, names: Mapping[str, str], rng: np.random.Generator) -> tuple[str, ...]:
    """The task objects in any order, the relations that the instruction states, and up to three more that hold between them.

    Free words state more kinds of relations than the templates of the data.
    """
    there = {o.instance for o in layout.objects}
    mentioned = [task.task_objects[k] for k in rng.permutation(len(task.task_objects)) if task.task_objects[k] in there]
    stated = [r for r in task.relations if set(members(r)) <= set(mentioned)]
    graph = relations_of(scene_graph(replace(layout, objects=tuple(layout[name] for name in sorted(mentioned))), {}))
    further = [r for r in graph if r.kind in _STATED and r.target in (*mentioned, *CELLS) and r not in stated]
    chosen = rng.permutation(len(further))[: rng.integers(_MOST_FURTHER + 1)]
    return required_phrases({name: names[name] for name in mentioned}, [*stated, *(further[k] for k in chosen)])


def edit_example_of(row: Row) -> TrainingExample:
    """Returns the example of a row of ``edits``: the layout so far is the scene before the edit, in the order of generation."""
    before, after = ([object_from_row(o) for o in row[key]] for key in ("objects_in", "objects_out"))
    present = generation_order(row["scene_id"], before)
    known = {o.instance for o in present}
    names = layout_names([*present, *(o for o in after if o.instance not in known)])
    question = ReasonerQuestion(row["instruction"], _table_of(row), "edit", layout_objects(present, names))
    changes = layout_objects(generation_order(row["scene_id"], after), names)
    return TrainingExample(row["scene_id"], question, changes, tuple(names[instance] for instance in row["removed"]))


def add_whole_layouts(examples: Iterable[TrainingExample]) -> Iterator[TrainingExample]:
    """Adds the one-shot variant of each scene after its last stage: the answer is the whole layout."""
    for example in examples:
        yield example
        # Only the last stage has all objects of a scene: its layout so far and its own.
        if example.question.wanted is Stage.SECONDARY:
            whole: Wanted = "whole"
            question = replace(example.question, wanted=whole, layout=(), required=example.required)
            objects = example.question.layout + example.objects
            yield TrainingExample(example.scene_id, question, objects, required=example.required)


def _table_of(row: Row) -> Tabletop:
    width, depth = row["table_size"]
    return Tabletop(row["table_type"], (width, depth), tuple(row["restricted_zone"]) if row["restricted_zone"] else None)
