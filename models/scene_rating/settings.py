"""Settings of a judge, and the function that makes the judge which they name."""

from collections.abc import Iterable
from dataclasses import dataclass, field, replace
from typing import Any

from models.scene_rating.judge import SYMBOLIC, RatingJudge
from models.semantic_reasoner.engines.http_settings import HttpSettings
from models.semantic_reasoner.engines.protocol import Sampling
from models.semantic_reasoner.engines.registry import EngineSettings, load_engine
from models.settings import PositiveCount, Settings
from stable_data.errors import ConfigError

_KINDS = ("openai", "scripted")  # engines that get pictures


@dataclass(frozen=True, slots=True)
class RatingSettings(Settings):
    """Settings of a judge."""

    judge: str = SYMBOLIC
    """``symbolic`` (rules, without pictures), ``openai:MODEL`` (a model that sees pictures behind an endpoint, ``http.base_url``;
    for Azure the deployment, with ``http.azure_api_version``) or ``scripted:FILE`` (replies of a file).
    """

    tries: PositiveCount = 3
    """How often a model is asked about a scene, at most, until its answer is a rating."""

    binds: bool = True
    """Whether the endpoint is asked to bind replies to their form; false for endpoints that know no JSON schemas."""

    cache: str = ""
    """Folder that keeps the replies of a model; a run that is resumed reads them from there. Empty keeps none."""

    sampling: Sampling = field(default_factory=lambda: Sampling(temperature=0.0, top_p=1.0, max_tokens=1500))
    """How tokens are drawn."""

    http: HttpSettings = field(default_factory=lambda: HttpSettings("http://127.0.0.1:8000/v1", "default"))
    """The endpoint of ``openai``: its address, key, requests at once, tries of a request, times, and prices."""

    def check(self) -> None:
        """Refuses an unknown judge; see the base class."""
        kind, _, what = self.judge.partition(":")
        if self.judge != SYMBOLIC and (kind not in _KINDS or not what):
            raise ConfigError(f"judge is {self.judge!r}, expected {SYMBOLIC}, openai:MODEL or scripted:FILE", "config_invalid")

    @property
    def asks_model(self) -> bool:
        """Whether a language model rates, which needs pictures."""
        return self.judge != SYMBOLIC

    @property
    def engine(self) -> EngineSettings:
        """The settings of the engine."""
        return EngineSettings(self.judge, self.sampling, cache=self.cache, http=self.http)

    def settled(self) -> "RatingSettings":
        """Returns the settings with absolute paths, so that they hold in any working directory."""
        if not self.asks_model:
            return self
        engine = self.engine.settled()
        return replace(self, judge=engine.engine, cache=engine.cache)

    def shaping(self) -> dict[str, Any]:
        """Returns all that ratings depend on beside the scenes and the categories of their assets.

        The endpoint's address and limits are left out; its prices shape the cost.

        Raises:
            ConfigError: The script is missing (``engine_missing``), or the key is (``key_missing``).
        """
        if not self.asks_model:
            from models.scene_rating.symbolic_judge import rules_version

            return {"judge": self.judge, "version": rules_version()}
        from models.scene_rating.prompt import PROMPT_VERSION

        return {
            "judge": self.judge,
            "version": PROMPT_VERSION,
            "tries": self.tries,
            "binds": self.binds,
            "prompt_price": self.http.prompt_price,
            "reply_price": self.http.reply_price,
            **self.engine.shaping(),
        }


def load_judge(settings: RatingSettings, categories: Iterable[str] = ()) -> RatingJudge:
    """Makes the judge that the settings name.

    Args:
        settings: The settings.
        categories: Categories of the scenes, which the judge by rules has to know.

    Raises:
        ConfigError: It cannot be made: a missing file, or a key that is not set.
    """
    if not settings.asks_model:
        from models.scene_rating.symbolic_judge import SymbolicJudge

        return SymbolicJudge(categories)
    from models.scene_rating.vision_judge import VisionJudge

    return VisionJudge(load_engine(settings.engine), settings.tries, binds=settings.binds)
