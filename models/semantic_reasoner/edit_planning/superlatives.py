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
    r"|,? (?:that|which)(?: is|'s) (?:on|to|at) the (?P<of_two>left|right|front|back)\b(?! (?:of|side|edge|end|corner|hand)\b)"
)
"""Words after a mention that pick it out of several, with the side."""

MIDDLE = frozenset({"middle", "centre", "center", "central"})

_LOOKS = re.compile(r",? (?:that|which)(?: is|'s) ([\w-]+)")
_THE_ONE = re.compile(r"(?:(?!\b(?:keep|leave)\b)[^.:;!?])*,? the one(?: that is| that's)?( .*)")

_HANDED = re.compile(r"\b(left|right)[- ]hand\s*$")

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
    if (m := _HANDED.search(lead)) is not None:
        yield m[1]
    rest = text[end:].lower()
    if (m := _LOOKS.match(rest)) is not None and m[1] in ADJECTIVES:
        yield m[1]
    if (m := _THE_ONE.match(rest)) is not None:
        rest = f" that is{m[1]}"
    if (m := PICKED_OUT.match(rest)) is not None:
        side = m["side"] or m["end"] or m["of_two"] or m["very"]
        yield {"me": "front", "us": "front", "away": "back"}.get(side, side)


def picked(objects: Sequence[SceneObject], word: str, count: int) -> list[SceneObject]:
    """Returns the objects that a word picks out of several; all of them if it picks none.

    Args:
        objects: The objects.
        word: The word.
        count: How many are meant.
    """
    if word in MIDDLE and count == 1 and len(objects) % 2:
        axis = int(np.ptp([o.position for o in objects], axis=0).argmax())  # of a row, or of a stack
        return [sorted(objects, key=lambda o: o.position[axis])[len(objects) // 2]]
    key = EXTREMES.get(word)
    return list(objects) if key is None else sorted(objects, key=key)[:count]
