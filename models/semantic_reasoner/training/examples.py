"""Training examples of the reasoner: questions and answers from rows of the tables ``samples`` and ``edits``."""

from collections.abc import Iterable, Iterator
from dataclasses import dataclass, replace

from models.semantic_reasoner.text.prompt import ANY_TABLE, Message, ReasonerQuestion, Wanted, assistant_message, messages
from models.semantic_reasoner.text.reply_json import LayoutObject, layout_names, layout_objects
from stable_data.scene import Stage, Tabletop
from stable_data.scene_graph.staging import generation_order
from stable_data.storage.schemas import Row
from stable_data.storage.table_rows import object_from_row, task_from_row


@dataclass(frozen=True, slots=True)
class TrainingExample:
    """A question and its answer.

    Attributes:
        scene_id: The scene.
        question: The question.
        objects: The answer's objects.
        removed: The removed instances of an edit; None if it is not an edit.
    """

    scene_id: str
    question: ReasonerQuestion
    objects: tuple[LayoutObject, ...]
    removed: tuple[str, ...] | None = None

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


def example_of(row: Row, with_details: bool = False) -> TrainingExample:
    """Returns the example of a row of ``samples``; with details the prompt holds all of the task info."""
    objects_in, objects_out = ([object_from_row(o) for o in row[key]] for key in ("objects_in", "objects_out"))
    names = layout_names([*objects_in, *objects_out])
    task = task_from_row(row["task"])
    question = ReasonerQuestion(
        "" if task is None else task.task,  # an empty instruction is invalid; such examples are left out and counted
        _table_of(row),
        Stage(row["stage"]),
        layout_objects(objects_in, names),
        task if with_details else None,
    )
    return TrainingExample(row["scene_id"], question, layout_objects(objects_out, names))


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
            question = replace(example.question, wanted=whole, layout=())
            yield TrainingExample(example.scene_id, question, example.question.layout + example.objects)


def _table_of(row: Row) -> Tabletop:
    width, depth = row["table_size"]
    return Tabletop(row["table_type"], (width, depth), tuple(row["restricted_zone"]) if row["restricted_zone"] else None)
