"""Settings of the evaluate-policy job."""

from dataclasses import dataclass
from typing import ClassVar

from pipelines.demonstrate.settings import EpisodeSettings


@dataclass(frozen=True, slots=True)
class EvaluatePolicySettings(EpisodeSettings):
    """Settings of the evaluate-policy job, from ``--set key=value`` or the table ``[evaluate_policy]`` of a TOML file.

    The robot and the control are those of the policy, unless they are set.
    """

    section: ClassVar[str] = "evaluate_policy"
