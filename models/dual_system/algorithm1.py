"""The dual system: Algorithm 1 of the paper for one scene, as a coroutine.

For each stage of a schedule, the Semantic Reasoner proposes objects, the retriever finds assets for them, and the Physics
Corrector corrects the whole scene; the next question contains the corrected layout. The coroutine yields requests for these
three and is independent of other scenes: :func:`models.dual_system.batching.run_batched` runs many scenes concurrently and
answers their requests in batches.
"""

from collections.abc import Callable, Generator, Mapping, Set
from dataclasses import dataclass, replace
from typing import Literal, TypeAlias

from models.dual_system.generation_state import CARRYING, GOAL_HOLDS, BegunScene, GenerationState, StageCandidate
from models.dual_system.requests import (
    Answer,
    CorrectionRequest,
    Loop,
    ProposalRequest,
    Request,
    RetrievalRequest,
    Turn,
)
from models.physics_corrector.certify.correction import Correction
from models.semantic_reasoner.language.interpreter import InstructionInterpreter
from models.semantic_reasoner.reasoner import Proposal
from models.semantic_reasoner.replies.to_scene import attach_task_info, objects_of_reply
from models.semantic_reasoner.staged_layout import PROGRESSIVE, LayoutTask
from models.semantic_reasoner.text.prompt import ReasonerQuestion, Wanted
from models.semantic_reasoner.text.reply_json import layout_objects
from stable_data.assets.assignment import AssignedLayout
from stable_data.errors import ConfigError
from stable_data.metrics.movement import movement
from stable_data.metrics.relations_kept import DIRECTIONAL
from stable_data.random_seeds import named_seed
from stable_data.scene import TABLE, Relation, RelationKind, Scene, Stage
from stable_data.scene_graph.relations import cell_of, contacts_of, relations_of, scene_graph

Corrects: TypeAlias = Literal["each", "end", "never"]
"""When scenes are corrected: after each stage (the paper), once after all stages, or never (its ablations)."""


@dataclass(frozen=True, slots=True)
class LoopSettings:
    """How the two systems alternate.

    Attributes:
        schedule: The stages, in order; ``whole`` alone is the one-shot ablation.
        corrects: When scenes are corrected.
        earlier_move: Maximum distance that a correction may move the objects of earlier stages, metres; 0 fixes them, infinity
            sets no limit.
        tries: Maximum number of attempts at a stage. An attempt is repeated if its objects have no assets or no space, or do
            not stay as the instruction states, or if they are already as the instruction wants them to become. If every attempt
            has such a fault, the one with the fewest missing relations is used.
        full: Share of the table that objects may cover before the remaining stages are left out; 1 leaves out none.
        density: Share of the table that objects shall cover: after the schedule, its background stages are repeated until it is
            reached, up to six times, or until a round adds nothing (the open schedule of the paper's future work); 0 repeats none.
    """

    schedule: tuple[Wanted, ...] = PROGRESSIVE
    corrects: Corrects = "each"
    earlier_move: float = float("inf")
    tries: int = 3
    full: float = 1.0
    density: float = 0.0

    def __post_init__(self) -> None:
        """Checks the settings."""
        if not self.schedule or "edit" in self.schedule or self.schedule[0] not in (Stage.TASK, "whole"):
            raise ConfigError(
                f"schedule is {[str(w) for w in self.schedule]}, expected task or whole first and no edit", "config_invalid"
            )
        if self.tries < 1 or not self.earlier_move >= 0 or not 0 < self.full <= 1:
            found = f"tries is {self.tries}, earlier_move {self.earlier_move}, full {self.full}"
            raise ConfigError(f"{found}, expected at least 1, at least 0, and a share in (0, 1]", "config_invalid")
        if not 0 <= self.density <= 1 or (self.density and not self.background):
            raise ConfigError(
                f"density is {self.density}, expected a share in [0, 1], and a schedule with important or secondary",
                "config_invalid",
            )

    @property
    def background(self) -> tuple[Wanted, ...]:
        """The stages of the schedule that add background objects, which an open schedule repeats."""
        return tuple(wanted for wanted in self.schedule if wanted in (Stage.IMPORTANT, Stage.SECONDARY))

    def is_full(self, scene: Scene) -> bool:
        """Whether the objects directly on the table cover more than the share ``full`` of it."""
        return self.full < 1 and covered_share(scene) > self.full

    def is_dense(self, scene: Scene) -> bool:
        """Whether the density is reached."""
        return covered_share(scene) >= self.density


_PAPER = LoopSettings()
_MOST_ROUNDS = 6  # of an open schedule


def covered_share(scene: Scene) -> float:
    """Returns the share of the table that the boxes of objects directly on it cover."""
    width, depth = scene.table.size_xy
    return sum(o.size[0] * o.size[1] for o in scene.movable if o.support in (None, TABLE)) / (width * depth)


def dual_system(
    task: LayoutTask,
    seed: int,
    settings: LoopSettings = _PAPER,
    interpret: InstructionInterpreter | None = None,
    begun: BegunScene | None = None,
    is_done: Callable[[Scene], bool] | None = None,
) -> Loop:
    """Runs Algorithm 1 (the paper's appendix) for one scene.

    Args:
        task: The instruction and the table.
        seed: Seed of all random choices of the scene.
        settings: How the two systems alternate.
        interpret: Interprets the instruction, or None: the task info then has no relations.
        begun: A scene to which only background stages are added, those of the schedule or, if it has none, the two of the paper. None:
            the table is empty.
        is_done: Whether the goal of a corrected scene's task holds; None: it is not looked at.

    Yields:
        The next request.

    Returns:
        The scene, and all attempts.
    """
    state, system = GenerationState(task), _StageLoop(seed, settings, interpret, is_done)
    schedule = settings.schedule
    if begun is not None:
        state.begin(begun)
        schedule = settings.background or PROGRESSIVE[1:]
    for number, wanted in enumerate(schedule):
        if settings.is_full(state.scene):
            state.warn("table_full", f"stage {wanted} is left out: the objects cover the allowed share of the table")
            break
        candidate = yield from system.stage(state, wanted, is_last=number == len(schedule) - 1)
        if candidate is not None:
            state.accept(candidate)
            continue
        rejected = state.turns[-1]
        if not state.scene.movable:
            return state.failure(rejected.code, f"stage {wanted}: {rejected.rejected}")
        state.warn("stage_left_out", f"stage {wanted}: {rejected.rejected}")
    yield from system.fill(state)
    return (yield from closed(state, settings))


def closed(state: GenerationState, settings: LoopSettings) -> Loop:
    """Corrects a scene after all stages, unless it is corrected already or never shall be.

    Args:
        state: The state with the scene.
        settings: How the two systems alternate.

    Yields:
        The requests of the correction.

    Returns:
        The result.
    """
    if settings.corrects != "never" and not state.is_at_rest:
        everything, nothing = state.instances, frozenset[str]()
        earlier, new = (everything, nothing) if state.correction else (nothing, everything - state.held)
        closing = (yield from _corrected(state, settings, state.scene, state.supports, earlier, new, True))[-1]
        if closing.certified is None:
            return state.failure(str(closing.status), closing.reason)
        state.accept_closing(closing)
    return state.result()


@dataclass(frozen=True, slots=True)
class _StageLoop:
    """The inner part of Algorithm 1: one stage with its attempts. The attributes are the arguments of :func:`dual_system`."""

    seed: int
    settings: LoopSettings
    interpret: InstructionInterpreter | None
    is_done: Callable[[Scene], bool] | None

    def stage(
        self, state: GenerationState, wanted: Wanted, *, is_last: bool, round_: int = 0
    ) -> Generator[Request, Answer, StageCandidate | None]:
        """Repeats a stage until an attempt is not rejected, or no attempts are left; each round has random choices of its own.

        Returns:
            The attempt with the fewest missing relations, of equals one whose goal does not hold yet, then the last one, or None if no
            attempt can be used.
        """
        best: StageCandidate | None = None
        for attempt in range(round_ * self.settings.tries, (round_ + 1) * self.settings.tries):
            turn, candidate = yield from self._attempt(state, wanted, attempt, is_last)
            state.turns.append(turn)
            if candidate is not None and (best is None or candidate.num_faults <= best.num_faults):
                best = replace(candidate, turn=len(state.turns) - 1)
            # A failure without rejected replies is caused by the question or the engine, so another attempt cannot help.
            if not turn.rejected or (not turn.proposal.refused and turn.proposal.failure):
                break
        return best

    def fill(self, state: GenerationState) -> Generator[Request, Answer, None]:
        """Repeats the background stages until the density is reached, or until a round adds nothing."""
        settings = self.settings
        for number in range(1, _MOST_ROUNDS + 1):
            before = len(state.scene.movable)
            for wanted in settings.background:
                if settings.is_dense(state.scene) or settings.is_full(state.scene):
                    return
                # Each is as the last one, so that the scene is whole whenever no more is added.
                candidate = yield from self.stage(state, wanted, is_last=True, round_=number)
                if candidate is not None and candidate.num_missing <= state.num_missing:
                    state.accept(candidate)
            if len(state.scene.movable) <= before:
                return

    def _attempt(
        self, state: GenerationState, wanted: Wanted, attempt: int, is_last: bool
    ) -> Generator[Request, Answer, tuple[Turn, StageCandidate | None]]:
        """Proposes, retrieves and corrects once.

        Returns:
            The attempt, and its scene, or None if it cannot be used. An attempt that misses more relations of the instruction
            than before, after whose first objects the goal holds already, or in which an object of a whole layout found no asset, is
            rejected, but its scene can be used if no attempt is better.
        """
        task, before = state.task, state.scene
        # Propose the objects of the stage, given the corrected layout.
        layout = layout_objects(before.movable, {o.instance: o.instance for o in before.movable})
        question = ReasonerQuestion(task.instruction, task.shown_table, wanted, layout, task.details)
        proposal = yield ProposalRequest(question, named_seed(self.seed, attempt))
        assert isinstance(proposal, Proposal)
        state.note_proposal(wanted, proposal)
        if proposal.reply is None:
            return Turn(wanted, proposal, rejected=proposal.failure, code=proposal.code), None

        # Retrieve an asset for each object. A missing background object is acceptable, a missing task object is not.
        proposed = objects_of_reply(proposal.reply, question, self.interpret)
        assigned = yield RetrievalRequest(replace(before, objects=proposed, fixed=frozenset()))
        assert isinstance(assigned, AssignedLayout)
        turn, found = Turn(wanted, proposal, assigned), state.without_taken_names(assigned.scene.objects)
        names = {o.instance for o in found}
        if lost := [o.instance for o in proposed if o.stage is Stage.TASK and o.instance not in names]:
            why = next((f"; {assigned.unmatched[name].reason}" for name in lost if name in assigned.unmatched), "")
            turn = replace(turn, rejected=f"no asset for {', '.join(lost)}{why}", code="asset_unmatched")
            if wanted != "whole":
                return turn, None  # later stages would be proposed around what is not there
        if not (found or before.movable):
            return replace(turn, rejected="the proposal has no objects, expected at least one", code="layout_empty"), None
        scene = replace(before, objects=(*before.objects, *found))
        if not before.movable:
            scene = attach_task_info(scene, task.instruction, proposed, self.interpret, task.reference, task.conditions)
        supports = state.supports | proposed_supports(replace(before, objects=(*before.movable, *proposed)), names)
        candidate = StageCandidate(scene, found, supports, assigned.notices, state.num_missing + len(lost))

        # Correct all objects so far.
        if self.settings.corrects != "each" or not (found or is_last):
            return turn, candidate
        is_last = is_last or self.settings.is_full(scene)
        new = frozenset(o.instance for o in found)
        corrections = yield from _corrected(state, self.settings, scene, supports, state.instances, new, is_last)
        turn, done = replace(turn, corrections=corrections), corrections[-1]
        if done.certified is None:
            return replace(turn, rejected=done.reason, code=str(done.status)), None
        missing = self._num_missing(task, done) + len(lost)
        candidate = replace(candidate, scene=done.certified, correction=done, is_at_rest=is_last, num_missing=missing)
        if self.is_done is not None and not before.movable:
            candidate = replace(candidate, is_done=self.is_done(done.certified))
        if missing > state.num_missing:
            reason = f"{missing} relations of the instruction do not hold"
            turn = replace(turn, rejected=reason, code="relation_lost")
        elif candidate.is_done:
            turn = replace(turn, rejected="the goal of the task holds at the start", code=GOAL_HOLDS)
        return turn, candidate

    def _num_missing(self, task: LayoutTask, done: Correction) -> int:
        """Counts the relations of the instruction that do not hold: on, in or beside an object, or in a cell of the table."""
        stated = () if done.start.task is None else done.start.task.relations
        missing = set() if done.kept is None else {r for r in done.kept.asked_missing if r in stated}
        if done.certified is not None:
            cells = {o.instance: cell_of(o.position, task.table.size_xy) for o in done.certified.objects}
            missing |= {r for r in stated if r.kind is RelationKind.IS_AT and cells.get(r.subject) != r.target}
        return len(missing)


def _corrected(
    state: GenerationState,
    settings: LoopSettings,
    scene: Scene,
    supports: Mapping[str, Relation],
    earlier: frozenset[str],
    new: frozenset[str],
    is_last: bool,
) -> Generator[Request, Answer, tuple[Correction, ...]]:
    """Corrects a scene, and again with fixed earlier objects if the first correction moves them too far or drops one.

    Returns:
        The corrections; the last one is used.
    """
    scene = with_wanted_relations(scene, supports)
    are_fixed = settings.earlier_move == 0
    first = yield CorrectionRequest(scene, state.held | (earlier if are_fixed else frozenset()), new, is_last)
    assert isinstance(first, Correction)
    if are_fixed or first.certified is None or not earlier:
        return (first,)
    after = replace(first.certified, objects=tuple(o for o in first.certified.objects if o.instance in earlier))
    is_near = movement(scene, after)[1] <= 1e3 * settings.earlier_move
    if len(after.objects) == len(earlier) and is_near:
        return (first,)
    second = yield CorrectionRequest(scene, earlier, new, is_last)
    assert isinstance(second, Correction)
    if is_near and (second.certified is None or (second.rest is not None and second.rest.unsteady)):
        return second, first  # the second one fails, so the scene needs the drop of an earlier object
    return first, second


def with_wanted_relations(scene: Scene, supports: Mapping[str, Relation]) -> Scene:
    """Sets the relations that a correction must preserve: those of the instruction, and other supports by their subject."""
    stated = () if scene.task is None else scene.task.relations
    wanted = {**supports} | {r.subject: r for r in stated if r.kind in CARRYING}
    instances = {o.instance for o in scene.objects}
    beside = [r for r in stated if r.kind in DIRECTIONAL]
    return replace(scene, relations=tuple(r for r in (*wanted.values(), *beside) if r.target in instances))


def proposed_supports(scene: Scene, new: Set[str]) -> dict[str, Relation]:
    """Returns subject -> relation for the objects ``new`` whose boxes are on or in another object of a scene."""
    graph = scene_graph(scene, contacts_of(scene))
    return {r.subject: r for r in relations_of(graph) if r.kind in CARRYING and r.target != TABLE and r.subject in new}
