"""Reads the relations that an instruction states about its initial scene.

``take the jar out of the cup`` states that the jar is in the cup; ``put the jar into the cup`` states nothing about its place.
First :func:`number_mentions` replaces types and names of objects by numbers; the relations are between numbers.
"""

import re
from collections.abc import Iterator, Sequence
from dataclasses import dataclass

from stable_data.instructions.naming import ObjectMention
from stable_data.instructions.wording.vocabulary import nouns_of
from stable_data.instructions.wording.words import type_words
from stable_data.scene import RelationKind

OUTERMOST = {"leftmost": 1, "rightmost": -1}
"""Words for an outermost object, with the sign that makes its x the smallest."""

_LIST = r"(?P<a><\d+>(?:(?:, and |, | and )<\d+>)*)"
_B = r"(?P<b><\d+>)"
_PLACING = (
    r"\b(?:put|place|set|lay|drop|stack|insert|collect|gather|arrange|pile|store|load|move|bring|slide|push|hang|lean|rest"
    r"|carry|transfer|shift|nudge|serve|return|want|belongs?|goes|go)\b"
)
_TAKING = r"(?<!-)\b(?:pick|take|grab|grasp|lift|get|fetch|hand|give|pass|remove|use|press|open|close|leave|keep)\b"
_WISH = r"\b(?:so that|so|until|make sure|ensure)(?: that)? (?:(?:the|an?) (?:[\w-]+ ){0,3})?$"
_FILLING = r"\b(?:fill|pour)\b[^.;]*$"
_PARTING = r"\b(?:separate|part|tell) $"
_PART_OF_IT = r"\b(?:drops?|bit) of $"
_INSTEAD_OF = r"\binstead of (?:<\d+>(?:, and |, | and ))*$"
_SPOTS = {
    "in": RelationKind.IN,
    "inside": RelationKind.IN,
    "on": RelationKind.ON,
    "on top of": RelationKind.ON,
    "left of": RelationKind.LEFT_OF,
    "right of": RelationKind.RIGHT_OF,
    "in front of": RelationKind.IN_FRONT_OF,
    "behind": RelationKind.BEHIND,
}
_SPOT = r"(?P<spot>inside|on top of|in front of|behind|(?:to the |on the )?(?:left|right)(?: side)? of|in|on)"
_BE = (
    r"(?:,? (?:which|that))? ?(?:is|are|sits?|rests?|lies|stands?|sitting|resting|lying|standing|placed|kept)"
    r"(?: currently| now| in the way)?"
)
_WITHIN = r"(?: of| inside| within| the top of)? "
_TAKE = r"(?:removing|taking|lifting|picking)"

_AWAY = re.compile(rf"{_LIST}(?: up| gently| carefully)?(?P<gone> away)?,? (?P<how>out of|off|from){_WITHIN}{_B}")
_AWAY_IT = re.compile(rf"{_B}[^.;<]* (?:by|after) {_TAKE} {_LIST}(?: up)? (?P<how>out of|off|from) it\b")
_IT_AWAY = re.compile(rf"{_LIST}\. (?:take|get|lift|remove) (?:it|them) (?P<how>out of|off|from) {_B}")
_OUT = re.compile(rf"(?:reach into|empty) {_B} (?:and|by) (?:take|get|taking|getting) out {_LIST}")
_TAKEN_OFF = re.compile(rf"{_B}\. (?:take|get|lift|remove) {_LIST} (?P<how>out|off)\b(?! of)")
_INSTEAD = re.compile(rf"{_B} should (?P<how>hold|carry) [^.;]*? instead of {_LIST}")
_NO_MORE = re.compile(rf"{_B} should (?:not|no longer) (?P<how>hold|carry) {_LIST}")
_ILL_PLACED = re.compile(rf"{_LIST} do(?:es)? not belong (?P<spot>in|on) {_B}")
_BEFORE = re.compile(rf"in front of {_B} by (?:moving|pushing|taking) {_LIST}")
_STATED = re.compile(rf"{_LIST}(?P<be>{_BE}) {_SPOT} {_B}")
_NOUN = re.compile(rf"{_LIST} {_SPOT} {_B}")
_SINGLED_OUT = re.compile(rf"{_LIST},? (?:which|that) (?:is|are) {_SPOT} $")
_ALSO = re.compile(rf",? (?:(?:and )?(?:is |are )?also|and(?: is| are)?) {_SPOT} {_B}")
"""A further place after the first: ``is left of the cup and behind the plate``, ``in the bowl is also in the mug``."""

_EMPTIED = re.compile(
    r"\b(?:(?:everything|nothing)(?: that is| should be)? (?:in|on|out of|off|from)|empty|clear(?: out)?) <(\d+)>(?! away)"
    r"|<(\d+)> empty\b|<(\d+)>(?: that (?:is|are|lies|sits|stands) [^.;,]*)?\. take (?:what lies on top off|everything off)"
)
_ALL = re.compile(r"\b(?:everything|nothing|whatever|what|empty|clear)\b", re.IGNORECASE)
"""Words for objects that an instruction does not name; each match of :data:`_EMPTIED` contains one of them."""

_LEFT = {
    "out of": RelationKind.IN,
    "out": RelationKind.IN,
    "hold": RelationKind.IN,
    "off": RelationKind.ON,
    "carry": RelationKind.ON,
}


@dataclass(frozen=True, slots=True)
class StatedRelation:
    """A relation of the initial scene: number ``a`` is ``kind`` of number ``b``. A kind of None means in or on."""

    a: int
    kind: RelationKind | None
    b: int


def number_mentions(text: str, types: Sequence[str], mentioned: Sequence[ObjectMention] = (), pins: Sequence[str] = ()) -> str:
    """Returns the instruction in lower case, with each mention and its articles replaced by ``<number>``.

    Args:
        text: The instruction.
        types: Types of objects; the number of a type is its index. The longest are replaced first.
        mentioned: Mentions of single objects; they are replaced before the types.
        pins: The objects of these mentions; their numbers follow the numbers of the types.
    """
    marked = text.lower()
    for m in reversed(mentioned):
        marked = f"{marked[: m.start]}<{len(types) + pins.index(m.instance)}>{marked[m.end :]}"
    lead = rf"(?:\b(?:the|a|an|both|all|each|{'|'.join(OUTERMOST)}) )*"
    for index in sorted(range(len(types)), key=lambda k: -len(" ".join(type_words(types[k])))):
        if spelt := spelling(types[index]):
            marked = re.sub(rf"{lead}\b{spelt}(?:e?s)?\b(?!>)", f"<{index}>", marked)
    return marked


def nouns_in(text: str, category: str) -> tuple[str, ...]:
    """Returns the nouns by which an instruction mentions a category, its own words first."""
    return tuple(n for n in nouns_of(category) if "<0>" in number_mentions(text.replace("<", " "), (n,)))


def mentions_all(text: str) -> bool:
    """Whether an instruction may mention objects by their place alone: ``everything``, ``clear the tray``."""
    return bool(_ALL.search(text))


def spelling(name: str) -> str:
    """Returns a regular expression for a type in an instruction."""
    return "[ _-]".join(re.escape(word) for word in type_words(name))


def read_claims(marked: str) -> tuple[StatedRelation, ...]:
    """Returns the relations that a numbered instruction states about its initial scene, each once."""
    found = [*_taken(marked), *_stated(marked)]
    found += [c for m in _BEFORE.finditer(marked) for c in _pairs(m, RelationKind.IN_FRONT_OF)]
    return tuple(dict.fromkeys(found))


def _taken(marked: str) -> Iterator[StatedRelation]:
    """Relations in phrases of removal."""
    for match in _AWAY.finditer(marked):
        before = marked[: match.start()]
        is_other = match["gone"] or any(re.search(words, before) for words in (_FILLING, _PARTING, _PART_OF_IT))
        if match["how"] == "from" and is_other:
            continue  # "move a away from b", "fill a from b", "separate a from b", "get a drop of a from b" do not state the place of a
        # In "lift a that is left of c off b" the removed object is a.
        subjects = _SINGLED_OUT.search(before) or match
        yield from _claims(_numbers(subjects), _LEFT.get(match["how"]), match)
    for pattern in (_AWAY_IT, _IT_AWAY, _TAKEN_OFF, _INSTEAD, _NO_MORE):
        for match in pattern.finditer(marked):
            if pattern is _TAKEN_OFF and re.search(_INSTEAD_OF, marked[: match.start()]):
                continue  # in "instead of b. Take it out" the removed object is b
            yield from _pairs(match, _LEFT.get(match["how"]))
    for match in _OUT.finditer(marked):
        yield from _pairs(match, RelationKind.IN)


def _stated(marked: str) -> Iterator[StatedRelation]:
    """Relations in phrases of location."""
    for match in _ILL_PLACED.finditer(marked):
        yield from _pairs(match, _SPOTS[match["spot"]])
    for pattern in (_STATED, _NOUN):
        for match in pattern.finditer(marked):
            before = re.split(r"[.;:]", marked[: match.start()])[-1]
            verbs = re.findall(f"{_PLACING}|{_TAKING}", before) if pattern is _NOUN else []
            # "Put a on b" gives the target of a, "pick up a on b" its place: the last verb decides.
            if re.search(_WISH, before) or (verbs and re.fullmatch(_PLACING, verbs[-1])):
                continue
            subjects = _numbers(match)
            # "A, b and c standing on d" states the place of c alone, "a, b and c stand on d" of all.
            if pattern is _STATED and re.match(r",? ?(?:which|that|\w+ing|placed|kept)\b", match["be"]):
                subjects = subjects[-1:]
            where: re.Match[str] | None = match
            while where is not None:
                yield from _claims(subjects, _spot(where), where)
                where = _ALSO.match(marked, where.end())


def _spot(match: re.Match[str]) -> RelationKind:
    return _SPOTS[re.sub(r"^(?:to|on) the | side", "", match["spot"])]


def _pairs(match: re.Match[str], kind: RelationKind | None) -> Iterator[StatedRelation]:
    return _claims(_numbers(match), kind, match)


def _numbers(match: re.Match[str]) -> list[int]:
    return [int(a) for a in re.findall(r"\d+", match["a"])]


def _claims(subjects: Sequence[int], kind: RelationKind | None, match: re.Match[str]) -> Iterator[StatedRelation]:
    target = int(match["b"][1:-1])
    return (StatedRelation(a, kind, target) for a in subjects if a != target)


def emptied_numbers(marked: str) -> tuple[int, ...]:
    """Returns the numbers of the objects that a numbered instruction asks to empty or clear."""
    return tuple(int(next(filter(None, groups))) for groups in _EMPTIED.findall(marked))
