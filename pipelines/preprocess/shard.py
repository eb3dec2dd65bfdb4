"""The three steps of preprocess: assets, their point features, and scenes of a folder in the MesaTask-10K format."""

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
from stable_data.storage.table_rows import notice_row

if TYPE_CHECKING:
    from models.point_encoder import PointEncoder

I = TypeVar("I")  # noqa: E741 - an item


@dataclass(frozen=True, slots=True)
class DatasetStep(ItemStep[I]):
    """A step over a dataset.

    Attributes:
        data: Root of the dataset, readable for every worker; absolute, because each worker has its own current folder.
        settings: The job's settings, with absolute paths.
        fingerprint: Hash of the dataset, the key of what a process caches of it.
    """

    data: str
    settings: PreprocessSettings
    fingerprint: str = ""

    @property
    def seconds_per_item(self) -> float:
        """The time limit of an item, from the settings."""
        return self.settings.seconds_per_item

    def opened(self) -> tuple[MesaTaskDataset, AssetStore]:
        """The dataset and its store, cached in this process."""
        return _opened(self.data, self.fingerprint)

    def prepare(self, item: I) -> None:
        """Opens the dataset."""
        self.opened()


@dataclass(frozen=True, slots=True)
class AssetStep(DatasetStep[AssetUse]):
    """Computes repaired meshes, signed-distance grids, mass properties and surface points of assets."""

    TABLES: ClassVar = ("warnings", "failures", "sdf", "textures", "meshes", "assets")

    def item_id(self, item: AssetUse) -> str:
        """The asset's id."""
        return item.asset_id

    def prepare(self, item: AssetUse) -> None:
        """Opens the dataset and its text features."""
        self.opened()
        _text_features(self.data, self.fingerprint)

    def item_rows(self, item: AssetUse, progress: ItemProgress) -> Rows:
        """The rows of one asset."""
        dataset, store = self.opened()
        embedding = _text_features(self.data, self.fingerprint).get(item.asset_id)
        shaping = AssetSettings(self.settings.num_points, self.settings.sdf.backend)
        made = preprocess_asset(item, dataset.annotation(item.asset_id), store, shaping, progress, embedding)
        warnings = [notice_row(n) for n in made.notices]
        rows: Rows = {"assets": [made.asset], "meshes": [made.mesh], "textures": list(made.textures), "sdf": list(made.grids)}
        return rows | {"warnings": warnings}


@dataclass(frozen=True, slots=True)
class FeatureStep(DatasetStep[FeatureUse]):
    """Computes the point features of assets.

    Attributes:
        encoder: Fingerprint of the encoder.
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
        """The features of one asset, at every aspect and tilt."""
        return {"features": feature_rows(item, self.opened()[1], self._encoder(), progress)}

    def _encoder(self) -> "PointEncoder":
        return encoder_of(self.settings.features, self.encoder)


@dataclass(frozen=True, slots=True)
class SceneStep(DatasetStep[str]):
    """Reads and audits scenes and gives them tasks and stages; also writes the training samples of their stages."""

    TABLES: ClassVar = ("warnings", "failures", "samples", "scenes")

    def item_rows(self, item: str, progress: ItemProgress) -> Rows:
        """The rows of one scene."""
        dataset, store = self.opened()
        made = preprocess_scene(dataset, item, store, self.settings.scene_settings(), progress, task_writer(self.settings))
        warnings = [notice_row(n) for n in made.notices]
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
    """The model that writes the tasks of scenes without one, or None if templates are used.

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
