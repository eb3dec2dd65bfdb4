"""The table in its room: what pictures, the environment and exports show of it, and that nothing collides with it."""

import io

import numpy as np
import pytest
from PIL import Image

from stable_data.embedded_world.plans import TABLES, UNSEEN_TABLES
from stable_data.scene import FloatArray, Scene, Tabletop
from stable_data.simulation import offscreen
from stable_data.simulation.materials import wood
from stable_data.simulation.render import scene_bounds
from stable_data.simulation.room import FLOOR, TABLE_TOP, WALL, Design, RoomPart, design_of, designs, furnish
from tests.stable_data.simulation.test_render import drawn, scene_of, thing

pytestmark = pytest.mark.sim

SIZES = [(1.2, 0.7), (0.25, 0.2), (3.0, 0.4), (0.5, 1.9)]


def room_of(table: Tabletop, high: tuple[float, float, float] = (0.0, 0.0, 0.0)) -> dict[str, RoomPart]:
    low, top = scene_bounds(Scene("s", table, ()), [])
    return {part.name: part for part in furnish(table, low, np.maximum(top, high))}


def corners(parts: dict[str, RoomPart], prefix: str) -> FloatArray:
    return np.concatenate([p.surface.triangles.reshape(-1, 3) for name, p in parts.items() if name.startswith(prefix)])


@pytest.mark.parametrize("size", SIZES, ids=str)
@pytest.mark.parametrize("design", designs(), ids=lambda d: d.words.split()[0] if d.words else "other")
def test_a_table_is_its_rectangle_with_its_top_at_zero_and_stands_on_the_floor(
    design: Design, size: tuple[float, float]
) -> None:
    words = design.words.split()[0] if design.words else "unheard_of"
    parts = room_of(Tabletop(f"{words}_table", size))
    assert design_of(f"{words}_table") is design
    top, table, floor = corners(parts, TABLE_TOP), corners(parts, "table/"), corners(parts, FLOOR)
    np.testing.assert_allclose(top.max(axis=0), [*size, 0.0], atol=1e-12)
    np.testing.assert_allclose(top.min(axis=0)[:2], 0.0, atol=1e-12)
    assert table[:, 2].max() == 0.0
    np.testing.assert_allclose(table[:, 2].min(), floor[:, 2], atol=1e-12)
    outside = np.maximum(-table[:, :2], table[:, :2] - size).max()
    assert outside < 0.04  # handles
    for part in parts.values():
        assert np.linalg.norm(part.surface.triangles.std(axis=1), axis=1).min() > 0


def test_every_face_of_a_closed_part_looks_outward() -> None:
    for table_type in (*TABLES, *UNSEEN_TABLES):
        for name, part in room_of(Tabletop(table_type, (1.2, 0.7))).items():
            if name.startswith("table/"):
                triangles = part.surface.triangles
                volume = np.einsum("ij,ij->i", triangles[:, 0], np.cross(triangles[:, 1], triangles[:, 2])).sum() / 6
                assert volume > 0, name


def test_kinds_of_table_differ_and_unknown_ones_have_a_design() -> None:
    assert len({design_of(kind) for kind in (*TABLES, *UNSEEN_TABLES)}) == len(TABLES) + len(UNSEEN_TABLES)
    assert design_of("") == design_of("altar") == designs()[-1] == design_of("dining_table")
    assert design_of("Kitchen-Island") is design_of("kitchen_counter")


def test_the_room_keeps_clear_of_objects_beyond_the_table() -> None:
    near, far = (room_of(Tabletop("kitchen_counter", (1.0, 0.6)), high) for high in ((1.0, 0.6, 0.3), (5.0, 1.4, 0.3)))
    assert 0.6 <= corners(near, WALL)[:, 1].max() < 0.61
    assert 1.4 < corners(far, WALL)[:, 1].max() < 1.41
    assert corners(far, WALL)[:, 0].max() > 5.0
    low = furnish(Tabletop("coffee_table", (1.0, 0.6)), np.array([0.0, 0.0, -2.0]), np.array([1.0, 0.6, 0.0]))
    assert corners({part.name: part for part in low}, FLOOR)[:, 2].max() < -2.0


def test_images_are_small_repeat_and_are_the_same_each_time() -> None:
    first = wood("some_wood", "#553322", "#997755")
    wood.cache_clear()
    assert wood("some_wood", "#553322", "#997755") == first
    assert wood("other_wood", "#553322", "#997755").image != first.image
    for design in designs():
        for material in (design.top, design.floor, design.wall):
            if material.image is None:
                continue
            assert len(material.image) < 40_000
            pixels = np.asarray(Image.open(io.BytesIO(material.image)).convert("RGB")).astype(float)
            mean = [int(material.colour[k : k + 2], 16) for k in (1, 3, 5)]
            np.testing.assert_allclose(pixels.mean(axis=(0, 1)), mean, atol=1)
            if "tiles" not in material.name and "boards" not in material.name:  # these have an edge at the seam
                inner = np.abs(np.diff(pixels, axis=1)).mean(axis=(0, 2))
                assert np.abs(pixels[:, 0] - pixels[:, -1]).mean() <= 1.5 * inner.max()


def test_the_colour_of_the_table_top_is_that_of_its_material() -> None:
    """Seen from above the light is nearly full, so that a picture of the top has the mean colour of its image, a little darker."""
    for table_type in ("office_table", "coffee_table", "kitchen_counter"):
        picture = drawn(Scene("s", Tabletop(table_type, (1.0, 1.0)), ()), [], size=(96, 96), view="top")
        seen = picture[40:56, 40:56].reshape(-1, 3).mean(axis=0)
        colour = np.array([int(design_of(table_type).top.colour[k : k + 2], 16) for k in (1, 3, 5)])
        np.testing.assert_allclose(seen / seen.sum(), colour / colour.sum(), atol=0.02)
        assert 0.8 < seen.sum() / colour.sum() < 1.1


def test_a_kept_context_draws_what_a_new_one_draws() -> None:
    o, mesh = thing("mug/0", 0.4, 0.25)
    scene = scene_of(o, zone=(0.1, 0.3, 0.1, 0.4))
    offscreen._kept.__dict__.clear()
    first = drawn(scene, [mesh], size=(96, 64))
    drawn(scene_of(), [], size=(200, 300), view="left")
    np.testing.assert_array_equal(drawn(scene, [mesh], size=(96, 64)), first)


def test_shadows_of_high_things_have_soft_edges() -> None:
    o, mesh = thing("thermos/0", 0.3, 0.2)
    with_shadow = drawn(scene_of(o), [mesh], size=(256, 256), view="top").astype(int).sum(axis=2)
    without = drawn(scene_of(), [], size=(256, 256), view="top").astype(int).sum(axis=2)
    share = with_shadow[64:192] / without[64:192]
    assert share.min() < 0.75
    assert ((share > 0.8) & (share < 0.95)).sum() > 30
