"""Compares a variant with its source: what differs on its axis, and what should have been kept but was not."""

import math
from collections import Counter
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, replace
from typing import TypeAlias

import numpy as np

from models.dual_system.generation_state import BegunScene, supports_of
from models.dual_system.variant_task import Axis
from stable_data.instructions.naming import ObjectMention, ObjectNamer, mentions
from stable_data.metrics.alignment import broken_relations, members
from stable_data.scene import Relation, Scene, SceneObject
from stable_data.scene_graph.relations import contacts_of, scene_graph
from stable_data.scene_graph.support_tree import SupportTree

SAME_PLACE, SAME_TURN = 1e-3, math.radians(0.5)
"""An object that must not move stays within these, metres and radians."""

OTHER_PLACE, OTHER_TURN = 1e-2, math.radians(5.0)
"""An object has another pose if it moved or turned by more, metres and radians."""

_SAME_TILT = math.radians(0.5)
_SAME_SIZE = 1e-6  # relative

ContainersOf: TypeAlias = Callable[[Scene], Mapping[str, bool | None]]
"""Returns whether the objects of a scene are containers, by instance; None or missing if unknown."""


def _unknown(_: Scene) -> Mapping[str, bool | None]:
    return {}


@dataclass(frozen=True, slots=True)
class Comparison:
    """How a variant differs from its source.

    Attributes:
        num_varied: Number of objects that differ on the axis; 0 for ``task``.
        is_varied: Whether anything differs on the axis.
        lost: What should be as in the source and is not, one text each.
        concerned: The instances that ``lost`` is about.
        concerned: The instances that ``lost`` is about.
    """

    num_varied: int
    is_varied: bool
    lost: tuple[str, ...] = ()
    concerned: frozenset[str] = frozenset()


def compare_variant(source: Scene, variant: Scene, axis: Axis, containers: ContainersOf = _unknown) -> Comparison:
    """Compares a variant with its source.

    On every axis the table, the surroundings, and, but for ``task``, the task info must be equal; the relations that it states and
    that hold in the source must hold, in ``layout`` all of them; and the names in the instruction must still name the same objects,
    such as ``the cup on the left``. In ``layout`` and ``assets`` each object must be on or in what it was on or in.

    Args:
        source: The source, with supports.
        variant: The variant, with supports.
        axis: The axis.
        containers: Which of the objects of a scene are containers.
    """
    lost: dict[str, tuple[str, ...]] = {}  # what is lost, and of which instances
    if (source.table, source.surroundings) != (variant.table, variant.surroundings):
        lost["the table or its surroundings"] = ()
    if axis is not Axis.TASK:
        lost |= _lost_of_task(source, variant, axis, containers)
    before, after = ({o.instance: o for o in scene.movable} for scene in (source, variant))
    if axis is Axis.CLUTTER:
        kept = kept_beside_clutter(source, containers)
        lost |= {f"{n} is not as it was": (n,) for n in kept if n not in after or not _is_same(before[n], after[n])}
        new = [o for name, o in after.items() if name not in kept]
        were = [o for name, o in before.items() if name not in kept]
        return _comparison(len(new), _things(new) != _things(were), lost)
    lost |= {f"{name} is missing": (name,) for name in before if name not in after}
    lost |= {f"{name} is new": (name,) for name in after if name not in before}
    pairs = [(before[name], after[name]) for name in before if name in after]
    if axis is not Axis.TASK:
        broken = _newly_broken(source, variant, supports_of(source).values(), containers)
        lost |= {f"{r} does not hold": members(r) for r in broken}
    if axis is Axis.ASSETS:
        others = [(b, a) for b, a in pairs if a.category != b.category]
        lost |= {f"{b.instance} is a {a.category}, not a {b.category}": (b.instance,) for b, a in others}
        changed = sum(a.asset_id != b.asset_id for b, a in pairs)
        return _comparison(changed, changed > 0, lost)
    lost |= {f"{b.instance} has another asset, size or tilt": (b.instance,) for b, a in pairs if not _is_same_thing(b, a)}
    if axis is Axis.TASK:
        moved = [b.instance for b, a in pairs if not _is_at(b, a, SAME_PLACE, SAME_TURN)]
        lost |= {f"{name} is not where it was": (name,) for name in moved}
        return _comparison(0, variant.task is not None and not _is_same_task(source, variant), lost)
    num_moved = sum(not _is_at(b, a, OTHER_PLACE, OTHER_TURN) for b, a in pairs)
    return _comparison(num_moved, num_moved > 0, lost)


def _comparison(num_varied: int, is_varied: bool, lost: Mapping[str, tuple[str, ...]]) -> Comparison:
    return Comparison(num_varied, is_varied, tuple(lost), frozenset(name for names in lost.values() for name in names))


def kept_beside_clutter(scene: Scene, containers: ContainersOf = _unknown) -> tuple[str, ...]:
    """Returns what stays if the clutter of a scene is exchanged, in the scene's order.

    These are the task objects, the objects from which and by which their names in the instruction distinguish them (the other cup for
    ``the cup on the left``), and what all of these rest on and carry.
    """
    namer = _namer(scene, containers)
    there = {o.instance for o in scene.movable}
    named = set(() if scene.task is None else scene.task.task_objects)
    for mention in _mentions(scene, namer):
        named |= {*namer.matching(mention.name.noun), *(() if mention.name.anchor is None else (mention.name.anchor,))}
    tree = SupportTree.of(scene.movable, scene.scene_id)
    kept = tree.with_descendants(named & there)
    kept |= {below for name in named & there for below in tree.ancestors(name)}
    return tuple(o.instance for o in scene.movable if o.instance in kept)


def without_clutter(scene: Scene, containers: ContainersOf = _unknown) -> BegunScene:
    """Returns a scene with its surroundings and what stays beside its clutter, and the nouns by which its instruction names objects."""
    kept = {*kept_beside_clutter(scene, containers), *scene.fixed}
    nouns = frozenset(mention.name.noun for mention in _mentions(scene, _namer(scene, containers)))
    return BegunScene(replace(scene, objects=tuple(o for o in scene.objects if o.instance in kept)), nouns)


def names_in(scene: Scene, containers: ContainersOf = _unknown) -> dict[tuple[int, int], str]:
    """Returns which object each name in the instruction of a scene names, by the first character of the name and the one after it.

    Only names that are true of one object alone are found, see :func:`stable_data.instructions.naming.mentions`.
    """
    return {(m.start, m.end): m.instance for m in _mentions(scene, _namer(scene, containers))}


def _namer(scene: Scene, containers: ContainersOf) -> ObjectNamer:
    return ObjectNamer(scene, scene_graph(scene, contacts_of(scene), containers=containers(scene)))


def _mentions(scene: Scene, namer: ObjectNamer) -> tuple[ObjectMention, ...]:
    return () if scene.task is None else mentions(scene.task.task, namer)


def _lost_of_task(source: Scene, variant: Scene, axis: Axis, containers: ContainersOf) -> dict[str, tuple[str, ...]]:
    """What is lost of the task, with the instances: its info, its relations, and its names."""
    task = source.task
    if variant.task != task:
        return {"the task info": ()}
    if task is None:
        return {}
    if axis is Axis.LAYOUT:
        broken = broken_relations(variant, task.relations, contacts=contacts_of(variant), containers=containers(variant))
    else:
        broken = _newly_broken(source, variant, task.relations, containers)
    named = names_in(variant, containers)
    other = {span: name for span, name in names_in(source, containers).items() if named.get(span) != name}
    return {f"{r} does not hold": members(r) for r in broken} | {
        f"{task.task[slice(*span)]!r} does not name {name}": _of_its_kind(source, name) for span, name in other.items()
    }


def _of_its_kind(scene: Scene, instance: str) -> tuple[str, ...]:
    """The objects from which a name distinguishes one, and this one."""
    return tuple(o.instance for o in scene.objects if o.category == scene[instance].category)


def _newly_broken(
    source: Scene, variant: Scene, relations: Iterable[Relation], containers: ContainersOf
) -> tuple[Relation, ...]:
    """The relations that hold in the source and not in the variant."""
    wanted = tuple(relations)
    were, are = (
        broken_relations(scene, wanted, contacts=contacts_of(scene), containers=containers(scene))
        for scene in (source, variant)
    )
    return tuple(r for r in are if r not in were)


def _is_same_task(source: Scene, variant: Scene) -> bool:
    """Whether two scenes have the same instruction."""
    tasks = [" ".join(scene.task.task.lower().split()) if scene.task is not None else None for scene in (source, variant)]
    return tasks[0] == tasks[1]


def _is_same(one: SceneObject, other: SceneObject) -> bool:
    return _is_same_thing(one, other) and _is_at(one, other, SAME_PLACE, SAME_TURN)


def _is_same_thing(one: SceneObject, other: SceneObject) -> bool:
    """Whether asset, size, scale and tilt of an object are the same; a scale of None is known only after it was resolved."""
    pairs = [(one.size, other.size)]
    if one.scale is not None and other.scale is not None:
        pairs.append((one.scale, other.scale))
    cosine = min(1.0, abs(float(np.dot(one.tilt_quat_xyzw, other.tilt_quat_xyzw))))
    return (
        (one.category, one.asset_id) == (other.category, other.asset_id)
        and all(np.allclose(a, b, rtol=_SAME_SIZE, atol=0) for a, b in pairs)
        and 2 * math.acos(cosine) <= _SAME_TILT
    )


def _is_at(one: SceneObject, other: SceneObject, distance: float, turn: float) -> bool:
    return math.dist(one.position, other.position) <= distance and abs(math.remainder(one.yaw - other.yaw, math.tau)) <= turn


def _things(objects: list[SceneObject]) -> Counter[tuple[str, str | None]]:
    return Counter((o.category, o.asset_id) for o in objects)
