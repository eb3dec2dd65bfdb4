"""The diversity of sets of pictures of scenes, and the pictures that are nearly the same, by their features.

Two pictures are near-duplicates if the cosine of their features is at least a limit that belongs to the features. The limits of
:data:`ALIKE` lie between those of the same scene with every object moved by about 1 cm and turned by about 5 degrees, and those of
different scenes; docs/diversity.md has the figures.
"""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass
from itertools import combinations
from types import MappingProxyType
from typing import Any

import numpy as np

from stable_data.diversity.comparison import DRAWS, SAMPLE
from stable_data.diversity.layout_similarity import group_pairs
from stable_data.errors import ConfigError
from stable_data.feature_files import GRADIENTS, INCEPTION
from stable_data.scene import IntArray
from stable_data.scores.set_distance import Features, vendi_at
from stable_data.storage.row_groups import TableFiles

VIEW = "front"
"""The view whose features are compared, as the paper does for FID."""

ALIKE: Mapping[str, float] = MappingProxyType({INCEPTION: 0.95, GRADIENTS: 0.998})
"""Least cosine of near-duplicates, by the features."""

_BLOCK = 2048  # pictures that are compared with all others at once
_LEAVES = ("scene_id", "extractor", "extractor_fingerprint", "views.list.element.view", "views.list.element.features")


@dataclass(frozen=True, slots=True, eq=False)
class PictureSet:
    """The features of the pictures of a run.

    Attributes:
        name: The run of the pictures.
        scene_ids: The scenes, N, sorted.
        features: (N, D) float32, of the front views.
        extractor: Name of what computed them.
        fingerprint: Hash of all that determines them.
    """

    name: str
    scene_ids: tuple[str, ...]
    features: Features
    extractor: str
    fingerprint: str

    @classmethod
    def read(cls, uri: str) -> "PictureSet":
        """Reads the features of a run of the job ``views``; its pictures are not read.

        Raises:
            ConfigError: The table ``views`` is missing, or has no rows (``source_empty``).
        """
        files = TableFiles(uri, "views", _LEAVES)
        rows = [row for group in range(len(files.groups)) for row in files.read([group]).to_pylist()]
        if not rows:
            raise ConfigError(f"{uri}: has no pictures, expected some", "source_empty")
        rows.sort(key=lambda row: str(row["scene_id"]))
        chosen = [next(view["features"] for view in row["views"] if view["view"] == VIEW) for row in rows]
        names = tuple(str(row["scene_id"]) for row in rows)
        return cls(uri, names, np.array(chosen, np.float32), rows[0]["extractor"], rows[0]["extractor_fingerprint"])

    def __len__(self) -> int:
        """Number of pictures."""
        return len(self.scene_ids)


@dataclass(frozen=True, slots=True)
class PictureDiversity:
    """The diversity of one set of pictures.

    Attributes:
        name: The run of the pictures.
        num_pictures: Number of pictures.
        sample: Pictures of which the next figure was computed.
        vendi: Effective number of pictures among so many (Vendi score), mean over the draws; None with a single picture.
        duplicates: Pictures that have a near-duplicate in the set.
        examples: Scenes of the largest groups of near-duplicates.
    """

    name: str
    num_pictures: int
    sample: int
    vendi: float | None
    duplicates: int
    examples: tuple[tuple[str, ...], ...]


@dataclass(frozen=True, slots=True)
class PictureComparison:
    """The comparison of some sets of pictures.

    Attributes:
        features: Name of the features.
        alike: Least cosine of near-duplicates.
        sets: The diversity of each.
        overlaps: For each two sets their names, and the pictures of each that have a near-duplicate in the other.
        groups: A row for each scene: ``run``, ``scene_id``, ``group`` and ``group_size``.
    """

    features: str
    alike: float
    sets: tuple[PictureDiversity, ...]
    overlaps: tuple[tuple[str, str, int, int], ...]
    groups: tuple[dict[str, Any], ...]

    def figures(self) -> dict[str, Any]:
        """The figures without the groups, for JSON."""
        overlaps = [dict(zip(("first", "second", "first_scenes", "second_scenes"), o, strict=True)) for o in self.overlaps]
        return {"features": self.features, "alike": self.alike, "sets": [asdict(s) for s in self.sets], "overlaps": overlaps}

    def __str__(self) -> str:
        """The figures as text."""
        return "\n".join(self._lines())

    def _lines(self) -> Iterable[str]:
        yield f"features: {self.features}; near-duplicates have a cosine of at least {self.alike:g}"
        for one in self.sets:
            yield f"{one.name}: {one.num_pictures} pictures"
            score = "unknown" if one.vendi is None else f"{one.vendi:.1f} of {one.sample}"
            yield f"  {'effective number of pictures (Vendi score)':<52} {score}"
            yield f"  {'pictures with a near-duplicate':<52} {one.duplicates}"
            yield from (f"  near-duplicates: {', '.join(names)}" for names in one.examples)
        for first, second, one_way, other_way in self.overlaps:
            yield f"{first} and {second}"
            yield f"  {'pictures with a near-duplicate in the other set':<52} {one_way} and {other_way}"


def near_duplicate_pictures(features: Features, alike: float) -> IntArray:
    """Returns the pairs of rows whose cosine is at least ``alike``, (P, 2) int64, the smaller index first, in ascending order.

    Args:
        features: (N, D); a row of zeros has no near-duplicate.
        alike: The limit, above 0.
    """
    rows = np.asarray(features, np.float64)
    lengths = np.linalg.norm(rows, axis=1, keepdims=True)
    units = np.divide(rows, lengths, out=np.zeros_like(rows), where=lengths > 0).astype(np.float32)
    pairs = []
    for k in range(0, len(units), _BLOCK):
        first, second = np.nonzero(units[k : k + _BLOCK] @ units.T >= np.float32(alike))
        is_ordered = first + k < second
        pairs.append(np.stack([first[is_ordered] + k, second[is_ordered]], axis=1))
    return np.concatenate([np.zeros((0, 2), np.int64), *pairs])


def compare_pictures(
    sets: Sequence[PictureSet], *, alike: float | None = None, sample: int = SAMPLE, draws: int = DRAWS, seed: int = 0
) -> PictureComparison:
    """Compares sets of pictures.

    Args:
        sets: The sets, whose features one extractor computed.
        alike: Least cosine of near-duplicates; None: that of ``ALIKE``.
        sample: Pictures of which the Vendi score is computed; at most those of the smallest set.
        draws: Samples of this size.
        seed: Seed of the draws.

    Raises:
        ConfigError: The features are not of one extractor (``features_differ``), or no limit is known for them (``setting_invalid``).
    """
    if len({one.fingerprint for one in sets}) > 1:
        told = ", ".join(sorted({one.extractor for one in sets}))
        raise ConfigError(
            f"features of the pictures differ ({told}), expected one extractor; draw them again", "features_differ"
        )
    features = sets[0].extractor
    limit = ALIKE.get(features.partition(":")[0]) if alike is None else alike
    if limit is None:
        raise ConfigError(
            f"no limit of near-duplicates is known for the features {features}, expected --alike", "setting_invalid"
        )
    owner = np.repeat(np.arange(len(sets)), [len(one) for one in sets])
    names = [name for one in sets for name in one.scene_ids]
    pairs = near_duplicate_pictures(np.concatenate([one.features for one in sets]), limit)
    size = min(sample, *(len(one) for one in sets)) if len(sets) > 1 else min(sample, len(sets[0]))
    found = []
    for k, one in enumerate(sets):
        inside = pairs[(owner[pairs] == k).all(axis=1)]
        vendi = vendi_at(one.features, size, draws if size < len(one) else 1, seed).mean if size > 1 else None
        groups = [group for group in _groups(inside, len(names)) if len(group) > 1]
        examples = tuple(tuple(names[j] for j in group[:6]) for group in sorted(groups, key=len, reverse=True)[:5])
        found.append(
            PictureDiversity(one.name, len(one), size if vendi is not None else 0, vendi, len(np.unique(inside)), examples)
        )
    overlaps = []
    for a, b in combinations(range(len(sets)), 2):
        shared = pairs[(owner[pairs] == (a, b)).all(axis=1)]
        overlaps.append((sets[a].name, sets[b].name, len(np.unique(shared[:, 0])), len(np.unique(shared[:, 1]))))
    rows = [
        {"run": sets[owner[k]].name, "scene_id": names[k], "group": number, "group_size": len(group)}
        for number, group in enumerate(_groups(pairs, len(names)))
        for k in group
    ]
    return PictureComparison(features, limit, tuple(found), tuple(overlaps), tuple(rows))


def _groups(pairs: IntArray, size: int) -> list[list[int]]:
    """The members of each group, in the order of their first members."""
    found: dict[int, list[int]] = {}
    for k, number in enumerate(group_pairs(pairs, size).tolist()):
        found.setdefault(number, []).append(k)
    return list(found.values())
