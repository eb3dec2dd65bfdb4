"""Scenes that another system has made for the tasks of a job: those of a run, or of a folder in the MesaTask-10K format."""

from dataclasses import replace
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

_SCENE = "__scene"  # what import-scenes adds to the id for a file scene.xml in a folder of that name


class LayoutFiles:
    """The scenes of a place, each under the id of its task.

    ``import-scenes`` names scenes after their files: if no scene has the id, ``<id>__scene`` of the file ``<id>/scene.xml`` is taken.

    Args:
        place: A run with a table ``scenes`` (also one that ``import-scenes`` made), or a folder in the MesaTask-10K format.
        assets: The meshes of the scenes; by default those of the place.

    Raises:
        ConfigError: The place contains neither.
    """

    def __init__(self, place: str, assets: AssetSource | None = None) -> None:
        self._place = place
        self._source: SceneSource = scene_source(place, assets)
        self._ids = frozenset(self._source.scene_ids)

    @cached_property
    def _settings(self) -> SceneSettings:
        return SceneSettings(position_convention=PositionConvention(self._source.position_convention()))

    @property
    def fingerprint(self) -> str:
        """A hash of all scenes and of the meshes that they use."""
        return content_id(self._source.parts(self._settings, 32)[1])

    def of_task(self, scene_id: str) -> tuple[Scene | Notice, tuple[Notice, ...]]:
        """Returns the scene of a task, or why there is none; and what its reader remarked."""
        name = next((name for name in (scene_id, f"{scene_id}{_SCENE}") if name in self._ids), None)
        if name is None:
            message = f"{self._place} has no scene of this id, expected one for each task; make it, or leave out the task"
            return Notice(scene_id, STEP, "layout_missing", f"{scene_id}: {message}"), ()
        try:
            found = self._source.take(name, self._settings, ItemProgress("read"))
        except SceneError as error:
            return Notice(scene_id, STEP, error.code, str(error)), ()
        return found.scene, tuple(replace(notice, item_id=scene_id) for notice in found.notices)
