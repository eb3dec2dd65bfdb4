"""Upper bounds of text scores: a part of the numbers of each row bounds its dot product, at a part of the memory traffic.

The rows are turned to their principal axes. The first of these coordinates give most of a dot product, and the lengths of the
remainders bound the rest (Cauchy and Schwarz).
"""

import numpy as np

from stable_data.assets.text_embeddings import Rows
from stable_data.scene import FloatArray, IntArray

_CAPTURED = 0.99  # of the squared length of the rows, by the coordinates that are kept
_MOST_KEPT = 0.5  # of the coordinates
_SAMPLED = 1 << 14  # rows from which the axes are found
_AT_ONCE = 1 << 13  # rows that are turned at once
_FEW = 8  # the rows of up to an eighth are copied to multiply them alone


class TextBounds:
    """Bounds of the dot products of any row with N given rows.

    Args:
        rows: (N, D) float32, N > 0.
    """

    def __init__(self, rows: Rows) -> None:
        sample = rows[:: -(-len(rows) // _SAMPLED)].astype(np.float64)
        squares, axes = np.linalg.eigh(sample.T @ sample)
        shares = np.cumsum(squares[::-1]) / max(float(squares.sum()), np.finfo(np.float64).tiny)
        kept = max(1, min(int(_MOST_KEPT * len(squares)), 1 + int(np.searchsorted(shares, _CAPTURED))))
        self._axes: FloatArray = axes[:, ::-1][:, :kept].copy()
        self._turned: Rows = np.empty((len(rows), kept + 1), np.float32)
        for start in range(0, len(rows), _AT_ONCE):
            self._turned[start : start + _AT_ONCE] = self._turn(rows[start : start + _AT_ONCE])
        self._last: tuple[bytes, Rows] = (b"", np.zeros((0, len(rows)), np.float32))

    def bounds(self, features: Rows, chosen: IntArray | None = None) -> Rows:
        """Returns upper bounds of the dot products, (B, M), up to the rounding error of a product of float32.

        Args:
            features: (B, D) float32.
            chosen: The M given rows; None for all.
        """
        if chosen is not None and len(chosen) * _FEW < len(self._turned):
            return self._turn(features) @ self._turned[chosen].T
        every = self._every(features)
        return every.copy() if chosen is None else every[:, chosen]

    def _every(self, features: Rows) -> Rows:
        """The bounds for all rows; those of the last call are kept, since a search among fewer rows often follows."""
        key, last = features.tobytes(), self._last
        if last[0] != key:
            last = self._last = key, self._turn(features) @ self._turned.T
        return last[1]

    def _turn(self, rows: Rows) -> Rows:
        """The coordinates that are kept, and the length of the remainder, (B, K + 1)."""
        whole = rows.astype(np.float64)
        head = whole @ self._axes
        rest = np.sqrt(np.maximum(0.0, np.einsum("nd,nd->n", whole, whole) - np.einsum("nk,nk->n", head, head)))
        turned: Rows = np.concatenate([head, rest[:, None]], axis=1).astype(np.float32)
        return turned
