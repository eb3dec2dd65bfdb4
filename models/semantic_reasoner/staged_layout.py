"""Whole layouts from the reasoner alone: O^t, then O^B, then O^b, each told of what stands there already; nothing is corrected.

This is what the corrector starts from, and what the reasoner is judged by.
"""

from collections.abc import Sequence
from dataclasses import dataclass, field

from models.semantic_reasoner.language.category_statistics import CategoryStatistics
from models.semantic_reasoner.reasoner import Proposal, SemanticReasoner
from models.semantic_reasoner.replies.to_scene import objects_of_reply
from models.semantic_reasoner.text.prompt import ReasonerQuestion, Wanted
from models.semantic_reasoner.text.reply_json import LayoutObject
from stable_data.scene import Scene, SceneObject, Stage, Tabletop, TaskInfo

PROGRESSIVE: tuple[Wanted, ...] = tuple(Stage)
"""The paper's three stages."""

ONE_SHOT: tuple[Wanted, ...] = ("whole",)
"""The paper's ablation."""


@dataclass(frozen=True, slots=True)
class LayoutTask:
    """What is to be laid out.

    Attributes:
        scene_id: Names the layout.
        instruction: What is to be done on the table.
        table: The table.
        details: The task info, where the rest of it is to be said too and the engine was trained on that.
    """

    scene_id: str
    instruction: str
    table: Tabletop
    details: TaskInfo | None = None


@dataclass(slots=True)
class StagedLayout:
    """A layout as far as it came.

    Attributes:
        task: What was to be laid out.
        objects: Its objects, staged, without assets, in the order in which they were proposed.
        proposals: One a stage that was asked for; the last may be a failure, after which no stage is asked for.
    """

    task: LayoutTask
    objects: tuple[SceneObject, ...] = ()
    proposals: list[tuple[Wanted, Proposal]] = field(default_factory=list)
    _told: tuple[LayoutObject, ...] = ()

    @property
    def is_whole(self) -> bool:
        """Whether every stage has an answer."""
        return bool(self.proposals) and self.proposals[-1][1].reply is not None

    @property
    def scene(self) -> Scene:
        """The layout as a scene."""
        return Scene(self.task.scene_id, self.task.table, self.objects)

    def ask(self, wanted: Wanted) -> ReasonerQuestion:
        """The question for a stage."""
        return ReasonerQuestion(self.task.instruction, self.task.table, wanted, self._told, self.task.details)

    def take(self, ask: ReasonerQuestion, proposal: Proposal, statistics: CategoryStatistics | None) -> None:
        """Adds what a stage proposes."""
        self.proposals.append((ask.wanted, proposal))
        if proposal.reply is not None:
            self.objects += objects_of_reply(proposal.reply, ask, statistics)
            self._told += proposal.reply.objects


def staged_layouts(
    reasoner: SemanticReasoner,
    tasks: Sequence[LayoutTask],
    seeds: Sequence[int],
    stages: Sequence[Wanted] = PROGRESSIVE,
    statistics: CategoryStatistics | None = None,
) -> list[StagedLayout]:
    """A layout for each task, in their order; all layouts' requests of a stage are one batch.

    Args:
        reasoner: Proposes.
        tasks: What is to be laid out.
        seeds: One each.
        stages: What is asked for, in order.
        statistics: What is known of categories, to read the instruction by; only a whole layout's stages ask for it.
    """
    layouts = [StagedLayout(task) for task in tasks]
    for wanted in stages:
        alive = [(layout, seed) for layout, seed in zip(layouts, seeds, strict=True) if not layout.proposals or layout.is_whole]
        asks = [layout.ask(wanted) for layout, _ in alive]
        for (layout, _), ask, proposal in zip(alive, asks, reasoner.propose(asks, [s for _, s in alive]), strict=True):
            layout.take(ask, proposal, statistics)
    return layouts


def task_of_scene(scene: Scene) -> LayoutTask:
    """The task of a scene: its instruction and its table, and nothing else.

    Args:
        scene: With a task.
    """
    assert scene.task is not None
    return LayoutTask(scene.scene_id, scene.task.task, scene.table)
