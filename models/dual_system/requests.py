"""The requests and answers of Algorithm 1, its settings, and its result."""

from collections.abc import Generator
from dataclasses import dataclass
from typing import Literal, TypeAlias

from models.physics_corrector.certify import DroppedObject
from models.physics_corrector.certify.correction import Correction
from models.semantic_reasoner.reasoner import Proposal
from models.semantic_reasoner.staged_layout import PROGRESSIVE, LayoutTask
from models.semantic_reasoner.text.prompt import ReasonerQuestion, Wanted
from stable_data.assets.assignment import AssignedLayout
from stable_data.errors import ConfigError, Notice
from stable_data.scene import TABLE, Scene, Stage

Corrects: TypeAlias = Literal["each", "end", "never"]
"""When scenes are corrected: after each stage (the paper), once after all stages, or never (its ablations)."""


@dataclass(frozen=True, slots=True)
class ProposalRequest:
    """Requests the objects of a stage from the reasoner; the answer is a :class:`Proposal`.

    Attributes:
        ask: The question to the reasoner.
        seed: Seed of its random choices.
    """

    ask: ReasonerQuestion
    seed: int


@dataclass(frozen=True, slots=True)
class RetrievalRequest:
    """Requests assets; the answer is an :class:`AssignedLayout`.

    Attributes:
        scene: The new objects only; their supports may be objects of an earlier stage.
    """

    scene: Scene


@dataclass(frozen=True, slots=True)
class CorrectionRequest:
    """Requests clean poses from the corrector; the answer is a :class:`Correction`.

    Attributes:
        scene: All objects so far.
        fixed: Instances that must not move.
        new: Instances that no correction has placed yet.
        is_last: Whether no correction follows; the physics engine then checks which objects stay at rest.
    """

    scene: Scene
    fixed: frozenset[str]
    new: frozenset[str]
    is_last: bool


Request: TypeAlias = ProposalRequest | RetrievalRequest | CorrectionRequest
Answer: TypeAlias = Proposal | AssignedLayout | Correction


@dataclass(frozen=True, slots=True)
class LoopSettings:
    """How the two systems alternate.

    Attributes:
        schedule: The stages, in order; ``whole`` alone is the one-shot ablation.
        corrects: When scenes are corrected.
        earlier_move: Maximum distance that a correction may move the objects of earlier stages, metres; 0 fixes them, infinity
            sets no limit.
        tries: Maximum number of attempts at a stage. An attempt is repeated if its objects have no assets or no space, or do
            not stay as the instruction states. If every attempt misses relations, the one with the fewest missing is used.
        full: Share of the table that objects may cover before the remaining stages are left out; 1 leaves out none.
    """

    schedule: tuple[Wanted, ...] = PROGRESSIVE
    corrects: Corrects = "each"
    earlier_move: float = float("inf")
    tries: int = 3
    full: float = 1.0

    def __post_init__(self) -> None:
        """Checks the settings."""
        if not self.schedule or "edit" in self.schedule or self.schedule[0] not in (Stage.TASK, "whole"):
            raise ConfigError(
                f"schedule is {[str(w) for w in self.schedule]}, expected task or whole first and no edit", "config_invalid"
            )
        if self.tries < 1 or not self.earlier_move >= 0 or not 0 < self.full <= 1:
            found = f"tries is {self.tries}, earlier_move {self.earlier_move}, full {self.full}"
            raise ConfigError(f"{found}, expected at least 1, at least 0, and a share in (0, 1]", "config_invalid")

    def is_full(self, scene: Scene) -> bool:
        """Whether the objects directly on the table cover more than the share ``full`` of it."""
        width, depth = scene.table.size_xy
        covered = sum(o.size[0] * o.size[1] for o in scene.objects if o.support in (None, TABLE))
        return self.full < 1 and covered > self.full * width * depth


@dataclass(frozen=True, slots=True)
class Turn:
    """One attempt at a stage.

    Attributes:
        wanted: The stage.
        proposal: The proposal of the reasoner.
        assigned: The proposal with assets; None without a valid proposal.
        corrections: The corrections of the scene; the last one was used. The second exists if the first moved objects too far.
        rejected: Reason why the scene does not contain the proposal; empty if it does.
        code: Short machine-readable form of ``rejected``.
    """

    wanted: Wanted
    proposal: Proposal
    assigned: AssignedLayout | None = None
    corrections: tuple[Correction, ...] = ()
    rejected: str = ""
    code: str = ""


@dataclass(frozen=True, slots=True)
class GenerationResult:
    """The result for one task.

    Attributes:
        task: The task.
        scene: The scene after the last correction, with its task info; None if the generation failed.
        start: The objects of ``scene`` at their proposed poses.
        turns: All attempts, in order.
        correction: The correction that produced ``scene``, or None without one.
        dropped: Objects that the corrections of accepted attempts dropped, from all stages.
        failure: Why the generation failed.
        warnings: Notices for the user.
    """

    task: LayoutTask
    scene: Scene | None
    start: Scene
    turns: tuple[Turn, ...]
    correction: Correction | None = None
    dropped: tuple[DroppedObject, ...] = ()
    failure: Notice | None = None
    warnings: tuple[Notice, ...] = ()


Loop: TypeAlias = Generator[Request, Answer, GenerationResult]
