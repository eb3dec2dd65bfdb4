"""The instruction reader: text to what it says."""

from collections.abc import Iterable, Sequence
from functools import lru_cache
from pathlib import Path

import numpy as np
import torch

from models.instruction_reader.decoding import decode, spans_of
from models.instruction_reader.frames import read_frames
from models.instruction_reader.lexicon import Lexicon
from models.instruction_reader.nouns import read_nouns
from models.instruction_reader.reading import InstructionReading
from models.instruction_reader.sentences import EDIT_MARK, split_words
from models.instruction_reader.spelling import Spelling
from models.instruction_reader.weights import DEFAULT_WEIGHTS, ReaderModel, load_reader

_MOST_WORDS = 200
_MOST_MENTIONS = 40


class InstructionReader:
    """Reads instructions.

    Args:
        model: The network.
        lexicon: The nouns of the known categories.
        spelling: The known words.
    """

    def __init__(self, model: ReaderModel, lexicon: Lexicon, spelling: Spelling) -> None:
        self._model, self._lexicon, self._spelling = model, lexicon, spelling
        self._read = lru_cache(maxsize=4096)(self._reading)

    @classmethod
    def load(cls, categories: Iterable[str], path: Path = DEFAULT_WEIGHTS) -> "InstructionReader":
        """Returns a reader of these categories.

        Raises:
            ConfigError: The weights cannot be read.
        """
        nouns, model = read_nouns(), load_reader(path)
        return cls(model, Lexicon.of(nouns, categories), Spelling.of(read_frames(), nouns, model.tokens.whole_words))

    def read(self, text: str, is_edit: bool = False) -> InstructionReading:
        """Returns what a text says; words after the first 200 are not read.

        Args:
            text: The text.
            is_edit: Whether it says how to change a scene.
        """
        return self._read(text, is_edit)

    def _reading(self, text: str, is_edit: bool) -> InstructionReading:
        mark = list(EDIT_MARK) if is_edit else []
        words = [*mark, *self._spelling.mend(split_words(text)[:_MOST_WORDS])]
        if len(words) == len(mark):
            return InstructionReading(())
        return self._of_words(words)

    @torch.no_grad()
    def _of_words(self, words: Sequence[str]) -> InstructionReading:
        network = self._model.network
        rows = network.words(self._model.tokens.batch([words]))
        spans = spans_of(network.tags(rows)[0].argmax(-1).tolist())[:_MOST_MENTIONS]
        if not spans:
            return InstructionReading(())
        scores = network.mention_scores(rows, torch.tensor([spans]), torch.ones(1, len(spans), dtype=torch.bool))
        said = {name: value[0].softmax(-1).numpy() for name, value in scores.said.items()}
        start, goal = (np.asarray(value[0].softmax(-1)) for value in (scores.start, scores.goal))
        return decode(words, spans, said, start, goal, self._lexicon)
