"""Reads the assets of the format: annotations, categories, and the files in Assets_library."""

import bisect
import math
import os
import re
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

from stable_data.assets.annotation import AssetAnnotation
from stable_data.errors import ConfigError, SceneError
from stable_data.json_text import ReadLog, are_finite, number, numbers, parse_object, quote_value, read_bounded
from stable_data.limits import LIMITS
from stable_data.scene import Vec3

ANNOTATION_FILE = "Asset_annotation.json"
LIBRARY_FOLDER = "Assets_library"

MAX_NAME_BYTES = 200
"""Longest name of a file or folder: file systems allow 255 bytes, and a file has a longer name while it is written."""

# A rotated variant, such as ``_x_90_y_0``.
_VARIANT_SUFFIX = re.compile(r"_x_-?\d+(?:\.\d+)?(?:_[yz]_-?\d+(?:\.\d+)?)+$")
_HEX = "[0-9a-fA-F]"
# The uids of MesaTask-10K: 32 hex digits, or a UUID.
_KNOWN_FORM = re.compile(rf"{_HEX}{{32}}|(?:gen_)?{_HEX}{{8}}-{_HEX}{{4}}-{_HEX}{{4}}-{_HEX}{{4}}-{_HEX}{{12}}")
_MAX_ID_LENGTH = 200


def read_annotation(asset_id: str, entry: Mapping[str, Any]) -> AssetAnnotation:
    """Reads the entry of an asset in Asset_annotation.json. A missing value, or one of the wrong type, gets its default.

    Keys are compared without case, ``-`` and ``_``, because the same flag occurs as isContainer, is_container and is-container.
    """
    values = {re.sub(r"[-_ ]", "", key).lower(): value for key, value in entry.items()}
    container = _flag(values.get("iscontainer"))
    return AssetAnnotation(
        asset_id,
        category=_text(values.get("category")),
        description=_text(values.get("description")),
        caption=_text(values.get("detailedcaption")) or _text(values.get("caption")),
        source=_text(values.get("source")),
        mass=_mass(values.get("mass")),
        is_container=container,
        on_table=_flag(values.get("ontable")) is not False,
        mark_deletion=_flag(values.get("markdeletion")) is True,
        is_composite=_flag(values.get("iscomposite")) is True,
        extents_z_up=_extents_z_up(values),
        raw=entry,
    )


def write_annotation(annotation: AssetAnnotation) -> dict[str, Any]:
    """Returns the entry of Asset_annotation.json for an asset; the original entry if the annotation is unchanged."""
    if annotation.raw and read_annotation(annotation.asset_id, annotation.raw) == annotation:
        return dict(annotation.raw)
    entry: dict[str, Any] = {
        "category": annotation.category,
        "detailed_caption": annotation.caption,
        "description": annotation.description,
        "source": annotation.source,
        "mass": annotation.mass,
        "isContainer": annotation.is_container,
        "onTable": annotation.on_table,
        "mark_deletion": annotation.mark_deletion,
        "is_composite": annotation.is_composite,
    }
    if annotation.extents_z_up is not None:
        x, y, z = annotation.extents_z_up
        entry["bbox"] = {"x": x, "y": z, "z": y}
    known = {re.sub(r"[-_ ]", "", key).lower() for key in entry} | {"bbox", "minpoint", "maxpoint", "caption"}
    unknown = {key: value for key, value in annotation.raw.items() if re.sub(r"[-_ ]", "", key).lower() not in known}
    return {key: value for key, value in entry.items() if value is not None} | unknown


def is_inside(asset_id: str) -> bool:
    """Whether an asset id is a plain name, with no part that leads to another folder."""
    return not (re.search(r"[/\\\x00]", asset_id) or asset_id in {".", ".."})


def is_file_name(name: str) -> bool:
    """Whether a file or folder can have a name on every file system: a plain name, not too long, that can be printed."""
    return is_inside(name) and name.isprintable() and len(name.encode()) <= MAX_NAME_BYTES


def stem_of(asset_id: str) -> str:
    """Returns the id without the suffix of a rotated variant, such as ``_x_90_y_0``."""
    return _VARIANT_SUFFIX.sub("", asset_id)


class AssetFolder:
    """The assets of a dataset: annotations and GLB files. Either may be missing.

    Args:
        root: The dataset's folder.

    Attributes:
        annotations: By uid.
        notices: Remarks on the annotations and the files.

    Raises:
        ConfigError: Asset_annotation.json exists but cannot be used.
    """

    def __init__(self, root: Path) -> None:
        log = ReadLog(root.name)
        self.annotations: Mapping[str, AssetAnnotation] = _read_annotations(root / ANNOTATION_FILE, log)
        self._folder = root / LIBRARY_FOLDER
        self._resolved = self._folder.resolve()
        self._files = {path.stem: path for path in self._glb_files(log)}
        self._stems = sorted(self._files)
        if not self._files:
            log.warn("assets_missing", f"{LIBRARY_FOLDER} holds no GLB: objects are boxes; unpack the asset archive there")
        self.notices = tuple(log.notices)

    def _glb_files(self, log: ReadLog) -> Iterator[Path]:
        """Yields the .glb files that may be read, in the order of their names."""
        if not self._folder.is_dir():
            return
        with os.scandir(self._folder) as entries:
            found = sorted((Path(entry.path), entry) for entry in entries)
        for path, entry in found:
            if path.suffix.lower() != ".glb":
                continue
            # Only a link needs the slow check that it stays inside the library.
            if self._is_own(path) if entry.is_symlink() else entry.is_file():
                yield path
            else:
                message = f"{LIBRARY_FOLDER} holds {quote_value(path.name)}, expected a regular file inside of it"
                log.warn("glb_refused", f"{message}; it is not used; put the file itself there")

    def _is_own(self, path: Path) -> bool:
        """Whether a path leads to a regular file inside the library."""
        return path.is_file() and path.resolve().is_relative_to(self._resolved)

    @property
    def asset_ids(self) -> tuple[str, ...]:
        """Every uid that is annotated or has a file, sorted."""
        return tuple(sorted({*self.annotations, *self._files}))

    def path(self, asset_id: str) -> Path | None:
        """The path of an asset's GLB; None if there is none, or if it would be outside the library.

        A rotated variant (``<uid>_x_90_y_0``) uses its own file, else that of its stem. A uid without a file uses the file of a
        variant, the first by name.
        """
        if not is_inside(asset_id) or len(asset_id) > _MAX_ID_LENGTH:
            return None
        stem = stem_of(asset_id)
        path = self._files.get(asset_id) or self._files.get(stem) or self._variant(stem)
        return path if path is not None and self._is_own(path) else None

    def _variant(self, stem: str) -> Path | None:
        """Finds a file named ``<stem>_...`` if the stem is a complete uid, so that ``mug`` does not use the file of ``mug_red``."""
        if not _KNOWN_FORM.fullmatch(stem):
            return None
        index = bisect.bisect_left(self._stems, stem + "_")
        found = self._stems[index] if index < len(self._stems) else ""
        return self._files[found] if found.startswith(stem + "_") else None

    def annotation(self, asset_id: str) -> AssetAnnotation:
        """Returns the annotation of an asset or of its stem; defaults for an asset that only has a file.

        Raises:
            KeyError: The asset is neither annotated nor on disk.
        """
        found = self.annotations.get(asset_id) or self.annotations.get(stem_of(asset_id))
        # A file that was found at the start may have been deleted since.
        if found is None and asset_id not in self._files and self.path(asset_id) is None:
            raise KeyError(asset_id)
        return found or AssetAnnotation(asset_id)

    def __contains__(self, asset_id: object) -> bool:
        """Whether an asset is annotated or on disk."""
        if not isinstance(asset_id, str):
            return False
        return bool({asset_id, stem_of(asset_id)} & self.annotations.keys()) or self.path(asset_id) is not None


def _read_annotations(path: Path, log: ReadLog) -> dict[str, AssetAnnotation]:
    """Reads every usable entry of Asset_annotation.json; empty if the file is missing."""
    if not path.exists():
        log.warn("annotation_missing", f"{path} is missing: categories come from instance names, descriptions are empty")
        return {}
    try:
        data = read_bounded(path, LIMITS.layout, "max_annotation_bytes", log)
        document = parse_object(data, ANNOTATION_FILE, log, repeated_code="annotation_duplicate")
    except SceneError as error:
        raise ConfigError(f"{error}; fetch {path} again", error.code) from error
    annotations = {}
    for asset_id, entry in document.items():
        if isinstance(entry, dict):
            annotations[asset_id] = read_annotation(asset_id, entry)
        else:
            message = f"asset {quote_value(asset_id)} is annotated with {quote_value(entry)}, expected an object; it is ignored"
            log.warn("annotation_invalid", message)
    return annotations


def _text(value: object) -> str:
    return value.strip() if isinstance(value, str) else ""


def _flag(value: object) -> bool | None:
    """Reads a boolean, also one written as 0, 1 or a word."""
    if isinstance(value, str):
        value = {"true": True, "yes": True, "1": True, "false": False, "no": False, "0": False}.get(value.strip().lower())
    return bool(value) if value in (True, False) else None


def _mass(value: object) -> float | None:
    """Reads kilograms, also with the unit as text."""
    if isinstance(value, str):
        match = re.fullmatch(r"\s*+(\d++(?:\.\d++)?)\s*+(?:kg)?\s*+", value)  # possessive, so the time is linear in the length
        value = float(match[1]) if match else None
    mass = number(value)
    return mass if mass is not None and math.isfinite(mass) and mass > 0 else None


def _extents_z_up(values: Mapping[str, Any]) -> Vec3 | None:
    """Converts the y-up box of an annotation, in any of its forms, to z-up extents."""
    box = values.get("bbox")
    if isinstance(box, dict) and isinstance(box.get("size"), (dict, list)):
        box = box["size"]
    if isinstance(box, dict) and "min" in box and "max" in box:
        extents = _difference(box["max"], box["min"])
    elif box is not None:
        extents = _triple(box)
    else:
        extents = _difference(values.get("maxpoint"), values.get("minpoint"))
    if extents is None or not are_finite(extents) or min(extents) < 0 or max(extents) <= 0:
        return None
    x, y, z = extents  # y up
    return (x, z, y)


def _difference(high: object, low: object) -> Vec3 | None:
    """``high`` - ``low``, each {x, y, z} or a list."""
    top, bottom = _triple(high), _triple(low)
    if top is None or bottom is None:
        return None
    return (top[0] - bottom[0], top[1] - bottom[1], top[2] - bottom[2])


def _triple(value: object) -> Vec3 | None:
    """Three numbers given as {x, y, z} or as a list."""
    found = numbers([value.get(axis) for axis in "xyz"] if isinstance(value, dict) else value, 3)
    return None if found is None else (found[0], found[1], found[2])
