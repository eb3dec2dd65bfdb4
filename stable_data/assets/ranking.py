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

from stable_data.assets.box_fitting import box_proportions, size_score
from stable_data.assets.catalog import Asset, AssetLibrary
from stable_data.assets.licences import is_licence_allowed
from stable_data.assets.noun_fit import NounFit, noun_fit
from stable_data.assets.retrieval_settings import RetrievalSettings
from stable_data.assets.text_embeddings import Rows
from stable_data.scene import FloatArray, IntArray

Tickets = npt.NDArray[np.uint64]
BoolArray = npt.NDArray[np.bool_]
FitArray = npt.NDArray[np.int8]

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
        asset: Index of the asset, (B,) int64; -1 if there is no match.
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
        self._categories = sorted({a.category for a in self.assets})
        number = {category: k for k, category in enumerate(self._categories)}
        self._category = np.array([number[a.category] for a in self.assets], np.int64)
        self._fits: dict[str, FitArray] = {}  # of all categories, by wanted category
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
        *,
        any_noun: bool = True,
    ) -> RankedAssets:
        """Chooses the best asset and its resting tilt for each query.

        Args:
            features: Unit rows of the queries' texts, (B, D) float32.
            wanted: Requested boxes in the yaw frame, (B, 3) float64, metres.
            categories: Requested categories, None if unknown.
            tickets: Random bits that decide between equals, (B,) uint64.
            leans: Whether the object of the query may lean on its support, (B,).
            without: Ids of excluded assets, for each query.
            any_noun: Whether an asset may be chosen whose noun does not fit the category, :attr:`NounFit.OTHER`.
        """
        shapes, barred = box_proportions(wanted), self._barred(without)
        parts = []
        size = max(1, min(_BLOCK, _MAX_SCORES // len(self.assets)))
        for start in range(0, len(features), size):
            block = slice(start, start + size)
            boxes = WantedBoxes(shapes[block], leans[block])
            own = [(k - start, n) for k, n in barred if start <= k < start + size]
            fits = self._noun_fits(categories[block])
            parts.append(self._choose(features[block], boxes, fits, tickets[block], own, any_noun=any_noun))
        columns = zip(*((p.asset, p.tilt, p.text, p.size, p.nearest) for p in parts), strict=True)
        return RankedAssets(*(np.concatenate(column) for column in columns))

    def _barred(self, without: Sequence[Collection[str]]) -> list[tuple[int, int]]:
        """Returns the excluded pairs of query and asset, by index."""
        if not any(without):
            return []
        number = {asset.asset_id: n for n, asset in enumerate(self.assets)}
        return [(k, number[name]) for k, names in enumerate(without) for name in sorted(names) if name in number]

    def _noun_fits(self, categories: Sequence[str | None]) -> FitArray:
        """Returns how well the category of each asset fits each wanted one, (B, N)."""
        for wanted in {name or "" for name in categories} - self._fits.keys():
            self._fits[wanted] = np.array([noun_fit(category, wanted) for category in self._categories], np.int8)
        return np.stack([self._fits[name or ""][self._category] for name in categories])

    def _choose(
        self,
        features: Rows,
        boxes: WantedBoxes,
        fits: FitArray,
        tickets: Tickets,
        barred: Sequence[tuple[int, int]],
        *,
        any_noun: bool,
    ) -> RankedAssets:
        """Chooses for a block of queries; ``barred`` has the excluded pairs."""
        rough = features @ self.features.T  # (B, N)
        for k, n in barred:
            rough[k, n] = _BARRED
        offered = rough if any_noun else np.where(fits > NounFit.OTHER, rough, np.float32(_BARRED))
        rows, cols, text = self._candidates(offered, fits >= NounFit.KIND, features, boxes)
        size, rows, cols, text = self._best(rows, cols, text, features, boxes)
        # Among equally good assets those whose noun fits best are preferred, then the random bits decide.
        fit = fits[rows, cols]
        best_fit = np.zeros(len(features), np.int8)
        np.maximum.at(best_fit, rows, fit)
        keep = fit == best_fit[rows]
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

    def _candidates(
        self, rough: Rows, is_kind: BoolArray, features: Rows, boxes: WantedBoxes
    ) -> tuple[IntArray, IntArray, FloatArray]:
        """Returns pairs of query and asset that can be best or equally good, and their text scores to within the slack.

        Args:
            rough: Rough text scores, (B, N).
            is_kind: Whether an asset is of the wanted kind, so that the floor does not apply to it, (B, N).
            features: Unit rows of the queries, (B, D).
            boxes: The requested boxes.
        """
        s, slack = self._settings, self._slack
        passes = rough >= np.float32(s.floor - 2 * slack)
        # Scores close to a threshold are computed exactly, since the rough ones may be on the wrong side.
        near = _pairs(passes & (rough < np.float32(s.floor + 2 * slack)))
        passes[near] = self._text(*near, features) >= s.floor
        passes |= is_kind & (rough > _BARRED)
        best = rough.argmax(axis=1)
        lower = np.flatnonzero(~passes[np.arange(len(rough)), best])
        best[lower] = np.where(passes[lower], rough[lower], np.float32(_BARRED)).argmax(axis=1)
        # The total score of one asset is a lower bound of the best score, and so gives the least useful text score.
        known = s.text_weight * rough[np.arange(len(rough)), best] + s.size_weight * self._sizes(best, boxes)
        bar = (known - s.margin - s.size_weight) / s.text_weight - 2 * slack
        k = s.top_k_text if s.top_k_text is not None and s.top_k_text < rough.shape[1] else None
        if k is None:
            rows, cols = _pairs(passes & (rough >= bar[:, None].astype(np.float32)))
            return rows, cols, rough[rows, cols].astype(np.float64)
        kth = np.partition(rough, -k, axis=1)[:, -k]
        rows, cols = _pairs(rough >= np.maximum(bar, kth - 2 * slack)[:, None].astype(np.float32))
        text = rough[rows, cols].astype(np.float64)
        close = np.flatnonzero(text < kth[rows] + 2 * slack)
        text[close] = self._text(rows[close], cols[close], features)
        order = np.lexsort((cols, -text, rows))
        rank = np.empty(len(rows), np.int64)
        rank[order] = np.arange(len(rows)) - np.searchsorted(rows, rows)[order]
        keep = passes[rows, cols] & (rank < k)
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
    return asset.is_offered and is_licence_allowed(asset.licence, settings.licences)


def _pairs(mask: BoolArray) -> tuple[IntArray, IntArray]:
    """Returns the rows and columns of the true entries, as ``np.nonzero`` does, but faster where these are few."""
    rows, cols = np.divmod(np.flatnonzero(mask), mask.shape[1])
    return rows, cols
