"""The instruction reader: text to what it says."""

import hashlib
from collections.abc import Iterable, Sequence
from dataclasses import asdict
from functools import cache, lru_cache
from itertools import islice
from pathlib import Path

import numpy as np
import torch

from models.instruction_reader.decoding import decode, join_purposes, spans_of
from models.instruction_reader.frames import read_texts
from models.instruction_reader.lexicon import Lexicon
from models.instruction_reader.nouns import read_nouns
from models.instruction_reader.reading import InstructionReading
from models.instruction_reader.sentences import EDIT_MARK, WORD
from models.instruction_reader.spelling import Spelling
from models.instruction_reader.weights import DEFAULT_WEIGHTS, ReaderModel, load_reader
from stable_data.content_id import content_id

_NOUN_BONUS, _NAME_BONUS = 2.0, 5.0
"""What is taken from the score of "no mention" for a known noun, and for the name of a category: frames have each of the many nouns
in few sentences, but not all nouns always mean an object (``tea``)."""

_MOST_WORDS = 200
_MOST_MENTIONS = 40


@cache
def reader_fingerprint() -> str:
    """Returns a hash of the shipped weights and nouns, on which every reading depends."""
    return content_id(hashlib.sha256(DEFAULT_WEIGHTS.read_bytes()).hexdigest(), asdict(read_nouns()))


@lru_cache(maxsize=1)
def _opened(path: Path) -> tuple[ReaderModel, Spelling]:
    model = load_reader(path)
    return model, Spelling.of(read_texts(), read_nouns(), model.tokens.whole_words)


class InstructionReader:
    """Reads instructions.

    Args:
        model: The network.
        lexicon: The nouns of the known categories.
        spelling: The known words.

    Attributes:
        lexicon: The nouns of the known categories.
    """

    def __init__(self, model: ReaderModel, lexicon: Lexicon, spelling: Spelling) -> None:
        self._model, self.lexicon, self._spelling = model, lexicon, spelling

    @classmethod
    def load(cls, categories: Iterable[str], path: Path = DEFAULT_WEIGHTS) -> "InstructionReader":
        """Returns a reader of these categories.

        Raises:
            ConfigError: The weights cannot be read.
        """
        model, spelling = _opened(path)
        return cls(model, Lexicon.of(read_nouns(), categories, spelling.words), spelling)

    def knows(self, word: str) -> bool:
        """Returns whether a word in lower case, or its stem, is one of the words of the training or of the nouns."""
        return self._spelling.is_frequent(word)

    def read(self, text: str, is_edit: bool = False) -> InstructionReading:
        """Returns what a text says; words after the first 200 are not read.

        Args:
            text: The text.
            is_edit: Whether it says how to change a scene.
        """
        mark = EDIT_MARK if is_edit else ()
        found = list(islice(WORD.finditer(text), _MOST_WORDS))
        if not found:
            return InstructionReading(())
        words = [*mark, *self._spelling.mend([m[0].lower() for m in found])]
        return self._of_words(words, [(0, 0)] * len(mark) + [m.span() for m in found])

    @torch.no_grad()
    def _of_words(self, words: Sequence[str], places: Sequence[tuple[int, int]]) -> InstructionReading:
        network = self._model.network
        rows = network.words(self._model.tokens.batch([words]))
        tags = network.tags(rows)[0]
        for k, word in enumerate(words[: len(tags)]):
            if self.lexicon.is_noun(word):
                tags[k, 0] -= _NAME_BONUS if self.lexicon.is_name(word) else _NOUN_BONUS
        spans = join_purposes(words, spans_of(tags.argmax(-1).tolist()), self.lexicon)[:_MOST_MENTIONS]
        if not spans:
            return InstructionReading(())
        scores = network.mention_scores(rows, torch.tensor([spans]), torch.ones(1, len(spans), dtype=torch.bool))
        said = {name: value[0].softmax(-1).numpy() for name, value in scores.said.items()}
        start, goal = (np.asarray(value[0].softmax(-1)) for value in (scores.start, scores.goal))
        return decode(words, spans, said, start, goal, self.lexicon, places)
