"""Files of exported scenes that a user's exports share: what did not change is not made again."""

import hashlib
import json
import os
import tempfile
from collections.abc import Callable, Mapping
from contextlib import suppress
from dataclasses import asdict, dataclass, is_dataclass
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path, PurePosixPath
from typing import Any

from stable_data.assets.store import AssetStore
from stable_data.atomic_files import write_file_atomically
from stable_data.cache_folder import trim_folder, user_cache
from stable_data.code_version import code_version
from stable_data.export.formats import ExportFormat
from stable_data.scene import Scene
from stable_data.simulation.offscreen import can_render

MAX_CACHE_BYTES = 8 * 2**30
"""Maximum size of the files of all exported scenes of a user; those that were used longest ago are removed."""

_TRIMMED = 0.9  # of the maximum: what remains when the cache is full
# Packages whose versions shape the files; the last three decompose meshes.
_MAKERS = ("mujoco", "numpy", "pillow", "scipy", "trimesh", "usd-core", "fast-simplification", "manifold3d", "vhacdx")


@dataclass(frozen=True, slots=True)
class CachedScene:
    """The files of one exported scene.

    Attributes:
        files: Path below the folder of the export -> SHA-256 of the content; the file of the scene itself is the last one.
        num_boxes: Objects of the scene without a mesh, exported as boxes.
    """

    files: Mapping[str, str]
    num_boxes: int


class SceneCache:
    """Exported scenes by content, for one format.

    A scene is exported alone, to an empty folder, so that its files are known: its own and those that it shares with others. The
    cache keeps each content once, under its hash, and a list of files for each scene. The key of a scene is a hash of its row, of
    the rows and meshes of its assets, of the format with its settings, and of the code. Files are copied, never linked: a change in
    one export reaches no other. Content is checked when it is copied, and what is missing or damaged is made again. Any number of
    processes may use the folder; without a usable folder every scene is made.

    Args:
        name: Name of the format.
        chosen: The format. Formats that are not part of this package have no known version, so their scenes are always made.
        store: The assets of the scenes.
        folder: The folder; None: ``exports`` in the user's cache.
    """

    def __init__(self, name: str, chosen: ExportFormat, store: AssetStore, folder: Path | None = None) -> None:
        self._folder, self._format, self._store = folder or user_cache("exports"), chosen, store
        self._size = trim_folder(self._folder, MAX_CACHE_BYTES)
        settings: dict[str, Any] = asdict(chosen) if is_dataclass(chosen) and not isinstance(chosen, type) else {}
        makers = {maker: _version(maker) for maker in _MAKERS}
        # A package of OpenUSD has a picture where the machine can render, and states a date.
        self._code = [name, settings, code_version(), makers, can_render(), os.environ.get("SOURCE_DATE_EPOCH")]
        module = getattr(chosen, "__name__", type(chosen).__module__)
        self.is_usable = module.partition(".")[0] == __name__.partition(".")[0]

    def key(self, scene: Scene, row: Mapping[str, Any] | None, rest: Mapping[str, Any] | None) -> str | None:
        """Returns the key of a scene; None if the content of its assets is not known.

        Args:
            scene: The scene.
            row: Its row, if it has one.
            rest: Poses of its objects after settling, if these are exported.
        """
        support = None if scene.frame is None else scene.frame.asset_id
        assets = {
            name: self._store.fingerprint(name) for name in {support, *(o.asset_id for o in scene.objects)} if name is not None
        }
        if not self.is_usable or None in assets.values():
            return None
        parts = [self._code, asdict(scene) if row is None else row, rest, assets]
        return hashlib.sha256(json.dumps(parts, sort_keys=True, default=sorted).encode()).hexdigest()

    def place(self, key: str, out: Path) -> CachedScene | None:
        """Puts the files of a scene into the folder of an export; None if the cache does not have all of them.

        Raises:
            OSError: The folder of the export cannot be written.
        """
        scene = self._read(key)
        if scene is None:
            return None
        for name, digest in scene.files.items():
            path = out / name
            if path.exists():
                continue
            content = self._content(digest)
            if content is None:
                return None
            path.parent.mkdir(parents=True, exist_ok=True)
            write_file_atomically(path, content)
        return scene

    def make(self, key: str, scene: Scene, export: Callable[[Path], int]) -> None:
        """Exports a scene into the cache, if the cache can be written.

        Args:
            key: The key of the scene.
            scene: The scene.
            export: Exports the scene to a folder, and returns the number of objects that are boxes.

        Raises:
            StableDataError: As ``export``.
        """
        with suppress(OSError):  # the export itself goes on without the cache
            self._folder.mkdir(parents=True, exist_ok=True)
            with tempfile.TemporaryDirectory(prefix="staging-", dir=self._folder) as staging:
                place = Path(staging)
                num_boxes = export(place)
                own = self._format.scene_path(scene, place)
                paths = [path for path in place.rglob("*") if path.is_file() and path != own]
                # As the formats do: what lies deeper is needed by what lies above it, which says that a thing is complete.
                paths.sort(key=lambda path: (-len(path.parts), path.stat().st_mtime_ns, path))
                paths = [*paths, own]
                files = {path.relative_to(place).as_posix(): self._keep(path.read_bytes()) for path in paths}
            self._put(self._folder / key[:2] / f"{key}.json", json.dumps({"files": files, "num_boxes": num_boxes}).encode())
            if self._size > MAX_CACHE_BYTES:
                self._size = trim_folder(self._folder, int(_TRIMMED * MAX_CACHE_BYTES))

    def _read(self, key: str) -> CachedScene | None:
        """Returns the list of files of a scene; None if there is no usable one."""
        path = self._folder / key[:2] / f"{key}.json"
        try:
            found = json.loads(path.read_bytes())
            files = {str(name): str(digest) for name, digest in found["files"].items()}
            num_boxes = int(found["num_boxes"])
            os.utime(path)
        except (OSError, ValueError, TypeError, KeyError, AttributeError):
            return None
        names = map(PurePosixPath, files)
        return None if any(name.is_absolute() or ".." in name.parts for name in names) else CachedScene(files, num_boxes)

    def _content(self, digest: str) -> bytes | None:
        """Returns the content with a hash; None if there is none."""
        path = self._object(digest)
        try:
            content = path.read_bytes()
            os.utime(path)
        except OSError:
            return None
        return content if hashlib.sha256(content).hexdigest() == digest else None

    def _keep(self, content: bytes) -> str:
        """Stores a content, and returns its hash."""
        digest = hashlib.sha256(content).hexdigest()
        if self._content(digest) is None:
            self._put(self._object(digest), content)
        return digest

    def _put(self, path: Path, content: bytes) -> None:
        path.parent.mkdir(exist_ok=True)
        write_file_atomically(path, content)
        self._size += len(content)

    def _object(self, digest: str) -> Path:
        return self._folder / digest[:2] / digest


def _version(package: str) -> str | None:
    try:
        return version(package)
    except PackageNotFoundError:
        return None
