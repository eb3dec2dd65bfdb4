"""Noun phrases of an instruction: a noun of a known category with what is said before and after it."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

from models.semantic_reasoner.language.noun_lookup import NounLookup, NounMention, TextWord
from models.semantic_reasoner.language.stop_words import COUNTS, DETERMINERS, FUNCTION_WORDS, HOMOGRAPHS, NONE_OF, word_set
from stable_data.instructions import naming
from stable_data.instructions.claims import number_mentions

MOST = 20
"""A larger number before a noun is no count of objects."""

_REACH = 6  # words between a determiner and its noun, at most
_CLAUSE = 7  # words of a clause after a noun that tell things apart

_PLACES = word_set(
    "left right front rear middle leftmost rightmost nearer nearest farther farthest other second first third last"
    " upper lower own little next hand"
)
"""Function words that may stand between a determiner and its noun."""

_CLAUSE_OPENS = word_set("that which standing lying resting sitting closer nearer closest nearest farther on")
_CLAUSE_ENDS = word_set("left right back front me edge corner")
_ON_SIDE = 3


@dataclass(frozen=True, slots=True)
class NounPhrase:
    """A noun phrase.

    Attributes:
        first: Index of its first word, determiner and count included.
        mention: Its noun.
        before: The word before it, possibly nothing.
        modifiers: Words between its determiner and its noun, and those of a clause after it that tell it apart.
        count: How many of the thing it speaks of.
        is_denied: Whether it speaks of none.
        clause: Words of a clause after the noun that says where the thing is, possibly none.
    """

    first: int
    mention: NounMention
    before: str
    modifiers: tuple[str, ...]
    count: int
    is_denied: bool
    clause: tuple[str, ...]


def find_noun_phrases(words: Sequence[TextWord], nouns: NounLookup) -> Iterator[NounPhrase]:
    """The noun phrases of a text that speak of things of known categories, in its order.

    Args:
        words: The text.
        nouns: What the known categories are called.
    """
    for mention in nouns.read(words):
        first, counts = _opening(words, mention)
        is_open = first is not None
        if not is_open and (mention.noun in HOMOGRAPHS or mention.noun not in nouns.names):
            continue  # "so that it can stand"
        k = mention.first if first is None else first
        lead = [w.text for w in words[k : mention.first]]
        before = words[k - 1].text if k > 0 and not words[k].is_first else ""
        count = max([2, *counts]) if mention.is_plural else 1
        modifiers = tuple(w for w in lead if w not in DETERMINERS and w not in COUNTS and not w.isdecimal() and w != "of")
        is_denied = bool({*lead, before} & NONE_OF) or count > MOST or 0 in counts
        clause = _clause(words, mention)
        yield NounPhrase(k, mention, before, (*modifiers, *clause), count, is_denied, clause)


def _opening(words: Sequence[TextWord], mention: NounMention) -> tuple[int | None, list[int]]:
    """Where the phrase of a noun starts, None where nothing opens it; and its numbers."""
    counts: list[int] = []
    first = None
    k = mention.first
    while k > 0 and mention.first - k < _REACH and not words[k].is_first:
        word = words[k - 1].text
        if word in COUNTS or word.isdecimal():
            counts.append(COUNTS[word] if word in COUNTS else int(word[:4]))
            first = k - 1
        elif word in DETERMINERS or word in NONE_OF or (word == "of" and counts):
            first = k - 1
        elif first is not None or (word in FUNCTION_WORDS and word not in _PLACES):
            break
        k -= 1
    return first, counts


def _clause(words: Sequence[TextWord], mention: NounMention) -> tuple[str, ...]:
    """What a clause after a noun says of its place to tell it apart: ``that is on the left``; empty where there is none."""
    k = mention.last + 1
    if k >= len(words) or words[k].is_first or words[k].text not in _CLAUSE_OPENS:
        return ()
    said: list[str] = []
    for word in words[k : k + (_ON_SIDE if words[k].text == "on" else _CLAUSE)]:
        if word.is_first or (said and said[-1] in _CLAUSE_ENDS and word.text not in _CLAUSE_ENDS):
            break
        said.append(word.text)
    return tuple(said) if said[-1] in _CLAUSE_ENDS else ()


def number_phrases(text: str, words: Sequence[TextWord], spoken: Sequence[NounPhrase]) -> str:
    """A text with each phrase as its number, its clause included, as :mod:`stable_data.instructions.claims` reads it.

    Args:
        text: The text.
        words: Its words.
        spoken: Phrases in it, in its order.
    """
    names = [str(k) for k in range(len(spoken))]
    unnamed = naming.ObjectName("", "", naming.Distinction.NOUN)
    said = [
        naming.ObjectMention(words[p.first].start, words[_last(words, p)].end, name, unnamed)
        for name, p in zip(names, spoken, strict=True)
    ]
    return number_mentions(text, (), said, names)


def _last(words: Sequence[TextWord], phrase: NounPhrase) -> int:
    """Index of a phrase's last word; ``that is to the left of the jar`` is no clause of its own."""
    last = phrase.mention.last + len(phrase.clause)
    goes_on = last + 1 < len(words) and words[last + 1].text == "of" and not words[last + 1].is_first
    return phrase.mention.last if goes_on else last
