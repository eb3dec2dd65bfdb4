"""The steps of preprocess: assets, their point features, and scenes of a folder in the MesaTask-10K format become rows."""

import importlib
from collections.abc import Callable
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import TYPE_CHECKING, Any, ClassVar, TypeVar

from pipelines.execution.item_progress import ItemProgress
from pipelines.execution.shard_step import ItemStep, Rows
from pipelines.preprocess.asset import AssetSettings, AssetUse, TextFeature, preprocess_asset
from pipelines.preprocess.features import FeatureUse, encoder_of, feature_rows
from pipelines.preprocess.plan import text_features
from pipelines.preprocess.scene import CachedTaskWriter, preprocess_scene
from pipelines.preprocess.settings import PreprocessSettings
from stable_data.assets.store import AssetStore
from stable_data.errors import ConfigError
from stable_data.mesatask import MesaTaskDataset
from stable_data.storage import schemas

if TYPE_CHECKING:
    from models.point_encoder import PointEncoder

I = TypeVar("I")  # noqa: E741 - an item


@dataclass(frozen=True, slots=True)
class DatasetStep(ItemStep[I]):
    """A step over a dataset.

    Attributes:
        data: Root of the dataset, which every worker can read: an absolute path, for each worker has a folder of its own.
        settings: The job's settings, with absolute paths.
        fingerprint: Content of the dataset: what a process keeps of one is not used for another in the same place.
    """

    data: str
    settings: PreprocessSettings
    fingerprint: str = ""

    @property
    def seconds_per_item(self) -> float:
        """As the settings say."""
        return self.settings.seconds_per_item

    def opened(self) -> tuple[MesaTaskDataset, AssetStore]:
        """What this process keeps of the dataset."""
        return _opened(self.data, self.fingerprint)

    def prepare(self, item: I) -> None:
        """Opens the dataset."""
        self.opened()


@dataclass(frozen=True, slots=True)
class AssetStep(DatasetStep[AssetUse]):
    """Assets: their repaired meshes, grids of signed distance, physics and points."""

    TABLES: ClassVar = ("warnings", "failures", "sdf", "meshes", "assets")

    def item_id(self, item: AssetUse) -> str:
        """The asset's id."""
        return item.asset_id

    def prepare(self, item: AssetUse) -> None:
        """Opens the dataset and its text features."""
        self.opened()
        _text_features(self.data, self.fingerprint)

    def item_rows(self, item: AssetUse, progress: ItemProgress) -> Rows:
        """Rows of one asset."""
        dataset, store = self.opened()
        embedding = _text_features(self.data, self.fingerprint).get(item.asset_id)
        shaping = AssetSettings(self.settings.num_points)
        made = preprocess_asset(item, dataset.annotation(item.asset_id), store, shaping, progress, embedding)
        warnings = [schemas.notice_row(n) for n in made.notices]
        return {"assets": [made.asset], "meshes": [made.mesh], "sdf": list(made.grids), "warnings": warnings}


@dataclass(frozen=True, slots=True)
class FeatureStep(DatasetStep[FeatureUse]):
    """Point features of assets.

    Attributes:
        encoder: Fingerprint of their encoder.
    """

    TABLES: ClassVar = ("failures", "features")

    encoder: str = ""

    def item_id(self, item: FeatureUse) -> str:
        """The asset's id."""
        return item.asset_id

    def prepare(self, item: FeatureUse) -> None:
        """Opens the dataset and the encoder."""
        self.opened()
        self._encoder()

    def item_rows(self, item: FeatureUse, progress: ItemProgress) -> Rows:
        """Features of one asset, at every aspect and tilt."""
        return {"features": feature_rows(item, self.opened()[1], self._encoder(), progress)}

    def _encoder(self) -> "PointEncoder":
        return encoder_of(self.settings.features, self.encoder)


@dataclass(frozen=True, slots=True)
class SceneStep(DatasetStep[str]):
    """Scenes, by their ids: judged, tasked and staged, with the training samples of their stages."""

    TABLES: ClassVar = ("warnings", "failures", "samples", "scenes")

    def item_rows(self, item: str, progress: ItemProgress) -> Rows:
        """Rows of one scene."""
        dataset, store = self.opened()
        made = preprocess_scene(dataset, item, store, self.settings.scene_settings(), progress, task_writer(self.settings))
        warnings = [schemas.notice_row(n) for n in made.notices]
        return {"scenes": [made.scene], "samples": list(made.samples), "warnings": warnings}


@lru_cache(maxsize=2)
def _opened(data: str, fingerprint: str) -> tuple[MesaTaskDataset, AssetStore]:
    dataset = MesaTaskDataset(Path(data))
    return dataset, AssetStore(dataset)


@lru_cache(maxsize=2)
def _text_features(data: str, fingerprint: str) -> dict[str, TextFeature]:
    return text_features(Path(data))


@lru_cache(maxsize=2)
def task_writer(settings: PreprocessSettings) -> CachedTaskWriter | None:
    """Who writes the tasks of scenes without one; None: templates.

    Raises:
        ConfigError: The setting ``task_writer`` names no function (``config_invalid``).
    """
    if not settings.task_writer:
        return None
    module, _, name = settings.task_writer.partition(":")
    try:
        write: Callable[..., Any] = getattr(importlib.import_module(module), name)
    except (ImportError, AttributeError, ValueError) as error:
        raise ConfigError(
            f"setting task_writer is {settings.task_writer} ({error}), expected module:function", "config_invalid"
        ) from error
    return CachedTaskWriter(write, settings.task_cache, settings.task_writer)
