"""Opposite places of one object by another one, ``left of the cup and right of the cup``, of which the network sees one alone."""

from collections.abc import Iterator, Sequence
from itertools import pairwise

_FILLERS = frozenset({",", "also", "and", "at", "but", "is", "are", "its", "of", "side", "simultaneously", "the", "time", "to"})
_SIDES = {
    "left": ("left", False),
    "right": ("left", True),
    "front": ("front", False),
    "behind": ("front", True),
    "in": ("in", False),
    "inside": ("in", False),
    "on": ("on", False),
    "under": ("on", True),
    "below": ("on", True),
    "beneath": ("on", True),
}
"""Word -> kind of the relation, and whether the other object is its subject."""


def double_claims(
    words: Sequence[str],
    spans: Sequence[tuple[int, int]],
    clusters: Sequence[Sequence[int]],
    found: Sequence[tuple[float, int, str, int]],
) -> Iterator[tuple[float, int, str, int]]:
    """Yields the second of two relations that a clause states of the same two objects, if it is the opposite of the first.

    Args:
        words: The words of the sentence.
        spans: First and last word of each mention.
        clusters: The mentions of each object.
        found: The relations that the network sees: score, subject, kind, target.

    Yields:
        Relations in the same form, with score 0: less likely than what the network sees.
    """
    known = {(subject, kind, target) for _, subject, kind, target in found}
    for k, mentions in enumerate(clusters):
        for one, other in pairwise(mentions):
            said = words[spans[one][1] + 1 : spans[other][0]]
            places = [word for word in said if word not in _FILLERS]
            if other != one + 1 or "and" not in said[:3] or len(places) not in (1, 2):
                continue
            if places[0] not in _SIDES or (
                len(places) == 2 and places not in (["in", "front"], ["on", "left"], ["on", "right"])
            ):
                continue
            kind, turns = _SIDES[places[-1]]
            for i in range(len(clusters)):
                claim, opposite = ((k, kind, i), (i, kind, k)) if turns else ((i, kind, k), (k, kind, i))
                if opposite in known and claim not in known and clusters[i][0] < one:
                    yield (0.0, *claim)
