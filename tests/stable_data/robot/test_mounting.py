"""Where the robot stands: behind an edge, looking inwards, near what it needs."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from stable_data.errors import ConfigError
from stable_data.robot.arm.mounting import EDGES, best_mount, mount_at, mount_of, mount_setting
from stable_data.robot.arm.robots import ROBOTS
from stable_data.scene import Scene, Tabletop
from tests.stable_data.robot.tables import CAN, TABLE, laid_table

ROBOT = ROBOTS["simple"]


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
