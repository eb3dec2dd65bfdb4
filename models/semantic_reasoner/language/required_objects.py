"""Which objects an instruction asks for, read from its words and the known categories.

What is asked for here is refused where it is missing, so a doubtful word asks for nothing.
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
"""Words after a noun that are the head of its phrase, such as ``can opener``."""


@dataclass(frozen=True, slots=True)
class ObjectRequirement:
    """Objects that an instruction asks for.

    Attributes:
        words: The words that ask for them.
        categories: What may be meant; empty: anything at all, beside the thing that it is in or on.
        at_least: How many.
    """

    words: str
    categories: tuple[str, ...]
    at_least: int = 1

    def is_met_by(self, categories: Sequence[str]) -> bool:
        """Are there enough of these? One thing of a category that is called by a plural (``wooden_blocks``) is enough of its kind.

        Args:
            categories: Of every object of a layout.
        """
        if not self.categories:
            return len(categories) > self.at_least
        found = [c for c in categories if c in self.categories]
        return len(found) >= self.at_least or any(is_plural(own_noun(c)) for c in found)


def required_objects(instruction: str, statistics: CategoryStatistics) -> tuple[ObjectRequirement, ...]:
    """What an instruction asks for.

    Mentions of one noun are the same thing, unless words tell them apart (``the red mug ... the blue mug``) or one of them is
    said to be another. Nouns that are denied, doubtful or followed by what could be the true head (``the can opener``) ask for
    nothing.

    Args:
        instruction: The instruction.
        statistics: Of the known categories.

    Returns:
        In the order of their first mention; empty where nothing known is named.
    """
    words = words_of(instruction)
    found: dict[str, list[NounPhrase]] = {}
    spoken = []
    for phrase in find_noun_phrases(words, statistics.nouns):
        if (
            phrase.is_denied
            or _is_wanted(words, phrase)
            or statistics.is_doubtful(phrase)
            or _is_part_of_other(words, phrase, statistics)
        ):
            continue
        spoken.append(phrase)
        found.setdefault(phrase.mention.noun, []).append(phrase)
    asked = [_asked(instruction, words, same, statistics) for same in found.values()]
    text = number_phrases(instruction, words, spoken)
    if emptied_numbers(text) or _EVERYTHING.search(text):
        asked.append(ObjectRequirement("what is in or on it", ()))
    return tuple(asked)


def _is_wanted(words: Sequence[TextWord], phrase: NounPhrase) -> bool:
    """Is it something that is not there yet: ``make room for a laptop``?"""
    return phrase.before == "for" and words[phrase.first].text in ("a", "an", "another", "some")


def _is_part_of_other(words: Sequence[TextWord], phrase: NounPhrase, statistics: CategoryStatistics) -> bool:
    """Could the noun be but a part of the name of something else: ``the can opener``, ``a block of paper``, ``cotton pads``?"""
    mention, nouns = phrase.mention, statistics.nouns
    k = mention.last + 1
    after = words[k].text if k < len(words) and not words[k].is_first else ""
    if mention.noun in nouns.names:
        return after in _HEADS
    modifiers = (w.text for w in words[phrase.first : mention.first])
    return after in _HEADS | {"of"} or any(
        m not in FUNCTION_WORDS and not m.isdecimal() and (m in nouns.words or m not in statistics.words) for m in modifiers
    )


def _asked(
    instruction: str, words: Sequence[TextWord], same: Sequence[NounPhrase], statistics: CategoryStatistics
) -> ObjectRequirement:
    """What the mentions of one noun ask for."""
    others = [p for p in same if {"other", "another"} & {*p.modifiers, words[p.first].text}]
    told = {p.modifiers for p in same if p not in others and p.count == 1 and p.modifiers}
    count = max(len(told), *(p.count for p in same))
    if others and len(others) < len(same):
        count = max(count, len(told) + 1, 2)
    first = same[0]
    spelt = instruction[words[first.mention.first].start : words[first.mention.last].end]
    return ObjectRequirement(spelt, statistics.nouns.categories_of(first.mention.noun), count)
