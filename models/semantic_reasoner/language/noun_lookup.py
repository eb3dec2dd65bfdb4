"""The nouns of an instruction: which words call which of the known categories, found by the longest match."""

import re
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from functools import cached_property

from models.semantic_reasoner.language.stop_words import OFF_THE_TABLE, VERBS
from stable_data.instructions.wording.vocabulary import answers_to, classes_of, nouns_of
from stable_data.instructions.wording.words import is_plural, plural, singular, type_words

_LOOKS = frozenset({"wooden", "large", "small", "big", "tall"})
"""Words that are part of some category's name and may as well only describe: a ``wooden spoon`` may be a spoon of wood."""

_CLASS_NOUNS = frozenset({"fruit", "toy", "cutlery", "cosmetics", "food", "tableware"})
"""Classes of the vocabulary whose names are said of things."""

_WORD = re.compile(r"[^\W\d_]+|\d+")


@dataclass(frozen=True, slots=True)
class TextWord:
    """A word of a text.

    Attributes:
        text: In lower case.
        start: Where it starts in the text.
        end: Where it ends.
        is_first: Whether a mark, a line or the text's start stands between it and the word before.
        is_name: Whether it starts with a capital where no sentence starts.
    """

    text: str
    start: int
    end: int
    is_first: bool
    is_name: bool


def words_of(text: str) -> tuple[TextWord, ...]:
    """The words of a text; ``mug's`` is two, ``make-up`` too."""
    found: list[TextWord] = []
    last = 0
    for m in _WORD.finditer(text):
        between = text[last : m.start()]
        is_first = not found or re.search(r"[^\s'’_-]", between) is not None
        starts_sentence = not found or re.search(r"[.!?:;\n\"]", between) is not None
        found.append(
            TextWord(
                m[0].lower(), m.start(), m.end(), is_first, m[0][0].isupper() and not m[0][1:].isupper() and not starts_sentence
            )
        )
        last = m.end()
    return tuple(found)


@dataclass(frozen=True, slots=True)
class NounMention:
    """A noun in a text.

    Attributes:
        first: Index of its first word.
        last: Index of its last word.
        noun: What it is, in the singular.
        is_plural: Whether the words speak of several.
    """

    first: int
    last: int
    noun: str
    is_plural: bool


class NounLookup:
    """What the known categories may be called.

    A category is called by its own words, by the vocabulary's other names for it and by the ends of either (a ``cooking_pot``
    is a pot); a class of the vocabulary is called by its name (``fruit``).

    Args:
        categories: The known categories.
    """

    def __init__(self, categories: Iterable[str]) -> None:
        self.categories = tuple(sorted(set(categories)))
        self._by_words: dict[tuple[str, ...], tuple[str, bool]] = {}
        self._meant: dict[str, tuple[str, ...]] = {}
        own = sorted({noun for c in self.categories for noun in nouns_of(c)})
        ends = sorted(
            {" ".join(noun.split(" ")[k:]) for noun in own for k in range(1, len(noun.split(" "))) if " of " not in noun}
        )
        classes = sorted({name for c in self.categories for name in classes_of(c)} & _CLASS_NOUNS)
        self.names = frozenset(own)
        for noun in own:
            self._add(noun, singular(tuple(noun.split(" "))))  # one of ``nesting_cups``
        for noun in (*classes, *(end for end in ends if end not in OFF_THE_TABLE | VERBS)):
            self._add(noun)
        self._longest = max(map(len, self._by_words), default=0)

    def _add(self, noun: str, one: tuple[str, ...] = ()) -> None:
        words = tuple(noun.split(" "))
        many = tuple(plural(noun).split(" ")) if " of " not in noun else (plural(words[0]), *words[1:])
        for spelt, is_many in ((words, False), (many, not is_plural(noun)), (one, False)):
            if spelt:
                self._by_words.setdefault(spelt, (noun, is_many))
                self._by_words.setdefault(("".join(spelt),), (noun, is_many))

    @cached_property
    def words(self) -> frozenset[str]:
        """Every word of a noun."""
        return frozenset(word for spelt in self._by_words for word in spelt)

    def categories_of(self, noun: str) -> tuple[str, ...]:
        """The categories that a noun may mean, possibly none: those that it names, or else those whose name it ends or is the class of.

        A bottle is a ``bottle`` where there are such, and no ``sauce_bottle``.
        """
        if noun not in self._meant:
            asked = _one_of(noun)
            head, _, rest = noun.partition(" ")
            nouns = (noun, rest) if head in _LOOKS and rest else (noun,)
            named = tuple(c for c in self.categories if {*nouns, asked} & {*nouns_of(c), _one_of(own_noun(c))})
            meant = (c for c in self.categories if asked in classes_of(c) or any(answers_to(c, n) for n in nouns))
            self._meant[noun] = named or tuple(meant)
        return self._meant[noun]

    def read(self, words: Sequence[TextWord]) -> list[NounMention]:
        """The nouns of a text, the longest that fit, in its order; of ``orange pitcher`` the pitcher alone."""
        found: list[NounMention] = []
        k = 0
        while k < len(words):
            mention = self._at(words, k)
            if mention is None:
                k += 1
                continue
            if found and found[-1].last == k - 1 and not words[k].is_first:
                found[-1] = mention  # what comes before the head only tells its kind
            else:
                found.append(mention)
            k = mention.last + 1
        return found

    def _at(self, words: Sequence[TextWord], k: int) -> NounMention | None:
        for size in range(min(self._longest, len(words) - k), 0, -1):
            part = words[k : k + size]
            spelt = tuple(w.text for w in part)
            if spelt[0] == "hand" and k and words[k - 1].text in ("left", "right"):
                continue  # "the right-hand mirror" is no hand mirror
            if spelt in self._by_words and not any(w.is_first for w in part[1:]):
                noun, is_many = self._by_words[spelt]
                return NounMention(k, k + size - 1, noun, is_many)
        return None


def _one_of(noun: str) -> str:
    """One thing of a noun that may be a plural."""
    return " ".join(singular(tuple(noun.split(" "))))


def own_noun(category: str) -> str:
    """A category in words, such as ``spice jar``."""
    return " ".join(type_words(category))
