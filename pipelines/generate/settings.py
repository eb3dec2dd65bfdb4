"""Settings of the generate job: the reasoner, the retrieval, the schedule of Algorithm 1, and the rule of acceptance."""

from collections.abc import Collection
from dataclasses import asdict, dataclass, field, replace
from typing import Annotated, Any, ClassVar, Literal, cast

from annotated_types import Interval

from models.baselines.systems import CorrectorName, LayoutName
from models.dual_system.algorithm1 import Corrects, LoopSettings
from models.semantic_reasoner.engines.registry import EngineSettings
from models.semantic_reasoner.factory import ReasonerSettings
from models.semantic_reasoner.text.prompt import WANTED, Wanted
from models.settings import Count, NonNegative, Positive, PositiveCount, Share
from pipelines.correct.settings import CorrectorJobSettings
from pipelines.execution.shard_size import shard_size
from stable_data.assets.retrieval_settings import RetrievalSettings
from stable_data.embedded_world.library import NAME as EMBEDDED
from stable_data.errors import ConfigError
from stable_data.scene import Stage
from stable_data.storage.filter_expression import FilterExpression, parse_filter
from stable_data.storage.schemas import SCHEMAS

_FEWEST, _MOST = 16, 128  # scenes of a shard: fewer make small batches for the reasoner, more make a lost worker costly


@dataclass(frozen=True, slots=True)
class GenerateSettings(CorrectorJobSettings):
    """Settings of the generate job, from ``--set key=value`` or the table ``[generate]`` of a TOML file."""

    section: ClassVar[str] = "generate"

    engine: EngineSettings = field(default_factory=EngineSettings)
    """The language model that proposes objects."""

    reasoner: ReasonerSettings = field(default_factory=ReasonerSettings)
    """How the language model is asked."""

    retrieval: RetrievalSettings = field(default_factory=RetrievalSettings)
    """How assets are chosen."""

    only_served: Literal["auto", "always", "never"] = "auto"
    """Whether sampled tasks ask only for objects that the libraries other than ``embedded`` have. ``auto`` does so if ``embedded``
    is not among the libraries.
    """

    layout: LayoutName = "stages"
    """Who lays scenes out: ``stages``, the reasoner by its schedule; ``holodeck`` or ``idesign``, systems that let the language model
    propose objects and relations and find places by a search; ``files``, another system, whose scenes are those of ``layout_files``.
    """

    layout_files: str = ""
    """For ``layout=files``: a run with a table ``scenes``, or a folder in the MesaTask-10K format. The scene of a task is the one with its
    id.
    """

    schedule: str = "task,important,secondary"
    """Stages that are asked for, in order, joined by commas: task, important, secondary; or whole, the one-shot ablation."""

    corrector: CorrectorName = "stable"
    """What corrects scenes: ``stable``, the Physics Corrector; or a post-hoc optimiser: ``steerable``, ``steerable_parts`` (with convex
    parts instead of hulls), ``mesatask``, or ``mesatask_released`` (with the faults of the released program).
    """

    corrects: Corrects = "each"
    """When the corrector is asked: after ``each`` stage (Algorithm 1), once at the ``end``, or ``never``."""

    earlier_move: NonNegative = 10.0
    """Metres; how far a correction may move an object of an earlier stage. 0 fixes it."""

    tries: PositiveCount = 3
    """How often a stage is proposed, at most, where its objects found no assets or no place, or could not stay where the
    instruction says.
    """

    full: Annotated[float, Interval(gt=0, le=1)] = 1.0
    """Share of the table; once this much is covered no further stage is asked for. 1 asks for all stages."""

    density: Share = 0.0
    """Share of the table that objects shall cover: after the schedule, its background stages are repeated until this is reached, up
    to six times, or until nothing more finds a place. 0 repeats none.
    """

    settle: bool = True
    """Whether the last correction simulates physics to find objects that do not stay at rest, and moves them."""

    accept: str = "clean and stable"
    """Condition on the columns of ``scenes`` that an accepted scene meets; the other scenes are in ``rejected``. Empty accepts
    all.
    """

    keep_settled: bool = False
    """Whether the poses after the physics simulation are kept, in the table ``settled``."""

    seed: int = 0
    """Seed of draws and choices; a scene's seed follows from it and from the scene's name."""

    engines: Count = 0
    """Language models that the workers share, each a Ray actor; 0 gives every worker its own. Requests of all workers join one
    running batch. The job starts these models and ends them.
    """

    engine_gpus: NonNegative = 0.0
    """GPUs of each shared language model: a part of one, or a whole number."""

    scenes_per_shard: Count = 0
    """Scenes that are made side by side and stored together; 0 takes an eighth of the tasks, at least 16 and at most 128."""

    num_pictures: Count = 12
    """Scenes that the report shows."""

    core_hour_price: NonNegative = 0.0
    """Price of an hour of one core, for the report's cost of a thousand scenes."""

    seconds_per_item: Positive = 600.0
    """Seconds; a correction that takes longer, or what is read for a scene, is ended. Not enforced without worker processes."""

    def check(self) -> None:
        """Refuses an impossible number of GPUs, and invalid schedules and conditions; see the base class."""
        self.check_correctors(self.section)
        if self.engine_gpus > 1 and not float(self.engine_gpus).is_integer():
            raise ConfigError(
                f"setting {self.section}.engine_gpus is {self.engine_gpus}, expected a fraction of a GPU or a whole number",
                "config_invalid",
            )
        _ = self.loop
        self._check_system()
        self.check_judges(self.section, self.accepting)
        self.check_robot(self.section, self.accepting)

    def _check_system(self) -> None:
        """Refuses layouts and correctors that lack something, or that something asked for would not use."""
        if (self.layout == "files") != bool(self.layout_files):
            what = "is empty" if self.layout == "files" else f"is {self.layout_files!r}, but layout is {self.layout}"
            raise ConfigError(
                f"setting {self.section}.layout_files {what}; layout=files needs a run or a folder there, other layouts need none",
                "config_invalid",
            )
        if self.corrector != "stable" and self.correctors:
            raise ConfigError(
                f"setting {self.section}.correctors is {self.correctors}, but corrector is {self.corrector}, which is not shared; set "
                "correctors to 0, or corrector to stable",
                "config_invalid",
            )
        dialect = self.reasoner.dialect_with(self.engine)
        if dialect == "mesatask" and self.layout == "stages" and self.stages != ("whole",):
            raise ConfigError(
                f"setting {self.section}.schedule is {self.schedule!r}, but the dialect mesatask asks for whole layouts; set schedule to "
                "whole",
                "config_invalid",
            )

    @property
    def stages(self) -> tuple[Wanted, ...]:
        """The stages of the schedule, in order.

        Raises:
            ConfigError: A stage is unknown.
        """
        names = [name.strip() for name in self.schedule.split(",")]
        known = [str(wanted) for wanted in WANTED if wanted != "edit"]
        if unknown := [name for name in names if name not in known]:
            raise ConfigError(
                f"setting {self.section}.schedule has {unknown[0]!r}, expected some of {', '.join(known)}", "config_invalid"
            )
        return tuple(Stage(name) if name in set(Stage) else cast(Wanted, name) for name in names)

    @property
    def chats(self) -> bool:
        """Whether the language model answers prompts of other systems; the embedded one knows those of its training alone."""
        return self.engine.kind != "embedded"

    @property
    def loop(self) -> LoopSettings:
        """The settings of Algorithm 1."""
        return LoopSettings(self.stages, self.corrects, self.earlier_move, self.tries, self.full, self.density)

    @property
    def accepting(self) -> FilterExpression | None:
        """The rule of acceptance, or None to accept all scenes."""
        return parse_filter(self.accept, SCHEMAS["scenes"]) if self.accept.strip() else None

    def draws_served(self, places: Collection[str]) -> bool:
        """Whether sampled tasks ask only for what the libraries have."""
        is_foreign = bool(places) and EMBEDDED not in places
        return self.only_served == "always" or (self.only_served == "auto" and is_foreign)

    def serving_advice(self, places: Collection[str]) -> str:
        """What a user may do if the libraries other than ``embedded`` serve no sampled task."""
        more = "name more libraries" if set(places) - {EMBEDDED} else "name a library other than embedded"
        if self.only_served == "auto":
            return f"{more}, add --assets embedded, or set only_served=never"
        return f"{more}, or set only_served={'auto' if not places or EMBEDDED in places else 'never'}"

    def of_tasks(self, count: int) -> "GenerateSettings":
        """The settings with the shard size for a number of tasks."""
        return replace(self, scenes_per_shard=self.scenes_per_shard or shard_size(count, parts=8, fewest=_FEWEST, most=_MOST))

    def shaping(self) -> dict[str, Any]:
        """The settings that shape rows, without those of the reasoner; a run is resumed only if they are equal."""
        aside = (
            "engine",
            "reasoner",
            "num_pictures",
            "core_hour_price",
            "engines",
            "engine_gpus",
            "correctors",
            "corrector_gpus",
            "seconds_per_item",
            "device",
            "layout_files",  # whose content is an input
        )
        own = {k: v for k, v in asdict(self).items() if k not in aside}
        licences = self.retrieval.licences
        own["retrieval"]["licences"] = None if licences is None else sorted(licences)  # JSON has no sets
        # A worker's own engine answers in another order, which forms other batches of the corrector and can change rounding.
        return own | {"shares_engines": self.engines > 0} | self.shaping_shared()
