"""Words as such: types and categories, one and many, lists and sentences. Knows no scene."""

import re
from collections.abc import Sequence

_IRREGULAR = {"knife": "knives", "loaf": "loaves", "mouse": "mice", "dice": "dice", "die": "dice", "shelf": "shelves"}
_NUMBERS = {2: "two", 3: "three", 4: "four", 5: "five", 6: "six", 7: "seven", 8: "eight", 9: "nine", 10: "ten"}


def type_words(name: str) -> tuple[str, ...]:
    """Lower-case words of a type or category: ``NestingCup``, ``nesting_cup`` and ``nesting cup`` are the same two."""
    words = re.findall(r"[A-Z]+(?![a-z])|[A-Z]?[a-z]+|\d+", name)
    return tuple(word.lower() for word in words)


def type_name(category: str) -> str:
    """A category as a type: ``nesting_cup`` is ``NestingCup``."""
    return "".join(word.capitalize() for word in type_words(category))


def singular(words: tuple[str, ...]) -> tuple[str, ...]:
    """Words without the s of a plural, so that ``mugs`` and ``mug`` compare equal; not always good English."""
    return tuple(w[:-1] if w.endswith("s") and not w.endswith("ss") and len(w) > 3 else w for w in words)


def is_plural(noun: str) -> bool:
    """Does one say ``they`` of a thing with this name, such as scissors?"""
    head = noun.split(" of ")[0]
    return head.endswith("s") and not head.endswith(("ss", "us", "is"))


def plural(noun: str) -> str:
    """The name of several things of a kind: ``table knife`` gives ``table knives``."""
    *lead, last = noun.split(" ")
    if last in _IRREGULAR:
        last = _IRREGULAR[last]
    elif re.search(r"(?:s|x|z|ch|sh|[^aeiou]o)$", last):
        last += "es"
    elif re.search(r"[^aeiou]y$", last):
        last = last[:-1] + "ies"
    else:
        last += "s"
    return " ".join([*lead, last])


def number_word(count: int) -> str:
    """``three``; digits from eleven on."""
    return _NUMBERS.get(count, str(count))


def join_words(phrases: Sequence[str]) -> str:
    """``a``, ``a and b``, ``a, b and c``."""
    return " and ".join([", ".join(phrases[:-1]), phrases[-1]]) if len(phrases) > 1 else phrases[0]


def sentences(text: str) -> str:
    """The text with a capital at the start of every sentence and a mark at its end."""
    capital = re.sub(r"(^|[.!?] )([a-z])", lambda m: m[1] + m[2].upper(), text)
    return capital if capital.endswith((".", "!", "?")) else f"{capital}."
