"""The systems of the paper's comparison by name: the settings of the job ``generate`` that make the row of each."""

import json
from collections.abc import Mapping
from dataclasses import dataclass
from types import MappingProxyType
from typing import Literal, TypeAlias

from stable_data.errors import ConfigError

LayoutName: TypeAlias = Literal["stages", "holodeck", "idesign", "files"]
"""Who lays scenes out."""

CorrectorName: TypeAlias = Literal["stable", "steerable", "steerable_parts", "mesatask", "mesatask_released"]
"""What corrects scenes: the Physics Corrector, or one of :data:`models.baselines.methods.METHODS`."""

_EVERY: Mapping[str, str | int] = {
    "accept": "",  # a row is a mean over all scenes, clean or not
    "layout": "stages",
    "schedule": "task,important,secondary",
    "corrector": "stable",
    "corrects": "each",
    "density": 0,
}
"""What makes a system, where its own settings do not say otherwise: its row means the same whatever a file sets."""

_LONG: Mapping[str, int] = {"engine.sampling.max_tokens": 16_384}
"""Room for sixty objects, or for their relations, in one answer."""


@dataclass(frozen=True, slots=True)
class ComparedSystem:
    """A row of the comparison.

    Attributes:
        row: Its name in the paper's Table 1 (Sec. "Experiment"), or in its appendix "Baselines".
        about: What it is, one line.
        settings: Settings of ``generate`` that differ from those of Algorithm 1, by key.
        needs: What else has to be given; empty if nothing has to be.
    """

    row: str
    about: str
    settings: Mapping[str, str | int]
    needs: str = ""

    @property
    def values(self) -> dict[str, str | int]:
        """All settings that make the system, by key."""
        return {**_EVERY, **self.settings}

    @property
    def overrides(self) -> list[str]:
        """The same as ``key=value``."""
        return [f"{key}={json.dumps(value)}" for key, value in self.values.items()]


_WHOLE: Mapping[str, str] = {"schedule": "whole", "corrects": "never"}
_MESATASK: Mapping[str, str | int] = {
    **_WHOLE,
    "reasoner.dialect": "mesatask",
    "engine.sampling.max_tokens": 32_768,  # reasons and a scene graph come before the layout
}

SYSTEMS: Mapping[str, ComparedSystem] = MappingProxyType(
    {
        "stable": ComparedSystem("Ours", "Algorithm 1: the reasoner and the corrector in turn, stage by stage", {}),
        "one_shot": ComparedSystem(
            "One-shot",
            "the reasoner is asked once for the whole scene, then the corrector (Table 3 b)",
            {"schedule": "whole"},
        ),
        "uncorrected": ComparedSystem(
            "Reasoner alone",
            "the reasoner's stages, as it proposes them",
            {"corrects": "never"},
        ),
        "steerable": ComparedSystem(
            "Steerable",
            "the reasoner's stages without a correction, then Steerable's projection alone, without its simulation",
            {"corrector": "steerable", "corrects": "end"},
        ),
        "mesatask": ComparedSystem(
            "MesaTask",
            "MesaTask's model with its prompt, as it answers",
            _MESATASK,
            "--engine transformers:FOLDER, vllm:FOLDER or openai:MODEL with MesaTask's released model",
        ),
        "mesatask_refined": ComparedSystem(
            "MesaTask+refine",
            "the same, then MesaTask's optimiser",
            {**_MESATASK, "corrector": "mesatask", "corrects": "end"},
            "--engine as for mesatask",
        ),
        "zero_shot": ComparedSystem(
            "GPT-4o",
            "a general language model, asked for the whole layout in this project's JSON",
            {**_WHOLE, **_LONG, "reasoner.dialect": "zero_shot"},
            "--engine openai:gpt-4o, or another model that follows instructions",
        ),
        "holodeck": ComparedSystem(
            "Holodeck-Table",
            "a language model proposes objects and relations, a search over a grid places them",
            {**_LONG, "layout": "holodeck", "corrects": "never"},
            "--engine openai:gpt-4o for the paper's row; the embedded model exercises the search with its own layouts",
        ),
        "idesign": ComparedSystem(
            "I-Design-Table",
            "agents propose objects and a graph that rules check, backtracking places them",
            {**_LONG, "layout": "idesign", "corrects": "never"},
            "--engine as for holodeck",
        ),
        "files": ComparedSystem(
            "TabletopGen",
            "scenes that another system has made for the tasks",
            {"layout": "files", "corrects": "never"},
            "--set layout_files=PLACE: a run, or a folder in the MesaTask-10K format",
        ),
    }
)
"""The systems by name."""


def system_named(name: str) -> ComparedSystem:
    """Returns a system by name.

    Raises:
        ConfigError: The name is unknown (``system_unknown``).
    """
    if name not in SYSTEMS:
        raise ConfigError(f"system is {name!r}, expected one of {', '.join(SYSTEMS)}", "system_unknown")
    return SYSTEMS[name]
