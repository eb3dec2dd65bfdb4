"""The figures of a system: means over its scenes or tasks, with intervals and with the number of values that are not known."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from types import MappingProxyType
from typing import Any, Literal

from stable_data.rating.criteria import CRITERIA
from stable_data.scores.intervals import mean_interval, wilson_interval


@dataclass(frozen=True, slots=True)
class Figure:
    """A figure of a system.

    Attributes:
        key: Its name in files; for figures of scenes and tasks the column that is averaged.
        label: Its name in tables.
        per: What it is a mean over: ``scene``, the scenes that were made; ``task``, all tasks, where one without a scene counts as 0;
            ``request``, the same for the tasks that ask for it: AwS where an instruction states relations; ``set``, the repetitions,
            each of which has one value.
        factor: What values are multiplied by, 100 for shares in per cent.
        digits: Decimals in tables.
        better: ``higher``, ``lower``, or empty if neither is better.
        is_verdict: Whether values are true or false.
        lowest: Smallest possible value, in the unit of the table, at which intervals end.
        highest: Largest possible value.
    """

    key: str
    label: str
    per: Literal["scene", "task", "request", "set"] = "scene"
    factor: float = 1.0
    digits: int = 1
    better: Literal["", "higher", "lower"] = ""
    is_verdict: bool = False
    lowest: float = 0.0
    highest: float = math.inf


FIGURES = (
    Figure("made", "tasks with a scene, %", "task", 100.0, better="higher", is_verdict=True),
    Figure("ready", "clean and at rest, % of tasks", "task", 100.0, better="higher", is_verdict=True),
    Figure("oc", "exact OC, %", factor=100.0, digits=2, better="lower"),
    Figure("oc_sdf", "OC, %", factor=100.0, digits=2, better="lower"),
    Figure("float_rate", "floating, %", factor=100.0, better="lower"),
    Figure("float_gap", "floating by the paper's gap, %", factor=100.0, better="lower"),
    Figure("out_of_bounds_rate", "out of bounds, %", factor=100.0, better="lower"),
    Figure("clean", "clean, %", factor=100.0, better="higher", is_verdict=True),
    Figure("stable", "at rest, %", factor=100.0, better="higher", is_verdict=True),
    Figure("awt", "AwT, %", "request", 100.0, better="higher"),
    Figure("aws", "entailed AwS, %", "request", 100.0, better="higher"),
    Figure("aws_graph", "AwS, %", "request", 100.0, better="higher"),
    Figure("distractor_rate", "distractors, %", factor=100.0),
    Figure("num_objects", "objects"),
    Figure("num_stacked", "objects on others", digits=2),
    Figure("num_contained", "objects in others", digits=2),
    *(Figure(c.key, f"{c.key.upper()}, 1 to 10", digits=2, better="higher", lowest=1.0, highest=10.0) for c in CRITERIA),
    Figure("average", "average of the five, 1 to 10", digits=2, better="higher", lowest=1.0, highest=10.0),
    Figure("quality_pass", "average above 7 and clean, % of tasks", "task", 100.0, better="higher", is_verdict=True),
    Figure("frechet", "Frechet distance", "set", digits=2, better="lower"),
    Figure("kernel", "kernel distance", "set", digits=4, better="lower", lowest=-math.inf),
    Figure("vendi_pictures", "Vendi score of pictures", "set", better="higher"),
    Figure("vendi_layouts", "Vendi score of layouts", "set", better="higher"),
    Figure("pairs_unseen", "pairs of categories unseen in the reference's training, %", "set", better="lower", highest=100.0),
    Figure("placement", "placement, as a multiple of its floor", "set", digits=2, better="lower"),
    Figure("processor_seconds", "core seconds a task", "set", digits=2, better="lower"),
    Figure("seconds", "seconds of a worker a task", "set", digits=2, better="lower"),
    Figure("tokens", "tokens a task", "set", digits=0, better="lower"),
    Figure("cost", "cost a task", "set", digits=4, better="lower"),
)
"""All figures, in the order of the table."""

TABLE_1_COLUMNS: Mapping[str, str] = MappingProxyType(
    {
        **{c.key: c.key.upper() for c in CRITERIA},
        "average": "average",
        "oc_sdf": "OC, %",
        "awt": "AwT, %",
        "aws_graph": "AwS, %",
        "oc": "exact OC, %",
        "aws": "entailed AwS, %",
    }
)
"""Figures beside the distance of pictures in the paper's Table 1: those by the paper's rules, then those of this project."""

RULES = (
    "OC: a surface sample inside another object, and AwS: all relations of the task's graph, as in the paper; exact OC: deeper than 0.5 mm "
    "by the meshes, and entailed AwS: the relations that the instruction states"
)
"""What :data:`TABLE_1_COLUMNS` are."""


@dataclass(frozen=True, slots=True)
class Estimate:
    """A figure with its interval.

    Attributes:
        value: The mean; None if no value is known.
        low: Lower bound of its 95 % interval; None if it has none.
        high: Upper bound.
        known: Number of values.
        unknown: Number of scenes, tasks or repetitions whose value is not known.
    """

    value: float | None
    low: float | None
    high: float | None
    known: int
    unknown: int

    def text(self, digits: int) -> str:
        """The figure for a table: value, interval, and how many are unknown."""
        if self.value is None:
            return "unknown"
        bounds = "" if self.low is None or self.high is None else f" [{self.low:.{digits}f}, {self.high:.{digits}f}]"
        return f"{self.value:.{digits}f}{bounds}" + (f", {self.unknown} unknown" if self.unknown else "")


@dataclass(frozen=True, slots=True)
class Repetition:
    """What one repetition of a system gave.

    Attributes:
        tasks: Ids of all tasks.
        unlabelled: Those without labels, which ask for nothing that is compared with these.
        unanswered: Those without a scene because an endpoint did not answer.
        rows: Scene id -> column -> value, for the scenes that were made; only columns whose values were computed.
        values: Key -> value of the figures of the whole set; None where it is not known.
    """

    tasks: tuple[str, ...]
    rows: Mapping[str, Mapping[str, Any]]
    values: Mapping[str, float | None]
    unlabelled: frozenset[str] = frozenset()
    unanswered: frozenset[str] = frozenset()

    def __post_init__(self) -> None:
        """Refuses scenes of other tasks, whose tasks would count as without a scene (ValueError)."""
        if strange := sorted(self.rows.keys() - set(self.tasks)):
            raise ValueError(f"{strange[0]} is no task of the repetition, expected scenes of its tasks alone")


def estimate(
    samples: Sequence[Sequence[float | None]], factor: float = 1.0, *, are_verdicts: bool = False, are_same: bool = False
) -> Estimate:
    """Returns the mean of values and its interval.

    The interval of verdicts is Wilson's over all of them. That of other values is Student's t for the mean over repetitions, of one
    repetition for the mean over its values; equal values have none, because they do not show how values spread.

    Args:
        samples: The values of each repetition.
        factor: What the values are multiplied by.
        are_verdicts: Whether all values are 0 or 1.
        are_same: Whether all repetitions are of the same tasks. Their verdicts are then not independent, and the interval is as wide as
            that of the same rate in a single one.
    """
    filled = [values for sample in samples if (values := [float(v) for v in sample if v is not None])]
    unknown = sum(v is None for sample in samples for v in sample)
    every = [value for values in filled for value in values]
    if not every:
        return Estimate(None, None, None, 0, unknown)
    if are_verdicts:
        value, num = sum(every) / len(every), len(every) // len(filled) if are_same else len(every)
        low, high = wilson_interval(round(value * num), num)
    else:
        means = [sum(values) / len(values) for values in filled]
        value, low, high = mean_interval(means if len(samples) > 1 else filled[0])
    is_bounded = math.isfinite(high - low) and high > low
    return Estimate(
        factor * value, factor * low if is_bounded else None, factor * high if is_bounded else None, len(every), unknown
    )


def estimate_figures(systems: Mapping[str, Sequence[Repetition]]) -> dict[str, dict[str, Estimate]]:
    """Returns the figures of systems that had the same tasks.

    A task asks for AwS, for example, if a scene of some system has a value. Of a labelled task without any scene it is not known, and it
    counts as if it did.

    Args:
        systems: Label -> the repetitions of a system, none if it was not run.

    Returns:
        Label -> key of the figure -> estimate.
    """
    found: dict[str, dict[str, Estimate]] = {label: {} for label in systems}
    every = [one for repetitions in systems.values() for one in repetitions]
    are_same = {
        label: len({name for one in own for name in one.tasks}) < sum(len(one.tasks) for one in own)
        for label, own in systems.items()
    }
    told = {name for one in every for name in (*one.rows, *one.unlabelled)}
    for figure in FIGURES:
        silent = set[str]()
        if figure.per == "request":
            silent = told - {name for one in every for name, row in one.rows.items() if row.get(figure.key) is not None}
        for label, repetitions in systems.items():
            samples = [_values(figure, one, silent) for one in repetitions]
            mean = estimate(samples, figure.factor, are_verdicts=figure.is_verdict, are_same=are_same[label])
            found[label][figure.key] = _within(figure, mean)
    return found


def _within(figure: Figure, found: Estimate) -> Estimate:
    """An estimate whose interval ends at the smallest and the largest possible value; shares end at 100 %."""
    if found.low is None or found.high is None:
        return found
    highest = min(figure.highest, figure.factor) if figure.factor > 1 else figure.highest
    return replace(found, low=max(found.low, figure.lowest), high=min(found.high, highest))


def _values(figure: Figure, one: Repetition, silent: set[str]) -> list[float | None]:
    """The values of a repetition; ``silent`` are tasks that do not ask for the figure."""
    if figure.per == "set":
        return [one.values.get(figure.key)]
    of_scenes = {name: row.get(figure.key) for name, row in one.rows.items()}
    if figure.per == "scene":
        return list(of_scenes.values())
    asking = [name for name in one.tasks if name not in silent]
    if of_scenes and all(value is None for value in of_scenes.values()):
        return [None] * len(asking)  # nothing was judged: zeros of tasks without a scene alone would be no mean
    return [of_scenes.get(name, None if name in one.unanswered else 0.0) for name in asking]
