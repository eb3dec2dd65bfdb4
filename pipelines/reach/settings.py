"""Settings of jobs with a robot; and those of the reach job, what it tries."""

from dataclasses import asdict, dataclass
from typing import Any, ClassVar

from models.settings import Count, Positive, Settings
from pipelines.execution.shard_size import shard_size
from stable_data.robot.arm.mounting import AUTO, parse_mount
from stable_data.robot.arm.robots import described_robot
from stable_data.robot.reach import ReachOptions

_PARTS, _FEWEST, _MOST = 16, 1, 16  # shards of a small job, scenes of a shard


@dataclass(frozen=True, slots=True)
class RobotSettings(Settings):
    """Settings of jobs in which a robot acts in scenes: which one, and where it stands."""

    section: ClassVar[str] = ""
    ASIDE: ClassVar[tuple[str, ...]] = ("seconds_per_item",)
    """Settings that shape no rows."""

    robot: str = "panda"
    """The robot: ``panda``, ``panda_2f85``, ``so101`` or ``simple``; ``stable-data robots`` lists them."""

    mount: str = AUTO
    """Where the robot stands: ``auto``, an edge of the table (``front``, ``left``, ``right``, ``back``), or an edge and a share of its
    length, such as ``front:0.25``.
    """

    scenes_per_shard: Count = 0
    """Scenes of a shard. 0: by the number of scenes."""

    seconds_per_item: Positive = 300.0
    """Seconds; a scene or episode that takes longer is a failure. Not enforced without worker processes."""

    def check(self) -> None:
        """Refuses robots and mounts that do not exist.

        Raises:
            ConfigError: See above (``setting_invalid``).
        """
        described_robot(self.robot)
        parse_mount(self.mount)

    def shaping(self) -> dict[str, Any]:
        """The settings that shape rows; a run is resumed only if they are equal."""
        return {k: sorted(v) if isinstance(v, frozenset) else v for k, v in asdict(self).items() if k not in self.ASIDE}

    def shard_size(self, num_scenes: int) -> int:
        """Scenes of a shard."""
        return self.scenes_per_shard or shard_size(num_scenes, parts=_PARTS, fewest=_FEWEST, most=_MOST)


@dataclass(frozen=True, slots=True)
class ReachSettings(RobotSettings):
    """Settings of the reach job, from ``--set key=value`` or the table ``[reach]`` of a TOML file."""

    section: ClassVar[str] = "reach"

    grasp_tries: Count = 3
    """Grasps of each object that are tried in simulation; 0 tries none, so that ``task_graspable`` is unknown."""

    all_objects: bool = False
    """Whether objects that the task does not need are surveyed too."""

    def options(self) -> ReachOptions:
        """What is looked at in each scene."""
        return ReachOptions(self.mount, self.grasp_tries, self.all_objects)
