"""The small arm SO-101, which stands on the table, has five joints, and moves one jaw: what it reaches and holds."""

from dataclasses import replace

import numpy as np
import pytest

from stable_data.condition import ConditionKind, GoalCondition
from stable_data.robot.arm.assembly import assemble
from stable_data.robot.arm.kinematics import Arm
from stable_data.robot.arm.mounting import mount_at
from stable_data.robot.arm.robots import ROBOTS
from stable_data.robot.arm.world import RobotWorld
from stable_data.robot.grasp_trial import GraspFinder
from stable_data.robot.reach import START_COLLIDES, ReachOptions, survey_reach
from stable_data.scene import Scene, SceneObject, Tabletop, TaskInfo
from stable_data.simulation.scene_geometry import SceneGeometry

ROBOT = ROBOTS["so101"]
TABLE = Tabletop("desk", (1.0, 0.7))
CUBE = "cube_0"


@pytest.fixture(autouse=True)
def files_of_the_robot() -> None:
    if not ROBOT.is_there:  # asked in each test, because others change the folder of the cache
        pytest.skip("the files of so101 are not on this machine: stable-data robots --fetch so101")


def box(name: str, x: float, y: float, size: tuple[float, float, float], yaw: float = 0.0) -> SceneObject:
    return SceneObject(name, "block", (x, y, size[2] / 2), yaw, size, support="table")


def scene_of(geometry: SceneGeometry, *objects: SceneObject) -> SceneGeometry:
    """Boxes on a table, with the task to hold the first one."""
    first = objects[0].instance
    task = TaskInfo("", "Pick it up.", task_objects=(first,), conditions=(GoalCondition(first, ConditionKind.HELD),))
    return SceneGeometry.of(Scene("small", TABLE, objects, task), geometry.store)


@pytest.mark.parametrize(("ahead", "yaw"), [(0.2, 0.0), (0.2, 0.7), (0.26, 0.3), (0.32, 0.0)])
def test_a_small_box_in_front_of_it_is_held(geometry: SceneGeometry, ahead: float, yaw: float) -> None:
    laid = scene_of(geometry, box(CUBE, 0.5, ahead + 0.05, (0.03, 0.04, 0.035), yaw))
    found = survey_reach(laid, ROBOT, ReachOptions("front", 3))
    assert (found.task_reachable, found.task_graspable, found.task_reason) == (True, True, None)


def test_it_finds_its_place_beside_the_objects(geometry: SceneGeometry) -> None:
    laid = scene_of(geometry, box(CUBE, 0.5, 0.35, (0.03, 0.03, 0.04)), box("wall_0", 0.5, 0.05, (0.8, 0.08, 0.3)))
    found = survey_reach(laid, ROBOT, ReachOptions("auto", 3))
    assert found.mount is not None
    assert not found.mount.startswith("front")
    assert found.task_graspable is True
    assert survey_reach(laid, ROBOT, ReachOptions(found.mount, 3)) == found


def test_a_full_table_has_no_place_for_it(geometry: SceneGeometry) -> None:
    laid = scene_of(geometry, box("board_0", 0.5, 0.35, (0.99, 0.69, 0.02)))
    found = survey_reach(laid, ROBOT, ReachOptions("auto", 1))
    assert found.task_reachable is False
    assert found.task_reason is not None
    assert found.task_reason.startswith(f"{START_COLLIDES}: so101 touches board_0")
    assert "\n" not in found.task_reason


def test_the_standing_jaw_is_beside_the_object_and_the_space_between_the_jaws_is_free(geometry: SceneGeometry) -> None:
    laid = scene_of(geometry, box(CUBE, 0.5, 0.27, (0.03, 0.03, 0.04)))
    built = assemble(laid, ROBOT, mount_at(ROBOT, TABLE, "front"))
    finder, world = GraspFinder(built, Arm(ROBOT)), RobotWorld(built)
    reachable = finder.survey(world, CUBE).reachable
    assert reachable
    centre = built.mount.to_base(np.array([0.5, 0.27, 0.02]))
    best = reachable[0]
    away = (centre - best.position) @ best.rotation[:, 1]  # towards the moving jaw
    assert best.width / 2 < away < best.width / 2 + 0.015
    assert finder.clearance.hits(best.approach[-1], best.opening) is None  # not even the cube itself
    path, _ = finder.arm.poses(finder.lift(best))
    assert path[-1, 2] - path[0, 2] > 0.09  # the tool turns where it cannot be lifted straight


def test_a_place_counts_where_the_arm_comes_only_with_the_hand_inclined(geometry: SceneGeometry) -> None:
    """Five joints hardly ever bring the hand straight down over a place."""
    laid = scene_of(geometry, box(CUBE, 0.5, 0.3, (0.03, 0.03, 0.035)), box("plate_0", 0.62, 0.3, (0.1, 0.1, 0.02)))
    task = TaskInfo("", "Put it there.", task_objects=(CUBE,), conditions=(GoalCondition(CUBE, ConditionKind.ON, "plate_0"),))
    found = survey_reach(replace(laid, scene=replace(laid.scene, task=task)), ROBOT, ReachOptions("front", 1))
    assert found.task_reason is None
    assert found.task_reachable is True
