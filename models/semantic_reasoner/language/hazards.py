"""Finds instructions that no robot should carry out: violence, fire, and liquid on electric devices.

The start scene of such an instruction is harmless, so it is made; a warning says that the task is dangerous. The words are few and
plain on purpose: a warning that comes often is not read.
"""

import re

from models.instruction_reader.nouns import is_electric
from models.instruction_reader.reading import InstructionReading

_VIOLENT = "attack|burn|detonate|electrocute|explode|hurt|ignite|injure|kick|kill|poison|punch|shatter|slash|smash|stab|strangle|threaten"
_SOMETHING = (
    r"(?:the|a|an|my|your|his|her|their|our|this|that|these|those|him|them|me|someone|somebody|everyone|everybody|people)\b"
)
_HARM = re.compile(
    rf"\b(?:{_VIOLENT}) (?!me\b){_SOMETHING}"  # "she will kill me" is an idiom
    rf"|\b(?:throw|hurl|fling|toss|chuck)\b[^.;!?]{{1,40}}? at {_SOMETHING}"
    rf"|\b(?:point|aim|swing|wave)\b[^.;!?]{{1,30}}?\b(?:knife|knives|scissors|blade|razor)\b[^.;!?]{{0,20}}? at {_SOMETHING}"
    r"|\bset fire to\b|\bset [^.;!?]{1,30}? (?:on fire|alight)\b"
)
_WET = re.compile(r"\b(?:pour|spill|splash|spray)\b[^.;!?]*\b(?:over|on|onto|into|in)(?: \w+){0,3} $")
_WASHED = re.compile(r"\b(?:boil|drown|dunk|flood|immerse|microwave|rinse|soak|submerge|wash)(?: \w+){0,3} $")
_NOT = re.compile(r"\b(?:don't|dont|do not|never|not|without|avoid|n't)(?: \w+){0,3} $")


def hazard_of(instruction: str, reading: InstructionReading) -> str | None:
    """Returns the words of an instruction that ask for something dangerous, or None.

    Args:
        instruction: The instruction.
        reading: Its reading.
    """
    text = instruction.lower().replace("’", "'")
    for harm in _HARM.finditer(text):
        if not _NOT.search(text[: harm.start()]):
            return harm[0]
    for one in reading.objects:
        for start, end in one.mentions if any(map(is_electric, one.categories)) else ():
            before = text[:start]
            for words in (_WET, _WASHED):
                if (found := words.search(before)) is not None and not _NOT.search(before[: found.start()]):
                    return text[found.start() : end]
    return None
