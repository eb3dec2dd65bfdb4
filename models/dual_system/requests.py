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
    """Asks the reasoner for the objects of a stage; the answer is a :class:`Proposal`."""

    ask: ReasonerQuestion
    seed: int


@dataclass(frozen=True, slots=True)
class RetrievalRequest:
    """Asks for assets; the answer is :class:`AssignedLayout`.

    Attributes:
        scene: The new objects only; their supports may be of an earlier stage.
    """

    scene: Scene


@dataclass(frozen=True, slots=True)
class CorrectionRequest:
    """Asks the corrector for clean poses; the answer is a :class:`Correction`.

    Attributes:
        scene: All objects so far.
        fixed: Instances that must stay.
        new: Instances that no correction has placed yet.
        is_last: Whether no correction follows, so that the physics engine decides what stays at rest.
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
        earlier_move: How far a correction may move the objects of earlier stages, metres: 0 fixes them, infinity leaves them
            free.
        tries: How often a stage is proposed at most, where its objects find no assets or no place, or cannot stay where the
            instruction says. If no attempt holds all relations of the instruction, the one that lacks the fewest is used.
        full: Share of the table that may be covered before the remaining stages are left out; 1 leaves out none.
    """

    schedule: tuple[Wanted, ...] = PROGRESSIVE
    corrects: Corrects = "each"
    earlier_move: float = float("inf")
    tries: int = 3
    full: float = 1.0

    def __post_init__(self) -> None:
        """Refuses settings that cannot be followed."""
        if not self.schedule or "edit" in self.schedule or self.schedule[0] not in (Stage.TASK, "whole"):
            raise ConfigError(
                f"schedule is {[str(w) for w in self.schedule]}, expected task or whole first, and no edit", "config_invalid"
            )
        if self.tries < 1 or not self.earlier_move >= 0 or not 0 < self.full <= 1:
            found = f"tries is {self.tries}, earlier_move {self.earlier_move}, full {self.full}"
            raise ConfigError(f"{found}, expected at least 1, at least 0, and a share over 0", "config_invalid")

    def is_full(self, scene: Scene) -> bool:
        """Whether the objects that stand on the table cover more than ``full`` of it."""
        width, depth = scene.table.size_xy
        covered = sum(o.size[0] * o.size[1] for o in scene.objects if o.support in (None, TABLE))
        return self.full < 1 and covered > self.full * width * depth


@dataclass(frozen=True, slots=True)
class Turn:
    """One attempt at a stage.

    Attributes:
        wanted: The stage.
        proposal: The proposal of the reasoner.
        furnished: The proposal with assets; None where nothing was proposed.
        corrections: The corrections of the scene with it; a second one where the first moved objects too far.
        rejected: Why it is not in the scene; empty where it is.
        code: Short machine-readable form of ``rejected``.
    """

    wanted: Wanted
    proposal: Proposal
    furnished: AssignedLayout | None = None
    corrections: tuple[Correction, ...] = ()
    rejected: str = ""
    code: str = ""


@dataclass(frozen=True, slots=True)
class GenerationResult:
    """The result for one task.

    Attributes:
        task: The task.
        scene: The scene after the last correction, with its task info; None where there is a failure.
        start: The objects of ``scene`` where they were first proposed.
        turns: All attempts, in order.
        correction: The correction that produced ``scene``; None where none did.
        dropped: Objects that the corrections of accepted attempts dropped, of every stage.
        failure: Why there is no scene.
        warnings: Notices that deserve a look.
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
