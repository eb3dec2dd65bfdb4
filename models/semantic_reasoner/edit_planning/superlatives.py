"""Words that pick one of several objects: "the taller candle", "the jar that is farthest to the left", "the middle bottle"."""

import re
from collections.abc import Callable, Iterator, Mapping, Sequence

import numpy as np

from models.instruction_reader.phrases import ADJECTIVES
from models.instruction_reader.sentences import split_words
from stable_data.scene import SceneObject

EXTREMES: Mapping[str, Callable[[SceneObject], float]] = {
    **dict.fromkeys(("left", "leftmost"), lambda o: o.position[0]),
    **dict.fromkeys(("right", "rightmost"), lambda o: -o.position[0]),
    **dict.fromkeys(("front", "nearest", "closest", "near", "nearer", "closer"), lambda o: o.position[1]),
    **dict.fromkeys(("back", "rear", "furthest", "farthest", "far", "further", "farther"), lambda o: -o.position[1]),
    **dict.fromkeys(("tall", "taller", "tallest", "high", "higher", "highest"), lambda o: -o.size[2]),
    **dict.fromkeys(("short", "shorter", "shortest", "lowest", "lower"), lambda o: o.size[2]),
    **dict.fromkeys(("big", "bigger", "biggest", "large", "larger", "largest"), lambda o: -float(np.prod(o.size))),
    **dict.fromkeys(("small", "smaller", "smallest", "little", "tiny"), lambda o: float(np.prod(o.size))),
    **dict.fromkeys(("top", "topmost", "upper", "uppermost"), lambda o: -o.position[2]),
    **dict.fromkeys(("bottom", "lowermost"), lambda o: o.position[2]),
}  # fmt: skip
"""What is least for the object that a word picks out of several."""

PICKED_OUT = re.compile(
    r"(?:,? (?:that|which)(?: is|'s)(?: farther| further| nearer| closer)?)?(?: lying| sitting| standing| resting)?"
    r"(?:(?:(?: the)? (?:farthest|furthest|nearest|closest)|(?<= farther)|(?<= further)|(?<= nearer)|(?<= closer))(?: to| on| at)?(?: the)?"
    r" (?P<side>left|right|front|back|me|us|away)\b"
    r"| at the very (?P<very>back|front|left|right)\b"
    r"| (?:on|at)(?: the)?(?: very)? (?P<end>top|bottom)\b(?! of (?!(?:the|that|this) (?:pile|stack|heap))))"
    r"| (?:nearer|nearest|closer|closest|farther|farthest|further|furthest)(?: to| from| away from)(?: the)? (?P<near>me|us|left|right)\b"
    r"(?= (?:and|can|could|goes|has|in|into|is|may|might|must|needs|on|onto|should|to|wants|will|would)\b)"
    r"|,? (?:that|which)(?: is|'s) in the (?P<between>middle)\b(?! of the (?:table|desk|counter|vanity))"
    r"|,? (?:that|which)(?: is|'s) (?:on|to|at) the (?P<of_two>left|right|front|back)\b(?! (?:of|side|edge|end|corner|hand)\b)"
)
"""Words after a mention that pick it out of several, with the side."""

MIDDLE = frozenset({"middle", "centre", "center", "central"})

_LOOKS = re.compile(r",? (?:that|which)(?: is|'s) ([\w-]+)")
_THE_ONE = re.compile(
    r"(?:(?!\b(?:keep|leave)\b)[^.:;!?])*,? the (?:last |first |very last |end )?one(?: that is| that's)?( .*)"
)

_HANDED = re.compile(r"\b(left|right)[- ]hand\s*$")
_SIDE_OF = re.compile(r"(?:^|[.,;:!?(]|\b(?:the|that|this|my|our|your|his|her|and)) *(left|right|front|back|rear|top|bottom) $")
"""A side right before a mention: "the left box"."""

_THESE = r"(?:the|my|our|those|these)(?: two| three| four| five)?(?: [\w-]+)? $"
ONE_OF = re.compile(rf"\b(?:(?:(?P<word>[\w-]+) )?one|any|(?P<most>\w+(?:st|er))) of {_THESE}")
OF_THESE = re.compile(rf"\b(?:of|from|among) (?:(?:the|a) (?:row|pile|set) of )?{_THESE}")
"""Words before a plural of which one is meant: "the middle one of the three varnishes", "of the two jars, the taller one"."""

_THE_OTHER_ONE = re.compile(r"[^.!?;]*, the ([\w-]+) one\b")

_ORDINAL = re.compile(r"\b(first|1st|second|2nd|third|3rd|fourth|4th|fifth|5th|last) $")
_FROM = re.compile(r"^ (?:from|on|at|to) (?:the |your |my )?(?:far )?(left|right|front|back|top|bottom)\b(?! of)")
_PLACES = {
    word: k
    for k, words in enumerate(("first 1st", "second 2nd", "third 3rd", "fourth 4th", "fifth 5th"))
    for word in words.split()
}

_BEFORE = 2  # words before a mention that may be superlatives


def words_around(text: str, start: int, end: int) -> Iterator[str]:
    """Yields the words around a mention that say which of several it is, such as ``left`` for ``that is farthest to the left``.

    Args:
        text: The instruction.
        start: First character of the mention.
        end: The character after it.
    """
    lead = text[:start].lower()
    for word in split_words(lead)[-_BEFORE:]:
        if word in ADJECTIVES or word in MIDDLE or (word in EXTREMES and word.endswith(("st", "er"))):
            yield word  # "the white" [chess piece]
    if (m := ONE_OF.search(lead)) is not None and (word := m["word"] or m["most"]) in {*EXTREMES, *MIDDLE}:
        yield word
    if (m := _HANDED.search(lead) or _SIDE_OF.search(lead)) is not None:
        yield m[1]
    rest = text[end:].lower()
    inside = text[start:end].lower().rpartition(" ")[0] + " "  # an ordinal may be a word of the mention
    if (row := _FROM.match(rest)) is not None and (m := _ORDINAL.search(lead) or _ORDINAL.search(inside)) is not None:
        yield row[1] if m[1] == "last" else f"{_PLACES[m[1]]} {row[1]}"
    if (m := _LOOKS.match(rest)) is not None and m[1] in ADJECTIVES:
        yield m[1]
    if OF_THESE.search(lead) and (m := _THE_OTHER_ONE.match(rest)) is not None and m[1] in EXTREMES:
        yield m[1]  # "of the two jars, the taller one"
    if (m := _THE_ONE.match(rest)) is not None:
        rest = f" that is{m[1]}"
    if (m := PICKED_OUT.match(rest)) is not None:
        side = m["side"] or m["end"] or m["of_two"] or m["very"] or m["near"] or m["between"]
        yield {"me": "front", "us": "front", "away": "back"}.get(side, side)


def picked(objects: Sequence[SceneObject], word: str, count: int) -> list[SceneObject]:
    """Returns the objects that a word picks out of several; all of them if it picks none.

    Args:
        objects: The objects.
        word: The word, or the number of others before the object and its side, such as ``1 left`` of the second from the left.
        count: How many are meant.
    """
    before, _, side = word.rpartition(" ")
    if before and count == 1:
        return sorted(objects, key=EXTREMES[side])[int(before) :][:1] or list(objects)
    if word in MIDDLE and count == 1 and len(objects) % 2:
        axis = int(np.ptp([o.position for o in objects], axis=0).argmax())  # of a row, or of a stack
        return [sorted(objects, key=lambda o: o.position[axis])[len(objects) // 2]]
    key = EXTREMES.get(word)
    return list(objects) if key is None else sorted(objects, key=key)[:count]
