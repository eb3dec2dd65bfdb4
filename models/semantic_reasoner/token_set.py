"""Examples as tokens, and the batches that a training takes of them."""

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from typing import TypeAlias

import numpy as np
import numpy.typing as npt
from transformers import PreTrainedTokenizerBase

from models.semantic_reasoner.examples import Example
from models.semantic_reasoner.prompt import WANTED
from stable_data.scene import IntArray

Tokens: TypeAlias = npt.NDArray[np.int32]

KINDS = tuple(WANTED)
"""What can be asked for, in the order of :attr:`TokenSet.kind`."""


@dataclass(frozen=True, slots=True, eq=False)
class TokenSet:
    """Examples as tokens, one after another.

    Attributes:
        tokens: Of all examples, (T,) int32.
        start: Where each example begins, and T at the end, (E + 1,) int64.
        reply: Where each example's reply begins, (E,) int64: the loss is on what comes from there.
        kind: Index in :data:`KINDS` of what each asks for, (E,) int64.
        num_too_long: Examples that were left out, being longer than allowed.
    """

    tokens: Tokens
    start: IntArray
    reply: IntArray
    kind: IntArray
    num_too_long: int = 0

    def __len__(self) -> int:
        return len(self.kind)

    @property
    def length(self) -> IntArray:
        """Tokens of each example, (E,) int64."""
        return np.diff(self.start)

    def of(self, example: int) -> tuple[Tokens, int]:
        """An example's tokens and how many of them are the prompt's."""
        begin, end = self.start[example], self.start[example + 1]
        return self.tokens[begin:end], int(self.reply[example] - begin)


def tokenized(examples: Iterable[Example], tokenizer: PreTrainedTokenizerBase, max_tokens: int) -> TokenSet:
    """Examples as tokens.

    Args:
        examples: The examples.
        tokenizer: With a chat template.
        max_tokens: Longer examples are left out and counted.

    Returns:
        The set.
    """
    parts: list[Tokens] = []
    sizes, replies, kinds, too_long = [], [], [], 0
    for batch in _batched(examples, 512):
        # As text first: rendering and encoding many at once is several times faster than one chat at a time.
        prompts = [tokenizer.apply_chat_template(e.prompt, add_generation_prompt=True, tokenize=False) for e in batch]
        answers = [e.answer + str(tokenizer.eos_token) for e in batch]
        encoded = [tokenizer(texts, add_special_tokens=False)["input_ids"] for texts in (prompts, answers)]
        for example, prompt, reply in zip(batch, *encoded, strict=True):
            if len(prompt) + len(reply) > max_tokens:
                too_long += 1
                continue
            parts.append(np.array([*prompt, *reply], np.int32))
            sizes.append(len(prompt) + len(reply))
            replies.append(len(prompt))
            kinds.append(KINDS.index(example.ask.wanted))
    start = np.concatenate([[0], np.cumsum(sizes, dtype=np.int64)]).astype(np.int64)
    tokens = np.concatenate(parts) if parts else np.zeros(0, np.int32)
    return TokenSet(tokens, start, start[:-1] + np.array(replies, np.int64), np.array(kinds, np.int64), too_long)


def _batched(examples: Iterable[Example], size: int) -> Iterator[list[Example]]:
    batch: list[Example] = []
    for example in examples:
        batch.append(example)
        if len(batch) == size:
            yield batch
            batch = []
    if batch:
        yield batch


@dataclass(frozen=True, slots=True, eq=False)
class TokenBatch:
    """Rows of a batch.

    Attributes:
        tokens: (B, T) int64, padded on the right.
        position: Place of each token in its own example, (B, T) int64; it starts anew where a row has several examples.
        target: The next token where the loss counts, -100 elsewhere, (B, T) int64.
    """

    tokens: IntArray
    position: IntArray
    target: IntArray


def rows_of(lengths: IntArray, max_tokens: int, packs: bool) -> list[list[int]]:
    """Which examples share a row.

    Args:
        lengths: Tokens of each example, (E,), none above ``max_tokens``.
        max_tokens: Of a row.
        packs: Whether rows have several examples, as many as go in (first fit, longest first); else each has a row to itself.

    Returns:
        Indices of the examples of each row.
    """
    if not packs:
        return [[k] for k in range(len(lengths))]
    rows: list[list[int]] = []
    room: list[int] = []
    for k in np.argsort(-lengths, kind="stable").tolist():
        place = next((i for i, left in enumerate(room) if left >= lengths[k]), None)
        if place is None:
            rows.append([])
            room.append(max_tokens)
            place = len(rows) - 1
        rows[place].append(k)
        room[place] -= int(lengths[k])
    return rows


def batch_of(data: TokenSet, rows: Sequence[Sequence[int]], pad: int) -> TokenBatch:
    """The batch that some rows make.

    Args:
        data: The examples.
        rows: Indices of the examples of each row.
        pad: Token that fills rows up.
    """
    width = max(int(sum(data.length[list(row)])) for row in rows)
    tokens = np.full((len(rows), width), pad, np.int64)
    position = np.zeros((len(rows), width), np.int64)
    target = np.full((len(rows), width), -100, np.int64)
    for r, row in enumerate(rows):
        at = 0
        for example in row:
            words, prompt = data.of(example)
            size = len(words)
            tokens[r, at : at + size] = words
            position[r, at : at + size] = np.arange(size)
            target[r, at + prompt - 1 : at + size - 1] = words[prompt:]
            at += size
        position[r, at:] = np.arange(width - at)  # padding is an example of its own that nothing looks at
    return TokenBatch(tokens, position, target)


def batches_of_pass(
    data: TokenSet,
    shares: Sequence[float],
    tokens_per_batch: int,
    max_tokens: int,
    packs: bool,
    rng: np.random.Generator,
) -> list[list[list[int]]]:
    """The batches of one pass: examples in any order, those of like length together so that little is padding.

    Args:
        data: The examples.
        shares: Of each of :data:`KINDS`, which share of its examples a pass takes; drawn anew each time.
        tokens_per_batch: Bound on a batch's tokens, padding included; at least one row.
        max_tokens: Of a row that is packed.
        packs: See :func:`rows_of`.
        rng: Where the draws come from.

    Returns:
        Batches of rows of indices.
    """
    chosen = [
        rng.permutation(np.flatnonzero(data.kind == k))[: round(share * int((data.kind == k).sum()))]
        for k, share in enumerate(shares)
    ]
    order = rng.permutation(np.concatenate(chosen))
    length = data.length
    batches: list[list[list[int]]] = []
    window = 64 * max(1, tokens_per_batch // max(1, int(np.mean(length[order])) if len(order) else 1))
    for first in range(0, len(order), window):
        members = order[first : first + window]
        rows = [[int(members[k]) for k in row] for row in rows_of(length[members], max_tokens, packs)]
        rows.sort(key=lambda row: int(sum(length[row])))
        batches += _cut(rows, length, tokens_per_batch)
    return [batches[k] for k in rng.permutation(len(batches))]


def _cut(rows: Sequence[list[int]], length: IntArray, tokens_per_batch: int) -> list[list[list[int]]]:
    """Rows, shortest first, cut into batches of at most so many tokens, padding included."""
    batches: list[list[list[int]]] = [[]]
    for row in rows:
        width = int(sum(length[row]))
        if batches[-1] and width * (len(batches[-1]) + 1) > tokens_per_batch:
            batches.append([])
        batches[-1].append(row)
    return [batch for batch in batches if batch]
