"""Drafts of edits: what an edit asks for, and where everything would then be, each thing lowered onto what lies under it.

Five kinds, after what people ask of a layout: add, remove, replace, move, and restyle (all of a kind at once). A draft is a
wish: whether it stays and is clean is for others to find out.
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
"""Drafts of a kind, and places for a thing, that are looked at before giving up."""

_BESIDE = (0.02, 0.10)  # how far beside an anchor a thing is put, metres
_NARROWEST, _WIDEST = 0.5, 1.3  # of what replaces a thing, beside its longest side


@dataclass(frozen=True, slots=True)
class EditDraft:
    """What an edit would make of a scene.

    Attributes:
        things: Every thing that is then there, with its instance; None for new ones.
        changed: Instances that the edit may change.
        text: The words, as :func:`stable_data.instructions.wording.paraphrase.reword` takes them.
    """

    things: tuple[tuple[str | None, PlacedObject], ...]
    changed: frozenset[str]
    text: str


@dataclass(frozen=True, eq=False)
class SceneEditor:
    """A scene as an editor sees it.

    Attributes:
        scene: The scene.
        things: What it was made from, where it has settled, by instance.
        namer: Words for its objects.
        kit: Draws.
        carriers: Objects that something rests on.
    """

    scene: Scene
    things: Mapping[str, PlacedObject]
    namer: ObjectNamer
    kit: GroupSampler
    carriers: frozenset[str]

    def leaves(self) -> list[SceneObject]:
        """Objects that carry nothing and can be named, in any order."""
        objects = [o for o in self.scene.objects if o.instance not in self.carriers and self.namer.names(o.instance)]
        return [objects[k] for k in self.kit.rng.permutation(len(objects))]

    def standing(self) -> list[SceneObject]:
        """Objects on the table that can be named."""
        graph = self.namer.graph
        return [o for o in self.scene.objects if graph.nodes[o.instance]["support"] == TABLE and self.namer.names(o.instance)]

    def name(self, instance: str) -> str:
        """Words for an object."""
        names: Sequence[ObjectName] = self.namer.names(instance)
        return names[int(self.kit.rng.integers(len(names)))].words

    def ground(self, *without: str) -> TableOccupancy:
        """The table with everything on it but some."""
        ground = TableOccupancy(self.scene.table)
        for instance, thing in self.things.items():
            if instance not in without:
                ground.take(thing.item.outline())
        return ground

    def with_change(
        self, change: Mapping[str, PlacedObject | None], new: Sequence[PlacedObject] = ()
    ) -> tuple[tuple[str | None, PlacedObject], ...]:
        """Every thing, some of them changed (None: gone), new ones at the end."""
        kept = ((instance, change.get(instance, thing)) for instance, thing in self.things.items())
        return (*((instance, thing) for instance, thing in kept if thing is not None), *((None, thing) for thing in new))

    def drafts(self, kind: str) -> Iterator[EditDraft]:
        """Drafts of a kind, those that make a scene too empty or too full left out."""
        drafts = itertools.islice(DRAFTERS[kind](self), TRIES)
        return (draft for draft in drafts if FEWEST <= len(draft.things) <= MOST)


Drafter: TypeAlias = Callable[[SceneEditor], Iterator[EditDraft]]


def _removals(desk: SceneEditor) -> Iterator[EditDraft]:
    for o in desk.leaves():
        name = desk.name(o.instance)
        text = desk.kit.pick(f"[remove] {name}", f"[take|clear] away {name}", f"get rid of {name}", f"I do not need {name}.")
        yield EditDraft(desk.with_change({o.instance: None}), frozenset(), text)


def _additions(desk: SceneEditor) -> Iterator[EditDraft]:
    plan = plan_of(desk.scene.table.table_type)
    for _ in range(4 * TRIES):  # a full table has no place for anything
        group = plan.others[desk.kit.rng.integers(len(plan.others))](desk.kit)
        item = replace(group[0], x=0.0, y=0.0, yaw=desk.kit.around(0.4), tilt_quat_xyzw=asset(group[0].key).tilts[0])
        caption = _new(item.key, desk.kit)
        for there, where in _destinations(desk, item):
            wish = f"I [need|want] {caption} {where.replace('into', 'in')}."
            put = desk.kit.pick(f"[put] {caption} {where}", f"add {caption} {where}", wish)
            yield EditDraft(desk.with_change({}, [there]), frozenset(), put)
            break


def _moves(desk: SceneEditor) -> Iterator[EditDraft]:
    for o in desk.leaves():
        thing = desk.things[o.instance]
        item = replace(thing.item, x=0.0, y=0.0)
        if o.tilt_angle > 0.02:
            item = replace(item, tilt_quat_xyzw=asset(item.key).tilts[0])
        name = desk.name(o.instance)
        for there, where in _destinations(desk, item, o.instance):
            text = desk.kit.pick(f"[move] {name} {where}", f"[put] {name} {where}")
            yield EditDraft(desk.with_change({o.instance: replace(there, group=thing.group)}), frozenset({o.instance}), text)
            break


def _replacements(desk: SceneEditor) -> Iterator[EditDraft]:
    plan = plan_of(desk.scene.table.table_type)
    standing = {o.instance for o in desk.standing()}
    for o in desk.leaves():
        if o.instance not in standing:
            continue
        key = plan.others[desk.kit.rng.integers(len(plan.others))](desk.kit)[0].key
        item = GroupItem(key, o.position[0], o.position[1], o.yaw, asset(key).tilts[0], desk.kit.scale())
        ratio = max(item.size[:2]) / max(o.size[:2])
        if not _NARROWEST < ratio < _WIDEST or asset(key).category == o.category or not _has_room(desk, item, o.instance):
            continue
        new = _new(key, desk.kit)
        name = desk.name(o.instance)
        text = desk.kit.pick(f"[replace|swap] {name} with {new}", f"exchange {name} for {new}", f"[put] {new} where {name} is")
        there = lower_group([item], desk.things[o.instance].group)[0]
        yield EditDraft(desk.with_change({o.instance: there}), frozenset({o.instance}), text)


def _restylings(desk: SceneEditor) -> Iterator[EditDraft]:
    """All things of a category in another variant, each where it was, what they carry lowered onto them again."""
    kinds: dict[str, list[str]] = {}
    for o in desk.scene.objects:
        kinds.setdefault(o.category, []).append(o.instance)
    several = [category for category, instances in sorted(kinds.items()) if len(instances) > 1]
    for k in desk.kit.rng.permutation(len(several)):
        category = several[k]
        key = f"{category}/{desk.kit.rng.integers(NUM_VARIANTS)}"
        if all(desk.things[name].item.key == key for name in kinds[category]):
            continue
        change = _restyled(desk, frozenset(kinds[category]), key)
        if change is None:
            continue
        several_words, color = plural(" ".join(type_words(category))), asset(key).color_name
        style = f"{color} ones" if not color.startswith("#") else f"ones like this: {asset(key).captions[0]}"
        text = desk.kit.pick(
            f"replace all the {several_words} [with|by] {style}", f"I would like all the {several_words} to be {style}.",
            f"[exchange|swap] all {several_words} for {style}",
        )  # fmt: skip
        yield EditDraft(desk.with_change(change), frozenset(change), text)


DRAFTERS: Mapping[str, Drafter] = MappingProxyType(
    {"add": _additions, "remove": _removals, "replace": _replacements, "move": _moves, "restyle": _restylings}
)
"""What drafts each kind of edit."""

KINDS = tuple(DRAFTERS)
"""Kinds of edit."""


def _restyled(desk: SceneEditor, instances: frozenset[str], key: str) -> dict[str, PlacedObject] | None:
    """The groups of some things, laid again with these in another variant; None where one of them lies or leans."""
    groups = {desk.things[name].group for name in instances}
    upright = asset(key).tilts[0]
    change: dict[str, PlacedObject] = {}
    for group in sorted(groups):
        members = [(name, thing) for name, thing in desk.things.items() if thing.group == group]
        items = [replace(t.item, key=key, tilt_quat_xyzw=upright) if n in instances else t.item for n, t in members]
        if any(desk.scene[name].tilt_angle > 0.02 for name, _ in members):
            return None
        others = [thing.item.outline() for name, thing in desk.things.items() if thing.group != group]
        outline = shapely.union_all([item.outline() for item in items])
        if not desk.ground().allows(outline) or bool(shapely.dwithin(outline, others, 0.002).any()):
            return None
        change |= {name: thing for (name, _), thing in zip(members, lower_group(items, group), strict=True)}
    return change


def _has_room(desk: SceneEditor, item: GroupItem, instance: str) -> bool:
    return desk.ground(instance).is_free(item.outline())


def _destinations(desk: SceneEditor, item: GroupItem, moving: str | None = None) -> Iterator[tuple[PlacedObject, str]]:
    """Places for a thing, with words for them: beside a thing, in a corner, on top of or in another."""
    ways = (_beside, _in_a_corner, _onto)
    for k in desk.kit.rng.permutation(len(ways)):
        yield from ways[k](desk, item, moving)


def _beside(desk: SceneEditor, item: GroupItem, moving: str | None) -> Iterator[tuple[PlacedObject, str]]:
    sides = (("to the left of", -1, 0), ("to the right of", 1, 0), ("in front of", 0, -1), ("behind", 0, 1))
    anchors = [o for o in desk.standing() if o.instance != moving]
    ground = desk.ground(*([] if moving is None else [moving]))
    for _ in range(TRIES if anchors else 0):
        anchor = anchors[desk.kit.rng.integers(len(anchors))]
        words, along_x, along_y = sides[desk.kit.rng.integers(4)]
        x_min, y_min, x_max, y_max = desk.things[anchor.instance].item.outline().bounds
        width, depth = np.ptp(np.reshape(item.outline().bounds, (2, 2)), axis=0).tolist()
        gap = desk.kit.between(*_BESIDE)
        x = (x_min + x_max) / 2 + along_x * ((x_max - x_min + width) / 2 + gap) + desk.kit.around(0.01)
        y = (y_min + y_max) / 2 + along_y * ((y_max - y_min + depth) / 2 + gap) + desk.kit.around(0.01)
        there = replace(item, x=x, y=y)
        if ground.is_free(there.outline()):
            yield lower_group([there])[0], f"{words} {desk.name(anchor.instance)}"


def _in_a_corner(desk: SceneEditor, item: GroupItem, moving: str | None) -> Iterator[tuple[PlacedObject, str]]:
    width, depth = desk.scene.table.size_xy
    ground = desk.ground(*([] if moving is None else [moving]))
    for _ in range(TRIES):
        row, column = desk.kit.pick("front", "back"), desk.kit.pick("left", "right")
        x, y = (0.17 if column == "left" else 0.83) * width, (0.17 if row == "front" else 0.83) * depth
        there = replace(item, x=x + desk.kit.around(0.14 * width), y=y + desk.kit.around(0.14 * depth))
        if ground.is_free(there.outline()):
            yield lower_group([there])[0], f"into the {row} {column} corner"


def _onto(desk: SceneEditor, item: GroupItem, moving: str | None) -> Iterator[tuple[PlacedObject, str]]:
    """On top of, or in, a thing that stands upright and carries nothing yet."""
    graph = desk.namer.graph
    for o in desk.leaves():
        source = asset(desk.things[o.instance].item.key)
        space, words = (source.top, "on") if source.top is not None else (source.hollow, "in")
        held = any(graph.has_edge(o.instance, other, key=RelationKind.IN) for other in desk.things)
        if o.instance == moving or space is None or o.tilt_angle > 0.02 or held:
            continue
        carrier = desk.things[o.instance]
        inside = scatter(floor_of(carrier.item, space, 0.002), [item], desk.kit)
        if inside:
            pair = lower_group([carrier.item, inside[0]], carrier.group)
            lift = carrier.z - pair[0].z
            yield PlacedObject(inside[0], pair[1].z + lift, carrier.group), f"{words} {desk.name(o.instance)}"


def _new(key: str, kit: GroupSampler) -> str:
    """Words for a thing that is not there yet, with an article."""
    captions = asset(key).captions
    caption = kit.pick(captions[0], *(c for c in captions[1:] if "," not in c))
    first = caption.split()[0]
    if first in ("a", "an", "the", "some", "two", "three"):
        return caption
    return f"{'an' if first[0] in 'aeiou' else 'a'} {caption}"
