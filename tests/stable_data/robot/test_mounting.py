"""Where the robot stands: behind an edge, looking inwards, near what it needs."""

from dataclasses import replace

import numpy as np
import pytest
import shapely
from hypothesis import given
from hypothesis import strategies as st

from stable_data.errors import ConfigError
from stable_data.robot.arm.mounting import EDGES, Mount, best_mount, mount_at, mount_of, mount_setting
from stable_data.robot.arm.robots import ROBOTS, Robot
from stable_data.scene import FloatArray, Scene, SceneObject, Tabletop
from stable_data.scene_graph.relations import yawed_rectangle
from tests.stable_data.robot.tables import CAN, TABLE, laid_table

ROBOT = ROBOTS["simple"]
SMALL = ROBOTS["so101"]  # its files are not needed


def base_corners(robot: Robot, mount: Mount) -> FloatArray:
    """Of a base on the table, (4, 2), metres, frame of the scene."""
    assert robot.table_base is not None
    back, front, half = -robot.table_base.back, robot.base_front, robot.table_base.half_width
    return mount.to_scene(np.array([(back, -half, 0.0), (back, half, 0.0), (front, half, 0.0), (front, -half, 0.0)]))[:, :2]


@given(st.sampled_from(EDGES), st.floats(0, 1), st.floats(0.3, 3), st.floats(0.3, 2))
def test_the_base_is_outside_and_looks_at_the_table(edge: str, share: float, width: float, depth: float) -> None:
    mount = mount_at(ROBOT, Tabletop("desk", (width, depth)), edge, share)
    outside = not (
        -ROBOT.base_front < mount.x < width + ROBOT.base_front and -ROBOT.base_front < mount.y < depth + ROBOT.base_front
    )
    assert outside
    ahead = mount.to_scene(np.array([ROBOT.base_front + 0.1, 0.0, 0.0]))
    assert ahead[0] + 1e-9 > 0
    assert -1e-9 <= ahead[0] <= width + 1e-9
    assert -1e-9 <= ahead[1] <= depth + 1e-9


@given(st.tuples(*[st.floats(-2, 2)] * 3))
def test_frames_go_back_and_forth(point: tuple[float, float, float]) -> None:
    mount = mount_at(ROBOT, TABLE, "left", 0.3)
    assert mount.to_scene(mount.to_base(np.array(point))) == pytest.approx(np.array(point), abs=1e-9)


def test_the_best_mount_brings_the_wanted_object_near() -> None:
    wide = replace(laid_table(), table=Tabletop("desk", (3.0, 0.7)))
    far = replace(wide.objects[0], position=(2.7, 0.3, wide.objects[0].position[2]))
    scene = replace(wide, objects=(far, *wide.objects[1:]))
    mount = best_mount(ROBOT, scene, (CAN,))
    distance = np.hypot(mount.x - 2.7, mount.y - 0.3)
    assert ROBOT.too_near <= distance <= ROBOT.reach
    assert best_mount(ROBOT, scene) == mount  # the can is the task object


def test_an_empty_table_has_a_robot_in_front() -> None:
    assert best_mount(ROBOT, Scene("empty", TABLE, ())).edge == "front"


def test_a_setting_names_edge_and_share() -> None:
    assert mount_of(ROBOT, laid_table(), "right:0.25") == mount_at(ROBOT, TABLE, "right", 0.25)
    assert mount_of(ROBOT, laid_table(), "back") == mount_at(ROBOT, TABLE, "back", 0.5)


@pytest.mark.parametrize("setting", ["roof", "front:2", "front:x", "front:nan", ""])
def test_other_settings_are_refused(setting: str) -> None:
    with pytest.raises(ConfigError, match="mount is") as error:
        mount_of(ROBOT, laid_table(), setting)
    assert error.value.code == "setting_invalid"


@given(st.sampled_from(EDGES), st.floats(0, 1))
def test_a_mount_is_stated_to_a_ten_thousandth_of_its_edge(edge: str, share: float) -> None:
    mount = mount_at(ROBOT, TABLE, edge, share)
    again = mount_of(ROBOT, laid_table(), mount_setting(mount, TABLE))
    assert again.edge == edge
    assert np.hypot(again.x - mount.x, again.y - mount.y) <= 1e-4 * max(TABLE.size_xy)


@given(st.sampled_from(EDGES), st.floats(0, 1), st.floats(0.3, 3), st.floats(0.3, 2))
def test_a_small_robot_stands_on_the_table_and_looks_inwards(edge: str, share: float, width: float, depth: float) -> None:
    table = Tabletop("desk", (width, depth))
    mount = mount_at(SMALL, table, edge, share)
    corners = base_corners(SMALL, mount)
    assert (corners >= -1e-9).all()
    assert (corners <= np.array(table.size_xy) + 1e-9).all()
    side, place = {"front": (1, 0.0), "back": (1, depth), "left": (0, 0.0), "right": (0, width)}[edge]
    assert abs(corners[:, side] - place).min() <= 0.03  # just inside
    ahead, here = mount.to_scene(np.array([0.1, 0.0, 0.0]))[side], mount.position[side]
    assert abs(ahead - place) > abs(here - place)


@given(st.sampled_from(EDGES), st.floats(0, 1))
def test_a_mount_on_the_table_is_stated_as_a_setting_that_gives_it_again(edge: str, share: float) -> None:
    setting = mount_setting(mount_at(SMALL, TABLE, edge, share), TABLE)
    again = mount_of(SMALL, laid_table(), setting)
    assert mount_setting(again, TABLE) == setting
    assert again == mount_of(SMALL, laid_table(), mount_setting(again, TABLE))


@given(st.lists(st.tuples(st.floats(0, 1), st.floats(0, 0.7), st.floats(0, 3)), min_size=1, max_size=12))
def test_a_base_on_the_table_is_put_where_no_object_stands(places: list[tuple[float, float, float]]) -> None:
    boxes = tuple(SceneObject(f"box_{k}", "box", (x, y, 0.02), yaw, (0.12, 0.06, 0.04)) for k, (x, y, yaw) in enumerate(places))
    mount = best_mount(SMALL, Scene("full", TABLE, boxes))
    base = shapely.Polygon(base_corners(SMALL, mount))
    assert not any(base.intersects(shapely.Polygon(yawed_rectangle(box))) for box in boxes)


def test_a_small_robot_stands_near_what_it_needs() -> None:
    mount = best_mount(SMALL, laid_table(), (CAN,))
    distance = np.hypot(mount.x - 0.4, mount.y - 0.25)
    assert SMALL.too_near <= distance <= SMALL.reach


@pytest.mark.parametrize(
    ("name", "edge", "share", "place", "auto"),
    [
        ("panda", "front", 0.5, (0.5, -0.14, np.pi / 2), "front:0.4"),
        ("panda", "right", 0.25, (1.14, 0.175, np.pi), "front:0.4"),
        ("simple", "back", 0.1, (0.1, 0.8, -np.pi / 2), "front:0.5"),
        ("simple", "left", 0.0, (-0.1, 0.0, 0.0), "front:0.5"),
    ],
)
def test_large_robots_stand_behind_the_edges(
    name: str, edge: str, share: float, place: tuple[float, float, float], auto: str
) -> None:
    mount = mount_at(ROBOTS[name], TABLE, edge, share)
    assert (mount.x, mount.y, mount.yaw) == pytest.approx(place)
    assert mount_setting(best_mount(ROBOTS[name], laid_table()), TABLE) == auto
