"""Task infos of scenes: resolves their task objects, or asks a model for a task info.

A task info contains types (``NestingCup``). Training needs instances and the relations that the instruction states about the
initial scene: :func:`resolve_task_objects` finds both in the words. For a scene without a task info, :func:`derive_task` fills
a template with facts of the scene, and :func:`model_task` asks a model of the caller.
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
from stable_data.instructions.claims import OUTERMOST, StatedRelation, emptied_numbers, number_mentions, read_claims
from stable_data.instructions.deriving import derive_task, task_rng
from stable_data.instructions.naming import ObjectMention, ObjectNamer, involved_instances, mentions
from stable_data.instructions.situation import OPPOSITE
from stable_data.instructions.wording.words import singular, type_name, type_words
from stable_data.scene import TABLE, Relation, RelationKind, Scene, SceneObject, TaskInfo
from stable_data.scene_graph.relations import SceneGraph, relations_of
from stable_data.task_info import task_info_of, validate_task_info

TaskWriter: TypeAlias = Callable[[Scene, tuple[Relation, ...]], Mapping[str, Any]]
"""A model that writes a task info, with the keys of MesaTask, for a scene and the relations of its scene graph."""

STEP = "task"
"""The step in the notices of this module."""

# --- names --------------------------------------------------------------------------------------------------------------------


def _instances_of(scene: Scene, name: str) -> list[SceneObject]:
    """Objects of a type: by category, else by the start or end of their category, else by description."""
    words = type_words(name)
    tests: tuple[Callable[[SceneObject], bool], ...] = (
        lambda o: singular(type_words(o.category)) == singular(words),
        lambda o: _is_prefix_or_suffix(singular(type_words(o.category)), singular(words)),
        lambda o: bool(words) and set(words) <= set(type_words(o.description)),
    )
    for test in tests:
        if words and (found := [o for o in scene.objects if test(o)]):
            return found
    return []


def _is_prefix_or_suffix(one: tuple[str, ...], other: tuple[str, ...]) -> bool:
    """Whether the longer one starts or ends with the shorter one."""
    short, long = sorted((one, other), key=len)
    return bool(short) and (long[: len(short)] == short or long[-len(short) :] == short)


# --- task objects and relations of the initial scene --------------------------------------------------------------------------


def resolve_task_objects(task: TaskInfo, scene: Scene, graph: SceneGraph) -> tuple[TaskInfo, tuple[Notice, ...]]:
    """Finds the task objects of a task info, and the relations that its instruction states about the initial scene.

    Names of single objects (``the red mug``, ``the leftmost mug``) have priority. If a type has several instances, those that
    agree with the instruction (``the spice jar in the cup``) remain. If several remain, the function chooses all of them if the
    instruction asks for all; otherwise it chooses the one nearest to the other task objects and reports it in a notice.
    Relations to the table itself are not listed. A task info that has instances already is returned unchanged.

    Args:
        task: The task info; its types are read from ``objects_cluster`` and the action sequence, else from the instruction.
        scene: The initial scene.
        graph: Its scene graph.

    Returns:
        The task info with ``task_objects`` and ``relations``, and notices: ``task_object_missing``,
        ``task_object_ambiguous``, ``task_relation_not_held``.
    """
    if task.task_objects:
        absent = sorted(set(task.task_objects) - {o.instance for o in scene.objects})
        return task, tuple(_notice(scene, "task_object_missing", f"no object has the name {name}") for name in absent)
    named = mentions(task.task, ObjectNamer(scene, graph))
    types = _types_of(task, scene, named)
    found = {k: [o.instance for o in _instances_of(scene, name)] for k, name in enumerate(types)}
    notices = [_notice(scene, "task_object_missing", f"no object is a {types[k]}") for k, names in found.items() if not names]
    wanted = {k: max(1, sum(type_words(c) == type_words(types[k]) for c in task.objects_cluster)) for k in found}
    known = {name for names in found.values() for name in names}
    named = tuple(m for m in named if m.instance in known)
    pins = [
        n for n in dict.fromkeys([*(m.instance for m in named), *involved_instances([m.name for m in named])]) if n in known
    ]
    marked = number_mentions(task.task, types, named, pins)
    claims = read_claims(marked)
    _pin(found, wanted, pins)
    slots = [*types, *(type_name(scene[name].category) for name in pins)]
    notices += _narrow(scene, graph, task, slots, claims, found, wanted)
    chosen = [o.instance for o in scene.objects if any(o.instance in names for names in found.values())]
    stated = {r for claim in claims for r in _relations_of_claim(graph, claim, found)}
    linked = ((a, k, b) for a, b, k in graph.edges(keys=True) if a in chosen and k in (RelationKind.IN, RelationKind.ON))
    emptied = {name for k in emptied_numbers(marked) for name in found[k] if len(found[k]) == 1}
    stated |= {Relation(a, RelationKind(k), b) for a, k, b in linked if b in emptied}
    stated |= {_with_subject(m.name.relation, m.instance) for m in named if m.name.relation is not None}
    relations = tuple(sorted(stated))
    for r in relations:
        if r.kind is not RelationKind.IS_AT and not _holds(scene, graph, r.subject, r.kind, r.target):
            notices.append(_notice(scene, "task_relation_not_held", f"the instruction states {r}, which does not hold"))
    return replace(task, task_objects=tuple(chosen), relations=relations), tuple(notices)


def _notice(scene: Scene, code: str, message: str) -> Notice:
    return Notice(scene.scene_id, STEP, code, f"{scene.scene_id}: {message}; check the task info against the layout")


def _pin(found: dict[int, list[str]], wanted: dict[int, int], pins: Sequence[str]) -> None:
    """Gives each named object its own number, and reduces the number of objects wanted of its type."""
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


def _types_of(task: TaskInfo, scene: Scene, mentioned: Sequence[ObjectMention]) -> list[str]:
    """Types of the task objects, each once."""
    # The first argument of a primitive is an object, except for PlaceAt, whose argument is a place.
    arguments = re.findall(r"\b(?!PlaceAt)\w+\(\s*([^,()]+)", " ".join(task.action_sequence))
    named = [*task.objects_cluster, *(a for a in arguments if _instances_of(scene, a))]
    if not named:
        categories = sorted({o.category for o in scene.objects})
        instances = list(dict.fromkeys(m.instance for m in mentioned))
        marked = number_mentions(task.task, categories, mentioned, instances)
        named = [category for k, category in enumerate(categories) if f"<{k}>" in marked]
        named += [scene[name].category for name in (*instances, *involved_instances([m.name for m in mentioned]))]
    unique = {type_words(name): name for name in reversed(named) if type_words(name) not in ((), (TABLE,))}
    return list(reversed(unique.values()))


def _narrow(
    scene: Scene,
    graph: SceneGraph,
    task: TaskInfo,
    types: Sequence[str],
    claims: Sequence[StatedRelation],
    found: dict[int, list[str]],
    wanted: Mapping[int, int],
) -> list[Notice]:
    """Reduces ``found`` to the instances that the instruction refers to."""
    notices = []
    for k, names in found.items():
        asked = re.search(
            rf"\b({'|'.join(OUTERMOST)}) {'[ _-]'.join(map(re.escape, type_words(types[k])))}\b", task.task.lower()
        )
        if asked and names:
            found[k] = [min(names, key=lambda n: (OUTERMOST[asked[1]] * scene[n].position[0], n))]
    _filter_by_relations(scene, graph, claims, found)
    # Types with few candidates first: their objects are anchors for the others.
    for k in sorted(found, key=lambda k: len(found[k])):
        if len(found[k]) <= wanted[k] or _asks_for_all(task.task, types[k]):
            continue
        anchors = [names[0] for other, names in found.items() if other != k and len(names) == 1]
        message = f"{len(found[k])} objects are a {types[k]} ({', '.join(found[k])}), the nearest is used"
        notices.append(_notice(scene, "task_object_ambiguous", message))
        found[k] = _nearest(scene, found[k], anchors)[: wanted[k]]
        _filter_by_relations(scene, graph, claims, found)
    return notices


def _filter_by_relations(
    scene: Scene, graph: SceneGraph, claims: Sequence[StatedRelation], found: dict[int, list[str]]
) -> None:
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
    """Instances in order of their distance to the other task objects, or to the viewer if there are none."""
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


def _relations_of_claim(graph: SceneGraph, claim: StatedRelation, found: Mapping[int, list[str]]) -> Iterator[Relation]:
    if len(found[claim.b]) != 1:
        return
    b = found[claim.b][0]
    is_container = graph.nodes[b]["container"] is True
    for a in found[claim.a]:
        if a == b:
            continue
        # "From" means in or on: "in" for a known container, else "on", which an object in a container satisfies too.
        is_in = is_container and graph.has_edge(a, b, key=RelationKind.IN)
        linked = RelationKind.IN if is_in else RelationKind.ON
        yield Relation(a, claim.kind or linked, b)


def _with_subject(relation: Relation, instance: str) -> Relation:
    """The relation or its inverse, with ``instance`` as the subject."""
    if relation.subject == instance:
        return relation
    return Relation(instance, OPPOSITE[relation.kind], relation.subject)


# --- task infos of a model ----------------------------------------------------------------------------------------------------


def model_task(
    scene: Scene, graph: SceneGraph, write: TaskWriter, cache_dir: Path | str, writer_id: str = "", seed: int = 0
) -> tuple[TaskInfo, tuple[Notice, ...]]:
    """Returns the task that a model writes for a scene, or a task from a template if the answer is unusable.

    A usable answer is cached on disk under a hash of the input of the model, so that a rerun does not ask again and gives the
    same rows. An unusable answer is not cached.

    Args:
        scene: The scene; at least one object.
        graph: Its scene graph.
        write: The model. Its ``OSError``, ``ValueError`` and ``LookupError`` count as unusable answers.
        cache_dir: Folder of the cached answers; created if it is missing.
        writer_id: An id of the model and the version of its prompt, on which the answer depends besides the scene.
        seed: Seed of the task from a template.

    Returns:
        The task info, ``origin`` ``model`` or ``template``, and notices: ``task_model_failed`` or those of
        :func:`resolve_task_objects`.

    Raises:
        ConfigError: A usable answer cannot be cached: no permission, or the disk is full.
    """
    relations = relations_of(graph)
    path = Path(cache_dir) / f"{_content_key(scene, relations, writer_id)}.json"
    try:
        data, is_new = _read_cached(path), False
        if data is None:
            data, is_new = _normalized(write(scene, relations)), True
        task, notices = resolve_task_objects(task_info_of(data, origin="model"), scene, graph)
        if not task.task_objects:
            raise SceneError(
                f"task {task.task!r} names {task.objects_cluster}, expected types of the scene", "task_objects_unknown"
            )
    except (OSError, ValueError, LookupError) as error:
        message = f"the task of the model cannot be used ({error}), a template is used"
        derived = derive_task(scene, graph, task_rng(scene.scene_id, seed))
        return derived, (_notice(scene, "task_model_failed", message),)
    if is_new:
        _write_cached(path, data)
    return task, notices


def _normalized(answer: Mapping[str, Any]) -> dict[str, Any]:
    """The answer after a round trip through JSON, as a rerun reads it from the cache."""
    try:
        plain: dict[str, Any] = json.loads(json.dumps(dict(answer), sort_keys=True))
    except (TypeError, RecursionError) as error:
        raise SceneError(f"task info: the answer is not a JSON object ({error})", "task_info_invalid") from error
    return plain


def _content_key(scene: Scene, relations: Iterable[Relation], writer_id: str) -> str:
    objects = [(o.instance, o.category, o.description, o.position, o.yaw, o.size, o.asset_id) for o in scene.objects]
    shown = json.dumps([writer_id, asdict(scene.table), objects, [asdict(r) for r in relations]], sort_keys=True)
    return hashlib.sha256(shown.encode()).hexdigest()


def _read_cached(path: Path) -> dict[str, Any] | None:
    """A cached answer, or None if there is no valid one."""
    try:
        data = json.loads(path.read_text(encoding="utf-8"))
        validate_task_info(data)
    except (OSError, ValueError, AttributeError, RecursionError):
        return None
    return dict(data)


def _write_cached(path: Path, data: Mapping[str, Any]) -> None:
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        write_file_atomically(path, json.dumps(data, indent=2, sort_keys=True).encode())
    except OSError as error:
        raise cannot_write(str(path), error) from error
