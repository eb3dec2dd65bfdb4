"""What the reasoner learns from: questions and answers made of rows of the tables ``samples`` and ``edits``."""

from collections.abc import Iterable, Iterator
from dataclasses import dataclass, replace

from models.semantic_reasoner.text.prompt import ANY_TABLE, Message, ReasonerQuestion, Wanted, assistant_message, messages
from models.semantic_reasoner.text.reply_json import LayoutObject, layout_names, layout_objects
from stable_data.scene import Stage, Tabletop
from stable_data.scene_graph.staging import generation_order
from stable_data.storage.schemas import Row, object_from_row, task_from_row


@dataclass(frozen=True, slots=True)
class TrainingExample:
    """A question and its answer.

    Attributes:
        scene_id: The scene.
        ask: The question.
        objects: The answer's objects.
        removed: What an edit takes away; None: no edit.
    """

    scene_id: str
    ask: ReasonerQuestion
    objects: tuple[LayoutObject, ...]
    removed: tuple[str, ...] | None = None

    @property
    def prompt(self) -> list[Message]:
        """The chat up to the answer."""
        return messages(self.ask)

    @property
    def answer(self) -> str:
        """The answer's text."""
        return assistant_message(self.objects, self.removed)

    def on_any_table(self) -> "TrainingExample":
        """The same without the kind of table, so that a model learns to go by its size."""
        return replace(self, ask=replace(self.ask, table=replace(self.ask.table, table_type=ANY_TABLE)))


def example_of(row: Row, with_details: bool = False) -> TrainingExample:
    """The example that a row of ``samples`` makes.

    Args:
        row: The row.
        with_details: Whether the rest of the task info is said too.
    """
    objects_in, objects_out = ([object_from_row(o) for o in row[key]] for key in ("objects_in", "objects_out"))
    names = layout_names([*objects_in, *objects_out])
    task = task_from_row(row["task"])
    ask = ReasonerQuestion(
        "" if task is None else task.task,  # which cannot be asked, and is counted where it is left out
        _table(row),
        Stage(row["stage"]),
        layout_objects(objects_in, names),
        task if with_details else None,
    )
    return TrainingExample(row["scene_id"], ask, layout_objects(objects_out, names))


def edit_example_of(row: Row) -> TrainingExample:
    """The example that a row of ``edits`` makes: the scene as it was is the layout so far, in the order of generation.

    Args:
        row: The row.
    """
    before, after = ([object_from_row(o) for o in row[key]] for key in ("objects_in", "objects_out"))
    present = generation_order(row["scene_id"], before)
    known = {o.instance for o in present}
    names = layout_names([*present, *(o for o in after if o.instance not in known)])
    ask = ReasonerQuestion(row["instruction"], _table(row), "edit", layout_objects(present, names))
    changes = layout_objects(generation_order(row["scene_id"], after), names)
    return TrainingExample(row["scene_id"], ask, changes, tuple(names[instance] for instance in row["removed"]))


def add_whole_layouts(examples: Iterable[TrainingExample]) -> Iterator[TrainingExample]:
    """Examples and, after each last stage of a scene, its one-shot variant: the answer is the whole layout in one pass.

    Only the last stage of a scene says all: its layout so far and its own objects.
    """
    for example in examples:
        yield example
        if example.ask.wanted is Stage.SECONDARY:
            whole: Wanted = "whole"
            ask = replace(example.ask, wanted=whole, layout=())
            yield TrainingExample(example.scene_id, ask, example.ask.layout + example.objects)


def _table(row: Row) -> Tabletop:
    width, depth = row["table_size"]
    return Tabletop(row["table_type"], (width, depth), tuple(row["restricted_zone"]) if row["restricted_zone"] else None)
