"""All assets of the embedded world as a folder, made once: what scenes are furnished from where no other library is named."""

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
"""What the library is called."""

TILTS_FILE = "resting_tilts.json"
"""How each asset rests, by uid: quaternions xyzw, the usual one first."""


def embedded_library(cache: Path) -> tuple[Path, AssetLibrary]:
    """The embedded world's library, not encoded; made in about a minute where it is not there yet.

    Args:
        cache: A folder for it; one library for each version of the code that makes it.

    Returns:
        Its folder, with ``Asset_annotation.json`` and ``Assets_library``, and its catalogue.

    Raises:
        ConfigError: It cannot be written.
    """
    root = cache / f"{NAME}-{_fingerprint()}"
    if not (root / ANNOTATION_FILE).is_file():
        _make(root)
    try:
        tilts = json.loads((root / TILTS_FILE).read_text("utf-8"))
    except (OSError, ValueError) as error:
        raise ConfigError(
            f"{root} is not a usable library ({error}); delete the folder; it is then built again", "library_broken"
        ) from error
    return root, library_of_folder(root, NAME, scenes=_shown(tilts))


def _make(root: Path) -> None:
    """Writes the library aside and puts it in place in one step."""
    try:
        root.parent.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryDirectory(prefix=f".{root.name}-", dir=root.parent) as folder:
            aside = Path(folder) / "made"
            aside.mkdir()
            write_library(aside, KEYS)
            tilts = {asset(key).uid: asset(key).tilts for key in KEYS}
            (aside / TILTS_FILE).write_text(json.dumps(tilts), "utf-8")
            aside.rename(root)
    except OSError as error:
        if not (root / ANNOTATION_FILE).is_file():  # else another process was faster
            raise cannot_write(str(root), error) from error


def _shown(tilts: dict[str, list[tuple[float, float, float, float]]]) -> Iterator[Scene]:
    """A scene for each asset, in which it rests in each of its ways, in the usual one twice."""
    for uid, ways in tilts.items():
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
            for k, way in enumerate([*ways[:1], *ways])
        )
        yield Scene(uid, Tabletop("table", (1.0, 1.0)), objects)


def _fingerprint() -> str:
    """Of the code that makes assets."""
    folder = Path(__file__).parent
    digest = hashlib.sha256()
    for path in sorted(folder.rglob("*.py")):
        digest.update(path.read_bytes())
    return digest.hexdigest()[:16]
