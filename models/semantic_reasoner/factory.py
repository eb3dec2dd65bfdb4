"""Makes a reasoner from its settings: the engine, the checks, and the interpreter of instructions."""

from dataclasses import asdict, dataclass, field, replace
from functools import cache, partial
from pathlib import Path
from typing import Any, Literal

from models.instruction_reader.reader import reader_fingerprint
from models.semantic_reasoner.engines.protocol import Engine
from models.semantic_reasoner.engines.registry import EMBEDDED, EngineSettings, load_engine
from models.semantic_reasoner.language.category_statistics import CategoryStatistics
from models.semantic_reasoner.language.interpreter import InstructionInterpreter
from models.semantic_reasoner.prompt_styles import MESATASK_TEXT, prompt_style_of
from models.semantic_reasoner.reasoner import SemanticReasoner
from models.semantic_reasoner.replies.checks import CheckSettings, ReplyCheck, form_check
from models.semantic_reasoner.replies.object_check import ObjectCheck
from models.semantic_reasoner.replies.required_objects import RequiredObjects
from models.semantic_reasoner.text.prompt import PROMPT_VERSION
from models.semantic_reasoner.text.zero_shot_prompt import ZERO_SHOT_SYSTEM
from models.settings import PositiveCount, Settings
from stable_data.content_id import content_id
from stable_data.errors import ConfigError
from stable_data.json_text import read_json
from stable_data.storage.run_folder import absolute_uri


@dataclass(frozen=True, slots=True)
class ReasonerSettings(Settings):
    """Settings of the reasoner."""

    tries: PositiveCount = 4
    """How often a question is asked, at most, until its answer passes the checks."""

    statistics: str = ""
    """Where the checks take the statistics of categories from: a model's folder with ``categories.json``, or a preprocess run
    with the table ``samples``. Empty takes the engine's own folder; without statistics only the form is checked.
    """

    checks: CheckSettings = field(default_factory=CheckSettings)
    """How strict the checks of an answer are."""

    dialect: Literal["auto", "stages", "zero_shot", "mesatask"] = "auto"
    """Form of the prompts: ``stages`` is the one that this project's models are trained on, ``zero_shot`` explains it to models
    that were not, ``mesatask`` is the one that MesaTask's released model was trained with. ``auto`` takes ``zero_shot`` for the
    engine ``openai`` and ``stages`` for the others. The embedded model is always asked in its own form, ``stages``.
    """

    wording: str = ""
    """File with the text of MesaTask's question, for the dialect ``mesatask``; empty takes a text of the same meaning."""

    def dialect_with(self, engine: EngineSettings) -> str:
        """The form of the prompts for an engine."""
        if engine.kind == "embedded":
            return "stages"  # it knows no other prompts than those of its training
        if self.dialect != "auto":
            return self.dialect
        return "zero_shot" if engine.kind == "openai" else "stages"

    def settled(self) -> "ReasonerSettings":
        """Returns the settings with absolute paths, so that they hold in any working directory."""
        return replace(self, statistics=_absolute(self.statistics), wording=_absolute(self.wording))


def load_reasoner(
    engine: EngineSettings, settings: ReasonerSettings | None = None, loaded: Engine | None = None
) -> tuple[SemanticReasoner, InstructionInterpreter | None]:
    """Returns a reasoner, and its interpreter of instructions if the statistics of categories are known.

    ``loaded`` is the engine if it is loaded already, such as in another process.

    Raises:
        ConfigError: The engine, the statistics or the instruction reader cannot be loaded.
    """
    settings = settings or ReasonerSettings()
    statistics = _statistics(engine, settings)
    interpret, check, required, object_check = None, form_check, None, None
    if statistics is not None:
        from models.text_encoder import load_default

        interpret = InstructionInterpreter(statistics, load_default())
        check = ReplyCheck(statistics, interpret, settings.checks)
        required = RequiredObjects(statistics, interpret, settings.checks.most_objects)
        object_check = partial(ObjectCheck.of_question, interpret=interpret, settings=settings.checks)
    is_closed = engine.kind == "embedded"  # it knows only the words of its training
    dialect = prompt_style_of(settings.dialect_with(engine), _text(settings.wording), interpret, is_closed, _requires(engine))
    plan_edit = None
    if is_closed and statistics is not None and interpret is not None:
        from models.semantic_reasoner.edit_planning.planner import EditPlanner

        plan_edit = EditPlanner(interpret, statistics)
    own = interpret if is_closed else None
    reasoner = SemanticReasoner(
        loaded or load_engine(engine),
        check,
        settings.tries,
        engine.reads_reasons,
        own,
        dialect,
        plan_edit,
        required,
        object_check,
    )
    return reasoner, interpret


@cache
def embedded_interpreter() -> InstructionInterpreter:
    """Returns the interpreter of the embedded reasoner, which reads instructions for any system; the same one each time."""
    from models.text_encoder import load_default

    return InstructionInterpreter(CategoryStatistics.load(EMBEDDED), load_default())


def _absolute(path: str) -> str:
    return absolute_uri(path) if path else path


def _text(file: str) -> str:
    try:
        return Path(file).read_text("utf-8") if file else ""
    except (OSError, UnicodeDecodeError) as error:
        raise ConfigError(f"{file}: cannot be read as text ({error})", "config_invalid") from error


def proposal_config(engine: EngineSettings, settings: ReasonerSettings | None = None) -> dict[str, Any]:
    """Returns everything that proposals depend on except questions and seeds, as JSON values.

    A resumed job compares it, so that the rows of two reasoners do not mix. The engine is not loaded.

    Raises:
        ConfigError: The engine or the statistics are missing.
    """
    settings = settings or ReasonerSettings()
    found = engine.shaping() | {
        "tries": settings.tries,
        "checks": settings.checks.shaping(),
        "prompt_version": PROMPT_VERSION,
    }
    if (dialect := settings.dialect_with(engine)) != "stages":
        wording = ZERO_SHOT_SYSTEM if dialect == "zero_shot" else _text(settings.wording) or MESATASK_TEXT
        found |= {"dialect": dialect, "wording": content_id(wording)}
    statistics = _statistics(engine, settings)
    if settings.statistics:  # else they are in the engine's own folder, whose files are hashed with the model
        found["statistics"] = content_id(None if statistics is None else asdict(statistics))
    if statistics is None:
        found["statistics"] = content_id(asdict(CategoryStatistics.load(EMBEDDED)))  # of the reading by which scenes are judged
    found["reader"] = reader_fingerprint()
    return found


def _requires(engine: EngineSettings) -> bool:
    """Whether the engine's model was trained on questions that state what is required."""
    from models.semantic_reasoner.training.hf_folder import NOTES  # it imports transformers, which endpoints do not need

    notes = None if engine.folder is None else engine.folder / NOTES
    if notes is None or not notes.is_file():
        return False
    return bool(read_json(notes).get("settings", {}).get("required_share", 0))


def _statistics(engine: EngineSettings, settings: ReasonerSettings) -> CategoryStatistics | None:
    if settings.statistics:
        folder = Path(settings.statistics)
        is_model = "://" not in settings.statistics and (folder / "categories.json").is_file()
        return CategoryStatistics.load(folder) if is_model else CategoryStatistics.of_run(settings.statistics)
    own = engine.folder
    return CategoryStatistics.load(own) if own is not None and (own / "categories.json").is_file() else None
