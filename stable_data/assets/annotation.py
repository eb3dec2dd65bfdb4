"""What an annotation says about an asset."""

import re
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

from stable_data.scene import Vec3


@dataclass(frozen=True, slots=True)
class AssetAnnotation:
    """What Asset_annotation.json says about one asset; defaults where it says nothing.

    Attributes:
        asset_id: Its uid.
        category: Its kind, as annotated.
        description: A few words for it.
        caption: A sentence about it (``detailed_caption``).
        source: Where it comes from, such as ``gen``.
        mass: Kilograms, if given.
        is_container: Whether things can lie in it, if given.
        on_table: Whether it belongs on a table.
        mark_deletion: Whether the annotators wanted it removed.
        is_composite: Whether it is several things in one mesh.
        extents_z_up: Its box in mesh units along the z-up axes, if given. The format gives it y-up.
        raw: The entry of the file, so that writing loses nothing. Not compared.
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
    raw: Mapping[str, Any] = field(default_factory=dict, compare=False, repr=False)

    @property
    def words(self) -> str:
        """Its description, else its caption."""
        return self.description or self.caption

    @property
    def licence(self) -> str | None:
        """Under which it may be used, if the file says so."""
        return str(self.raw.get("licence") or self.raw.get("license") or "").strip() or None


def category_of(instance: str) -> str:
    """The kind that an instance name speaks of: words joined by ``_``, lower case, without numbers and tokenizer debris.

    Args:
        instance: Such as ``12_Paper##clip_0`` or ``pen_0``.

    Returns:
        Such as ``paperclip`` or ``pen``; ``object`` where nothing is left.
    """
    words = re.sub(r"^\d+_|_\d+(?:\.\d+)?$", "", instance).replace("##", "").lower()
    return re.sub(r"[\W_]+", "_", words).strip("_") or "object"
