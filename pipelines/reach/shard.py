"""The step of the reach job: the scenes of a run, each with what a robot reaches and holds in it."""

from dataclasses import dataclass
from functools import lru_cache
from typing import ClassVar

from pipelines.execution.item_progress import ItemProgress
from pipelines.execution.shard_step import ItemStep, Rows
from pipelines.reach.settings import ReachSettings
from stable_data.robot.arm.robots import robot_named
from stable_data.robot.reach import survey_reach
from stable_data.robot.reach_rows import grasp_rows, reach_columns
from stable_data.simulation.run_reader import RunScenes, SceneSelection
from stable_data.storage.run_folder import RunFolder
from stable_data.storage.schemas import SCHEMAS
from stable_data.storage.table_rows import scene_from_row


@dataclass(frozen=True, slots=True)
class ReachStep(ItemStep[str]):
    """Surveys scenes; an item is a scene id.

    Attributes:
        run: The run of the scenes; readable for every worker.
        settings: The job's settings.
    """

    TABLES: ClassVar = ("warnings", "failures", "grasps", "scenes")
    UNIT: ClassVar = "scene"

    run: str
    settings: ReachSettings

    @property
    def seconds_per_item(self) -> float:
        """The time limit of a scene, seconds."""
        return self.settings.seconds_per_item

    def prepare(self, item: str) -> None:
        """Opens the meshes of the run."""
        _opened(self.run)

    def item_rows(self, item: str, progress: ItemProgress) -> Rows:
        """The row of one scene, with the columns of the robot, and its grasps."""
        progress.step = "scene"
        known = _opened(self.run)
        scenes = known.select(SceneSelection(scene_ids=(item,)))
        row = scenes.row(0)
        geometry = scenes.geometry(scene_from_row(row))
        progress.step = "reach"
        found = survey_reach(geometry, robot_named(self.settings.robot), self.settings.options())
        blank = dict.fromkeys(SCHEMAS["scenes"].names)  # an older run may lack columns
        return {"scenes": [{**blank, **row, **reach_columns(found)}], "grasps": grasp_rows(item, found)}


@lru_cache(maxsize=1)
def _opened(run: str) -> RunScenes:
    """The run, with its meshes open."""
    return RunScenes(RunFolder(run))
