"""Edits: a scene, an instruction that changes it, and the scene as it then is; clean and at rest before and after.

Five kinds, after what people ask of a layout: add, remove, replace, move, and restyle (all of a kind at once). What an edit does
not speak of keeps its pose to the last digit.
"""

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from types import MappingProxyType
from typing import TypeAlias

import numpy as np
import shapely

from stable_data.instructions.naming import Name, Namer
from stable_data.instructions.paraphrase import request, reword
from stable_data.instructions.words import plural, type_words
from stable_data.scene import TABLE, RelationKind, Scene, SceneObject
from stable_data.synth.arrangement import Item, Kit, floor_of, scattered
from stable_data.synth.catalogue import NUM_VARIANTS, asset
from stable_data.synth.placing import Ground, Placed, lowered
from stable_data.synth.scenes import FEWEST, MOST, RECORD, MadeScene, graph_of, plan_of
from stable_data.synth.settling import audit, restless, settled_objects, unclean

_TRIES = 12
_KEPT = 1e-3  # what an edit does not speak of settles no farther than this from where it was, metres; it is then put back
_BESIDE = (0.02, 0.10)  # how far beside an anchor a thing is put, metres
_NARROWEST, _WIDEST = 0.5, 1.3  # of what replaces a thing, beside its longest side


@dataclass(frozen=True, slots=True, eq=False)
class Edit:
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
    placed: tuple[Placed, ...]


@dataclass(frozen=True, slots=True)
class _Draft:
    """What an edit would make of a scene: every thing with its instance, None for new ones, and the words."""

    things: tuple[tuple[str | None, Placed], ...]
    changed: frozenset[str]
    text: str


@dataclass(frozen=True, eq=False)
class _Desk:
    """A scene as an editor sees it.

    Attributes:
        made: The scene.
        things: What it was made from, where it has settled, by instance.
        namer: Words for its objects.
        kit: Draws.
        carriers: Objects that something rests on.
    """

    made: MadeScene
    things: Mapping[str, Placed]
    namer: Namer
    kit: Kit
    carriers: frozenset[str]

    def leaves(self) -> list[SceneObject]:
        """Objects that carry nothing and can be named, in any order."""
        objects = [o for o in self.made.scene.objects if o.instance not in self.carriers and self.namer.names(o.instance)]
        return [objects[k] for k in self.kit.rng.permutation(len(objects))]

    def standing(self) -> list[SceneObject]:
        """Objects on the table that can be named."""
        graph = self.namer.graph
        return [
            o for o in self.made.scene.objects if graph.nodes[o.instance]["support"] == TABLE and self.namer.names(o.instance)
        ]

    def name(self, instance: str) -> str:
        """Words for an object."""
        names: Sequence[Name] = self.namer.names(instance)
        return names[int(self.kit.rng.integers(len(names)))].words

    def ground(self, *without: str) -> Ground:
        """The table with everything on it but some."""
        ground = Ground(self.made.scene.table)
        for instance, thing in self.things.items():
            if instance not in without:
                ground.take(thing.item.outline())
        return ground

    def with_change(
        self, change: Mapping[str, Placed | None], new: Sequence[Placed] = ()
    ) -> tuple[tuple[str | None, Placed], ...]:
        """Every thing, some of them changed (None: gone), new ones at the end."""
        kept = ((instance, change.get(instance, thing)) for instance, thing in self.things.items())
        return (*((instance, thing) for instance, thing in kept if thing is not None), *((None, thing) for thing in new))


_Drafter: TypeAlias = Callable[[_Desk], Iterator[_Draft]]


def make_edit(made: MadeScene, rng: np.random.Generator, kinds: Sequence[str] = ()) -> Edit | None:
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
    settled = {o.instance: _settled(thing, o) for o, thing in zip(made.scene.objects, made.placed, strict=True)}
    desk = _Desk(made, settled, Namer(made.scene, graph), Kit(rng), carriers)
    for kind in kinds or [tuple(_DRAFTERS)[k] for k in rng.permutation(len(_DRAFTERS))]:
        for _, draft in zip(range(_TRIES), _DRAFTERS[kind](desk), strict=False):
            edit = _carried_out(kind, draft, desk)
            if edit is not None:
                return edit
    return None


def _settled(thing: Placed, o: SceneObject) -> Placed:
    x, y, z = o.position
    return Placed(replace(thing.item, x=x, y=y, yaw=o.yaw, tilt_quat_xyzw=o.tilt_quat_xyzw), z, thing.group)


def _carried_out(kind: str, draft: _Draft, desk: _Desk) -> Edit | None:
    """The edit, where what it makes stays, is clean, and leaves alone what it does not speak of."""
    before, placed = desk.made.scene, [thing for _, thing in draft.things]
    if not FEWEST <= len(placed) <= MOST:
        return None
    settled = settled_objects(placed, before.table)
    if settled is None or settled[1]:
        return None
    numbers = _numbers(before)
    objects: list[SceneObject] = []
    for (instance, _), o in zip(draft.things, settled[0], strict=True):
        if instance is None or before[instance].category != o.category:
            objects.append(replace(o, instance=next(numbers).format(o.category, _count(objects, before, o.category))))
        elif _is_kept(o, before[instance]):
            objects.append(before[instance])
        elif instance in draft.changed:
            objects.append(replace(o, instance=instance))
        else:
            return None
    after = replace(
        before,
        scene_id=f"{before.scene_id}_{kind}",
        objects=tuple(objects),
        task=None,
        source={RECORD: {"keys": [thing.item.key for thing in placed]}},
    )
    if unclean(audit(after, placed)) or restless(after, placed):
        return None
    old, new = {o.instance for o in before.objects}, {o.instance for o in objects}
    text = request(reword(draft.text, desk.kit.rng), "", desk.kit.rng)
    moved = tuple(o.instance for o in objects if o.instance in old and o != before[o.instance])
    return Edit(kind, text, before, after, tuple(sorted(new - old)), tuple(sorted(old - new)), moved, tuple(placed))


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


# --- the kinds ----------------------------------------------------------------------------------------------------------------


def _removals(desk: _Desk) -> Iterator[_Draft]:
    for o in desk.leaves():
        name = desk.name(o.instance)
        text = desk.kit.pick(f"[remove] {name}", f"[take|clear] away {name}", f"get rid of {name}", f"I do not need {name}.")
        yield _Draft(desk.with_change({o.instance: None}), frozenset(), text)


def _additions(desk: _Desk) -> Iterator[_Draft]:
    plan = plan_of(desk.made.scene.table.table_type)
    while True:
        group = plan.others[desk.kit.rng.integers(len(plan.others))](desk.kit)
        item = replace(group[0], x=0.0, y=0.0, yaw=desk.kit.around(0.4), tilt_quat_xyzw=asset(group[0].key).design.tilts[0])
        caption = _new(item.key, desk.kit)
        for there, where in _destinations(desk, item):
            put = desk.kit.pick(f"[put] {caption} {where}", f"add {caption} {where}", f"I [need|want] {caption} {where}.")
            yield _Draft(desk.with_change({}, [there]), frozenset(), put)
            break


def _moves(desk: _Desk) -> Iterator[_Draft]:
    for o in desk.leaves():
        thing = desk.things[o.instance]
        item = replace(thing.item, x=0.0, y=0.0)
        if o.tilt_angle > 0.02:
            item = replace(item, tilt_quat_xyzw=asset(item.key).design.tilts[0])
        name = desk.name(o.instance)
        for there, where in _destinations(desk, item, o.instance):
            text = desk.kit.pick(f"[move] {name} {where}", f"[put] {name} {where}")
            yield _Draft(desk.with_change({o.instance: replace(there, group=thing.group)}), frozenset({o.instance}), text)
            break


def _replacements(desk: _Desk) -> Iterator[_Draft]:
    plan = plan_of(desk.made.scene.table.table_type)
    standing = {o.instance for o in desk.standing()}
    for o in desk.leaves():
        if o.instance not in standing:
            continue
        key = plan.others[desk.kit.rng.integers(len(plan.others))](desk.kit)[0].key
        item = Item(key, o.position[0], o.position[1], o.yaw, asset(key).design.tilts[0], desk.kit.scale())
        ratio = max(item.size[:2]) / max(o.size[:2])
        if not _NARROWEST < ratio < _WIDEST or asset(key).category == o.category or not _has_room(desk, item, o.instance):
            continue
        new = _new(key, desk.kit)
        name = desk.name(o.instance)
        text = desk.kit.pick(f"[replace|swap] {name} with {new}", f"exchange {name} for {new}", f"[put] {new} where {name} is")
        there = lowered([item], desk.things[o.instance].group)[0]
        yield _Draft(desk.with_change({o.instance: there}), frozenset({o.instance}), text)


def _restylings(desk: _Desk) -> Iterator[_Draft]:
    """All things of a category in another variant, each where it was, what they carry lowered onto them again."""
    kinds: dict[str, list[str]] = {}
    for o in desk.made.scene.objects:
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
        several_words, color = plural(" ".join(type_words(category))), asset(key).design.color
        style = f"{color} ones" if not color.startswith("#") else f"ones like this: {asset(key).design.captions[0]}"
        text = desk.kit.pick(
            f"replace all the {several_words} [with|by] {style}", f"I would like all the {several_words} to be {style}.",
            f"[exchange|swap] all {several_words} for {style}",
        )  # fmt: skip
        yield _Draft(desk.with_change(change), frozenset(change), text)


_DRAFTERS: Mapping[str, _Drafter] = MappingProxyType(
    {"add": _additions, "remove": _removals, "replace": _replacements, "move": _moves, "restyle": _restylings}
)

KINDS = tuple(_DRAFTERS)
"""Kinds of edit."""


def _restyled(desk: _Desk, instances: frozenset[str], key: str) -> dict[str, Placed] | None:
    """The groups of some things, laid again with these in another variant; None where one of them lies or leans."""
    groups = {desk.things[name].group for name in instances}
    upright = asset(key).design.tilts[0]
    change: dict[str, Placed] = {}
    for group in sorted(groups):
        members = [(name, thing) for name, thing in desk.things.items() if thing.group == group]
        items = [replace(t.item, key=key, tilt_quat_xyzw=upright) if n in instances else t.item for n, t in members]
        if any(desk.made.scene[name].tilt_angle > 0.02 for name, _ in members):
            return None
        others = [thing.item.outline() for name, thing in desk.things.items() if thing.group != group]
        outline = shapely.union_all([item.outline() for item in items])
        if not desk.ground().allows(outline) or bool(shapely.dwithin(outline, others, 0.002).any()):
            return None
        change |= {name: thing for (name, _), thing in zip(members, lowered(items, group), strict=True)}
    return change


def _has_room(desk: _Desk, item: Item, instance: str) -> bool:
    return desk.ground(instance).is_free(item.outline())


def _destinations(desk: _Desk, item: Item, moving: str | None = None) -> Iterator[tuple[Placed, str]]:
    """Places for a thing, with words for them: beside a thing, in a corner, on top of or in another."""
    ways = (_beside, _in_a_corner, _onto)
    for k in desk.kit.rng.permutation(len(ways)):
        yield from ways[k](desk, item, moving)


def _beside(desk: _Desk, item: Item, moving: str | None) -> Iterator[tuple[Placed, str]]:
    sides = (("to the left of", -1, 0), ("to the right of", 1, 0), ("in front of", 0, -1), ("behind", 0, 1))
    anchors = [o for o in desk.standing() if o.instance != moving]
    ground = desk.ground(*([] if moving is None else [moving]))
    for _ in range(_TRIES if anchors else 0):
        anchor = anchors[desk.kit.rng.integers(len(anchors))]
        words, along_x, along_y = sides[desk.kit.rng.integers(4)]
        x_min, y_min, x_max, y_max = desk.things[anchor.instance].item.outline().bounds
        width, depth = np.ptp(np.reshape(item.outline().bounds, (2, 2)), axis=0).tolist()
        gap = desk.kit.between(*_BESIDE)
        x = (x_min + x_max) / 2 + along_x * ((x_max - x_min + width) / 2 + gap) + desk.kit.around(0.01)
        y = (y_min + y_max) / 2 + along_y * ((y_max - y_min + depth) / 2 + gap) + desk.kit.around(0.01)
        there = replace(item, x=x, y=y)
        if ground.is_free(there.outline()):
            yield lowered([there])[0], f"{words} {desk.name(anchor.instance)}"


def _in_a_corner(desk: _Desk, item: Item, moving: str | None) -> Iterator[tuple[Placed, str]]:
    width, depth = desk.made.scene.table.size_xy
    ground = desk.ground(*([] if moving is None else [moving]))
    for _ in range(_TRIES):
        row, column = desk.kit.pick("front", "back"), desk.kit.pick("left", "right")
        x, y = (0.17 if column == "left" else 0.83) * width, (0.17 if row == "front" else 0.83) * depth
        there = replace(item, x=x + desk.kit.around(0.14 * width), y=y + desk.kit.around(0.14 * depth))
        if ground.is_free(there.outline()):
            yield lowered([there])[0], f"into the {row} {column} corner"


def _onto(desk: _Desk, item: Item, moving: str | None) -> Iterator[tuple[Placed, str]]:
    """On top of, or in, a thing that stands upright and carries nothing yet."""
    graph = desk.namer.graph
    for o in desk.leaves():
        source = asset(desk.things[o.instance].item.key)
        space, words = (source.top, "on") if source.top is not None else (source.hollow, "in")
        held = any(graph.has_edge(o.instance, other, key=RelationKind.IN) for other in desk.things)
        if o.instance == moving or space is None or o.tilt_angle > 0.02 or held:
            continue
        carrier = desk.things[o.instance]
        inside = scattered(floor_of(carrier.item, space, 0.002), [item], desk.kit)
        if inside:
            pair = lowered([carrier.item, inside[0]], carrier.group)
            lift = carrier.z - pair[0].z
            yield Placed(inside[0], pair[1].z + lift, carrier.group), f"{words} {desk.name(o.instance)}"


def _new(key: str, kit: Kit) -> str:
    """Words for a thing that is not there yet, with an article."""
    captions = asset(key).design.captions
    caption = kit.pick(captions[0], *(c for c in captions[1:] if "," not in c))
    first = caption.split()[0]
    if first in ("a", "an", "the", "some", "two", "three"):
        return caption
    return f"{'an' if first[0] in 'aeiou' else 'a'} {caption}"
