"""Finds the objects of a layout that an instruction mentions: by category, adjectives, place, relations and superlatives."""

import re
from collections.abc import Callable, Iterable, Mapping, Sequence, Set
from dataclasses import dataclass, replace
from functools import cached_property
from math import inf

import numpy as np

from models.instruction_reader.lexicon import Lexicon
from models.instruction_reader.reading import InstructionReading, MentionedObject, MentionedRelation
from models.instruction_reader.sentences import split_words
from stable_data.errors import SceneError
from stable_data.instructions.wording.vocabulary import closeness
from stable_data.instructions.wording.words import singular, type_words
from stable_data.scene import Relation, RelationKind, Scene, SceneObject, Tabletop
from stable_data.scene_graph.relations import cell_of, direction_of, is_held, relations_of, scene_graph

MISSING, AMBIGUOUS = "object_missing", "ambiguous"
"""Codes of the errors of this module."""

_ANY = frozenset({"a", "an", "any", "one", "some"})
"""Words before a mention of which any object may be meant."""

_ALL = frozenset({"all", "every", "each", "both"})

_ONE_OR_MANY = frozenset({"dice"})
"""Nouns whose plural may mean one object."""

_DEFINITE = frozenset({"the", "that", "this", "those", "these"})
"""Words before a mention of an object that must be there."""

_OWN = frozenset({"my", "our", "your", "his", "her", "their"})
"""Words before a mention of an object that is probably there."""

_COLLECTIONS = frozenset({"stack", "pile", "row", "line", "heap", "bunch", "set", "group"})
"""Nouns before ``of`` and all objects of a kind."""

_LETTERS = 4  # of a word that is looked for in descriptions

_NEW = frozenset({"replace", "style"})  # kinds of relations whose subject, or whose target, is not in the layout

_EXTREMES: Mapping[str, Callable[[SceneObject], float]] = {
    **dict.fromkeys(("left", "leftmost"), lambda o: o.position[0]),
    **dict.fromkeys(("right", "rightmost"), lambda o: -o.position[0]),
    **dict.fromkeys(("front", "nearest", "closest", "near"), lambda o: o.position[1]),
    **dict.fromkeys(("back", "rear", "furthest", "farthest", "far"), lambda o: -o.position[1]),
    **dict.fromkeys(("tall", "taller", "tallest", "high", "higher", "highest"), lambda o: -o.size[2]),
    **dict.fromkeys(("short", "shorter", "shortest", "lowest", "lower"), lambda o: o.size[2]),
    **dict.fromkeys(("big", "bigger", "biggest", "large", "larger", "largest"), lambda o: -float(np.prod(o.size))),
    **dict.fromkeys(("small", "smaller", "smallest", "little", "tiny"), lambda o: float(np.prod(o.size))),
    **dict.fromkeys(("top", "topmost", "upper", "uppermost"), lambda o: -o.position[2]),
    **dict.fromkeys(("bottom", "lowermost"), lambda o: o.position[2]),
}  # fmt: skip
"""What is least for the object that a word picks out of several."""


_PICKED_OUT = re.compile(
    r"(?:,? (?:that|which)(?: is|'s))?(?: lying| sitting| standing| resting)?"
    r"(?:(?: the)? (?:farthest|furthest|nearest|closest)(?: to| on| at)?(?: the)? (?P<side>left|right|front|back|me|away)\b"
    r"| (?:on|at)(?: the)?(?: very)? (?P<end>top|bottom)\b(?! of (?!(?:the|that|this) (?:pile|stack|heap))))"
)
"""Words after a mention that pick it out of several, with the side."""

_WITH = re.compile(r"\b(?:with|and)(?: its| the| their)?(?: own)?\s*$")
"""Words before a carrier that goes along with what is on it."""

_HANDED = re.compile(r"\b(left|right)[- ]hand\s*$")

_SIDE_WORDS = {"left": ({"left"}, {"right"}), "front": ({"front", "before"}, {"behind", "beyond", "back"})}
"""Words that state the relations ``left`` and ``front``, and words that state the same with its objects exchanged."""

_EXCHANGED = {"left": "right", "front": "behind"}

_ACROSS = re.compile(r"\b(?:other|opposite|far) side of\b")

_BEFORE = 2  # words before a mention that may be superlatives


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
        lexicon: The known nouns.
    """

    def __init__(
        self, text: str, reading: InstructionReading, layout: Sequence[SceneObject], table: Tabletop, lexicon: Lexicon
    ) -> None:
        self._text, self._reading, self._layout, self._table, self._lexicon = text, reading, layout, table, lexicon
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
        added = {k for k, o in enumerate(self._reading.objects) if o.change == "add" and not self._is_there(o)}
        for r in self._reading.goal:
            if r.kind in _NEW:
                added.add(r.subject if r.kind == "replace" else r.target)
            elif self._is_absent(mover := r.target if self._is_said_of_target(r) else r.subject):
                added.add(mover)
        return frozenset(added | {k for k, o in enumerate(self._reading.objects) if o.goal_region and self._is_absent(k)})

    def _is_absent(self, number: int) -> bool:
        """Whether an object has a place but is not in the layout, as in "a candle beside the mug": it comes."""
        one = self._reading.objects[number]
        return bool(one.categories) and not (self._of_category(one) or self._words_before(one) & _DEFINITE)

    def _is_there(self, one: MentionedObject) -> bool:
        """Whether an object that comes is one of the layout, as in "bring the jar nearer"."""
        return bool(self._words_before(one) & (_DEFINITE | _OWN) and self._of_category(one))

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
        if r.kind == "near" and r.subject not in self.new and _ACROSS.search(self._text.lower()):
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
        head, *rest = one.words.split()
        is_all = bool(before & _ALL) or (head in _COLLECTIONS and rest[:1] == ["of"])
        is_open = one.is_one_of_many or is_all or one.words.split()[-1] in _ONE_OR_MANY
        return MentionedGroup(numbers, one, is_open, bool(before & _ANY))

    def _fitting(self) -> list[list[str]]:
        """The instances that each group may mean, by all that is said of it."""
        fitting = [self._of_category(group.first) for group in self.groups]
        for k, group in enumerate(self.groups):
            fitting[k] = self._described(group, fitting[k])
            fitting[k] = self._in_region(group, fitting[k])
        for _ in self.groups:  # each round uses what the one before it found
            for k in range(len(self.groups)):
                fitting[k] = self._related(k, fitting)
        for k, group in enumerate(self.groups):
            fitting[k] = self._extreme(group, fitting[k])
        fitting = self._different(fitting)
        return [self._with_its_carrier(k, fitting) for k in range(len(self.groups))]

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
        """The instances of its categories, or else those with most of its words in their descriptions."""
        close = {o.instance: self._closeness(one, o) for o in self._layout}
        if not any(close.values()):
            words = set(singular(tuple(w for w in one.words.split() if len(w) >= _LETTERS)))
            close = {o.instance: _common_words(words, singular(tuple(split_words(o.description)))) for o in self._layout}
        best = max(close.values(), default=0)
        return [name for name, how in close.items() if how == best > 0]

    def _closeness(self, one: MentionedObject, o: SceneObject) -> int:
        """How well an object fits a mention; best if the mention says its category."""
        words, category = singular(tuple(one.words.split())), singular(type_words(o.category))
        size = self._lexicon.noun_size(one.words.split())
        if category and category == words[-len(category) :] and len(category) >= size:
            return 3
        if category and set(category) <= set(words) and set(self._lexicon.categories(category)) & set(one.categories):
            return 2  # the ketchup of a "ketchup bottle"
        return max((closeness(o.category, c) for c in one.categories), default=0)

    def _adjectives(self, one: MentionedObject) -> list[str]:
        """The words of a mention, and what is said of its place among others (``that is farthest to the left``)."""
        found = one.words.split()
        for start, end in one.mentions:
            before = split_words(self._text[:start])[-_BEFORE:]
            found += [word for word in before if word in _EXTREMES and word.endswith(("st", "er"))]
            if (m := _HANDED.search(self._text[:start].lower())) is not None:
                found.append(m[1])
            if (m := _PICKED_OUT.match(self._text[end:].lower())) is not None:
                side = m["side"] or m["end"]
                found.append({"me": "front", "away": "back"}.get(side, side))
        return found

    def _described(self, group: MentionedGroup, names: list[str]) -> list[str]:
        """The instances whose description has the adjectives of a mention, as far as any has them."""
        for word in self._adjectives(group.first):
            having = [name for name in names if word in split_words(self._objects[name].description)]
            names = having or names
        return names

    def _in_region(self, group: MentionedGroup, names: list[str]) -> list[str]:
        region = group.first.region
        if not region or len(names) <= len(group.numbers):
            return names
        inside = [name for name in names if cell_of(self._objects[name].position, self._table.size_xy) == region]
        if inside:
            return inside
        for word in region.split("_"):  # "the left one" is in no cell, but to the left of the others
            names = self._least(names, word, len(group.numbers))
        return names

    def _extreme(self, group: MentionedGroup, names: list[str]) -> list[str]:
        for word in self._adjectives(group.first):
            if len(names) > len(group.numbers):
                names = self._least(names, word, len(group.numbers))
        return names

    def _least(self, names: list[str], word: str, count: int) -> list[str]:
        key = _EXTREMES.get(word)
        return names if key is None else sorted(names, key=lambda name: key(self._objects[name]))[:count]

    def _related(self, k: int, fitting: Sequence[list[str]]) -> list[str]:
        """The instances of a group that have its stated relations to others, as far as any has them."""
        names = fitting[k]
        for r in self._reading.start:
            for one, other, is_subject in ((r.subject, r.target, True), (r.target, r.subject, False)):
                if self._group_of.get(one) != k or self._group_of.get(other, k) == k:
                    continue
                others = fitting[self._group_of[other]]
                holding = [
                    name
                    for name in names
                    if any(self._holds(r.kind, *((name, b) if is_subject else (b, name))) for b in others if b != name)
                ]
                names = holding or names
        return names

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


def _are_alike(one: MentionedObject, other: MentionedObject) -> bool:
    return (one.words, one.change) == (other.words, other.change)


def _common_words(words: Iterable[str], of_description: Sequence[str]) -> int:
    """The number of words that a description has, alone or as the end of a compound such as ``racquetball``."""
    return sum(any(other.endswith(word) for other in of_description) for word in words)


_NEAR = 0.15  # metres between the outlines of objects that are near each other


def gap_between(one: SceneObject, other: SceneObject) -> float:
    """Returns the distance of two boxes seen from above without their yaw, metres; 0 if they overlap."""
    apart = np.abs(np.subtract(one.position[:2], other.position[:2])) - np.add(one.size[:2], other.size[:2]) / 2
    return float(np.hypot(*np.maximum(apart, 0.0)))
