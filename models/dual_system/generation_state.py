"""The state of one scene while Algorithm 1 generates it."""

from collections.abc import Sequence
from dataclasses import dataclass, field, replace

from models.dual_system.requests import GenerationResult, Turn
from models.physics_corrector.certify import DroppedObject
from models.physics_corrector.certify.correction import Correction
from models.semantic_reasoner.reasoner import Proposal
from models.semantic_reasoner.staged_layout import LayoutTask
from models.semantic_reasoner.text.prompt import Wanted
from stable_data.errors import Notice
from stable_data.instructions.wording.vocabulary import answers_to
from stable_data.metrics.alignment import broken_relations
from stable_data.scene import Relation, RelationKind, Scene, SceneObject
from stable_data.scene_graph.relations import contacts_of
from stable_data.scene_graph.support_tree import SupportTree

STEP = "generate"
"""The step that notices of the loop name."""

GOAL_HOLDS = "goal_true_at_start"
"""Code of a proposal after which there is nothing to do."""

CARRYING = frozenset({RelationKind.ON, RelationKind.IN})
"""Relations of an object to what carries it."""


def supports_of(scene: Scene) -> dict[str, Relation]:
    """Returns subject -> relation for the objects that a scene graph puts on or in another object."""
    names = {o.instance for o in scene.objects}
    return {r.subject: r for r in scene.relations if r.kind in CARRYING and {r.subject, r.target} <= names}


@dataclass(frozen=True, slots=True, eq=False)
class StageCandidate:
    """The scene that one attempt at a stage produces.

    Attributes:
        scene: The scene with the new objects, corrected if the settings require it.
        found: The new objects as they were proposed, with assets.
        supports: Subject -> relation of every object that was proposed on or in another one.
        notices: Notices of the retrieval.
        num_missing: Number of relations of the instruction that do not hold in the scene.
        correction: The correction of the scene, or None if it was not corrected.
        is_at_rest: Whether the physics engine has checked the scene.
        is_done: Whether the goal of the task holds in the scene, so that there is nothing to do.
        turn: Index of the attempt among all turns.
    """

    scene: Scene
    found: tuple[SceneObject, ...]
    supports: dict[str, Relation]
    notices: tuple[Notice, ...]
    num_missing: int
    correction: Correction | None = None
    is_at_rest: bool = False
    is_done: bool = False
    turn: int = -1

    @property
    def num_faults(self) -> tuple[int, bool]:
        """What is wrong with it, to compare candidates by; a relation that does not hold counts more than a goal that does."""
        return self.num_missing, self.is_done


@dataclass(frozen=True, slots=True)
class BegunScene:
    """A scene to which Algorithm 1 adds background objects.

    Attributes:
        scene: The scene with its task and its relations; its objects stay where they are.
        nouns: Nouns of which it gets no further object, such as those by which its instruction names one.
    """

    scene: Scene
    nouns: frozenset[str] = frozenset()


@dataclass(slots=True, eq=False)
class GenerationState:
    """A scene during its generation.

    Attributes:
        task: The task of the scene.
        scene: The scene after the last accepted stage.
        start: All accepted objects at their proposed poses.
        turns: All attempts so far.
        warnings: Notices so far.
        dropped: Objects that the corrections of accepted attempts dropped.
        correction: The correction that produced ``scene``.
        is_at_rest: Whether the physics engine has checked ``scene``.
        supports: As in :class:`StageCandidate`, of all accepted stages.
        num_missing: As in :class:`StageCandidate`.
        held: Instances that no correction moves.
        nouns: As in :class:`BegunScene`.
    """

    task: LayoutTask
    scene: Scene = field(init=False)
    start: Scene = field(init=False)
    turns: list[Turn] = field(default_factory=list)
    warnings: list[Notice] = field(default_factory=list)
    dropped: list[DroppedObject] = field(default_factory=list)
    correction: Correction | None = None
    is_at_rest: bool = False
    supports: dict[str, Relation] = field(default_factory=dict)
    num_missing: int = 0
    held: frozenset[str] = frozenset()
    nouns: frozenset[str] = frozenset()

    def __post_init__(self) -> None:
        """Sets both scenes to an empty table."""
        self.scene = self.start = self.task.empty_scene

    @property
    def instances(self) -> frozenset[str]:
        """The instances of ``scene``."""
        return frozenset(o.instance for o in self.scene.objects)

    def begin(self, begun: BegunScene) -> None:
        """Starts with a scene."""
        self.scene = self.start = scene = begun.scene
        self.nouns = begun.nouns
        self.held, self.supports = self.instances, supports_of(scene)
        self.num_missing = (
            0 if scene.task is None else len(broken_relations(scene, scene.task.relations, contacts=contacts_of(scene)))
        )

    def without_taken_names(self, objects: Sequence[SceneObject]) -> tuple[SceneObject, ...]:
        """Returns new objects without those that answer to one of the nouns, and what is on these; a warning names them."""
        taken = {o.instance for o in objects if any(answers_to(o.category, noun) for noun in self.nouns)}
        if not taken:
            return tuple(objects)
        gone = SupportTree.of(objects).with_descendants(taken)
        self.warn("name_taken", f"{', '.join(sorted(gone))} left out, because the instruction uses the noun for another object")
        return tuple(o for o in objects if o.instance not in gone)

    def accept(self, candidate: StageCandidate) -> None:
        """Replaces the scene by that of a candidate."""
        self.turns[candidate.turn] = replace(self.turns[candidate.turn], rejected="", code="")
        self.warnings += candidate.notices
        if candidate.is_done:
            self.warn(GOAL_HOLDS, "the goal of the task holds at the start, so there is nothing to do")
        # The name of an object that an earlier correction dropped may be that of another object now.
        earlier = (o for o in self.start.objects if o.instance in self.instances)
        self.start = replace(self.start, objects=(*earlier, *candidate.found))
        self.scene, self.num_missing = candidate.scene, candidate.num_missing
        self.supports = {name: r for name, r in candidate.supports.items() if name in self.instances}
        if candidate.correction is not None:
            self.correction, self.is_at_rest = candidate.correction, candidate.is_at_rest
            self.dropped += candidate.correction.dropped

    def accept_closing(self, correction: Correction) -> None:
        """Replaces the scene by that of a correction after all stages."""
        assert correction.certified is not None
        self.scene, self.correction = correction.certified, correction
        self.dropped += correction.dropped

    def note_proposal(self, wanted: Wanted, proposal: Proposal) -> None:
        """Adds warnings for unknown parts of the question and for the remaining faults of the proposal."""
        name = self.task.scene_id
        for notice in proposal.notices:  # equal at every stage; the result removes duplicates
            message = notice.message.removeprefix(f"{notice.item_id}: ")
            self.warnings.append(Notice(name, notice.step, notice.code, f"{name}: {message}"))
        for fault in proposal.faults:
            self.warn(fault.code, f"stage {wanted}: {fault.message}")

    def warn(self, code: str, message: str) -> None:
        """Adds a warning about the scene."""
        self.warnings.append(self._notice(code, message))

    def failure(self, code: str, message: str) -> GenerationResult:
        """Returns the result without a scene."""
        return self._result(self._notice(code, message))

    def result(self) -> GenerationResult:
        """Returns the result with the current scene."""
        return self._result(None)

    def _notice(self, code: str, message: str) -> Notice:
        return Notice(self.task.scene_id, STEP, code, f"{self.task.scene_id}: {message}")

    def _result(self, failure: Notice | None) -> GenerationResult:
        scene, correction = (self.scene, self.correction) if failure is None else (None, None)
        left = tuple(o for o in self.start.objects if o.instance in self.instances)
        start = replace(self.start, objects=left, task=self.scene.task)
        warnings, dropped = tuple(dict.fromkeys(self.warnings)), tuple(self.dropped)
        return GenerationResult(self.task, scene, start, tuple(self.turns), correction, dropped, failure, warnings)
