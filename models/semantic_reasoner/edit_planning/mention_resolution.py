"""Finds the objects of a layout that an instruction mentions: by category, adjectives, place, relations and superlatives."""

import re
from collections.abc import Iterable, Sequence, Set
from dataclasses import dataclass, replace
from functools import cached_property
from math import inf

import numpy as np

from models.instruction_reader.reading import InstructionReading, MentionedObject, MentionedRelation
from models.instruction_reader.sentences import split_words
from models.semantic_reasoner.edit_planning.candidates import Candidates, adjectives_of, words_of
from models.semantic_reasoner.edit_planning.spoken_changes import OTHER
from models.semantic_reasoner.edit_planning.superlatives import (
    EXTREMES,
    MIDDLE,
    OF_THESE,
    ONE_OF,
    PICKED_OUT,
    picked,
    words_around,
)
from stable_data.errors import SceneError
from stable_data.instructions.wording.words import is_plural, singular
from stable_data.scene import Relation, RelationKind, Scene, SceneObject, Tabletop
from stable_data.scene_graph.relations import cell_of, direction_of, is_held, relations_of, scene_graph

MISSING, AMBIGUOUS = "object_missing", "ambiguous"
"""Codes of the errors of this module."""

_ANY = frozenset({"a", "an", "any", "one", "some"})
"""Words before a mention of which any object may be meant."""

_ALL = frozenset({"all", "every", "each"})

_ONE_OR_MANY = frozenset({"dice"})
"""Nouns whose plural may mean one object."""

_DEFINITE = frozenset({"the", "that", "this", "those", "these"})
"""Words before a mention of an object that must be there."""

_OWN = frozenset({"my", "our", "your", "his", "her", "their"})
"""Words before a mention of an object that is probably there."""

_THE_ONE = re.compile(r"[^.!?;]*, the (?:[\w-]+ )?one\b")
"""Words after a plural of which one is meant."""

_LOT = re.compile(r"[^a-z]{1,3}(?:all of (?:it|them)|the (?:whole )?lot|every (?:single |last )?one)\b")
"""Words after a mention that mean all of its kind."""

_MASS = frozenset({"cosmetics", "crockery", "cutlery", "food", "fruit", "silverware", "stationery", "tableware"})
"""Nouns of all objects of several kinds."""

_COLLECTIONS = frozenset({"stack", "pile", "row", "line", "heap", "bunch", "set", "group"})
"""Nouns before ``of`` and all objects of a kind."""

_TOLD_APART = 4  # letters of a word of the text that tells several objects apart, and of its beginning
_NEARER = 0.05  # metres by which the nearest of several has to be nearer

_NEW = frozenset({"replace", "style"})  # kinds of relations whose subject, or whose target, is not in the layout

_WITH = re.compile(r"\b(?:with|and)(?: its| the| their)?(?: own)?\s*$")
"""Words before a carrier that goes along with what is on it."""

_SIDE_WORDS = {"left": ({"left"}, {"right"}), "front": ({"front", "before"}, {"behind", "beyond", "back"})}
"""Words that state the relations ``left`` and ``front``, and words that state the same with its objects exchanged."""

_EXCHANGED = {"left": "right", "front": "behind"}
_READ_AS = {side: kind for kind, side in _EXCHANGED.items()}

_PLAIN = frozenset(
    {"and", "for", "its", "one", "that", "the", "this", "with", "two", "three", "without", "make", "made", "small", "open"}
)
"""Words of descriptions that tell no objects apart."""

_ACROSS = re.compile(r"\b(?:other|opposite|far) side of\b")


@dataclass(frozen=True, slots=True)
class MentionedGroup:
    """The mentioned objects of one name.

    Attributes:
        numbers: Their numbers in the reading.
        first: One of them, for what is said of all.
        is_open: Whether it is a plural without a number, or has a word such as ``all``: all that fit are meant.
        is_any: Whether any that fits is meant.
    """

    numbers: tuple[int, ...]
    first: MentionedObject
    is_open: bool
    is_any: bool


class MentionResolver:
    """Finds mentioned objects in a layout.

    Args:
        text: The instruction.
        reading: Its reading.
        layout: The objects, with the layout's names.
        table: The table.
        candidates: Finds the objects that a noun may mean.
    """

    def __init__(
        self,
        text: str,
        reading: InstructionReading,
        layout: Sequence[SceneObject],
        table: Tabletop,
        candidates: Candidates,
    ) -> None:
        self._text, self._reading, self._layout, self._table = text, reading, layout, table
        self._candidates = candidates
        self._said, self._objects = split_words(text), {o.instance: o for o in layout}
        found: dict[int, list[int]] = {}
        for number, one in enumerate(reading.objects):
            if number not in self.new:
                found.setdefault(one.name, []).append(number)
        self.groups = [self._group(tuple(numbers)) for numbers in found.values()]
        self._group_of = {n: k for k, group in enumerate(self.groups) for n in group.numbers}

    @cached_property
    def new(self) -> frozenset[int]:
        """Numbers of the mentioned objects that are not in the layout: new ones, and the words of a new look."""
        moving = {r.subject if not self._is_said_of_target(r) else r.target for r in self._reading.goal if r.kind not in _NEW}
        added = {
            k
            for k, o in enumerate(self._reading.objects)
            if o.change == "add" and not self._is_there(o) and not (k in moving and self._is_called(o))
        }
        for r in self._reading.goal:
            one = self._reading.objects[r.subject]
            if r.kind == "replace" and self._words_before(one) & _DEFINITE and self._of_category(one):
                continue  # "the mug can have its place"
            if r.kind in _NEW:
                added.add(r.subject if r.kind == "replace" else r.target)
            elif self._is_absent(mover := r.target if self._is_said_of_target(r) else r.subject):
                added.add(mover)
        return frozenset(added | {k for k, o in enumerate(self._reading.objects) if o.goal_region and self._is_absent(k)})

    def _is_absent(self, number: int) -> bool:
        """Whether an object has a place but is not in the layout, as in "a candle beside the mug": it comes."""
        one, before = self._reading.objects[number], self._words_before(self._reading.objects[number])
        there = self._candidates.named(one) if before & {"a", "an"} else self._of_category(one)
        return bool(one.categories) and not (there or before & _DEFINITE)

    def _is_there(self, one: MentionedObject) -> bool:
        """Whether an object that comes is one of the layout, as in "bring the jar nearer"."""
        is_certain = not one.categories or bool(self._words_before(one) & (_DEFINITE | _OWN | _ALL | {"both"}))
        return is_certain and bool(self._of_category(one))

    def _is_called(self, one: MentionedObject) -> bool:
        """Whether an object begins a sentence without an article and is there once: "Knife to the right of the spoon"."""
        begins = any(not self._text[:start].strip() or self._text[:start].rstrip()[-1] in ".!?;:" for start, _ in one.mentions)
        return begins and len(self._of_category(one)) == 1

    def _is_said_of_target(self, r: MentionedRelation) -> bool:
        """Whether the words state a relation of its target: "the mug behind the plate" is read as the plate in front of it."""
        if r.kind not in _SIDE_WORDS:
            return False
        own, exchanged = (bool(words & set(self._said)) for words in _SIDE_WORDS[r.kind])
        if own != exchanged:
            return exchanged
        first = [min((start for start, _ in self._reading.objects[k].mentions), default=inf) for k in (r.subject, r.target)]
        return first[1] < first[0]

    def with_mover_first(self, r: MentionedRelation) -> MentionedRelation:
        """Returns a relation after the task with the object that moves as its subject.

        Its kind may then be ``right``, ``behind``, or ``across`` if the object goes to the other side of the target.
        """
        no_side = r.kind in _SIDE_WORDS and not any(words & set(self._said) for words in _SIDE_WORDS[r.kind])
        if (r.kind == "near" or no_side) and r.subject not in self.new and _ACROSS.search(self._text.lower()):
            return replace(r, kind="across")
        is_one_new = (r.subject in self.new) != (r.target in self.new)
        if r.kind in _EXCHANGED and (r.target in self.new if is_one_new else self._is_said_of_target(r)):
            return replace(r, subject=r.target, kind=_EXCHANGED[r.kind], target=r.subject)
        return r

    def _words_before(self, one: MentionedObject) -> set[str]:
        return {split_words(self._text[:start])[-1] for start, _ in one.mentions if split_words(self._text[:start])}

    def is_unknown(self, number: int) -> bool:
        """Whether a mention has no known noun and fits no object, such as ``the washbasin`` beside the table."""
        one = self._reading.objects[number]
        return number not in self.new and not one.categories and not self._of_category(one)

    def is_idle(self, number: int) -> bool:
        """Whether an unknown mention is in passing, without an article: "Juice is no good for books"; a warning names it."""
        one = self._reading.objects[number]
        return not self._words_before(one) & (_DEFINITE | _OWN | _ALL | _ANY) and bool(one.words) and self.is_unknown(number)

    def resolve(self, needed: Iterable[int], changed: Set[int]) -> dict[int, tuple[str, ...]]:
        """Returns the instances of each needed object; all objects of a group have the same instances.

        Args:
            needed: Numbers of objects that the edit changes, or that it needs to know the place of.
            changed: Those that it changes; of the others fewer may be there than are mentioned ("the row of three books").

        Raises:
            SceneError: None or too few objects fit (``object_missing``), or more than are meant (``ambiguous``).
        """
        fitting = self._fitting()
        found: dict[int, tuple[str, ...]] = {}
        for k in dict.fromkeys(self._group_of[n] for n in needed if n in self._group_of):
            group, names = self.groups[k], fitting[k]
            if not names:
                words = ", ".join(o.instance for o in self._layout[:8])
                raise SceneError(f"no object of the layout is {group.first.words!r}; it has {words}", MISSING)
            count = len(group.numbers)
            if len(names) < count and not group.is_open and changed & set(group.numbers):
                there = ", ".join(names)
                raise SceneError(f"{count} objects are {group.first.words!r}, but the layout has only {there}", MISSING)
            if len(names) > count and not group.is_open:
                if not group.is_any:
                    several = ", ".join(names)
                    raise SceneError(f"{group.first.words!r} may be {several}; say which of them is meant", AMBIGUOUS)
                full = {r.target for r in self._on_in}
                names = sorted(names, key=lambda name: name in full)[:count]
            found |= dict.fromkeys(group.numbers, tuple(names))
        return found

    def is_certainly_not(self, r: MentionedRelation) -> bool:
        """Whether two objects are certain, and not on the sides of each other that a relation with its mover first says."""
        try:
            found = self.resolve({r.subject, r.target}, set())
        except SceneError:
            return False
        if len(found.get(r.subject, ())) != 1 or len(found.get(r.target, ())) != 1:
            return False
        (a,), (b,) = found[r.subject], found[r.target]
        kind, one, other = (_READ_AS[r.kind], b, a) if r.kind in _READ_AS else (r.kind, a, b)
        return not self._holds(kind, one, other)

    def comes_along(self, carrier: str) -> bool:
        """Whether the words say that an object goes where the one on it goes: "the mug with its coaster"."""
        return any(
            _WITH.search(self._text[:start].lower())
            for group in self.groups
            if carrier in self._of_category(group.first)
            for start, _ in group.first.mentions
        )

    def _group(self, numbers: tuple[int, ...]) -> MentionedGroup:
        one = self._reading.objects[numbers[0]]
        before = self._words_before(one)
        head, *rest = one.words.split() or [""]
        is_all = bool(before & _ALL or _MASS & {*one.words.split()[-1:]}) or (head in _COLLECTIONS and rest[:1] == ["of"])
        is_part = any(o.mentions == one.mentions and o.name != one.name for o in self._reading.objects)
        is_plain_plural = len(numbers) == 1 and not is_part and is_plural(one.words) and not any(map(_is_pair, one.categories))
        is_open = (
            one.is_one_of_many
            or is_all
            or any(_LOT.match(self._text[end:].lower()) for _, end in one.mentions)
            or (is_plain_plural and bool(one.categories))
            or bool(_ONE_OR_MANY & {*one.words.split()[-1:]})
        )
        text = self._text.lower()
        is_one_of = any(ONE_OF.search(text[:start]) for start, _ in one.mentions)
        is_one_of |= any(OF_THESE.search(text[:start]) and _THE_ONE.match(text[end:]) for start, end in one.mentions)
        if is_one_of:
            picks = any(word in EXTREMES or word in MIDDLE or " " in word for word in self._adjectives(one))
            return MentionedGroup(numbers[:1], one, False, not picks)
        return MentionedGroup(numbers, one, is_open, bool(before & _ANY) and not (before & _DEFINITE or self._is_picked(one)))

    def _is_picked(self, one: MentionedObject) -> bool:
        """Whether words after a mention pick it out: ``one tablet, the one nearer to me``."""
        return any(" the one " in self._text[end:].lower() for _, end in one.mentions)

    def _fitting(self) -> list[list[str]]:
        """The instances that each group may mean, by all that is said of it."""
        fitting = [self._of_category(group.first) for group in self.groups]
        fitting = [self._spoken_of(k, fitting) for k in range(len(self.groups))]
        for k, group in enumerate(self.groups):
            fitting[k] = self._described(group, fitting[k])
            fitting[k] = self._in_region(group, fitting[k])
        for _ in self.groups:  # each round uses what the one before it found
            for k in range(len(self.groups)):
                fitting[k] = self._related(k, fitting)
        for k, group in enumerate(self.groups):
            if len(fitting[k]) > len(group.numbers):
                fitting[k] = self._candidates.best(group.first, fitting[k])
            fitting[k] = self._extreme(group, fitting[k])
        for r in self._reading.start:
            if r.kind == OTHER:
                own, kept = self._group_of[r.subject], fitting[self._group_of[r.target]]
                fitting[own] = [name for name in fitting[own] if name not in kept]
        fitting = self._different(fitting)
        fitting = [self._with_its_carrier(k, fitting) for k in range(len(self.groups))]
        return [self._told_apart(group, fitting[k]) for k, group in enumerate(self.groups)]

    def _spoken_of(self, k: int, fitting: Sequence[list[str]]) -> list[str]:
        """The instances that a wider noun after ``that`` means of what was mentioned before: "two cereals ... that box"."""
        one = self.groups[k].first
        if one.mentions and self._words_before(one) & {"that", "this", "those", "these"}:
            for j, other in enumerate(self.groups):
                if j != k and other.first.mentions and other.first.mentions[0] < one.mentions[0]:
                    both = [name for name in fitting[k] if name in fitting[j]]
                    if both and len(both) < len(fitting[k]):
                        return both
        return fitting[k]

    def _told_apart(self, group: MentionedGroup, names: list[str]) -> list[str]:
        """The instances that a word elsewhere in the text tells from the others: "who spilt the oil? That bottle can go"."""
        if len(names) <= len(group.numbers) or group.is_open or group.is_any:
            return names
        of_others = [
            place
            for k, one in enumerate(self._reading.objects)
            if self._is_other(k, group) and not self._is_part(k, group, names)
            for place in one.mentions
        ]
        kept = "".join(" " if any(a <= k < b for a, b in of_others) else c for k, c in enumerate(self._text.lower()))
        said = {word for word in singular(tuple(split_words(kept))) if word not in EXTREMES and word not in _PLAIN}
        words = {name: set(words_of(self._objects[name])) for name in names}
        shared = set.intersection(*words.values())
        score = {name: sum(_is_said(word, said) for word in words[name] - shared) for name in names}
        best = [name for name in names if score[name] == max(score.values())]
        return best if len(best) == len(group.numbers) else names

    def _is_part(self, number: int, group: MentionedGroup, names: Sequence[str]) -> bool:
        """Whether a mention is a part of objects rather than one of its own: ``the lipstick in the pink case``."""
        relations = [r for r in self._reading.start if r.subject in group.numbers and r.target == number]
        others = self._of_category(self._reading.objects[number])
        return bool(relations) and not any(
            self._holds(r.kind, name, other) for r in relations for name in names for other in others if name != other
        )

    def _is_other(self, number: int, group: MentionedGroup) -> bool:
        """Whether the words of a mention say nothing of a group: they mean other objects, or a new look."""
        one = self._reading.objects[number]
        return number not in group.numbers and bool(number in self.new or one.categories)

    def _with_its_carrier(self, k: int, fitting: Sequence[list[str]]) -> list[str]:
        """The instances of a group that lie on, or carry, another mentioned object: ``the muffin, plate and all``.

        The group is not where something shall go: ``put the muffin on the plate`` asks for another plate than its own.
        """
        names, group = fitting[k], self.groups[k]
        aims = {r.target for r in self._reading.goal}
        if len(names) <= len(group.numbers) or aims & set(group.numbers):
            return names
        known = [one for j, found in enumerate(fitting) if j != k and len(found) == 1 for one in found]
        tied = [a for a in names if any(self._holds("on", a, b) or self._holds("on", b, a) for b in known if a != b)]
        return tied if len(tied) == len(group.numbers) else names

    def _of_category(self, one: MentionedObject) -> list[str]:
        return self._candidates.of(one)

    def _adjectives(self, one: MentionedObject) -> list[str]:
        """The words of a mention, and what is said of its place among others (``that is farthest to the left``)."""
        return [*adjectives_of(one), *(word for start, end in one.mentions for word in words_around(self._text, start, end))]

    def _described(self, group: MentionedGroup, names: list[str]) -> list[str]:
        """The instances whose description has the adjectives of a mention, as far as any has them."""
        one = group.first
        adjectives = self._adjectives(one)
        if any(self._text[start:end].lower().split()[-1:] in (["one"], ["ones"]) for start, end in one.mentions):
            spoken = [word for word in adjectives_of(one) if word not in EXTREMES]
            having = self._candidates.described(spoken)
            if having and not set(having) & set(names):
                return having  # "the glass ... the felt one": no glass is of felt, but a coaster is
        if "'" in one.words.split():  # "the elephant's tray"
            words = one.words.split()[: one.words.split().index("'")]
            owners = self._of_category(replace(one, words=" ".join(words), categories=self._candidates.categories(words)))
            names = [name for name in names if any(name != o and self._holds("on", o, name) for o in owners)] or names
        for word in adjectives:
            having = [name for name in names if word in split_words(self._objects[name].description)]
            names = having or names
        return names

    def _in_region(self, group: MentionedGroup, names: list[str]) -> list[str]:
        region = group.first.region
        is_picked = any(PICKED_OUT.match(self._text[end:].lower()) for _, end in group.first.mentions)
        if not region or is_picked or region == group.first.goal_region or len(names) <= len(group.numbers):
            return names
        inside = [name for name in names if cell_of(self._objects[name].position, self._table.size_xy) == region]
        if inside and (len(inside) < len(names) or group.is_open):
            return inside
        for word in region.split("_"):  # "the left one" is in no cell, but to the left of the others
            if word not in MIDDLE:
                names = self._least(names, word, len(group.numbers))
        return names

    def _extreme(self, group: MentionedGroup, names: list[str]) -> list[str]:
        for word in self._adjectives(group.first):
            if len(names) > len(group.numbers):
                names = self._least(names, word, len(group.numbers))
        return names

    def _least(self, names: list[str], word: str, count: int) -> list[str]:
        return [o.instance for o in picked([self._objects[name] for name in names], word, count)]

    def _related(self, k: int, fitting: Sequence[list[str]]) -> list[str]:
        """The instances of a group that have its stated relations to others, as far as any has them."""
        names = fitting[k]
        for r in self._reading.start:
            for one, other, is_subject in ((r.subject, r.target, True), (r.target, r.subject, False)):
                if self._group_of.get(one) != k or self._group_of.get(other, k) == k:
                    continue
                others = fitting[self._group_of[other]]
                if r.kind == OTHER:
                    continue
                if r.kind == "between":
                    names = (self._between(names, r.subject, fitting) if is_subject else []) or names
                    continue
                holding = [
                    name
                    for name in names
                    if any(self._holds(r.kind, *((name, b) if is_subject else (b, name))) for b in others if b != name)
                ]
                if r.kind == "near":
                    holding = self._nearest(holding, others, len(self.groups[k].numbers))
                names = holding or names
        return names

    def _between(self, names: Sequence[str], subject: int, fitting: Sequence[list[str]]) -> list[str]:
        """The instances between the targets of a subject: beside the line from one to the other."""
        targets = (self._group_of.get(r.target) for r in self._reading.start if (r.subject, r.kind) == (subject, "between"))
        ends = [fitting[g] for g in dict.fromkeys(targets) if g is not None]
        pairs = [(a, b) for a in ends[0] for b in ends[-1] if a != b] if ends else []
        return [name for name in names if any(name not in pair and self._is_between(name, *pair) for pair in pairs)]

    def _is_between(self, name: str, one: str, other: str) -> bool:
        a, b, c = (np.array(self._objects[n].position[:2]) for n in (one, other, name))
        length = float(np.linalg.norm(b - a))
        along = float(np.dot(c - a, b - a)) / max(length, 1e-6)
        across = float(np.linalg.norm(c - a - (b - a) * along / max(length, 1e-6)))
        return 0 < along < length and across < _BESIDE_LINE

    def _nearest(self, names: list[str], others: Sequence[str], count: int) -> list[str]:
        """Of objects near others the nearest, if they are clearly nearer than the rest."""
        gaps = {
            name: min(gap_between(self._objects[name], self._objects[other]) for other in others if other != name)
            for name in names
        }
        names = sorted(names, key=lambda name: gaps[name])
        is_clear = len(names) > count and gaps[names[count]] - gaps[names[count - 1]] > _NEARER
        return names[:count] if is_clear else names

    @cached_property
    def _on_in(self) -> frozenset[Relation]:
        graph = scene_graph(Scene("layout", self._table, tuple(self._layout)), {})
        return frozenset(r for r in relations_of(graph) if r.kind in (RelationKind.ON, RelationKind.IN))

    def _holds(self, kind: str, one: str, other: str) -> bool:
        a, b = self._objects[one], self._objects[other]
        if kind in ("in", "on"):
            return is_held(self._on_in, Relation(one, RelationKind.ON, other))
        if kind == "near":
            return gap_between(a, b) < _NEAR
        wanted = {"left": RelationKind.LEFT_OF, "front": RelationKind.IN_FRONT_OF}.get(kind)
        return wanted is None or direction_of(a.position[0] - b.position[0], a.position[1] - b.position[1]) is wanted

    def _different(self, fitting: Sequence[list[str]]) -> list[list[str]]:
        """The instances without those that are certainly another object of the instruction."""
        left = [list(names) for names in fitting]
        for _ in left:
            for k, group in enumerate(self.groups):
                if len(left[k]) != len(group.numbers):
                    continue
                for j, names in enumerate(left):
                    rest = [name for name in names if name not in left[k]]
                    if j != k and len(rest) >= len(self.groups[j].numbers):
                        left[j] = rest
        for k, names in enumerate(left):  # "one brush ... another brush": the same objects fit several groups, one each
            one = self.groups[k].first
            alike = [j for j, others in enumerate(left) if others == names and _are_alike(one, self.groups[j].first)]
            if len(alike) > 1 and sum(len(self.groups[j].numbers) for j in alike) == len(names):
                each = iter(names)
                for j in alike:
                    left[j] = [next(each) for _ in self.groups[j].numbers]
        return left


def _is_pair(category: str) -> bool:
    """Whether the name of a category is a plural, such as scissors."""
    return is_plural(category.replace("_", " "))


def _is_said(word: str, said: Set[str]) -> bool:
    """Whether a text has a word of a description, or one with the same beginning: ``chocolatey`` for ``chocolate``."""
    if len(word) < _TOLD_APART:
        return len(word) > 2 and word in said
    return any(other == word or (len(other) >= _TOLD_APART and other.startswith(word)) for other in said)


def _are_alike(one: MentionedObject, other: MentionedObject) -> bool:
    return (one.words, one.change) == (other.words, other.change)


_BESIDE_LINE = 0.08  # metres from the line between two objects to what is between them
_NEAR = 0.15  # metres between the outlines of objects that are near each other


def gap_between(one: SceneObject, other: SceneObject) -> float:
    """Returns the distance of two boxes seen from above without their yaw, metres; 0 if they overlap."""
    apart = np.abs(np.subtract(one.position[:2], other.position[:2])) - np.add(one.size[:2], other.size[:2]) / 2
    return float(np.hypot(*np.maximum(apart, 0.0)))
