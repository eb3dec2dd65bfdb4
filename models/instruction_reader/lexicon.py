"""The known categories that a noun phrase may mean."""

from collections.abc import Container, Iterable, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property

from rapidfuzz.distance import OSA
from rapidfuzz.process import extractOne

from models.instruction_reader.nouns import NounPools
from models.instruction_reader.sentences import split_words
from stable_data.instructions.wording.vocabulary import classes_of
from stable_data.instructions.wording.words import is_plural, plural

_CLASS_NOUNS = frozenset({"fruit", "toy", "cutlery", "cosmetics", "food", "tableware"})
"""Classes of the vocabulary whose names are nouns of objects."""

_LEAST = 5  # letters of a noun that is compared with a typing error
_LONG = 9  # letters from which two errors are accepted


@dataclass(frozen=True)
class Lexicon:
    """The nouns of the known categories.

    Attributes:
        nouns: The nouns of each category.
        words: Words that are not typing errors of a noun.
    """

    nouns: Mapping[str, Sequence[str]]
    words: Container[str] = frozenset()

    @classmethod
    def of(cls, pools: NounPools, categories: Iterable[str], words: Container[str] = frozenset()) -> "Lexicon":
        """Returns the nouns of these categories."""
        return cls({c: pools.nouns.get(c, (c.replace("_", " "),)) for c in categories}, words)

    def _nouns_of(self, category: str) -> tuple[str, ...]:
        """The nouns of a category, and those of its classes, such as ``fruit``."""
        return (*self.nouns[category], *(sorted(classes_of(category) & _CLASS_NOUNS)))

    @cached_property
    def _by_noun(self) -> dict[str, tuple[str, ...]]:
        found: dict[str, list[str]] = {}
        for category in self.nouns:
            for noun in self._nouns_of(category):
                for form in (noun, *(() if is_plural(noun) else (plural(noun),))):
                    spelt = _spelt(split_words(form))
                    found.setdefault(spelt, []).append(category)
                    found.setdefault(spelt.replace(" ", ""), []).append(category)
        return {noun: tuple(dict.fromkeys(categories)) for noun, categories in found.items()}

    @cached_property
    def _nouns(self) -> list[str]:
        return list(self._by_noun)

    def categories(self, words: Sequence[str]) -> tuple[str, ...]:
        """Returns the categories that a noun phrase may mean; none if it is unknown.

        The longest end of the phrase that is a noun decides: ``red coffee mug`` is a mug. If no end is a noun, the longest one with
        a typing error decides, and in ``mug of tea`` the words before ``of``.

        Args:
            words: The phrase in lower case.
        """
        ends = [_spelt(words[k:]) for k in range(len(words))]
        for end in ends:
            if end in self._by_noun:
                return self._by_noun[end]
        for end in ends:
            if (near := self._nearest(end)) is not None:
                return self._by_noun[near]
        if "of" in words[1:]:
            return self.categories(words[: words.index("of", 1)])
        return ()

    def is_noun(self, word: str) -> bool:
        """Returns whether a word alone is a noun of a category."""
        return word in self._by_noun

    def noun_size(self, words: Sequence[str]) -> int:
        """Returns the number of words at the end of a phrase that are its noun; all of them if the noun is unknown."""
        return next((len(words) - k for k in range(len(words)) if _spelt(words[k:]) in self._by_noun), len(words))

    def _nearest(self, spelt: str) -> str | None:
        if len(spelt) < _LEAST or all(word in self.words for word in spelt.split()):
            return None
        most = 2 if len(spelt) >= _LONG else 1
        found = extractOne(spelt, self._nouns, scorer=OSA.distance, score_cutoff=most)
        return None if found is None or found[0][0] != spelt[0] else str(found[0])


def _spelt(words: Sequence[str]) -> str:
    """Words without hyphens and possessives."""
    return " ".join(w for w in words if w.isalnum() and w != "s")
