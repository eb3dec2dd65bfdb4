"""Derives a task for a scene: draws a kind of task, then its objects, then the words."""

import hashlib
from dataclasses import replace

import numpy as np

from stable_data.condition import ConditionKind, GoalCondition
from stable_data.errors import SceneError
from stable_data.instructions import containing, dining, picking, placing, sorting, stacking, tidying, using
from stable_data.instructions.kind import TaskDraft, TaskKind
from stable_data.instructions.naming import SIDE_WORDS, Distinction, ObjectName, ObjectNamer, holds_relation, mentions
from stable_data.instructions.situation import TaskContext
from stable_data.instructions.steps import MultiStepKind, steps_of
from stable_data.instructions.wording.paraphrase import request
from stable_data.instructions.wording.words import is_plural, sentences, type_name
from stable_data.scene import RelationKind, Scene, TaskInfo
from stable_data.scene_graph.relations import SceneGraph

SIMPLE_KINDS: tuple[TaskKind, ...] = (
    *picking.KINDS,
    *placing.KINDS,
    *containing.KINDS,
    *stacking.KINDS,
    *sorting.KINDS,
    *dining.KINDS,
    *using.KINDS,
    *tidying.KINDS,
)
"""Kinds of task with one step."""

KINDS: tuple[TaskKind | MultiStepKind, ...] = (*SIMPLE_KINDS, *steps_of(SIMPLE_KINDS))
"""All kinds of task."""

NUM_PATTERNS = len({text for kind in KINDS for text in kind.texts})
"""Number of different templates, before rewording."""


def task_rng(scene_id: str, seed: int = 0) -> np.random.Generator:
    """Returns the random generator for the task of a scene; it depends on the scene id and the seed alone."""
    digest = hashlib.sha256(f"{seed}:{scene_id}".encode()).digest()
    return np.random.default_rng(int.from_bytes(digest[:8], "big"))


def derive_task(scene: Scene, graph: SceneGraph, rng: np.random.Generator) -> TaskInfo:
    """Derives a feasible task for a scene from templates.

    Draws a kind of task with equal probability among the kinds that are feasible in the scene, then the objects, then the words.
    Where these state no relation of the start, a sentence before them states one.
    Each statement is true: each name identifies one object, the relations hold, and the goal is not reached yet. Objects
    without a support in the scene graph and objects without a mesh are used only if the scene has no others.

    Args:
        scene: The scene; at least one object.
        graph: Its scene graph.
        rng: The random generator, usually :func:`task_rng` of the scene id.

    Returns:
        The task info with ``origin`` ``template``, its task objects and the relations that it states about the initial scene.
        Each task object adds its type to ``objects_cluster``, so a type may occur twice.

    Raises:
        SceneError: The scene has no objects (``scene_empty``).
    """
    if not scene.objects:
        raise SceneError(f"{scene.scene_id}: no objects, expected at least one for a task; remove the scene", "scene_empty")
    steady = [o.instance for o in scene.objects if o.asset_id is not None and graph.nodes[o.instance]["support"] is not None]
    namer = ObjectNamer(scene, graph)
    context = TaskContext(scene, graph, rng, steady, [name for name in steady if namer.names(name)])
    drafts = (kind.draft(context, namer) for kind in context.shuffled(KINDS))  # lazy: a draft consumes random numbers
    draft = next((d for d in drafts if d is not None), None)
    if draft is None:
        return _task_info(_fallback(scene, steady, namer), scene)
    text = request(draft.text, draft.theme, rng)
    if not draft.relations and (told := _situation(draft, context, namer)) is not None:
        words, draft = told
        text = f"{words} {text}"
    return _task_info(draft, scene, text)


def _situation(draft: TaskDraft, context: TaskContext, namer: ObjectNamer) -> tuple[str, TaskDraft] | None:
    """A sentence that states where an object of the task is, and the draft with that relation; None if none can be named.

    The layout of a scene follows its instruction only where the instruction says something of it.
    """
    graph = context.graph
    said = {m.instance: m.name for m in mentions(draft.text, namer) if m.name.anchor is None}
    for one in context.shuffled([name for name in draft.objects if name in said]):
        for other in context.shuffled(sorted({*graph.successors(one), *graph.predecessors(one)} & context.named)):
            subject = said[one]  # with another name it would seem to be another object
            place = said.get(other) or (None if other in draft.objects else _name_alone(other, namer, context))
            stated = {kind: holds_relation(graph, one, kind, other) for kind in (RelationKind.IN, RelationKind.ON, *SIDE_WORDS)}
            kind, relation = next(((k, r) for k, r in stated.items() if r is not None), (None, None))
            if place is None or kind is None or relation is None:
                continue
            nouns = {subject.noun} if other in draft.objects else {*draft.nouns, subject.noun}
            if not any(noun.endswith(place.noun) or place.noun.endswith(noun) for noun in nouns):
                verb = context.pick(
                    ("are", "are now", "are currently") if is_plural(subject.noun) else ("is", "is now", "is currently")
                )
                words = sentences(f"{subject.words} {verb} {SIDE_WORDS.get(kind, str(kind))} {place.words}")
                objects = tuple(dict.fromkeys([*draft.objects, other]))
                return words, replace(draft, objects=objects, relations=(relation,))
    return None


def _name_alone(instance: str, namer: ObjectNamer, context: TaskContext) -> ObjectName | None:
    """A name without another object: the noun, else preferably a name that ends with it; None if there is none."""
    alone = [name for name in namer.names(instance) if name.anchor is None and name.distinction is not Distinction.CELL]
    bare = [name for name in alone if name.distinction is Distinction.NOUN] or [name for name in alone if name.is_short]
    return context.pick(bare or alone) if alone else None


def _task_info(draft: TaskDraft, scene: Scene, text: str = "") -> TaskInfo:
    objects = {o.instance: o for o in scene.objects}
    return TaskInfo(
        environment=f"A {scene.table.table_type.replace('_', ' ')}, seen from its front edge.",
        task=text or sentences(draft.text),
        goal=tuple(sentences(goal) for goal in draft.goal),
        action_sequence=draft.actions,
        objects_cluster=tuple(type_name(objects[name].category) or "Object" for name in draft.objects),
        task_objects=tuple(name for name in objects if name in draft.objects),
        relations=draft.relations,
        origin="template",
        conditions=draft.conditions,
    )


def _fallback(scene: Scene, steady: list[str], namer: ObjectNamer) -> TaskDraft:
    """The task if no kind is feasible: pick up the best object (prefers supported, then nameable, then small objects)."""
    best = min(scene.objects, key=lambda o: (o.instance not in steady, not namer.names(o.instance), max(o.size), o.instance))
    noun = namer.own_noun(best.instance) or "object"
    names = namer.names(best.instance)
    words = next((name.words for name in names if name.anchor is None), f"one {noun}" if noun != "object" else "the object")
    goal = f"{words} {'are' if is_plural(noun) else 'is'} held above the table"
    return TaskDraft(
        f"pick up {words}",
        (goal,),
        (f"Pick({type_name(best.category) or 'Object'})",),
        (best.instance,),
        (noun,),
        (),
        conditions=(GoalCondition(best.instance, ConditionKind.HELD),),
    )
