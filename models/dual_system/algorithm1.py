"""The dual system: Algorithm 1 for one scene, as a coroutine.

For each stage of a schedule the Semantic Reasoner proposes objects, assets are found for them, and the Physics Corrector puts
all that is there where physics leaves it; the corrected layout is what the next stage is told. The coroutine asks for these
three things and knows neither who answers nor what else is answered with it: :func:`models.dual_system.batching.run_batched`
keeps many scenes alive and has their questions answered in batches.
"""

from collections.abc import Generator, Mapping, Set
from dataclasses import dataclass, field, replace
from typing import Literal, TypeAlias

from models.physics_corrector.certify import DroppedObject
from models.physics_corrector.correction import Correction
from models.semantic_reasoner.language.category_statistics import CategoryStatistics
from models.semantic_reasoner.language.stated_relations import relations_not_held
from models.semantic_reasoner.reasoner import Proposal
from models.semantic_reasoner.replies.to_scene import accepted, with_task
from models.semantic_reasoner.staged_layout import PROGRESSIVE, LayoutTask
from models.semantic_reasoner.text.prompt import ReasonerQuestion, Wanted
from models.semantic_reasoner.text.reply_json import layout_objects
from stable_data.assets.assignment import AssignedLayout
from stable_data.errors import ConfigError, Notice
from stable_data.metrics.movement import movement
from stable_data.metrics.relations_kept import DIRECTIONAL
from stable_data.random_seeds import named_seed
from stable_data.scene import TABLE, Relation, RelationKind, Scene, SceneObject, Stage
from stable_data.scene_graph.relations import relations_of, scene_graph

STEP = "generate"
"""The step that notices of the loop name."""

_CARRYING = frozenset({RelationKind.ON, RelationKind.IN})

Corrects: TypeAlias = Literal["each", "end", "never"]
"""When the corrector is asked: after each stage (the paper), once when all is there, or not at all (its ablations)."""


@dataclass(frozen=True, slots=True)
class ProposalRequest:
    """Asks the reasoner for a stage's objects; the answer is a :class:`Proposal`."""

    ask: ReasonerQuestion
    seed: int


@dataclass(frozen=True, slots=True)
class RetrievalRequest:
    """Asks for assets; the answer is :class:`AssignedLayout`.

    Attributes:
        scene: The new objects alone; what carries them may be of an earlier stage.
    """

    scene: Scene


@dataclass(frozen=True, slots=True)
class CorrectionRequest:
    """Asks the corrector for clean poses; the answer is a :class:`Correction`.

    Attributes:
        scene: All that is there.
        fixed: Instances that must stay.
        new: Instances that no correction has put anywhere yet.
        is_last: Whether nothing comes after it, so that the physics engine is to be asked what stays at rest.
    """

    scene: Scene
    fixed: frozenset[str]
    new: frozenset[str]
    is_last: bool


Request: TypeAlias = ProposalRequest | RetrievalRequest | CorrectionRequest
Answer: TypeAlias = Proposal | AssignedLayout | Correction


@dataclass(frozen=True, slots=True)
class LoopSettings:
    """How the two systems take turns.

    Attributes:
        schedule: What is asked for, in order; ``whole`` alone is the one-shot ablation.
        corrects: When the corrector is asked.
        earlier_move: How far a correction may move what stood there before its stage, metres: 0 holds it, infinity leaves it
            free.
        tries: How often a stage is proposed at most where what it proposed found no assets or no place, or could not stay where
            the instruction says; where none could, the one counts that lacks the fewest of what it says.
        full: Share of the table that may be covered before no further stage is asked for; 1 asks for all.
    """

    schedule: tuple[Wanted, ...] = PROGRESSIVE
    corrects: Corrects = "each"
    earlier_move: float = float("inf")
    tries: int = 3
    full: float = 1.0

    def __post_init__(self) -> None:
        """Refuses settings that no loop can follow."""
        if not self.schedule or "edit" in self.schedule or self.schedule[0] not in (Stage.TASK, "whole"):
            raise ConfigError(
                f"schedule is {[str(w) for w in self.schedule]}, expected task or whole first, and no edit", "config_invalid"
            )
        if self.tries < 1 or not self.earlier_move >= 0 or not 0 < self.full <= 1:
            found = f"tries is {self.tries}, earlier_move {self.earlier_move}, full {self.full}"
            raise ConfigError(f"{found}, expected at least 1, at least 0, and a share over 0", "config_invalid")


@dataclass(frozen=True, slots=True)
class Turn:
    """What came of asking for a stage once.

    Attributes:
        wanted: The stage.
        proposal: What the reasoner proposed.
        furnished: The same with assets; None where nothing was proposed.
        corrections: The scene with it, corrected; a second one where the first moved what it should not.
        rejected: Why it is not in the scene; empty where it is.
        code: Short machine-readable reason of that.
    """

    wanted: Wanted
    proposal: Proposal
    furnished: AssignedLayout | None = None
    corrections: tuple[Correction, ...] = ()
    rejected: str = ""
    code: str = ""


@dataclass(frozen=True, slots=True)
class GenerationResult:
    """What became of a task.

    Attributes:
        task: The task.
        scene: The scene as the last correction left it, with its task info; None where there is a failure.
        start: Its objects where they were first proposed; what is in ``scene`` is in it.
        turns: All that was tried, in order.
        correction: The one that made ``scene``; None where none did.
        dropped: What the corrections that count have left out, of every stage.
        failure: Why there is no scene.
        warnings: What deserves a look.
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


def dual_system(
    task: LayoutTask, seed: int, settings: LoopSettings = LoopSettings(), statistics: CategoryStatistics | None = None
) -> Loop:
    """Algorithm 1 (the paper's appendix) for one scene.

    Args:
        task: What is to be laid out.
        seed: Of the scene's draws.
        settings: How the two systems take turns.
        statistics: What is known of categories, to read the instruction by; None: the task info has no relations.

    Yields:
        What is to be answered next.

    Returns:
        The scene, and all that was tried.
    """
    return _Scene(task, seed, settings, statistics).run()


@dataclass(frozen=True, slots=True, eq=False)
class _Step:
    """What a try would make of a scene: with what it found, corrected where that is wanted."""

    scene: Scene
    found: tuple[SceneObject, ...]
    meant: dict[str, Relation]  # of the scene and this
    notices: tuple[Notice, ...]
    missing: int  # how many of the relations that the instruction says the scene would have lost
    correction: Correction | None = None
    is_at_rest: bool = False
    turn: int = -1  # its number


@dataclass(slots=True, eq=False)
class _Scene:
    """A scene being made."""

    task: LayoutTask
    seed: int
    settings: LoopSettings
    statistics: CategoryStatistics | None
    scene: Scene = field(init=False)
    start: Scene = field(init=False)
    turns: list[Turn] = field(default_factory=list)
    warnings: list[Notice] = field(default_factory=list)
    dropped: list[DroppedObject] = field(default_factory=list)
    correction: Correction | None = None  # that made the scene as it is
    is_at_rest: bool = False  # whether the engine was asked of it
    meant: dict[str, Relation] = field(default_factory=dict)  # what was proposed on or in another thing, and is to be there
    missing: int = 0  # how many of the relations that the instruction says it has lost

    def __post_init__(self) -> None:
        self.scene = self.start = Scene(self.task.scene_id, self.task.table, ())

    def run(self) -> Loop:
        schedule = self.settings.schedule
        for number, wanted in enumerate(schedule):
            if self._is_full(self.scene):
                self._warn("table_full", f"stage {wanted} is not asked for: the table is as full as it may be")
                break
            best: _Step | None = None
            for attempt in range(self.settings.tries):
                turn, step = yield from self._turn(wanted, attempt, number == len(schedule) - 1)
                self.turns.append(turn)
                if step is not None and (best is None or step.missing <= best.missing):
                    best = replace(step, turn=len(self.turns) - 1)
                if not turn.rejected:
                    break
                if not turn.proposal.refused and turn.proposal.failure:
                    break  # the question itself, or whoever answers, is at fault
            if best is not None:
                self._take(best)
            else:
                message = f"stage {wanted}: {turn.rejected}"
                if not self.scene.objects:
                    return self._failed(turn.code, message)
                self._warn("stage_left_out", message)
        if self.settings.corrects != "never" and not self.is_at_rest:
            there, none = frozenset(o.instance for o in self.scene.objects), frozenset[str]()
            earlier, new = (there, none) if self.correction else (none, there)
            done = (yield from self._corrected(self.scene, self.meant, earlier, new, True))[-1]
            if done.certified is None:
                return self._failed(str(done.status), done.reason)
            self.scene, self.correction = done.certified, done
            self.dropped += done.dropped
        return self._ended(None)

    def _take(self, step: "_Step") -> None:
        """Makes a try's scene the scene."""
        self.turns[step.turn] = replace(self.turns[step.turn], rejected="", code="")
        self.warnings += step.notices
        self.meant, self.missing = step.meant, step.missing
        self.start = replace(self.start, objects=(*self.start.objects, *step.found))
        self.scene = step.scene
        if step.correction is not None:
            self.correction, self.is_at_rest = step.correction, step.is_at_rest
            self.dropped += step.correction.dropped

    def _turn(self, wanted: Wanted, attempt: int, is_last: bool) -> Generator[Request, Answer, tuple[Turn, "_Step | None"]]:
        """Asks for a stage once.

        Returns:
            What came of it, and what it would make of the scene, None where it cannot be used. It is rejected and yet can be
            used where relations are lost that the instruction says.
        """
        told = layout_objects(self.scene.objects, {o.instance: o.instance for o in self.scene.objects})
        ask = ReasonerQuestion(self.task.instruction, self.task.table, wanted, told, self.task.details)
        proposal = yield ProposalRequest(ask, named_seed(self.seed, attempt))
        assert isinstance(proposal, Proposal)
        self._hear(wanted, proposal)
        if proposal.reply is None:
            return Turn(wanted, proposal, rejected=proposal.failure, code=proposal.code), None
        proposed = accepted(proposal.reply, ask, self.statistics)
        furnished = yield RetrievalRequest(replace(self.scene, objects=proposed))
        assert isinstance(furnished, AssignedLayout)
        found = furnished.scene.objects
        there = {o.instance for o in found}
        if lost := [o.instance for o in proposed if o.stage is Stage.TASK and o.instance not in there]:
            why = next((f"; {furnished.unmatched[name].reason}" for name in lost if name in furnished.unmatched), "")
            return Turn(wanted, proposal, furnished, (), f"no asset for {', '.join(lost)}{why}", "asset_unmatched"), None
        if not (found or self.scene.objects):
            return Turn(
                wanted, proposal, furnished, (), "nothing is proposed, expected an object at least", "layout_empty"
            ), None
        scene = replace(self.scene, objects=(*self.scene.objects, *found))
        if not self.scene.objects:
            scene = with_task(scene, self.task.instruction, proposed, self.statistics)
        meant = self.meant | _carried(replace(self.scene, objects=(*self.scene.objects, *proposed)), there)
        step = _Step(scene, found, meant, furnished.notices, self.missing)
        if self.settings.corrects != "each" or not (found or is_last):
            return Turn(wanted, proposal, furnished), step
        is_last = is_last or self._is_full(scene)
        earlier, new = (frozenset(o.instance for o in objects) for objects in (self.scene.objects, found))
        corrections = yield from self._corrected(scene, meant, earlier, new, is_last)
        done = corrections[-1]
        if done.certified is None:
            return Turn(wanted, proposal, furnished, corrections, done.reason, str(done.status)), None
        missing = self._missing(done)
        step = replace(step, scene=done.certified, correction=done, is_at_rest=is_last, missing=missing)
        if missing <= self.missing:
            return Turn(wanted, proposal, furnished, corrections), step
        reason = f"{missing} relations do not hold that the instruction says"
        return Turn(wanted, proposal, furnished, corrections, reason, "relation_lost"), step

    def _corrected(
        self, scene: Scene, meant: Mapping[str, Relation], earlier: frozenset[str], new: frozenset[str], is_last: bool
    ) -> Generator[Request, Answer, tuple[Correction, ...]]:
        """Corrections of a scene, the last of which counts: what was there before is moved no farther than it may.

        Nor is any of it left out while the new things can give way to it.
        """
        scene = _wanting(scene, meant)
        holds = self.settings.earlier_move == 0
        first = yield CorrectionRequest(scene, earlier if holds else frozenset(), new, is_last)
        assert isinstance(first, Correction)
        if holds or first.certified is None or not earlier:
            return (first,)
        now = replace(first.certified, objects=tuple(o for o in first.certified.objects if o.instance in earlier))
        is_near = movement(scene, now)[1] <= 1e3 * self.settings.earlier_move
        if len(now.objects) == len(earlier) and is_near:
            return (first,)
        second = yield CorrectionRequest(scene, earlier, new, is_last)
        assert isinstance(second, Correction)
        if is_near and (second.certified is None or (second.rest is not None and second.rest.unsteady)):
            return second, first  # what has to go is one of those that stood there before
        return first, second

    def _missing(self, done: Correction) -> int:
        """How many relations do not hold that the instruction says: on, in or beside a thing, or in a corner of the table."""
        said = () if done.start.task is None else done.start.task.relations
        missing = set() if done.kept is None else {r for r in done.kept.asked_missing if r in said}
        if self.statistics is not None and done.certified is not None:
            named = [o for o in done.certified.objects if o.stage is Stage.TASK]
            # Of corners alone: what is on and in what is known of the correction, exactly.
            broken = relations_not_held(named, self.task.table, self.task.instruction, self.statistics, frozenset())
            missing |= {r for r in broken if r.kind is RelationKind.IS_AT}
        return len(missing)

    def _is_full(self, scene: Scene) -> bool:
        """Whether what stands on the table covers as much of it as it may."""
        width, depth = scene.table.size_xy
        covered = sum(o.size[0] * o.size[1] for o in scene.objects if o.support in (None, TABLE))
        return self.settings.full < 1 and covered > self.settings.full * width * depth

    def _start(self) -> Scene:
        names = {o.instance for o in self.scene.objects}
        return replace(self.start, objects=tuple(o for o in self.start.objects if o.instance in names), task=self.scene.task)

    def _hear(self, wanted: Wanted, proposal: Proposal) -> None:
        """Notes what was unknown in the question, and what is still wrong with the answer."""
        name = self.task.scene_id
        for notice in proposal.notices:  # the same at every stage
            message = notice.message.removeprefix(f"{notice.item_id}: ")
            self.warnings.append(Notice(name, notice.step, notice.code, f"{name}: {message}"))
        for fault in proposal.faults:
            self._warn(fault.code, f"stage {wanted}: {fault.message}")

    def _warn(self, code: str, message: str) -> None:
        self.warnings.append(Notice(self.task.scene_id, STEP, code, f"{self.task.scene_id}: {message}"))

    def _failed(self, code: str, message: str) -> GenerationResult:
        return self._ended(Notice(self.task.scene_id, STEP, code, f"{self.task.scene_id}: {message}"))

    def _ended(self, failure: Notice | None) -> GenerationResult:
        scene, correction = (self.scene, self.correction) if failure is None else (None, None)
        warnings = tuple(dict.fromkeys(self.warnings))
        dropped = tuple(self.dropped)
        return GenerationResult(self.task, scene, self._start(), tuple(self.turns), correction, dropped, failure, warnings)


def _wanting(scene: Scene, meant: Mapping[str, Relation]) -> Scene:
    """The scene as one whose things are to be where the instruction says, else on or in what they were meant to be on or in."""
    said = () if scene.task is None else scene.task.relations
    wanted = {**meant} | {r.subject: r for r in said if r.kind in _CARRYING}
    there = {o.instance for o in scene.objects}
    beside = [r for r in said if r.kind in DIRECTIONAL]
    return replace(scene, relations=tuple(r for r in (*wanted.values(), *beside) if r.target in there))


def _carried(scene: Scene, new: Set[str]) -> dict[str, Relation]:
    """What of the new things a proposal has on or in others, by their boxes."""
    graph = scene_graph(scene, {o.instance: (o.support,) for o in scene.objects if o.support is not None})
    return {r.subject: r for r in relations_of(graph) if r.kind in _CARRYING and r.target != TABLE and r.subject in new}
