"""Tasks become raw layouts with assets: the reasoner's half, for a batch of tasks at a time."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Any

from models.semantic_reasoner.engines.protocol import OFF
from models.semantic_reasoner.language.category_statistics import CategoryStatistics
from models.semantic_reasoner.reasoner import Proposal, SemanticReasoner
from models.semantic_reasoner.replies.to_scene import with_task
from models.semantic_reasoner.staged_layout import LayoutTask, StagedLayout, staged_layouts
from models.semantic_reasoner.text.prompt import Wanted, answer
from stable_data.assets.assignment import STEP as ASSETS
from stable_data.assets.assignment import AssignedLayout, assign_assets
from stable_data.assets.retrieval import Retriever
from stable_data.errors import Notice
from stable_data.random_seeds import named_seed
from stable_data.scene import Scene, Stage

STEP = "propose"
"""The step that notices of layouts name."""


@dataclass(frozen=True, slots=True)
class Outcome:
    """What became of a task.

    Attributes:
        layout: The layout as it was proposed, with every proposal.
        scene: The same with assets and its task; None where there is a failure.
        failure: Why there is no scene.
        warnings: What deserves a look.
    """

    layout: StagedLayout
    scene: Scene | None
    failure: Notice | None = None
    warnings: tuple[Notice, ...] = ()

    @property
    def is_off(self) -> bool:
        """Whether the engine could not be reached, so that asking again later may help."""
        return bool(self.layout.proposals) and self.layout.proposals[-1][1].code in OFF


class Proposer:
    """Lays out tasks.

    Args:
        reasoner: Proposes objects.
        statistics: What is known of categories; None: nothing, and task infos have no relations.
        retriever: Finds assets.
        stages: What is asked for, in order.
        seed: Of draws and choices: with an engine that repeats itself, a task has the same outcome in whichever batch.
    """

    def __init__(
        self,
        reasoner: SemanticReasoner,
        statistics: CategoryStatistics | None,
        retriever: Retriever,
        stages: Sequence[Wanted],
        seed: int,
    ) -> None:
        self.reasoner, self.statistics, self.retriever = reasoner, statistics, retriever
        self._stages, self._seed = stages, seed

    def outcomes(self, tasks: Sequence[LayoutTask]) -> list[Outcome]:
        """What becomes of each task, in their order; what fails does not touch the others."""
        seeds = [named_seed(self._seed, task.scene_id) for task in tasks]
        layouts = staged_layouts(self.reasoner, tasks, seeds, self._stages, self.statistics)
        there = {k: layout.scene for k, layout in enumerate(layouts) if layout.is_whole and layout.objects}
        furnished = dict(zip(there, assign_assets(list(there.values()), self.retriever, self._seed), strict=True))
        return [self._outcome(layout, furnished.get(k)) for k, layout in enumerate(layouts)]

    def _outcome(self, layout: StagedLayout, furnished: AssignedLayout | None) -> Outcome:
        warnings = list(dict.fromkeys(_said(layout)))
        name = layout.task.scene_id
        if furnished is None:
            wanted, proposal = layout.proposals[-1]
            code, why = proposal.code, f"stage {wanted}: {proposal.failure}"
            if not proposal.failure:
                code, why = (
                    "layout_empty",
                    "the engine proposes no object at all, expected at least one; say which things there are",
                )
            return Outcome(layout, None, Notice(name, STEP, code, f"{name}: {why}"), tuple(warnings))
        kept = {o.instance for o in furnished.scene.objects}
        lost = [o.instance for o in layout.objects if o.stage is Stage.TASK and o.instance not in kept]
        if lost or not kept:
            reasons = [n.message.removeprefix(f"{name}: ") for n in furnished.notices if n.code == "asset_unmatched"]
            hint = "add a library that has such things, or lower retrieval.floor"
            failure = Notice(name, ASSETS, "asset_unmatched", f"{name}: {'; '.join(reasons)}; {hint}")
            return Outcome(layout, None, failure, tuple(warnings))
        scene = with_task(furnished.scene, layout.task.instruction, layout.objects, self.statistics)
        return Outcome(layout, scene, None, (*warnings, *furnished.notices))


def _said(layout: StagedLayout) -> Iterator[Notice]:
    """What was unknown in the question, and what is still wrong with the answers, of all stages."""
    name = layout.task.scene_id
    for wanted, proposal in layout.proposals:
        for notice in proposal.notices:  # the same at every stage
            message = notice.message.removeprefix(f"{notice.item_id}: ")
            yield Notice(name, notice.step, notice.code, f"{name}: {message}")
        for fault in proposal.faults:
            yield Notice(name, STEP, fault.code, f"{name}: stage {wanted}: {fault.message}")


def proposal_rows(layout: StagedLayout) -> Iterator[dict[str, Any]]:
    """What was asked and answered, a row for each stage."""
    for wanted, proposal in layout.proposals:
        yield {"scene_id": layout.task.scene_id, "stage": str(wanted), **_row(proposal)}


def _row(p: Proposal) -> dict[str, Any]:
    return {
        "reply": None if p.reply is None else answer(p.reply.objects),
        "tries": p.tries,
        "refused": [{"answer": r.answer, "codes": [f.code for f in r.faults], "reason": r.reason} for r in p.refused],
        "left": [{"code": f.code, "message": f.message} for f in p.faults],
        "notices": [{"code": n.code, "message": n.message} for n in p.notices],
        "failure": p.failure,
        "code": p.code,
        "prompt_tokens": p.prompt_tokens,
        "reply_tokens": p.reply_tokens,
        "cost": p.cost,
    }
