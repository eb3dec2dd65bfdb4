"""Settings of the evaluate job: the systems, their repetitions, and the settings that all of them share."""

from dataclasses import dataclass, field
from typing import ClassVar

from models.baselines.systems import SYSTEMS
from models.settings import Count, PositiveCount, Settings
from pipelines.generate.settings import GenerateSettings
from pipelines.rate.settings import RateSettings
from pipelines.views.settings import ViewsSettings


@dataclass(frozen=True, slots=True)
class EvaluateSettings(Settings):
    """Settings of the evaluate job, from ``--set key=value`` or the table ``[evaluate]`` of a TOML file."""

    section: ClassVar[str] = "evaluate"

    systems: tuple[str, ...] = tuple(SYSTEMS)
    """The systems, as ``NAME``, ``NAME=ENGINE``, ``files=PLACE`` or ``LABEL:NAME=…``. In PLACE, ``{seed}`` is the seed of a repetition."""

    repetitions: PositiveCount = 1
    """How often everything is repeated with another seed, from ``generate.seed`` on; intervals are those of the mean over them."""

    reference: str = ""
    """A run of scenes whose pictures those of the systems are compared with (FID, KID). Empty: these figures are unknown."""

    reference_where: str = ""
    """Which scenes of the reference, such as ``split == 'test'``. Empty: all."""

    reference_pictures: str = ""
    """Run of the pictures of the reference: they are drawn there once, and further evaluations take them from there. Empty: each
    evaluation has its own.
    """

    num_pictures: Count = 6
    """Tasks whose scenes the report shows side by side."""

    generate: GenerateSettings = field(default_factory=GenerateSettings)
    """What all systems share: assets, retrieval, engine, limits. What makes a system overrides it."""

    views: ViewsSettings = field(default_factory=ViewsSettings)
    """The pictures and their features."""

    rate: RateSettings = field(default_factory=RateSettings)
    """Who rates the scenes."""
