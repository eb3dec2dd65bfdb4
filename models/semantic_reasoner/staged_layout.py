"""Whole layouts from the reasoner alone: O^t, then O^B, then O^b, each given the objects before it; nothing is corrected.

These layouts are the input of the corrector, and the reasoner is evaluated on them.
"""

from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass, field, replace

import numpy as np

from models.semantic_reasoner.language.interpreter import InstructionInterpreter
from models.semantic_reasoner.reasoner import Proposal, SemanticReasoner
from models.semantic_reasoner.replies.to_scene import objects_of_reply
from models.semantic_reasoner.text.prompt import ReasonerQuestion, Wanted
from models.semantic_reasoner.text.reply_json import LayoutObject
from stable_data.condition import GoalCondition
from stable_data.errors import SceneError
from stable_data.metrics.alignment import AlignmentReference, reference_of
from stable_data.scene import Scene, SceneObject, Stage, SupportFrame, Tabletop, TaskInfo
from stable_data.scene_graph.relations import yawed_rectangle

_LOW = 0.05  # fixed things that reach lower than this above a table stand on it, metres
_APART = 1.5  # the box around them is shown if it is at most as many times as large as they are; else the largest of them
_FEW = 0.005  # a smaller share of the table is not shown

PROGRESSIVE: tuple[Wanted, ...] = tuple(Stage)
"""The paper's three stages."""

ONE_SHOT: tuple[Wanted, ...] = ("whole",)
"""The paper's one-shot ablation."""


def table_with_zone(table: Tabletop, surroundings: Sequence[SceneObject]) -> Tabletop:
    """Returns a table with a restricted zone where fixed things stand, if it has no zone of its own.

    A table has one zone, a rectangle: the box around all fixed things if it is not much larger than they are, else that of the
    largest. The corrector knows each of them.
    """
    standing = [o for o in surroundings if o.bottom < _LOW]
    if table.restricted_zone is not None or not standing:
        return table
    width, depth = table.size_xy
    corners = np.array([yawed_rectangle(o) for o in standing])
    boxes = np.concatenate([corners.min(axis=1), corners.max(axis=1)], axis=1).clip(0.0, (width, depth, width, depth))
    areas = (boxes[:, 2] - boxes[:, 0]) * (boxes[:, 3] - boxes[:, 1])
    if areas.max() <= 0:
        return table  # all of them are beside it
    on_table = boxes[areas > 0]
    around = np.r_[on_table[:, :2].min(axis=0), on_table[:, 2:].max(axis=0)]
    is_near = (around[2] - around[0]) * (around[3] - around[1]) <= _APART * areas.sum()
    x_min, y_min, x_max, y_max = (around if is_near else boxes[int(areas.argmax())]).tolist()
    if (x_max - x_min) * (y_max - y_min) < _FEW * width * depth:
        return table  # walls of a shelf, which reach a little over its edge
    return replace(table, restricted_zone=(x_min, x_max, y_min, y_max))


@dataclass(frozen=True, slots=True)
class LayoutTask:
    """The input of a layout.

    Attributes:
        scene_id: Name of the layout.
        instruction: The task instruction I.
        table: The tabletop T.
        details: The task info, if the prompt holds all of it and the engine was trained on that.
        reference: What a scene must have by labels that no reader made, such as the annotation of a scene; None without labels.
            It is not part of any question, and the finished scene is compared with it.
        conditions: What holds when the task is done, by the same labels, in the names of ``reference`` and of other objects of the
            annotated scene; none if that is not known.
        surroundings: Fixed objects around the table, such as the walls of a shelf.
        frame: The surface of a support that is the table; None: the table is a piece of its own.
    """

    scene_id: str
    instruction: str
    table: Tabletop
    details: TaskInfo | None = None
    reference: AlignmentReference | None = None
    conditions: tuple[GoalCondition, ...] = ()
    surroundings: tuple[SceneObject, ...] = ()
    frame: SupportFrame | None = None

    @property
    def shown_table(self) -> Tabletop:
        """The table as the reasoner sees it, see :func:`table_with_zone`."""
        return table_with_zone(self.table, self.surroundings)

    @property
    def empty_scene(self) -> Scene:
        """The scene before anything is laid out: the table and its surroundings."""
        fixed = frozenset(o.instance for o in self.surroundings)
        return Scene(self.scene_id, self.table, self.surroundings, fixed=fixed, frame=self.frame)


@dataclass(slots=True)
class StagedLayout:
    """A layout with the stages that are generated so far.

    Attributes:
        task: The input.
        objects: Its objects, staged, without assets, in the order of the proposals.
        proposals: One for each stage that was asked for; the last may be a failure, after which no stage is asked for.
    """

    task: LayoutTask
    objects: tuple[SceneObject, ...] = ()
    proposals: list[tuple[Wanted, Proposal]] = field(default_factory=list)
    _layout: tuple[LayoutObject, ...] = ()

    @property
    def is_whole(self) -> bool:
        """Whether no stage failed."""
        return bool(self.proposals) and self.proposals[-1][1].reply is not None

    @property
    def scene(self) -> Scene:
        """The layout as a scene."""
        empty = self.task.empty_scene
        return replace(empty, objects=(*empty.objects, *self.objects))

    def question(self, wanted: Wanted) -> ReasonerQuestion:
        """Returns the question for a stage."""
        return ReasonerQuestion(self.task.instruction, self.task.shown_table, wanted, self._layout, self.task.details)

    def add(self, question: ReasonerQuestion, proposal: Proposal, interpret: InstructionInterpreter | None) -> None:
        """Adds the proposal of a stage."""
        self.proposals.append((question.wanted, proposal))
        if proposal.reply is not None:
            self.objects += objects_of_reply(proposal.reply, question, interpret)
            self._layout += proposal.reply.objects


def staged_layouts(
    reasoner: SemanticReasoner,
    tasks: Sequence[LayoutTask],
    seeds: Sequence[int],
    stages: Sequence[Wanted] = PROGRESSIVE,
    interpret: InstructionInterpreter | None = None,
) -> list[StagedLayout]:
    """Returns a layout for each task, in their order; the requests of one stage are one batch.

    Each task has a seed. Only :data:`ONE_SHOT` interprets the instructions.
    """
    layouts = [StagedLayout(task) for task in tasks]
    for wanted in stages:
        alive = [(layout, seed) for layout, seed in zip(layouts, seeds, strict=True) if not layout.proposals or layout.is_whole]
        questions = [layout.question(wanted) for layout, _ in alive]
        proposals = reasoner.propose(questions, [seed for _, seed in alive])
        for (layout, _), question, proposal in zip(alive, questions, proposals, strict=True):
            layout.add(question, proposal, interpret)
    return layouts


def task_of_scene(scene: Scene) -> LayoutTask:
    """Returns the task of a scene that has one, on its table with its surroundings; with labels if its objects are known."""
    assert scene.task is not None
    told = TaskInfo(
        *(getattr(scene.task, name) for name in ("environment", "task", "goal", "action_sequence", "objects_cluster"))
    )
    task = LayoutTask(scene.scene_id, told.task, scene.table, told, surroundings=scene.surroundings, frame=scene.frame)
    with suppress(SceneError):
        return replace(task, reference=reference_of(scene), conditions=scene.task.conditions)
    return task
