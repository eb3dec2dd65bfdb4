"""A task for a scene: a kind is drawn, then objects, then words."""

import hashlib

import numpy as np

from stable_data.errors import SceneError
from stable_data.instructions import containing, dining, picking, placing, sorting, stacking, tidying, using
from stable_data.instructions.kind import TaskDraft, TaskKind
from stable_data.instructions.naming import ObjectNamer
from stable_data.instructions.situation import TaskContext
from stable_data.instructions.steps import MultiStepKind, steps_of
from stable_data.instructions.wording.paraphrase import request
from stable_data.instructions.wording.words import is_plural, sentences, type_name
from stable_data.scene import Scene, TaskInfo
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
"""Kinds of task that stand for themselves."""

KINDS: tuple[TaskKind | MultiStepKind, ...] = (*SIMPLE_KINDS, *steps_of(SIMPLE_KINDS))
"""Every kind of task."""

NUM_PATTERNS = len({text for kind in KINDS for text in kind.texts})
"""Different texts with roles, before any rewording."""


def task_rng(scene_id: str, seed: int = 0) -> np.random.Generator:
    """The generator from which a scene's task is drawn: the same for the same scene and seed, whoever asks and whenever."""
    digest = hashlib.sha256(f"{seed}:{scene_id}".encode()).digest()
    return np.random.default_rng(int.from_bytes(digest[:8], "big"))


def derive_task(scene: Scene, graph: SceneGraph, rng: np.random.Generator) -> TaskInfo:
    """A task that makes sense in a scene, by template.

    A kind of task is drawn evenly among those that the scene has the objects for, then the objects, then the words. What is
    said is true: objects are told apart from the others of their kind, relations hold, and the goal is not reached yet. Objects
    that float in the scene graph's sense, or have no mesh, are left alone where there are others.

    Args:
        scene: The scene; at least one object.
        graph: Its scene graph.
        rng: Where the draws come from, as a rule :func:`task_rng` of the scene's id.

    Returns:
        The task info, ``origin`` ``template``; its task objects, and what it says of the start, are known. Every task object
        adds its type to ``objects_cluster``, so a type may be there twice.

    Raises:
        SceneError: The scene has no objects (``scene_empty``).
    """
    if not scene.objects:
        raise SceneError(f"{scene.scene_id}: no objects, expected at least one for a task; remove the scene", "scene_empty")
    supports = {name: about.get("support") for name, about in graph.nodes(data=True)}
    steady = [o.instance for o in scene.objects if o.asset_id is not None and supports[o.instance] is not None]
    namer = ObjectNamer(scene, graph)
    situation = TaskContext(scene, graph, rng, steady, [name for name in steady if namer.names(name)])
    told = (kind.tell(situation, namer) for kind in situation.mixed(KINDS))
    first = next((one for one in told if one is not None), None)
    if first is None:
        return _task(_fallback(scene, steady, namer), scene)
    return _task(first, scene, request(first.text, first.theme, rng))


def _task(told: TaskDraft, scene: Scene, text: str = "") -> TaskInfo:
    objects = {o.instance: o for o in scene.objects}
    return TaskInfo(
        environment=f"A {scene.table.table_type.replace('_', ' ')}, seen from its front edge.",
        task=text or sentences(told.text),
        goal=tuple(sentences(goal) for goal in told.goal),
        action_sequence=told.actions,
        objects_cluster=tuple(type_name(objects[name].category) or "Object" for name in told.objects),
        task_objects=tuple(name for name in objects if name in told.objects),
        relations=told.relations,
        origin="template",
    )


def _fallback(scene: Scene, steady: list[str], namer: ObjectNamer) -> TaskDraft:
    """Where no kind applies: the object best picked up is, steady, with a name, small."""
    best = min(scene.objects, key=lambda o: (o.instance not in steady, not namer.names(o.instance), max(o.size), o.instance))
    noun = namer.own_noun(best.instance) or "object"
    names = namer.names(best.instance)
    words = next((name.words for name in names if name.anchor is None), f"one {noun}" if noun != "object" else "the object")
    verb = "are" if is_plural(noun) else "is"
    goal = f"{words} {verb} held above the table"
    return TaskDraft(
        f"pick up {words}", (goal,), (f"Pick({type_name(best.category) or 'Object'})",), (best.instance,), (noun,), ()
    )
