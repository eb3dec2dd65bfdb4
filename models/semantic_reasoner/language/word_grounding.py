"""Replaces unknown nouns of an instruction by known ones, for a model with a closed vocabulary, and reports this in notices.

The embedded reasoner knows only the words of its training instructions. The noun of an unknown object is found by its position
in the sentence. It is replaced by the most similar noun of a known category if a text encoder finds one that is similar enough.
Unknown adjectives, names, people and places are not changed.
"""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field
from types import MappingProxyType
from typing import TypeAlias

import numpy as np
import numpy.typing as npt

from models.semantic_reasoner.language.category_statistics import CategoryStatistics
from models.semantic_reasoner.language.noun_lookup import NounMention, TextWord, words_of
from models.semantic_reasoner.language.stop_words import (
    COUNTS,
    DETERMINERS,
    FUNCTION_WORDS,
    OFF_THE_TABLE,
    PREPOSITIONS,
    is_verb,
)
from models.semantic_reasoner.text.prompt import ANY_TABLE
from stable_data.errors import Notice
from stable_data.instructions.wording.vocabulary import classes_of
from stable_data.instructions.wording.words import is_plural, plural, singular_noun

TextEncoder: TypeAlias = Callable[[Sequence[str]], npt.NDArray[np.float32]]
"""Maps texts to rows of unit length, (N, D)."""

STEP = "grounding"
"""The step in the notices of this module."""

NEAR = 0.7
"""Least cosine similarity for replacing an unknown noun by a known one (all-MiniLM-L6-v2, ``a doughnut`` with ``a donut``)."""

NEAR_IN_CLASS = 0.4
"""Least cosine similarity if both nouns belong to one class of the vocabulary."""

LANGUAGE = 0.5
"""Share of unknown words above which a text counts as another language than English."""

_MIN_FOREIGN = 3  # least number of unknown words in a text of another language

_KINDS = frozenset(
    {
        "drinkware", "saucer", "plate", "bowl", "fork", "knife", "spoon", "cutlery", "pourer", "waterer", "plant", "fruit",
        "blade", "board", "pot", "lid", "writing", "writing_place", "book", "toothbrush", "toothbrush_place", "soap", "soap_place",
        "cosmetics", "laptop", "rubbish_place",
    }
)  # fmt: skip
"""Classes of the vocabulary that state the kind of an object, not its shape or use."""

_ALSO_CALLED = MappingProxyType(
    {
        "biro": "pen", "ballpoint": "pen", "rollerball": "pen", "felt tip": "marker", "rubber": "eraser", "wok": "frying pan",
        "serviette": "napkin", "flacon": "perfume", "lippy": "lipstick", "gamepad": "game controller", "spud": "potato",
        "post its": "sticky notes", "wristwatch": "watch", "specs": "glasses", "eyeglasses": "sunglasses", "biscuit": "cookie",
        "goblet": "wine glass", "carafe": "pitcher",
        "aubergine": "eggplant", "courgette": "cucumber", "clementine": "orange", "mandarin": "orange", "tangerine": "orange",
        "diary": "notebook", "statue": "figurine", "timer": "hourglass", "ramekin": "bowl", "platter": "plate", "flask": "thermos",
        "cellphone": "phone", "bagel": "bun", "hamper": "basket", "teddy": "teddy bear", "telly": "monitor", "couch pillow": "cushion",
        "sofa pillow": "cushion",
    }
)  # fmt: skip
"""Everyday nouns that a small text encoder does not know."""


@dataclass(frozen=True, slots=True)
class GroundedInstruction:
    """An instruction in known words.

    Attributes:
        instruction: The instruction.
        notices: ``word_read_as``, ``word_unknown`` or ``language_unknown``.
    """

    instruction: str
    notices: tuple[Notice, ...] = ()


@dataclass(frozen=True, slots=True)
class UnknownSpan:
    """Words of an instruction that are the noun of an unknown object.

    Attributes:
        first: Index of the first word.
        last: Index of the last word.
        is_opened: Whether a determiner or a number opens the phrase, so that it certainly is an object.
    """

    first: int
    last: int
    is_opened: bool


@dataclass(eq=False)
class WordGrounding:
    """Replaces unknown nouns in instructions for an engine with a closed vocabulary.

    Args:
        statistics: Statistics of categories and words.
        encode: Maps texts to rows of unit length; without it, only common other names are replaced.
        near: See :data:`NEAR`.
        near_in_class: See :data:`NEAR_IN_CLASS`.
    """

    statistics: CategoryStatistics
    encode: TextEncoder | None = None
    near: float = NEAR
    near_in_class: float = NEAR_IN_CLASS
    _rows: npt.NDArray[np.float32] | None = field(default=None, init=False, repr=False)

    def ground(self, instruction: str, item_id: str = "instruction") -> GroundedInstruction:
        """Replaces the unknown nouns of an instruction.

        Args:
            instruction: The instruction.
            item_id: The item of the notices.

        Returns:
            The instruction, in which only unknown nouns with a replacement are changed, and notices.
        """
        words = words_of(instruction)
        if self._is_foreign(words):
            message = f"{item_id}: most words of {_shown(instruction)} are unknown, expected English; write it in English"
            return GroundedInstruction(instruction, (Notice(item_id, STEP, "language_unknown", message),))
        notices, changes = [], []
        for span in self.unknown(words):
            start, end = words[span.first].start, words[span.last].end
            phrase = " ".join(w.text for w in words[span.first : span.last + 1])
            noun = self.nearest(phrase)
            original = _shown(instruction[start:end])
            if noun is not None:
                is_many = words[span.last].text.endswith("s") and not words[span.last].text.endswith("ss")
                changes.append((start, end, plural(noun) if is_many and not is_plural(noun) else noun))
                notices.append(Notice(item_id, STEP, "word_read_as", f"{item_id}: {original} is unknown, read as {noun}"))
            elif span.is_opened:
                message = f"{item_id}: {original} is unknown and no known object is similar; name a known object"
                notices.append(Notice(item_id, STEP, "word_unknown", message))
        for start, end, noun in reversed(changes):
            instruction = f"{instruction[:start]}{noun}{instruction[end:]}"
        return GroundedInstruction(instruction, tuple(dict.fromkeys(notices)))

    def table_type(self, table_type: str, item_id: str = "table") -> tuple[str, tuple[Notice, ...]]:
        """Returns a kind of table if it is known, else the kind for any table, so that the engine sees only its size.

        Args:
            table_type: The kind of table.
            item_id: The item of the notice.

        Returns:
            The kind, and the notice ``table_unknown`` if it is unknown.
        """
        known = self.statistics.tables
        if not known or table_type in (*known, ANY_TABLE):
            return table_type, ()
        message = f"{item_id}: {_shown(table_type)} is an unknown kind of table, only its size is used; known kinds: "
        return ANY_TABLE, (Notice(item_id, STEP, "table_unknown", message + ", ".join(sorted(known))),)

    # --- unknown words ---

    def _is_foreign(self, words: Sequence[TextWord]) -> bool:
        unknown = [w.text for w in words if not self._is_known(w) and not w.is_name]
        if 0 < len(unknown) == len(words) and not all(map(str.isascii, unknown)):
            return True  # a script without spaces between words gives few words
        return len(unknown) >= _MIN_FOREIGN and len(unknown) > LANGUAGE * len(words)

    def _is_known(self, word: TextWord) -> bool:
        text = word.text
        return (
            text in FUNCTION_WORDS
            or text in self.statistics.words
            or text in self.statistics.nouns.words
            or text in OFF_THE_TABLE
            or text.isdecimal()
            or len(text) == 1
            or is_verb(text)
        )

    def unknown(self, words: Sequence[TextWord]) -> Iterator[UnknownSpan]:
        """Yields the nouns of unknown objects in a text, in its order."""
        mentions = self.statistics.nouns.read(words)
        heads = {m.last: m for m in mentions}
        k = 0
        while k < len(words):
            if self._is_known(words[k]) or words[k].is_name or words[k].text.endswith("ly"):
                k += 1
                continue
            first, last = self._chunk(words, k)
            span = self._thing(words, k, first, last, heads)
            if span is not None:
                yield span
            k = last + 1

    def _chunk(self, words: Sequence[TextWord], k: int) -> tuple[int, int]:
        """First and last index of the content words around an unknown word."""
        first = last = k
        while first > 0 and not words[first].is_first and _is_content(words[first - 1]):
            first -= 1
        while last + 1 < len(words) and not words[last + 1].is_first and _is_content(words[last + 1], after=True):
            last += 1
        return first, last

    def _thing(
        self, words: Sequence[TextWord], k: int, first: int, last: int, heads: dict[int, NounMention]
    ) -> UnknownSpan | None:
        """The part of a chunk that is the noun of an unknown object, or None."""
        head, following = words[last].text, words[last + 1].text if last + 1 < len(words) else ""
        known = heads.get(last)
        if known is not None and (known.noun in self.statistics.nouns.names or known.first <= k):
            return None  # the unknown word is an adjective of a known noun
        is_adjective = head.endswith(("est", "ing", "ed", "ly")) or (
            following in ("one", "ones") and not words[last + 1].is_first
        )
        if head in OFF_THE_TABLE or singular_noun(head) in OFF_THE_TABLE or is_adjective or words[last].is_name:
            return None
        if any(first <= m.first and m.last < k for m in heads.values()):
            return None  # "the mug wobbles": the unknown word may be a verb
        begin = next((j for j in range(first, last + 1) if not self._only_describes(words[j])), k)
        before = words[first - 1].text if first > 0 and not words[first].is_first else ""
        is_opened = before in DETERMINERS or before in COUNTS or before.isdecimal() or before in _ORDINALS
        if not is_opened and before == "to":
            is_near = first > 1 and words[first - 2].text in _NEXT
            return UnknownSpan(begin, last, is_opened=False) if is_near else None
        if is_opened or before in PREPOSITIONS or before == "and" or is_verb(before):
            return UnknownSpan(begin, last, is_opened)
        return None

    def _only_describes(self, word: TextWord) -> bool:
        """Whether a known word is part of no noun, such as ``red``."""
        return (word.text in self.statistics.words or is_verb(word.text)) and word.text not in self.statistics.nouns.words

    # --- similar nouns ---

    def nearest(self, phrase: str) -> str | None:
        """Returns the known noun that is most similar to a noun in lower case, or None if none is similar enough."""
        names = sorted(self.statistics.nouns.names)
        one = singular_noun(phrase)
        for spelt in (phrase, one):
            if _ALSO_CALLED.get(spelt) in self.statistics.nouns.names:
                return _ALSO_CALLED[spelt]
        if self.encode is None or not names:
            return None
        if self._rows is None:
            self._rows = np.asarray(self.encode([f"a {name}" for name in names]))
        similarity = self._rows @ np.asarray(self.encode([f"a {one}"]))[0]
        kinds = classes_of(one) & _KINDS
        if kinds:
            shared = [len(kinds & classes_of(name)) for name in names]
            of_kind = max((k for k, n in enumerate(shared) if n == max(shared) > 0), key=lambda k: similarity[k], default=None)
            if of_kind is not None and similarity[of_kind] >= self.near_in_class:
                return names[of_kind]
        best = int(similarity.argmax())
        return names[best] if similarity[best] >= self.near else None


_ORDINALS = frozenset({"other", "another", "first", "second", "third", "last", "next", "left", "right"})
_NEXT = frozenset({"next", "close", "on", "in", "closer", "nearer", "nearest", "closest", "over", "up"})


def _is_content(word: TextWord, after: bool = False) -> bool:
    """Whether a word can be part of a noun phrase; a participle such as ``chipped`` can be so only before the noun."""
    if word.text in FUNCTION_WORDS or word.text.isdecimal() or word.text.endswith("ly"):
        return False
    is_participle = word.text.endswith(("ed", "ing"))
    return not (is_verb(word.text) or is_participle) if after else not is_verb(word.text) or is_participle


def _shown(text: str) -> str:
    words = " ".join(text.split())
    return repr(words if len(words) <= 60 else f"{words[:57]}...")
