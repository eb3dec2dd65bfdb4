"""Plans an edit from the reading of its instruction: the reply of a reasoner that no edit was ever shown to.

What goes, comes, moves, is replaced, restyled or exchanged follows from the reading; which objects are meant, from
:mod:`models.semantic_reasoner.edit_planning.mention_resolution`. Places are free of other boxes where there is room; the correction
finds the exact ones. An instruction that states no change gives no plan.
"""

import math
from collections.abc import Iterable, Iterator, Mapping, Sequence, Set
from dataclasses import replace
from typing import TypeAlias

import numpy as np
import shapely

from models.instruction_reader.reading import MentionedObject, MentionedRelation
from models.instruction_reader.sentences import split_words
from models.semantic_reasoner.edit_planning.mention_resolution import MentionResolver
from models.semantic_reasoner.edit_planning.turns import yaw_after_turn
from models.semantic_reasoner.language.category_statistics import LEVELS, CategoryStatistics
from models.semantic_reasoner.language.interpreter import InstructionInterpreter
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
from stable_data.errors import SceneError
from stable_data.instructions.wording.words import type_words
from stable_data.metrics.alignment import members
from stable_data.scene import Relation, RelationKind, Vec3
from stable_data.scene_graph.relations import cell_of, direction_of, yawed_rectangle
from stable_data.scene_graph.support_from_boxes import carriers_of
from stable_data.scene_graph.support_tree import SupportTree

_SIDES = {
    "right": RelationKind.RIGHT_OF,
    "left": RelationKind.LEFT_OF,
    "front": RelationKind.IN_FRONT_OF,
    "behind": RelationKind.BEHIND,
}
"""The directions by their names in goals; those of a thing that is only near another one are tried in this order."""

_RELATIONS = {**_SIDES, "on": RelationKind.ON, "in": RelationKind.IN, "at": RelationKind.IS_AT}
"""The relations of a scene graph by their names in goals."""

_TOUCHES = 0.002  # metres by which boxes may overlap in height without sharing a place
_SHOWN = 60  # characters of an instruction in a message
_SMALLER, _LARGER = 0.8, 1.25  # factors of the sizes of objects that become smaller or larger
_SIZE_WORDS = {
    **dict.fromkeys(("smaller", "shorter", "tiny", "mini", "small", "little"), _SMALLER),
    **dict.fromkeys(("bigger", "larger", "taller", "huge", "giant", "big", "large", "oversized"), _LARGER),
}
Moves: TypeAlias = Mapping[str, Mapping[str, Sequence[str]]]
"""The wanted relations of each object that moves: instance -> kind -> the instances of their targets, or a cell."""

_LOOK = "look"
"""Kind of a relation whose target has the words of a new look before its noun."""

_NO_LOOK = frozenset(
    {"a", "an", "the", "into", "in", "to", "of", "more", "much", "rather", "something", "instead", "one", "it"}
)
"""Words of a new look that describe nothing."""


class EditPlanner:
    """Plans edits.

    Args:
        interpret: Interprets instructions.
        statistics: The usual sizes of categories.
    """

    def __init__(self, interpret: InstructionInterpreter, statistics: CategoryStatistics) -> None:
        self._interpret, self._statistics = interpret, statistics

    def __call__(self, question: ReasonerQuestion) -> LayoutReply:
        """Returns the reply to an edit.

        Raises:
            SceneError: The instruction states no change that is understood (``edit_unread``), an object that the edit needs is
                not in the layout (``object_missing``), or several fit (``ambiguous``).
        """
        meant = self._interpret(question.instruction, is_edit=True)
        plan = _Plan(question, self._statistics)
        objects, reading = meant.reading.objects, meant.reading
        resolver = MentionResolver(
            question.instruction, reading, list(plan.objects.values()), question.table, self._interpret.lexicon
        )
        acted = {k for k, o in enumerate(objects) if o.change or o.goal_region}
        goals = [resolver.with_mover_first(r) for r in reading.goal]
        goals = list(_without_surroundings(goals, resolver, acted))
        needed = acted | {n for r in goals for n in (r.subject, r.target)}
        if not needed:
            message = f"no change is understood in {question.instruction[:_SHOWN]!r}"
            raise SceneError(f"{message}; say what goes, comes, moves, is replaced or gets another look", "edit_unread")
        meanings = resolver.resolve(needed, acted | {r.subject for r in goals})
        goals = [_as_style(r, objects) for r in goals]
        for k in resolver.new:
            if objects[k].categories and not any(r.kind in ("style", _LOOK) and r.target == k for r in goals):
                meanings[k] = (plan.create(objects[k]),)
        for r in goals:
            self._apply(plan, r.kind, meanings.get(r.subject, ()), meanings.get(r.target, ()), objects[r.target])
        for k, o in enumerate(objects):
            for name in meanings.get(k, ()) if o.change == "remove" else ():
                plan.remove(name)
        moves = plan.with_carriers(_moves(objects, goals, meanings, plan.placed), resolver)
        for name, wanted in _targets_first({n: w for n, w in moves.items() if not plan.comes_along(n, w, moves)}):
            plan.move(name, wanted)
        return plan.reply()

    def _apply(
        self,
        plan: "_Plan",
        kind: str,
        subjects: Sequence[str],
        targets: Sequence[str],
        look: MentionedObject,
    ) -> None:
        """Applies a replacement, a new look or an exchange."""
        match kind:
            case "replace":
                for new, old in zip(subjects, targets, strict=False):
                    plan.put_in_place(new, old)
            case "style" | "look":
                words = look.words if kind == "style" else " ".join(look.words.split()[:-1])
                others = [name for name in subjects if not plan.has_look(name, words)]
                for name in others or subjects:  # of several, those that look so already stay
                    plan.restyle(name, words)
            case "swap" if subjects and targets and subjects[0] < targets[0]:
                plan.exchange(subjects[0], targets[0])
            case _:
                pass


def _without_surroundings(
    goals: Sequence[MentionedRelation], resolver: MentionResolver, acted: Set[int]
) -> Iterator[MentionedRelation]:
    """The goals without those to unknown things around the table, where the edit says more of the same object."""
    known = [r for r in goals if not resolver.is_unknown(r.target)]
    placed = acted | {r.subject for r in known}
    return (r for r in goals if r in known or r.subject not in placed)


def _as_style(r: MentionedRelation, objects: Sequence[MentionedObject]) -> MentionedRelation:
    """A replacement by objects of the same kind, as in "the napkins by white ones", as a new look of the old ones."""
    new, old = objects[r.subject], objects[r.target]
    if r.kind != "replace" or len(new.words.split()) < 2 or not set(new.categories) & set(old.categories):
        return r
    return MentionedRelation(r.target, _LOOK, r.subject, r.score)


def _moves(
    objects: Sequence[MentionedObject],
    goals: Sequence[MentionedRelation],
    meanings: Mapping[int, Sequence[str]],
    placed: Set[str],
) -> Moves:
    moves: dict[str, dict[str, list[str]]] = {}
    for r in goals:
        if r.kind not in ("replace", "style", _LOOK, "swap"):
            for name in meanings.get(r.subject, ()):
                moves.setdefault(name, {}).setdefault(r.kind, []).extend(meanings.get(r.target, ()))
    for name, o in ((name, o) for k, o in enumerate(objects) for name in meanings.get(k, ())):
        if o.goal_region and name not in moves:
            moves[name] = {"at": [o.goal_region]}
        elif o.change in ("away", "add") and name not in moves and name not in placed:
            moves[name] = {"away": []}
    return moves


def _targets_first(moves: Moves) -> Iterator[tuple[str, Mapping[str, Sequence[str]]]]:
    """The moves in an order in which an object moves after those that it goes to."""
    left = dict(moves)
    while left:
        targets = {n: {t for names in wanted.values() for t in names} - {n} for n, wanted in left.items()}
        name = next((n for n in left if not targets[n] & left.keys()), "")
        name = name or next(iter(left))  # they go to each other
        yield name, left.pop(name)


def _look_words(look: str) -> list[str]:
    return [word for word in look.split() if word not in _NO_LOOK]


class _Plan:
    """A layout while an edit changes it."""

    def __init__(self, question: ReasonerQuestion, statistics: CategoryStatistics) -> None:
        self._question, self._statistics, self._table = question, statistics, question.table
        self.objects = {o.instance: o.to_scene_object() for o in question.layout}
        self._entries = {o.instance: o for o in question.layout}
        self.removed: list[str] = []
        self.placed: set[str] = set()
        self._wanted: list[Relation] = []
        self._new: set[str] = set()

    def reply(self) -> LayoutReply:
        was = {o.instance: o for o in self._question.layout}
        there = [o for name, o in self._entries.items() if name not in self.removed]
        changed = tuple(o for o in there if was.get(o.instance) != o)
        return LayoutReply(changed, tuple(self.removed), tuple(r for r in self._wanted if self._entails(r)))

    def _entails(self, r: Relation) -> bool:
        """Whether a relation is still about objects of the layout."""
        return set(members(r)) <= self.objects.keys()

    def remove(self, name: str) -> None:
        if name not in self.removed:
            self.removed.append(name)
            self.objects.pop(name, None)

    def create(self, one: MentionedObject) -> str:
        """Adds an object of the usual size, not yet placed."""
        known = [c for c in one.categories if c in self._statistics.categories and self._statistics.categories[c].sizes]
        category = self._statistics.most_frequent(known or one.categories)
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

    def has_look(self, name: str, look: str) -> bool:
        words = _look_words(look)
        return bool(words) and set(words) <= set(split_words(self._entries[name].description))

    def restyle(self, name: str, look: str) -> None:
        """Gives an object another look or size, or turns it on the spot if the words of the look describe a turn."""
        if name not in self.objects:
            return  # it goes
        entry = self._entries[name]
        if (yaw := yaw_after_turn(split_words(look), entry.z_rotation_deg)) is not None:
            self._store(replace(entry, z_rotation_deg=yaw))
            return
        words = _look_words(look)
        factor = next((_SIZE_WORDS[word] for word in words if word in _SIZE_WORDS), 1.0)
        w, d, h = (round(side * factor, 1) for side in entry.size_cm)
        x, y, z = entry.position_cm
        noun = " ".join(type_words(entry.category))
        described = f"a {' '.join(words)} {noun}" if words else entry.description
        place = (x, y, round(z + (h - entry.size_cm[2]) / 2, 1))
        self._store(replace(entry, description=described, size_cm=(w, d, h), position_cm=place))

    def exchange(self, one: str, other: str) -> None:
        if not {one, other} <= self.objects.keys():
            return  # one of them goes
        a, b = self.objects[one], self.objects[other]
        self._put(one, (b.position[0], b.position[1], b.bottom + a.size[2] / 2))
        self._put(other, (a.position[0], a.position[1], a.bottom + b.size[2] / 2))

    def put_in_place(self, new: str, old: str) -> None:
        was = self.objects.get(old)
        if was is None:
            return
        self.remove(old)
        x, y, _ = was.position
        self._put(new, (x, y, was.bottom + self.objects[new].size[2] / 2))

    def with_carriers(self, moves: Moves, resolver: MentionResolver) -> Moves:
        """The moves, with a carrier in place of an object that takes it along."""
        carriers = carriers_of(list(self.objects.values()), self._table)
        below = {name: carriers.get(name) for name in moves}
        along = {name: c for name, c in below.items() if c is not None and c not in moves and resolver.comes_along(c)}
        return {along.get(name, name): wanted for name, wanted in moves.items()}

    def comes_along(self, name: str, wanted: Mapping[str, Sequence[str]], moves: Moves) -> bool:
        """Whether an object is on or in another one that moves to the same place, and so needs no move of its own."""
        carriers = carriers_of(list(self.objects.values()), self._table)
        return name in self.objects and any(moves.get(other) == wanted for other in SupportTree(carriers).ancestors(name))

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
            return  # it is there already
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
            for target in there:
                relation = RelationKind.IN if kind == "in" else RelationKind.ON
                yield from self._of_mover(name, places_on_or_in(self.objects[name], self.objects[target], relation))
        elif there:
            sides = (_SIDES[kind],) if kind in _SIDES else tuple(_SIDES.values())
            if kind == "across":
                now = direction_of(*np.subtract(self.objects[there[0]].position, self.objects[name].position)[:2])
                sides = sides if now is None else (now,)
            for side in sides:
                beside = places_beside(Relation(name, side, there[0]), self.objects, carriers)
                yield from self._of_mover(name, beside)
        else:
            yield from self._elsewhere(name)

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
