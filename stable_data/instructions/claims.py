"""What an instruction says of the scene it starts from, read from its words.

``take the jar out of the cup`` says that the jar is in the cup; ``put the jar into the cup`` says nothing of where it is.
Types, and objects that the words single out, are replaced by numbers first (:func:`number_mentions`); claims are about numbers.
"""

import re
from collections.abc import Iterator, Sequence
from dataclasses import dataclass

from stable_data.instructions.naming import ObjectMention
from stable_data.instructions.wording.vocabulary import nouns_of
from stable_data.instructions.wording.words import type_words
from stable_data.scene import RelationKind

OUTERMOST = {"leftmost": 1, "rightmost": -1}
"""Words for the one of several that is farthest out, with the sign of x that is least there."""

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
"""Goes on after where a thing is with where it is besides: ``is left of the cup and behind the plate``, ``in the bowl is also in
the mug``."""

_EMPTIED = re.compile(
    r"\b(?:(?:everything|nothing)(?: that is| should be)? (?:in|on|out of|off|from)|empty|clear(?: out)?) <(\d+)>(?! away)"
    r"|<(\d+)> empty\b|<(\d+)>(?: that (?:is|are|lies|sits|stands) [^.;,]*)?\. take (?:what lies on top off|everything off)"
)
_ALL = re.compile(r"\b(?:everything|nothing|whatever|what|empty|clear)\b", re.IGNORECASE)
"""Words with which an instruction can speak of what it does not name; what :data:`_EMPTIED` reads has one of them."""

_LEFT = {
    "out of": RelationKind.IN,
    "out": RelationKind.IN,
    "hold": RelationKind.IN,
    "off": RelationKind.ON,
    "carry": RelationKind.ON,
}


@dataclass(frozen=True, slots=True)
class StatedRelation:
    """What an instruction says of the start: number ``a`` is ``kind`` of ``b``; None: in it or on it, the words leave open which."""

    a: int
    kind: RelationKind | None
    b: int


def number_mentions(text: str, types: Sequence[str], said: Sequence[ObjectMention] = (), pins: Sequence[str] = ()) -> str:
    """The instruction in lower case, what it mentions as ``<number>``, articles gone.

    Args:
        text: The instruction.
        types: Each has its index as its number; the longest are looked for first.
        said: Words that single objects out; they go before the types.
        pins: The objects; their numbers come after those of the types.
    """
    marked = text.lower()
    for m in reversed(said):
        marked = f"{marked[: m.start]}<{len(types) + pins.index(m.instance)}>{marked[m.end :]}"
    lead = rf"(?:\b(?:the|a|an|both|all|each|{'|'.join(OUTERMOST)}) )*"
    for index in sorted(range(len(types)), key=lambda k: -len(" ".join(type_words(types[k])))):
        if spelt := spelling(types[index]):
            marked = re.sub(rf"{lead}\b{spelt}(?:e?s)?\b(?!>)", f"<{index}>", marked)
    return marked


def is_named(category: str, text: str) -> bool:
    """Does an instruction speak of such a thing, by any of its names?"""
    return any("<0>" in number_mentions(text.replace("<", " "), (noun,)) for noun in nouns_of(category))


def mentions_all(text: str) -> bool:
    """Could an instruction speak of things by their place alone: ``everything``, ``whatever is in there``, ``clear the tray``?"""
    return bool(_ALL.search(text))


def spelling(name: str) -> str:
    """A pattern for a type in an instruction."""
    return "[ _-]".join(re.escape(word) for word in type_words(name))


def read_claims(marked: str) -> tuple[StatedRelation, ...]:
    """What a marked instruction says of the scene it starts from, each claim once."""
    found = [*_taken(marked), *_stated(marked)]
    found += [c for m in _BEFORE.finditer(marked) for c in _pairs(m, RelationKind.IN_FRONT_OF)]
    return tuple(dict.fromkeys(found))


def _taken(marked: str) -> Iterator[StatedRelation]:
    """Claims in words of taking away."""
    for match in _AWAY.finditer(marked):
        before = marked[: match.start()]
        is_other = match["gone"] or any(re.search(words, before) for words in (_FILLING, _PARTING, _PART_OF_IT))
        if match["how"] == "from" and is_other:
            continue  # "move a away from b", "fill a from b", "separate a from b", "get a drop of a from b" do not say where a is
        # "Lift a that is left of c off b" says it of a.
        meant = _SINGLED_OUT.search(before) or match
        yield from _claims([int(a) for a in re.findall(r"\d+", meant["a"])], _left(match), match)
    for pattern in (_AWAY_IT, _IT_AWAY, _TAKEN_OFF, _INSTEAD, _NO_MORE):
        for match in pattern.finditer(marked):
            if pattern is _TAKEN_OFF and re.search(_INSTEAD_OF, marked[: match.start()]):
                continue  # "instead of b. Take it out" speaks of b itself
            yield from _pairs(match, _left(match))
    for match in _OUT.finditer(marked):
        yield from _pairs(match, RelationKind.IN)


def _left(match: re.Match[str]) -> RelationKind | None:
    return _LEFT.get(match["how"])


def _stated(marked: str) -> Iterator[StatedRelation]:
    """Claims in words of being somewhere."""
    for match in _ILL_PLACED.finditer(marked):
        yield from _pairs(match, _SPOTS[match["spot"]])
    for pattern in (_STATED, _NOUN):
        for match in pattern.finditer(marked):
            before = re.split(r"[.;:]", marked[: match.start()])[-1]
            verbs = re.findall(f"{_PLACING}|{_TAKING}", before) if pattern is _NOUN else []
            # "Put a on b" says where a shall be, "pick up a on b" where it is: the last verb tells.
            if re.search(_WISH, before) or (verbs and re.fullmatch(_PLACING, verbs[-1])):
                continue
            things = [int(a) for a in re.findall(r"\d+", match["a"])]
            # "A, b and c standing on d" says it of c alone, "a, b and c stand on d" of all.
            if pattern is _STATED and re.match(r",? ?(?:which|that|\w+ing|placed|kept)\b", match["be"]):
                things = things[-1:]
            where: re.Match[str] | None = match
            while where is not None:
                yield from _claims(things, _spot(where), where)
                where = _ALSO.match(marked, where.end())


def _spot(match: re.Match[str]) -> RelationKind:
    return _SPOTS[re.sub(r"^(?:to|on) the | side", "", match["spot"])]


def _pairs(match: re.Match[str], kind: RelationKind | None) -> Iterator[StatedRelation]:
    return _claims([int(a) for a in re.findall(r"\d+", match["a"])], kind, match)


def _claims(things: Sequence[int], kind: RelationKind | None, match: re.Match[str]) -> Iterator[StatedRelation]:
    """What a match says of some things."""
    target = int(match["b"][1:-1])
    return (StatedRelation(a, kind, target) for a in things if a != target)


def emptied_numbers(marked: str) -> tuple[int, ...]:
    """The numbers of what a marked instruction wants emptied or cleared, whatever is in or on it."""
    return tuple(int(next(filter(None, groups))) for groups in _EMPTIED.findall(marked))
