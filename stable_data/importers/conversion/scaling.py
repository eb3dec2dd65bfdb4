"""The scale of an imported asset, what it rests on, and which sizes it may have."""

import math
from dataclasses import dataclass, replace

import numpy as np

from stable_data.errors import MeshError, Notice
from stable_data.importers.conversion.sizes import Scale, SetScale, SizeTable
from stable_data.importers.source import SourceAsset
from stable_data.scene import FloatArray
from stable_data.storage.schemas import Row

SMALLEST, LARGEST = 1e-3, 5.0
"""Range of the longest side of an asset, metres."""
_USUAL = (0.01, 2.0)  # longest side of a thing of unknown category, metres
_SURE = 0.6  # confidence from which the unit of a set counts for its assets
_ODD, _FAR = 3.0, 2.5  # factor, and standard deviations, by which an asset's own scale differs if it is not of that unit
_UNKNOWN = 2.0  # factor by which a thing may be smaller or larger than the user's default
_NOT_SAME = 1.1  # ratio by which the proportions of a stated size may differ from those of the mesh


@dataclass(frozen=True, slots=True)
class ChosenScale:
    """The scale of an asset.

    Attributes:
        unit_m: Metres for each unit of its file.
        source: ``given``, ``stated_size``, ``set``, ``category`` or ``option``.
        confidence: Estimated probability that it is right within a factor of 1.5; None if the user states a default.
        low: Longest side that few such things are below, metres; 0 if unknown.
        high: Longest side that few such things are above, metres; 0 if unknown.
        notices: Warnings.
    """

    unit_m: float
    source: str
    confidence: float | None
    low: float = 0.0
    high: float = 0.0
    notices: tuple[Notice, ...] = ()

    def columns(self, longest: float) -> Row:
        """The columns of ``assets``, for an asset whose longest side has a length, metres."""
        is_exact = self.source in ("given", "stated_size")
        low, high = (self.low, self.high) if self.low else (longest / _UNKNOWN, longest * _UNKNOWN)
        return {
            "typical_scale": [1.0, 1.0, 1.0],
            "scale_source": self.source,
            "scale_inferred": not is_exact,
            "scale_confidence": self.confidence,
            "size_low": longest if is_exact else min(low, longest),
            "size_high": longest if is_exact else max(high, longest),
        }


def choose_scale(
    asset: SourceAsset,
    category: str,
    extents: FloatArray,
    sizes: SizeTable,
    *,
    set_scale: SetScale | None = None,
    default_longest_m: float = 0.0,
) -> ChosenScale:
    """Chooses the scale of an asset: given, by a stated size, that of its set, that of its category, or the user's.

    Args:
        asset: As a reader gives it.
        category: Its category.
        extents: Box of its surfaces, their unit, (3,).
        sizes: Sizes of categories.
        set_scale: The common unit of its set, if one was found. An asset of a set that surely has one unit keeps it, unless its size
            would then be wrong by far for its category, such as a table among toys. In a folder of files of many units the surer
            of both scales counts.
        default_longest_m: Longest side if nothing else is known, metres; 0 for none.

    Raises:
        MeshError: ``scale_unknown``, or ``unit_implausible``: no side of 1 mm to 5 m.
    """
    longest = float(extents.max())
    size = sizes.find(category)
    low, high = (0.0, 0.0) if size is None else (size[0].low, size[0].high)
    if asset.unit_m is not None:
        chosen = ChosenScale(asset.unit_m, "given", 1.0)
    elif asset.size_m is not None:
        chosen = _stated(asset, extents)
    else:
        own = sizes.infer_scale(category, extents.tolist())
        if set_scale is not None and _counts(set_scale, own):
            chosen = ChosenScale(set_scale.unit_m, "set", set_scale.confidence, low, high)
        elif own is not None:
            chosen = ChosenScale(own.unit_m, "category", own.confidence, low, high)
        elif default_longest_m > 0:
            chosen = ChosenScale(default_longest_m / longest, "option", None, low, high)
        elif set_scale is not None:
            chosen = ChosenScale(set_scale.unit_m, "set", set_scale.confidence, low, high)
        else:
            message = (
                f"asset {asset.asset_id}: its file states no unit and no size of a {category.replace('_', ' ')} is known, expected "
                "either; state the unit or size in a manifest, or a default in metres with --set longest_side_m=0.2"
            )
            raise MeshError(message, "scale_unknown")
        sure = "" if chosen.confidence is None else f" (right within a factor of 1.5 with probability {chosen.confidence:.2f})"
        centimetres = 100 * chosen.unit_m * longest
        message = (
            f"asset {asset.asset_id}: its file states no unit; it is made {centimetres:.1f} cm long by {chosen.source}{sure}"
        )
        notice = Notice(asset.asset_id, "scale", "scale_inferred", f"{message}; state the unit if you know it")
        chosen = replace(chosen, notices=(notice,))
    _check_size(asset.asset_id, chosen.unit_m * longest, low, high)
    return chosen


def _counts(common: SetScale, own: Scale | None) -> bool:
    """Whether an asset has the unit of its set, and not the scale that its category suggests."""
    if own is None:
        return common.confidence >= _SURE
    if common.confidence < _SURE:
        return common.confidence >= own.confidence
    return abs(math.log(own.unit_m / common.unit_m)) <= max(math.log(_ODD), _FAR * own.spread)


def _stated(asset: SourceAsset, extents: FloatArray) -> ChosenScale:
    """The scale that gives an asset the stated size."""
    assert asset.size_m is not None
    ratios = np.divide(asset.size_m, extents, out=np.full(3, np.nan), where=extents > 1e-3 * extents.max())
    ratios = ratios[np.isfinite(ratios) & (ratios > 0)]
    if not len(ratios):
        message = (
            f"asset {asset.asset_id}: its stated size is {asset.size_m} m, expected positive lengths; correct the manifest"
        )
        raise MeshError(message, "unit_implausible")
    notices: tuple[Notice, ...] = ()
    if ratios.max() > _NOT_SAME * ratios.min():
        message = (
            f"asset {asset.asset_id}: its stated size {tuple(round(s, 4) for s in asset.size_m)} m has other proportions than its mesh "
            f"{tuple(round(float(e), 4) for e in extents)}; it is scaled evenly by the middle ratio; check the order of the lengths"
        )
        notices = (Notice(asset.asset_id, "scale", "size_differs", message),)
    return ChosenScale(float(np.median(ratios)), "stated_size", 1.0, notices=notices)


def _check_size(asset_id: str, longest: float, low: float, high: float) -> None:
    """Refuses a size that no asset can have, and names the unit that would make it plausible."""
    if SMALLEST <= longest <= LARGEST:
        return
    least, most = (low / 2, 2 * high) if low else _USUAL
    fits = [f for f in (1000.0, 100.0, 25.4) for f in (f, 1 / f) if least <= longest * f <= most]
    advice = f"a factor of {fits[0]:.4g} would make it {100 * longest * fits[0]:.1f} cm; " if fits else ""
    message = f"asset {asset_id}: its longest side is {longest:.4g} m, expected {SMALLEST:g} to {LARGEST:g} m; {advice}correct the unit"
    raise MeshError(message, "unit_implausible")
