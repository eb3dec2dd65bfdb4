"""Who answers the questions of Algorithm 1 in one process: its own reasoner, libraries and corrector."""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field, replace
from time import perf_counter

from models.dual_system.algorithm1 import CorrectionRequest, ProposalRequest, RetrievalRequest
from models.physics_corrector.certify import CorrectionStatus
from models.physics_corrector.corrector import Correction, InputScene, PhysicsCorrector, certified_from, named, told
from models.physics_corrector.stabilization.drop_simulation import let_down
from models.physics_corrector.stabilization.stabilize import steadied
from models.semantic_reasoner.engines.incremental_batches import Conversation
from models.semantic_reasoner.reasoner import Proposal, SemanticReasoner
from pipelines.execution.shard_job import unexpected
from stable_data.assets.assignment import AssignedLayout, assign_assets
from stable_data.assets.retrieval import Retriever
from stable_data.assets.store import AssetStore
from stable_data.errors import ConfigError
from stable_data.metrics.audit import audit_scene
from stable_data.scene import Scene

NOT_OF_A_SCENE = (ConfigError, OSError, MemoryError)
"""Errors that are of the run or of the machine: another time, or elsewhere, they may not come."""

Certify = Callable[["PendingCertification"], Correction]
"""Certifies one scene; in a process of its own where a mesh may end this one."""


@dataclass(frozen=True, slots=True)
class PendingCertification:
    """One scene after the flow, to be proven or mended.

    Attributes:
        scene: As it was proposed.
        raw: What the flow made of it; None without one.
        fixed: Instances that must stay.
        new: Instances that nothing has put anywhere yet.
        settles: Whether the physics engine is asked what stays at rest.
    """

    scene: Scene
    raw: Scene | None
    fixed: frozenset[str]
    new: frozenset[str]
    settles: bool


@dataclass(frozen=True, slots=True, eq=False)
class LocalCertifier:
    """Certifies scenes in this process.

    Attributes:
        corrector: Corrects scenes.
        store: Geometry of the assets.
    """

    corrector: PhysicsCorrector
    store: AssetStore

    def __call__(self, asked: PendingCertification) -> Correction:
        """One scene; what nobody foresaw keeps it out, and no other.

        Raises:
            ConfigError: The run itself cannot go on.
            OSError: Nor can it for now.
            MemoryError: Likewise.
        """
        try:
            return self._certified(asked)
        except NOT_OF_A_SCENE:
            raise
        except Exception as error:  # noqa: BLE001 - a scene that breaks the geometry of one library is a row of failures
            return unanswered(asked, unexpected(error))

    def _certified(self, asked: PendingCertification) -> Correction:
        scene, shapes, _ = self.store.resolved(asked.scene)
        came = InputScene(scene, shapes, audit_scene(scene, shapes))
        fixed = self.corrector.options.fixed | asked.fixed
        let = let_down(scene, asked.new, fixed, self.store)
        _, shapes, _ = self.store.resolved(let.scene)
        raw = None if asked.raw is None else let.followed(asked.raw)
        options = replace(self.corrector.options, fixed=fixed)
        done = told(came, certified_from(let.scene, raw, shapes, options), named(let.scene, shapes), raw=asked.raw)
        return steadied(self.corrector, done, came, fixed, self.store) if asked.settles else done


@dataclass(slots=True, eq=False)
class LocalRequestHandler:
    """Answers from this process, in batches.

    Attributes:
        reasoner: Proposes objects.
        retriever: Finds assets.
        certifier: Corrects scenes.
        seed: Decides among assets that are as good.
        settles: Whether the physics engine is asked of the last correction of a scene.
        certify: Certifies one scene instead; None: the certifier.
        fault_of: Says why an asset cannot be used instead; None: the certifier's store.
        seconds: Spent on each kind of question so far.
    """

    reasoner: SemanticReasoner
    retriever: Retriever
    certifier: LocalCertifier
    seed: int = 0
    settles: bool = True
    certify: Certify | None = None
    fault_of: Callable[[str], str | None] | None = None
    seconds: dict[str, float] = field(default_factory=lambda: dict.fromkeys(("propose", "retrieve", "flow", "certify"), 0.0))

    def propose(self, questions: Sequence[ProposalRequest], /) -> Conversation[Proposal, ProposalRequest]:
        """Objects of stages: what is asked for later joins what the engine is still busy with."""
        began = perf_counter()
        talk = self.reasoner.converse([(q.ask, q.seed) for q in questions])
        found = next(talk, None)
        while found is not None:
            self.seconds["propose"] += perf_counter() - began
            more = yield found
            began = perf_counter()
            try:
                found = talk.send([(q.ask, q.seed) for q in more])
            except StopIteration:
                found = None
        self.seconds["propose"] += perf_counter() - began

    def retrieve(self, questions: Sequence[RetrievalRequest], /) -> list[AssignedLayout]:
        """Assets of objects, all of them looked for at once."""
        began = perf_counter()
        fault_of = self.fault_of or self.certifier.store.fault_of
        found = assign_assets([q.scene for q in questions], self.retriever, self.seed, fault_of)
        self.seconds["retrieve"] += perf_counter() - began
        return found

    def correct(self, questions: Sequence[CorrectionRequest], /) -> Iterator[Correction]:
        """Clean poses of scenes: the flow moves all of them as one batch, each is certified alone."""
        began = perf_counter()
        resolved = [self.certifier.store.resolved(q.scene)[:2] for q in questions]
        fixed = [q.fixed for q in questions]
        scenes, shapes = [scene for scene, _ in resolved], [shapes for _, shapes in resolved]
        raws = self.certifier.corrector.raw(scenes, shapes, fixed)
        self.seconds["flow"] += perf_counter() - began
        certify = self.certify or self.certifier
        for q, scene, raw in zip(questions, scenes, raws, strict=True):
            began = perf_counter()
            found = certify(PendingCertification(scene, raw, q.fixed, q.new, q.is_last and self.settles))
            self.seconds["certify"] += perf_counter() - began
            yield found


def unanswered(asked: PendingCertification, reason: str) -> Correction:
    """What comes of a scene that could not be certified at all: it is kept out, and the others go on.

    Args:
        asked: The scene.
        reason: Why, one line.
    """
    return Correction(
        status=CorrectionStatus.UNKNOWN,
        reason=reason,
        start=asked.scene,
        raw=asked.raw,
        certified=None,
        dropped=(),
        card_before=None,
        card_raw=None,
        card_after=None,
        audit=None,
        kept=None,
        rest=None,
    )
