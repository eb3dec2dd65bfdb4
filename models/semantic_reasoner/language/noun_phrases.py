"""Noun phrases of an instruction: nouns of known categories with the words around them."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

from models.semantic_reasoner.language.noun_lookup import NounLookup, NounMention, TextWord
from models.semantic_reasoner.language.stop_words import COUNTS, DETERMINERS, FUNCTION_WORDS, HOMOGRAPHS, NONE_OF, word_set
from stable_data.instructions import naming
from stable_data.instructions.claims import number_mentions

MOST = 20
"""Largest count of objects; a larger number before a noun is not a count."""

_REACH = 6  # largest number of words between a determiner and its noun
_CLAUSE = 7  # largest number of words of a clause of place after a noun

_PLACES = word_set(
    "left right front rear middle leftmost rightmost nearer nearest farther farthest other second first third last"
    " upper lower own little next hand"
)
"""Function words that may stand between a determiner and its noun."""

_CLAUSE_OPENS = word_set("that which standing lying resting sitting closer nearer closest nearest farther on")
_CLAUSE_ENDS = word_set("left right back front me edge corner")
_ON_SIDE = 3  # the same for a clause that starts with "on", such as "on the left"


@dataclass(frozen=True, slots=True)
class NounPhrase:
    """A noun phrase.

    Attributes:
        first: Index of its first word, determiner and count included.
        mention: Its noun.
        before: The word before it, or empty.
        modifiers: Words between its determiner and its noun, and the words of ``clause``.
        count: Number of objects that it means.
        is_denied: Whether it means no object, as in ``without a mug``.
        clause: Words of a clause after the noun that gives the place of the object, possibly none.
    """

    first: int
    mention: NounMention
    before: str
    modifiers: tuple[str, ...]
    count: int
    is_denied: bool
    clause: tuple[str, ...]


def find_noun_phrases(words: Sequence[TextWord], nouns: NounLookup) -> Iterator[NounPhrase]:
    """Yields the noun phrases of a text whose nouns are known, in its order.

    Args:
        words: The text.
        nouns: The known nouns.
    """
    for mention in nouns.read(words):
        first, counts = _opening(words, mention)
        is_open = first is not None
        if not is_open and (mention.noun in HOMOGRAPHS or mention.noun not in nouns.names):
            continue  # without a determiner, "can" in "so that it can stand" is a verb
        k = mention.first if first is None else first
        lead = [w.text for w in words[k : mention.first]]
        before = words[k - 1].text if k > 0 and not words[k].is_first else ""
        count = max([2, *counts]) if mention.is_plural else 1
        modifiers = tuple(w for w in lead if w not in DETERMINERS and w not in COUNTS and not w.isdecimal() and w != "of")
        is_denied = bool({*lead, before} & NONE_OF) or count > MOST or 0 in counts
        clause = _clause(words, mention)
        yield NounPhrase(k, mention, before, (*modifiers, *clause), count, is_denied, clause)


def _opening(words: Sequence[TextWord], mention: NounMention) -> tuple[int | None, list[int]]:
    """Index of the first word of the phrase of a noun, or None if no determiner or count opens it; and its counts."""
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
    """The words of a clause of place after a noun, such as ``that is on the left``; empty if there is none."""
    k = mention.last + 1
    if k >= len(words) or words[k].is_first or words[k].text not in _CLAUSE_OPENS:
        return ()
    clause: list[str] = []
    for word in words[k : k + (_ON_SIDE if words[k].text == "on" else _CLAUSE)]:
        if word.is_first or (clause and clause[-1] in _CLAUSE_ENDS and word.text not in _CLAUSE_ENDS):
            break
        clause.append(word.text)
    return tuple(clause) if clause[-1] in _CLAUSE_ENDS else ()


def number_phrases(text: str, words: Sequence[TextWord], phrases: Sequence[NounPhrase]) -> str:
    """Replaces each phrase with its clause by its number, the format of :mod:`stable_data.instructions.claims`.

    Args:
        text: The text.
        words: Its words.
        phrases: Phrases in it, in its order.
    """
    names = [str(k) for k in range(len(phrases))]
    unnamed = naming.ObjectName("", "", naming.Distinction.NOUN)
    mentioned = [
        naming.ObjectMention(words[p.first].start, words[_last(words, p)].end, name, unnamed)
        for name, p in zip(names, phrases, strict=True)
    ]
    return number_mentions(text, (), mentioned, names)


def _last(words: Sequence[TextWord], phrase: NounPhrase) -> int:
    """Index of the last word of a phrase; ``that is to the left of the jar`` is not part of the phrase."""
    last = phrase.mention.last + len(phrase.clause)
    goes_on = last + 1 < len(words) and words[last + 1].text == "of" and not words[last + 1].is_first
    return phrase.mention.last if goes_on else last
