"""The taste of scenes: statistics of what is on a table and how it lies there, and their distance to those of held-out scenes.

- repeats: share of the objects whose category occurs before in the scene; most of one category: its count;
- pairs unseen: share of the pairs of different categories of a scene that no scene of training has together. The expected
  value is that of the held-out scenes;
- covered: share of the table's area under the outlines of things on the table;
- gap, uneven gaps, touching: mean distance from a thing on the table to the nearest outline of another one; standard deviation of
  these distances divided by their mean, with three or more things; share of these distances up to 2 mm;
- stacked mats: scenes in which a thing lower than 1 cm lies on another one; both are at least 5 cm wide, because a knife on a
  napkin is no fault;
- on, in: share of the objects that are on or in another one;
- yaw, straight, in line: of things on the table: degrees to the nearest multiple of 90; share within 5; share of the pairs of
  nearest neighbours whose centres agree in x or y within 1 cm;
- edge, cells: of things on the table: distance from the outline to the nearest edge of the table, negative beyond it; the ninth of
  the table with the centre;
- size: logarithm of an object's volume divided by the geometric mean of its category in training.

Outlines and volumes are those of boxes. A thing is on the table if it is neither on nor in another one.

The distance is Wasserstein-1 divided by the standard deviation of the held-out values; for cells and stacked mats it is the total
variation. The floor is the mean distance between two random parts of the held-out scenes: halves, or as many scenes as were
generated and the rest if fewer were generated. A figure of too few scenes is unknown, as is a distance to equal held-out values
from which the generated ones differ.
"""

from collections import Counter, defaultdict
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from itertools import combinations
from typing import TypeAlias

import numpy as np
import pyarrow.compute as pc
import shapely
from scipy.stats import wasserstein_distance

from stable_data.scene import FloatArray, RelationKind, Scene, SceneObject
from stable_data.scene_graph.relations import CELLS, cell_of, yawed_rectangle
from stable_data.storage.filter_expression import parse_filter
from stable_data.storage.run_folder import RunFolder
from stable_data.storage.schemas import SCHEMAS
from stable_data.storage.table_rows import scene_from_row

LEAST = 10
"""Fewest scenes with a value on either side of a distance."""

LEAST_TRAINING = 100
"""Fewest training scenes in which a pair of categories that is not there says anything."""

POOLED = "all tables"

_MAT_HEIGHT, _MAT_WIDTH = 0.01, 0.05  # metres
_STRAIGHT = 5.0  # degrees
_IN_LINE, _TOUCHING = 0.01, 0.002  # metres
_HALVINGS = 20  # random halvings of the held-out scenes; one alone gives a noisy floor
_LEAST_VOLUME = 1e-9  # cubic metres: a box without thickness has no logarithm
_COLUMNS = ["scene_id", "table_type", "table_size", "restricted_zone", "task", "objects", "relations", "source_json"]

Values: TypeAlias = Sequence[float]
"""The values of one scene: one, or one for each object, or none if the scene has no such value."""


class TrainingStatistics:
    """What the statistics know of the training scenes.

    Args:
        scenes: The scenes.
    """

    def __init__(self, scenes: Iterable[Scene]) -> None:
        self.together: set[tuple[str, str]] = set()
        self.num_scenes = 0
        logs: defaultdict[str, list[float]] = defaultdict(list)
        for scene in scenes:
            self.num_scenes += 1
            self.together.update(_category_pairs(scene))
            for o in scene.objects:
                logs[o.category].append(_log_volume(o))
        self.log_volume = {category: float(np.mean(values)) for category, values in logs.items()}


def _category_pairs(scene: Scene) -> list[tuple[str, str]]:
    return list(combinations(sorted({o.category for o in scene.objects}), 2))


def _log_volume(o: SceneObject) -> float:
    return float(np.log(max(_LEAST_VOLUME, o.size[0] * o.size[1] * o.size[2])))


class SceneTaste:
    """A scene with what its statistics share.

    Args:
        scene: The scene, with its relations.
        training: The training scenes.
    """

    def __init__(self, scene: Scene, training: TrainingStatistics) -> None:
        self.scene, self.training = scene, training
        self.objects = {o.instance: o for o in scene.objects}
        self.carried = {
            kind: {r.subject: r.target for r in scene.relations if r.kind is kind and r.target in self.objects}
            for kind in (RelationKind.ON, RelationKind.IN)
        }
        self.on_table = [o for o in scene.objects if not any(o.instance in carried for carried in self.carried.values())]

    @cached_property
    def outlines(self) -> list[shapely.Polygon]:
        """The outlines of the things on the table."""
        return [shapely.Polygon(yawed_rectangle(o)) for o in self.on_table]

    @cached_property
    def neighbours(self) -> tuple[FloatArray, list[int]]:
        """Of each thing on the table: metres to the nearest outline of another one, and which thing has it; empty for one thing."""
        if len(self.outlines) < 2:
            return np.zeros(0), []
        outlines = np.array(self.outlines)
        gaps = np.array(shapely.distance(outlines[:, None], outlines[None]), np.float64)
        np.fill_diagonal(gaps, np.inf)
        return gaps.min(axis=1), gaps.argmin(axis=1).tolist()

    def counts(self) -> Counter[str]:
        """The number of objects of each category."""
        return Counter(o.category for o in self.scene.objects)

    def repeats(self) -> Values:
        """Percent of the objects whose category occurs before."""
        return [100 * (1 - len(self.counts()) / len(self.objects))] if self.objects else []

    def pairs_unseen(self) -> Values:
        """Percent of the pairs of categories that are never together in training."""
        pairs = _category_pairs(self.scene) if self.training.num_scenes else []
        return [100 * sum(pair not in self.training.together for pair in pairs) / len(pairs)] if pairs else []

    def covered(self) -> Values:
        """Percent of the table's area under outlines."""
        x, y = self.scene.table.size_xy
        return [100 * float(shapely.union_all(self.outlines).intersection(shapely.box(0, 0, x, y)).area) / (x * y)]

    def gap(self) -> Values:
        """Mean distance to the nearest outline, cm."""
        gaps, _ = self.neighbours
        return [100 * float(gaps.mean())] if len(gaps) else []

    def uneven_gaps(self) -> Values:
        """Coefficient of variation of the distances to the nearest outline."""
        gaps, _ = self.neighbours
        return [float(gaps.std() / gaps.mean())] if len(gaps) >= 3 and gaps.mean() > 0 else []

    def touching(self) -> Values:
        """Percent of the things on the table whose outline touches another one, or nearly."""
        gaps, _ = self.neighbours
        return [100 * float((gaps <= _TOUCHING).mean())] if len(gaps) else []

    def stacked_mats(self) -> Values:
        """100 if a mat lies on a mat, else 0."""
        mats = {o.instance for o in self.scene.objects if o.size[2] < _MAT_HEIGHT and min(o.size[:2]) >= _MAT_WIDTH}
        return [100.0 * any({one, other} <= mats for one, other in self.carried[RelationKind.ON].items())]

    def share_carried(self, kind: RelationKind) -> Values:
        """Percent of the objects that are on or in another one."""
        return [100 * len(self.carried[kind]) / len(self.objects)] if self.objects else []

    def yaw(self) -> Values:
        """Degrees from the yaw of each thing on the table to the nearest multiple of 90."""
        return [abs((float(np.degrees(o.yaw)) + 45) % 90 - 45) for o in self.on_table]

    def straight(self) -> Values:
        """Percent of the things on the table whose yaw is near a multiple of 90 degrees."""
        yaw = self.yaw()
        return [100 * sum(degrees <= _STRAIGHT for degrees in yaw) / len(yaw)] if yaw else []

    def in_line(self) -> Values:
        """Percent of the pairs of nearest neighbours whose centres agree in x or y."""
        centres = np.array([o.position[:2] for o in self.on_table])
        pairs = {frozenset(pair) for pair in enumerate(self.neighbours[1])}
        agree = [float(np.abs(np.subtract(*centres[list(pair)])).min()) <= _IN_LINE for pair in pairs]
        return [100 * sum(agree) / len(agree)] if agree else []

    def edge(self) -> Values:
        """Distance from each outline to the nearest edge, cm."""
        corners = [yawed_rectangle(o) for o in self.on_table]
        return [100 * float(min(c.min(), (np.array(self.scene.table.size_xy) - c).min())) for c in corners]

    def cells(self) -> Values:
        """Number of the ninth of the table that each thing is in."""
        return [float(CELLS.index(cell_of(o.position, self.scene.table.size_xy))) for o in self.on_table]

    def size(self) -> Values:
        """Logarithm of each volume relative to its category in training."""
        known = self.training.log_volume
        return [_log_volume(o) - known[o.category] for o in self.scene.objects if o.category in known]


@dataclass(frozen=True, slots=True)
class Statistic:
    """One statistic.

    Attributes:
        label: Its name and unit in the printed table.
        measure: Its values of a scene.
        is_label: Whether its values are names, which have no distance from each other: total variation is measured.
        has_mean: Whether the mean of its values says something.
    """

    label: str
    measure: Callable[[SceneTaste], Values]
    is_label: bool = False
    has_mean: bool = True


STATISTICS: Mapping[str, Statistic] = {
    "objects": Statistic("objects", lambda s: [float(len(s.objects))]),
    "repeats": Statistic("repeats, %", SceneTaste.repeats),
    "most_of_one": Statistic("most of one category", lambda s: [float(max(s.counts().values(), default=0))]),
    "pairs_unseen": Statistic("pairs unseen, %", SceneTaste.pairs_unseen),
    "covered": Statistic("covered, %", SceneTaste.covered),
    "gap": Statistic("gap, cm", SceneTaste.gap),
    "uneven_gaps": Statistic("uneven gaps", SceneTaste.uneven_gaps),
    "touching": Statistic("touching, %", SceneTaste.touching),
    "stacked_mats": Statistic("stacked mats, % of scenes", SceneTaste.stacked_mats, is_label=True),
    "on": Statistic("on, %", lambda s: s.share_carried(RelationKind.ON)),
    "in": Statistic("in, %", lambda s: s.share_carried(RelationKind.IN)),
    "yaw": Statistic("yaw, degrees", SceneTaste.yaw),
    "straight": Statistic("straight, %", SceneTaste.straight),
    "in_line": Statistic("in line, %", SceneTaste.in_line),
    "edge": Statistic("edge, cm", SceneTaste.edge),
    "cells": Statistic("cells", SceneTaste.cells, is_label=True, has_mean=False),
    "size": Statistic("size, log", SceneTaste.size),
}
"""The statistics by their name in the JSON file, in the order of the printed table."""


PLACEMENT = ("covered", "gap", "edge", "cells", "yaw", "straight", "in_line")
"""Statistics of how things lie on the table."""


@dataclass(frozen=True, slots=True)
class StatisticComparison:
    """A statistic of two sets of scenes; None is unknown.

    Attributes:
        generated: Mean of the generated values.
        held_out: Mean of the held-out values.
        distance: Distance of the two distributions.
        floor: Distance of two random parts of the held-out scenes.
        ratio: Distance divided by floor.
        num_generated: Generated scenes with a value.
        num_held_out: Held-out scenes with a value.
    """

    generated: float | None
    held_out: float | None
    distance: float | None
    floor: float | None
    ratio: float | None
    num_generated: int
    num_held_out: int


def compare(statistic: Statistic, generated: Sequence[Values], held_out: Sequence[Values]) -> StatisticComparison:
    """Compares the values of generated scenes with those of held-out ones.

    Args:
        statistic: The statistic.
        generated: Its values, by scene.
        held_out: Likewise.
    """
    one, other = ([np.asarray(values, np.float64) for values in scenes if len(values)] for scenes in (generated, held_out))
    means = [float(np.concatenate(x).mean()) if x and statistic.has_mean else None for x in (one, other)]
    distance = floor = None
    if min(len(one), len(other)) >= LEAST:
        unit = 1.0 if statistic.is_label else float(np.concatenate(other).std())
        distance = _distance(statistic, one, other, unit)
        first = min(len(one), len(other) // 2)
        if first >= LEAST:
            rng = np.random.default_rng(0)
            orders = [rng.permutation(len(other)) for _ in range(_HALVINGS)]
            parts = [([other[k] for k in order[:first]], [other[k] for k in order[first:]]) for order in orders]
            found = [_distance(statistic, a, b, unit) for a, b in parts]
            floor = float(np.mean([d for d in found if d is not None]))  # with equal held-out values all are 0
    ratio = distance / floor if distance is not None and floor else None
    return StatisticComparison(means[0], means[1], distance, floor, ratio, len(one), len(other))


def _distance(statistic: Statistic, one: Sequence[FloatArray], other: Sequence[FloatArray], unit: float) -> float | None:
    """Returns the distance of two sets of values, or None if it has no unit."""
    a, b = np.concatenate(one), np.concatenate(other)
    if statistic.is_label:
        return float(sum(abs((a == label).mean() - (b == label).mean()) for label in np.union1d(a, b))) / 2
    apart = float(wasserstein_distance(a, b))
    return apart / unit if unit > 0 else 0.0 if apart == 0 else None


def compare_scenes(
    generated: Sequence[Scene], held_out: Sequence[Scene], training: TrainingStatistics
) -> dict[str, dict[str, StatisticComparison]]:
    """Returns the comparison of each statistic, by kind of table, first of all tables together."""
    values = [
        [(scene.table.table_type, {k: s.measure(taste) for k, s in STATISTICS.items()}) for scene, taste in tastes]
        for tastes in ([(scene, SceneTaste(scene, training)) for scene in scenes] for scenes in (generated, held_out))
    ]
    kinds = sorted({kind for scenes in values for kind, _ in scenes})

    def of(key: str, chosen: str) -> StatisticComparison:
        one, other = ([found[key] for kind, found in scenes if chosen in (kind, POOLED)] for scenes in values)
        return compare(STATISTICS[key], one, other)

    return {kind: {key: of(key, kind) for key in STATISTICS} for kind in (POOLED, *kinds)}


def placement_ratio(comparisons: Mapping[str, StatisticComparison]) -> float | None:
    """Returns how much farther from held-out scenes the placement is than held-out scenes are from each other.

    Args:
        comparisons: The comparison of each statistic.

    Returns:
        The mean over the statistics of ``PLACEMENT`` of distance divided by floor: about 1 for scenes like the held-out ones; None if one
        of them is unknown.
    """
    ratios = [comparisons[key].ratio for key in PLACEMENT]
    known = [ratio for ratio in ratios if ratio is not None]
    return float(np.mean(known)) if len(known) == len(ratios) else None


def read_scenes(run: str, splits: Sequence[str], where: str = "") -> Iterable[Scene]:
    """Yields the scenes of some splits of a run, or all scenes if no split is named.

    Args:
        run: The run.
        splits: Names of splits.
        where: A further condition on the scenes (:mod:`stable_data.storage.filter_expression`).

    Raises:
        ConfigError: The run or the condition cannot be read.
    """
    chosen = pc.field("split").isin(list(splits)) if splits else None
    if where:
        asked = parse_filter(where, SCHEMAS["scenes"]).expression
        chosen = asked if chosen is None else chosen & asked
    for batch in RunFolder(run).batches("scenes", _COLUMNS, chosen):
        yield from map(scene_from_row, batch.to_pylist())
