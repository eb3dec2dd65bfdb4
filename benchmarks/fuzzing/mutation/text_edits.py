"""Edits of texts by their words and lines."""

import re
from collections.abc import Sequence
from random import Random

from benchmarks.fuzzing.mutation.odd_values import near_number, odd_number, odd_text

_WORD = re.compile(r"[-+]?\d+(?:\.\d+)?(?:[eE][-+]?\d+)?|\w+|[^\w\s]|\s+")
_NUMBER = re.compile(r"[-+]?\d+(?:\.\d+)?(?:[eE][-+]?\d+)?")
_HALF = re.compile("([\ud800-\udfff])")
_OPENINGS = ("(", "[", "{", '"', "'", "not ", "- ", "<a>", "#", "\\", "((", "[[", "{{")
_MOST_WORDS = 4000


def edited_text(content: bytes, rng: Random, donors: Sequence[bytes] = (), words: Sequence[str] = ()) -> bytes:
    """Returns a text with one edit: words and numbers exchanged, removed, repeated, moved; lines copied from another text.

    Args:
        content: The text, UTF-8; other bytes are kept.
        rng: Chooses the edit.
        donors: Texts from which lines are copied.
        words: Words of the grammar.
    """
    text = content.decode("utf-8", "surrogateescape")
    kind = rng.random()
    if kind < 0.12:
        return _encoded(_by_lines(text, rng, donors))
    parts = _WORD.findall(text, 0, 200_000)[:_MOST_WORDS]
    rest = text[sum(map(len, parts)) :]
    if not parts:
        return odd_text(rng, words).encode("utf-8", "surrogatepass")
    k = rng.randrange(len(parts))
    solid = [number for number, part in enumerate(parts) if not part.isspace()]
    k = rng.choice(solid) if solid else k
    if kind < 0.3:
        numbers = [number for number, part in enumerate(parts) if _NUMBER.fullmatch(part)]
        k = rng.choice(numbers) if numbers else k
        parts[k] = str(near_number(float(parts[k]), rng) if numbers and rng.random() < 0.5 else odd_number(rng))
    elif kind < 0.5:
        parts[k] = odd_text(rng, words)
    elif kind < 0.65:
        parts.insert(k, f" {odd_text(rng, words)} " if rng.random() < 0.7 else odd_text(rng, words))
    elif kind < 0.78:
        del parts[k : k + rng.choice((1, 1, 2, 5, 20))]
    elif kind < 0.86:
        end = k + rng.choice((1, 2, 5, 20))
        parts[k:end] = parts[k:end] * rng.choice((2, 2, 5, 50, 500))
    elif kind < 0.94:
        other = rng.choice(solid) if solid else k
        parts[k], parts[other] = parts[other], parts[k]
    else:
        parts[k] = rng.choice(_OPENINGS) * rng.choice((1, 2, 40, 1000)) + parts[k]
    return _encoded("".join(parts) + rest)


def _encoded(text: str) -> bytes:
    """The bytes of a text: those that were no UTF-8 as they were, and halves of surrogate pairs as three bytes each."""
    return b"".join(
        part.encode("utf-8", "surrogateescape" if "\udc80" <= part <= "\udcff" else "surrogatepass")
        for part in _HALF.split(text)
    )


def _by_lines(text: str, rng: Random, donors: Sequence[bytes]) -> str:
    lines = text.split("\n")
    k, kind = rng.randrange(len(lines)), rng.random()
    if kind < 0.3:
        del lines[k]
    elif kind < 0.55:
        lines[k:k] = [lines[k]] * rng.choice((1, 2, 20, 300))
    elif kind < 0.75:
        other = rng.randrange(len(lines))
        lines[k], lines[other] = lines[other], lines[k]
    elif donors:
        lines.insert(k, rng.choice(rng.choice(donors).decode("utf-8", "replace").split("\n")))
    return rng.choice(("\n", "\n", "\n", "\r\n", "\r", "\u2028")).join(lines)
