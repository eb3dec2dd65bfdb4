"""The page on a set of scenes counts what the cards say, unknowns apart."""

from dataclasses import asdict

import polars as pl
import pyarrow as pa

from stable_data import tables
from stable_data.metrics.audit import audit_scene
from stable_data.metrics.card import MetricCard
from stable_data.metrics.summary import Line, Summary, summarise
from stable_data.shape import Shape
from tests.scenes import ball_in_bowl, box, box_on_table, overlapping_balls, scene_of

UNKNOWN = scene_of(
    [("a", Shape.box((0.1, 0.1, 0.1)), (0.5, 0.5, 0.05, 0.0)), ("b", box(0.1, 0.1, 0.1), (0.55, 0.5, 0.05, 0.0))]
)


def frame() -> pl.DataFrame:
    built = {
        "air": box_on_table(0.02),
        "balls": overlapping_balls(0.02),
        "bowl": ball_in_bowl(),
        "sunk": box_on_table(-0.01),
        "unknown": UNKNOWN,
    }
    rows = []
    for name, scene in built.items():
        audit = audit_scene(*scene)
        rows.append({"scene_id": name, **asdict(audit.card()), **audit.rows()})
    schema = tables.SCHEMAS["scenes"]
    names = ["scene_id", *MetricCard.__dataclass_fields__, "pairs", "verdicts"]
    table = pa.Table.from_pylist(rows, schema=pa.schema([schema.field(n) for n in names]))
    return pl.DataFrame(pl.from_arrow(table))


def line(summary: Summary, label: str) -> Line:
    (found,) = (one for one in summary.lines if one.label == label)
    return found


def test_scenes_are_counted_with_the_unknown_apart() -> None:
    summary = summarise(frame())
    clean = line(summary, "scenes clean (0.5 mm)")
    assert (clean.count, clean.total, clean.unknown) == (1, 5, 1)
    colliding = line(summary, "scenes with a collision (0.5 mm)")
    assert (colliding.count, colliding.unknown) == (1, 1)
    assert line(summary, "scenes with a collision deeper than 10 mm").count == 1
    assert line(summary, "scenes that sink into the table (0.5 mm)").count == 1
    assert line(summary, "scenes with a floating object").count == 1
    assert line(summary, "scenes with a missing or broken mesh").count == 1


def test_objects_are_counted() -> None:
    summary = summarise(frame())
    assert (line(summary, "objects that float (0.5 mm)").count, line(summary, "objects that float (0.5 mm)").total) == (1, 8)
    assert line(summary, "objects without a mesh").count == 1


def test_the_worst_scenes_are_named_with_their_figure() -> None:
    offenders = {(o.scene_id, o.what) for o in summarise(frame()).offenders}
    assert ("air", "20.0 mm above its support") in offenders
    assert ("sunk", "10.0 mm in the table") in offenders
    assert any(scene_id == "balls" and what.endswith("deep in each other") for scene_id, what in offenders)
    assert not any(scene_id == "bowl" for scene_id, _ in offenders)


def test_the_page_shows_counts_shares_and_unknowns() -> None:
    text = str(summarise(frame()))
    assert "1 of 5       20.0 %, 1 unknown" in text
    assert "worst:" in text


def test_a_line_of_nothing_has_no_share() -> None:
    assert Line("x", 0, 0).share == 0.0


def test_no_scenes_make_an_empty_page() -> None:
    summary = summarise(frame().clear())
    assert summary.figures == ()
    assert summary.offenders == ()
    assert all(one.total == 0 for one in summary.lines)
