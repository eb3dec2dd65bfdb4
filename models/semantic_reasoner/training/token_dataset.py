"""Examples as tokens: made once, kept in files and mapped into memory."""

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
"""What can be asked for, in the order of :attr:`TokenDataset.kind`."""

_TOKENS, _INDEX = "tokens.bin", "index.npz"
_KEPT = ("start", "reply", "kind", "too_long", "unasked")
_AT_ONCE = 512


@dataclass(frozen=True, slots=True, eq=False)
class TokenDataset:
    """Examples as tokens, one after another.

    Attributes:
        tokens: Of all examples, (T,) int32.
        start: Where each example begins, and T at the end, (E + 1,) int64.
        reply: Where each example's reply begins, (E,) int64: the loss is on what comes from there.
        kind: Index in :data:`KINDS` of what each asks for, (E,) int64.
        too_long: Of each kind, the examples that were left out, being longer than allowed, (K,) int64.
        unasked: Of each kind, those that were left out because their question cannot be asked (no instruction, or a novel),
            (K,) int64.
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
        """An example's tokens and how many of them are the prompt's."""
        begin, end = self.start[example], self.start[example + 1]
        return self.tokens[begin:end], int(self.reply[example] - begin)


def _encoded(
    examples: Iterable[TrainingExample], tokenizer: PreTrainedTokenizerBase, index: "_Index", max_tokens: int
) -> Iterator[Tokens]:
    """The tokens of the examples that can be used; the index is told of all."""
    for part in _batched(examples, _AT_ONCE):
        # As text first: rendering and encoding many at once is several times faster than one chat at a time.
        asked = [(example, text) for example in part if (text := _prompt(example, tokenizer, index)) is not None]
        answers = [example.answer + str(tokenizer.eos_token) for example, _ in asked]
        texts = ([text for _, text in asked], answers)
        encoded = [tokenizer(of, add_special_tokens=False)["input_ids"] if of else [] for of in texts]
        for (example, _), prompt, reply in zip(asked, *encoded, strict=True):
            if index.takes(KINDS.index(example.ask.wanted), len(prompt), len(reply), max_tokens):
                yield np.array([*prompt, *reply], "<i4")


def _prompt(example: TrainingExample, tokenizer: PreTrainedTokenizerBase, index: "_Index") -> str | None:
    try:
        chat = example.prompt
    except SceneError:
        index.unasked[KINDS.index(example.ask.wanted)] += 1
        return None
    return chat_text(tokenizer, chat)


def tokenize_examples(examples: Iterable[TrainingExample], tokenizer: PreTrainedTokenizerBase, max_tokens: int) -> TokenDataset:
    """Examples as tokens.

    Args:
        examples: The examples.
        tokenizer: With a chat template.
        max_tokens: Longer examples are left out and counted.

    Returns:
        The set.
    """
    index = _Index()
    parts = list(_encoded(examples, tokenizer, index, max_tokens))
    return index.of_tokens(np.concatenate(parts) if parts else np.zeros(0, np.int32))


def write_tokens(
    folder: Path, examples: Iterable[TrainingExample], tokenizer: PreTrainedTokenizerBase, max_tokens: int
) -> TokenDataset:
    """The same as :func:`tokenize_examples`, kept in a folder and mapped from it: it never is in memory whole.

    Args:
        folder: Where; put in place in one step, so it is whole where it is.
        examples: The examples.
        tokenizer: With a chat template.
        max_tokens: Longer examples are left out and counted.

    Returns:
        The set.
    """
    aside = folder.with_name(f".{folder.name}.{os.getpid()}")
    shutil.rmtree(aside, ignore_errors=True)
    aside.mkdir(parents=True)
    try:
        index = _Index()
        with (aside / _TOKENS).open("wb") as file:
            for tokens in _encoded(examples, tokenizer, index, max_tokens):
                tokens.tofile(file)
            _sync(file)
        found = index.of_tokens(np.zeros(0, np.int32))
        with (aside / _INDEX).open("wb") as file:
            np.savez(file, **{name: getattr(found, name) for name in _KEPT})
            _sync(file)
        shutil.rmtree(folder, ignore_errors=True)  # a part of one, from which :func:`read_tokens` read nothing
        aside.replace(folder)
    finally:
        shutil.rmtree(aside, ignore_errors=True)
    made = read_tokens(folder)
    assert made is not None
    return made


def read_tokens(folder: Path) -> TokenDataset | None:
    """The set that :func:`write_tokens` kept, its tokens mapped; None where none was that can be read."""
    try:
        with np.load(folder / _INDEX, allow_pickle=False) as index:
            arrays = {name: index[name] for name in _KEPT}
        total = int(arrays["start"][-1])
        is_whole = (folder / _TOKENS).stat().st_size == 4 * total
        tokens = np.memmap(folder / _TOKENS, "<i4", "r") if total else np.zeros(0, np.int32)
    except (OSError, ValueError, KeyError, EOFError):
        return None
    return TokenDataset(tokens, **arrays) if is_whole else None


class _Index:
    """Where each example's tokens are, as they come."""

    def __init__(self) -> None:
        self._sizes: list[int] = []
        self._prompts: list[int] = []
        self._kinds: list[int] = []
        self.too_long, self.unasked = np.zeros((2, len(KINDS)), np.int64)

    def takes(self, kind: int, num_prompt: int, num_reply: int, max_tokens: int) -> bool:
        if num_prompt + num_reply > max_tokens:
            self.too_long[kind] += 1
            return False
        self._sizes.append(num_prompt + num_reply)
        self._prompts.append(num_prompt)
        self._kinds.append(kind)
        return True

    def of_tokens(self, tokens: Tokens) -> TokenDataset:
        start = np.concatenate([[0], np.cumsum(self._sizes, dtype=np.int64)]).astype(np.int64)
        reply = start[:-1] + np.array(self._prompts, np.int64)
        return TokenDataset(tokens, start, reply, np.array(self._kinds, np.int64), self.too_long, self.unasked)


def _batched(examples: Iterable[TrainingExample], size: int) -> Iterator[list[TrainingExample]]:
    part: list[TrainingExample] = []
    for example in examples:
        part.append(example)
        if len(part) == size:
            yield part
            part = []
    if part:
        yield part


def _sync(file: BinaryIO) -> None:
    file.flush()
    os.fsync(file.fileno())  # a rename must not outlive its content
