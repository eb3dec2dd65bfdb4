"""Statistics of an episode and of all episodes, as a LeRobotDataset states them for the normalisation of inputs.

Each feature has ``min``, ``max``, ``mean``, ``std``, ``count`` and five quantiles. Those of an episode are exact: a quantile q of n
values is the smallest value that at least q n of them do not exceed. Those of a dataset follow from the episodes' as LeRobot defines
them: its quantiles are means of the episodes' quantiles, weighted by their counts.
"""

from collections.abc import Mapping, Sequence
from typing import Any, TypeAlias

import numpy as np
import numpy.typing as npt

Statistics: TypeAlias = dict[str, npt.NDArray[Any]]
"""Name -> values, (D,), or (3, 1, 1) of pictures; ``count`` is (1,) int64."""

QUANTILES = {"q01": 0.01, "q10": 0.10, "q50": 0.50, "q90": 0.90, "q99": 0.99}
NAMES = ("min", "max", "mean", "std", "count", *QUANTILES)

_FEW = 100  # frames of which all are looked at
_MOST = 10_000
_POWER = 0.75
_LARGE = 300  # pixels of a side from which a picture is thinned out
_THINNED = 150


def array_statistics(values: npt.NDArray[Any]) -> Statistics:
    """Returns the statistics of numbers, integers or booleans, (T, D)."""
    ordered = np.sort(values, axis=0)
    numbers = values.astype(np.float64)
    return {
        "min": ordered[0],
        "max": ordered[-1],
        "mean": numbers.mean(axis=0),
        "std": numbers.std(axis=0),
        "count": np.array([len(values)]),
        **{name: ordered[_rank(q, len(values))].astype(np.float64) for name, q in QUANTILES.items()},
    }


def _rank(q: float, count: int) -> int:
    """The place of a quantile among ordered values."""
    return min(count - 1, max(0, int(np.ceil(q * count)) - 1))


def sampled_frames(num_frames: int) -> list[int]:
    """Returns the frames whose pictures give the statistics: all of a short episode, fewer of a long one, evenly spaced."""
    count = max(min(_FEW, num_frames), min(int(num_frames**_POWER), _MOST))
    return [int(k) for k in np.round(np.linspace(0, num_frames - 1, count))]


class PictureStatistics:
    """Statistics of the colours of pictures, channel by channel, from 0 to 1.

    The pixels are counted by their 256 levels, so that no picture stays in memory.
    """

    def __init__(self) -> None:
        self._levels = np.zeros((3, 256), np.int64)
        self._count = 0

    def add(self, picture: npt.NDArray[np.uint8]) -> None:
        """Adds a picture, (H, W, 3) uint8; of a large one, every k-th pixel of every k-th row."""
        height, width = picture.shape[:2]
        if max(height, width) >= _LARGE:
            step = max(height, width) // _THINNED
            picture = picture[::step, ::step]
        for channel in range(3):
            self._levels[channel] += np.bincount(picture[..., channel].ravel(), minlength=256)
        self._count += 1

    def statistics(self) -> Statistics:
        """Returns the statistics of the pictures, of which there must be at least one."""
        levels = np.arange(256.0)
        total = int(self._levels[0].sum())
        mean = self._levels @ levels / total
        spread = (self._levels * (levels - mean[:, None]) ** 2).sum(axis=1) / total
        reached = self._levels.cumsum(axis=1)  # (3, 256): pixels up to each level

        def at(rank: int) -> npt.NDArray[np.float64]:
            return np.asarray((reached <= rank).sum(axis=1), np.float64)

        found = {"min": at(0), "max": at(total - 1), "mean": mean, "std": np.sqrt(spread)}
        found |= {name: at(_rank(q, total)) for name, q in QUANTILES.items()}
        shaped = {name: (values / 255).reshape(3, 1, 1) for name, values in found.items()}
        return {name: shaped.get(name, np.array([self._count])) for name in NAMES}


class TotalStatistics:
    """Joins the statistics of episodes, one after the other."""

    def __init__(self) -> None:
        self._total: dict[str, Statistics] = {}

    def add(self, episode: Mapping[str, Statistics]) -> None:
        """Adds the statistics of the features of an episode."""
        for feature, found in episode.items():
            self._total[feature] = _joined([self._total[feature], found]) if feature in self._total else dict(found)

    def as_json(self) -> dict[str, dict[str, Any]]:
        """Returns feature -> name -> nested lists of numbers."""
        return {feature: {name: found[name].tolist() for name in NAMES} for feature, found in self._total.items()}


def _joined(parts: Sequence[Statistics]) -> Statistics:
    counts = np.concatenate([part["count"] for part in parts])
    shares = counts / counts.sum()

    def mean_of(values: Sequence[npt.NDArray[Any]]) -> npt.NDArray[np.float64]:
        return np.asarray(sum(share * value for share, value in zip(shares, values, strict=True)), np.float64)

    mean = mean_of([part["mean"] for part in parts])
    return {
        "min": np.minimum(parts[0]["min"], parts[1]["min"]),
        "max": np.maximum(parts[0]["max"], parts[1]["max"]),
        "mean": mean,
        "std": np.sqrt(mean_of([part["std"] ** 2 + (part["mean"] - mean) ** 2 for part in parts])),
        "count": np.array([counts.sum()]),
        **{name: mean_of([part[name] for part in parts]) for name in QUANTILES},
    }
