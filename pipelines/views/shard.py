"""The step of the views job: the pictures of scenes, and their features."""

import io
from dataclasses import dataclass
from functools import lru_cache
from typing import ClassVar

import numpy as np
from PIL import Image

from models.picture_features import FeatureExtractor, extractor_named
from pipelines.execution.item_progress import ItemProgress
from pipelines.execution.shard_step import ItemStep, Rows
from pipelines.views.settings import ViewsSettings
from stable_data.simulation.offscreen import Picture
from stable_data.simulation.run_reader import RunScenes, SceneSelection
from stable_data.simulation.views import draw_scored_views
from stable_data.storage.run_folder import RunFolder
from stable_data.storage.table_rows import scene_from_row


@dataclass(frozen=True, slots=True)
class ViewsStep(ItemStep[str]):
    """Draws scenes; an item is a scene id.

    Attributes:
        run: The run of the scenes; readable for every worker.
        settings: The job's settings, resolved.
    """

    TABLES: ClassVar = ("warnings", "failures", "views")
    UNIT: ClassVar = "scene"

    run: str
    settings: ViewsSettings

    @property
    def seconds_per_item(self) -> float:
        """The time limit of a scene, seconds."""
        return self.settings.seconds_per_item

    def prepare(self, item: str) -> None:
        """Opens the meshes of the run, and the extractor."""
        _opened(self.run)
        _extractor(self.settings.features, self.settings.device)

    def item_rows(self, item: str, progress: ItemProgress) -> Rows:
        """The row of a scene."""
        progress.step = "scene"
        known, settings = _opened(self.run), self.settings
        scenes = known.select(SceneSelection(scene_ids=(item,)))
        geometry = scenes.geometry(scene_from_row(scenes.row(0)))
        progress.step = "draw"
        drawn = draw_scored_views(geometry, (settings.width, settings.height), settings.surroundings)
        progress.step = "features"
        extractor = _extractor(settings.features, settings.device)
        features = extractor(np.stack(list(drawn.values())))
        shown = [
            {"view": view, "picture": _png(picture), "features": row}
            for (view, picture), row in zip(drawn.items(), features, strict=True)
        ]
        extracted = {"extractor": extractor.name, "extractor_fingerprint": extractor.fingerprint}
        return {"views": [{"scene_id": item, **extracted, "views": shown}]}


def _png(picture: Picture) -> bytes:
    stream = io.BytesIO()
    Image.fromarray(picture).save(stream, "png")
    return stream.getvalue()


@lru_cache(maxsize=1)
def _opened(run: str) -> RunScenes:
    """The run, with its meshes open."""
    return RunScenes(RunFolder(run))


@lru_cache(maxsize=1)
def _extractor(name: str, device: str) -> FeatureExtractor:
    return extractor_named(name, device)
