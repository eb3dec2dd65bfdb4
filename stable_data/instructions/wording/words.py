"""Operations on words: types and categories, singular and plural, lists and sentences."""

import re
from collections.abc import Sequence
from functools import lru_cache

_IRREGULAR = {"knife": "knives", "loaf": "loaves", "mouse": "mice", "dice": "dice", "die": "dice", "shelf": "shelves"}
_SINGULAR = {many: one for one, many in _IRREGULAR.items() if many != one}
_NUMBERS = {2: "two", 3: "three", 4: "four", 5: "five", 6: "six", 7: "seven", 8: "eight", 9: "nine", 10: "ten"}


def type_words(name: str) -> tuple[str, ...]:
    """Splits a type or category into lower-case words: ``NestingCup``, ``nesting_cup`` and ``nesting cup`` give the same two."""
    words = re.findall(r"[A-Z]+(?![a-z])|[A-Z]?[a-z]+|\d+", name)
    return tuple(word.lower() for word in words)


def type_name(category: str) -> str:
    """Returns a category as a type: ``nesting_cup`` gives ``NestingCup``."""
    return "".join(word.capitalize() for word in type_words(category))


def singular(words: tuple[str, ...]) -> tuple[str, ...]:
    """Removes the plural ending of each word, so that ``berries`` equals ``berry``; the result is not always an English word."""
    return tuple(map(_stem, words))


@lru_cache(maxsize=65536)
def category_words(category: str) -> tuple[str, ...]:
    """Returns the words of a category without plural endings, from a cache."""
    return singular(type_words(category))


@lru_cache(maxsize=65536)
def _stem(word: str) -> str:
    if word in _SINGULAR:
        return _SINGULAR[word]
    if len(word) > 3 and word.endswith("s") and not word.endswith("ss"):
        word = word[:-1]
    if len(word) > 3 and word.endswith("ie"):
        return word[:-2] + "y"
    return word[:-1] if re.search(r"(?:ch|sh|x|ss|z)e$", word) else word  # of the plural ending es


def singular_noun(noun: str) -> str:
    """Applies :func:`singular` to the words of a noun."""
    return " ".join(singular(tuple(noun.split(" "))))


def is_plural(noun: str) -> bool:
    """Whether a noun is a plural, also of a single object such as scissors."""
    head = noun.split(" of ")[0]
    return head.endswith("s") and not head.endswith(("ss", "us", "is"))


def plural(noun: str) -> str:
    """Returns the plural of a noun: ``table knife`` gives ``table knives``."""
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
    """Returns a number in words, such as ``three``; digits from eleven on."""
    return _NUMBERS.get(count, str(count))


def join_words(phrases: Sequence[str]) -> str:
    """Joins phrases: ``a``, ``a and b``, ``a, b and c``."""
    return " and ".join([", ".join(phrases[:-1]), phrases[-1]]) if len(phrases) > 1 else phrases[0]


def sentences(text: str) -> str:
    """Capitalizes the start of each sentence and adds a full stop at the end if no punctuation mark is there."""
    capital = re.sub(r"(^|[.!?] )([a-z])", lambda m: m[1] + m[2].upper(), text)
    return capital if capital.endswith((".", "!", "?")) else f"{capital}."
