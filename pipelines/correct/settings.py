"""Settings of the correct job: which of them shape its rows."""

from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any, ClassVar, Literal, Self, cast

from models.physics_corrector.corrector import Polish, Purpose
from models.physics_corrector.flow.expected_error import ExpectedError
from models.settings import Count, NonNegative, Positive, Settings
from pipelines.execution.shard_size import shard_size
from pipelines.preprocess.convention import ConventionChoice
from pipelines.preprocess.scene import SceneSettings
from pipelines.sources.scenes import SceneSource
from stable_data.errors import ConfigError
from stable_data.judges.registry import check_judges, judge_names
from stable_data.mesatask import PositionConvention
from stable_data.metrics.judge_columns import columns_not_filled
from stable_data.metrics.reach_columns import reach_columns_not_filled
from stable_data.robot.arm.mounting import AUTO, parse_mount
from stable_data.robot.arm.robots import robot_named
from stable_data.scene import Scene
from stable_data.storage.filter_expression import FilterExpression


@dataclass(frozen=True, slots=True, kw_only=True)
class CorrectorJobSettings(Settings):
    """Settings of all jobs that use the Physics Corrector."""

    weights: str = "auto"
    """Weights of the corrector: ``auto`` is the file in models/weights, ``none`` uses the certifier alone, else a file."""

    steps: Count = 0
    """Solver steps of the flow; 0 takes the number that is stored with the weights."""

    device: str = "cpu"
    """Device of flow and refinement, such as cpu or cuda. Batches that do not fit into its memory are halved. Workers reserve no GPU,
    so each would load its own flow on the first one: name ``correctors`` too.
    """

    correctors: Count = 0
    """Flows and refinements that the workers share, each a Ray actor; 0 gives every worker its own. The scenes of all workers that
    wait become one batch.
    """

    corrector_gpus: NonNegative = 0.0
    """GPUs of each shared flow and refinement: a part of one, or a whole number."""

    refine: bool = False
    """Whether layouts are refined in batches after the flow. Four of five need no certification then, but on a CPU that takes longer
    than certification alone.
    """

    polish: Polish = "certify"
    """What follows the flow: ``certify`` certifies what the refinement leaves, ``verify`` only audits the refined scenes, ``off``
    publishes the result of the flow itself. Scenes that are not clean then have the status ``unclean``.
    """

    judges: str = "mujoco"
    """Physics engines that judge whether the final scene stays at rest, joined by commas: mujoco, sapien (PhysX), drake. Empty: none.
    Each has columns in ``scenes``.
    """

    arbiter: str = ""
    """A further judge, such as drake, which is asked only about scenes on which the others disagree; empty: none."""

    robust_rest: Count = 0
    """Number of repetitions of MuJoCo's verdict with other frictions, masses, time steps and a nudge, for the column
    ``stable_share``; 0: none.
    """

    robot: str = ""
    """The robot whose reach and grasps are surveyed in each scene, for the columns ``task_reachable`` and others and the table ``grasps``:
    panda, panda_2f85, so101 or simple (``stable-data robots`` lists them). Empty: none.
    """

    mount: str = AUTO
    """Where the robot stands: ``auto``, an edge of the table (front, left, right, back), or an edge and a share of its length, such as
    ``front:0.25``.
    """

    grasp_tries: Count = 3
    """Grasps of each object that are tried in simulation; 0 tries none, so that ``task_graspable`` is unknown."""

    @property
    def judge_names(self) -> tuple[str, ...]:
        """The judges, in order."""
        return judge_names(self.judges)

    def check_judges(self, section: str, condition: FilterExpression | None = None) -> None:
        """Refuses unknown judges, an arbiter that has nothing to decide, and a condition on verdicts that no judge gives.

        Raises:
            ConfigError: See above (``config_invalid``), or the package of a judge is not installed (``judge_missing``).
        """
        names = [*check_judges(self.judges, self.arbiter, section), *([self.arbiter] if self.arbiter else [])]
        if condition is not None:
            missing = columns_not_filled(condition.columns, names, self.robust_rest > 0)
            for column, judge in missing.items():
                what = (
                    "robust_rest is 0; set it to 8"
                    if judge == "robust_rest"
                    else f"judges is {self.judges!r}; add {judge} to it"
                )
                raise ConfigError(
                    f"setting {section}.accept is {condition.text!r}, but nothing fills the column {column}: {what}, or change accept",
                    "config_invalid",
                )

    def check_robot(self, section: str, condition: FilterExpression | None = None) -> None:
        """Refuses unknown robots and mounts, and a condition on what no survey fills.

        Raises:
            ConfigError: See above (``setting_invalid`` or ``config_invalid``), or the robot's package is missing (``robot_missing``).
        """
        if self.robot:
            robot_named(self.robot)
            parse_mount(self.mount)
        if condition is not None:
            for column, key in reach_columns_not_filled(condition.columns, self.robot, self.grasp_tries).items():
                what = "robot is empty; set it to panda" if key == "robot" else "grasp_tries is 0; set it to 3"
                raise ConfigError(
                    f"setting {section}.accept is {condition.text!r}, but nothing fills the column {column}: {what}, or change accept",
                    "config_invalid",
                )

    def shaping_shared(self) -> dict[str, Any]:
        """What shared correctors add to the settings that shape rows: batches with scenes of other shards can change rounding."""
        return {"shares_correctors": self.correctors > 0}

    def alone(self) -> Self:
        """The settings of a separate process, which cannot reach the shared correctors: these have the GPUs."""
        return replace(self, device="cpu", correctors=0, corrector_gpus=0.0) if self.correctors else self

    def check_correctors(self, section: str) -> None:
        """Refuses numbers of GPUs that are impossible, or that nothing would use.

        Raises:
            ConfigError: See above (``config_invalid``).
        """
        gpus = self.corrector_gpus
        if gpus > 1 and not float(gpus).is_integer():
            raise ConfigError(
                f"setting {section}.corrector_gpus is {gpus}, expected a fraction of a GPU or a whole number", "config_invalid"
            )
        if gpus and not self.correctors:
            raise ConfigError(
                f"setting {section}.corrector_gpus is {gpus:g}, but correctors is 0; set correctors, or corrector_gpus to 0",
                "config_invalid",
            )
        if gpus and self.device == "cpu":
            raise ConfigError(
                f"setting {section}.corrector_gpus is {gpus:g}, but device is cpu; set device to cuda, or corrector_gpus to 0",
                "config_invalid",
            )


@dataclass(frozen=True, slots=True)
class CorrectSettings(CorrectorJobSettings):
    """Settings of the correct job, from ``--set key=value`` or the table ``[correct]`` of a TOML file."""

    section: ClassVar[str] = "correct"

    purpose: Purpose = "repair"
    """``repair``: layouts are meant as they are, objects move only as far as a clean layout needs, and directions between objects
    are kept. ``rearrange``: objects go where the flow finds that they belong; supports, and directions that the task states, stay.
    """

    position_error: NonNegative = 0.0
    """Metres; expected error of positions along x and along y, which the flow is told. 0: unknown."""

    yaw_error: NonNegative = 0.0
    """Radians; expected error of yaws, which the flow is told. 0: unknown."""

    when_full: Literal["drop", "infeasible"] = "drop"
    """What happens where not all objects fit: ``drop`` removes the least important background object, ``infeasible`` reports
    it.
    """

    restore: bool = True
    """Whether the scene graph's relations on and in are restored where the layout breaks them."""

    fixed: str = ""
    """Categories or instances that must not move, joined by commas."""

    judges: str = ""
    """Physics engines that judge whether the final scene stays at rest, joined by commas: mujoco, sapien (PhysX), drake. Empty: none.
    Each has columns in ``scenes``.
    """

    settle: bool = False
    """Whether physics is simulated to find objects that do not stay at rest; those are moved to a place where they do, if one
    is found.
    """

    judge_raw: bool = True
    """Whether the flow's result is audited too, before it is certified."""

    important_threshold: Positive = 0.02
    """Metres; objects nearer than this to a task object are O^B."""

    seed: int = 0
    """Seed of task templates and splits."""

    position_convention: ConventionChoice = "auto"
    """What a position in the dataset is the centre of: ``box_centre``, ``mesh_centre``, or ``auto``, which decides from the
    dataset.
    """

    scenes_per_shard: Count = 0
    """Scenes of a shard, at most; 0 takes an eighth of all scenes, but at least 4 and at most 32."""

    write_dataset: bool = True
    """Whether corrected scenes of a folder are also written in the folder's format, beside the tables."""

    num_pictures: Count = 8
    """Scenes that the report shows, before and after."""

    seconds_per_item: Positive = 600.0
    """Seconds; a scene that takes longer is a failure. Not enforced without worker processes."""

    def check(self) -> None:
        """Refuses a simulation after no certification, which would not take place, and a rearrangement without a flow."""
        self.check_correctors(self.section)
        self.check_judges(self.section)
        self.check_robot(self.section)
        if self.purpose == "rearrange" and self.weights == "none":
            raise ConfigError(
                f"setting {self.section}.purpose is rearrange, but weights is none: nothing knows where things belong, expected weights; "
                "set weights to auto, or purpose to repair",
                "config_invalid",
            )
        if self.settle and self.polish != "certify":
            raise ConfigError(
                f"setting {self.section}.settle needs certification, but polish is {self.polish}; "
                "set polish to certify, or settle to false",
                "config_invalid",
            )

    def shaping(self) -> dict[str, Any]:
        """The settings that shape rows; a run is resumed only if they are equal."""
        aside = ("num_pictures", "seconds_per_item", "write_dataset", "device", "correctors", "corrector_gpus")
        return {k: v for k, v in asdict(self).items() if k not in aside} | self.shaping_shared()

    def scene_settings(self) -> SceneSettings:
        """The settings for reading a scene."""
        convention = PositionConvention(self.position_convention)  # settled() has replaced auto
        return SceneSettings(self.important_threshold, self.seed, position_convention=convention)

    def settled(self, source: SceneSource) -> Self:
        """The settings with the position convention resolved and an absolute path of the weights."""
        settings = self
        if settings.position_convention == "auto":
            settings = replace(settings, position_convention=cast(ConventionChoice, str(source.position_convention())))
        if settings.weights not in ("auto", "none"):
            settings = replace(settings, weights=str(Path(settings.weights).expanduser().resolve()))
        return settings

    def error(self) -> ExpectedError:
        """What the flow is told of the errors of layouts."""
        return ExpectedError(self.position_error or None, self.yaw_error or None)

    def of_items(self, count: int) -> Self:
        """The settings with the shard size for a number of items."""
        return replace(self, scenes_per_shard=self.scenes_per_shard or shard_size(count, parts=8, fewest=4, most=32))

    def fixed_in(self, scene: Scene) -> frozenset[str]:
        """The instances of a scene that must stay."""
        names = {name.strip() for name in self.fixed.split(",")}
        return frozenset(o.instance for o in scene.objects if {o.instance, o.category} & names)
