"""Mends typing errors: an unknown word becomes the frequent known word that differs from it least."""

import re
from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property

from rapidfuzz.distance import OSA
from rapidfuzz.process import extract

from models.instruction_reader.nouns import NounPools
from models.instruction_reader.phrases import ADJECTIVES, PHRASES
from models.instruction_reader.sentences import split_words
from stable_data.instructions.wording.words import plural

_SHORT_SLIPS = {"teh": "the", "hte": "the", "adn": "and", "nad": "and", "fo": "of", "si": "is", "ti": "it", "ont": "on"}
"""Slips in words that are too short to be compared."""

_ENDINGS = (
    ("s", ""),
    ("es", ""),
    ("ies", "y"),
    ("ing", ""),
    ("ing", "e"),
    ("ed", ""),
    ("ed", "e"),
    ("er", ""),
    ("er", "e"),
    ("ier", "y"),
    ("est", ""),
    ("est", "e"),
    ("iest", "y"),
    ("re", ""),
    ("ve", ""),
)
"""Endings of known stems, and what the stem has instead."""

_DOUBLING = frozenset({"ing", "ed", "er"})  # endings before which short stems double their last letter
_DOUBLED = re.compile("[^aeiou]*[aeiou][^aeiouwxy]")

_LEAST = 4  # letters of a word that is compared
_LONG = 8  # letters from which any two errors are mended; in shorter words two vowels may be wrong
_CANDIDATES = 12
_SEVERAL = 3  # occurrences of a word that is not foreign


@dataclass(frozen=True)
class Spelling:
    """The known words.

    Attributes:
        frequent: Words that an unknown word may become, with their counts.
        known: Further words that stay as they are.
    """

    frequent: Mapping[str, int]
    known: frozenset[str] = field(default_factory=frozenset)

    @classmethod
    def of(cls, texts: Iterable[str], nouns: NounPools, known: Iterable[str] = ()) -> "Spelling":
        """Returns the words of frames, phrases and nouns.

        Args:
            texts: The texts of frames.
            nouns: The nouns.
            known: Further words that stay as they are, such as the whole words of a tokenizer.
        """
        counts: Counter[str] = Counter()
        known = frozenset(known)
        for text in texts:
            counts.update(split_words(text))
        # Frames have typing errors too: a rare word that the tokenizer does not know may be one.
        counts = Counter({word: n for word, n in counts.items() if n >= _SEVERAL or word in known})
        for phrases in PHRASES.values():
            counts.update(word for phrase in phrases for word in split_words(phrase))
        for names in nouns.nouns.values():
            counts.update(10 * [word for name in names for one in (name, plural(name)) for word in split_words(one)])
        for name in (*ADJECTIVES, *nouns.unknown, *nouns.elsewhere):
            counts.update(split_words(name))
        return cls({word: n for word, n in counts.items() if word.isalpha()}, known)

    @cached_property
    def words(self) -> frozenset[str]:
        """All known words."""
        return self.known | self.frequent.keys()

    @cached_property
    def _words(self) -> list[str]:
        return [word for word in self.frequent if len(word) >= _LEAST - 1]

    def mend(self, words: Sequence[str]) -> list[str]:
        """Returns the words with typing errors mended; their number stays."""
        return [self._mended(word) for word in words]

    def is_frequent(self, word: str) -> bool:
        """Returns whether a word or its stem occurs several times in frames, phrases and nouns; some frames have foreign words."""
        return any(self.frequent.get(stem, 0) >= _SEVERAL for stem in _stems(word))

    def _is_known(self, word: str) -> bool:
        """Whether a word or its stem is known; so is ``theyre``, which lacks an apostrophe."""
        return any(stem in self.frequent or stem in self.known for stem in _stems(word) if len(stem) >= _LEAST - 1)

    def _mended(self, word: str) -> str:
        if word in _SHORT_SLIPS:
            return _SHORT_SLIPS[word]
        if len(word) < _LEAST or not (word.isalpha() and word.isascii()) or self._is_known(word):
            return word
        found = extract(word, self._words, scorer=OSA.distance, score_cutoff=2, limit=_CANDIDATES)
        near = [
            (distance, candidate)
            for candidate, distance, _ in found
            if _begins_alike(word, candidate)
            and (
                distance < 2
                or len(word) >= _LONG
                or consonants(word) == consonants(candidate)
                or sorted(word) == sorted(candidate)  # "pichter"
            )
        ]
        if not near:
            return word
        spoken = consonants(word)
        return min(near, key=lambda one: (one[0], consonants(one[1]) != spoken, -self.frequent[one[1]], one[1]))[1]


def _stems(word: str) -> tuple[str, ...]:
    """A word, and what it may be an inflection of: ``chop`` of ``chopping``, but not of ``choping``."""
    found = [word]
    for end, more in _ENDINGS:
        if word.endswith(end):
            stem = word.removesuffix(end)
            doubles = not more and end in _DOUBLING
            if not (doubles and _DOUBLED.fullmatch(stem)):
                found.append(stem + more)
            if doubles and stem[-1:] == stem[-2:-1]:
                found.append(stem[:-1])
    return tuple(found)


def consonants(word: str) -> str:
    """Returns a word without its vowels, which typing errors change most."""
    return "".join(letter for letter in word if letter not in "aeiou")


def _begins_alike(word: str, candidate: str) -> bool:
    """Whether the first letters agree, perhaps in another order."""
    return word[0] == candidate[0] or (word[0] == candidate[1] and word[1] == candidate[0])
