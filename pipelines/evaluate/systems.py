"""The systems of an evaluation: what was asked for, as settings of the job ``generate``."""

import re
from collections.abc import Iterable
from dataclasses import asdict, dataclass

from models.baselines.systems import SYSTEMS, ComparedSystem, system_named
from models.settings import fill_settings
from pipelines.generate.settings import GenerateSettings
from stable_data.errors import ConfigError
from stable_data.json_text import quote_value

_SEED = "{seed}"
_LABEL = re.compile(r"[A-Za-z0-9][A-Za-z0-9_.-]{0,63}")


@dataclass(frozen=True, slots=True)
class EvaluatedSystem:
    """A system of an evaluation.

    Attributes:
        label: Its name in tables, and of its folder.
        name: Its name in :data:`models.baselines.systems.SYSTEMS`.
        given: Its engine, or for ``files`` the place of its layouts; empty: the engine that all share.
    """

    label: str
    name: str
    given: str = ""

    @classmethod
    def parse(cls, text: str) -> "EvaluatedSystem":
        """Reads ``NAME``, ``NAME=ENGINE``, ``files=PLACE`` or ``LABEL:NAME=…``.

        Raises:
            ConfigError: The name is unknown (``system_unknown``), or the label is none (``config_invalid``).
        """
        head, _, given = text.partition("=")
        label, colon, name = head.partition(":")
        name = name if colon else label
        system_named(name)
        if not _LABEL.fullmatch(label):
            raise ConfigError(
                f"label of a system is {quote_value(label)}, expected letters, digits, underscores, points and hyphens",
                "config_invalid",
            )
        return cls(label, name, given)

    @property
    def compared(self) -> ComparedSystem:
        """Its row."""
        return SYSTEMS[self.name]

    def row(self, shared: GenerateSettings) -> str:
        """Its row in the paper's Table 1, and what differs from that: the embedded model in place of a language model, or other files."""
        if self.lacks(shared):
            return self.compared.row
        if self.name == "files":
            return self.compared.row if self.compared.row.lower() in self.label.lower() else "layouts of files"
        if self.compared.needs and not self.settings(shared, shared.seed).chats:
            return f"{self.compared.row} without its model"
        return self.compared.row

    def is_repeated(self) -> bool:
        """Whether its scenes differ between repetitions: files of one place are the same for all of them."""
        return self.name != "files" or _SEED in self.given

    def settings(self, shared: GenerateSettings, seed: int) -> GenerateSettings:
        """Returns the settings of a repetition: what all share, then what makes the system.

        Raises:
            ConfigError: They cannot be used.
        """
        own: dict[str, str | int] = {"seed": seed, **self.compared.values}
        if self.given:
            own["layout_files" if self.name == "files" else "engine.engine"] = self.given.replace(_SEED, str(seed))
        values = asdict(shared)
        for key, value in own.items():
            *path, last = key.split(".")
            inner = values
            for name in path:
                inner = inner[name]
            inner[last] = value
        return fill_settings(GenerateSettings, values, "generate")

    def lacks(self, shared: GenerateSettings) -> str:
        """Returns what has to be given for it to run; empty if nothing is missing.

        Rows of other models have an engine of their own or none; the embedded model stands in for them only if it is named.
        """
        if self.given:
            return ""
        if self.name == "files":
            return "--system files=PLACE: a run, or a folder in the MesaTask-10K format (docs/systems.md)"
        if self.name in ("mesatask", "mesatask_refined"):  # another model that answers its questions would not be MesaTask
            return f"MesaTask's model, --system {self.name}=ENGINE (docs/systems.md)"
        is_lacking = self.name == "zero_shot" and not shared.chats
        return f"{self.compared.needs}, or --system {self.name}=ENGINE" if is_lacking else ""


def parse_systems(texts: Iterable[str]) -> list[EvaluatedSystem]:
    """Reads the systems of an evaluation.

    Raises:
        ConfigError: There is none, one is unknown, or two have the same label (``config_invalid``).
    """
    found = [EvaluatedSystem.parse(text) for text in texts]
    labels = [system.label for system in found]
    if not found:
        raise ConfigError("an evaluation has no systems, expected at least one", "config_invalid")
    if twice := sorted({label for label in labels if labels.count(label) > 1}):
        raise ConfigError(
            f"{twice[0]} is evaluated twice, expected different labels; name one LABEL:{found[labels.index(twice[0])].name}",
            "config_invalid",
        )
    return found
