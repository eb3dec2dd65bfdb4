"""Edits: a scene, an instruction and the edited scene; both scenes are clean and at rest.

Objects that an instruction does not mention keep their poses exactly.
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

_MAX_SHIFT = 1e-3  # an object that the edit does not mention may settle this far away and is then put back, metres


@dataclass(frozen=True, slots=True, eq=False)
class SceneEdit:
    """An edit of a scene.

    Attributes:
        kind: ``add``, ``remove``, ``replace``, ``move`` or ``restyle``.
        instruction: The instruction.
        before: The scene before the edit.
        after: The scene after the edit; an instance in both scenes is the same object.
        added: Instances only in ``after``.
        removed: Instances only in ``before``.
        moved: Instances whose pose or asset differs.
        placed: The placed objects of ``after``, in its order.
    """

    kind: str
    instruction: str
    before: Scene
    after: Scene
    added: tuple[str, ...]
    removed: tuple[str, ...]
    moved: tuple[str, ...]
    placed: tuple[PlacedObject, ...]


def make_edit(embedded: EmbeddedScene, rng: np.random.Generator, kinds: Sequence[str] = ()) -> SceneEdit | None:
    """Makes an edit of a scene.

    Args:
        embedded: The scene.
        rng: The random choices.
        kinds: The kinds to try, in this order; all kinds in random order if empty.

    Returns:
        The edit; None if no draft of these kinds came to rest clean.
    """
    scene_audit = audit(embedded.scene, embedded.placed)
    graph = graph_of(embedded.scene, scene_audit, embedded.placed)
    carriers = frozenset(name for o in scene_audit.objects for name in o.supports)
    settled = {o.instance: place_as_settled(obj, o) for o, obj in zip(embedded.scene.objects, embedded.placed, strict=True)}
    editor = SceneEditor(embedded.scene, settled, ObjectNamer(embedded.scene, graph), GroupSampler(rng), carriers)
    for kind in kinds or [KINDS[k] for k in rng.permutation(len(KINDS))]:
        for draft in editor.drafts(kind):
            edit = _execute_draft(kind, draft, editor)
            if edit is not None:
                return edit
    return None


def place_as_settled(obj: PlacedObject, o: SceneObject) -> PlacedObject:
    """Returns a placed object at its settled pose."""
    x, y, z = o.position
    return PlacedObject(replace(obj.item, x=x, y=y, yaw=o.yaw, tilt_quat_xyzw=o.tilt_quat_xyzw), z, obj.group)


def _execute_draft(kind: str, draft: EditDraft, editor: SceneEditor) -> SceneEdit | None:
    """Settles a draft; None unless the result is clean, at rest and changes only what the draft may change."""
    before, placed = editor.scene, [obj for _, obj in draft.placed]
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
        source={RECORD: {"keys": [obj.item.key for obj in placed]}},
    )
    if unclean_objects(audit(after, placed)) or unsteady_objects(after, placed):
        return None
    old, new = {o.instance for o in before.objects}, {o.instance for o in objects}
    moved = tuple(o.instance for o in objects if o.instance in old and o != before[o.instance])
    text = phrase_edit(draft, editor.kit.rng)
    return SceneEdit(kind, text, before, after, tuple(sorted(new - old)), tuple(sorted(old - new)), moved, tuple(placed))


def phrase_edit(draft: EditDraft, rng: np.random.Generator) -> str:
    """Phrases a draft as a request."""
    return request(reword(draft.text, rng), "", rng)


def edited_objects(before: Scene, draft: EditDraft, settled: Sequence[SceneObject]) -> tuple[SceneObject, ...] | None:
    """Names the objects of an edited scene; an object of another category than before receives a new name.

    Args:
        before: The scene before the edit.
        draft: The edit.
        settled: The settled objects of the draft, under any names.

    Returns:
        The objects, those that the edit does not change as they are in ``before``; None if the edit displaces such an object.
    """
    numbers = _numbers(before)
    objects: list[SceneObject] = []
    for (instance, _), o in zip(draft.placed, settled, strict=True):
        # A new object, or another one in its place.
        if instance is None or before[instance].category != o.category:
            objects.append(replace(o, instance=next(numbers).format(o.category, _count(objects, before, o.category))))
        # The simulation moves every object slightly: an unmentioned one receives its former pose.
        elif _is_unchanged(o, before[instance]):
            objects.append(before[instance])
        elif instance in draft.changed:
            objects.append(replace(o, instance=instance))
        else:
            return None
    return tuple(objects)


def _is_unchanged(o: SceneObject, old: SceneObject) -> bool:
    return o.asset_id == old.asset_id and bool(np.linalg.norm(np.subtract(o.position, old.position)) <= _MAX_SHIFT)


def _numbers(scene: Scene) -> Iterator[str]:
    """Patterns of new instance names, numbered from the first number that the scene does not use."""
    used = [int(o.instance.split("_")[0]) for o in scene.objects]
    first = max(used, default=0) + 1
    return (f"{first + k}_{{}}_{{}}" for k in range(MOST + 1))


def _count(objects: Sequence[SceneObject], scene: Scene, category: str) -> int:
    """The number of the next object of a category."""
    names = {o.instance for o in (*objects, *scene.objects) if o.category == category}
    return max((int(name.rsplit("_", 1)[1]) + 1 for name in names), default=0)
