"""Finds the objects that an instruction requires, from its words and the known categories.

A layout without a required object is rejected, so a doubtful word requires nothing.
"""

import re
from collections.abc import Sequence
from dataclasses import dataclass

from models.semantic_reasoner.language.category_statistics import CategoryStatistics
from models.semantic_reasoner.language.noun_lookup import TextWord, own_noun, words_of
from models.semantic_reasoner.language.noun_phrases import NounPhrase, find_noun_phrases, number_phrases
from models.semantic_reasoner.language.stop_words import FUNCTION_WORDS, word_set
from stable_data.instructions.claims import emptied_numbers
from stable_data.instructions.wording.words import is_plural

_EVERYTHING = re.compile(r"\b(?:everything|all|whatever|what)(?: else)?(?: that)?(?:'s| is| lies| stands)? (?:on|in|inside) <")
_HEADS = word_set("opener handle lid rim cap button cover drawer spot place corner")
"""Words after a noun that are the true head of its phrase, such as ``can opener``."""


@dataclass(frozen=True, slots=True)
class ObjectRequirement:
    """Objects that an instruction requires.

    Attributes:
        words: The words that mention them.
        categories: Categories that they may have; empty: any, in addition to the object that they are in or on.
        at_least: Least number of objects.
    """

    words: str
    categories: tuple[str, ...]
    at_least: int = 1

    def is_met_by(self, categories: Sequence[str]) -> bool:
        """Whether a layout has enough of these objects; one object of a plural category (``wooden_blocks``) is enough.

        Args:
            categories: Categories of all objects of the layout.
        """
        if not self.categories:
            return len(categories) > self.at_least
        found = [c for c in categories if c in self.categories]
        return len(found) >= self.at_least or any(is_plural(own_noun(c)) for c in found)


def required_objects(instruction: str, statistics: CategoryStatistics) -> tuple[ObjectRequirement, ...]:
    """Finds the objects that an instruction requires.

    Mentions of one noun mean the same object unless their modifiers differ (``the red mug ... the blue mug``) or one of them
    has ``other`` or ``another``. Nouns that are denied, doubtful, or followed by a possible true head (``the can opener``)
    require nothing.

    Args:
        instruction: The instruction.
        statistics: Statistics of the known categories.

    Returns:
        Requirements in the order of their first mention; empty if the instruction mentions no known object.
    """
    words = words_of(instruction)
    found: dict[str, list[NounPhrase]] = {}
    phrases = []
    for phrase in find_noun_phrases(words, statistics.nouns):
        if (
            phrase.is_denied
            or _is_future(words, phrase)
            or statistics.is_doubtful(phrase)
            or _is_part_of_other(words, phrase, statistics)
        ):
            continue
        phrases.append(phrase)
        found.setdefault(phrase.mention.noun, []).append(phrase)
    required = [_requirement(instruction, words, same, statistics) for same in found.values()]
    text = number_phrases(instruction, words, phrases)
    if emptied_numbers(text) or _EVERYTHING.search(text):
        required.append(ObjectRequirement("what is in or on it", ()))
    return tuple(required)


def _is_future(words: Sequence[TextWord], phrase: NounPhrase) -> bool:
    """Whether a phrase means a future object: ``make room for a laptop``."""
    return phrase.before == "for" and words[phrase.first].text in ("a", "an", "another", "some")


def _is_part_of_other(words: Sequence[TextWord], phrase: NounPhrase, statistics: CategoryStatistics) -> bool:
    """Whether a noun may be part of another name: ``the can opener``, ``a block of paper``, ``cotton pads``."""
    mention, nouns = phrase.mention, statistics.nouns
    k = mention.last + 1
    after = words[k].text if k < len(words) and not words[k].is_first else ""
    if mention.noun in nouns.names:
        return after in _HEADS
    modifiers = (w.text for w in words[phrase.first : mention.first])
    return after in _HEADS | {"of"} or any(
        m not in FUNCTION_WORDS and not m.isdecimal() and (m in nouns.words or m not in statistics.words) for m in modifiers
    )


def _requirement(
    instruction: str, words: Sequence[TextWord], same: Sequence[NounPhrase], statistics: CategoryStatistics
) -> ObjectRequirement:
    """The requirement of all mentions of one noun."""
    others = [p for p in same if {"other", "another"} & {*p.modifiers, words[p.first].text}]
    modifiers = {p.modifiers for p in same if p not in others and p.count == 1 and p.modifiers}
    count = max(len(modifiers), *(p.count for p in same))
    if others and len(others) < len(same):
        count = max(count, len(modifiers) + 1, 2)
    first = same[0]
    spelt = instruction[words[first.mention.first].start : words[first.mention.last].end]
    return ObjectRequirement(spelt, statistics.nouns.categories_of(first.mention.noun), count)
