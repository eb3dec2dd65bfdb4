"""A table with a can, a mug, a box and a plate, and a robot at it, for tests."""

from dataclasses import replace
from pathlib import Path

from stable_data.assets.run_assets import run_store
from stable_data.condition import ConditionKind, GoalCondition
from stable_data.robot.arm.assembly import RobotModel, assemble
from stable_data.robot.arm.kinematics import Arm
from stable_data.robot.arm.mounting import mount_at
from stable_data.robot.arm.robots import robot_named
from stable_data.robot.arm.world import RobotWorld
from stable_data.robot.grasp_trial import GraspFinder
from stable_data.scene import Scene, Tabletop, TaskInfo
from stable_data.simulation.scene_geometry import SceneGeometry
from tests.stable_data.export.runs import LYING, thing, write_run

TABLE = Tabletop("dining_table", (1.0, 0.7))
CAN, MUG, BOX, PLATE = "0_can_0", "1_mug_0", "2_cereal_box_0", "3_plate_0"


def laid_table() -> Scene:
    """Four things in front of a robot at the front edge, apart from each other."""
    objects = (
        thing("can/0", CAN, 0.4, 0.25, 0.0),
        thing("mug/0", MUG, 0.6, 0.25, 0.0, 1.0),
        thing("cereal_box/0", BOX, 0.22, 0.45, 0.0, 0.4, tilt_quat_xyzw=LYING),
        thing("plate/0", PLATE, 0.55, 0.45, 0.0),
    )
    task = TaskInfo("A kitchen.", "Pick up the can.", action_sequence=("Pick(Can)",), task_objects=(CAN,))
    return Scene("laid", TABLE, objects, task)


def asked_table() -> Scene:
    """The laid table with a goal: the can is held."""
    task = TaskInfo("", "Pick up the can.", task_objects=(CAN,), conditions=(GoalCondition(CAN, ConditionKind.HELD),))
    return replace(laid_table(), task=task)


def geometry_in(folder: Path, scene: Scene) -> SceneGeometry:
    """A scene with its geometry, of a run that is written to a folder."""
    run = write_run(folder / "run", (scene,))
    return SceneGeometry.of(scene, run_store(run.uri))


class Bench:
    """A robot at a table, with everything that tests ask for."""

    def __init__(self, geometry: SceneGeometry, name: str = "simple") -> None:
        robot = robot_named(name)
        self.arm = Arm(robot)
        self.built: RobotModel = assemble(geometry, robot, mount_at(robot, geometry.scene.table, "front"))
        self.world = RobotWorld(self.built)
        self.finder = GraspFinder(self.built, self.arm)
        self.clearance = self.finder.clearance

    def index(self, instance: str) -> int:
        """Number of an object."""
        return self.built.names.index(instance)
