"""Concurrent generation of many scenes: while some wait for proposals, others are corrected.

The content of a batch depends on the order of the loops and on their requests, never on timing: the same loops and answers give
the same batches, and so the same scenes, on every machine.
"""

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from typing import Any, Protocol

from models.baselines.placement.problem import Placement
from models.dual_system.requests import (
    Answer,
    ChatRequest,
    CorrectionRequest,
    ExchangedAssets,
    ExchangeRequest,
    GenerationResult,
    LanguageAnswer,
    LanguageRequest,
    Loop,
    PlacementRequest,
    ProposalRequest,
    RetrievalRequest,
)
from models.physics_corrector.certify.correction import Correction
from models.semantic_reasoner.engines.incremental_batches import Conversation, run_conversation
from stable_data.assets.assignment import AssignedLayout

_LANGUAGE = (ProposalRequest, ChatRequest)


class RequestHandler(Protocol):
    """Answers the requests of loops; a request that fails does not affect the others."""

    def propose(self, questions: Sequence[LanguageRequest], /) -> Conversation[LanguageAnswer, LanguageRequest]:
        """Proposes the objects of stages, and answers chats; further requests follow when the answers are known."""
        ...

    def retrieve(self, questions: Sequence[RetrievalRequest], /) -> Sequence[AssignedLayout]:
        """Finds the assets of objects: one answer for each request, in order."""
        ...

    def exchange(self, questions: Sequence[ExchangeRequest], /) -> Sequence[ExchangedAssets]:
        """Finds other assets for objects: one answer for each request, in order."""
        ...

    def place(self, questions: Sequence[PlacementRequest], /) -> Iterable[Placement]:
        """Finds places for objects: one answer for each request, in order, each as soon as it is known."""
        ...

    def correct(self, questions: Sequence[CorrectionRequest], /) -> Iterable[Correction]:
        """Corrects scenes: one answer for each request, in order, each as soon as it is known."""
        ...


@dataclass(frozen=True, slots=True)
class QueueCounts:
    """Number of scenes of a batch in each step.

    Attributes:
        reasoner: Scenes that wait for the language model.
        corrector: Scenes that wait for assets, places or a correction.
        made: Scenes that are finished.
    """

    reasoner: int
    corrector: int
    made: int


def run_batched(
    loops: Sequence[Loop], answerer: RequestHandler, watch: Callable[[QueueCounts], None] | None = None
) -> list[GenerationResult]:
    """Runs loops concurrently: Algorithm 1 with its batch of M scenes, or its serial alternation if there is one loop.

    Args:
        loops: The loops, not yet started.
        answerer: Answers the requests of the loops.
        watch: Called with the counts each time a loop has continued.

    Returns:
        The result of each loop, in order.
    """
    run = _Run(loops, answerer, watch)
    asking: list[int] = []  # the loop of each request for a proposal, in the order of the requests

    def open_proposals() -> list[LanguageRequest]:
        """Answers all other requests, then returns the open requests to the language model."""
        run.answer_others()
        new = {k: q for k, q in sorted(run.open.items()) if isinstance(q, _LANGUAGE)}
        for k in new:
            run.open.pop(k)
        asking.extend(new)
        return list(new.values())

    def receive(found: list[tuple[int, LanguageAnswer]]) -> list[LanguageRequest]:
        for number, answer in found:
            run.advance(asking[number], answer)
        return open_proposals()

    run_conversation(answerer.propose(open_proposals()), receive)
    return [run.made[k] for k in range(len(loops))]


class _Run:
    """The state of running loops.

    Attributes:
        open: Unanswered requests, by loop.
        made: Results of finished loops, by loop.
    """

    def __init__(self, loops: Sequence[Loop], answerer: RequestHandler, watch: Callable[[QueueCounts], None] | None) -> None:
        self._loops, self._answerer, self._watch = loops, answerer, watch
        self.open: dict[int, Any] = {}
        self.made: dict[int, GenerationResult] = {}
        for k in range(len(loops)):
            self.advance(k, None)

    def advance(self, k: int, answer: Answer | None) -> None:
        """Sends a loop its answer, and stores its next request or its result."""
        try:
            self.open[k] = self._loops[k].send(answer)  # type: ignore[arg-type]  # None starts a loop
        except StopIteration as end:
            self.made[k] = end.value
        if self._watch is not None:
            corrector = sum(not isinstance(q, _LANGUAGE) for q in self.open.values())
            made = len(self.made)
            self._watch(QueueCounts(len(self._loops) - corrector - made, corrector, made))

    def answer_others(self) -> None:
        """Answers requests until only those to the language model are open."""
        while True:
            retrieve = {k: q for k, q in sorted(self.open.items()) if isinstance(q, RetrievalRequest)}
            exchange = {k: q for k, q in sorted(self.open.items()) if isinstance(q, ExchangeRequest)}
            place = {k: q for k, q in sorted(self.open.items()) if isinstance(q, PlacementRequest)}
            correct = {k: q for k, q in sorted(self.open.items()) if isinstance(q, CorrectionRequest)}
            if retrieve:
                self._give(list(retrieve), self._answerer.retrieve(list(retrieve.values())))
            elif exchange:
                self._give(list(exchange), self._answerer.exchange(list(exchange.values())))
            elif place:
                self._give(list(place), self._answerer.place(list(place.values())))
            elif correct:
                self._give(list(correct), self._answerer.correct(list(correct.values())))
            else:
                return

    def _give(self, loops: Sequence[int], answers: Iterable[Answer]) -> None:
        for k, answer in zip(loops, answers, strict=True):
            del self.open[k]
            self.advance(k, answer)
