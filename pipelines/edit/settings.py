"""Settings of the edit job: those of correct, and those of the reasoner."""

from dataclasses import dataclass, field, replace
from typing import Any, ClassVar, Literal, Self

from models.semantic_reasoner.engines.registry import EngineSettings
from models.semantic_reasoner.factory import ReasonerSettings
from pipelines.correct.settings import CorrectSettings
from pipelines.sources.scenes import SceneSource
from stable_data.errors import ConfigError


@dataclass(frozen=True, slots=True)
class EditSettings(CorrectSettings):
    """Settings of the edit job, from ``--set key=value`` or the table ``[edit]`` of a TOML file.

    ``scenes_per_shard`` counts edits. The default of ``when_full`` is ``infeasible``, so that no other object is removed.
    """

    section: ClassVar[str] = "edit"

    when_full: Literal["drop", "infeasible"] = "infeasible"
    """What happens where not all objects fit: ``infeasible`` reports it, ``drop`` removes the least important background
    object.
    """

    correct: bool = True
    """Whether the edited scene is corrected; otherwise it is stored as the reply states it."""

    others: Literal["fixed", "free", "fixed_first"] = "fixed_first"
    """Objects that the edit does not name: ``fixed`` never move, ``free`` may move, ``fixed_first`` move only where no clean
    layout is found otherwise, those in the way or at fault first; a warning names them.
    """

    engine: EngineSettings = field(default_factory=EngineSettings)
    """The language model that is asked where an edit has no reply."""

    reasoner: ReasonerSettings = field(default_factory=ReasonerSettings)
    """How the language model is asked."""

    def check(self) -> None:
        """Refuses edits without certification, which alone knows what an edit asks for, and with a rearrangement; see the base class."""
        CorrectSettings.check(self)
        if self.polish != "certify":
            raise ConfigError(f"setting {self.section}.polish is {self.polish}, expected certify for edits", "config_invalid")
        if self.purpose != "repair":
            raise ConfigError(f"setting {self.section}.purpose is {self.purpose}, expected repair for edits", "config_invalid")

    def shaping(self) -> dict[str, Any]:
        """The settings that shape rows; a run is resumed only if they are equal.

        The configuration of the reasoner is compared as an input (:func:`models.semantic_reasoner.factory.proposal_config`).
        """
        return {k: v for k, v in CorrectSettings.shaping(self).items() if k not in ("engine", "reasoner")}

    def settled(self, source: SceneSource) -> Self:
        """The settings with the position convention resolved and absolute paths, which workers on all nodes can open."""
        return replace(CorrectSettings.settled(self, source), engine=self.engine.settled(), reasoner=self.reasoner.settled())
