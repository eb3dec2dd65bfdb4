"""One scene by a system that drafts objects and relations, and finds places by a search: a coroutine like Algorithm 1."""

import math
from collections.abc import Generator, Sequence
from dataclasses import dataclass, replace

from models.baselines.layout.draft import stacked
from models.baselines.layout.drafting import Draft, Drafting, Exchanges
from models.baselines.placement.problem import Constraint, Placement, PlacementProblem, Search
from models.dual_system.algorithm1 import LoopSettings, closed
from models.dual_system.generation_state import STEP, GenerationState, StageCandidate
from models.dual_system.requests import Answer, Loop, PlacementRequest, Request, RetrievalRequest, Turn
from models.semantic_reasoner.language.interpreter import InstructionInterpreter
from models.semantic_reasoner.replies.to_scene import attach_task_info, staged_by_instruction
from models.semantic_reasoner.staged_layout import LayoutTask
from models.semantic_reasoner.text.reply_json import layout_objects
from stable_data.assets.assignment import AssignedLayout
from stable_data.errors import Notice
from stable_data.random_seeds import named_seed
from stable_data.scene import Relation, RelationKind, Scene, SceneObject


@dataclass(frozen=True, slots=True)
class PlacingSystem:
    """A system that places objects by a search.

    Attributes:
        drafting: Obtains the objects and their relations.
        search: Finds their places.
        retrieves_first: Whether objects get their assets before the search, which then knows the true boxes; otherwise the search uses
            the proposed sizes, and the assets may be larger or smaller.
    """

    drafting: Drafting
    search: Search
    retrieves_first: bool


def placed_layout(
    system: PlacingSystem, task: LayoutTask, seed: int, settings: LoopSettings, interpret: InstructionInterpreter | None
) -> Loop:
    """Runs a system for one scene.

    Args:
        system: The system.
        task: The instruction and the table.
        seed: Seed of all random choices of the scene.
        settings: ``tries``, and whether the layout is corrected: ``each`` and ``end`` mean the same, since there is one stage.
        interpret: Interprets the instruction, or None: the task info then has no relations.

    Yields:
        The next request.

    Returns:
        The scene, and all attempts.
    """
    state = GenerationState(task)
    for attempt in range(settings.tries):
        turn, candidate = yield from _attempt(system, state, named_seed(seed, attempt), interpret)
        state.turns.append(turn)
        if candidate is not None:
            state.accept(replace(candidate, turn=len(state.turns) - 1))
            return (yield from closed(state, settings))
        if not turn.proposal.refused and turn.proposal.failure:  # the question or the engine is the cause
            break
    rejected = state.turns[-1]
    return state.failure(rejected.code, rejected.rejected)


def _attempt(
    system: PlacingSystem, state: GenerationState, seed: int, interpret: InstructionInterpreter | None
) -> Generator[Request, Answer, tuple[Turn, StageCandidate | None]]:
    """Drafts, retrieves and places once.

    Returns:
        The attempt, and its scene, or None if it has no object.
    """
    task, before = state.task, state.scene
    exchanges = Exchanges(task, seed)
    draft = yield from system.drafting(exchanges)
    if draft is None:
        proposal = exchanges.proposal(None)
        state.note_proposal("whole", proposal)
        return Turn("whole", proposal, rejected=proposal.failure, code=proposal.code), None
    bare = replace(before, objects=(), fixed=frozenset())
    wanted = stacked([o.to_scene_object() for o in draft.objects], draft.constraints)
    objects = wanted
    if system.retrieves_first:
        assigned = yield from _with_assets(replace(bare, objects=wanted))
        objects = assigned.scene.objects
    constraints = _between(draft.constraints, objects)
    boxes = tuple(_box(o) for o in objects)
    problem = PlacementProblem(task.table, boxes, constraints, before.surroundings, named_seed(seed, "placement"))
    placement = yield PlacementRequest(problem, system.search)
    assert isinstance(placement, Placement)
    placed = tuple(_at_place(o, placement) for o in objects if o.instance not in placement.dropped)
    if not system.retrieves_first:
        assigned = yield from _with_assets(replace(bare, objects=placed))
        placed = assigned.scene.objects
    proposed = _as_drafted(placed, draft)
    proposal = exchanges.proposal(layout_objects(proposed, {o.instance: o.instance for o in proposed}))
    state.note_proposal("whole", proposal)
    turn = Turn("whole", proposal, assigned)
    if not placed:
        reason = next(iter(placement.dropped.values()), "no object has an asset")
        return replace(turn, rejected=f"no object has a place: {reason}", code="layout_empty"), None
    proposed = staged_by_instruction(proposed, task.shown_table, task.instruction, interpret)
    placed = tuple(replace(o, stage=own.stage) for o, own in zip(placed, proposed, strict=True))
    scene = replace(before, objects=(*before.objects, *placed))
    scene = attach_task_info(scene, task.instruction, proposed, interpret, task.reference, task.conditions)
    notices = (*assigned.notices, *_notices(task, placement))
    return turn, StageCandidate(scene, placed, _supports(constraints, placed), notices, 0)


def _with_assets(layout: Scene) -> Generator[Request, Answer, AssignedLayout]:
    """The layout with assets."""
    assigned = yield RetrievalRequest(layout)
    assert isinstance(assigned, AssignedLayout)
    return assigned


def _between(constraints: Sequence[Constraint], objects: Sequence[SceneObject]) -> tuple[Constraint, ...]:
    """The relations between objects that are there."""
    names = {o.instance for o in objects}
    return tuple(c for c in constraints if names.issuperset(c.members))


def _is_turned(o: SceneObject) -> bool:
    """Whether the asset of an object is modelled along the other side of its box."""
    return abs(math.sin(o.yaw)) > 0.5


def _box(o: SceneObject) -> SceneObject:
    """The object as a search sees it: its box at yaw 0."""
    width, depth, height = o.size
    return replace(o, size=(depth, width, height)) if _is_turned(o) else o


def _at_place(o: SceneObject, placement: Placement) -> SceneObject:
    """The object at the place that a search has found for it."""
    found = next(own for own in placement.objects if own.instance == o.instance)
    yaw = math.remainder(found.yaw + (o.yaw if _is_turned(o) else 0.0), math.tau)
    return replace(o.moved(found.position, yaw), support=found.support)


def _as_drafted(placed: Sequence[SceneObject], draft: Draft) -> tuple[SceneObject, ...]:
    """Placed objects with the categories of the draft, by which the instruction names them."""
    category = {o.instance: o.category for o in draft.objects}
    return tuple(replace(o, category=category[o.instance]) for o in placed)


def _supports(constraints: Sequence[Constraint], placed: Sequence[SceneObject]) -> dict[str, Relation]:
    """Subject -> relation of the placed objects that are on or in another one."""
    support = {o.instance: o.support for o in placed}
    return {
        c.subject: Relation(c.subject, RelationKind(str(c.kind)), c.target)
        for c in constraints
        if c.subject in support and support[c.subject] == c.target and str(c.kind) in (RelationKind.ON, RelationKind.IN)
    }


def _notices(task: LayoutTask, placement: Placement) -> list[Notice]:
    """What found no place, and which relations could not be met."""
    name = task.scene_id
    found = [
        Notice(name, STEP, "no_place", f"{name}: {instance} is left out: {reason}")
        for instance, reason in placement.dropped.items()
    ]
    if placement.broken:
        told = ", ".join(map(str, placement.broken))
        found.append(Notice(name, STEP, "relation_not_met", f"{name}: the search has found no places where {told}"))
    return found
