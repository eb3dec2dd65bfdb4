"""Examples as tokens, written to files once and mapped into memory."""

import itertools
import os
import shutil
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import BinaryIO, TypeAlias

import numpy as np
import numpy.typing as npt
from transformers import PreTrainedTokenizerBase

from models.semantic_reasoner.text.prompt import WANTED
from models.semantic_reasoner.text.tokenizer import chat_text
from models.semantic_reasoner.training.examples import TrainingExample
from stable_data.errors import SceneError
from stable_data.scene import IntArray

Tokens: TypeAlias = npt.NDArray[np.int32]

KINDS = tuple(WANTED)
"""Kinds of questions, in the order of :attr:`TokenDataset.kind`."""

_TOKENS, _INDEX = "tokens.bin", "index.npz"
_INDEX_ARRAYS = ("start", "reply", "kind", "too_long", "unasked")
_CHUNK = 512


@dataclass(frozen=True, slots=True, eq=False)
class TokenDataset:
    """Concatenated examples as tokens.

    Attributes:
        tokens: Tokens of all examples, (T,) int32.
        start: Index of each example's first token, and T at the end, (E + 1,) int64.
        reply: Index of the first token of each example's reply, (E,) int64: from there on the loss counts.
        kind: Index of each example's kind in :data:`KINDS`, (E,) int64.
        too_long: Number of examples of each kind that were left out as too long, (K,) int64.
        unasked: Number of examples of each kind that were left out for their instruction, empty or too long, (K,) int64.
    """

    tokens: Tokens
    start: IntArray
    reply: IntArray
    kind: IntArray
    too_long: IntArray
    unasked: IntArray

    def __len__(self) -> int:
        return len(self.kind)

    @property
    def length(self) -> IntArray:
        """Tokens of each example, (E,) int64."""
        return np.diff(self.start)

    @property
    def reply_length(self) -> IntArray:
        """Tokens of each example's reply, (E,) int64."""
        return self.start[1:] - self.reply

    def of(self, example: int) -> tuple[Tokens, int]:
        """Returns an example's tokens and the number of its prompt's tokens."""
        begin, end = self.start[example], self.start[example + 1]
        return self.tokens[begin:end], int(self.reply[example] - begin)


def _encoded(
    examples: Iterable[TrainingExample], tokenizer: PreTrainedTokenizerBase, index: "_Index", max_tokens: int
) -> Iterator[Tokens]:
    """The tokens of the examples that can be used; the index counts all examples."""
    remaining = iter(examples)
    while part := list(itertools.islice(remaining, _CHUNK)):
        # Encoding many texts at once is several times faster than one chat at a time.
        asked = [(example, text) for example in part if (text := _prompt(example, tokenizer, index)) is not None]
        answers = [example.answer + str(tokenizer.eos_token) for example, _ in asked]
        texts = ([text for _, text in asked], answers)
        # Tokenizers refuse an empty list.
        encoded = [tokenizer(of, add_special_tokens=False)["input_ids"] if of else [] for of in texts]
        for (example, _), prompt, reply in zip(asked, *encoded, strict=True):
            if index.add(KINDS.index(example.question.wanted), len(prompt), len(reply), max_tokens):
                yield np.array([*prompt, *reply], "<i4")


def _prompt(example: TrainingExample, tokenizer: PreTrainedTokenizerBase, index: "_Index") -> str | None:
    try:
        chat = example.prompt
    except SceneError:
        index.unasked[KINDS.index(example.question.wanted)] += 1
        return None
    return chat_text(tokenizer, chat)


def tokenize_examples(examples: Iterable[TrainingExample], tokenizer: PreTrainedTokenizerBase, max_tokens: int) -> TokenDataset:
    """Tokenizes examples in memory; see :func:`write_tokens`."""
    index = _Index()
    parts = list(_encoded(examples, tokenizer, index, max_tokens))
    return index.dataset(np.concatenate(parts) if parts else np.zeros(0, np.int32))


def write_tokens(
    folder: Path, examples: Iterable[TrainingExample], tokenizer: PreTrainedTokenizerBase, max_tokens: int
) -> TokenDataset:
    """Tokenizes examples into a folder, which is written atomically, and maps it, so that they are never all in memory.

    The tokenizer has a chat template. Examples of more than ``max_tokens`` tokens are left out and counted.
    """
    temporary = folder.with_name(f".{folder.name}.{os.getpid()}")
    shutil.rmtree(temporary, ignore_errors=True)
    temporary.mkdir(parents=True)
    try:
        index = _Index()
        with (temporary / _TOKENS).open("wb") as file:
            for tokens in _encoded(examples, tokenizer, index, max_tokens):
                tokens.tofile(file)
            _flush_to_disk(file)
        found = index.dataset(np.zeros(0, np.int32))
        with (temporary / _INDEX).open("wb") as file:
            np.savez(file, **{name: getattr(found, name) for name in _INDEX_ARRAYS})
            _flush_to_disk(file)
        shutil.rmtree(folder, ignore_errors=True)  # an incomplete one, from which :func:`read_tokens` returned None
        temporary.replace(folder)
    finally:
        shutil.rmtree(temporary, ignore_errors=True)
    made = read_tokens(folder)
    assert made is not None
    return made


def read_tokens(folder: Path) -> TokenDataset | None:
    """Returns the dataset that :func:`write_tokens` wrote, with mapped tokens; None if there is no complete one."""
    try:
        with np.load(folder / _INDEX, allow_pickle=False) as index:
            arrays = {name: index[name] for name in _INDEX_ARRAYS}
        total = int(arrays["start"][-1])
        is_whole = (folder / _TOKENS).stat().st_size == 4 * total
        tokens = np.memmap(folder / _TOKENS, "<i4", "r") if total else np.zeros(0, np.int32)
    except (OSError, ValueError, KeyError, EOFError):
        return None
    return TokenDataset(tokens, **arrays) if is_whole else None


class _Index:
    """Sizes and kinds of the examples so far."""

    def __init__(self) -> None:
        self._sizes: list[int] = []
        self._prompts: list[int] = []
        self._kinds: list[int] = []
        self.too_long, self.unasked = np.zeros((2, len(KINDS)), np.int64)

    def add(self, kind: int, num_prompt: int, num_reply: int, max_tokens: int) -> bool:
        """Adds an example; False if it is too long."""
        if num_prompt + num_reply > max_tokens:
            self.too_long[kind] += 1
            return False
        self._sizes.append(num_prompt + num_reply)
        self._prompts.append(num_prompt)
        self._kinds.append(kind)
        return True

    def dataset(self, tokens: Tokens) -> TokenDataset:
        start = np.concatenate([[0], np.cumsum(self._sizes, dtype=np.int64)]).astype(np.int64)
        reply = start[:-1] + np.array(self._prompts, np.int64)
        return TokenDataset(tokens, start, reply, np.array(self._kinds, np.int64), self.too_long, self.unasked)


def _flush_to_disk(file: BinaryIO) -> None:
    file.flush()
    os.fsync(file.fileno())  # else a power cut may keep the rename and lose the content
