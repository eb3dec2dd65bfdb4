"""Many scenes at once: while some are proposed, others are corrected, and each goes on as soon as it has its answer.

What is answered together follows from the order of the loops and from what they ask, never from who is ready first: the same
loops and answers make the same batches wherever they run, and so the same scenes.
"""

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from typing import Any, Protocol

from models.dual_system.requests import Answer, CorrectionRequest, GenerationResult, Loop, ProposalRequest, RetrievalRequest
from models.physics_corrector.correction import Correction
from models.semantic_reasoner.engines.incremental_batches import Conversation, converse
from models.semantic_reasoner.reasoner import Proposal
from stable_data.assets.assignment import AssignedLayout


class RequestHandler(Protocol):
    """Who answers the questions of loops; what fails does not touch the others."""

    def propose(self, questions: Sequence[ProposalRequest], /) -> Conversation[Proposal, ProposalRequest]:
        """Objects of stages, and of those that are asked for when these are known."""
        ...

    def retrieve(self, questions: Sequence[RetrievalRequest], /) -> Sequence[AssignedLayout]:
        """Assets of objects: one answer each, in their order."""
        ...

    def correct(self, questions: Sequence[CorrectionRequest], /) -> Iterable[Correction]:
        """Clean poses of scenes: one answer each, in their order, each of them when it is there."""
        ...


@dataclass(frozen=True, slots=True)
class QueueCounts:
    """Where the scenes of a batch are.

    Attributes:
        reasoner: How many wait for a proposal.
        corrector: How many wait for assets and clean poses.
        made: How many are at their end.
    """

    reasoner: int
    corrector: int
    made: int


def run_batched(
    loops: Sequence[Loop], answerer: RequestHandler, watch: Callable[[QueueCounts], None] | None = None
) -> list[GenerationResult]:
    """Runs loops side by side: Algorithm 1 with its batch of M scenes; with one loop, its serial alternation.

    Args:
        loops: The loops, none of them begun.
        answerer: Answers.
        watch: Told where the scenes are each time one of them has gone on.

    Returns:
        What became of each, in their order.
    """
    run = _Run(loops, answerer, watch)
    asking: list[int] = []  # the loop of each question for a proposal, in the order in which they were asked

    def proposals_wanted() -> list[ProposalRequest]:
        """The questions for proposals that have not been asked, once all others are answered."""
        run.answer_others()
        new = {k: q for k, q in sorted(run.open.items()) if isinstance(q, ProposalRequest)}
        for k in new:
            run.open.pop(k)
        asking.extend(new)
        return list(new.values())

    def heard(found: list[tuple[int, Proposal]]) -> list[ProposalRequest]:
        for number, proposal in found:
            run.go_on(asking[number], proposal)
        return proposals_wanted()

    converse(answerer.propose(proposals_wanted()), heard)
    return [run.made[k] for k in range(len(loops))]


class _Run:
    """Loops that are under way.

    Attributes:
        open: Questions that nobody has been asked yet, by loop.
        made: What became of the loops that are at their end.
    """

    def __init__(self, loops: Sequence[Loop], answerer: RequestHandler, watch: Callable[[QueueCounts], None] | None) -> None:
        self._loops, self._answerer, self._watch = loops, answerer, watch
        self.open: dict[int, Any] = {}
        self.made: dict[int, GenerationResult] = {}
        for k in range(len(loops)):
            self.go_on(k, None)

    def go_on(self, k: int, answer: Answer | None) -> None:
        """Gives a loop its answer, and takes its next question or its end."""
        try:
            self.open[k] = self._loops[k].send(answer)  # type: ignore[arg-type]  # a loop that begins is sent None
        except StopIteration as end:
            self.made[k] = end.value
        if self._watch is not None:
            corrector, made = (
                sum(isinstance(q, RetrievalRequest | CorrectionRequest) for q in self.open.values()),
                len(self.made),
            )
            self._watch(QueueCounts(len(self._loops) - corrector - made, corrector, made))

    def answer_others(self) -> None:
        """Answers all that asks for no proposal, until nothing else is open."""
        while True:
            retrieve = {k: q for k, q in sorted(self.open.items()) if isinstance(q, RetrievalRequest)}
            correct = {k: q for k, q in sorted(self.open.items()) if isinstance(q, CorrectionRequest)}
            if retrieve:
                self._give(list(retrieve), self._answerer.retrieve(list(retrieve.values())))
            elif correct:
                self._give(list(correct), self._answerer.correct(list(correct.values())))
            else:
                return

    def _give(self, loops: Sequence[int], answers: Iterable[Answer]) -> None:
        for k, answer in zip(loops, answers, strict=True):
            del self.open[k]
            self.go_on(k, answer)
