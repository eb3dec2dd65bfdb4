"""The requests and answers of Algorithm 1, and its result."""

from collections.abc import Generator
from dataclasses import dataclass
from typing import TypeAlias

from models.baselines.placement.problem import Placement, PlacementProblem, Search
from models.physics_corrector.certify import DroppedObject
from models.physics_corrector.certify.correction import Correction
from models.semantic_reasoner.chat import ChatQuestion, ChatReply
from models.semantic_reasoner.reasoner import Proposal
from models.semantic_reasoner.staged_layout import LayoutTask
from models.semantic_reasoner.text.prompt import ReasonerQuestion, Wanted
from stable_data.assets.assignment import AssignedLayout
from stable_data.assets.retrieval import Answer as AssetAnswer
from stable_data.assets.retrieval import AssetQuery
from stable_data.errors import Notice
from stable_data.scene import Scene


@dataclass(frozen=True, slots=True)
class ProposalRequest:
    """Requests the objects of a stage from the reasoner; the answer is a :class:`Proposal`.

    Attributes:
        question: The question to the reasoner.
        seed: Seed of its random choices.
    """

    question: ReasonerQuestion
    seed: int


@dataclass(frozen=True, slots=True)
class ChatRequest:
    """Asks the language model something other than for a layout in this project's form; the answer is a :class:`ChatReply`.

    Attributes:
        question: The chat.
        seed: Seed of its random choices.
    """

    question: ChatQuestion
    seed: int


@dataclass(frozen=True, slots=True)
class RetrievalRequest:
    """Requests assets; the answer is an :class:`AssignedLayout`.

    Attributes:
        scene: The new objects only; their supports may be objects of an earlier stage.
    """

    scene: Scene


@dataclass(frozen=True, slots=True)
class ExchangeRequest:
    """Requests other assets for objects that have one; the answer is :class:`ExchangedAssets`.

    Attributes:
        queries: One for each object.
    """

    queries: tuple[AssetQuery, ...]


@dataclass(frozen=True, slots=True)
class ExchangedAssets:
    """The usable assets for the queries of an :class:`ExchangeRequest`.

    Attributes:
        answers: One for each query, in order.
    """

    answers: tuple[AssetAnswer, ...]


@dataclass(frozen=True, slots=True)
class CorrectionRequest:
    """Requests clean poses from the corrector; the answer is a :class:`Correction`.

    Attributes:
        scene: All objects so far.
        fixed: Instances that must not move.
        new: Instances that no correction has placed yet.
        is_last: Whether no correction follows; the physics engine then checks which objects stay at rest.
        may_tilt: Whether tilts may change.
    """

    scene: Scene
    fixed: frozenset[str]
    new: frozenset[str]
    is_last: bool
    may_tilt: bool = True


@dataclass(frozen=True, slots=True, eq=False)
class PlacementRequest:
    """Requests places for objects from a search; the answer is a :class:`Placement`.

    Attributes:
        problem: The objects, and where they shall stand.
        search: The search.
    """

    problem: PlacementProblem
    search: Search


LanguageRequest: TypeAlias = ProposalRequest | ChatRequest
LanguageAnswer: TypeAlias = Proposal | ChatReply
Request: TypeAlias = LanguageRequest | RetrievalRequest | ExchangeRequest | PlacementRequest | CorrectionRequest
Answer: TypeAlias = LanguageAnswer | AssignedLayout | ExchangedAssets | Placement | Correction


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
