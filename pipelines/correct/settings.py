"""Settings of the correct job: what shapes its rows, and what does not."""

from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any, ClassVar, Self

from pipelines.preprocess.scene import SceneSettings
from pipelines.sources.scenes import SceneSource
from stable_data.errors import ConfigError
from stable_data.mesatask import PositionConvention
from stable_data.scene import Scene


@dataclass(frozen=True, slots=True)
class CorrectSettings:
    """Settings of the job; ``--set key=value`` or the table ``[correct]`` of a TOML file.

    Attributes:
        weights: The corrector: ``auto`` is the one in the repository, ``none`` certifies alone, else a file.
        steps: Steps of the flow; 0 as its weights say.
        when_full: What happens where not everything fits: ``drop`` the least important background object, or ``infeasible``.
        restore: Whether the scene graph's on and in relations are restored where the layout broke them.
        fixed: Categories or instances that must stay, joined by commas.
        settle: Whether the physics engine is asked what stays at rest, and what does not is put where it does, if that is
            found.
        judge_raw: Whether the raw result of the flow is audited too.
        important_threshold: Objects nearer than this to a task object are O^B, metres.
        seed: For task templates and splits.
        position_convention: ``box_centre``, ``mesh_centre``, or ``auto``: judged on the dataset.
        scenes_per_shard: Scenes of one shard, where they come from a folder.
        write_dataset: Whether the corrected scenes of a folder are written in its format too, beside the tables.
        num_pictures: Scenes drawn in the report, before and after.
        seconds_per_item: A scene that takes longer is a failure; not watched without worker processes.
    """

    section: ClassVar[str] = "correct"

    weights: str = "auto"
    steps: int = 0
    when_full: str = "drop"
    restore: bool = True
    fixed: str = ""
    settle: bool = False
    judge_raw: bool = True
    important_threshold: float = 0.02
    seed: int = 0
    position_convention: str = "auto"
    scenes_per_shard: int = 32
    write_dataset: bool = True
    num_pictures: int = 8
    seconds_per_item: float = 600.0

    def __post_init__(self) -> None:
        """Refuses settings that no run can follow."""
        if self.when_full not in ("drop", "infeasible"):
            raise ConfigError(
                f"setting {self.section}.when_full is {self.when_full}, expected drop or infeasible", "config_invalid"
            )
        if self.position_convention not in ("auto", *PositionConvention):
            found = f"setting {self.section}.position_convention is {self.position_convention}"
            raise ConfigError(f"{found}, expected auto, box_centre or mesh_centre", "config_invalid")
        for key in ("important_threshold", "scenes_per_shard", "seconds_per_item"):
            if getattr(self, key) <= 0:
                found = f"setting {self.section}.{key} is {getattr(self, key)}"
                raise ConfigError(f"{found}, expected a positive number", "config_invalid")
        if self.steps < 0:
            raise ConfigError(f"setting {self.section}.steps is {self.steps}, expected 0 or more", "config_invalid")

    def shaping(self) -> dict[str, Any]:
        """The settings that shape rows: a run is resumed only under the same."""
        aside = ("num_pictures", "seconds_per_item", "write_dataset")
        return {k: v for k, v in asdict(self).items() if k not in aside}

    def scene_settings(self) -> SceneSettings:
        """Those of reading a scene."""
        convention = PositionConvention(self.position_convention)  # settled() has replaced auto
        return SceneSettings(self.important_threshold, self.seed, position_convention=convention)

    def settled(self, source: SceneSource) -> Self:
        """The settings with ``auto`` replaced: what positions mean, and where the weights are."""
        settings = self
        if settings.position_convention == "auto":
            settings = replace(settings, position_convention=str(source.position_convention()))
        if settings.weights not in ("auto", "none"):
            settings = replace(settings, weights=str(Path(settings.weights).expanduser().resolve()))
        return settings

    def fixed_in(self, scene: Scene) -> frozenset[str]:
        """The instances of a scene that must stay."""
        names = {name.strip() for name in self.fixed.split(",")}
        return frozenset(o.instance for o in scene.objects if {o.instance, o.category} & names)
