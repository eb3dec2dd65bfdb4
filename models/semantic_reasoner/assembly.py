"""A reasoner from its settings: engine, checks, and what a closed vocabulary needs."""

from dataclasses import dataclass, field
from pathlib import Path

from models.semantic_reasoner.categories import CategoryStatistics
from models.semantic_reasoner.checks import CheckSettings, ReplyCheck
from models.semantic_reasoner.engines import EngineSettings, load_engine
from models.semantic_reasoner.grounding import Grounding
from models.semantic_reasoner.reasoner import SemanticReasoner


@dataclass(frozen=True, slots=True)
class ReasonerSettings:
    """How the reasoner asks.

    Attributes:
        tries: How often a question is asked at most.
        statistics: What is known of categories, for the checks: a model's folder with ``categories.json``, or a preprocess run
            with the table ``samples``; empty takes that of the engine's own folder, and without any only form is checked.
        checks: How strict the checks are.
    """

    tries: int = 4
    statistics: str = ""
    checks: CheckSettings = field(default_factory=CheckSettings)


def load_reasoner(
    engine: EngineSettings, settings: ReasonerSettings | None = None
) -> tuple[SemanticReasoner, CategoryStatistics | None]:
    """A reasoner, and what it knows of categories.

    Args:
        engine: Who answers.
        settings: How it is asked.

    Raises:
        ConfigError: The engine or the statistics cannot be loaded.
    """
    settings = settings or ReasonerSettings()
    statistics = _statistics(engine, settings)
    check = None if statistics is None else ReplyCheck(statistics, settings.checks)
    grounding = None
    if engine.kind == "embedded" and statistics is not None:
        from models.text_encoder import load_default

        grounding = Grounding(statistics, load_default())
    reasoner = SemanticReasoner(load_engine(engine), check, settings.tries, engine.reads_reasons, grounding)
    return reasoner, statistics


def _statistics(engine: EngineSettings, settings: ReasonerSettings) -> CategoryStatistics | None:
    if settings.statistics:
        folder = Path(settings.statistics)
        is_model = "://" not in settings.statistics and (folder / "categories.json").is_file()
        return CategoryStatistics.load(folder) if is_model else CategoryStatistics.of_run(settings.statistics)
    own = engine.folder
    return CategoryStatistics.load(own) if own is not None and (own / "categories.json").is_file() else None
