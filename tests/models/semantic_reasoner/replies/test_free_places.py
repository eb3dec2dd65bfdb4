"""Boxes are placed beside others, as long as there is room."""

import numpy as np

from models.semantic_reasoner.replies.free_places import FreePlaces
from stable_data.scene import Tabletop
from tests.models.semantic_reasoner.language.known_categories import thing

TABLE = Tabletop("desk", (1.0, 0.5))


def test_equal_boxes_fill_the_table_row_by_row() -> None:
    places = FreePlaces(TABLE)
    found = [places.take(0.1, 0.1) for _ in range(51)]
    assert found[50] is None
    assert found[:2] == [(0.05, 0.05, False), (0.15000000000000002, 0.05, False)]
    assert len({np.round(place, 3).tobytes() for place in found[:50] if place is not None}) == 50


def test_a_box_is_turned_where_it_fits_only_so() -> None:
    places = FreePlaces(TABLE)
    place = places.take(0.2, 0.9)
    assert place is not None
    assert (np.round(place[:2], 6).tolist(), place[2]) == ([0.45, 0.1], True)
    assert places.take(0.6, 0.6) is None


def test_places_keep_away_from_objects_edges_and_the_restricted_zone() -> None:
    plate = thing("plate_0", 13, 13, turned=45).to_scene_object()
    places = FreePlaces(Tabletop("desk", (1.0, 0.5), (0.6, 1.0, 0.0, 0.5)), [plate], gap=0.02)
    boxes = []
    while (place := places.take(0.1, 0.08)) is not None:
        w, d = (0.08, 0.1) if place[2] else (0.1, 0.08)
        boxes.append((place[0] - w / 2, place[1] - d / 2, place[0] + w / 2, place[1] + d / 2))
    found = np.array(boxes)
    assert len(found) > 5
    assert found[:, :2].min() >= 0
    assert found[:, 2].max() <= 0.58 + 1e-9
    assert found[:, 3].max() <= 0.5 + 1e-9
    reach = 0.13 + 0.13 * 2**0.5 + 0.02  # of the turned plate, whose sides are 26 cm
    assert all(x >= reach - 1e-9 or y >= reach - 1e-9 for x, y in found[:, :2])
    gaps = np.maximum(found[:, None, :2] - found[None, :, 2:], found[None, :, :2] - found[:, None, 2:]).max(-1)
    assert gaps[~np.eye(len(found), dtype=bool)].min() >= 0.02 - 1e-9
