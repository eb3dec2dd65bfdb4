"""Settings of the edit job: those of correcting, and who is asked and how."""

from dataclasses import dataclass, field, replace
from typing import Any, ClassVar, Self

from models.semantic_reasoner.engines.registry import EngineSettings
from models.semantic_reasoner.factory import ReasonerSettings
from pipelines.correct.settings import CorrectSettings
from pipelines.sources.scenes import SceneSource
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
        engine: Who is asked; opened where an edit has no reply.
        reasoner: How it is asked.
    """

    section: ClassVar[str] = "edit"

    when_full: str = "infeasible"
    correct: bool = True
    others: str = "fixed_first"
    engine: EngineSettings = field(default_factory=EngineSettings)
    reasoner: ReasonerSettings = field(default_factory=ReasonerSettings)

    def __post_init__(self) -> None:
        """Refuses settings that no run can follow."""
        CorrectSettings.__post_init__(self)
        if self.others not in OTHERS:
            raise ConfigError(f"setting edit.others is {self.others}, expected one of {', '.join(OTHERS)}", "config_invalid")

    def shaping(self) -> dict[str, Any]:
        """The settings that shape rows: a run is resumed only under the same.

        What of the reasoner does is an input, by its content (:func:`models.semantic_reasoner.factory.shaping_of_proposals`).
        """
        return {k: v for k, v in CorrectSettings.shaping(self).items() if k not in ("engine", "reasoner")}

    def settled(self, source: SceneSource) -> Self:
        """The settings with ``auto`` replaced, and with paths that workers elsewhere can follow."""
        return replace(CorrectSettings.settled(self, source), engine=self.engine.settled(), reasoner=self.reasoner.settled())
