"""Settings of the propose job: who is asked, how, and how assets are chosen."""

from dataclasses import asdict, dataclass, field
from typing import Any, ClassVar

from models.semantic_reasoner.engines.registry import EngineSettings
from models.semantic_reasoner.factory import ReasonerSettings
from models.semantic_reasoner.staged_layout import ONE_SHOT, PROGRESSIVE
from models.semantic_reasoner.text.prompt import Wanted
from stable_data.assets.ranking import RetrievalSettings
from stable_data.errors import ConfigError


@dataclass(frozen=True, slots=True)
class ProposeSettings:
    """Settings of the job; ``--set key=value`` or the table ``[propose]`` of a TOML file.

    Attributes:
        engine: Who answers.
        reasoner: How it is asked.
        retrieval: How assets are chosen.
        one_shot: Ask for the whole layout at once, the paper's ablation.
        seed: Of draws and of choices among assets that are as good.
        scenes_per_shard: Scenes that are laid out together, and kept together.
        pictures: Whether front.png is drawn.
        num_pictures: Scenes shown in the report.
    """

    section: ClassVar[str] = "propose"

    engine: EngineSettings = field(default_factory=EngineSettings)
    reasoner: ReasonerSettings = field(default_factory=ReasonerSettings)
    retrieval: RetrievalSettings = field(default_factory=RetrievalSettings)
    one_shot: bool = False
    seed: int = 0
    scenes_per_shard: int = 64
    pictures: bool = True
    num_pictures: int = 12

    def __post_init__(self) -> None:
        """Refuses settings that no run can follow."""
        if self.scenes_per_shard < 1 or self.num_pictures < 0:
            found = f"scenes_per_shard is {self.scenes_per_shard}, num_pictures {self.num_pictures}"
            raise ConfigError(f"{found}, expected at least 1 and 0", "config_invalid")

    @property
    def stages(self) -> tuple[Wanted, ...]:
        """What is asked for, in order."""
        return ONE_SHOT if self.one_shot else PROGRESSIVE

    def shaping(self) -> dict[str, Any]:
        """The settings that shape scenes beside the reasoner's own: a run is resumed only under the same."""
        return {
            "retrieval": plain_retrieval(self.retrieval),
            "one_shot": self.one_shot,
            "seed": self.seed,
            "scenes_per_shard": self.scenes_per_shard,
            "pictures": self.pictures,
        }


def plain_retrieval(settings: RetrievalSettings) -> dict[str, Any]:
    """The settings of retrieval as JSON has them."""
    return asdict(settings) | {"licences": None if settings.licences is None else sorted(settings.licences)}
