"""How well the noun of an asset fits a wanted one."""

from enum import IntEnum

from stable_data.instructions.wording.vocabulary import closeness, nouns_of
from stable_data.instructions.wording.words import category_words, singular, type_words


class NounFit(IntEnum):
    """How well a category fits a wanted one, from worst to best."""

    OTHER = 0
    """Something else: a ``tablet`` for a ``laptop``."""

    POSSIBLE = 1
    """The last words are equal, as for a ``knife`` and a ``kitchen_knife``, or one of the categories is unknown."""

    KIND = 2
    """It is a name of the wanted one or a kind of it: a ``soup_can`` is a ``can``."""

    EQUAL = 3
    """The same words."""


def noun_fit(category: str, wanted: str) -> NounFit:
    """Returns how well a category fits a wanted one; either may be empty, which means unknown."""
    own, asked = category_words(category), category_words(wanted)
    if close := closeness(category, wanted):
        return NounFit.EQUAL if close == 2 else NounFit.KIND
    return NounFit.POSSIBLE if not (own and asked) or own[-1] == asked[-1] else NounFit.OTHER


def is_named_in(text: str, category: str) -> bool:
    """Whether a text contains a name of a category, as whole words: ``a red coffee mug`` names a ``mug``."""
    words = singular(type_words(text))
    names = [singular(type_words(noun)) for noun in nouns_of(category)]
    return any(words[k : k + len(name)] == name for name in names for k in range(len(words)))
