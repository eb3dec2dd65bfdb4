"""A layout while a planned edit changes it: objects come, go, and get places that are free of other boxes where there is room."""

import math
from collections.abc import Iterable, Iterator, Mapping, Sequence, Set
from dataclasses import replace
from typing import TypeAlias

import numpy as np
import shapely

from models.instruction_reader.reading import MentionedObject, MentionedRelation
from models.instruction_reader.sentences import split_words
from models.semantic_reasoner.edit_planning.candidates import adjectives_of, head_of
from models.semantic_reasoner.edit_planning.mention_resolution import MentionResolver
from models.semantic_reasoner.edit_planning.turns import yaw_after_turn
from models.semantic_reasoner.language.category_statistics import LEVELS, CategoryStatistics
from models.semantic_reasoner.replies.places import (
    Place,
    half_extent,
    places_beside,
    places_between,
    places_on_or_in,
    table_spots,
)
from models.semantic_reasoner.text.prompt import ReasonerQuestion
from models.semantic_reasoner.text.reply_json import LayoutObject, LayoutReply
from stable_data.instructions.wording.vocabulary import nouns_of
from stable_data.instructions.wording.words import singular, type_words
from stable_data.metrics.alignment import members
from stable_data.scene import Relation, RelationKind, Vec3
from stable_data.scene_graph.relations import cell_of, direction_of, yawed_rectangle
from stable_data.scene_graph.support_from_boxes import carriers_of
from stable_data.scene_graph.support_tree import SupportTree

SIDES = {
    "right": RelationKind.RIGHT_OF,
    "left": RelationKind.LEFT_OF,
    "front": RelationKind.IN_FRONT_OF,
    "behind": RelationKind.BEHIND,
}
"""The directions by their names in goals; those of a thing that is only near another one are tried in this order."""

_RELATIONS = {**SIDES, "on": RelationKind.ON, "in": RelationKind.IN, "at": RelationKind.IS_AT}
"""The relations of a scene graph by their names in goals."""

_TOUCHES = 0.002  # metres by which boxes may overlap in height without sharing a place
_SMALLER, _LARGER = 0.8, 1.25  # factors of the sizes of objects that become smaller or larger
_SIZE_WORDS = {
    **dict.fromkeys(("smaller", "shorter", "tiny", "mini", "small", "little"), _SMALLER),
    **dict.fromkeys(("bigger", "larger", "taller", "huge", "giant", "big", "large", "oversized"), _LARGER),
}
Moves: TypeAlias = Mapping[str, Mapping[str, Sequence[str]]]
"""The wanted relations of each object that moves: instance -> kind -> the instances of their targets, or a cell."""

_NO_LOOK = frozenset(
    {
        "a",
        "an",
        "the",
        "into",
        "in",
        "to",
        "of",
        "on",
        "more",
        "much",
        "rather",
        "something",
        "instead",
        "one",
        "it",
        "very",
        "so",
    }
)
"""Words of a new look that describe nothing."""


def look_words(look: str) -> list[str]:
    """Returns the words of a new look that describe something."""
    return [word for word in look.split() if word not in _NO_LOOK]


class LayoutPlan:
    """A layout while an edit changes it."""

    def __init__(self, question: ReasonerQuestion, statistics: CategoryStatistics) -> None:
        self._question, self._statistics, self._table = question, statistics, question.table
        self.objects = {o.instance: o.to_scene_object() for o in question.layout}
        self._was, self._entries = dict(self.objects), {o.instance: o for o in question.layout}
        self.removed: list[str] = []
        self.placed: set[str] = set()
        self._wanted: list[Relation] = []
        self._new: set[str] = set()
        self.is_so = False  # a wanted relation holds already

    def reply(self) -> LayoutReply:
        """Returns what has changed, and the relations that shall hold."""
        was = {o.instance: o for o in self._question.layout}
        there = [o for name, o in self._entries.items() if name not in self.removed]
        changed = tuple(o for o in there if was.get(o.instance) != o)
        return LayoutReply(changed, tuple(self.removed), tuple(r for r in self._wanted if self._entails(r)))

    def _entails(self, r: Relation) -> bool:
        """Whether a relation is still about objects of the layout."""
        return set(members(r)) <= self.objects.keys()

    def remove(self, name: str) -> None:
        """Removes an object."""
        if name not in self.removed:
            self.removed.append(name)
            self.objects.pop(name, None)

    def create(self, one: MentionedObject, text: str) -> str:
        """Adds an object of the usual size, not yet placed; of several categories preferably one that the text says.

        An object of no known category gets that of its last word, and whether a library has it turns out later.
        """
        known = [c for c in one.categories if c in self._statistics.categories and self._statistics.categories[c].sizes]
        said = set(singular(tuple(split_words(text))))
        spoken = [c for c in known if set(singular(type_words(c))) <= said]
        spoken = spoken or [c for c in known if head_of(one.words) in {head_of(noun) for noun in nouns_of(c)}] or known
        likely = {c: self._share(c, adjectives_of(one)) for c in spoken}
        spoken = [c for c in spoken if likely[c] == max(likely.values())]
        category = self._statistics.most_frequent(spoken or one.categories or (head_of(one.words),))
        used = {name for name in self._entries if name.rpartition("_")[0] == category}
        name = next(f"{category}_{k}" for k in range(len(used) + 1) if f"{category}_{k}" not in used)
        size: Vec3 = (0.1, 0.1, 0.1)
        if known:
            size = self._statistics.categories[category].sizes[LEVELS.index(0.5)]
        width, depth = self._table.size_xy
        w, d, h = (round(100 * side, 1) for side in size)
        article = "an" if one.words[:1] in "aeiou" else "a"
        entry = LayoutObject(name, f"{article} {one.words}", (w, d, h), (50 * width, 50 * depth, h / 2), 0)
        self._entries[name], self.objects[name] = entry, entry.to_scene_object()
        self._new.add(name)
        return name

    def _share(self, category: str, words: Iterable[str]) -> float:
        """How usual words are in descriptions of a category."""
        known = self._statistics.categories[category]
        return sum(known.words.get(word, 0) for word in set(words) if len(word) > 2) / max(1, known.count)

    def has_look(self, name: str, look: str) -> bool:
        """Whether an object's description has the words of a look."""
        words = look_words(look)
        return bool(words) and set(words) <= set(split_words(self._entries[name].description))

    def restyle(self, name: str, look: str) -> None:
        """Gives an object another look or size, or turns it on the spot if the words of the look describe a turn."""
        if name not in self.objects:
            return  # it goes
        entry = self._entries[name]
        if (yaw := yaw_after_turn(split_words(look), entry.z_rotation_deg)) is not None:
            self._store(replace(entry, z_rotation_deg=yaw))
            return
        words = look_words(look)
        factor = next((_SIZE_WORDS[word] for word in words if word in _SIZE_WORDS), 1.0)
        w, d, h = (round(side * factor, 1) for side in entry.size_cm)
        x, y, z = entry.position_cm
        noun = " ".join(type_words(entry.category))
        described = f"a {' '.join(words)}" if noun in " ".join(words) else f"a {' '.join(words)} {noun}"
        described = described if words else entry.description
        place = (x, y, round(z + (h - entry.size_cm[2]) / 2, 1))
        self._store(replace(entry, description=described, size_cm=(w, d, h), position_cm=place))

    def exchange(self, one: str, other: str) -> None:
        """Lets two objects change places."""
        if not {one, other} <= self.objects.keys():
            return  # one of them goes
        a, b = self.objects[one], self.objects[other]
        self._put(one, (b.position[0], b.position[1], b.bottom + a.size[2] / 2))
        self._put(other, (a.position[0], a.position[1], a.bottom + b.size[2] / 2))

    def put_in_place(self, new: str, old: str, is_replaced: bool) -> None:
        """Puts an object where another one was, which goes if it is replaced."""
        was = self._was.get(old)
        if was is None or new not in self.objects:
            return
        if is_replaced:
            self.remove(old)
        x, y, _ = was.position
        self._put(new, (x, y, was.bottom + self.objects[new].size[2] / 2))

    def nearest(self, some: Iterable[str], others: Iterable[str]) -> list[str]:
        """Returns one object of some and one of others that are nearest to each other; fewer if they are not there."""
        pairs = [(a, b) for a in some for b in others if a != b and {a, b} <= self.objects.keys()]
        return list(min(pairs, key=lambda pair: math.dist(*(self.objects[n].position[:2] for n in pair)), default=()))

    def with_contents(
        self, goals: Sequence[MentionedRelation], meanings: Mapping[int, Sequence[str]]
    ) -> list[MentionedRelation]:
        """The goals, where a new carrier keeps what is on or in the old one: "the brushes in a mug instead of that holder"."""
        tree = SupportTree(carriers_of(list(self.objects.values()), self._table))
        found = list(goals)
        for r in goals:
            for other in goals:
                if (r.kind, other.kind, r.subject) != ("replace", "replace", other.subject) or r.target == other.target:
                    continue
                above, below = (set(meanings.get(n, ())) for n in (r.target, other.target))
                if above and below and all(below & set(tree.ancestors(name)) for name in above) and r in found:
                    found.remove(r)
                    self._wanted += (Relation(n, RelationKind.IN, meanings[r.subject][0]) for n in sorted(above))
        return found

    def with_carriers(self, moves: Moves, resolver: MentionResolver) -> Moves:
        """The moves, with a carrier in place of an object that takes it along."""
        carriers = carriers_of(list(self.objects.values()), self._table)
        below = {name: carriers.get(name) for name in moves}
        along = {name: c for name, c in below.items() if c is not None and c not in moves and resolver.comes_along(c)}
        return {along.get(name, name): wanted for name, wanted in moves.items()}

    def comes_along(self, name: str, wanted: Mapping[str, Sequence[str]], moves: Moves) -> bool:
        """Whether an object is on or in another one that moves to the same place, and so needs no move of its own."""
        if name not in self.objects or name in self._new:
            return False
        carriers = carriers_of(list(self.objects.values()), self._table)
        return any(moves.get(other) == wanted for other in SupportTree(carriers).ancestors(name))

    def move(self, name: str, wanted: Mapping[str, Sequence[str]]) -> None:
        """Moves an object to a free place for which the first of the wanted relations holds, and the others if possible."""
        if name not in self.objects:
            return  # it goes
        carriers = carriers_of(list(self.objects.values()), self._table)
        self._wanted += (
            Relation(name, _RELATIONS[kind], t[0]) for kind, t in wanted.items() if kind in _RELATIONS and len(t) == 1
        )
        first, *rest = sorted(wanted, key=lambda kind: kind == "near")
        candidates = list(self._places(name, first, wanted[first], carriers))
        if not candidates:
            return
        if first in ("in", "on") and not rest and not set(wanted[first]).isdisjoint(SupportTree(carriers).ancestors(name)):
            self.is_so = True
            return
        below = set(wanted[first]) if first in ("in", "on") else set()
        others = [self.objects[t] for kind in rest for t in wanted[kind] if t in self.objects]
        heights = list(dict.fromkeys(z for _, _, z in candidates))  # the likeliest first
        scored = [
            (
                self._is_taken(name, place, below, carriers),
                heights.index(place[2]),
                round(sum(math.dist(place[:2], t.position[:2]) for t in others), 2),
            )
            for place in candidates
        ]
        self._put(name, candidates[min(range(len(candidates)), key=lambda k: (scored[k], k))])

    def _places(
        self, name: str, kind: str, targets: Sequence[str], carriers: dict[str, str | None]
    ) -> Iterator[tuple[float, float, float]]:
        there = [t for t in targets if t in self.objects and t != name]
        if kind == "at":
            yield from (place for cell in targets for place in self._in_cell(name, cell))
        elif kind == "between" and len(there) > 1:
            between = Relation(name, RelationKind.BETWEEN, ", ".join(there[:2]))
            yield from self._of_mover(name, places_between(between, self.objects, carriers))
        elif kind in ("in", "on"):
            for target in self._topmost(there, carriers) if kind == "on" else there:
                relation = RelationKind.IN if kind == "in" else RelationKind.ON
                yield from self._of_mover(name, places_on_or_in(self.objects[name], self.objects[target], relation))
        elif there:
            sides = (SIDES[kind],) if kind in SIDES else tuple(SIDES.values())
            if kind == "across":
                now = direction_of(*np.subtract(self.objects[there[0]].position, self.objects[name].position)[:2])
                sides = sides if now is None else (now,)
            for side in sides:
                beside = places_beside(Relation(name, side, there[0]), self.objects, carriers)
                yield from self._of_mover(name, beside)
        else:
            yield from self._elsewhere(name)

    @staticmethod
    def _topmost(names: Sequence[str], carriers: Mapping[str, str | None]) -> list[str]:
        """The objects without those that carry others of them: on a pile is on its topmost object."""
        below = {carrier for name in names for carrier in SupportTree(carriers).ancestors(name)}
        return [name for name in names if name not in below] or list(names)

    @staticmethod
    def _of_mover(name: str, places: Iterable[Place]) -> Iterator[tuple[float, float, float]]:
        return (place for mover, place in places if mover == name)

    def _in_cell(self, name: str, cell: str) -> Iterator[tuple[float, float, float]]:
        """Places in a cell of the table, those in its middle first."""
        o, size = self.objects[name], np.array(self._table.size_xy)
        half = half_extent(o)
        inside = [spot for spot in table_spots(size) if cell_of(spot, self._table.size_xy) == cell]
        middle = np.mean(inside, axis=0)
        for spot in sorted(inside, key=lambda spot: math.dist(spot, middle)):
            x, y = np.clip(np.array(spot), half, np.maximum(half, size - half))
            if cell_of((float(x), float(y)), self._table.size_xy) == cell:
                yield float(x), float(y), o.size[2] / 2

    def _elsewhere(self, name: str) -> Iterator[tuple[float, float, float]]:
        """Places on the table, the nearest first; those of an object that is there already are a hand's breadth away."""
        o, size = self.objects[name], np.array(self._table.size_xy)
        half = half_extent(o)
        spots = (np.clip(np.array(spot), half, np.maximum(half, size - half)) for spot in table_spots(size))
        far = sorted((math.dist(spot, o.position[:2]), *map(float, spot)) for spot in spots)
        for distance, x, y in far:
            if name in self._new or distance > 0.1:
                yield x, y, o.size[2] / 2

    def _is_taken(
        self, name: str, place: tuple[float, float, float], below: Set[str], carriers: dict[str, str | None]
    ) -> float:
        """How much of an object's outline would be off the table or share its place with other objects, square metres."""
        moved = replace(self.objects[name], position=place)
        outline = shapely.Polygon(yawed_rectangle(moved))
        width, depth = self._table.size_xy
        lost = outline.area - outline.intersection(shapely.box(0, 0, width, depth)).area
        if (zone := self._table.restricted_zone) is not None:
            lost += outline.intersection(shapely.box(zone[0], zone[2], zone[1], zone[3])).area
        own = SupportTree(carriers).with_descendants({name})
        for other, o in self.objects.items():
            if other in own or other in below or other in self._new - self.placed:
                continue
            if moved.bottom < o.top - _TOUCHES and o.bottom < moved.top - _TOUCHES:
                lost += outline.intersection(shapely.Polygon(yawed_rectangle(o))).area
        return round(float(lost), 5)

    def _put(self, name: str, place: tuple[float, float, float]) -> None:
        x, y, z = (round(100 * float(value), 1) + 0.0 for value in place)
        self._store(replace(self._entries[name], position_cm=(x, y, z)))
        self.placed.add(name)

    def _store(self, entry: LayoutObject) -> None:
        was = self.objects[entry.instance]
        self._entries[entry.instance] = entry
        self.objects[entry.instance] = entry.to_scene_object()
        step = np.subtract(self.objects[entry.instance].position, was.position)
        carriers = carriers_of([was, *(o for o in self.objects.values() if o.instance != entry.instance)], self._table)
        for name in SupportTree(carriers).with_descendants({entry.instance}) - {entry.instance}:
            x, y, z = (float(v) for v in np.add(self.objects[name].position, step))
            self.objects[name] = replace(self.objects[name], position=(x, y, z))  # apply_edit moves it with its support
