from typing import Any

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from models.semantic_reasoner.training.table_crop import crop_table
from stable_data.scene import Stage
from stable_data.storage.schemas import Row
from tests.models.semantic_reasoner.language.known_categories import entry, in_metres, row


def thing(name: str, x: float, y: float, stage: Stage, support: str = "table", side: float = 8.0) -> dict[str, Any]:
    """A cube that stands at a place, metres."""
    made = entry("mug", in_metres((side, side, side)), name, support)
    return made | {"position": [x, y, side / 200], "stage": stage}


def table(*objects: dict[str, Any], stage: Stage = Stage.SECONDARY, text: str = "Put the mug away.") -> Row:
    made = row(stage, "scene", text, [o for o in objects if o["stage"] == stage])
    made["objects_in"] = [o for o in objects if o["stage"] != stage]
    return made | {"table_size": (1.2, 0.6), "restricted_zone": None}


MUG = thing("mug_0", 0.3, 0.3, Stage.TASK)
FAR = thing("mug_1", 1.1, 0.5, Stage.SECONDARY)
TRAY = thing("tray_0", 0.6, 0.3, Stage.SECONDARY, side=30.0)
ON_TRAY = thing("mug_2", 0.48, 0.3, Stage.SECONDARY, "tray_0")
ROW = table(MUG, FAR, TRAY, ON_TRAY)


@given(st.integers(0, 10_000))
def test_what_is_in_the_window_stays_where_it_was_seen_from_its_corner(seed: int) -> None:
    part = crop_table(ROW, np.random.default_rng(seed))
    if part is None:
        return  # nothing of the stage was in it
    width, depth = part["table_size"]
    assert 0.35 <= width <= 1.2
    assert 0.35 <= depth <= 0.6
    there = {o["instance"]: o for key in ("objects_in", "objects_out") for o in part[key]}
    assert "mug_0" in there
    assert ("tray_0" in there) == ("mug_2" in there)  # what is carried goes with what carries it
    moves = {
        name: np.subtract(o["position"], o0["position"])
        for o0 in (MUG, FAR, TRAY, ON_TRAY)
        if (o := there.get(name := o0["instance"]))
    }
    assert all(np.allclose(move, moves["mug_0"]) and move[2] == 0 for move in moves.values())
    for o in there.values():
        half = o["size"][0] / 2
        assert half - 1e-6 <= o["position"][0] <= width - half + 1e-6
        assert half - 1e-6 <= o["position"][1] <= depth - half + 1e-6


def test_all_stages_of_a_scene_are_seen_through_one_window() -> None:
    first, second = table(MUG, stage=Stage.TASK), table(MUG, {**FAR, "stage": Stage.IMPORTANT}, stage=Stage.IMPORTANT)
    for seed in range(20):
        one, other = (crop_table(r, np.random.default_rng(seed)) for r in (first, second))
        assert one is not None
        assert other is not None
        assert one["table_size"] == other["table_size"]
        assert one["objects_out"] == other["objects_in"]


def test_small_windows_are_as_likely_as_large_ones() -> None:
    widths = [
        part["table_size"][0]
        for k in range(400)
        if (part := crop_table(table(MUG, stage=Stage.TASK), np.random.default_rng(k)))
    ]
    found, _ = np.histogram(widths, np.linspace(0.35, 1.2, 6))
    assert found.min() > 50


def test_an_instruction_that_speaks_of_a_part_of_the_table_is_left_alone() -> None:
    rng = np.random.default_rng(0)
    assert crop_table(table(MUG, FAR, text="Move the mug that is in the back left corner."), rng) is None
    told = table(MUG, FAR)
    told["task"]["relations"] = [{"subject": "mug_0", "kind": "is at", "target": "front_left"}]
    assert crop_table(told, rng) is None


def test_a_window_with_nothing_of_the_stage_says_so_where_that_is_an_answer() -> None:
    far = table(MUG, FAR)
    near = table(MUG, {**FAR, "stage": Stage.IMPORTANT}, stage=Stage.IMPORTANT)
    found = [[crop_table(r, np.random.default_rng(k)) for k in range(60)] for r in (far, near)]
    assert any(part is None for part in found[0])
    assert all(part is not None for part in found[1])
    assert any(part["objects_out"] == [] for part in found[1] if part is not None)


def test_a_restricted_zone_is_seen_through_the_window_too() -> None:
    zoned = table(MUG, stage=Stage.TASK) | {"restricted_zone": (0.0, 0.2, 0.0, 0.6)}
    parts = [part for k in range(80) if (part := crop_table(zoned, np.random.default_rng(k)))]
    kept = [part for part in parts if part["restricted_zone"]]
    assert 0 < len(kept) < len(parts)
    for part in kept:
        x_min, x_max, y_min, y_max = part["restricted_zone"]
        (mug,) = part["objects_out"]
        assert x_min == y_min == 0
        assert np.isclose(y_max, part["table_size"][1])
        assert np.isclose(x_max - mug["position"][0], 0.2 - 0.3)
