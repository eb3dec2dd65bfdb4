"""Settings of episodes, the robot, what it sees, and how they vary; and those of the demonstrate job."""

from dataclasses import asdict, dataclass, field
from typing import ClassVar, Literal

from models.settings import Count, NonNegative, PositiveCount, Settings, Share
from pipelines.reach.settings import RobotSettings
from stable_data.errors import ConfigError
from stable_data.json_text import quote_value
from stable_data.robot.arm.assembly import CAMERAS
from stable_data.robot.arm.control import CONTROLS
from stable_data.robot.env import RobotOptions
from stable_data.robot.randomization import RandomizationOptions


@dataclass(frozen=True, slots=True)
class VariationSettings(Settings):
    """What is varied from episode to episode, by its seed; 0 varies nothing."""

    light: Share = 0.0
    """Largest change of the brightness of the lights, as a share, and of their direction."""

    colours: Share = 0.0
    """Largest change of each colour, as a share."""

    friction: Share = 0.0
    """Largest change of the friction of each object, as a share."""

    mass: Share = 0.0
    """Largest change of the mass of each object, as a share."""

    cameras: NonNegative = 0.0
    """Metres; standard deviation of the positions of the cameras. Their directions vary by a tenth of it in radians."""

    start: NonNegative = 0.02
    """Radians; standard deviation of the joints at the start."""


@dataclass(frozen=True, slots=True)
class EpisodeSettings(RobotSettings):
    """Settings of jobs that make episodes: the robot, what it sees, its task, and how episodes vary."""

    ASIDE: ClassVar[tuple[str, ...]] = ("num_pictures", "seconds_per_item")

    control: str = "ee_delta"
    """What an action commands beside the opening of the hand: ``ee_delta``, ``ee``, ``joint_delta`` or ``joint``."""

    cameras: frozenset[str] = frozenset()
    """Cameras whose pictures are recorded: ``wrist``, ``front``, ``top``."""

    image_width: PositiveCount = 128
    """Pixels of a picture along a row."""

    image_height: PositiveCount = 128
    """Pixels of a picture along a column."""

    task: Literal["scene", "pick"] = "scene"
    """The task of an episode: that of the ``scene``, or to ``pick`` up an object that is drawn by the episode's seed among those that
    the robot reaches.
    """

    shadows: bool = False
    """Whether pictures have shadows, which take five times as long without a graphics card."""

    episodes: PositiveCount = 1
    """Episodes of each scene; their seeds differ."""

    max_steps: PositiveCount = 600
    """Longest episode, actions."""

    variation: VariationSettings = field(default_factory=VariationSettings)
    """What is varied from episode to episode."""

    settled: bool = False
    """Whether objects start where they settled (table ``settled``) instead of at their poses in the scene."""

    seed: int = 0
    """Seed of all choices; an episode's seed follows from it and from the episode's name."""

    num_pictures: Count = 24
    """Episodes that the report shows."""

    def check(self) -> None:
        """Refuses names that do not exist.

        Raises:
            ConfigError: See above (``setting_invalid``).
        """
        RobotSettings.check(self)  # super() does not work in a class with slots
        if self.control not in CONTROLS:
            raise ConfigError(
                f"setting {self.section}.control is {quote_value(self.control)}, expected one of {', '.join(CONTROLS)}",
                "setting_invalid",
            )
        if strange := sorted(self.cameras - set(CAMERAS)):
            raise ConfigError(
                f"setting {self.section}.cameras has {quote_value(strange[0])}, expected some of {', '.join(CAMERAS)}",
                "setting_invalid",
            )

    def options(self) -> RobotOptions:
        """The robot as the environment takes it."""
        return RobotOptions(
            robot=self.robot,
            mount=self.mount,
            control=self.control,
            cameras=tuple(name for name in CAMERAS if name in self.cameras),
            image_size=(self.image_width, self.image_height),
            shadows=self.shadows,
            max_steps=self.max_steps,
            randomization=RandomizationOptions(**asdict(self.variation)),
        )


@dataclass(frozen=True, slots=True)
class DemonstrateSettings(EpisodeSettings):
    """Settings of the demonstrate job, from ``--set key=value`` or the table ``[demonstrate]`` of a TOML file."""

    section: ClassVar[str] = "demonstrate"

    noise: Share = 0.0
    """Standard deviation of what is added to each action, as a share of the largest action: the expert corrects it, so that policies
    see how to come back.
    """

    lead: str = ""
    """A policy that acts before the expert in each episode, so that there are demonstrations from where the policy comes to: a folder
    of train-policy, or ``module:function``. Its actions are not recorded. Empty: none.
    """

    lead_actions: Count = 120
    """Actions of that policy at most; their number is drawn from 0 to this."""
