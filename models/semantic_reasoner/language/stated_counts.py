"""The number before a plural, read from its words.

The network reads counts up to eight, and not each of them surely. A plural with a number before it gets as many objects. Those that
the reader lacks are copies of the others, with the relations that all of them have: twelve mugs on a tray are all on it, and a stack
of twelve plates is one stack.
"""

import re
from collections import Counter
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import replace
from itertools import pairwise, product

from models.instruction_reader.reading import InstructionReading, MentionedRelation
from stable_data.instructions.wording.words import is_plural, plural, singular_noun
from stable_data.storage.json_schemas import MOST_ENTRIES

_LARGEST_READ = 8  # it means eight or more

_LONGEST = 80  # characters of a number in words

_ONES = "one two three four five six seven eight nine ten eleven twelve thirteen fourteen fifteen sixteen seventeen eighteen nineteen"
_TENS = "ten twenty thirty forty fifty sixty seventy eighty ninety"
_VALUES: Mapping[str, int] = {
    **{word: n for n, word in enumerate(_ONES.split(), 1)},
    **{word: 10 * n for n, word in enumerate(_TENS.split(), 1)},
}
_FACTORS: Mapping[str, int] = {"dozen": 12, "hundred": 100, "thousand": 1000, "million": 10**6, "billion": 10**9}
_WORD = rf"(?:half a dozen|\d{{1,3}}(?:,\d{{3}})+|\d+|{'|'.join((*_VALUES, *_FACTORS))})\b"
_NUMBER = rf"{_WORD}(?:(?:[ -]|(?:(?<=hundred)|(?<=thousand)|(?<=million)|(?<=billion)),? and ){_WORD})*"
_OF = r"( of)?(?: the| my| our| your| these| those)?"
_BEFORE = re.compile(rf"(?<![\d.,-])\b({_NUMBER})(?: more| other)?{_OF} *$", re.IGNORECASE)
_UNITS = r"(?:[cm]?[lm]|k?g|oz|lbs?|inch|inches|pounds?|(?:centi|milli)?(?:met|lit)(?:er|re)s?)\b"
_WITHIN = re.compile(rf"({_NUMBER})( of)? (?!{_UNITS})", re.IGNORECASE)  # not "500 ml bottles"


def number_of(words: str) -> int:
    """Returns the number that words or digits state, such as ``one hundred and twenty``."""
    whole, part = 0, 0
    for word in re.findall(r"[a-z]+|\d[\d,]*", words.lower().replace("half a dozen", "6")):
        if word in _FACTORS:
            part = max(1, part) * _FACTORS[word]
            if part >= 1000:
                whole, part = whole + part, 0
        elif word != "and":
            part += _VALUES.get(word) or int(word.replace(",", ""))
    return whole + part


def with_stated_counts(reading: InstructionReading, instruction: str) -> tuple[InstructionReading, int]:
    """Gives plurals the numbers that are stated before them.

    Args:
        reading: The reading.
        instruction: Its instruction.

    Returns:
        The reading, and the number of known objects that the instruction states. If this is more than a layout can have, the
        reading is as it was.
    """
    plurals: dict[tuple[tuple[int, int], ...], list[int]] = {}
    for k, o in enumerate(reading.objects):
        if o.categories and o.mentions:
            plurals.setdefault(o.mentions, []).append(k)
    num_like = Counter(o.categories for o in reading.objects)
    missing = {}
    for places, numbers in plurals.items():
        stated = max(_stated(instruction, *place) for place in places)
        # A small plural may have parts of other names, as in "of the four eggs, two are in cups; the loose ones are not".
        known = len(numbers) if stated > _LARGEST_READ else num_like[reading.objects[numbers[0]].categories]
        missing[numbers[-1]] = max(0, stated - known)
    count = sum(bool(o.categories) for o in reading.objects) + sum(missing.values())
    if count > MOST_ENTRIES or not any(missing.values()):
        return reading, count
    objects = [replace(o, is_one_of_many=False) if missing.get(k) else o for k, o in enumerate(reading.objects)]
    named: dict[int, list[int]] = {}
    for k, o in enumerate(objects):
        named.setdefault(o.name, []).append(k)
    for k, more in missing.items():
        named[objects[k].name] += range(len(objects), len(objects) + more)
        objects += [objects[k]] * more
    grown = {objects[k].name for k, more in missing.items() if more}
    start, goal, contradictions = (
        tuple(_expanded(relations, [o.name for o in objects], named, grown))
        for relations in (reading.start, reading.goal, reading.contradictions)
    )
    return InstructionReading(tuple(objects), start, goal, contradictions), count


def _stated(instruction: str, start: int, end: int) -> int:
    """The number before a plural noun, or at its start; 0 without one."""
    phrase = instruction[start:end]
    noun = phrase.split()[-1].lower()
    if not (is_plural(noun) or noun == plural(singular_noun(noun))):
        return 0
    found = _WITHIN.match(phrase[:_LONGEST]) or _BEFORE.search(instruction[max(0, start - _LONGEST) : start])
    return 0 if found is None else number_of(found[1])


def _expanded(
    relations: Iterable[MentionedRelation], name: Sequence[int], named: Mapping[int, Sequence[int]], grown: set[int]
) -> Iterator[MentionedRelation]:
    """The relations, those of plurals that have grown as the reader gives them."""
    found: dict[tuple[int, str, int], float] = {}
    for r in relations:
        one, other = name[r.subject], name[r.target]
        if {one, other} & grown:
            found[one, r.kind, other] = max(r.score, found.get((one, r.kind, other), 0.0))
        else:
            yield r
    for (one, kind, other), score in found.items():
        subjects, targets = named[one], named[other]
        if one == other:
            pairs: Iterable[tuple[int, int]] = pairwise(subjects)
        elif len(subjects) == len(targets):
            pairs = zip(subjects, targets, strict=True)  # each has its own
        else:
            pairs = product(subjects, targets[:1] if kind in ("in", "on") else targets)
        yield from (MentionedRelation(a, kind, b, score) for a, b in pairs)
