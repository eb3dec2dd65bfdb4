"""Settings of the rate job: who rates, and from which pictures."""

from dataclasses import dataclass, field, replace
from typing import Annotated, Any, ClassVar

from annotated_types import Ge

from models.scene_rating.settings import RatingSettings
from models.settings import Count, Positive, Settings
from pipelines.execution.shard_size import shard_size

_PARTS, _FEWEST, _MOST = 16, 4, 64  # shards of a small job, scenes of a shard


@dataclass(frozen=True, slots=True)
class RateSettings(Settings):
    """Settings of the rate job, from ``--set key=value`` or the table ``[rate]`` of a TOML file."""

    section: ClassVar[str] = "rate"

    rating: RatingSettings = field(default_factory=RatingSettings)
    """Who rates."""

    picture_size: Annotated[int, Ge(256)] = 512
    """Width and height of the pictures that a model sees, pixels. In smaller ones, the caption would not be legible."""

    scenes_per_shard: Count = 0
    """Scenes of a shard, whose questions are asked at once. 0: by the number of scenes."""

    seconds_per_item: Positive = 120.0
    """Seconds; a scene whose audit and pictures take longer is a failure. Not enforced without worker processes."""

    def settled(self) -> "RateSettings":
        """Returns the settings with absolute paths, so that they hold in any working directory."""
        return replace(self, rating=self.rating.settled())

    def shaping(self) -> dict[str, Any]:
        """The settings that shape rows; a run is resumed only if they are equal."""
        return {"rating": self.rating.shaping(), "picture_size": self.picture_size if self.rating.asks_model else 0}

    def shard_size(self, num_scenes: int) -> int:
        """Scenes of a shard."""
        return self.scenes_per_shard or shard_size(num_scenes, parts=_PARTS, fewest=_FEWEST, most=_MOST)
