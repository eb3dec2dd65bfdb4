"""Finds the nouns of known categories in an instruction, by the longest match."""

import re
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from functools import cached_property

from models.semantic_reasoner.language.stop_words import OFF_THE_TABLE, VERBS
from stable_data.instructions.wording.vocabulary import answers_to, classes_of, nouns_of
from stable_data.instructions.wording.words import is_plural, plural, singular, singular_noun, type_words

_LOOKS = frozenset({"wooden", "large", "small", "big", "tall"})
"""Adjectives that are also part of category names: a ``wooden spoon`` may be any spoon made of wood."""

_CLASS_NOUNS = frozenset({"fruit", "toy", "cutlery", "cosmetics", "food", "tableware"})
"""Classes of the vocabulary whose names are nouns of objects."""

_WORD = re.compile(r"[^\W\d_]+|\d+")


@dataclass(frozen=True, slots=True)
class TextWord:
    """A word of a text.

    Attributes:
        text: The word in lower case.
        start: Index of its first character.
        end: Index after its last character.
        is_first: Whether it is the first word of the text or a punctuation mark is before it.
        is_name: Whether only its first letter is a capital and it is not at the start of a sentence.
    """

    text: str
    start: int
    end: int
    is_first: bool
    is_name: bool


def words_of(text: str) -> tuple[TextWord, ...]:
    """Splits a text into words; ``mug's`` and ``make-up`` give two words each."""
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
        noun: The noun in the singular.
        is_plural: Whether the words are a plural of it.
    """

    first: int
    last: int
    noun: str
    is_plural: bool


class NounLookup:
    """Maps nouns to the known categories.

    The nouns of a category are its own words, its other names in the vocabulary, and the ends of both (``pot`` for a
    ``cooking_pot``). The noun of a class of the vocabulary is its name (``fruit``).

    Args:
        categories: The known categories.
    """

    def __init__(self, categories: Iterable[str]) -> None:
        self.categories = tuple(sorted(set(categories)))
        self._by_words: dict[tuple[str, ...], tuple[str, bool]] = {}
        self._meant: dict[str, tuple[str, ...]] = {}
        own = sorted({noun for c in self.categories for noun in nouns_of(c)})
        # "bottle of perfume" has its head at the start, so its ends are not names of it.
        ends = sorted(
            {" ".join(noun.split(" ")[k:]) for noun in own for k in range(1, len(noun.split(" "))) if " of " not in noun}
        )
        classes = sorted({name for c in self.categories for name in classes_of(c)} & _CLASS_NOUNS)
        self.names = frozenset(own)
        for noun in own:
            self._add(noun, singular(tuple(noun.split(" "))))  # the singular of ``nesting_cups``
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
        """All words that occur in nouns."""
        return frozenset(word for spelt in self._by_words for word in spelt)

    def categories_of(self, noun: str) -> tuple[str, ...]:
        """Returns the categories that a noun may mean, possibly none.

        These are the categories that it names; if there are none, the categories whose name ends with it or whose class it is.
        For example ``bottle`` means a ``sauce_bottle`` only if the category ``bottle`` is not known.
        """
        if noun not in self._meant:
            asked = singular_noun(noun)
            head, _, rest = noun.partition(" ")
            nouns = (noun, rest) if head in _LOOKS and rest else (noun,)
            named = tuple(c for c in self.categories if {*nouns, asked} & {*nouns_of(c), singular_noun(own_noun(c))})
            meant = (c for c in self.categories if asked in classes_of(c) or any(answers_to(c, n) for n in nouns))
            self._meant[noun] = named or tuple(meant)
        return self._meant[noun]

    def read(self, words: Sequence[TextWord]) -> list[NounMention]:
        """Finds the nouns of a text in its order, by the longest match; of ``orange pitcher`` only the pitcher."""
        found: list[NounMention] = []
        k = 0
        while k < len(words):
            mention = self._at(words, k)
            if mention is None:
                k += 1
                continue
            if found and found[-1].last == k - 1 and not words[k].is_first:
                found[-1] = mention  # a noun before the head of a phrase describes the head
            else:
                found.append(mention)
            k = mention.last + 1
        return found

    def _at(self, words: Sequence[TextWord], k: int) -> NounMention | None:
        for size in range(min(self._longest, len(words) - k), 0, -1):
            part = words[k : k + size]
            spelt = tuple(w.text for w in part)
            if spelt[0] == "hand" and k and words[k - 1].text in ("left", "right"):
                continue  # "the right-hand mirror" is not a hand mirror
            if spelt in self._by_words and not any(w.is_first for w in part[1:]):
                noun, is_many = self._by_words[spelt]
                return NounMention(k, k + size - 1, noun, is_many)
        return None


def own_noun(category: str) -> str:
    """Returns a category in words, such as ``spice jar``."""
    return " ".join(type_words(category))
