"""What a robot reaches and holds in a finished scene, as columns of ``scenes`` and rows of ``grasps``."""

from collections.abc import Mapping
from dataclasses import dataclass

from pipelines.correct.settings import CorrectorJobSettings
from stable_data.assets.store import AssetStore
from stable_data.robot.arm.robots import robot_named
from stable_data.robot.reach import ReachOptions, survey_reach
from stable_data.robot.reach_rows import grasp_rows, reach_columns
from stable_data.scene import Scene
from stable_data.simulation.scene_geometry import SceneGeometry
from stable_data.storage import schemas


@dataclass(frozen=True, slots=True, eq=False)
class ReachedScene:
    """A survey as rows.

    Attributes:
        columns: The columns of the robot in ``scenes``; null without a robot.
        grasps: Rows of ``grasps``.
    """

    columns: schemas.Row
    grasps: list[schemas.Row]


def reach_scene(
    scene: Scene, store: AssetStore, settings: CorrectorJobSettings, containers: Mapping[str, bool | None]
) -> ReachedScene:
    """Surveys the reach of a job's robot in a scene, if it has one.

    Args:
        scene: The scene, resolved, with the supports of its objects.
        store: The store of their meshes.
        settings: The job's settings.
        containers: Whether objects can be put into an object.

    Raises:
        ConfigError: The files of the robot are missing.
    """
    found = None
    if settings.robot:
        options = ReachOptions(settings.mount, settings.grasp_tries)
        found = survey_reach(SceneGeometry.of(scene, store), robot_named(settings.robot), options, containers)
    return ReachedScene(reach_columns(found), grasp_rows(scene.scene_id, found))
