"""Scores of one library's assets for many queries at once, and the choice among the equally good ones.

Matrix products in float32 preselect the assets that can be best. These few are then scored in one fixed order of operations, so
that the choice for a query does not depend on the other queries.
"""

import hashlib
import math
from collections.abc import Collection, Iterator, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from stable_data.assets.box_fitting import box_proportions, diagonal, scale_factor, size_score, uniform_scale_factor
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
_MAX_PAIRS = 1 << 20  # pairs in a block whose sizes are compared
_FITTING = math.radians(5.0)  # a misfit up to this counts as a perfect fit
_MAX_EXCESS = math.radians(10.0)  # a tilt whose misfit exceeds the least one by more than this is never chosen
LARGEST_MISFIT = 2.0
"""Factor between the size of an asset and that of the requested box above which it is no match while there are others."""

TURNED_FIT = 0.2
"""An asset is turned by 90 degrees about z if its box then fits better by this cosine."""

_FREE_MISFIT = 1.25  # a factor between the sizes that costs nothing
_MISFIT_LOSS = 2.0  # of the size score, for a factor of e beyond that: 0.2 of the score
_NARROWED = 1 << 14  # assets from which bounds of the text scores tell which ones are compared
_NARROWING = 16  # queries up to which they do: one product for many queries costs less
_PROBED = 256  # assets with high bounds that are scored first
_FEW = 8  # the rows of up to an eighth of the assets are copied to multiply them alone
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
        is_turned: Whether it is turned by 90 degrees about z, (B,).
        size: Its size score at the tilt that fits best, (B,) float64; 0 if there is no match.
        nearest: The asset with the highest text score if there is no match and it was searched for, (B,) int64; else -1.
    """

    asset: IntArray
    tilt: IntArray
    is_turned: BoolArray
    text: FloatArray
    size: FloatArray
    nearest: IntArray

    @classmethod
    def empty(cls, num: int) -> "RankedAssets":
        """The answers to queries without a match."""
        none = np.full(num, -1)
        return cls(none, np.zeros(num, np.int64), np.zeros(num, np.bool_), np.zeros(num), np.zeros(num), none.copy())

    def put(self, rows: IntArray, other: "RankedAssets") -> None:
        """Replaces the answers to some queries."""
        for own, new in zip(self._columns(), other._columns(), strict=True):
            own[rows] = new

    def _columns(self) -> tuple[npt.NDArray[Any], ...]:
        return self.asset, self.tilt, self.is_turned, self.text, self.size, self.nearest


@dataclass(frozen=True, slots=True, eq=False)
class WantedBoxes:
    """The requested boxes of B queries.

    Attributes:
        shapes: Proportions, (B, 3).
        lengths: Diagonals, metres, (B,).
        leans: Whether the object of the query may lean on its support, (B,).
        holds: Whether another object is in it, (B,).
    """

    shapes: FloatArray
    lengths: FloatArray
    leans: BoolArray
    holds: BoolArray

    def of(self, rows: IntArray | slice) -> "WantedBoxes":
        """Returns the boxes of some queries, in the given order."""
        return WantedBoxes(self.shapes[rows], self.lengths[rows], self.leans[rows], self.holds[rows])


@dataclass(frozen=True, slots=True, eq=False)
class _ComparedPoses:
    """P pairs of a requested box and an asset, at each tilt of the asset, concatenated to (T,).

    Attributes:
        cosines: Cosine of the proportions, (T,); 0 where the tilt cannot be used.
        misfits: By how much the asset is larger or smaller than the nearest box, as the logarithm of the ratio, (T,).
        starts: Start of each pair, (P,).
        is_turned: Whether the asset is turned by 90 degrees about z, (P,).
    """

    cosines: FloatArray
    misfits: FloatArray
    starts: IntArray
    is_turned: BoolArray


class AssetScores:
    """The assets of one library that may be chosen, as arrays for scoring.

    Args:
        library: The library, with features.
        settings: How to choose.

    Attributes:
        assets: The N assets that may be chosen.
        has_sizes: Whether the size of an asset is limited.
        is_limited: Whether an asset may not fit: its size is limited, or it is no container.
        names_category: As in :class:`~stable_data.assets.catalog.AssetLibrary`.
    """

    def __init__(self, library: AssetLibrary, settings: RetrievalSettings) -> None:
        assert library.features is not None
        self._settings = settings
        allowed = [k for k, asset in enumerate(library.assets) if may_be_used(asset, settings)]
        self.assets: tuple[Asset, ...] = tuple(library.assets[k] for k in allowed)
        # The rows of all assets are kept as they are, since they may be a file that several processes share.
        self._features: Rows = library.features
        self._library = library
        self._feature = None if len(allowed) == len(library) else np.array(allowed, np.int64)
        self.names_category = library.names_category
        extents = np.array([t.extents for a in self.assets for t in a.tilts] or np.ones((0, 3)), np.float64)
        self._boxes, self._lengths = box_proportions(extents), diagonal(extents)
        # Assumed tilts of leaning in a cup have count 0, and so does the upright tilt of an unused asset, which is the first.
        self._only_leaning = np.array([k > 0 and t.count == 0 for a in self.assets for k, t in enumerate(a.tilts)], np.bool_)
        self._num_tilts = np.array([len(a.tilts) for a in self.assets], np.int64)
        self._first_tilt = np.cumsum(self._num_tilts) - self._num_tilts
        self._limits = np.array([_scale_limits(a, settings.metric_slack) for a in self.assets]).reshape(-1, 2)
        self.has_sizes = bool(np.isfinite(self._limits[:, 1]).any())
        self._is_closed = np.array([a.is_container is False for a in self.assets], np.bool_)
        self.is_limited = self.has_sizes or bool(self._is_closed.any())
        self._categories = sorted({a.category for a in self.assets})
        number = {category: k for k, category in enumerate(self._categories)}
        self._category = np.array([number[a.category] for a in self.assets], np.int64)
        by_category = np.argsort(self._category, kind="stable")
        self._members = np.split(by_category, np.cumsum(np.bincount(self._category, minlength=len(number)))[:-1])
        self._fits: dict[str, FitArray] = {}  # of all categories, by wanted category
        self._tickets = np.array([tie_break_number(a.asset_id) for a in self.assets], np.uint64)
        self._number: dict[str, int] = {}
        self._slack = 2.0 * self.width * 2.0**-24  # bound on the rounding error of a float32 product

    @property
    def width(self) -> int:
        """Numbers of a row of text features."""
        return int(self._features.shape[1])

    def choose(
        self,
        features: Rows,
        wanted: FloatArray,
        categories: Sequence[str | None],
        tickets: Tickets,
        leans: BoolArray,
        holds: BoolArray,
        without: Sequence[Collection[str]],
        *,
        least: NounFit = NounFit.OTHER,
        must_fit: bool = False,
    ) -> RankedAssets:
        """Chooses the best asset and its resting tilt for each query.

        Args:
            features: Unit rows of the queries' texts, (B, D) float32.
            wanted: Requested boxes in the yaw frame, (B, 3) float64, metres.
            categories: Requested categories, None if unknown.
            tickets: Random bits that decide between equals, (B,) uint64.
            leans: Whether the object of the query may lean on its support, (B,).
            holds: Whether another object is in the object of the query, (B,).
            without: Ids of excluded assets, for each query.
            least: An asset may be chosen if its noun fits the category at least so well.
            must_fit: Whether an asset is left out that would be more than :data:`LARGEST_MISFIT` larger or smaller than the box, or that is
                no container where one is needed.
        """
        boxes, barred = WantedBoxes(box_proportions(wanted), diagonal(wanted), leans, holds), self._barred(without)
        found = RankedAssets.empty(len(features))
        for rows, cols in self._groups(categories, least):
            narrows = len(cols) >= _NARROWED and len(rows) <= _NARROWING and self._settings.top_k_text is None
            choose = self._choose_narrowed if narrows else self._choose
            pairs = _MAX_PAIRS if must_fit and self.has_sizes and not narrows else _MAX_SCORES
            size = max(1, min(_BLOCK, pairs // max(1, len(cols))))
            for start in range(0, len(rows), size):
                block = rows[start : start + size]
                fits = np.stack([self._category_fits(categories[k] or "") for k in block.tolist()])
                own = self._barred_places(block, cols, barred)
                part = choose(
                    features[block], boxes.of(block), fits, tickets[block], own, cols, must_fit=must_fit, nearest=not least
                )
                found.put(block, part)
        return found

    def _groups(self, categories: Sequence[str | None], least: NounFit) -> Iterator[tuple[IntArray, IntArray]]:
        """Yields groups of queries, and the assets that may be chosen for all queries of a group, in the order of the assets."""
        if least is NounFit.OTHER:
            yield np.arange(len(categories)), np.arange(len(self.assets))
            return
        groups: dict[str, list[int]] = {}
        for k, name in enumerate(categories):
            groups.setdefault(name or "", []).append(k)
        for name, members in groups.items():
            fitting = np.flatnonzero(self._category_fits(name) >= least)
            if len(fitting):
                yield np.array(members), np.sort(np.concatenate([self._members[k] for k in fitting]))

    def _barred(self, without: Sequence[Collection[str]]) -> dict[int, list[int]]:
        """Returns the excluded assets of queries, by index."""
        if not any(without):
            return {}
        if not self._number:
            self._number = {asset.asset_id: n for n, asset in enumerate(self.assets)}
        return {
            k: [self._number[name] for name in sorted(names) if name in self._number]
            for k, names in enumerate(without)
            if names
        }

    @staticmethod
    def _barred_places(rows: IntArray, cols: IntArray, barred: dict[int, list[int]]) -> list[tuple[int, int]]:
        """Returns the excluded pairs of a block, by their places in it."""
        pairs = [(place, n) for place, k in enumerate(rows.tolist()) for n in barred.get(k, ())]
        places = np.searchsorted(cols, [n for _, n in pairs]).tolist() if pairs else []
        return [(k, at) for (k, n), at in zip(pairs, places, strict=True) if at < len(cols) and cols[at] == n]

    def _category_fits(self, wanted: str) -> FitArray:
        """Returns how well each category of the library fits a wanted one, (C,)."""
        if wanted not in self._fits:
            self._fits[wanted] = np.array([noun_fit(category, wanted) for category in self._categories], np.int8)
        return self._fits[wanted]

    def _rough(self, features: Rows, cols: IntArray) -> Rows:
        """Computes rough text scores of all pairs, (B, M): of few assets from a copy of their rows, else from all rows."""
        is_whole = len(cols) == len(self._features)
        if not is_whole and len(cols) * _FEW < len(self._features):
            return features @ self._features[self._feature_rows(cols)].T
        every = features @ self._features.T
        return every if is_whole else every[:, self._feature_rows(cols)]

    def _feature_rows(self, cols: IntArray) -> IntArray:
        return cols if self._feature is None else self._feature[cols]

    def _choose_narrowed(
        self,
        features: Rows,
        boxes: WantedBoxes,
        fits: FitArray,
        tickets: Tickets,
        barred: Sequence[tuple[int, int]],
        cols: IntArray,
        *,
        must_fit: bool,
        nearest: bool,
    ) -> RankedAssets:
        """Chooses as :meth:`_choose`, for each query among those assets alone that can be its best or nearest one."""
        chosen = None if len(cols) == len(self._features) else self._feature_rows(cols)
        bounds = self._library.text_bounds.bounds(features, chosen)
        for k, n in barred:
            bounds[k, n] = _BARRED
        found = RankedAssets.empty(len(features))
        for k in range(len(features)):
            one, own = slice(k, k + 1), list[tuple[int, int]]()
            places = self._promising(bounds[k], features[one], boxes.of(one), fits[k], cols, must_fit=must_fit, nearest=nearest)
            if nearest and not len(places):  # all are excluded
                places, own = np.arange(len(cols)), [(0, n) for row, n in barred if row == k]
            if len(places):
                part = self._choose(
                    features[one],
                    boxes.of(one),
                    fits[one],
                    tickets[one],
                    own,
                    cols[places],
                    must_fit=must_fit,
                    nearest=nearest,
                )
                found.put(np.array([k]), part)
        return found

    def _promising(
        self,
        bounds: Rows,
        features: Rows,
        boxes: WantedBoxes,
        fits: FitArray,
        cols: IntArray,
        *,
        must_fit: bool,
        nearest: bool,
    ) -> IntArray:
        """Returns the places of the assets that can be the best or the nearest one of a query, in order; no excluded ones.

        Args:
            bounds: Upper bounds of the text scores, (M,); :data:`_BARRED` for excluded assets.
            features: Unit row of the query, (1, D).
            boxes: The requested box.
            fits: How well each category fits, (C,); the floor does not apply to the wanted kind.
            cols: The assets, (M,).
            must_fit: See :meth:`choose`.
            nearest: Whether the asset with the highest text score is needed if there is no match.
        """
        s, slack = self._settings, 3 * self._slack  # of the bound, and of both rough scores that are compared later
        # The scores of some assets, those with the highest bounds of their parts of the library, are lower bounds of the best score.
        width = -(-len(bounds) // _PROBED)
        padded = np.full(_PROBED * width, np.float32(_BARRED))
        padded[: len(bounds)] = bounds
        probed = padded.reshape(_PROBED, width).argmax(axis=1) + width * np.arange(_PROBED)
        probed = probed[padded[probed] > _BARRED]
        if must_fit:
            probed = probed[~self._is_misfit(cols[probed], boxes)[0]]
        query = np.zeros(len(probed), np.int64)
        text = self._text(query, cols[probed], features)
        is_kind = fits >= NounFit.KIND
        passes = (text >= s.floor) | is_kind[self._category[cols[probed]]]
        if passes.any():
            size = self._sizes(cols[probed[passes]], boxes.of(query[passes]))
            known = float((s.text_weight * text[passes] + s.size_weight * size).max())
            least = (known - s.margin - s.size_weight) / s.text_weight
            return np.flatnonzero(bounds >= np.float32(max(least, -1.0) - slack))
        least = min(s.floor, float(text.max(initial=-1.0))) if nearest else s.floor
        may_serve = bounds >= np.float32(least - slack)
        if is_kind.any():
            may_serve |= is_kind[self._category[cols]] & (bounds > _BARRED)
        return np.flatnonzero(may_serve)

    def _choose(
        self,
        features: Rows,
        boxes: WantedBoxes,
        fits: FitArray,
        tickets: Tickets,
        barred: Sequence[tuple[int, int]],
        cols: IntArray,
        *,
        must_fit: bool,
        nearest: bool,
    ) -> RankedAssets:
        """Chooses for a block of queries among the assets ``cols``, (M,), in order.

        ``fits`` has the fit of each category, (B, C), and ``barred`` the excluded pairs. Only with ``nearest`` the nearest asset is
        named where there is no match.
        """
        fits = fits[:, self._category[cols]]
        rough = self._rough(features, cols)
        for k, n in barred:
            rough[k, n] = _BARRED
        if must_fit:
            rough[self._is_misfit(cols, boxes)] = _BARRED
        rows, places, text = self._candidates(rough, fits >= NounFit.KIND, features, boxes, cols)
        size, rows, places, text = self._best(rows, places, text, features, boxes, cols)
        # Among equally good assets those whose noun fits best are preferred, then the random bits decide.
        fit = fits[rows, places]
        best_fit = np.zeros(len(features), np.int8)
        np.maximum.at(best_fit, rows, fit)
        keep = fit == best_fit[rows]
        rows, chosen, text, size = rows[keep], cols[places[keep]], text[keep], size[keep]
        order = np.lexsort((_mixed(self._tickets[chosen] ^ tickets[rows]), rows))
        last = order[np.flatnonzero(np.diff(rows[order], append=-1))]
        found = RankedAssets.empty(len(features))
        found.asset[rows[last]], found.text[rows[last]], found.size[rows[last]] = chosen[last], text[last], size[last]
        lost = np.flatnonzero(found.asset < 0)
        if nearest and len(lost):
            found.nearest[lost], found.text[lost] = self._nearest(rough, features, lost, cols)
        found.tilt[rows[last]], found.is_turned[rows[last]] = self._tilt(chosen[last], boxes.of(rows[last]))
        return found

    def _is_misfit(self, cols: IntArray, boxes: WantedBoxes) -> BoolArray:
        """Whether assets would be much larger or smaller than a requested box, or cannot hold what is in it, (B, M)."""
        found = boxes.holds[:, None] & self._is_closed[cols]
        limited = np.flatnonzero(np.isfinite(self._limits[cols, 1]))
        if len(limited):
            rows, places = (g.ravel() for g in np.meshgrid(np.arange(len(found)), limited, indexing="ij"))
            poses = self._poses(cols[places], boxes.of(rows))
            least = np.minimum.reduceat(np.where(poses.cosines > 0, poses.misfits, np.inf), poses.starts)
            found[rows, places] |= least > math.log(LARGEST_MISFIT)
        return found

    def _candidates(
        self, rough: Rows, is_kind: BoolArray, features: Rows, boxes: WantedBoxes, cols: IntArray
    ) -> tuple[IntArray, IntArray, FloatArray]:
        """Returns pairs of query and asset that can be best or equally good, and their text scores to within the slack.

        Args:
            rough: Rough text scores, (B, M).
            is_kind: Whether an asset is of the wanted kind, so that the floor does not apply to it, (B, M).
            features: Unit rows of the queries, (B, D).
            boxes: The requested boxes.
            cols: The assets, (M,).

        Returns:
            Queries, places of the assets in ``cols``, and text scores.
        """
        s, slack = self._settings, self._slack
        passes = rough >= np.float32(s.floor - 2 * slack)
        # Scores close to a threshold are computed exactly, since the rough ones may be on the wrong side.
        near = _pairs(passes & (rough < np.float32(s.floor + 2 * slack)))
        passes[near] = self._text(near[0], cols[near[1]], features) >= s.floor
        passes |= is_kind
        passes &= rough > _BARRED
        best = rough.argmax(axis=1)
        lower = np.flatnonzero(~passes[np.arange(len(rough)), best])
        best[lower] = np.where(passes[lower], rough[lower], np.float32(_BARRED)).argmax(axis=1)
        # The total score of one asset is a lower bound of the best score, and so gives the least useful text score.
        known = s.text_weight * rough[np.arange(len(rough)), best] + s.size_weight * self._sizes(cols[best], boxes)
        bar = (known - s.margin - s.size_weight) / s.text_weight - 2 * slack
        k = s.top_k_text if s.top_k_text is not None and s.top_k_text < rough.shape[1] else None
        if k is None:
            rows, places = _pairs(passes & (rough >= bar[:, None].astype(np.float32)))
            return rows, places, rough[rows, places].astype(np.float64)
        kth = np.partition(rough, -k, axis=1)[:, -k]
        rows, places = _pairs(rough >= np.maximum(bar, kth - 2 * slack)[:, None].astype(np.float32))
        text = rough[rows, places].astype(np.float64)
        close = np.flatnonzero(text < kth[rows] + 2 * slack)
        text[close] = self._text(rows[close], cols[places[close]], features)
        order = np.lexsort((places, -text, rows))
        rank = np.empty(len(rows), np.int64)
        rank[order] = np.arange(len(rows)) - np.searchsorted(rows, rows)[order]
        keep = passes[rows, places] & (rank < k)
        return rows[keep], places[keep], text[keep]

    def _best(
        self, rows: IntArray, places: IntArray, text: FloatArray, features: Rows, boxes: WantedBoxes, cols: IntArray
    ) -> tuple[FloatArray, IntArray, IntArray, FloatArray]:
        """Selects the candidates as good as each query's best: size scores, queries, places in ``cols`` and exact text scores."""
        s = self._settings
        size = self._sizes(cols[places], boxes.of(rows))
        for slack in (2 * self._slack, 0.0):  # first with rough text scores, then the remaining ones with exact scores
            score = np.round(s.text_weight * text + s.size_weight * size, _DECIMALS)
            best = np.full(len(features), -np.inf)
            np.maximum.at(best, rows, score)
            keep = score >= np.round(best[rows] - s.margin - s.text_weight * slack, _DECIMALS)
            rows, places, size, text = rows[keep], places[keep], size[keep], text[keep]
            if slack:
                text = self._text(rows, cols[places], features)
        return size, rows, places, text

    def _text(self, rows: IntArray, cols: IntArray, features: Rows) -> FloatArray:
        """Computes text scores of pairs, (P,) float64, always summed in the same order."""
        scores: FloatArray = (features[rows] * self._features[self._feature_rows(cols)]).sum(axis=1).astype(np.float64)
        return scores

    def _nearest(self, rough: Rows, features: Rows, lost: IntArray, cols: IntArray) -> tuple[IntArray, FloatArray]:
        """Returns the asset with the highest text score for some queries, and that score."""
        rows, places = np.nonzero(rough[lost] >= rough[lost].max(axis=1, keepdims=True) - 2 * np.float32(self._slack))
        text = self._text(lost[rows], cols[places], features)
        order = np.lexsort((-places, np.round(text, _DECIMALS), rows))
        last = order[np.flatnonzero(np.diff(rows[order], append=-1))]
        return cols[places[last]], text[last]

    def _sizes(self, cols: IntArray, boxes: WantedBoxes) -> FloatArray:
        """Computes size scores of pairs at the tilt that fits best, (P,) float64."""
        if not len(cols):
            return np.zeros(0)
        poses = self._poses(cols, boxes)
        scores = poses.cosines - _MISFIT_LOSS * np.maximum(0.0, poses.misfits - math.log(_FREE_MISFIT))
        best: FloatArray = np.maximum.reduceat(scores, poses.starts)
        return best

    def _tilt(self, cols: IntArray, boxes: WantedBoxes) -> tuple[IntArray, BoolArray]:
        """Returns the resting tilt of each pair, the most frequent one whose fit is close to the best, and whether it is turned, (P,)."""
        if not len(cols):
            return np.zeros(0, np.int64), np.zeros(0, np.bool_)
        poses = self._poses(cols, boxes)
        counts = self._num_tilts[cols]
        angles = np.arccos(poses.cosines)
        least = np.minimum.reduceat(angles, poses.starts)
        most = np.maximum(np.minimum(self._settings.tilt_patience * least, least + _MAX_EXCESS), _FITTING)
        fits = angles <= np.repeat(most, counts)
        number = np.arange(len(angles)) - np.repeat(poses.starts, counts)  # tilts are sorted, the most frequent first
        chosen: IntArray = np.minimum.reduceat(np.where(fits, number, len(angles)), poses.starts)
        return chosen, poses.is_turned

    def _poses(self, cols: IntArray, boxes: WantedBoxes) -> "_ComparedPoses":
        """Compares pairs at each tilt of the asset, turned by 90 degrees if it fits only then."""
        counts = self._num_tilts[cols]
        starts = np.cumsum(counts) - counts
        tilts = np.arange(counts.sum()) + np.repeat(self._first_tilt[cols] - starts, counts)
        own, shapes = self._boxes[tilts], np.repeat(boxes.shapes, counts, axis=0)
        cannot = self._only_leaning[tilts] & ~np.repeat(boxes.leans, counts)
        straight, crossed = size_score(own, shapes), size_score(own, shapes[:, [1, 0, 2]])
        best, best_crossed = (np.maximum.reduceat(np.where(cannot, 0.0, c), starts) for c in (straight, crossed))
        is_turned = best_crossed > best + TURNED_FIT
        cosines = np.where(np.repeat(is_turned, counts), crossed, straight)
        misfits = np.zeros(len(cosines))
        if self.has_sizes:
            nearest = scale_factor(np.repeat(boxes.lengths, counts) / self._lengths[tilts], cosines)
            low, high = np.repeat(self._limits[cols], counts, axis=0).T
            misfits = np.abs(np.log(nearest / np.clip(nearest, low, high)))
        return _ComparedPoses(np.where(cannot, 0.0, cosines), misfits, starts, is_turned)

    def scales(self, assets: IntArray, tilts: IntArray, wanted: npt.ArrayLike) -> FloatArray:
        """Computes the uniform scale of assets at a tilt that is nearest to requested boxes and within their limits, (B,) float64.

        Args:
            assets: Indices, (B,).
            tilts: Indices of a tilt of each, (B,).
            wanted: Requested boxes, (B, 3), metres.
        """
        boxes = [self.assets[a].tilts[t].extents for a, t in zip(assets.tolist(), tilts.tolist(), strict=True)]
        low, high = self._limits[assets].T
        found: FloatArray = np.clip(uniform_scale_factor(wanted, boxes), low, high)
        return found


def tie_break_number(*parts: str | int) -> int:
    """Returns 64 bits of a hash of words and numbers, the random bits that decide between equals."""
    text = "\x00".join(map(str, parts))
    return int.from_bytes(hashlib.blake2b(text.encode("utf-8", "surrogatepass"), digest_size=8).digest(), "little")


def _mixed(bits: Tickets) -> Tickets:
    """Mixes the combined bits of asset and query, so that all assets are equally likely."""
    for shift, factor in _MIX:
        bits = (bits ^ (bits >> np.uint64(shift))) * np.uint64(factor)
    return bits ^ (bits >> np.uint64(31))


def may_be_used(asset: Asset, settings: RetrievalSettings) -> bool:
    """Whether the annotations of an asset and the settings allow its use."""
    return asset.is_offered and is_licence_allowed(asset.licence, settings.licences)


def _scale_limits(asset: Asset, slack: float) -> tuple[float, float]:
    """Returns the smallest and largest scale of an asset, metres per mesh unit."""
    if asset.size_range is None:
        return 0.0, math.inf
    (low, high), longest = asset.size_range, max(asset.extents)
    return low / slack / longest, high * slack / longest


def _pairs(mask: BoolArray) -> tuple[IntArray, IntArray]:
    """Returns the rows and columns of the true entries, as ``np.nonzero`` does, but faster where these are few."""
    rows, cols = np.divmod(np.flatnonzero(mask), mask.shape[1])
    return rows, cols
