"""Names of objects: words that are true of one object and of no other object in the scene that matches its noun.

The noun suffices if only one object matches it. Several matching objects are distinguished by colour, material, pattern or
shape (if the descriptions of all of them give it), by size, by position in a row, by the corner of the table, or by an object
that they are in, on or next to. A search for the same words in an instruction finds the objects that it mentions.
"""

import math
import re
from collections.abc import Callable, Collection, Iterator, Mapping
from dataclasses import dataclass
from enum import StrEnum

import numpy as np

from stable_data.instructions.situation import OPPOSITE, SIDES
from stable_data.instructions.wording.vocabulary import answers_to, nouns_of
from stable_data.instructions.wording.words import is_plural, type_words
from stable_data.scene import TABLE, FloatArray, Relation, RelationKind, Scene
from stable_data.scene_graph.relations import SceneGraph


class Distinction(StrEnum):
    """What distinguishes an object from the others that match its noun."""

    NOUN = "noun"
    SYNONYM = "synonym"
    LOOK = "look"
    SIZE = "size"
    PLACE = "place"
    CARRIER = "carrier"
    SIDE = "side"
    BESIDE = "beside"
    CELL = "cell"
    LINK = "link"


WEIGHTS = {
    Distinction.NOUN: 8.0,
    Distinction.SYNONYM: 3.0,
    Distinction.LOOK: 3.0,
    Distinction.SIZE: 3.0,
    Distinction.PLACE: 3.0,
    Distinction.CARRIER: 1.5,
    Distinction.SIDE: 1.0,
    Distinction.BESIDE: 1.0,
    Distinction.CELL: 1.0,
    Distinction.LINK: 4.0,
}
"""Relative probability of each distinction among those that an object has."""

_LASTING = frozenset({Distinction.NOUN, Distinction.SYNONYM, Distinction.LOOK, Distinction.SIZE})

_LOOKS = (
    {  # similar colours share a value: "the blue mug" is not a name beside a navy mug
        **dict.fromkeys(("white", "cream", "ivory"), "white"),
        **dict.fromkeys(("grey", "gray", "silver"), "grey"),
        **dict.fromkeys(("black",), "black"),
        **dict.fromkeys(("brown", "beige", "tan", "walnut", "oak"), "brown"),
        **dict.fromkeys(("red", "crimson", "maroon", "terracotta"), "red"),
        **dict.fromkeys(("orange", "amber", "copper"), "orange"),
        **dict.fromkeys(("yellow", "gold", "golden"), "yellow"),
        **dict.fromkeys(("green", "olive", "teal", "turquoise"), "green"),
        **dict.fromkeys(("blue", "navy"), "blue"),
        **dict.fromkeys(("purple", "violet", "lilac"), "purple"),
        **dict.fromkeys(("pink",), "pink"),
    },
    {w: w for w in ("wooden", "ceramic", "porcelain", "metal", "plastic", "leather", "cardboard", "wicker", "steel", "bamboo")},
    {w: w for w in ("striped", "spotted", "plain", "floral", "checkered", "patterned")},
    {w: w for w in ("round", "square", "oval", "rectangular", "cylindrical", "hexagonal")},
)
LOOK_WORDS = frozenset(word for kind in _LOOKS for word in kind)
"""Words for the colour, material, pattern or shape by which an object may be named."""


def shows_look(description: str, look: str) -> bool | None:
    """Returns whether a description has a look.

    Args:
        description: Words of an object, such as ``a white mug with a blue rim``.
        look: A word of :data:`LOOK_WORDS`; similar colours are equal.

    Returns:
        True if the description has the look, False if it only has others of the same kind, None if it has none of that kind.
    """
    words, answers = re.findall(r"[a-z]+", description.lower()), []
    for values in _LOOKS:
        if look in values:
            found = {values[word] for word in words if word in values}
            answers.append(values[look] in found if found else None)
    return True if True in answers else False if False in answers else None


_SHADES = frozenset({"light", "dark", "pale", "bright", "deep"})
_SIZE_WORDS = frozenset(
    ("small", "large", "big", "tall", "short", "tiny", "mini", "medium", "long", "wide", "narrow", "extra", "little")
)

_APART = 0.025  # least distance of an outermost object from the next, metres
_LARGER = 1.5  # least ratio of the largest volume to the next
_TALLER = 1.25  # least ratio of the largest height to the next
_NEAR, _FAR = 0.05, 0.15  # an object "next to" an anchor is nearer than _NEAR, the others of its kind are beyond _FAR, metres

# Axis, sign, names of one of two objects, names of one of more.
_PLACES = (
    (0, -1, ("the left-hand {}", "the {} that {} on the left"), ("the leftmost {}", "the {} that {} farthest to the left")),
    (0, 1, ("the right-hand {}", "the {} that {} on the right"), ("the rightmost {}", "the {} that {} farthest to the right")),
    (1, -1, ("the nearer {}", "the {} that {} closer to me"), ("the nearest {}", "the {} that {} closest to the front edge")),
    (1, 1, ("the farther {}", "the {} that {} farther back"), ("the farthest {}", "the {} that {} farthest back")),
)
SIDE_WORDS = {
    RelationKind.LEFT_OF: "to the left of",
    RelationKind.RIGHT_OF: "to the right of",
    RelationKind.IN_FRONT_OF: "in front of",
    RelationKind.BEHIND: "behind",
}
"""Words for each direction."""


@dataclass(frozen=True, slots=True)
class ObjectName:
    """Words for one object.

    Attributes:
        words: The name with its article, such as ``the leftmost mug``.
        noun: Its noun.
        distinction: What distinguishes the object.
        anchor: Another object that the name contains.
        relation: The relation that the name states, as the edge of the scene graph.
    """

    words: str
    noun: str
    distinction: Distinction
    anchor: str | None = None
    relation: Relation | None = None

    @property
    def is_short(self) -> bool:
        """Whether the name ends with its noun, so that a particle can follow."""
        return self.words.endswith(self.noun)

    @property
    def is_lasting(self) -> bool:
        """Whether the name stays true after objects are moved."""
        return self.distinction in _LASTING


class ObjectNamer:
    """Finds names of the objects of a scene with its scene graph."""

    def __init__(self, scene: Scene, graph: SceneGraph) -> None:
        self.scene, self.graph = scene, graph
        self.objects = {o.instance: o for o in scene.objects}
        self._centre = {o.instance: np.array(o.position) for o in scene.objects}
        self._matching: dict[str, tuple[str, ...]] = {}
        self._names: dict[str, tuple[ObjectName, ...]] = {}

    def matching(self, noun: str) -> tuple[str, ...]:
        """Returns all objects of the scene that match a noun."""
        if noun not in self._matching:
            self._matching[noun] = tuple(o.instance for o in self.scene.objects if answers_to(o.category, noun))
        return self._matching[noun]

    def own_noun(self, instance: str) -> str:
        """Returns the category of an object in words; empty if it has none."""
        return " ".join(type_words(self.objects[instance].category))

    def is_unique(self, instance: str) -> bool:
        """Whether no other object matches its noun."""
        return self.matching(self.own_noun(instance)) == (instance,)

    def names(self, instance: str) -> tuple[ObjectName, ...]:
        """Returns all names of an object, possibly none."""
        if instance not in self._names:
            nouns = nouns_of(self.objects[instance].category)
            self._names[instance] = tuple(name for noun in nouns for name in self._names_with(instance, noun, noun == nouns[0]))
        return self._names[instance]

    def linked_names(self, instance: str, place: str) -> tuple[ObjectName, ...]:
        """Returns the noun if it is unique among the objects in or on ``place``, for a text that states the place; else nothing."""
        noun = self.own_noun(instance)
        others = [n for n in self.matching(noun) if n != instance]
        if not noun or place in others or any(self._is_in_or_on(n, place) for n in others):
            return ()
        return (ObjectName(f"the {noun}", noun, Distinction.LINK),)

    def _is_in_or_on(self, instance: str, place: str) -> bool:
        return any(self.graph.has_edge(instance, place, key=k) for k in (RelationKind.IN, RelationKind.ON))

    def _names_with(self, instance: str, noun: str, is_own: bool) -> Iterator[ObjectName]:
        alike = [n for n in self.matching(noun) if n != instance]
        if not alike:
            yield ObjectName(f"the {noun}", noun, Distinction.NOUN if is_own else Distinction.SYNONYM)
        for look in self._looks(instance, noun, alike):
            yield ObjectName(f"the {look} {noun}", noun, Distinction.LOOK)
        if alike:
            yield from (ObjectName(words, noun, Distinction.SIZE) for words in self._sizes(instance, noun, alike))
            yield from (ObjectName(words, noun, Distinction.PLACE) for words in self._places(instance, noun, alike))
        if is_own:
            yield from self._by_anchor(instance, noun, alike)
            yield from self._by_cell(instance, noun, alike)

    def _looks(self, instance: str, noun: str, alike: list[str]) -> Iterator[str]:
        for values in _LOOKS if not _SIZE_WORDS & set(noun.split(" ")) else ():  # "the red large pot" has the wrong word order
            own = self._look(instance, noun, values)
            if own is not None and all(self._looks_different(n, noun, values, own) for n in alike):
                yield own

    def _looks_different(self, instance: str, noun: str, values: Mapping[str, str], look: str) -> bool:
        """Whether the look of the object is known and differs."""
        own = self._look(instance, noun, values)
        return own is not None and values[own.split(" ")[-1]] != values[look.split(" ")[-1]]

    def _look(self, instance: str, noun: str, values: Mapping[str, str]) -> str | None:
        """The word of ``values`` in the head of its description, with its shade; None if there is not exactly one."""
        if not self.objects[instance].description:
            return None
        head = re.split(r"[,;.(]|\b(?:with|of|for|on|in|and|that|which|holding)\b", self.objects[instance].description.lower())[
            0
        ]
        words = re.findall(r"[a-z]+", head)
        found = [k for k, word in enumerate(words) if word in values and word not in noun.split(" ")]
        if len(found) != 1:
            return None
        k = found[0]
        return f"{words[k - 1]} {words[k]}" if k and words[k - 1] in _SHADES else words[k]

    def _sizes(self, instance: str, noun: str, alike: list[str]) -> Iterator[str]:
        if _SIZE_WORDS & set(noun.split(" ")):
            return
        size, others = np.array(self.objects[instance].size), np.array([self.objects[n].size for n in alike])
        more = len(alike) > 1
        volume, volumes = float(np.prod(size)), np.prod(others, axis=1)
        longest, lengths = size.max(), others.max(axis=1)
        if volume > _LARGER * volumes.max() and longest > lengths.max():
            yield from (f"the {word} {noun}" for word in (("largest", "biggest") if more else ("larger", "bigger")))
        if volume * _LARGER < volumes.min() and longest < lengths.min():
            yield f"the {'smallest' if more else 'smaller'} {noun}"
        is_upright = min(size[2] / longest, (others[:, 2] / lengths).min()) > 0.99
        if is_upright and size[2] > _TALLER * others[:, 2].max():
            yield f"the {'tallest' if more else 'taller'} {noun}"
        if is_upright and size[2] * _TALLER < others[:, 2].min():
            yield f"the {'shortest' if more else 'shorter'} {noun}"

    def _places(self, instance: str, noun: str, alike: list[str]) -> Iterator[str]:
        own, others = self._centre[instance], np.array([self._centre[n] for n in alike])
        for axis, sign, of_two, of_more in _PLACES:
            outer = sign * own[axis] > (sign * others[:, axis]).max() + _APART
            if outer and (axis == 0 or self._is_outer_for_viewer(own, others, sign)):
                yield from (words.format(noun, _verb(noun)) for words in (of_more if len(alike) > 1 else of_two))
        row = sorted([*alike, instance], key=lambda n: self._centre[n][0])
        if len(row) == 3 and row[1] == instance:
            places = np.array([self._centre[n] for n in row])
            if np.diff(places[:, 0]).min() > max(2 * _APART, np.ptp(places[:, 1])):
                yield f"the middle {noun}"

    def _is_outer_for_viewer(self, own: FloatArray, others: FloatArray, sign: int) -> bool:
        """Whether it is also outermost by distance from a viewer at the middle of the front edge."""
        viewer = np.array([self.scene.table.size_xy[0] / 2, 0.0])
        reach = np.linalg.norm(others[:, :2] - viewer, axis=1)
        return bool(sign * np.linalg.norm(own[:2] - viewer) > (sign * reach).max())

    def _by_anchor(self, instance: str, noun: str, alike: list[str]) -> Iterator[ObjectName]:
        for anchor in sorted({*self.graph.successors(instance), *self.graph.predecessors(instance)} - {TABLE}):
            if anchor in alike or not self.is_unique(anchor) or self._is_in_or_on(anchor, instance):
                continue
            place = f"the {self.own_noun(anchor)}"
            for kind, verb in ((RelationKind.IN, "lying"), (RelationKind.ON, "resting")):
                if self.graph.has_edge(instance, anchor, key=kind) and not any(self._is_in_or_on(n, anchor) for n in alike):
                    relation = Relation(instance, kind, anchor)
                    for words in (f"the {noun} that {_verb(noun)} {kind} {place}", f"the {noun} {verb} {kind} {place}"):
                        yield ObjectName(words, noun, Distinction.CARRIER, anchor, relation)
            if alike:
                yield from self._by_side(instance, noun, alike, anchor)

    def _by_side(self, instance: str, noun: str, alike: list[str], anchor: str) -> Iterator[ObjectName]:
        place = f"the {self.own_noun(anchor)}"
        for kind, (axis, sign) in SIDES.items():
            relation = holds_relation(self.graph, instance, kind, anchor)
            others = (sign * (self._centre[n][axis] - self._centre[anchor][axis]) for n in alike)
            if relation is not None and all(step < -_APART for step in others):
                for words in (f"that {_verb(noun)}", "standing"):
                    yield ObjectName(f"the {noun} {words} {SIDE_WORDS[kind]} {place}", noun, Distinction.SIDE, anchor, relation)
        if self._gap(instance, anchor, min) <= _NEAR and all(self._gap(n, anchor, math.hypot) >= _FAR for n in alike):
            yield ObjectName(f"the {noun} that {_verb(noun)} next to {place}", noun, Distinction.BESIDE, anchor)

    def _gap(self, one: str, other: str, breadth: Callable[[float, float], float]) -> float:
        """Distance of the circles inside two boxes (``breadth`` is ``min``) or around them (``hypot``), metres."""
        widths = breadth(*self.objects[one].size[:2]) + breadth(*self.objects[other].size[:2])
        return float(np.linalg.norm(self._centre[one][:2] - self._centre[other][:2])) - widths / 2

    def _by_cell(self, instance: str, noun: str, alike: list[str]) -> Iterator[ObjectName]:
        cells = {n: self.graph.nodes[n]["cell"] for n in (instance, *alike)}
        row, column = cells[instance].split("_")
        if alike and "middle" not in (row, column) and all(cells[n] != cells[instance] for n in alike):
            relation = Relation(instance, RelationKind.IS_AT, cells[instance])
            yield ObjectName(
                f"the {noun} that {_verb(noun)} in the {row} {column} corner", noun, Distinction.CELL, None, relation
            )


def _verb(noun: str) -> str:
    return "are" if is_plural(noun) else "is"


def holds_relation(graph: SceneGraph, subject: str, kind: RelationKind, target: str) -> Relation | None:
    """Returns the edge of a scene graph for a relation or for its inverse; None if the graph has neither."""
    if graph.has_edge(subject, target, key=kind):
        return Relation(subject, kind, target)
    if kind in OPPOSITE and graph.has_edge(target, subject, key=OPPOSITE[kind]):
        return Relation(target, OPPOSITE[kind], subject)
    return None


@dataclass(frozen=True, slots=True)
class ObjectMention:
    """A name of an object in an instruction.

    Attributes:
        start: Index of its first character.
        end: Index after its last character.
        instance: The object.
        name: Its name.
    """

    start: int
    end: int
    instance: str
    name: ObjectName


def mentions(text: str, namer: ObjectNamer) -> tuple[ObjectMention, ...]:
    """Finds the names of objects in an instruction, in the order of the text; the longest of overlapping names is used.

    Args:
        text: The instruction.
        namer: The names of its initial scene.
    """
    lower = text.lower()
    found: list[ObjectMention] = []
    for instance, o in namer.objects.items():
        if any(noun in lower for noun in nouns_of(o.category)):
            for name in namer.names(instance):
                spans = (m.span() for m in re.finditer(rf"\b{re.escape(name.words)}\b", lower) if name.words in lower)
                found += [ObjectMention(start, end, instance, name) for start, end in spans]
    chosen: list[ObjectMention] = []
    for one in sorted(found, key=lambda m: (m.start - m.end, m.start)):
        if all(one.end <= other.start or one.start >= other.end for other in chosen):
            chosen.append(one)
    return tuple(sorted(chosen, key=lambda m: m.start))


def involved_instances(names: Collection[ObjectName]) -> tuple[str, ...]:
    """Returns the anchors of names, each once."""
    return tuple(dict.fromkeys(name.anchor for name in names if name.anchor is not None))
