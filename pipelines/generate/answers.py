"""Answers the requests of Algorithm 1 in one process, with its own reasoner, libraries and corrector."""

from collections.abc import Callable, Iterator, Sequence
from contextlib import AbstractContextManager, nullcontext
from dataclasses import dataclass, field
from itertools import islice
from time import perf_counter
from typing import Protocol, TypeAlias

from models.baselines.placement.problem import Placement, PlacementProblem, Search
from models.dual_system.requests import (
    CorrectionRequest,
    ExchangedAssets,
    ExchangeRequest,
    LanguageAnswer,
    LanguageRequest,
    PlacementRequest,
    RetrievalRequest,
)
from models.physics_corrector.certify import CorrectionStatus
from models.physics_corrector.certify.correction import CertificationRequest, Correction, CorrectionOptions
from models.semantic_reasoner.engines.incremental_batches import Conversation
from models.semantic_reasoner.reasoner import SemanticReasoner
from pipelines.execution.shard_step import NOT_OF_AN_ITEM, batch_failure, batch_notices, unexpected_failure
from stable_data.assets.assignment import AssignedLayout, assign_assets, retrieve_usable
from stable_data.assets.retrieval import Retriever
from stable_data.assets.store import AssetStore
from stable_data.errors import Notice
from stable_data.scene import Scene

Certify: TypeAlias = Callable[[CertificationRequest], Correction]
"""Certifies one scene, in a separate process if a mesh may crash this one."""


Move: TypeAlias = Callable[[Sequence[Scene], Sequence[CorrectionOptions]], Sequence[CertificationRequest | Correction]]
"""Moves and refines scenes as one batch; a scene for which that is not possible has a failed correction."""


Limited: TypeAlias = Callable[[int], AbstractContextManager[None]]
"""Gives a body the time and the memory of a number of scenes."""


Place: TypeAlias = Callable[[Search, PlacementProblem], Placement]
"""Finds places by a search, within the time limit of the job."""


STEPS = ("propose", "retrieve", "place", "flow", "refine", "certify")
"""Steps whose time is measured; ``certify`` also is the post-processing that takes the place of flow, refinement and certification."""


class Corrector(Protocol):
    """What corrects scenes: the Physics Corrector, or a post-processor."""

    def move(
        self, scenes: Sequence[Scene], assets: AssetStore, options: Sequence[CorrectionOptions], /
    ) -> list[CertificationRequest]:
        """Moves the objects of all scenes as one batch."""
        ...

    def prepare(self, requests: Sequence[CertificationRequest], assets: AssetStore, /) -> list[CertificationRequest]:
        """Refines all scenes as one batch."""
        ...

    def certify(self, request: CertificationRequest, assets: AssetStore, /) -> Correction:
        """Corrects one scene."""
        ...


@dataclass(frozen=True, slots=True, eq=False)
class LocalCertifier:
    """Certifies scenes in this process.

    Attributes:
        corrector: Corrects scenes.
        store: The geometry of the assets.
        warnings: About batches that failed so far.
    """

    corrector: Corrector
    store: AssetStore
    warnings: list[Notice] = field(default_factory=list)

    def __call__(self, request: CertificationRequest) -> Correction:
        """Certifies one scene; an unexpected error rejects this scene alone.

        Raises:
            ConfigError: The whole run cannot continue.
            OSError: The machine has a problem, such as a full disk.
        """
        try:
            return self.corrector.certify(request, self.store)
        except NOT_OF_AN_ITEM:
            raise
        except Exception as error:  # noqa: BLE001 - a scene that breaks the geometry of one library is a row of failures
            return failed_correction(request, unexpected_failure(error))

    def moved(self, scenes: Sequence[Scene], options: Sequence[CorrectionOptions]) -> list[CertificationRequest]:
        """Moves the objects of scenes as one batch."""
        return self.corrector.move(scenes, self.store, options)

    def prepared(self, requests: Sequence[CertificationRequest]) -> list[CertificationRequest]:
        """The requests with refined layouts; after an unexpected error each is prepared alone, when it is certified."""
        try:
            return self.corrector.prepare(requests, self.store)
        except NOT_OF_AN_ITEM:
            raise
        except Exception as error:  # noqa: BLE001 - the scene is identified when it is certified
            self.warnings.extend(batch_notices(requests[0].scene.scene_id, len(requests), batch_failure(error, len(requests))))
            return list(requests)


@dataclass(slots=True, eq=False)
class LocalRequestHandler:
    """Answers requests in this process, in batches.

    Attributes:
        reasoner: Proposes objects.
        retriever: Finds assets.
        certifier: Certifies scenes; contains the corrector.
        seed: Decides among assets that match equally well.
        settles: Whether the last correction of a scene simulates it in MuJoCo.
        certify: Certifies one scene; None uses ``certifier``.
        move: Moves and refines scenes before they are certified; None uses the corrector.
        limited: Limits what is done for several scenes at once.
        fault_of: Returns why an asset cannot be used; None uses the certifier's store.
        search: Finds places by a search.
        seconds: Time spent so far, by step.
    """

    reasoner: SemanticReasoner
    retriever: Retriever
    certifier: LocalCertifier
    seed: int = 0
    settles: bool = True
    certify: Certify | None = None
    move: Move | None = None
    limited: Limited = lambda _: nullcontext()
    fault_of: Callable[[str], str | None] | None = None
    search: Place = lambda search, problem: search(problem)
    seconds: dict[str, float] = field(default_factory=lambda: dict.fromkeys(STEPS, 0.0))

    def propose(self, questions: Sequence[LanguageRequest], /) -> Conversation[LanguageAnswer, LanguageRequest]:
        """Proposes the objects of stages, and answers chats; later requests join the engine's running batch."""
        began = perf_counter()
        conversation = self.reasoner.converse([(q.question, q.seed) for q in questions])
        found = next(conversation, None)
        while found is not None:
            self.seconds["propose"] += perf_counter() - began
            more = yield found
            began = perf_counter()
            try:
                found = conversation.send([(q.question, q.seed) for q in more])
            except StopIteration:
                found = None
        self.seconds["propose"] += perf_counter() - began

    def retrieve(self, questions: Sequence[RetrievalRequest], /) -> list[AssignedLayout]:
        """Finds the assets of the objects of all requests at once."""
        began = perf_counter()
        fault_of = self.fault_of or self.certifier.store.fault_of
        found = assign_assets([q.scene for q in questions], self.retriever, self.seed, fault_of)
        self.seconds["retrieve"] += perf_counter() - began
        return found

    def exchange(self, questions: Sequence[ExchangeRequest], /) -> list[ExchangedAssets]:
        """Finds other assets for the objects of all requests at once."""
        began = perf_counter()
        fault_of = self.fault_of or self.certifier.store.fault_of
        queries = [query for q in questions for query in q.queries]
        answers = iter(retrieve_usable(queries, self.retriever, self.seed, fault_of)[0])
        found = [ExchangedAssets(tuple(islice(answers, len(q.queries)))) for q in questions]
        self.seconds["retrieve"] += perf_counter() - began
        return found

    def place(self, questions: Sequence[PlacementRequest], /) -> Iterator[Placement]:
        """Finds places for the objects of each request."""
        for question in questions:
            began = perf_counter()
            found = self.search(question.search, question.problem)
            self.seconds["place"] += perf_counter() - began
            yield found

    def correct(self, questions: Sequence[CorrectionRequest], /) -> Iterator[Correction]:
        """Corrects scenes: the flow moves and the refinement refines all of them as one batch, then each is certified alone."""
        began = perf_counter()
        certify = self.certify or self.certifier
        options = [CorrectionOptions(q.fixed, q.new, q.may_tilt, asks_engine=q.is_last and self.settles) for q in questions]
        moved: Sequence[CertificationRequest | Correction]
        if self.move is not None:
            moved = self.move([q.scene for q in questions], options)
            self.seconds["flow"] += perf_counter() - began
        else:
            with self.limited(len(questions)):
                moved = requests = self.certifier.moved([q.scene for q in questions], options)
            self.seconds["flow"] += perf_counter() - began
            began = perf_counter()
            with self.limited(len(questions)):
                moved = self.certifier.prepared(requests)
            self.seconds["refine"] += perf_counter() - began
        for one in moved:
            began = perf_counter()
            found = one if isinstance(one, Correction) else certify(one)
            self.seconds["certify"] += perf_counter() - began
            yield found


def failed_correction(request: CertificationRequest, reason: str) -> Correction:
    """The correction of a scene whose certification failed; the scene is rejected, the others continue.

    Args:
        request: The scene.
        reason: The reason, one line.
    """
    return Correction(CorrectionStatus.UNKNOWN, reason, request.scene, request.raw)
