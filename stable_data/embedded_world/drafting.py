"""Drafts of edits: the instruction, and where each object is afterwards, lowered onto its support.

There are five kinds, after what people ask for: add, remove, replace, move, and restyle (all objects of one category at once).
A draft is not checked: the caller decides whether its objects stay at rest and are clean.
"""

import itertools
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from types import MappingProxyType
from typing import TypeAlias

import numpy as np
import shapely

from stable_data.embedded_world.families.catalogue import NUM_VARIANTS, asset
from stable_data.embedded_world.groups.arrangement import GroupItem, GroupSampler, floor_of, scatter
from stable_data.embedded_world.placing import PlacedObject, TableOccupancy, lower_group
from stable_data.embedded_world.scenes import FEWEST, MOST, plan_of
from stable_data.instructions.naming import ObjectName, ObjectNamer
from stable_data.instructions.wording.words import plural, type_words
from stable_data.scene import TABLE, RelationKind, Scene, SceneObject

TRIES = 12
"""Attempts at a draft of one kind, and at a place for one item."""

_BESIDE = (0.02, 0.10)  # gap between an item and the object beside it, metres
_NARROWEST, _WIDEST = 0.5, 1.3  # longest side of a replacement over that of the replaced object


@dataclass(frozen=True, slots=True)
class EditDraft:
    """One proposed edit of a scene.

    Attributes:
        placed: All objects after the edit, each with its instance; None for new objects.
        changed: Instances that the edit may change.
        text: The instruction, in the form that :func:`stable_data.instructions.wording.paraphrase.reword` accepts.
    """

    placed: tuple[tuple[str | None, PlacedObject], ...]
    changed: frozenset[str]
    text: str


@dataclass(frozen=True, eq=False)
class SceneEditor:
    """The state that edits of one scene are drafted from.

    Attributes:
        scene: The scene.
        placed: The placed object of each instance, at its settled pose.
        namer: Names the objects of the scene in words.
        kit: The random choices.
        carriers: Instances that support another object.
    """

    scene: Scene
    placed: Mapping[str, PlacedObject]
    namer: ObjectNamer
    kit: GroupSampler
    carriers: frozenset[str]

    def leaves(self) -> list[SceneObject]:
        """Objects that support nothing and can be named, in random order."""
        objects = [o for o in self.scene.objects if o.instance not in self.carriers and self.namer.names(o.instance)]
        return [objects[k] for k in self.kit.rng.permutation(len(objects))]

    def standing(self) -> list[SceneObject]:
        """Objects that stand on the table and can be named."""
        graph = self.namer.graph
        return [o for o in self.scene.objects if graph.nodes[o.instance]["support"] == TABLE and self.namer.names(o.instance)]

    def name(self, instance: str) -> str:
        """Chooses a name of an object in words."""
        names: Sequence[ObjectName] = self.namer.names(instance)
        return names[int(self.kit.rng.integers(len(names)))].words

    def occupancy(self, *without: str) -> TableOccupancy:
        """The occupied areas of the table, without some instances."""
        occupancy = TableOccupancy(self.scene.table)
        for instance, obj in self.placed.items():
            if instance not in without:
                occupancy.reserve(obj.item.outline())
        return occupancy

    def with_change(
        self, change: Mapping[str, PlacedObject | None], new: Sequence[PlacedObject] = ()
    ) -> tuple[tuple[str | None, PlacedObject], ...]:
        """All objects after a change, new objects last; None in ``change`` removes an object."""
        pairs = ((instance, change.get(instance, obj)) for instance, obj in self.placed.items())
        return (*((instance, obj) for instance, obj in pairs if obj is not None), *((None, obj) for obj in new))

    def drafts(self, kind: str) -> Iterator[EditDraft]:
        """Yields drafts of one kind, without those that leave too few or too many objects."""
        drafts = itertools.islice(DRAFTERS[kind](self), TRIES)
        return (draft for draft in drafts if FEWEST <= len(draft.placed) <= MOST)


Drafter: TypeAlias = Callable[[SceneEditor], Iterator[EditDraft]]


def _removals(editor: SceneEditor) -> Iterator[EditDraft]:
    for o in editor.leaves():
        name = editor.name(o.instance)
        text = editor.kit.pick(f"[remove] {name}", f"[take|clear] away {name}", f"get rid of {name}", f"I do not need {name}.")
        yield EditDraft(editor.with_change({o.instance: None}), frozenset(), text)


def _additions(editor: SceneEditor) -> Iterator[EditDraft]:
    plan = plan_of(editor.scene.table.table_type)
    for _ in range(4 * TRIES):  # most attempts fail on a full table
        group = plan.others[editor.kit.rng.integers(len(plan.others))](editor.kit)
        # The first item of a group carries the others; it is added alone.
        item = replace(group[0], x=0.0, y=0.0, yaw=editor.kit.around(0.4), tilt_quat_xyzw=asset(group[0].key).tilts[0])
        caption = _words_for_new(item.key, editor.kit)
        for target, where in _destinations(editor, item):
            wish = f"I [need|want] {caption} {where.replace('into', 'in')}."
            put = editor.kit.pick(f"[put] {caption} {where}", f"add {caption} {where}", wish)
            yield EditDraft(editor.with_change({}, [target]), frozenset(), put)
            break


def _moves(editor: SceneEditor) -> Iterator[EditDraft]:
    for o in editor.leaves():
        obj = editor.placed[o.instance]
        item = replace(obj.item, x=0.0, y=0.0)
        # A leaning or lying object is put down in its usual tilt.
        if o.tilt_angle > 0.02:
            item = replace(item, tilt_quat_xyzw=asset(item.key).tilts[0])
        name = editor.name(o.instance)
        for target, where in _destinations(editor, item, o.instance):
            text = editor.kit.pick(f"[move] {name} {where}", f"[put] {name} {where}")
            yield EditDraft(editor.with_change({o.instance: replace(target, group=obj.group)}), frozenset({o.instance}), text)
            break


def _replacements(editor: SceneEditor) -> Iterator[EditDraft]:
    plan = plan_of(editor.scene.table.table_type)
    standing = {o.instance for o in editor.standing()}
    for o in editor.leaves():
        if o.instance not in standing:
            continue
        key = plan.others[editor.kit.rng.integers(len(plan.others))](editor.kit)[0].key
        item = GroupItem(key, o.position[0], o.position[1], o.yaw, asset(key).tilts[0], editor.kit.scale())
        ratio = max(item.size[:2]) / max(o.size[:2])
        if (
            not _NARROWEST < ratio < _WIDEST
            or asset(key).category == o.category
            or not editor.occupancy(o.instance).is_free(item.outline())
        ):
            continue
        new = _words_for_new(key, editor.kit)
        name = editor.name(o.instance)
        text = editor.kit.pick(
            f"[replace|swap] {name} with {new}", f"exchange {name} for {new}", f"[put] {new} where {name} is"
        )
        target = lower_group([item], editor.placed[o.instance].group)[0]
        yield EditDraft(editor.with_change({o.instance: target}), frozenset({o.instance}), text)


def _restylings(editor: SceneEditor) -> Iterator[EditDraft]:
    """Replaces all objects of a category by another variant at the same place and lowers what they support again."""
    kinds: dict[str, list[str]] = {}
    for o in editor.scene.objects:
        kinds.setdefault(o.category, []).append(o.instance)
    several = [category for category, instances in sorted(kinds.items()) if len(instances) > 1]
    for k in editor.kit.rng.permutation(len(several)):
        category = several[k]
        key = f"{category}/{editor.kit.rng.integers(NUM_VARIANTS)}"
        if all(editor.placed[name].item.key == key for name in kinds[category]):
            continue
        change = _restyle_groups(editor, frozenset(kinds[category]), key)
        if change is None:
            continue
        several_words, color = plural(" ".join(type_words(category))), asset(key).color_name
        style = f"{color} ones" if not color.startswith("#") else f"ones like this: {asset(key).captions[0]}"
        text = editor.kit.pick(
            f"replace all the {several_words} [with|by] {style}", f"I would like all the {several_words} to be {style}.",
            f"[exchange|swap] all {several_words} for {style}",
        )  # fmt: skip
        yield EditDraft(editor.with_change(change), frozenset(change), text)


DRAFTERS: Mapping[str, Drafter] = MappingProxyType(
    {"add": _additions, "remove": _removals, "replace": _replacements, "move": _moves, "restyle": _restylings}
)
"""The function that drafts each kind of edit."""

KINDS = tuple(DRAFTERS)
"""Kinds of edit."""


def kinds_in_turn(number: int) -> tuple[str, ...]:
    """All kinds of edit in the order in which they are tried; ``number`` selects the first."""
    first = number % len(KINDS)
    return (*KINDS[first:], *KINDS[:first])


def _restyle_groups(editor: SceneEditor, instances: frozenset[str], key: str) -> dict[str, PlacedObject] | None:
    """Lowers the groups of some instances again with another variant; None if an object of these groups is tilted."""
    groups = {editor.placed[name].group for name in instances}
    upright = asset(key).tilts[0]
    change: dict[str, PlacedObject] = {}
    for group in sorted(groups):
        members = [(name, obj) for name, obj in editor.placed.items() if obj.group == group]
        items = [replace(t.item, key=key, tilt_quat_xyzw=upright) if n in instances else t.item for n, t in members]
        # A tilted object leans on its group and would fall with another variant.
        if any(editor.scene[name].tilt_angle > 0.02 for name, _ in members):
            return None
        others = [obj.item.outline() for name, obj in editor.placed.items() if obj.group != group]
        outline = shapely.union_all([item.outline() for item in items])
        if not editor.occupancy().allows(outline) or bool(shapely.dwithin(outline, others, 0.002).any()):
            return None
        change |= {name: obj for (name, _), obj in zip(members, lower_group(items, group), strict=True)}
    return change


def _destinations(editor: SceneEditor, item: GroupItem, moving: str | None = None) -> Iterator[tuple[PlacedObject, str]]:
    """Places for an item, each with words for it: beside an object, in a corner of the table, on or in an object."""
    ways = (_beside, _in_a_corner, _onto)
    for k in editor.kit.rng.permutation(len(ways)):
        yield from ways[k](editor, item, moving)


def _beside(editor: SceneEditor, item: GroupItem, moving: str | None) -> Iterator[tuple[PlacedObject, str]]:
    sides = (("to the left of", -1, 0), ("to the right of", 1, 0), ("in front of", 0, -1), ("behind", 0, 1))
    anchors = [o for o in editor.standing() if o.instance != moving]
    occupancy = editor.occupancy(*([] if moving is None else [moving]))
    for _ in range(TRIES if anchors else 0):
        anchor = anchors[editor.kit.rng.integers(len(anchors))]
        words, along_x, along_y = sides[editor.kit.rng.integers(4)]
        x_min, y_min, x_max, y_max = editor.placed[anchor.instance].item.outline().bounds
        width, depth = np.ptp(np.reshape(item.outline().bounds, (2, 2)), axis=0).tolist()
        gap = editor.kit.between(*_BESIDE)
        x = (x_min + x_max) / 2 + along_x * ((x_max - x_min + width) / 2 + gap) + editor.kit.around(0.01)
        y = (y_min + y_max) / 2 + along_y * ((y_max - y_min + depth) / 2 + gap) + editor.kit.around(0.01)
        target = replace(item, x=x, y=y)
        if occupancy.is_free(target.outline()):
            yield lower_group([target])[0], f"{words} {editor.name(anchor.instance)}"


def _in_a_corner(editor: SceneEditor, item: GroupItem, moving: str | None) -> Iterator[tuple[PlacedObject, str]]:
    width, depth = editor.scene.table.size_xy
    occupancy = editor.occupancy(*([] if moving is None else [moving]))
    for _ in range(TRIES):
        row, column = editor.kit.pick("front", "back"), editor.kit.pick("left", "right")
        x, y = (0.17 if column == "left" else 0.83) * width, (0.17 if row == "front" else 0.83) * depth
        target = replace(item, x=x + editor.kit.around(0.14 * width), y=y + editor.kit.around(0.14 * depth))
        if occupancy.is_free(target.outline()):
            yield lower_group([target])[0], f"into the {row} {column} corner"


def _onto(editor: SceneEditor, item: GroupItem, moving: str | None) -> Iterator[tuple[PlacedObject, str]]:
    """On or in an upright object that supports nothing and is in no container."""
    graph = editor.namer.graph
    for o in editor.leaves():
        source = asset(editor.placed[o.instance].item.key)
        space, words = (source.top, "on") if source.top is not None else (source.hollow, "in")
        is_contained = any(graph.has_edge(o.instance, other, key=RelationKind.IN) for other in editor.placed)
        if o.instance == moving or space is None or o.tilt_angle > 0.02 or is_contained:
            continue
        carrier = editor.placed[o.instance]
        inside = scatter(floor_of(carrier.item, space, 0.002), [item], editor.kit)
        if inside:
            # The pair is lowered as if the carrier stood on the table; the lift restores its height.
            pair = lower_group([carrier.item, inside[0]], carrier.group)
            lift = carrier.z - pair[0].z
            yield PlacedObject(inside[0], pair[1].z + lift, carrier.group), f"{words} {editor.name(o.instance)}"


def _words_for_new(key: str, kit: GroupSampler) -> str:
    """A caption of a new asset, with an article."""
    captions = asset(key).captions
    caption = kit.pick(captions[0], *(c for c in captions[1:] if "," not in c))
    first = caption.split()[0]
    if first in ("a", "an", "the", "some", "two", "three"):
        return caption
    return f"{'an' if first[0] in 'aeiou' else 'a'} {caption}"
