"""What is to be done in a scene: task infos read, understood, or made up from the scene graph.

A task info names types (``NestingCup``); training needs instances and what the instruction says of the scene it starts from.
:func:`resolve_task_objects` finds both in the words. Where a scene has no task info, :func:`derive_task` fills a template with
things that are true in the scene, or :func:`model_task` asks a model of the caller's.
"""

import hashlib
import json
import math
import re
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any, TypeAlias

import numpy as np

from stable_data.atomic_files import write_file_atomically
from stable_data.errors import Notice, SceneError, cannot_write
from stable_data.instructions import derive_task, task_rng, type_name, type_words
from stable_data.instructions.claims import OUTERMOST, StatedRelation, emptied_numbers, number_mentions, read_claims
from stable_data.instructions.naming import ObjectMention, ObjectNamer, involved_instances, mentions
from stable_data.instructions.situation import OPPOSITE
from stable_data.instructions.wording.words import singular
from stable_data.scene import TABLE, Relation, RelationKind, Scene, SceneObject, TaskInfo
from stable_data.scene_graph.relations import SceneGraph, relations_of
from stable_data.task_info import task_info_of, validate_task_info

TaskWriter: TypeAlias = Callable[[Scene, tuple[Relation, ...]], Mapping[str, Any]]
"""A model that writes a task info, with MesaTask's keys, for a scene and its scene graph."""

STEP = "task"
"""The step that this module's notices name."""

# --- names --------------------------------------------------------------------------------------------------------------------


def _instances_of(scene: Scene, name: str) -> list[SceneObject]:
    """Objects of a type: by category, else by an end of it, else by their description."""
    words = type_words(name)
    tests: tuple[Callable[[SceneObject], bool], ...] = (
        lambda o: singular(type_words(o.category)) == singular(words),
        lambda o: _is_part(singular(type_words(o.category)), singular(words)),
        lambda o: bool(words) and set(words) <= set(type_words(o.description)),
    )
    for test in tests:
        if words and (found := [o for o in scene.objects if test(o)]):
            return found
    return []


def _is_part(one: tuple[str, ...], other: tuple[str, ...]) -> bool:
    """Does the longer start or end with the shorter?"""
    short, long = sorted((one, other), key=len)
    return bool(short) and (long[: len(short)] == short or long[-len(short) :] == short)


# --- task objects and what the instruction says of the start ------------------------------------------------------------------


def resolve_task_objects(task: TaskInfo, scene: Scene, graph: SceneGraph) -> tuple[TaskInfo, tuple[Notice, ...]]:
    """Finds the instances that a task is about, and what its instruction says of the scene it starts from.

    Words that single an object out (``the red mug``, ``the leftmost mug``) decide. Of several instances of a type those are
    kept that agree with the instruction (``the spice jar in the cup``); among the rest the one nearest to the other task
    objects is taken and a notice says so, or all where the words ask for all. Relations to the table itself are not listed. A
    task info that names its instances already is left as it is.

    Args:
        task: The task info; its types come from ``objects_cluster`` and the action sequence, else from the instruction.
        scene: The scene that it starts from.
        graph: Its scene graph.

    Returns:
        The task info with ``task_objects`` and ``relations``, and notices: ``task_object_missing``,
        ``task_object_ambiguous``, ``task_relation_not_held``.
    """
    if task.task_objects:
        absent = sorted(set(task.task_objects) - {o.instance for o in scene.objects})
        return task, tuple(_notice(scene, "task_object_missing", f"no object is called {name}") for name in absent)
    said = mentions(task.task, ObjectNamer(scene, graph))
    types = _types_of(task, scene, said)
    found = {k: [o.instance for o in _instances_of(scene, name)] for k, name in enumerate(types)}
    notices = [_notice(scene, "task_object_missing", f"no object is a {types[k]}") for k, names in found.items() if not names]
    wanted = {k: max(1, sum(type_words(c) == type_words(types[k]) for c in task.objects_cluster)) for k in found}
    known = {name for names in found.values() for name in names}
    said = tuple(m for m in said if m.instance in known)
    pins = [n for n in dict.fromkeys([*(m.instance for m in said), *involved_instances([m.name for m in said])]) if n in known]
    marked = number_mentions(task.task, types, said, pins)
    claims = read_claims(marked)
    _pin(found, wanted, pins)
    slots = [*types, *(type_name(scene[name].category) for name in pins)]
    notices += _settle(scene, graph, task, slots, claims, found, wanted)
    chosen = [o.instance for o in scene.objects if any(o.instance in names for names in found.values())]
    relations_said = {r for claim in claims for r in _relations_said(graph, claim, found)}
    linked = ((a, k, b) for a, b, k in graph.edges(keys=True) if a in chosen and k in (RelationKind.IN, RelationKind.ON))
    emptied_ones = {name for k in emptied_numbers(marked) for name in found[k] if len(found[k]) == 1}
    relations_said |= {Relation(a, RelationKind(k), b) for a, k, b in linked if b in emptied_ones}
    relations_said |= {_as_said(m.name.relation, m.instance) for m in said if m.name.relation is not None}
    relations = tuple(sorted(relations_said))
    for r in relations:
        if r.kind is not RelationKind.IS_AT and not _holds(scene, graph, r.subject, r.kind, r.target):
            notices.append(_notice(scene, "task_relation_not_held", f"the instruction says {r}"))
    return replace(task, task_objects=tuple(chosen), relations=relations), tuple(notices)


def _notice(scene: Scene, code: str, message: str) -> Notice:
    return Notice(scene.scene_id, STEP, code, f"{scene.scene_id}: {message}; check the task info against the layout")


def _pin(found: dict[int, list[str]], wanted: dict[int, int], pins: Sequence[str]) -> None:
    """Gives each object that the words single out a number of its own; its type is not sought any further than that."""
    for k, names in found.items():
        pinned = [name for name in names if name in pins]
        rest = [name for name in names if name not in pins]
        wanted[k] -= len(pinned)
        if pinned:
            found[k] = rest if wanted[k] > 0 else pinned
            wanted[k] = wanted[k] if wanted[k] > 0 else len(pinned)
    for name in pins:
        wanted[len(found)] = 1
        found[len(found)] = [name]


def _types_of(task: TaskInfo, scene: Scene, said: Sequence[ObjectMention]) -> list[str]:
    """Types of the task objects, each once."""
    arguments = re.findall(r"\b(?!PlaceAt)\w+\(\s*([^,()]+)", " ".join(task.action_sequence))
    named = [*task.objects_cluster, *(a for a in arguments if _instances_of(scene, a))]
    if not named:
        categories = sorted({o.category for o in scene.objects})
        singled = list(dict.fromkeys(m.instance for m in said))
        marked = number_mentions(task.task, categories, said, singled)
        named = [category for k, category in enumerate(categories) if f"<{k}>" in marked]
        named += [scene[name].category for name in (*singled, *involved_instances([m.name for m in said]))]
    unique = {type_words(name): name for name in reversed(named) if type_words(name) not in ((), (TABLE,))}
    return list(reversed(unique.values()))


def _settle(
    scene: Scene,
    graph: SceneGraph,
    task: TaskInfo,
    types: Sequence[str],
    claims: Sequence[StatedRelation],
    found: dict[int, list[str]],
    wanted: Mapping[int, int],
) -> list[Notice]:
    """Narrows ``found`` to the instances that are meant."""
    notices = []
    for k, names in found.items():
        asked = re.search(
            rf"\b({'|'.join(OUTERMOST)}) {'[ _-]'.join(map(re.escape, type_words(types[k])))}\b", task.task.lower()
        )
        if asked and names:
            found[k] = [min(names, key=lambda n: (OUTERMOST[asked[1]] * scene[n].position[0], n))]
    _keep_agreeing(scene, graph, claims, found)
    for k in sorted(found, key=lambda k: len(found[k])):
        if len(found[k]) <= wanted[k] or _asks_for_all(task.task, types[k]):
            continue
        anchors = [names[0] for other, names in found.items() if other != k and len(names) == 1]
        message = f"{len(found[k])} objects are a {types[k]} ({', '.join(found[k])}), the nearest is taken"
        notices.append(_notice(scene, "task_object_ambiguous", message))
        found[k] = _nearest(scene, found[k], anchors)[: wanted[k]]
        _keep_agreeing(scene, graph, claims, found)
    return notices


def _keep_agreeing(scene: Scene, graph: SceneGraph, claims: Sequence[StatedRelation], found: dict[int, list[str]]) -> None:
    for c in claims:
        pairs = [(a, b) for a in found[c.a] for b in found[c.b] if a != b and _holds(scene, graph, a, c.kind, b)]
        if pairs:
            found[c.a] = [a for a in found[c.a] if any(a == pair[0] for pair in pairs)]
            found[c.b] = [b for b in found[c.b] if any(b == pair[1] for pair in pairs)]


def _asks_for_all(text: str, name: str) -> bool:
    last = type_words(name)[-1]
    return bool(
        re.search(rf"\b(?:all|every|each|both)\b[^.;]*\b{last}|\b(?:two|three|four|five) [^.;]*\b{last}e?s\b", text.lower())
    )


def _nearest(scene: Scene, names: Sequence[str], anchors: Sequence[str]) -> list[str]:
    """Instances by distance to the other task objects, else to the viewer."""
    viewer = (scene.table.size_xy[0] / 2, 0.0)
    points = [scene[a].position[:2] for a in anchors] or [viewer]
    return sorted(names, key=lambda n: (round(sum(math.dist(scene[n].position[:2], p) for p in points), 6), n))


def _holds(scene: Scene, graph: SceneGraph, a: str, kind: RelationKind | None, b: str) -> bool:
    dx, dy, _ = np.subtract(scene[a].position, scene[b].position)
    sides = {
        RelationKind.LEFT_OF: dx < 0,
        RelationKind.RIGHT_OF: dx > 0,
        RelationKind.IN_FRONT_OF: dy < 0,
        RelationKind.BEHIND: dy > 0,
    }
    if kind in sides:
        return bool(sides[kind])
    return any(graph.has_edge(a, b, key=k) for k in (RelationKind.IN, RelationKind.ON) if kind in (k, None))


def _relations_said(graph: SceneGraph, claim: StatedRelation, found: Mapping[int, list[str]]) -> Iterator[Relation]:
    if len(found[claim.b]) != 1:
        return
    b = found[claim.b][0]
    is_container = graph.nodes[b]["container"] is True
    for a in found[claim.a]:
        if a == b:
            continue
        # "From" is in or on: in what is known to hold things, else on, which being in a thing satisfies.
        is_in = is_container and graph.has_edge(a, b, key=RelationKind.IN)
        linked = RelationKind.IN if is_in else RelationKind.ON
        yield Relation(a, claim.kind or linked, b)


def _as_said(relation: Relation, instance: str) -> Relation:
    """A relation with the object as its subject, as the words have it."""
    if relation.subject == instance:
        return relation
    return Relation(instance, OPPOSITE[relation.kind], relation.subject)


# --- a model's task infos -----------------------------------------------------------------------------------------------------


def model_task(
    scene: Scene, graph: SceneGraph, write: TaskWriter, cache_dir: Path | str, writer_id: str = "", seed: int = 0
) -> tuple[TaskInfo, tuple[Notice, ...]]:
    """The task that a model writes for a scene, or a template's where its answer cannot be used.

    A usable answer is kept on disk under the content of what the model was shown, so that a rerun asks nothing and gives the
    same rows; an answer that cannot be used is not kept.

    Args:
        scene: The scene; at least one object.
        graph: Its scene graph.
        write: The model. Its ``OSError``, ``ValueError`` and ``LookupError`` count as answers that cannot be used.
        cache_dir: Folder of the kept answers; made where it is missing.
        writer_id: What the answer depends on besides the scene: the model's name, its prompt's version.
        seed: For the template that stands in.

    Returns:
        The task info, ``origin`` ``model`` or ``template``, and notices: ``task_model_failed`` or those of
        :func:`resolve_task_objects`.

    Raises:
        ConfigError: A usable answer cannot be kept: no permission, or the disk is full.
    """
    relations = relations_of(graph)
    path = Path(cache_dir) / f"{_content_key(scene, relations, writer_id)}.json"
    try:
        data, is_new = _kept(path), False
        if data is None:
            data, is_new = _plain(write(scene, relations)), True
        task, notices = resolve_task_objects(task_info_of(data, origin="model"), scene, graph)
        if not task.task_objects:
            raise SceneError(
                f"task {task.task!r} names {task.objects_cluster}, expected types of the scene", "task_objects_unknown"
            )
    except (OSError, ValueError, LookupError) as error:
        told = derive_task(scene, graph, task_rng(scene.scene_id, seed))
        return told, (_notice(scene, "task_model_failed", f"the model's task cannot be used ({error}), a template's is taken"),)
    if is_new:
        _keep(path, data)
    return task, notices


def _plain(answer: Mapping[str, Any]) -> dict[str, Any]:
    """A model's answer as it will be read from the cache, so that a rerun gives the same rows."""
    try:
        plain: dict[str, Any] = json.loads(json.dumps(dict(answer), sort_keys=True))
    except (TypeError, RecursionError) as error:
        raise SceneError(f"task info: the answer is no JSON object ({error})", "task_info_invalid") from error
    return plain


def _content_key(scene: Scene, relations: Iterable[Relation], writer_id: str) -> str:
    objects = [(o.instance, o.category, o.description, o.position, o.yaw, o.size, o.asset_id) for o in scene.objects]
    shown = json.dumps([writer_id, asdict(scene.table), objects, [asdict(r) for r in relations]], sort_keys=True)
    return hashlib.sha256(shown.encode()).hexdigest()


def _kept(path: Path) -> dict[str, Any] | None:
    """An answer kept before, or None where there is none that can be read."""
    try:
        data = json.loads(path.read_text(encoding="utf-8"))
        validate_task_info(data)
    except (OSError, ValueError, AttributeError, RecursionError):
        return None
    return dict(data)


def _keep(path: Path, data: Mapping[str, Any]) -> None:
    """Written aside and put in place in one step, so that a reader never sees half of it."""
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        write_file_atomically(path, json.dumps(data, indent=2, sort_keys=True).encode())
    except OSError as error:
        raise cannot_write(str(path), error) from error
