"""The settings of retrieval: how an asset is chosen for a description and a box."""

import math
from dataclasses import dataclass

from stable_data.errors import ConfigError


@dataclass(frozen=True, slots=True)
class RetrievalSettings:
    """How assets are chosen."""

    text_weight: float = 0.9
    """Weight of the text score."""

    size_weight: float = 0.1
    """Weight of the size score."""

    floor: float = 0.55
    """Minimum text score of a match, unless the asset is of the wanted category; the default was measured with all-MiniLM-L6-v2
    (docs/retrieval.md).
    """

    margin: float = 0.02
    """Scores this close to the best are equally good: among them the category that fits best is preferred, then the seed
    decides.
    """

    top_k_text: int | None = None
    """Number of assets with the highest text scores that are compared (20 in MesaTask), or None for all. Assets that may not
    be chosen do not count.
    """

    tilt_patience: float = 2.0
    """The most frequent resting tilt is used whose misfit (the angle whose cosine is the size score) is at most this factor
    times the least misfit and at most ten degrees above it, or is at most five degrees.
    """

    metric_slack: float = 1.0
    """Factor by which an asset may be smaller or larger than the sizes that it has, if these are known; 1 keeps them exactly."""

    licences: frozenset[str] | None = None
    """Allowed licences, or None for all. Known ones may be spelled in any usual way; one without a version allows all versions. A list
    excludes assets whose licence is unknown.
    """

    stretch: bool = False
    """Whether assets are scaled along each axis to the requested size, as in the paper; otherwise the scale is uniform."""

    max_distortion: float = 2.0
    """With ``stretch``, the maximum ratio of an asset's largest and smallest scale; the paper has no bound."""

    def __post_init__(self) -> None:
        """Checks the ranges of the numbers."""
        bounds = {
            "text_weight": (self.text_weight, 1e-6, math.inf),
            "size_weight": (self.size_weight, 0.0, math.inf),
            "floor": (self.floor, -1.0, 1.0),
            "margin": (self.margin, 0.0, math.inf),
            "top_k_text": (1 if self.top_k_text is None else self.top_k_text, 1, math.inf),
            "tilt_patience": (self.tilt_patience, 1.0, math.inf),
            "metric_slack": (self.metric_slack, 1.0, math.inf),
            "max_distortion": (self.max_distortion, 1.0, math.inf),
        }
        for name, (value, low, high) in bounds.items():
            if not low <= value <= high:
                raise ConfigError(
                    f"retrieval setting {name} is {value}, expected a number from {low:g} to {high:g}", "setting_invalid"
                )
