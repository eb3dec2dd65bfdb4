"""Settings of the views job: the pictures, and what their features are."""

from dataclasses import asdict, dataclass, replace
from typing import Any, ClassVar

from models.picture_features import default_name
from models.settings import Count, Positive, PositiveCount, Settings
from pipelines.execution.shard_size import shard_size
from stable_data.simulation.room import Surroundings

AUTO = "auto"
"""Features of Inception if its weights were fetched, else those without weights."""

_PARTS, _FEWEST, _MOST = 16, 1, 64  # shards of a small job, scenes of a shard


@dataclass(frozen=True, slots=True)
class ViewsSettings(Settings):
    """Settings of the views job, from ``--set key=value`` or the table ``[views]`` of a TOML file."""

    section: ClassVar[str] = "views"

    width: PositiveCount = 512
    """Pixels of a picture along a row."""

    height: PositiveCount = 512
    """Pixels of a picture along a column."""

    surroundings: Surroundings = "floor"
    """What is around the table: a plain ``floor``; the ``room`` of the table; or ``none``, the black background on which MesaTask
    computes FID.
    """

    features: str = AUTO
    """What describes a picture: ``inception``, the network of FID (``stable-data features --fetch inception``); ``transformers:FOLDER``,
    a local vision model of Hugging Face; ``gradients``, without weights; or ``auto``: inception if it was fetched, else gradients.
    """

    device: str = "cpu"
    """The torch device of a network."""

    scenes_per_shard: Count = 0
    """Scenes of a shard. 0: by the number of scenes."""

    seconds_per_item: Positive = 300.0
    """Seconds; a scene that takes longer is a failure. Not enforced without worker processes."""

    def resolved(self) -> "ViewsSettings":
        """The settings with the name of the features in place of ``auto``."""
        return replace(self, features=default_name()) if self.features == AUTO else self

    def shaping(self) -> dict[str, Any]:
        """The settings that shape rows; a run is resumed only if they are equal."""
        return {k: v for k, v in asdict(self).items() if k not in ("device", "seconds_per_item")}

    def shard_size(self, num_scenes: int) -> int:
        """Scenes of a shard."""
        return self.scenes_per_shard or shard_size(num_scenes, parts=_PARTS, fewest=_FEWEST, most=_MOST)
