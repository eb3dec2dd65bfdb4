"""Settings of the generate job: who proposes, how assets are chosen, how the two systems take turns, and what is accepted."""

from dataclasses import asdict, dataclass, field, replace
from typing import Any, ClassVar, cast

from models.dual_system.requests import Corrects, LoopSettings
from models.semantic_reasoner.engines.registry import EngineSettings
from models.semantic_reasoner.factory import ReasonerSettings
from models.semantic_reasoner.text.prompt import WANTED, Wanted
from stable_data.assets.ranking import RetrievalSettings
from stable_data.errors import ConfigError
from stable_data.scene import Stage
from stable_data.storage.filter_expression import FilterExpression, parse_filter
from stable_data.storage.schemas import SCHEMAS

_FEWEST, _MOST = 16, 128  # scenes of a shard: with fewer the reasoner's batches are small, with more a lost worker costs much


@dataclass(frozen=True, slots=True)
class GenerateSettings:
    """Settings of the job; ``--set key=value`` or the table ``[generate]`` of a TOML file.

    Attributes:
        engine: Who proposes.
        reasoner: How it is asked.
        retrieval: How assets are chosen.
        schedule: What is asked for, in order, joined by commas: task, important, secondary, or whole (the one-shot ablation).
        corrects: When the corrector is asked: after each stage (``each``, Algorithm 1), once at the ``end``, or ``never``.
        earlier_move: How far a correction may move what stood there before its stage, metres; 0 holds it.
        tries: How often a stage is proposed at most where what it proposed found no assets or no place, or could not stay
            where the instruction says.
        full: Share of the table that may be covered before no further stage is asked for; 1 asks for all.
        weights: The corrector: ``auto`` is the one in the repository, ``none`` certifies alone, else a file.
        steps: Steps of the flow; 0 as its weights say.
        settle: Whether the last correction asks the physics engine what stays at rest, and mends what does not.
        accept: Which scenes are accepted, a condition on the columns of ``scenes``; the others are in ``rejected``. Empty: all.
        keep_settled: Whether the poses in which the physics engine left the objects are kept, in the table ``settled``.
        seed: Of draws and choices; a scene's own seed follows from it and from the scene's name.
        engines: Engines that the workers share, each an actor of Ray; 0: every worker has its own.
        engine_gpus: GPUs of each of these: a part of one, or whole ones.
        scenes_per_shard: Scenes that are made side by side, and kept together; 0: a quarter of the tasks, but 16 to 128, so
            that small jobs keep several workers busy and large ones fill their batches.
        num_pictures: Scenes drawn in the report.
        core_hour_price: What a core costs an hour, for the report's cost of a thousand scenes.
        seconds_per_item: A correction that takes longer is given up; not watched without worker processes.
    """

    section: ClassVar[str] = "generate"

    engine: EngineSettings = field(default_factory=EngineSettings)
    reasoner: ReasonerSettings = field(default_factory=ReasonerSettings)
    retrieval: RetrievalSettings = field(default_factory=RetrievalSettings)
    schedule: str = "task,important,secondary"
    corrects: Corrects = "each"
    earlier_move: float = 10.0
    tries: int = 3
    full: float = 1.0
    weights: str = "auto"
    steps: int = 0
    settle: bool = True
    accept: str = "clean and stable"
    keep_settled: bool = False
    seed: int = 0
    engines: int = 0
    engine_gpus: float = 0.0
    scenes_per_shard: int = 0
    num_pictures: int = 12
    core_hour_price: float = 0.0
    seconds_per_item: float = 600.0

    def __post_init__(self) -> None:
        """Refuses settings that no run can follow."""
        if self.scenes_per_shard < 0 or self.num_pictures < 0 or not self.seconds_per_item > 0 or self.steps < 0:
            found = f"scenes_per_shard is {self.scenes_per_shard}, num_pictures {self.num_pictures}, steps {self.steps}, "
            found += f"seconds_per_item {self.seconds_per_item}"
            raise ConfigError(f"{found}, expected none negative, and a positive number", "config_invalid")
        is_part_or_whole = 0 <= self.engine_gpus <= 1 or float(self.engine_gpus).is_integer()
        if self.engines < 0 or not (self.engine_gpus >= 0 and is_part_or_whole):
            found = f"engines is {self.engines} and engine_gpus {self.engine_gpus}"
            raise ConfigError(f"{found}, expected none negative, and a part of a GPU or whole ones", "config_invalid")
        _ = self.loop, self.accepting

    @property
    def stages(self) -> tuple[Wanted, ...]:
        """What is asked for, in order.

        Raises:
            ConfigError: A stage is not known.
        """
        names = [name.strip() for name in self.schedule.split(",")]
        known = [str(wanted) for wanted in WANTED if wanted != "edit"]
        if unknown := [name for name in names if name not in known]:
            raise ConfigError(
                f"setting {self.section}.schedule has {unknown[0]!r}, expected some of {', '.join(known)}", "config_invalid"
            )
        return tuple(Stage(name) if name in set(Stage) else cast(Wanted, name) for name in names)

    @property
    def loop(self) -> LoopSettings:
        """How the two systems take turns."""
        return LoopSettings(self.stages, self.corrects, self.earlier_move, self.tries, self.full)

    @property
    def accepting(self) -> FilterExpression | None:
        """Which scenes are accepted; None: all."""
        return parse_filter(self.accept, SCHEMAS["scenes"]) if self.accept.strip() else None

    def of_tasks(self, count: int) -> "GenerateSettings":
        """The same with as many scenes a shard as a number of tasks makes it."""
        return replace(self, scenes_per_shard=self.scenes_per_shard or min(_MOST, max(_FEWEST, -(-count // 4))))

    def shaping(self) -> dict[str, Any]:
        """The settings that shape rows beside the reasoner's own: a run is resumed only under the same."""
        aside = ("engine", "reasoner", "num_pictures", "core_hour_price", "engines", "engine_gpus", "seconds_per_item")
        own = {k: v for k, v in asdict(self).items() if k not in aside}
        licences = self.retrieval.licences
        own["retrieval"]["licences"] = None if licences is None else sorted(licences)  # JSON has no sets
        # A shared engine answers batch by batch, which may round otherwise than a worker's own.
        return own | {"shares_engines": self.engines > 0}
