"""Edges of the table and of the restricted zone."""

import numpy as np
import pytest

from stable_data.geometry.shape import Shape
from stable_data.metrics.audit import audit_scene
from stable_data.metrics.bounds import enters_zone, leaves_table
from stable_data.scene import Rectangle, Tabletop
from tests.scenes import Pose, ball, box, hollow, scene_of, sheet, triangles

ZONE: Rectangle = (0.4, 0.6, 0.4, 0.6)
CUBE = box(0.1, 0.1, 0.1)
TABLE = Tabletop("desk", (1.0, 0.8))


@pytest.mark.parametrize(
    ("low", "high", "expected"),
    [
        ((0.0, 0.0, 0.0), (1.0, 0.8, 0.1), False),
        ((-0.0009, 0.2, 0.0), (0.5, 0.8009, 0.1), False),
        ((-0.0011, 0.2, 0.0), (0.5, 0.5, 0.1), True),
        ((0.2, -0.0011, 0.0), (0.5, 0.5, 0.1), True),
        ((0.2, 0.2, 0.0), (1.0011, 0.5, 0.1), True),
        ((0.2, 0.2, 0.0), (0.5, 0.8011, 0.1), True),
        ((0.2, 0.2, -5.0), (0.5, 0.5, 5.0), False),
    ],
)
def test_an_edge_may_be_passed_by_the_slack(low: Pose, high: Pose, expected: bool) -> None:
    assert leaves_table(np.array(low), np.array(high), TABLE, 1e-3) is expected


@pytest.mark.parametrize(
    ("pose", "expected"),
    [
        ((0.2, 0.2, 0.05, 0.0), False),
        ((0.3508, 0.5, 0.05, 0.0), False),  # 0.8 mm in
        ((0.3515, 0.5, 0.05, 0.0), True),  # 1.5 mm in
        ((0.5, 0.5, 0.05, 0.3), True),
        ((0.5, 0.5, 0.90, 0.0), True),  # the zone has no height
        ((0.6495, 0.6495, 0.05, 0.0), False),  # its corner 0.5 mm in
        ((0.648, 0.648, 0.05, 0.0), True),
        ((0.66, 0.66, 0.05, np.pi / 4), False),  # its box meets the zone's corner, its turned footprint does not
    ],
)
def test_a_footprint_enters_the_zone_beyond_the_slack(pose: Pose, expected: bool) -> None:
    assert enters_zone(triangles(CUBE, pose), ZONE, 1e-3) is expected
    assert audit_scene(*scene_of([("box", CUBE, pose)], zone=ZONE)).objects[0].enters_restricted_zone is expected


def test_a_big_triangle_that_covers_the_zone_enters_it() -> None:
    assert enters_zone(triangles(sheet(3.0, 3.0), (0.55, 0.5, 0.2, 0.1)), ZONE, 1e-3)


def test_a_small_object_inside_the_zone_enters_it() -> None:
    assert enters_zone(triangles(ball(0.01), (0.5, 0.5, 0.01, 0.0)), ZONE, 1e-3)


def test_a_vertical_sheet_across_the_zone_enters_it() -> None:
    standing = triangles(sheet(0.4, 0.4))[:, :, [0, 2, 1]] + (0.5, 0.5, 0.2)
    assert enters_zone(standing, ZONE, 1e-3)


def test_what_goes_round_the_zone_does_not_enter_it() -> None:
    side = box(0.02, 0.4, 0.02)
    left, right = (Shape(side.vertices + np.array([x, 0.0, 0.0]), side.faces) for x in (-0.2, 0.2))
    assert not enters_zone(triangles(hollow(left, right), (0.5, 0.5, 0.01, 0.0)), ZONE, 1e-3)


def test_no_zone_and_a_zone_within_the_slack_are_never_entered() -> None:
    assert not enters_zone(triangles(CUBE), None, 1e-3)
    assert not enters_zone(triangles(CUBE), (-0.001, 0.0009, -1.0, 1.0), 1e-3)
