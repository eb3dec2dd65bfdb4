"""Scores of one library's assets for many queries at once, and the choice among the equally good ones.

Matrix products in float32 preselect the assets that can be best. These few are then scored in one fixed order of operations, so
that the choice for a query does not depend on the other queries.
"""

import hashlib
import math
from collections.abc import Collection, Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from stable_data.assets.annotation import category_of
from stable_data.assets.box_fitting import box_proportions, size_score
from stable_data.assets.catalog import Asset, AssetLibrary
from stable_data.assets.retrieval_settings import RetrievalSettings
from stable_data.assets.text_embeddings import Rows
from stable_data.scene import FloatArray, IntArray

Tickets = npt.NDArray[np.uint64]
BoolArray = npt.NDArray[np.bool_]

_BLOCK, _MAX_SCORES = 128, 1 << 24  # queries in a block, whose scores fit the processor's cache; scores in memory at once
_FITTING = math.radians(5.0)  # a misfit up to this counts as a perfect fit
_MAX_EXCESS = math.radians(10.0)  # a tilt whose misfit exceeds the least one by more than this is never chosen
_BARRED = -2.0  # score of an excluded asset; the dot product of unit rows is at least -1
_DECIMALS = 9  # scores that agree to this number of decimals are equal
_MIX = ((30, 0xBF58476D1CE4E5B9), (27, 0x94D049BB133111EB))  # finaliser of splitmix64 (Steele, Lea and Flood 2014)


@dataclass(frozen=True, slots=True, eq=False)
class RankedAssets:
    """The choices of one library for B queries.

    Attributes:
        asset: Index of the asset, (B,) int64; -1 if no text score reaches the floor.
        tilt: Index of its resting tilt, (B,) int64.
        text: Its text score, (B,) float64; that of the nearest asset if there is no match.
        size: Its size score at the tilt that fits best, (B,) float64; 0 if there is no match.
        nearest: The asset with the highest text score if there is no match, (B,) int64; else -1.
    """

    asset: IntArray
    tilt: IntArray
    text: FloatArray
    size: FloatArray
    nearest: IntArray


@dataclass(frozen=True, slots=True, eq=False)
class WantedBoxes:
    """The requested boxes of B queries.

    Attributes:
        shapes: Proportions, (B, 3).
        leans: Whether the object of the query may lean on its support, (B,).
    """

    shapes: FloatArray
    leans: BoolArray

    def of(self, rows: IntArray) -> "WantedBoxes":
        """Returns the boxes of some queries, in the given order."""
        return WantedBoxes(self.shapes[rows], self.leans[rows])


class AssetScores:
    """The assets of one library that may be chosen, as arrays for scoring.

    Args:
        library: The library, with features.
        settings: How to choose.

    Attributes:
        assets: The N assets that may be chosen.
        features: Text features of the assets, (N, D) float32.
        names_category: As in :class:`~stable_data.assets.catalog.AssetLibrary`.
    """

    def __init__(self, library: AssetLibrary, settings: RetrievalSettings) -> None:
        assert library.features is not None
        self._settings = settings
        allowed = [k for k, asset in enumerate(library.assets) if _may_be_used(asset, settings)]
        self.assets: tuple[Asset, ...] = tuple(library.assets[k] for k in allowed)
        self.features: Rows = library.features if len(allowed) == len(library) else library.features[allowed]
        self.names_category = library.names_category
        self._boxes = box_proportions([t.extents for a in self.assets for t in a.tilts] or np.ones((0, 3)))
        # Assumed tilts of leaning in a cup have count 0, and so does the upright tilt of an unused asset, which is the first.
        self._only_leaning = np.array([k > 0 and t.count == 0 for a in self.assets for k, t in enumerate(a.tilts)], np.bool_)
        self._num_tilts = np.array([len(a.tilts) for a in self.assets], np.int64)
        self._first_tilt = np.cumsum(self._num_tilts) - self._num_tilts
        self._codes = {name: k for k, name in enumerate(sorted({_kind(a.category) for a in self.assets} - {""}))}
        self._category = np.array([self._codes.get(_kind(a.category), -2) for a in self.assets], np.int64)
        self._tickets = np.array([tie_break_number(a.asset_id) for a in self.assets], np.uint64)
        self._slack = 2.0 * self.features.shape[1] * 2.0**-24  # bound on the rounding error of a float32 product

    def choose(
        self,
        features: Rows,
        wanted: FloatArray,
        categories: Sequence[str | None],
        tickets: Tickets,
        leans: BoolArray,
        without: Sequence[Collection[str]],
    ) -> RankedAssets:
        """Chooses the best asset and its resting tilt for each query.

        Args:
            features: Unit rows of the queries' texts, (B, D) float32.
            wanted: Requested boxes in the yaw frame, (B, 3) float64, metres.
            categories: Requested categories, None if unknown.
            tickets: Random bits that decide between equals, (B,) uint64.
            leans: Whether the object of the query may lean on its support, (B,).
            without: Ids of excluded assets, for each query.
        """
        shapes, barred = box_proportions(wanted), self._barred(without)
        codes = np.array([self._codes.get(_kind(name or ""), -1) for name in categories], np.int64)
        parts = []
        size = max(1, min(_BLOCK, _MAX_SCORES // len(self.assets)))
        for start in range(0, len(features), size):
            block = slice(start, start + size)
            boxes = WantedBoxes(shapes[block], leans[block])
            own = [(k - start, n) for k, n in barred if start <= k < start + size]
            parts.append(self._choose(features[block], boxes, codes[block], tickets[block], own))
        columns = zip(*((p.asset, p.tilt, p.text, p.size, p.nearest) for p in parts), strict=True)
        return RankedAssets(*(np.concatenate(column) for column in columns))

    def _barred(self, without: Sequence[Collection[str]]) -> list[tuple[int, int]]:
        """Returns the excluded pairs of query and asset, by index."""
        if not any(without):
            return []
        number = {asset.asset_id: n for n, asset in enumerate(self.assets)}
        return [(k, number[name]) for k, names in enumerate(without) for name in sorted(names) if name in number]

    def _choose(
        self, features: Rows, boxes: WantedBoxes, codes: IntArray, tickets: Tickets, barred: Sequence[tuple[int, int]]
    ) -> RankedAssets:
        """Chooses for a block of queries; ``barred`` has the excluded pairs."""
        rough = features @ self.features.T  # (B, N)
        for k, n in barred:
            rough[k, n] = _BARRED
        rows, cols, text = self._candidates(rough, features, boxes)
        size, rows, cols, text = self._best(rows, cols, text, features, boxes)
        # Among equally good assets those of the requested category are preferred, then the random bits decide.
        same = self._category[cols] == codes[rows]
        has_same = np.zeros(len(features), np.bool_)
        has_same[rows[same]] = True
        keep = same | ~has_same[rows]
        rows, cols, text, size = rows[keep], cols[keep], text[keep], size[keep]
        order = np.lexsort((_mixed(self._tickets[cols] ^ tickets[rows]), rows))
        last = order[np.flatnonzero(np.diff(rows[order], append=-1))]
        asset, nearest = np.full(len(features), -1), np.full(len(features), -1)
        texts, sizes = np.zeros(len(features)), np.zeros(len(features))
        asset[rows[last]], texts[rows[last]], sizes[rows[last]] = cols[last], text[last], size[last]
        lost = np.flatnonzero(asset < 0)
        nearest[lost], texts[lost] = self._nearest(rough, features, lost)
        tilt = np.zeros(len(features), np.int64)
        tilt[rows[last]] = self._tilt(cols[last], boxes.of(rows[last]))
        return RankedAssets(asset, tilt, texts, sizes, nearest)

    def _candidates(self, rough: Rows, features: Rows, boxes: WantedBoxes) -> tuple[IntArray, IntArray, FloatArray]:
        """Returns pairs of query and asset that can be best or equally good, and their text scores to within the slack."""
        s, slack = self._settings, self._slack
        best = rough.argmax(axis=1)
        # The total score of one asset is a lower bound of the best score, and so gives the least useful text score.
        known = s.text_weight * rough[np.arange(len(rough)), best] + s.size_weight * self._sizes(best, boxes)
        bar = np.maximum((known - s.margin - s.size_weight) / s.text_weight, s.floor) - 2 * slack
        edge = np.full(len(rough), s.floor + 2 * slack)
        k = s.top_k_text if s.top_k_text is not None and s.top_k_text < rough.shape[1] else None
        if k is not None:
            kth = np.partition(rough, -k, axis=1)[:, -k]
            bar, edge = np.maximum(bar, kth - 2 * slack), np.maximum(edge, kth + 2 * slack)
        rows, cols = np.nonzero(rough >= bar[:, None].astype(np.float32))
        text = rough[rows, cols].astype(np.float64)
        # Scores close to a threshold are computed exactly, since the rough ones may be on the wrong side.
        close = np.flatnonzero(text < edge[rows])
        text[close] = self._text(rows[close], cols[close], features)
        keep = text >= s.floor
        if k is not None:
            order = np.lexsort((cols, -text, rows))
            rank = np.empty(len(rows), np.int64)
            rank[order] = np.arange(len(rows)) - np.searchsorted(rows, rows)[order]
            keep &= rank < k
        return rows[keep], cols[keep], text[keep]

    def _best(
        self, rows: IntArray, cols: IntArray, text: FloatArray, features: Rows, boxes: WantedBoxes
    ) -> tuple[FloatArray, IntArray, IntArray, FloatArray]:
        """Selects the candidates as good as each query's best: size scores, queries, assets and exact text scores."""
        s = self._settings
        size = self._sizes(cols, boxes.of(rows))
        for slack in (2 * self._slack, 0.0):  # first with rough text scores, then the remaining ones with exact scores
            score = np.round(s.text_weight * text + s.size_weight * size, _DECIMALS)
            best = np.full(len(features), -np.inf)
            np.maximum.at(best, rows, score)
            keep = score >= np.round(best[rows] - s.margin - s.text_weight * slack, _DECIMALS)
            rows, cols, size, text = rows[keep], cols[keep], size[keep], text[keep]
            if slack:
                text = self._text(rows, cols, features)
        return size, rows, cols, text

    def _text(self, rows: IntArray, cols: IntArray, features: Rows) -> FloatArray:
        """Computes text scores of pairs, (P,) float64, always summed in the same order."""
        scores: FloatArray = (features[rows] * self.features[cols]).sum(axis=1).astype(np.float64)
        return scores

    def _nearest(self, rough: Rows, features: Rows, lost: IntArray) -> tuple[IntArray, FloatArray]:
        """Returns the asset with the highest text score for some queries, and that score."""
        rows, cols = np.nonzero(rough[lost] >= rough[lost].max(axis=1, keepdims=True) - 2 * np.float32(self._slack))
        text = self._text(lost[rows], cols, features)
        order = np.lexsort((-cols, np.round(text, _DECIMALS), rows))
        last = order[np.flatnonzero(np.diff(rows[order], append=-1))]
        return cols[last], text[last]

    def _sizes(self, cols: IntArray, boxes: WantedBoxes) -> FloatArray:
        """Computes size scores of pairs at the tilt that fits best, (P,) float64."""
        if not len(cols):
            return np.zeros(0)
        scores, starts = self._tilt_scores(cols, boxes)
        best: FloatArray = np.maximum.reduceat(scores, starts)
        return best

    def _tilt(self, cols: IntArray, boxes: WantedBoxes) -> IntArray:
        """Returns the resting tilt of each pair, the most frequent one whose fit is close to the best, (P,) int64."""
        if not len(cols):
            return np.zeros(0, np.int64)
        scores, starts = self._tilt_scores(cols, boxes)
        counts = self._num_tilts[cols]
        misfits = np.arccos(scores)
        least = np.minimum.reduceat(misfits, starts)
        most = np.maximum(np.minimum(self._settings.tilt_patience * least, least + _MAX_EXCESS), _FITTING)
        fits = misfits <= np.repeat(most, counts)
        number = np.arange(len(scores)) - np.repeat(starts, counts)  # tilts are sorted, the most frequent first
        chosen: IntArray = np.minimum.reduceat(np.where(fits, number, len(scores)), starts)
        return chosen

    def _tilt_scores(self, cols: IntArray, boxes: WantedBoxes) -> tuple[FloatArray, IntArray]:
        """Computes size scores of pairs at each tilt of the asset, concatenated, and the start of each pair, (P,) int64."""
        counts = self._num_tilts[cols]
        starts = np.cumsum(counts) - counts
        tilts = np.arange(counts.sum()) + np.repeat(self._first_tilt[cols] - starts, counts)
        scores = size_score(self._boxes[tilts], np.repeat(boxes.shapes, counts, axis=0))
        return np.where(self._only_leaning[tilts] & ~np.repeat(boxes.leans, counts), 0.0, scores), starts


def tie_break_number(*parts: str | int) -> int:
    """Returns 64 bits of a hash of words and numbers, the random bits that decide between equals."""
    text = "\x00".join(map(str, parts))
    return int.from_bytes(hashlib.blake2b(text.encode("utf-8", "surrogatepass"), digest_size=8).digest(), "little")


def _mixed(bits: Tickets) -> Tickets:
    """Mixes the combined bits of asset and query, so that all assets are equally likely."""
    for shift, factor in _MIX:
        bits = (bits ^ (bits >> np.uint64(shift))) * np.uint64(factor)
    return bits ^ (bits >> np.uint64(31))


def _may_be_used(asset: Asset, settings: RetrievalSettings) -> bool:
    return asset.is_offered and (settings.licences is None or asset.licence in settings.licences)


def _kind(category: str) -> str:
    """Returns a category in its form for comparison; empty for no category."""
    return category_of(category) if category.strip() else ""
