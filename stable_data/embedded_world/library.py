"""All assets of the embedded world as a folder, built once: the default library for scenes if no other library is named."""

import hashlib
import json
import tempfile
from collections.abc import Iterator
from pathlib import Path

from stable_data.assets.catalog import AssetLibrary
from stable_data.embedded_world.families.catalogue import KEYS, asset
from stable_data.embedded_world.world import write_library
from stable_data.errors import ConfigError, cannot_write
from stable_data.mesatask.asset_catalog import library_of_folder
from stable_data.mesatask.library import ANNOTATION_FILE
from stable_data.scene import Scene, SceneObject, Tabletop

NAME = "embedded"
"""Name of the library."""

TILTS_FILE = "resting_tilts.json"
"""File with the resting tilts of each asset by uid: quaternions xyzw, the most usual first."""


def embedded_library(cache: Path) -> tuple[Path, AssetLibrary]:
    """Returns the asset library of the embedded world, not encoded; builds it in about a minute if it is missing.

    Args:
        cache: The folder for it, with one library per version of the code that makes the assets.

    Returns:
        Its folder, with ``Asset_annotation.json`` and ``Assets_library``, and its catalogue.

    Raises:
        ConfigError: The folder cannot be written, or its contents are not usable (``library_broken``).
    """
    root = cache / f"{NAME}-{_fingerprint()}"
    if not (root / ANNOTATION_FILE).is_file():
        _build(root)
    try:
        tilts = json.loads((root / TILTS_FILE).read_text("utf-8"))
    except (OSError, ValueError) as error:
        raise ConfigError(
            f"{root} is not a usable library ({error}); delete the folder; it is then built again", "library_broken"
        ) from error
    return root, library_of_folder(root, NAME, scenes=_resting_scenes(tilts))


def _build(root: Path) -> None:
    """Writes the library into a temporary folder and renames it in one step."""
    try:
        root.parent.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryDirectory(prefix=f".{root.name}-", dir=root.parent) as folder:
            temporary = Path(folder) / "made"
            temporary.mkdir()
            write_library(temporary, KEYS)
            tilts = {asset(key).uid: asset(key).tilts for key in KEYS}
            (temporary / TILTS_FILE).write_text(json.dumps(tilts), "utf-8")
            temporary.rename(root)
    except OSError as error:
        if not (root / ANNOTATION_FILE).is_file():  # otherwise another process built it first
            raise cannot_write(str(root), error) from error


def _resting_scenes(tilts: dict[str, list[tuple[float, float, float, float]]]) -> Iterator[Scene]:
    """One scene per asset, with an object for each resting tilt and two for the most usual one."""
    for uid, tilts_of_asset in tilts.items():
        objects = tuple(
            SceneObject(
                f"thing_{k}",
                "thing",
                (0.0, 0.0, 0.0),
                0.0,
                (1.0, 1.0, 1.0),
                uid,
                tilt_quat_xyzw=(way[0], way[1], way[2], way[3]),
            )
            for k, way in enumerate([*tilts_of_asset[:1], *tilts_of_asset])
        )
        yield Scene(uid, Tabletop("table", (1.0, 1.0)), objects)


def _fingerprint() -> str:
    """A hash of the code that makes the assets."""
    folder = Path(__file__).parent
    digest = hashlib.sha256()
    # Any module of the package may shape an asset.
    for path in sorted(folder.rglob("*.py")):
        digest.update(path.read_bytes())
    return digest.hexdigest()[:16]
