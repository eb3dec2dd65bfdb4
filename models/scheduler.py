"""Many scenes at once: questions of a kind that are open at the same time are answered as one batch.

Batches form from the order of the loops and from what they ask, never by who is ready first: the same loops and answers make the
same batches wherever they run, and so the same scenes.
"""

from collections.abc import Callable, Sequence
from typing import Any, Protocol

from models.dual_system import Answer, Correct, Generated, Loop, Propose, Retrieve
from models.physics_corrector.corrector import Correction
from models.semantic_reasoner.reasoner import Proposal
from stable_data.furnishing import Furnished


class Answerer(Protocol):
    """Who answers the questions of loops: one answer each, in their order; what fails does not touch the others."""

    def propose(self, questions: Sequence[Propose], /) -> Sequence[Proposal]:
        """Objects of stages."""
        ...

    def retrieve(self, questions: Sequence[Retrieve], /) -> Sequence[Furnished]:
        """Assets of objects."""
        ...

    def correct(self, questions: Sequence[Correct], /) -> Sequence[Correction]:
        """Clean poses of scenes."""
        ...


def together(loops: Sequence[Loop], answerer: Answerer) -> list[Generated]:
    """Runs loops side by side: Algorithm 1 with its batch of M scenes; with one loop, its serial alternation.

    Args:
        loops: The loops, none of them begun.
        answerer: Answers.

    Returns:
        What became of each, in their order.
    """
    run = _Run(loops)
    kinds: tuple[tuple[type, Callable[[Any], Sequence[Answer]]], ...] = (
        (Propose, answerer.propose),
        (Retrieve, answerer.retrieve),
        (Correct, answerer.correct),
    )
    while run.asked:
        for kind, answers in kinds:
            of_kind = {k: question for k, question in sorted(run.asked.items()) if isinstance(question, kind)}
            if of_kind:
                for k, answer in zip(of_kind, answers(list(of_kind.values())), strict=True):
                    run.go_on(k, answer)
    return [run.made[k] for k in range(len(loops))]


class _Run:
    """Loops that are under way.

    Attributes:
        asked: The open question of each that is not at its end.
        made: What became of the others.
    """

    def __init__(self, loops: Sequence[Loop]) -> None:
        self._loops = loops
        self.asked: dict[int, Any] = {}
        self.made: dict[int, Generated] = {}
        for k in range(len(loops)):
            self.go_on(k, None)

    def go_on(self, k: int, answer: Answer | None) -> None:
        """Gives a loop its answer, and takes its next question or its end."""
        try:
            self.asked[k] = self._loops[k].send(answer)  # type: ignore[arg-type]  # a loop that begins is sent None
        except StopIteration as end:
            self.asked.pop(k, None)
            self.made[k] = end.value
