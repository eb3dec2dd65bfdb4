"""The diversity of sets of scenes, and the near-duplicates within them and between them.

A near-duplicate in another split makes a test easier than it looks: a model is asked what it has been shown.
"""

import math
from collections import Counter
from collections.abc import Collection, Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass
from itertools import combinations
from typing import Any

import numpy as np

from stable_data.content_id import content_id
from stable_data.diversity.layout_similarity import OTHER_PLACE, SceneLayouts, group_pairs, layout_kernel, near_duplicates
from stable_data.diversity.scene_set import ComparedScene, SceneSet, layouts_of
from stable_data.errors import ConfigError
from stable_data.scene import IntArray
from stable_data.scores.set_distance import vendi_score_of_kernel

SAMPLE = 200
"""Scenes of which the Vendi score is computed: it grows with the number of scenes, so sets are compared at one size."""

DRAWS = 5
"""Samples over which the score is averaged."""

_EXAMPLES, _NAMED = 5, 6  # groups of near-duplicates that are shown, and scenes of each


def effective_number(counts: Iterable[int]) -> float:
    """Returns exp of the entropy of some counts: k for k equally frequent kinds; 0 without any."""
    shares = np.array([count for count in counts if count], np.float64)
    if not len(shares):
        return 0.0
    shares /= shares.sum()
    return math.exp(float(-(shares * np.log(shares)).sum()))


@dataclass(frozen=True, slots=True)
class Coverage:
    """How much of a library the scenes of a set use.

    Attributes:
        assets: Assets of the library that are in a scene.
        of_assets: Assets of the library that scenes may use.
        categories: Categories of the former.
        of_categories: Categories of the latter.
    """

    assets: int
    of_assets: int
    categories: int
    of_categories: int

    @classmethod
    def of(cls, used: Collection[str], library: Mapping[str, str] | None) -> "Coverage | None":
        """The coverage of a library, or None if it is not known.

        Args:
            used: The assets in the scenes; those that are not of the library do not count.
            library: Category of each asset, empty for none, by its id.
        """
        if library is None:
            return None
        own = library.keys() & set(used)
        categories = [{library[name] for name in some} - {""} for some in (own, library)]
        return cls(len(own), len(library), *map(len, categories))


@dataclass(frozen=True, slots=True)
class SetDiversity:
    """The diversity of one set.

    Attributes:
        name: The run.
        num_all: Scenes of the run.
        num_scenes: Scenes that were compared.
        num_objects: Mean number of objects of a scene.
        table_types: Number of types of tables.
        categories: Number of categories.
        effective_categories: How many equally frequent categories would be as diverse.
        assets: Number of assets.
        effective_assets: The same for assets.
        coverage: How much of the library is used; None if the library is not known.
        sample: Scenes of which the next two were computed.
        layouts: Effective number of layouts among so many scenes (Vendi score), mean over the draws; None without scenes.
        contents: The same for what is on the tables, wherever it is.
        duplicates: Scenes that have a near-duplicate in the set.
        across_splits: Scenes that have one in another split; None if no scene has a split.
        largest_group: Scenes of the largest group of near-duplicates.
        examples: Scenes of the largest groups of near-duplicates.
    """

    name: str
    num_all: int
    num_scenes: int
    num_objects: float
    table_types: int
    categories: int
    effective_categories: float
    assets: int
    effective_assets: float
    coverage: Coverage | None
    sample: int
    layouts: float | None
    contents: float | None
    duplicates: int
    across_splits: int | None
    largest_group: int
    examples: tuple[tuple[str, ...], ...]

    def lines(self) -> Iterable[str]:
        """The figures as lines of text."""
        yield _line("types of tables", str(self.table_types))
        yield _line("objects a scene, mean", f"{self.num_objects:.1f}")
        yield _line("categories, effective number", f"{self.categories}, {self.effective_categories:.1f}")
        yield _line("assets, effective number", f"{self.assets}, {self.effective_assets:.1f}")
        cover = self.coverage
        parts = (None, None) if cover is None else ((cover.assets, cover.of_assets), (cover.categories, cover.of_categories))
        for what, part in zip(("assets", "categories"), parts, strict=True):
            yield _line(f"{what} of the library that are used", _share(part))
        for what, value in (("layouts", self.layouts), ("sets of objects", self.contents)):
            said = "unknown" if value is None else f"{value:.1f} of {self.sample}"
            yield _line(f"effective number of {what} (Vendi score)", said)
        share = (
            f" ({100 * self.duplicates / self.num_scenes:.1f} %), largest group {self.largest_group}" if self.duplicates else ""
        )
        yield _line("scenes with a near-duplicate", f"{self.duplicates}{share}")
        if self.duplicates and self.across_splits is not None:
            yield _line("of these, with one in another split", str(self.across_splits))
        for names in self.examples:
            more = f", and {len(names) - _NAMED} more" if len(names) > _NAMED else ""
            yield f"near-duplicates: {', '.join(names[:_NAMED])}{more}"


@dataclass(frozen=True, slots=True)
class SetOverlap:
    """What two sets share.

    Attributes:
        first: One run.
        second: The other.
        first_scenes: Scenes of the first with a near-duplicate in the second.
        second_scenes: Scenes of the second with a near-duplicate in the first.
        categories: Number of categories that both have.
        assets: Number of assets that both have.
    """

    first: str
    second: str
    first_scenes: int
    second_scenes: int
    categories: int
    assets: int


@dataclass(frozen=True, slots=True)
class SetComparison:
    """The comparison of some sets.

    Attributes:
        sets: The diversity of each.
        overlaps: What each two of them share.
        groups: A row for each scene: ``run``, ``scene_id``, ``table_type``, ``split``, ``group`` and ``group_size``. The name of a group
            is a hash of its scenes, the same wherever their runs are.
    """

    sets: tuple[SetDiversity, ...]
    overlaps: tuple[SetOverlap, ...]
    groups: tuple[dict[str, Any], ...]

    def figures(self) -> dict[str, Any]:
        """The figures without the groups, for JSON."""
        return {"sets": [asdict(s) for s in self.sets], "overlaps": [asdict(o) for o in self.overlaps]}

    def __str__(self) -> str:
        """The figures as text."""
        lines = list[str]()
        for one in self.sets:
            drawn = f", drawn of {one.num_all}" if one.num_all > one.num_scenes else ""
            lines += [f"{one.name}: {one.num_scenes} scenes{drawn}", *(f"  {line}" for line in one.lines()), ""]
        for o in self.overlaps:
            lines.append(f"{o.first} and {o.second}")
            lines.append(
                "  " + _line("scenes with a near-duplicate in the other set", f"{o.first_scenes} and {o.second_scenes}")
            )
            lines.append("  " + _line("categories and assets of both", f"{o.categories} and {o.assets}"))
            lines.append("")
        return "\n".join(lines).rstrip()


def compare_sets(sets: Sequence[SceneSet], *, sample: int = SAMPLE, draws: int = DRAWS, seed: int = 0) -> SetComparison:
    """Compares sets of scenes.

    Args:
        sets: The sets.
        sample: Scenes of which the Vendi score is computed; at most those of the smallest set, so that scores can be compared.
        draws: Samples of this size; one where it has all scenes of a set.
        seed: Seed of the draws.

    Raises:
        ConfigError: ``sample`` or ``draws`` is less than 1.
    """
    if sample < 1 or draws < 1:
        raise ConfigError(f"sample is {sample} and draws {draws}, expected at least 1", "setting_invalid")
    scenes = [scene for one in sets for scene in one.scenes]
    owner = np.repeat(np.arange(len(sets)), [len(one) for one in sets])
    layouts = layouts_of(scenes)
    pairs = near_duplicates(layouts)
    sample = min([sample, *(len(one) for one in sets if len(one))])
    splits = np.array([scene.split or "" for scene in scenes], dtype=np.str_)
    found = []
    for k, one in enumerate(sets):
        own, rng = np.flatnonzero(owner == k), np.random.default_rng(seed)
        drawn = [
            layouts.some(np.sort(rng.choice(own, sample, replace=False)).tolist())
            for _ in range(draws if sample < len(own) else min(1, len(own)))
        ]
        scores = [[_vendi_score(some, length) for length in (OTHER_PLACE, math.inf)] for some in drawn]
        layout_score, content_score = np.mean(scores, axis=0).tolist() if scores else (None, None)
        categories = Counter(name for scene in one.scenes for name in scene.categories)
        assets = Counter(name for scene in one.scenes for name in scene.assets if name is not None)
        inside = pairs[(owner[pairs] == k).all(axis=1)]
        ends = splits[inside]
        between = inside[(ends[:, 0] != ends[:, 1]) & (ends != "").all(axis=1)]
        members = _members(group_pairs(inside, len(scenes)), own)
        found.append(
            SetDiversity(
                one.name,
                one.num_all,
                len(one),
                float(np.mean([len(scene.categories) for scene in one.scenes])) if len(one) else 0.0,
                len({scene.table_type for scene in one.scenes}),
                len(categories),
                effective_number(categories.values()),
                len(assets),
                effective_number(assets.values()),
                Coverage.of(assets, one.library),
                sample if scores else 0,
                layout_score,
                content_score,
                len(np.unique(inside)),
                len(np.unique(between)) if (splits[own] != "").any() else None,
                max(map(len, members), default=0),
                tuple(tuple(scenes[j].scene_id for j in group) for group in members[:_EXAMPLES] if len(group) > 1),
            )
        )
    overlaps = [_overlap(sets, owner, pairs, a, b) for a, b in combinations(range(len(sets)), 2)]
    return SetComparison(tuple(found), tuple(overlaps), tuple(_groups(sets, pairs)))


def _vendi_score(layouts: SceneLayouts, length: float) -> float:
    return vendi_score_of_kernel(layout_kernel(layouts, length)) if len(layouts) > 1 else 1.0


def _members(groups: IntArray, items: IntArray) -> list[list[int]]:
    """Some items by their group, the largest group first."""
    found: dict[int, list[int]] = {}
    for item in items.tolist():
        found.setdefault(int(groups[item]), []).append(item)
    return sorted(found.values(), key=len, reverse=True)


def _overlap(sets: Sequence[SceneSet], owner: IntArray, pairs: IntArray, first: int, second: int) -> SetOverlap:
    shared = pairs[(owner[pairs] == (first, second)).all(axis=1)]  # of a pair, the set that is named first is first
    one, other = sets[first], sets[second]
    categories, assets = (
        [{name for scene in s.scenes for name in getattr(scene, what)} - {None} for s in (one, other)]
        for what in ("categories", "assets")
    )
    return SetOverlap(
        one.name,
        other.name,
        len(np.unique(shared[:, 0])),
        len(np.unique(shared[:, 1])),
        len(categories[0] & categories[1]),
        len(assets[0] & assets[1]),
    )


def _groups(sets: Sequence[SceneSet], pairs: IntArray) -> Iterable[dict[str, Any]]:
    scenes = [(one.name, scene) for one in sets for scene in one.scenes]
    number = group_pairs(pairs, len(scenes))
    for own in sorted(_members(number, np.arange(len(scenes)))):
        name = content_id(sorted(_content(scenes[k][1]) for k in own))
        for run, scene in (scenes[k] for k in own):
            yield {
                "run": run,
                "scene_id": scene.scene_id,
                "table_type": scene.table_type,
                "split": scene.split,
                "group": name,
                "group_size": len(own),
            }


def _content(scene: ComparedScene) -> list[Any]:
    """What names a scene, without the run in which it is."""
    return [scene.scene_id, scene.table_type, list(scene.categories), scene.positions.tolist()]


def _share(part: tuple[int, int] | None) -> str:
    """A part of a number; unknown if either is, or if it would be a part of nothing."""
    return "unknown" if part is None or not part[1] else f"{part[0]} of {part[1]} ({100 * part[0] / part[1]:.1f} %)"


def _line(label: str, value: str) -> str:
    return f"{label:<52} {value}"
