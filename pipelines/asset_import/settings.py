"""Settings of the import job."""

from dataclasses import asdict, dataclass
from typing import Any, ClassVar

from models.settings import Count, NonNegative, Positive, PositiveCount, Settings
from stable_data.assets.licences import KNOWN_LICENCES, normalise_licence
from stable_data.errors import ConfigError
from stable_data.importers.conversion import PERMISSIVE, ConversionSettings, SetScale
from stable_data.importers.source import Axis, ReaderOptions
from stable_data.json_text import quote_value


@dataclass(frozen=True, slots=True)
class ImportSettings(Settings):
    """Settings of the import job, from ``--set key=value`` or the table ``[import]`` of a TOML file."""

    section: ClassVar[str] = "import"

    preset: str = ""
    """The layout of a known set: ``objaverse``, ``graspnet_infinite``, ``graspnet``, ``ycb``, ``kaykit`` or
    ``sweethome3d``. Empty finds every model file."""

    manifest: str = ""
    """A CSV or JSONL file in the folder with a row for each asset (docs/import.md lists its columns). Empty uses none."""

    up: Axis = ""
    """The upward axis of files whose format does not state it, such as ``y``. Empty looks for the pose in which the asset rests."""

    front: Axis = ""
    """The axis that faces the user, in the frame of the files. Empty: not known."""

    unit_m: NonNegative = 0.0
    """Metres; the unit of files whose format does not state it, such as 0.001 for millimetres. 0 estimates it from the sizes that
    things of their categories have.
    """

    longest_side_m: NonNegative = 0.0
    """Metres; the longest side of an asset whose unit is not known and whose category has no known size. 0 refuses such assets."""

    licence: str = ""
    """The licence of assets whose source names no known one, such as ``CC-BY-4.0``. Empty refuses them."""

    licences: frozenset[str] = frozenset()
    """Licences that are allowed besides those that permit any use, at most with the author's name (docs/import.md)."""

    decomposes: bool = True
    """Whether meshes without convex parts of their own are decomposed; otherwise that is done when a part is first needed."""

    max_faces: PositiveCount = 100_000
    """Triangles of a mesh in the library; a larger one is reduced, and the distance is stored."""

    texture_side: PositiveCount = 1024
    """Pixels of the longer side of a texture; a larger one is reduced."""

    num_points: PositiveCount = 1024
    """Surface points of an asset."""

    assets_per_shard: PositiveCount = 16
    """Assets of a shard."""

    num_pictures: Count = 240
    """Assets that the report shows."""

    seconds_per_item: Positive = 300.0
    """Seconds; an asset that takes longer is a failure. Not enforced without worker processes."""

    def check(self) -> None:
        """Refuses names of licences that are not known: no asset could have them.

        Raises:
            ConfigError: See above (``licence_unknown``).
        """
        named = [("licences (--allow-licence)", name) for name in sorted(self.licences)]
        for setting, name in [*named, *([("licence (--licence)", self.licence)] if self.licence else [])]:
            if normalise_licence(name) is None:
                known = ", ".join(KNOWN_LICENCES)
                found = f"setting {self.section}.{setting} is {quote_value(name)}, which names no known licence"
                raise ConfigError(
                    f"{found}, expected one of {known}; CC-BY and its kinds may have a version, such as CC-BY-4.0",
                    "licence_unknown",
                )

    def shaping(self) -> dict[str, Any]:
        """The settings that shape rows; a run is resumed only if they are equal."""
        aside = ("num_pictures", "seconds_per_item")
        return {k: sorted(v) if isinstance(v, frozenset) else v for k, v in asdict(self).items() if k not in aside}

    @property
    def reading(self) -> ReaderOptions:
        """What the reader of the folder is told."""
        return ReaderOptions(self.preset, self.manifest, self.up, self.front, self.unit_m)

    def conversion(self, set_scale: SetScale | None = None) -> ConversionSettings:
        """How assets are converted.

        Args:
            set_scale: The common unit of the set, if it is estimated.
        """
        return ConversionSettings(
            allowed_licences=(*PERMISSIVE, *sorted(self.licences)),
            licence=self.licence,
            decomposes=self.decomposes,
            num_points=self.num_points,
            max_faces=self.max_faces,
            texture_side=self.texture_side,
            set_scale=set_scale,
            default_longest_m=self.longest_side_m,
        )
