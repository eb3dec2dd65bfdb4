"""The text of an edit with its reading: which object is mentioned where, and what is said of it."""

import re
from collections.abc import Callable
from dataclasses import replace

from models.instruction_reader.lexicon import Lexicon
from models.instruction_reader.reading import InstructionReading, MentionedObject
from models.instruction_reader.sentences import split_words

IsDetail = Callable[[str, str], bool]
"""Whether a word is one of those that describe objects of a category."""


class SpokenText:
    """The reading while the rules change it; positions are those of characters of the text."""

    def __init__(self, reading: InstructionReading, text: str, lexicon: Lexicon, is_detail: IsDetail) -> None:
        self.objects, self.start, self.goal = list(reading.objects), list(reading.start), list(reading.goal)
        self._forgotten: set[int] = set()
        self._text, self._lexicon, self._is_detail = text.lower().replace("’", "'"), lexicon, is_detail

    # --- which objects stand where in the text ---

    def _places(self) -> list[tuple[int, int, int]]:
        """Start, end and number of the first object of each mention, in the order of the text."""
        first: dict[tuple[int, int], int] = {}
        for k, one in enumerate(self.objects):
            for place in one.mentions if k not in self._forgotten else ():
                first.setdefault(place, k)
        return sorted((start, end, k) for (start, end), k in first.items())

    def _before(self, position: int, same_sentence: bool = True) -> int | None:
        """The last object mentioned before a position."""
        least = max((m.end() for m in re.finditer(r"[.!?;]", self._text[:position])), default=0) if same_sentence else 0
        found = [(end, k) for start, end, k in self._places() if end <= position and start >= least]
        return max(found)[1] if found else None

    def _at(self, position: int, words: int = 2) -> int | None:
        """The object mentioned at a position, or after a few words."""
        for start, _, k in self._places():
            if start >= position and len(split_words(self._text[position:start])) <= words:
                return k
        return None

    def _after(self, position: int) -> int | None:
        """The first object mentioned after a position in its sentence."""
        end = next((m.start() + position for m in re.finditer(r"[.!?;]", self._text[position:])), len(self._text))
        return next((k for start, _, k in self._places() if position <= start < end), None)

    def _family(self, number: int) -> list[int]:
        """All objects of the name of one."""
        return [k for k, one in enumerate(self.objects) if one.name == self.objects[number].name]

    def _change(self, number: int, change: str) -> None:
        for k in self._family(number):
            self.objects[k] = replace(self.objects[k], change=change)

    def _has_role(self, number: int) -> bool:
        own = self._family(number)
        return any(self.objects[k].change or self.objects[k].goal_region for k in own) or any(
            r.subject in own or (r.kind in ("replace", "swap") and r.target in own) for r in self.goal
        )

    def _forget(self, number: int) -> None:
        """Takes all that is said of an object, but not the object, so that the numbers stay."""
        own = set(self._family(number))
        self._forgotten |= own
        for k in own:
            self.objects[k] = replace(self.objects[k], change="", goal_region="", region="")
        self.goal = [r for r in self.goal if not own & {r.subject, r.target}]
        self.start = [r for r in self.start if not own & {r.subject, r.target}]

    def _add(self, words: str, place: tuple[int, int], categories: tuple[str, ...] = (), is_open: bool = False) -> int:
        name = max((one.name for one in self.objects), default=-1) + 1
        self.objects.append(MentionedObject(words, categories, mentions=(place,), name=name, is_one_of_many=is_open))
        return len(self.objects) - 1

    def _is_new(self, number: int) -> bool:
        """Whether the words before an object say that it is not there yet."""
        words = split_words(self._text[: self.objects[number].mentions[0][0]]) if self.objects[number].mentions else []
        return not words or words[-1] not in ("the", "that", "this", "these", "those", "my", "our", "your", "his", "her")
