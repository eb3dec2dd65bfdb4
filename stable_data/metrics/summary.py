"""One page on the state of a set of scenes, from their metric cards and verdicts."""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import polars as pl

_WORST = 5


@dataclass(frozen=True, slots=True)
class Offender:
    """A scene that is worst in something.

    Attributes:
        scene_id: The scene.
        what: In what, with the figure.
    """

    scene_id: str
    what: str


@dataclass(frozen=True, slots=True)
class Line:
    """One line of the summary.

    Attributes:
        label: What is counted.
        count: How many.
        total: Out of how many.
        unknown: How many could not be judged.
    """

    label: str
    count: int
    total: int
    unknown: int = 0

    @property
    def share(self) -> float:
        """Count over total; 0 for none."""
        return self.count / self.total if self.total else 0.0

    def __str__(self) -> str:
        """The line as text."""
        unknown = f", {self.unknown} unknown" if self.unknown else ""
        return f"{self.label:<44} {self.count:>6} of {self.total:<6} {100 * self.share:5.1f} %{unknown}"


@dataclass(frozen=True, slots=True)
class Summary:
    """The page.

    Attributes:
        lines: Scene and object counts.
        figures: Name and value of the deepest, the largest and so on.
        offenders: Worst scenes.
    """

    lines: tuple[Line, ...]
    figures: tuple[tuple[str, str], ...]
    offenders: tuple[Offender, ...]

    def __str__(self) -> str:
        """The page as text."""
        figures = [f"{name:<44} {value}" for name, value in self.figures]
        worst = [f"  {o.scene_id:<28} {o.what}" for o in self.offenders]
        return "\n".join([*map(str, self.lines), *figures, *(["worst:", *worst] if worst else [])])


def summarise(scenes: pl.DataFrame) -> Summary:
    """Sums up scenes.

    Args:
        scenes: Rows with the columns of the metric card and ``verdicts``, as in the table ``scenes``.

    Returns:
        The summary.
    """
    count = scenes.height
    verdicts = scenes.select(pl.col("verdicts").explode()).drop_nulls().unnest("verdicts") if count else pl.DataFrame()

    def of_scenes(label: str, condition: pl.Expr, unknown: pl.Expr | None = None) -> Line:
        return Line(label, _count(scenes, condition), count, 0 if unknown is None else _count(scenes, unknown))

    def of_objects(label: str, condition: pl.Expr, unknown: pl.Expr | None = None) -> Line:
        hits = [0 if e is None or not verdicts.height else _count(verdicts, e) for e in (condition, unknown)]
        return Line(label, hits[0], verdicts.height, hits[1])

    collides = pl.col("num_collisions") > 0
    outside = pl.col("leaves_table") | pl.col("enters_restricted_zone")
    lines = (
        of_scenes("scenes clean (0.5 mm)", pl.col("clean"), pl.col("clean").is_null()),
        of_scenes("scenes with a collision (0.5 mm)", collides, ~collides & pl.col("oc").is_null()),
        of_scenes("scenes with a collision deeper than 10 mm", pl.col("oc_10mm") > 0, pl.col("oc_10mm").is_null()),
        of_scenes("scenes that sink into the table (0.5 mm)", pl.col("table_penetration_mm") > 0.5),
        of_scenes(
            "scenes with a floating object", pl.col("verdicts").list.eval(pl.element().struct.field("floats")).list.any()
        ),
        of_scenes("scenes with an object out of bounds", pl.col("out_of_bounds_rate") > 0),
        of_scenes("scenes with a tilted object (5 degrees)", pl.col("num_tilted") > 0),
        of_scenes("scenes with a missing or broken mesh", pl.col("num_without_mesh") > 0),
        of_objects("objects that float (0.5 mm)", pl.col("floats"), pl.col("floats").is_null()),
        of_objects("objects out of bounds", outside),
        of_objects("objects without a mesh", ~pl.col("has_mesh")),
    )
    return Summary(lines, _figures(scenes), tuple(_offenders(scenes)))


def _count(frame: pl.DataFrame, condition: pl.Expr) -> int:
    return frame.filter(condition).height


def _figures(scenes: pl.DataFrame) -> tuple[tuple[str, str], ...]:
    if not scenes.height:
        return ()
    deepest = scenes.select(
        pairs=pl.col("max_penetration_mm").max(), table=pl.col("table_penetration_mm").max(), gap=pl.col("max_gap_mm").max(),
        objects=pl.col("num_objects").mean(), most=pl.col("num_objects").max(), oc=pl.col("oc").mean(),
    ).row(0, named=True)  # fmt: skip
    return (
        ("objects a scene, mean and most", f"{deepest['objects']:.1f}, {deepest['most']}"),
        ("deepest object-object penetration", _millimetres(deepest["pairs"])),
        ("deepest table penetration", _millimetres(deepest["table"])),
        ("largest gap below an object", _millimetres(deepest["gap"])),
        ("mean share of colliding pairs (OC)", "unknown" if deepest["oc"] is None else f"{100 * deepest['oc']:.3f} %"),
    )


def _millimetres(value: float | None) -> str:
    return "unknown" if value is None else f"at least {value:.0f} mm" if value >= 100 else f"{value:.2f} mm"


def _offenders(scenes: pl.DataFrame) -> Iterable[Offender]:
    kinds: Sequence[tuple[str, str, float]] = (
        ("max_penetration_mm", "{:.1f} mm deep in each other", 0.5),
        ("table_penetration_mm", "{:.1f} mm in the table", 0.5),
        ("max_gap_mm", "{:.1f} mm above its support", 0.5),
        ("out_of_bounds_rate", "{:.2f} of its objects out of bounds", 0.0),
    )
    for column, text, bound in kinds:
        worst = scenes.filter(pl.col(column) > bound).sort([column, "scene_id"], descending=[True, False]).head(_WORST)
        for scene_id, value in worst.select("scene_id", column).iter_rows():
            yield Offender(scene_id, text.format(value))
