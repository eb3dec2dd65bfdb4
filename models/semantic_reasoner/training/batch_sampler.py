"""The batches that a training takes of a token set."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TypeAlias

import numpy as np

from models.semantic_reasoner.training.settings import ReasonerTrainingSettings
from models.semantic_reasoner.training.token_dataset import TokenDataset
from stable_data.scene import IntArray

Rows: TypeAlias = list[list[int]]
"""Of a batch: which examples each of its rows has."""

IGNORED = -100
"""Target of a place where no loss counts, as torch has it."""

_WINDOW = 64  # batches whose examples are sorted by length together


@dataclass(frozen=True, slots=True, eq=False)
class TokenBatch:
    """Rows of a batch.

    Attributes:
        tokens: (B, T) int64, padded on the right.
        position: Place of each token in its own example, (B, T) int64; it starts anew where a row has several examples.
        target: The next token where the loss counts, :data:`IGNORED` elsewhere, (B, T) int64.
    """

    tokens: IntArray
    position: IntArray
    target: IntArray


def batch_of(data: TokenDataset, rows: Sequence[Sequence[int]], pad: int) -> TokenBatch:
    """The batch that some rows make.

    Args:
        data: The examples.
        rows: Indices of the examples of each row.
        pad: Token that fills rows up.
    """
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
            target[r, at + prompt - 1 : at + size - 1] = words[prompt:]
            at += size
        position[r, at:] = np.arange(width - at)  # padding is an example of its own that nothing looks at
    return TokenBatch(tokens, position, target)


def batches_of_pass(data: TokenDataset, settings: ReasonerTrainingSettings, number: int) -> list[Rows]:
    """The batches of one pass: examples in any order, those of like length together so that little is padding.

    Args:
        data: The examples.
        settings: Shares of the kinds, sizes of batches and rows, seed.
        number: Of the pass; each draws anew.
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
    """Batches of some examples, shortest first, each in a row of its own: for evaluation."""
    return _cut([[k] for k in members.tolist()], data.length, settings)


def rows_of(lengths: IntArray, max_tokens: int, packs: bool) -> Rows:
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
    """Rows, shortest first, cut into batches of at most so many rows and tokens, padding included."""
    widths = [int(length[row].sum()) for row in rows]
    most = settings.rows_per_batch or len(rows)
    batches: list[Rows] = []
    for k in np.argsort(widths, kind="stable").tolist():
        size = len(batches[-1]) if batches else 0
        if not size or size == most or widths[k] * (size + 1) > settings.tokens_per_batch:
            batches.append([])
        batches[-1].append(rows[k])
    return batches


def padding_of(data: TokenDataset, batches: Sequence[Rows]) -> float:
    """Share of the batches' places that are padding."""
    length = data.length
    places = tokens = 0
    for rows in batches:
        widths = [int(length[row].sum()) for row in rows]
        places += len(rows) * max(widths)
        tokens += sum(widths)
    return 1 - tokens / places if places else 0.0
