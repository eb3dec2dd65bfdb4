"""Settings of the edit job: those of correcting, and what is asked of the reasoner."""

from dataclasses import dataclass
from typing import Any, ClassVar

from pipelines.correct_settings import CorrectSettings
from stable_data.errors import ConfigError

OTHERS = ("fixed", "free", "fixed_first")
"""What may become of things that an edit does not name."""


@dataclass(frozen=True, slots=True)
class EditSettings(CorrectSettings):
    """Settings of the job; ``--set key=value`` or the table ``[edit]`` of a TOML file.

    ``scenes_per_shard`` counts edits; ``when_full`` is ``infeasible``, so that nothing goes that was not asked to.

    Attributes:
        when_full: What happens where not everything fits: ``infeasible``, or ``drop`` the least important background object.
        correct: Whether the edited scene is corrected; else it is as the reply has it.
        others: Things that the edit does not name: ``fixed`` never move, ``free`` may, ``fixed_first`` move only where no clean
            layout is found otherwise, those first that are in the way or at fault themselves; a warning names them.
        attempts: How often the reasoner is asked until its reply can be used.
        temperature: Of its draws; 0 takes the likeliest token.
        max_tokens: Longest reply.
    """

    section: ClassVar[str] = "edit"

    when_full: str = "infeasible"
    correct: bool = True
    others: str = "fixed_first"
    attempts: int = 3
    temperature: float = 0.0
    max_tokens: int = 4096

    def __post_init__(self) -> None:
        """Refuses settings that no run can follow."""
        CorrectSettings.__post_init__(self)
        if self.others not in OTHERS:
            raise ConfigError(f"setting edit.others is {self.others}, expected one of {', '.join(OTHERS)}", "config_invalid")
        for key in ("attempts", "max_tokens"):
            if getattr(self, key) < 1:
                raise ConfigError(f"setting edit.{key} is {getattr(self, key)}, expected 1 or more", "config_invalid")
        if not 0 <= self.temperature <= 2:
            raise ConfigError(f"setting edit.temperature is {self.temperature}, expected 0 to 2", "config_invalid")

    def shaping(self) -> dict[str, Any]:
        """The settings that shape rows: a run is resumed only under the same."""
        return CorrectSettings.shaping(self)
