"""The annotation of an asset in its dataset."""

import re
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

from stable_data.scene import QuatXyzw, Vec3


@dataclass(frozen=True, slots=True)
class AssetAnnotation:
    """The entry of one asset in Asset_annotation.json, with defaults for missing values.

    Attributes:
        asset_id: Identifier of the asset.
        category: Category, as annotated.
        description: Short description.
        caption: Description in a sentence (``detailed_caption``).
        source: Origin, such as ``gen``.
        mass: Kilograms, if given.
        is_container: Whether other objects can be placed inside, if given.
        on_table: Whether the asset belongs on a table.
        mark_deletion: Whether the annotators marked it for deletion.
        is_composite: Whether the mesh contains several objects.
        extents_z_up: Box extents in mesh units along the z-up axes, if given. The file gives them y-up.
        typical_scale: Usual scale, metres per mesh unit, if the asset is of a run that knows it; no file gives it. Not compared.
        resting_tilt: Most frequent tilt in the scenes of its run, xyzw, if the asset is of a run; no file gives it. Not compared.
        raw: The entry of the file, for a lossless round trip. Not compared.
    """

    asset_id: str
    category: str = ""
    description: str = ""
    caption: str = ""
    source: str = ""
    mass: float | None = None
    is_container: bool | None = None
    on_table: bool = True
    mark_deletion: bool = False
    is_composite: bool = False
    extents_z_up: Vec3 | None = None
    typical_scale: Vec3 | None = field(default=None, compare=False, repr=False)
    resting_tilt: QuatXyzw | None = field(default=None, compare=False, repr=False)
    raw: Mapping[str, Any] = field(default_factory=dict, compare=False, repr=False)

    @property
    def words(self) -> str:
        """The description, or the caption if there is no description."""
        return self.description or self.caption

    @property
    def is_offered(self) -> bool:
        """Whether the asset may be used on a table."""
        return self.on_table and not self.mark_deletion and not self.is_composite

    @property
    def licence(self) -> str | None:
        """The licence, if the file gives one."""
        return str(self.raw.get("licence") or self.raw.get("license") or "").strip() or None


def category_of(instance: str) -> str:
    """Returns the category in an instance name: words joined by ``_``, lower case, without numbers and tokenizer marks.

    Args:
        instance: Such as ``12_Paper##clip_0`` or ``pen_0``.

    Returns:
        Such as ``paperclip`` or ``pen``; ``object`` if no word is left.
    """
    words = re.sub(r"^\d+_|_\d+(?:\.\d+)?$", "", instance).replace("##", "").lower()
    return re.sub(r"[\W_]+", "_", words).strip("_") or "object"
