"""What a robot reaches and holds in a scene: verdicts on tasks with their reasons, as rows."""

from dataclasses import replace

import numpy as np
import pytest

from stable_data.condition import ConditionKind, GoalCondition
from stable_data.errors import ConfigError
from stable_data.metrics.reach_columns import REACH_COLUMNS
from stable_data.robot.arm.mounting import mount_of
from stable_data.robot.arm.robots import ROBOTS
from stable_data.robot.grasp_trial import GraspFinder, GraspOutcome
from stable_data.robot.reach import ReachOptions, ReachRole, SceneReach, survey_reach
from stable_data.robot.reach_rows import grasp_rows, reach_columns
from stable_data.rotations import rotation_matrix
from stable_data.scene import TABLE, Scene, SceneObject, Tabletop, TaskInfo
from stable_data.simulation.scene_geometry import SceneGeometry
from stable_data.storage.filter_expression import parse_filter
from stable_data.storage.schemas import SCHEMAS
from stable_data.storage.table_rows import arrow_table
from tests.stable_data.robot.tables import BOX, CAN, MUG, PLATE, laid_table

SIMPLE = ROBOTS["simple"]
K = ConditionKind


def asking(scene: Scene, *conditions: GoalCondition) -> Scene:
    names = tuple(dict.fromkeys(name for c in conditions for name in c.subjects))
    return replace(scene, task=TaskInfo("", "Do it.", task_objects=names, conditions=conditions))


def surveyed(geometry: SceneGeometry, *conditions: GoalCondition, tries: int = 1, mount: str = "front") -> SceneReach:
    asked = replace(geometry, scene=asking(geometry.scene, *conditions))
    return survey_reach(asked, SIMPLE, ReachOptions(mount, tries))


def with_objects(geometry: SceneGeometry, *objects: SceneObject, size: tuple[float, float] = (1.0, 0.7)) -> SceneGeometry:
    """Other objects on a table, with the meshes of the run."""
    return SceneGeometry.of(Scene("other", Tabletop("desk", size), objects), geometry.store)


def block(name: str, x: float, y: float, size: tuple[float, float, float], z: float = 0.0, on: str = TABLE) -> SceneObject:
    """A box without a mesh."""
    return SceneObject(name, "block", (x, y, z + size[2] / 2), 0.0, size, support=on)


SMALL = (0.05, 0.05, 0.05)


def test_a_can_that_shall_be_held_is_reached_and_held(geometry: SceneGeometry) -> None:
    found = surveyed(geometry, GoalCondition(CAN, K.HELD), tries=2)
    assert (found.task_kind, found.task_reachable, found.task_graspable, found.task_reason) == ("pick", True, True, None)
    assert found.mount == "front:0.5"
    (can,) = found.objects
    assert (can.instance, can.role, can.reachable, can.graspable) == (CAN, ReachRole.GRASP, True, True)
    assert can.num_tried == len(found.grasps) == 2
    assert can.num_grasps == sum(grasp.outcome is GraspOutcome.HELD for grasp in found.grasps) > 0
    assert can.num_reachable is not None
    assert can.num_out_of_reach is not None
    assert can.blocked_by is not None
    assert can.num_candidates == can.num_reachable + can.num_out_of_reach + sum(can.blocked_by.values())


def test_what_is_too_wide_is_named(geometry: SceneGeometry) -> None:
    found = surveyed(geometry, GoalCondition(BOX, K.HELD))
    assert (found.task_reachable, found.task_graspable) == (False, False)
    assert found.task_reason == f"too_wide: {BOX}"
    assert not found.grasps


def test_what_is_far_away_is_out_of_reach(geometry: SceneGeometry) -> None:
    far = with_objects(geometry, block("far_0", 0.5, 1.8, SMALL), size=(1.0, 2.0))
    found = surveyed(far, GoalCondition("far_0", K.HELD))
    assert (found.task_reachable, found.task_graspable, found.task_reason) == (False, False, "out_of_reach: far_0")


def test_what_stands_in_the_way_is_named(geometry: SceneGeometry) -> None:
    """A cube in a pit of tall walls."""
    walls = [
        block(f"wall_{k}", 0.5 + x, 0.3 + y, (0.05, 0.05, 0.35))
        for k, (x, y) in enumerate(((0.055, 0), (-0.055, 0), (0, 0.055), (0, -0.055)))
    ]
    found = surveyed(with_objects(geometry, block("cube_0", 0.5, 0.3, SMALL), *walls), GoalCondition("cube_0", K.HELD))
    assert found.task_reachable is False
    assert found.task_reason is not None
    assert found.task_reason.startswith("blocked: cube_0, by wall_")
    assert found.objects[0].num_reachable == 0


def test_places_and_targets_are_looked_at_too(geometry: SceneGeometry) -> None:
    near = surveyed(geometry, GoalCondition(CAN, K.ON, PLATE), tries=0)
    assert (near.task_kind, near.task_reachable, near.task_graspable) == ("place_on", True, None)  # nothing was tried
    assert {o.instance: o.role for o in near.objects} == {CAN: ReachRole.GRASP, PLATE: ReachRole.TARGET}
    long = with_objects(geometry, block("cube_0", 0.5, 0.25, SMALL), size=(1.0, 2.5))
    found = surveyed(long, GoalCondition("cube_0", K.AT, "back_left"), tries=0)
    assert (found.task_reachable, found.task_graspable) == (False, False)
    assert found.task_reason == "place_out_of_reach: cube_0, cube_0 at back_left"
    assert found.objects[0].reachable is True


def test_where_an_object_is_handed_over_is_looked_at_too(geometry: SceneGeometry) -> None:
    near = surveyed(geometry, GoalCondition(CAN, K.HELD, "front_edge"), tries=0)
    assert (near.task_kind, near.task_reachable, near.task_reason) == ("hand_over", True, None)
    long = with_objects(geometry, block("cube_0", 0.5, 2.2, SMALL), size=(1.0, 2.5))
    far = surveyed(long, GoalCondition("cube_0", K.HELD, "front_edge"), tries=0, mount="back")
    assert far.task_reason == "place_out_of_reach: cube_0, cube_0 held front_edge"
    assert far.objects[0].reachable is True


def test_a_later_step_finds_the_scene_as_the_earlier_one_leaves_it(geometry: SceneGeometry) -> None:
    """The lower cube is in a pit that the upper one closes, until it is taken away."""
    low, top = block("low_0", 0.4, 0.3, SMALL), block("top_0", 0.4, 0.3, (0.07, 0.07, 0.2), 0.05, "low_0")
    stacked = with_objects(geometry, low, top)
    first = surveyed(stacked, GoalCondition("low_0", K.HELD))
    then = surveyed(stacked, GoalCondition("top_0", K.AT, "front_right"), GoalCondition("low_0", K.HELD))
    counts = [next(o.num_reachable for o in found.objects if o.instance == "low_0") for found in (first, then)]
    assert counts[1] is not None
    assert counts[0] is not None
    assert counts[1] > counts[0]
    assert then.task_graspable is True
    assert [o.instance for o in then.objects] == ["top_0", "low_0"]


def test_a_goal_that_is_not_known_passes_nothing(geometry: SceneGeometry) -> None:
    scene = replace(geometry.scene, task=TaskInfo("", "Wipe.", action_sequence=("Wipe(Table)",), task_objects=(CAN,)))
    found = survey_reach(replace(geometry, scene=scene), SIMPLE, ReachOptions("front", 0))
    assert (found.task_kind, found.task_reachable, found.task_graspable) == (None, None, None)
    assert found.task_reason is not None
    assert found.task_reason.startswith("goal_not_checkable: ")
    assert "\n" not in found.task_reason
    assert [(o.instance, o.role, o.reachable) for o in found.objects] == [(CAN, ReachRole.OTHER, True)]
    none = survey_reach(replace(geometry, scene=replace(scene, task=None)), SIMPLE, ReachOptions("front", 0))
    assert none.task_reason is not None
    assert none.task_reason.startswith("no_task: ")
    assert not none.objects
    everything = survey_reach(replace(geometry, scene=replace(scene, task=None)), SIMPLE, ReachOptions("front", 0, True))
    assert {o.instance for o in everything.objects} == {CAN, MUG, BOX, PLATE}


def test_a_robot_that_would_start_in_something_says_so(geometry: SceneGeometry) -> None:
    full = with_objects(geometry, block("tower_0", 0.5, 0.3, (0.3, 0.4, 0.6)), block("cube_0", 0.1, 0.2, SMALL))
    found = surveyed(full, GoalCondition("cube_0", K.HELD))
    assert (found.task_reachable, found.task_graspable) == (False, False)
    assert found.task_reason == "robot_start_collides: simple touches tower_0 where it starts, at front:0.5"


def test_a_mount_is_stated_as_a_setting_that_gives_it_again(geometry: SceneGeometry) -> None:
    far = with_objects(geometry, block("cube_0", 1.7, 0.3, SMALL), size=(2.0, 0.7))
    found = surveyed(far, GoalCondition("cube_0", K.HELD), tries=0, mount="auto")
    assert found.mount is not None
    assert found.mount != "front:0.5"
    again = surveyed(far, GoalCondition("cube_0", K.HELD), tries=0, mount=found.mount)
    assert again == found


def test_another_place_is_tried_where_the_nearest_one_to_the_objects_does_not_do(geometry: SceneGeometry) -> None:
    """From the place near the cube the right edge is out of reach, from the middle both are in reach."""
    wide = with_objects(geometry, block("cube_0", 0.12, 0.1, SMALL), size=(1.4, 0.4))
    goal = GoalCondition("cube_0", K.AT, "right_edge")
    near = surveyed(wide, goal, tries=0, mount="front:0.4286")
    assert near.task_reason == "place_out_of_reach: cube_0, cube_0 at right_edge"
    assert mount_of(SIMPLE, wide.scene, "auto", ("cube_0",)) == mount_of(SIMPLE, wide.scene, f"front:{0.6 / 1.4}")
    found = surveyed(wide, goal, tries=0, mount="auto")
    assert (found.task_reachable, found.mount) == (True, "front:0.5")
    far = with_objects(geometry, block("cube_0", 0.12, 0.1, SMALL), size=(3.0, 0.4))
    nowhere = surveyed(far, goal, tries=0, mount="auto")
    assert (nowhere.task_reachable, nowhere.mount) == (False, surveyed(far, goal, tries=0, mount=nowhere.mount or "").mount)


def test_trials_that_fail_are_kept_with_their_outcome(geometry: SceneGeometry, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(GraspFinder, "try_grasp", lambda *_: GraspOutcome.SLIPPED)
    found = surveyed(geometry, GoalCondition(CAN, K.HELD), tries=3)
    assert (found.task_reachable, found.task_graspable) == (True, False)
    assert found.task_reason == f"slipped: {CAN}, held in 0 of 3 trials"
    assert [grasp.outcome for grasp in found.grasps] == [GraspOutcome.SLIPPED] * 3
    assert [grasp.number for grasp in found.grasps] == [0, 1, 2]


def test_a_survey_becomes_rows_that_conditions_select(geometry: SceneGeometry) -> None:
    found = surveyed(geometry, GoalCondition(CAN, K.HELD))
    columns, (grasp,) = reach_columns(found), grasp_rows("laid", found)
    assert tuple(columns) == REACH_COLUMNS
    assert tuple(grasp) == tuple(SCHEMAS["grasps"].names)
    row = dict.fromkeys(SCHEMAS["scenes"].names) | columns
    (back,) = arrow_table("scenes", [row]).to_pylist()
    assert back["reach"][0]["blocked_by"] == columns["reach"][0]["blocked_by"]
    assert arrow_table("grasps", [grasp]).num_rows == 1
    graspable = parse_filter("task_graspable and robot == 'simple'", SCHEMAS["scenes"])
    assert graspable.passes(row, SCHEMAS["scenes"])
    unknown = dict.fromkeys(SCHEMAS["scenes"].names) | reach_columns(None)
    assert not graspable.passes(unknown, SCHEMAS["scenes"])
    assert not parse_filter("not task_graspable", SCHEMAS["scenes"]).passes(unknown, SCHEMAS["scenes"])
    # The tool points down at the can, between its sides.
    x, y, z = grasp["position"]
    assert np.hypot(x - 0.4, y - 0.25) < 0.06
    assert 0 < z < 0.12
    assert rotation_matrix(grasp["quat_xyzw"])[2, 2] < 0


def test_the_default_survey_is_of_the_scene_as_it_is() -> None:
    assert ReachOptions() == ReachOptions("auto", 3, False)
    with pytest.raises(ConfigError, match="expected auto or one of front"):
        mount_of(SIMPLE, laid_table(), "above")
