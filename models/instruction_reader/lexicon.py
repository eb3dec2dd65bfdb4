"""The known categories that a noun phrase may mean."""

from collections.abc import Container, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property

from rapidfuzz.distance import OSA
from rapidfuzz.process import extract

from models.instruction_reader.nouns import NounPools
from models.instruction_reader.sentences import split_words
from models.instruction_reader.spelling import consonants
from stable_data.instructions.wording.vocabulary import classes_of
from stable_data.instructions.wording.words import is_plural, plural, singular_noun

_CLASS_NOUNS = frozenset({"fruit", "toy", "cutlery", "cosmetics", "food", "tableware"})
"""Classes of the vocabulary whose names are nouns of objects."""

_PARTS = frozenset({"base", "bottom", "corner", "edge", "end", "foot", "handle", "rim", "side", "surface", "top"})
"""Words after a noun that mean a part of its object."""

_TABLES = ("table", "tabletop", "table top", "worktop", "countertop", "work surface", "desktop")
"""Nouns of the table, which are no typing errors of ``tablet``."""

_SIZES = frozenset({"big", "large", "little", "small", "tiny"})
_ARTICLES = frozenset({"a", "an", "her", "his", "my", "our", "the", "their", "your"})

_WHOLE = frozenset({"scales", "kitchen scales", "weighing scales"})
"""Plurals of one object whose singular means the same object."""

_LEAST = 5  # letters of a noun that is compared with a typing error
_LONG = 9  # letters from which two errors are accepted
_CANDIDATES = 12
_USUAL = 6  # the nouns of a category are listed with the usual ones first: a noun this much later in the list is no usual one


@dataclass(frozen=True)
class Lexicon:
    """The nouns of the known categories.

    Attributes:
        nouns: The nouns of each category.
        words: Words that are not typing errors of a noun.
        unknown: Nouns of objects of no known category, such as ``loo roll``.
    """

    nouns: Mapping[str, Sequence[str]]
    words: Container[str] = frozenset()
    unknown: Sequence[str] = ()

    @classmethod
    def of(cls, pools: NounPools, categories: Iterable[str], words: Container[str] = frozenset()) -> "Lexicon":
        """Returns the nouns of these categories."""
        return cls({c: pools.nouns.get(c, (c.replace("_", " "),)) for c in categories}, words, (*pools.unknown, *_TABLES))

    def _nouns_of(self, category: str) -> tuple[str, ...]:
        """The nouns of a category, and those of its classes, such as ``fruit``."""
        return (*self.nouns[category], *(sorted(classes_of(category) & _CLASS_NOUNS)))

    @cached_property
    def _by_noun(self) -> dict[str, tuple[str, ...]]:
        found: dict[str, list[str]] = {}
        for category in self.nouns:
            for spelt in _forms(self._nouns_of(category)):
                found.setdefault(spelt, []).append(category)
                found.setdefault(spelt.replace(" ", ""), []).append(category)
        return {noun: tuple(dict.fromkeys(categories)) for noun, categories in found.items()}

    @cached_property
    def _nouns(self) -> list[str]:
        return list(self._by_noun)

    @cached_property
    def _unknown(self) -> frozenset[str]:
        return frozenset(_forms(self.unknown)) - self._by_noun.keys()

    def categories(self, words: Sequence[str]) -> tuple[str, ...]:
        """Returns the categories that a noun phrase may mean; none if it is unknown.

        The longest end of the phrase that is a noun decides: ``red coffee mug`` is a mug, and ``loo roll`` is no roll. If no end is
        a noun, the longest one with a typing error decides, in ``mug of tea`` the words before ``of``, and in ``monitor base`` the
        words before the part. ``Cup of egg`` and ``cup for a boiled egg``
        are an egg cup if there is such a noun.

        Args:
            words: The phrase in lower case.
        """
        if (whole := self._by_noun.get(_spelt(words))) is not None:
            return self._with_plain(whole, _spelt(words))
        if turned := self.of_purpose(words):
            return turned
        place = words.index("of", 1) if "of" in words[1:-1] else 0
        ends = [_spelt(words[k:]) for k in range(len(words))]
        for k, end in enumerate(ends):
            if end in self._by_noun:
                return self._with_plain(self._by_noun[end], end)
            if end in self._unknown:
                return self.categories(words[:place]) if k > place > 0 else ()
        for end in ends:
            if (near := self._nearest(end)) is not None:
                return self._by_noun[near]
        if place:
            return self.categories(words[:place])
        return self.categories(words[:-1]) if len(words) > 1 and words[-1] in _PARTS else ()

    def _with_plain(self, categories: tuple[str, ...], noun: str) -> tuple[str, ...]:
        """Adds to the categories of a noun those of its name without a size: a small plate is a saucer or a plate."""
        size, _, name = noun.partition(" ")
        plain = (c for c in self._by_noun.get(name, ()) if c.replace("_", " ") in (name, singular_noun(name)))
        return tuple(dict.fromkeys((*categories, *plain))) if size in _SIZES else categories

    def of_purpose(self, words: Sequence[str]) -> tuple[str, ...]:
        """Returns the categories of a compound that is said in turn, such as ``cup for a boiled egg``; none if it is no noun."""
        for k in (words.index(link, 1) for link in ("of", "for") if link in words[1:-1]):
            purpose = [w for w in words[k + 1 :] if w not in _ARTICLES]
            singulars = [singular_noun(w) for w in purpose]
            for what in (purpose, singulars, purpose[-1:], singulars[-1:], purpose[:1]):
                if what and (turned := self._by_noun.get(_spelt([*what, words[k - 1]]))) is not None:
                    return turned
        return ()

    def of_contents(self, words: Sequence[str], contents: Sequence[str]) -> tuple[str, ...]:
        """Returns the categories of an object by what is in or on it: a pot with brushes is a brush pot; none if no noun says so.

        Args:
            words: The phrase of the object in lower case; only one that is a noun of one word is looked up.
            contents: The phrase of what it carries.
        """
        if not words or not contents or self.noun_size(words) != 1:
            return ()
        return self._by_noun.get(_spelt([singular_noun(contents[-1]), singular_noun(words[-1])]), ())

    def usual(self, words: Sequence[str], categories: Sequence[str]) -> tuple[str, ...]:
        """Returns those of the categories of a phrase for which its noun is a usual one: ``tray`` of a serving tray, not of an oven dish.

        Args:
            words: The phrase in lower case.
            categories: Categories that it may mean.
        """
        ends = [[singular_noun(w) for w in words[k:]] for k in range(len(words))]
        for spelt in map(_spelt, (*(words[k:] for k in range(len(words))), *ends)):
            ranks = {c: self.nouns[c].index(spelt) for c in categories if spelt in self.nouns.get(c, ())}
            if ranks:
                return tuple(c for c in categories if c in ranks and ranks[c] <= min(ranks.values()) + _USUAL)
        return tuple(categories)

    def is_one_thing(self, words: Sequence[str], categories: Sequence[str]) -> bool:
        """Returns whether the noun of a phrase is a plural that means one object, such as ``scales`` or ``cornflakes``."""
        noun = _spelt(words[len(words) - self.noun_size(words) :])
        singulars = {noun.removesuffix(last) + singular_noun(last) for last in noun.split()[-1:]}
        named = [self.nouns[c] for c in categories if noun in self.nouns.get(c, ())]
        return is_plural(noun) and bool(named) and all(noun in _WHOLE or not singulars & {*nouns} for nouns in named)

    def is_noun(self, word: str) -> bool:
        """Returns whether a word alone is a noun of a category."""
        return word in self._by_noun

    def is_name(self, word: str) -> bool:
        """Returns whether a noun is the last word of the name of a category that it may mean, such as ``mugs``."""
        names = {c.rpartition("_")[2] for c in self._by_noun.get(word, ())}
        return bool(names & {word, singular_noun(word)})

    def is_unknown(self, words: Sequence[str]) -> bool:
        """Returns whether the end of a phrase is the table, or a compound that is not what its last word is, such as ``loo roll``."""
        ends = [_spelt(words[k:]) for k in range(len(words))]
        return not self.categories(words) and any(e in _TABLES or (" " in e and e in self._unknown) for e in ends)

    def noun_size(self, words: Sequence[str]) -> int:
        """Returns the number of words at the end of a phrase that are its noun; all of them if the noun is unknown."""
        return next((len(words) - k for k in range(len(words)) if _spelt(words[k:]) in self._by_noun), len(words))

    def _nearest(self, spelt: str) -> str | None:
        spoken = spelt.split()
        is_spelt = all(word in self.words for word in spoken)
        if len(spelt) < _LEAST or (is_spelt and (len(spoken) < 2 or len(spelt) < _LONG)):
            return None
        most = 2 if len(spelt) >= _LONG and not is_spelt else 1
        near = extract(spelt, self._nouns, scorer=OSA.distance, score_cutoff=most, limit=_CANDIDATES)
        # Of words that are all known one may still be a slip, as in "puzzle cub", but then the others are those of the noun.
        fits = [
            (distance, consonants(noun) != consonants(spelt), k)
            for k, (noun, distance, _) in enumerate(near)
            if noun[0] == spelt[0] and (not is_spelt or set(spoken) & set(noun.split()))
        ]
        return str(near[min(fits)[2]][0]) if fits else None


def _forms(nouns: Iterable[str]) -> Iterator[str]:
    """The nouns and their plurals."""
    for noun in nouns:
        for form in (noun, *(() if is_plural(noun) else (plural(noun),))):
            yield _spelt(split_words(form))


def _spelt(words: Sequence[str]) -> str:
    """Words without hyphens and possessives."""
    return " ".join(w for w in words if w.isalnum() and w != "s")
