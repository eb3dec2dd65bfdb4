"""Settings of the preprocess job: which of them shape its rows."""

from dataclasses import asdict, dataclass, field, replace
from typing import Any, ClassVar, cast

from models.settings import Count, Positive, PositiveCount, Settings, Share
from pipelines.preprocess.convention import ConventionChoice
from pipelines.preprocess.scene import SceneSettings
from stable_data.assets.store import AssetStore
from stable_data.errors import ConfigError
from stable_data.geometry.sdf.second_opinion import INSTALL, SdfBackend, has_pysdf
from stable_data.mesatask import MesaTaskDataset, PositionConvention
from stable_data.mesatask.convention_detection import position_convention


@dataclass(frozen=True, slots=True)
class SdfSettings(Settings):
    """Settings of the signed-distance grids."""

    backend: SdfBackend = "exact"
    """``exact``: libigl near the surface, with pysdf as a second opinion where it is installed. ``pysdf``: pysdf at every node; its
    errors are measured and stored. It needs the extra ``pysdf``, and takes longer.
    """

    def check(self) -> None:
        """Refuses a backend that is not installed; see the base class."""
        if self.backend == "pysdf" and not has_pysdf():
            raise ConfigError(
                f"setting preprocess.sdf.backend is pysdf, but pysdf is not installed; {INSTALL}", "pysdf_missing"
            )


@dataclass(frozen=True, slots=True)
class PreprocessSettings(Settings):
    """Settings of the preprocess job, from ``--set key=value`` or the table ``[preprocess]`` of a TOML file."""

    section: ClassVar[str] = "preprocess"

    important_threshold: Positive = 0.02
    """Metres; objects nearer than this to a task object are O^B."""

    seed: int = 0
    """Seed of task templates and splits."""

    train_share: Share = 0.9
    """Share of near-duplicate groups in the training split."""

    validation_share: Share = 0.05
    """Share of near-duplicate groups in the validation split; the rest is the test split."""

    position_convention: ConventionChoice = "auto"
    """What a position in the dataset is the centre of: ``box_centre``, ``mesh_centre``, or ``auto``, which decides from the
    dataset.
    """

    tasks_per_scene: PositiveCount = 1
    """Tasks of a scene in the table ``samples``: its own, then others by template. MesaTask trains on five."""

    num_points: PositiveCount = 1024
    """Surface points of an asset."""

    sdf: SdfSettings = field(default_factory=SdfSettings)
    """Signed-distance grids."""

    all_assets: bool = True
    """Whether every annotated asset with a mesh is processed; else only those that a scene uses."""

    scenes_per_shard: PositiveCount = 32
    """Scenes of a shard."""

    assets_per_shard: PositiveCount = 8
    """Assets of a shard."""

    task_writer: str = ""
    """``module:function`` that writes task infos for scenes without one; empty uses templates."""

    task_cache: str = "data/task_cache"
    """Folder that keeps the task writer's answers; on a cluster every node must see it."""

    features: str = "auto"
    """Encoder of the point features: ``auto`` (the file in models/weights, where it exists), ``none``, a file that
    ``models.point_encoder.save`` wrote, or a published encoder as ``scannet:FILE``, ``modelnet:FILE`` or ``sonata:FILE``, by
    its training data. On a cluster every node must see the file. The encoder in models/weights takes a core about 30 ms a
    feature, and torch takes 200 MB of memory in each worker; ``none`` does not load it.
    """

    num_pictures: Count = 12
    """Scenes that the report shows."""

    seconds_per_item: Positive = 600.0
    """Seconds; a scene or asset that takes longer is a failure. Not enforced without worker processes."""

    def check(self) -> None:
        """Refuses a cache that is not a folder, and shares over 1; see the base class."""
        if "://" in self.task_cache:
            raise ConfigError(f"setting preprocess.task_cache is {self.task_cache}, expected a folder", "config_invalid")
        shares = (self.train_share, self.validation_share)
        if sum(shares) > 1:
            raise ConfigError(
                f"train_share and validation_share are {shares}, expected shares that add up to at most 1", "config_invalid"
            )

    def shaping(self) -> dict[str, Any]:
        """The settings that shape rows; a run is resumed only if they are equal. The encoder is compared by its fingerprint."""
        aside = ("features", "num_pictures", "seconds_per_item", "task_cache")
        return {k: v for k, v in asdict(self).items() if k not in aside}

    def scene_settings(self) -> SceneSettings:
        """The settings of the scene step."""
        convention = PositionConvention(self.position_convention)  # settled() has replaced auto
        return SceneSettings(
            self.important_threshold, self.seed, self.train_share, self.validation_share, convention, self.tasks_per_scene
        )

    def settled(self, dataset: MesaTaskDataset) -> "PreprocessSettings":
        """The settings with ``auto`` replaced by the convention that the dataset shows."""
        if self.position_convention != "auto":
            return self
        return replace(self, position_convention=cast(ConventionChoice, str(position_convention(dataset, AssetStore(dataset)))))
