"""Edits: a scene, an instruction that changes it, and the scene as it then is; clean and at rest before and after.

What an edit does not speak of keeps its pose to the last digit.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np

from stable_data.embedded_world.drafting import KINDS, EditDraft, SceneEditor
from stable_data.embedded_world.groups.arrangement import GroupSampler
from stable_data.embedded_world.placing import PlacedObject
from stable_data.embedded_world.scenes import MOST, RECORD, EmbeddedScene, graph_of
from stable_data.embedded_world.settling import audit, settle_objects, unclean_objects, unsteady_objects
from stable_data.instructions.naming import ObjectNamer
from stable_data.instructions.wording.paraphrase import request, reword
from stable_data.scene import Scene, SceneObject

_KEPT = 1e-3  # what an edit does not speak of settles no farther than this from where it was, metres; it is then put back


@dataclass(frozen=True, slots=True, eq=False)
class SceneEdit:
    """A change of a scene.

    Attributes:
        kind: ``add``, ``remove``, ``replace``, ``move`` or ``restyle``.
        instruction: What is asked for.
        before: The scene as it was.
        after: The scene as it is then; instances that both have are the same things.
        added: Instances that are new.
        removed: Instances that are gone.
        moved: Instances whose place, or shape, is another.
        placed: The things of ``after``, in its order.
    """

    kind: str
    instruction: str
    before: Scene
    after: Scene
    added: tuple[str, ...]
    removed: tuple[str, ...]
    moved: tuple[str, ...]
    placed: tuple[PlacedObject, ...]


def make_edit(made: EmbeddedScene, rng: np.random.Generator, kinds: Sequence[str] = ()) -> SceneEdit | None:
    """An edit of a scene.

    Args:
        made: The scene.
        rng: Draws.
        kinds: Which kinds may be tried, in this order; any where empty, in any order.

    Returns:
        The edit; None where no draft of the kinds tried came to rest clean.
    """
    judged = audit(made.scene, made.placed)
    graph = graph_of(made.scene, judged, made.placed)
    carriers = frozenset(name for o in judged.objects for name in o.supports)
    settled = {o.instance: place_as_settled(thing, o) for o, thing in zip(made.scene.objects, made.placed, strict=True)}
    desk = SceneEditor(made.scene, settled, ObjectNamer(made.scene, graph), GroupSampler(rng), carriers)
    for kind in kinds or [KINDS[k] for k in rng.permutation(len(KINDS))]:
        for draft in desk.drafts(kind):
            edit = _carried_out(kind, draft, desk)
            if edit is not None:
                return edit
    return None


def place_as_settled(thing: PlacedObject, o: SceneObject) -> PlacedObject:
    """A thing where it has come to lie."""
    x, y, z = o.position
    return PlacedObject(replace(thing.item, x=x, y=y, yaw=o.yaw, tilt_quat_xyzw=o.tilt_quat_xyzw), z, thing.group)


def _carried_out(kind: str, draft: EditDraft, desk: SceneEditor) -> SceneEdit | None:
    """The edit, where what it makes stays, is clean, and leaves alone what it does not speak of."""
    before, placed = desk.scene, [thing for _, thing in draft.things]
    settled = settle_objects(placed, before.table)
    if settled is None or settled[1]:
        return None
    objects = edited_objects(before, draft, settled[0])
    if objects is None:
        return None
    after = replace(
        before,
        scene_id=f"{before.scene_id}_{kind}",
        objects=objects,
        task=None,
        source={RECORD: {"keys": [thing.item.key for thing in placed]}},
    )
    if unclean_objects(audit(after, placed)) or unsteady_objects(after, placed):
        return None
    old, new = {o.instance for o in before.objects}, {o.instance for o in objects}
    moved = tuple(o.instance for o in objects if o.instance in old and o != before[o.instance])
    text = phrase_edit(draft, desk.kit.rng)
    return SceneEdit(kind, text, before, after, tuple(sorted(new - old)), tuple(sorted(old - new)), moved, tuple(placed))


def phrase_edit(draft: EditDraft, rng: np.random.Generator) -> str:
    """The words of a draft as a request."""
    return request(reword(draft.text, rng), "", rng)


def edited_objects(before: Scene, draft: EditDraft, found: Sequence[SceneObject]) -> tuple[SceneObject, ...] | None:
    """The objects of an edited scene under their names; what is another thing than before has another name.

    Args:
        before: The scene as it was.
        draft: The edit.
        found: Its things as objects of any names, where they came to lie.

    Returns:
        The objects, those that stay as they were in the scene; None where one is elsewhere that the edit does not speak of.
    """
    numbers = _numbers(before)
    objects: list[SceneObject] = []
    for (instance, _), o in zip(draft.things, found, strict=True):
        if instance is None or before[instance].category != o.category:
            objects.append(replace(o, instance=next(numbers).format(o.category, _count(objects, before, o.category))))
        elif _is_kept(o, before[instance]):
            objects.append(before[instance])
        elif instance in draft.changed:
            objects.append(replace(o, instance=instance))
        else:
            return None
    return tuple(objects)


def _is_kept(o: SceneObject, was: SceneObject) -> bool:
    return o.asset_id == was.asset_id and bool(np.linalg.norm(np.subtract(o.position, was.position)) <= _KEPT)


def _numbers(scene: Scene) -> Iterator[str]:
    """Forms of further instance names, running numbers that the scene does not use."""
    used = [int(o.instance.split("_")[0]) for o in scene.objects]
    first = max(used, default=0) + 1
    return (f"{first + k}_{{}}_{{}}" for k in range(MOST + 1))


def _count(objects: Sequence[SceneObject], scene: Scene, category: str) -> int:
    """The number of a further object of a category."""
    names = {o.instance for o in (*objects, *scene.objects) if o.category == category}
    return max((int(name.rsplit("_", 1)[1]) + 1 for name in names), default=0)
