"""The page on a set of scenes counts what the cards say, unknowns apart."""

from collections.abc import Mapping
from dataclasses import asdict
from typing import Any

import polars as pl
import pyarrow as pa
import pytest

from stable_data.geometry.shape import Shape
from stable_data.metrics.audit import audit_scene
from stable_data.metrics.card import MetricCard
from stable_data.metrics.summary import AuditSummary, SummaryLine, summarise
from stable_data.scene import Scene
from stable_data.storage import schemas
from tests.scenes import Placed, ball_in_bowl, box, box_on_table, overlapping_balls, scene_of

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
    return framed(built)


def framed(built: Mapping[str, tuple[Scene, list[Shape]]]) -> pl.DataFrame:
    """Scenes as rows of the table ``scenes``."""
    rows = []
    for name, scene in built.items():
        audit = audit_scene(*scene)
        rows.append({"scene_id": name, **asdict(audit.card()), **audit.rows()})
    schema = schemas.SCHEMAS["scenes"]
    names = ["scene_id", *MetricCard.__dataclass_fields__, "pairs", "verdicts"]
    table = pa.Table.from_pylist(rows, schema=pa.schema([schema.field(n) for n in names]))
    return pl.DataFrame(pl.from_arrow(table))


def hidden() -> pl.DataFrame:
    """A scene of which much is known, although one object has no mesh, and one of which little is."""
    stand_in, cube = Shape.box((0.1, 0.1, 0.1)), box(0.1, 0.1, 0.1)
    much: list[Placed] = [
        ("a", cube, (0.5, 0.5, 0.05, 0.0)),
        ("b", cube, (0.56, 0.5, 0.05, 0.0)),
        ("in the air", cube, (0.2, 0.5, 0.25, 0.0)),
        ("over the edge", cube, (0.5, 0.0, 0.05, 0.0)),
        ("unknown", stand_in, (0.42, 0.5, 0.05, 0.0)),
        ("on the unknown", cube, (0.38, 0.55, 0.1503, 0.0)),
    ]
    little: list[Placed] = [("x", stand_in, (0.5, 0.0, 0.25, 0.0)), ("y", cube, (0.5, 0.05, 0.17, 0.0))]
    return framed({"much": scene_of(much), "little": scene_of(little), "ball": ball_in_bowl()})


def test_what_is_known_is_not_hidden_by_what_is_not() -> None:
    summary = summarise(hidden())
    assert card_of(hidden(), "much")["max_penetration_mm"] is None
    for label, count, unknown in (
        ("scenes clean (0.5 mm)", 1, 1),
        ("scenes with a collision (0.5 mm)", 1, 1),
        ("scenes with a collision deeper than 10 mm", 1, 1),
        ("scenes with a floating object", 1, 1),
        ("scenes with an object out of bounds", 1, 1),
        ("objects that float (0.5 mm)", 1, 3),
        ("objects out of bounds", 1, 1),
    ):
        assert (line(summary, label).count, line(summary, label).unknown) == (count, unknown), label
    figures = dict(summary.figures)
    assert figures["deepest object-object penetration"].endswith(" mm, 2 pairs unknown")
    assert float(figures["deepest object-object penetration"].split()[0]) == pytest.approx(40, rel=0.03)
    assert figures["largest gap below an object"] == "at least 100 mm, 3 objects unknown"
    assert figures["mean share of colliding pairs (OC)"] == "0.000 %, 2 scenes unknown"
    worst = {(scene_id, figure.split(" ", 1)[1]) for scene_id, figure in summary.worst}
    assert ("much", "mm deep in each other") in worst
    assert ("much", "mm above its support") in worst
    assert ("much", "of its objects out of bounds") in worst


def test_a_depth_in_the_table_is_measured_however_deep() -> None:
    deep = framed({"sunk": box_on_table(-0.15)})
    assert dict(summarise(deep).figures)["deepest table penetration"] == "150.00 mm"


def test_a_depth_of_the_tolerance_itself_counts_as_the_verdict_has_it() -> None:
    frame_of_one = framed({"sunk": box_on_table(-5e-4 - 1e-16)})
    assert card_of(frame_of_one, "sunk")["clean"] is True
    summary = summarise(frame_of_one)
    assert line(summary, "scenes that sink into the table (0.5 mm)").count == 0
    assert summary.worst == ()


def card_of(scenes: pl.DataFrame, scene_id: str) -> dict[str, Any]:
    return scenes.filter(pl.col("scene_id") == scene_id).row(0, named=True)


def line(summary: AuditSummary, label: str) -> SummaryLine:
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
    worst = summarise(frame()).worst
    assert ("air", "20.0 mm above its support") in worst
    assert ("sunk", "10.0 mm in the table") in worst
    assert any(scene_id == "balls" and figure.endswith("deep in each other") for scene_id, figure in worst)
    assert not any(scene_id == "bowl" for scene_id, _ in worst)


def test_the_page_shows_counts_shares_and_unknowns() -> None:
    text = str(summarise(frame()))
    assert "1 of 5       20.0 %, 1 unknown" in text
    assert "worst:" in text


def test_a_line_of_nothing_has_no_share() -> None:
    assert SummaryLine("x", 0, 0).share == 0.0


def test_no_scenes_make_an_empty_page() -> None:
    summary = summarise(frame().clear())
    assert summary.figures == ()
    assert summary.worst == ()
    assert all(one.total == 0 for one in summary.lines)
