"""The views of a scene for judges and distances of pictures: whole, neutral, the same each time."""

from dataclasses import replace

import numpy as np
import pytest

from pipelines.reports.scene_pictures import draw_scene
from stable_data.assets.store import AssetStore
from stable_data.errors import ConfigError
from stable_data.scene import Scene, SceneObject, Tabletop
from stable_data.simulation.offscreen import Picture, can_render
from stable_data.simulation.room import FLOOR, WALL, Surroundings, furnish
from stable_data.simulation.scene_geometry import SceneGeometry
from stable_data.simulation.views import SCORED_VIEWS, draw_scored_views, draw_view

pytestmark = pytest.mark.sim

SIZE = (96, 96)


class NoAssets:
    def asset_path(self, asset_id: str) -> None:
        return None


STORE = AssetStore(NoAssets())


def box(x: float, y: float, height: float = 0.1) -> SceneObject:
    return SceneObject("0_apple_0", "apple", (x, y, height / 2), 0.0, (0.1, 0.1, height))


def geometry_of(*objects: SceneObject, table_type: str = "dining_table") -> SceneGeometry:
    return SceneGeometry.of(Scene("dining_table_0000", Tabletop(table_type, (1.0, 0.6)), objects), STORE)


@pytest.fixture(autouse=True)
def _needs_gl() -> None:
    if not can_render():
        pytest.skip("this machine cannot render")


def is_table(picture: Picture) -> np.ndarray:
    """The pixels of something, where nothing is around the table."""
    return np.asarray(picture.max(axis=2) > 8)


def test_both_views_have_the_size_and_are_the_same_again() -> None:
    geometry = geometry_of(box(0.3, 0.3))
    first, again = (draw_scored_views(geometry, (64, 48)) for _ in range(2))
    assert tuple(first) == SCORED_VIEWS == ("front", "perspective")
    for view in SCORED_VIEWS:
        assert first[view].shape == (48, 64, 3)
        assert first[view].dtype == np.uint8
        np.testing.assert_array_equal(first[view], again[view])
    assert (first["front"] != first["perspective"]).any()


def test_surroundings_are_plain_and_the_same_for_every_table() -> None:
    pictures = [draw_view(geometry_of(table_type=t), size=SIZE) for t in ("dining_table", "bathroom_vanity", "office_table")]
    for picture in pictures:
        sides = picture[:16].reshape(-1, 3).astype(int)
        assert np.ptp(sides, axis=0).max() < 12  # one colour above the table: no horizon, wall or label
        np.testing.assert_allclose(sides.mean(axis=0), pictures[0][:16].reshape(-1, 3).mean(axis=0), atol=4)
    assert not draw_view(geometry_of(), size=SIZE, surroundings="none")[:8].any()


@pytest.mark.parametrize("view", SCORED_VIEWS)
@pytest.mark.parametrize("height", [0.1, 0.9])
def test_table_and_highest_object_are_whole(view: str, height: float) -> None:
    """The picture's sides and top show nothing; the legs of the table may end below it."""
    seen = is_table(draw_view(geometry_of(box(0.9, 0.5, height)), view, SIZE, "none"))  # type: ignore[arg-type]
    assert seen.sum() > 500
    assert not seen[0].any()
    assert not seen[: SIZE[1] // 2, [0, -1]].any()


def test_the_floor_changes_no_object() -> None:
    """What is seen of a scene is the same with and without a floor."""
    plain, black = (draw_view(geometry_of(box(0.5, 0.3)), "front", SIZE, around) for around in ("floor", "none"))
    red = black[:, :, 0].astype(int) > 2 * black[:, :, 2].astype(int) + 40
    assert red.sum() > 20
    assert np.abs(plain[red].astype(int) - black[red].astype(int)).mean() < 10


@pytest.mark.parametrize(("surroundings", "expected"), [("room", {FLOOR, WALL}), ("floor", {FLOOR}), ("none", set())])
def test_what_is_around_the_table(surroundings: Surroundings, expected: set[str]) -> None:
    low, high = np.array([0.0, 0.0, -0.03]), np.array([1.0, 0.6, 0.2])
    parts = furnish(Tabletop("dining_table", (1.0, 0.6)), low, high, None, surroundings)
    assert {part.name for part in parts if part.name in (FLOOR, WALL)} == expected
    assert any(part.is_of_table for part in parts)


def test_an_unknown_view_is_refused() -> None:
    with pytest.raises(ConfigError) as error:
        draw_view(geometry_of(), "below")  # type: ignore[arg-type]
    assert error.value.code == "unknown_view"


def test_reports_keep_their_room() -> None:
    scene = geometry_of(box(0.5, 0.3)).scene
    walls = replace(scene, table=Tabletop("bathroom_vanity", (1.0, 0.6)))
    assert (draw_scene(scene, STORE, SIZE)[:8] != draw_scene(walls, STORE, SIZE)[:8]).any()
