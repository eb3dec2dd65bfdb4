"""Statistics of layouts: what they count, and their files."""

import json
import math
from dataclasses import replace
from pathlib import Path

import pytest

from models.scene_rating.usual_layouts import (
    FEWEST_OBJECTS,
    FEWEST_SCENES,
    UsualLayouts,
    askew,
    offset_of,
    read_scenes,
    spread_of,
    turned_away,
)
from stable_data.errors import ConfigError
from stable_data.scene import TABLE, Scene, SceneObject, Tabletop

DESK = Tabletop("office_table", (1.0, 0.5))


def thing(category: str, x: float, y: float, yaw: float = 0.0, support: str | None = TABLE) -> SceneObject:
    return SceneObject(f"{category}_{x}_{y}", category, (x, y, 0.05), yaw, (0.1, 0.1, 0.1), support=support)


def desk(*objects: SceneObject, table: Tabletop = DESK) -> Scene:
    return Scene("s", table, objects)


MANY = [desk(thing("laptop", 0.5, 0.25, 0.1), thing("mug", 0.2, 0.2, 2.0), thing("pen", 0.9, 0.4, 0.7, None))] * FEWEST_SCENES


def test_angles() -> None:
    assert [round(math.degrees(turned_away(math.radians(a)))) for a in (0, 30, -170, 190, 360)] == [0, 30, 170, 170, 0]
    assert [round(math.degrees(askew(math.radians(a)))) for a in (0, 30, 45, 80, 90, -100, 200)] == [0, 30, 45, 10, 0, 10, 20]


def test_the_spread_is_the_share_of_the_table_within_the_outlines() -> None:
    corners = [thing("pen", x, y) for x in (0.05, 0.95) for y in (0.05, 0.45)]
    assert spread_of(desk(*corners)) == pytest.approx(1.0)
    assert spread_of(desk(corners[0])) == pytest.approx(0.02)
    assert spread_of(desk()) == 0.0
    assert offset_of(desk(*corners)) == pytest.approx(0.0)
    assert offset_of(desk(corners[0])) == pytest.approx(0.9)


def test_company_is_the_share_of_the_others_that_stand_together_with_a_category() -> None:
    lounge = [desk(*(thing(c, 0.1, 0.1) for c in ("vase", "candle", "mug", "toy")), table=replace(DESK, table_type="lounge"))]
    usual = UsualLayouts.of_scenes([*MANY, *lounge])
    assert usual.company("mug", ["laptop", "pen", "vase"], "office_table") == pytest.approx(2 / 3)
    assert usual.company("mug", ["laptop", "pen", "vase"], "lounge") == 1.0  # too few scenes: all kinds of table count
    assert usual.company("mug", ["laptop", "pen", "never_seen"], "office_table") is None
    assert usual.company("never_seen", ["laptop", "pen", "mug"], "office_table") is None


def test_turns_are_those_of_standing_upright_things_and_need_many() -> None:
    usual = UsualLayouts.of_scenes(MANY)
    laptop, mug = usual.turn("laptop"), usual.turn("mug")
    assert laptop is not None
    assert mug is not None
    assert (laptop.count, laptop.front, mug.front) == (FEWEST_SCENES, 1.0, 0.0)
    assert laptop.askew == pytest.approx(0.1)
    assert usual.turn("pen") is None  # it stands on nothing
    assert UsualLayouts.of_scenes(MANY[: FEWEST_OBJECTS - 1]).turn("laptop") is None


def test_a_file_holds_them_and_a_broken_one_is_refused(tmp_path: Path) -> None:
    usual, path = UsualLayouts.of_scenes(MANY), tmp_path / "folder" / "usual.json"
    usual.save(path)
    assert UsualLayouts.load(path) == usual
    for content, code in (("[", "statistics_invalid"), ("{}", "statistics_invalid"), ('{"version": 1}', "statistics_invalid")):
        path.write_text(content)
        with pytest.raises(ConfigError) as caught:
            UsualLayouts.load(path)
        assert caught.value.code == code
    with pytest.raises(ConfigError, match="usual_layouts FOLDER"):
        UsualLayouts.load(tmp_path / "absent")


def test_the_shipped_file_knows_the_tables_and_what_has_a_front() -> None:
    usual = UsualLayouts.load()
    assert all(usual.knows_table(t) for t in ("office_table", "dining_table", "kitchen_counter", "coffee_table"))
    assert not usual.knows_table("nightstand")
    for category, has_front in (("laptop", True), ("monitor", True), ("mirror", True), ("plate", False), ("orange", False)):
        turn = usual.turn(category)
        assert turn is not None
        assert (turn.front > 0.95) is has_front, category
    company = usual.company("toothbrush_cup", ["laptop", "monitor", "keyboard", "stapler"], "office_table")
    assert company is not None
    assert company < 0.5
    assert usual.company("mouse", ["laptop", "monitor", "keyboard", "stapler"], "office_table") == 1.0
    limits = usual.limits(12)
    assert limits is not None
    assert limits[0] > 0.2
    assert limits[1] < 0.6
    assert usual.limits(2) is None


def test_a_folder_is_measured_by_its_boxes(dataset: Path) -> None:
    scenes = list(read_scenes(dataset))
    assert len(scenes) == 4
    assert all(any(o.support == TABLE for o in scene.objects) for scene in scenes)
    usual = UsualLayouts.of_scenes(scenes)
    assert sum(usual.num_scenes.values()) == 4
    layout = json.loads(next(dataset.glob("Layout_info/*/*/layout.json")).read_text("utf-8"))
    assert layout["objects"]
    assert usual.categories >= {o.category for o in scenes[0].objects}
