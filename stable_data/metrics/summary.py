"""A one-page summary of a set of scenes, from their metric cards and verdicts."""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import polars as pl

from stable_data.metrics.collision import DEEPEST
from stable_data.metrics.verdicts import ROUNDING, TOLERANCE

_NUM_WORST = 5  # scenes listed for each kind of defect
_BOUND = 1e3 * (TOLERANCE + ROUNDING)  # millimetres: the limit of the verdicts
_DEEP = 1e3 * (1e-2 + ROUNDING)  # millimetres


@dataclass(frozen=True, slots=True)
class SummaryLine:
    """One line of the summary.

    Attributes:
        label: The meaning of the count.
        count: The count.
        total: The number that it is a part of.
        unknown: How many could not be judged.
    """

    label: str
    count: int
    total: int
    unknown: int = 0

    @property
    def share(self) -> float:
        """Count over total; 0 if the total is 0."""
        return self.count / self.total if self.total else 0.0

    def __str__(self) -> str:
        unknown = f", {self.unknown} unknown" if self.unknown else ""
        return f"{self.label:<44} {self.count:>6} of {self.total:<6} {100 * self.share:5.1f} %{unknown}"


@dataclass(frozen=True, slots=True)
class AuditSummary:
    """The page.

    Attributes:
        lines: Counts of scenes and objects.
        figures: Name and value of each figure, such as the deepest penetration.
        worst: Id of each worst scene and its figure, as text.
    """

    lines: tuple[SummaryLine, ...]
    figures: tuple[tuple[str, str], ...]
    worst: tuple[tuple[str, str], ...]

    def __str__(self) -> str:
        figures = [f"{name:<44} {value}" for name, value in self.figures]
        worst = [f"  {scene_id:<28} {figure}" for scene_id, figure in self.worst]
        return "\n".join([*map(str, self.lines), *figures, *(["worst:", *worst] if worst else [])])


def summarise(scenes: pl.DataFrame) -> AuditSummary:
    """Summarises scenes.

    Args:
        scenes: Rows with the columns of the metric card, ``pairs`` and ``verdicts``, as in the table ``scenes``. Figures that
            are null for a whole scene are computed from its pairs and verdicts, so that one object without a mesh hides no
            known verdict.
    """
    scenes = scenes.with_columns(
        deepest=_each("pairs", pl.element().struct.field("penetration_mm")).list.max().fill_null(0.0),
        unknown_pairs=_each("pairs", pl.element().struct.field("penetration_mm").is_null()).list.sum(),
        gap=_each("verdicts", pl.element().struct.field("gap_mm")).list.max(),
        unknown_gaps=_each("verdicts", pl.element().struct.field("gap_mm").is_null()).list.sum(),
        floating=_each("verdicts", pl.element().struct.field("floats")).list.any(),
        may_float=_each("verdicts", pl.element().struct.field("floats").is_null()).list.any(),
        outside=_each("verdicts", _OUTSIDE).list.sum() / pl.col("num_objects"),
        may_be_outside=_each("verdicts", _OUTSIDE.is_null()).list.any(),
    )
    # One row for each object; a scene without objects has none.
    objects = scenes.select(pl.col("verdicts").explode()).drop_nulls().unnest("verdicts")

    def of_scenes(label: str, condition: pl.Expr, unknown: pl.Expr | None = None) -> SummaryLine:
        hits = _count(scenes, condition)
        return SummaryLine(label, hits, scenes.height, 0 if unknown is None else _count(scenes, unknown & ~condition))

    def of_objects(label: str, condition: pl.Expr) -> SummaryLine:
        return SummaryLine(label, _count(objects, condition), objects.height, _count(objects, condition.is_null()))

    unknown_pairs = pl.col("unknown_pairs") > 0
    lines = (
        SummaryLine("scenes clean (0.5 mm)", _count(scenes, pl.col("clean")), scenes.height, scenes["clean"].null_count()),
        of_scenes("scenes with a collision (0.5 mm)", pl.col("num_collisions") > 0, unknown_pairs),
        of_scenes("scenes with a collision deeper than 10 mm", pl.col("deepest") > _DEEP, unknown_pairs),
        of_scenes("scenes that sink into the table (0.5 mm)", pl.col("table_penetration_mm") > _BOUND),
        of_scenes("scenes with a floating object", pl.col("floating"), pl.col("may_float")),
        of_scenes("scenes with an object out of bounds", pl.col("outside") > 0, pl.col("may_be_outside")),
        of_scenes("scenes with a tilted object (5 degrees)", pl.col("num_tilted") > 0),
        of_scenes("scenes with a missing or broken mesh", pl.col("num_without_mesh") > 0),
        of_objects("objects that float (0.5 mm)", pl.col("floats")),
        of_objects("objects out of bounds", pl.col("leaves_table") | pl.col("enters_restricted_zone")),
        of_objects("objects without a mesh", ~pl.col("has_mesh")),
    )
    return AuditSummary(lines, _figures(scenes), tuple(_worst_scenes(scenes)))


_OUTSIDE = pl.element().struct.field("leaves_table") | pl.element().struct.field("enters_restricted_zone")


def _each(column: str, value: pl.Expr) -> pl.Expr:
    """A list for each scene: one value for each of its pairs or verdicts."""
    return pl.col(column).list.eval(value)


def _count(frame: pl.DataFrame, condition: pl.Expr) -> int:
    return frame.filter(condition).height


def _figures(scenes: pl.DataFrame) -> tuple[tuple[str, str], ...]:
    if not scenes.height:
        return ()
    found = scenes.select(
        pl.max("deepest", "table_penetration_mm", "gap"), pl.sum("unknown_pairs", "unknown_gaps"),
        objects=pl.col("num_objects").mean(), most=pl.col("num_objects").max(),
        oc=pl.col("oc").mean(), unknown_oc=pl.col("oc").null_count(),
    ).row(0, named=True)  # fmt: skip
    oc = "unknown" if found["oc"] is None else f"{100 * found['oc']:.3f} %"
    return (
        ("objects a scene, mean and most", f"{found['objects']:.1f}, {found['most']}"),
        ("deepest object-object penetration", _millimetres(found["deepest"]) + _unknown(found["unknown_pairs"], "pair")),
        ("deepest table penetration", f"{found['table_penetration_mm']:.2f} mm"),
        ("largest gap below an object", _millimetres(found["gap"]) + _unknown(found["unknown_gaps"], "object")),
        ("mean share of colliding pairs (OC)", oc + _unknown(found["unknown_oc"], "scene")),
    )


def _millimetres(value: float | None) -> str:
    """A depth or gap as text; the search for it ends at DEEPEST."""
    return "unknown" if value is None else f"at least {value:.0f} mm" if value >= 1e3 * DEEPEST else f"{value:.2f} mm"


def _unknown(count: int, noun: str) -> str:
    """How many values a figure does not cover."""
    return f", {count} {noun}{'s' * (count > 1)} unknown" if count else ""


def _worst_scenes(scenes: pl.DataFrame) -> Iterable[tuple[str, str]]:
    kinds: Sequence[tuple[str, str, float]] = (
        ("deepest", "{:.1f} mm deep in each other", _BOUND),
        ("table_penetration_mm", "{:.1f} mm in the table", _BOUND),
        ("gap", "{:.1f} mm above its support", _BOUND),
        ("outside", "{:.2f} of its objects out of bounds", 0.0),
    )
    for column, text, bound in kinds:
        worst = scenes.filter(pl.col(column) > bound).sort([column, "scene_id"], descending=[True, False]).head(_NUM_WORST)
        for scene_id, value in worst.select("scene_id", column).iter_rows():
            yield scene_id, text.format(value)
