"""The batches of a training."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TypeAlias

import numpy as np

from models.semantic_reasoner.training.settings import ReasonerTrainingSettings
from models.semantic_reasoner.training.token_dataset import TokenDataset
from stable_data.scene import IntArray

Rows: TypeAlias = list[list[int]]
"""A batch: the indices of the examples in each of its rows."""

IGNORED = -100
"""Target of tokens without a loss, torch's default ``ignore_index``."""

_WINDOW = 64  # batches whose examples are sorted by length together: more give less padding, fewer more random batches


@dataclass(frozen=True, slots=True, eq=False)
class TokenBatch:
    """The arrays of a batch.

    Attributes:
        tokens: (B, T) int64, padded on the right.
        position: Position of each token in its example, (B, T) int64; it starts again with each example of a row.
        target: The next token in replies, :data:`IGNORED` elsewhere, (B, T) int64.
    """

    tokens: IntArray
    position: IntArray
    target: IntArray


def batch_of(data: TokenDataset, rows: Sequence[Sequence[int]], pad: int) -> TokenBatch:
    """Returns the batch of rows, which are indices of examples, padded with the token ``pad``."""
    length = data.length
    width = max(int(length[list(row)].sum()) for row in rows)
    tokens = np.full((len(rows), width), pad, np.int64)
    position = np.zeros((len(rows), width), np.int64)
    target = np.full((len(rows), width), IGNORED, np.int64)
    for r, row in enumerate(rows):
        at = 0
        for example in row:
            words, prompt = data.of(example)
            size = len(words)
            tokens[r, at : at + size] = words
            position[r, at : at + size] = np.arange(size)
            target[r, at + prompt - 1 : at + size - 1] = words[prompt:]  # shifted by one: each token predicts the next
            at += size
        position[r, at:] = np.arange(width - at)  # padding counts as another example, to which no token attends
    return TokenBatch(tokens, position, target)


def batches_of_pass(data: TokenDataset, settings: ReasonerTrainingSettings, number: int) -> list[Rows]:
    """Returns the batches of one pass: in random order, with examples of similar length together to save padding.

    The number of the pass is a part of the seed.
    """
    rng = np.random.default_rng([settings.seed, number])
    chosen = []
    for kind, share in enumerate(settings.shares.of_kinds()):
        members = np.flatnonzero(data.kind == kind)
        chosen.append(rng.permutation(members)[: round(share * len(members))])
    order = rng.permutation(np.concatenate(chosen))
    length = data.length
    mean = float(length[order].mean()) if len(order) else 1.0
    window = _WINDOW * max(1, round(settings.tokens_per_batch / mean))
    batches: list[Rows] = []
    for first in range(0, len(order), window):
        members = order[first : first + window]
        rows = [members[row].tolist() for row in rows_of(length[members], settings.max_tokens, settings.packs)]
        batches += _cut(rows, length, settings)
    return [batches[k] for k in rng.permutation(len(batches))]


def batches_in_order(data: TokenDataset, members: IntArray, settings: ReasonerTrainingSettings) -> list[Rows]:
    """Returns batches of some examples, shortest first, one example a row: for evaluation."""
    return _cut([[k] for k in members.tolist()], data.length, settings)


def rows_of(lengths: IntArray, max_tokens: int, packs: bool) -> Rows:
    """Assigns examples to rows.

    Args:
        lengths: Tokens of each example, (E,), none above ``max_tokens``.
        max_tokens: Largest number of tokens of a row.
        packs: Whether rows have several examples (first fit decreasing); else one each.

    Returns:
        Indices of the examples of each row.
    """
    if not packs:
        return [[k] for k in range(len(lengths))]
    rows: Rows = []
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


def _cut(rows: Rows, length: IntArray, settings: ReasonerTrainingSettings) -> list[Rows]:
    """Cuts rows, shortest first, into batches within the bounds of rows and tokens, padding included."""
    widths = [int(length[row].sum()) for row in rows]
    most = settings.rows_per_batch or len(rows)
    batches: list[Rows] = []
    for k in np.argsort(widths, kind="stable").tolist():
        size = len(batches[-1]) if batches else 0
        # Sorted by width, so the new row is the widest, and the batch is padded to it.
        if not size or size == most or widths[k] * (size + 1) > settings.tokens_per_batch:
            batches.append([])
        batches[-1].append(rows[k])
    return batches


def padding_of(data: TokenDataset, batches: Sequence[Rows]) -> float:
    """Returns the share of padding in the tokens of batches."""
    length = data.length
    places = tokens = 0
    for rows in batches:
        widths = [int(length[row].sum()) for row in rows]
        places += len(rows) * max(widths)
        tokens += sum(widths)
    return 1 - tokens / places if places else 0.0
