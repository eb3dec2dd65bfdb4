"""Scenes that another system has made for the tasks of a job: those of a run, or of a folder in the MesaTask-10K format."""

from functools import cached_property

from pipelines.execution.item_progress import ItemProgress
from pipelines.preprocess.scene import SceneSettings
from pipelines.sources.scenes import SceneSource, scene_source
from stable_data.assets.store import AssetSource
from stable_data.content_id import content_id
from stable_data.errors import Notice, SceneError
from stable_data.mesatask import PositionConvention
from stable_data.scene import Scene

STEP = "layout"
"""The step that notices of this module name."""

_PART = "__"  # between the parts of an id that import-scenes makes of a path


class LayoutFiles:
    """The scenes of a place, each under the id of its task.

    ``import-scenes`` names scenes after their files: also ``<id>__scene`` of the file ``<id>/scene.xml`` is the scene of the task ``<id>``.

    Args:
        place: A run with a table ``scenes`` (also one that ``import-scenes`` made), or a folder in the MesaTask-10K format.
        assets: The meshes of the scenes; by default those of the place.

    Raises:
        ConfigError: The place contains neither.
    """

    def __init__(self, place: str, assets: AssetSource | None = None) -> None:
        self._place = place
        self._source: SceneSource = scene_source(place, assets)
        self._ids = self._source.scene_ids

    @cached_property
    def _settings(self) -> SceneSettings:
        return SceneSettings(position_convention=PositionConvention(self._source.position_convention()))

    @property
    def fingerprint(self) -> str:
        """A hash of all scenes and of the meshes that they use."""
        return content_id(self._source.parts(self._settings, 32)[1])

    def of_task(self, scene_id: str) -> Scene | Notice:
        """Returns the scene of a task, or why there is none."""
        found = sorted((name for name in self._ids if name == scene_id or name.startswith(f"{scene_id}{_PART}")), key=len)
        if not found:
            message = f"{self._place} has no scene of this id, expected one for each task; make it, or leave out the task"
            return Notice(scene_id, STEP, "layout_missing", f"{scene_id}: {message}")
        # Of several surfaces of one file, the first has its name, and the others have longer ones.
        if any(not name.startswith(f"{found[0]}{_PART}") for name in found[1:]):
            message = f"{self._place} has {', '.join(found[:3])}, expected one scene for each task; rename the others"
            return Notice(scene_id, STEP, "layout_ambiguous", f"{scene_id}: {message}")
        try:
            return self._source.take(found[0], self._settings, ItemProgress("read")).scene
        except SceneError as error:
            return Notice(scene_id, STEP, error.code, str(error))
