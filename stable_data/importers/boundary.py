"""The boundary of a source folder: nothing outside of it is read, and sizes are limited."""

import os
import re
import stat
import unicodedata
from collections.abc import Collection, Iterator
from pathlib import Path, PurePosixPath
from typing import Any
from urllib.parse import unquote

from stable_data.errors import ConfigError, MeshError, Notice
from stable_data.json_text import quote_value
from stable_data.limits import LIMITS, FileLimits, at_most

_SCHEME = re.compile(r"^[a-zA-Z][a-zA-Z0-9+.-]+:")  # at least two letters: one is a drive
_DRIVE = re.compile(r"^(?:[a-zA-Z]:|\\\\)")
_NOT_OF_AN_ID = re.compile(r"[^A-Za-z0-9._-]+")

LONGEST_PATH = 4_096
"""Characters of a path, as many as systems take. A path is looked up folder by folder, which takes long for one of very many."""


class Boundary:
    """A folder whose files may be read. Links are followed only where they stay inside.

    A reader makes one for each asset: it counts what is read.

    Args:
        root: The folder.
        limits: Sizes beyond which an asset is refused.

    Attributes:
        opened: The files that were read, relative to the folder.

    Raises:
        ConfigError: The folder does not exist (``source_missing``).
    """

    def __init__(self, root: Path, limits: FileLimits = LIMITS.file) -> None:
        if not root.is_dir():
            raise ConfigError(f"{root}: no folder, expected the source folder of assets; check the path", "source_missing")
        self.root = root.resolve()
        self.limits = limits
        self.opened: set[str] = set()
        self._bytes = 0

    def files(self, suffixes: Collection[str]) -> Iterator[str]:
        """Lists files by their suffix, lower case with a dot, relative to the folder, sorted within each folder.

        Links and hidden folders are left out, so that no file is listed twice and none outside.
        """
        stack = [self.root]
        while stack:
            folder = stack.pop()
            try:
                with os.scandir(folder) as entries:
                    found = sorted(entries, key=lambda entry: entry.name)
            except OSError as error:
                raise ConfigError(f"{folder}: cannot be listed ({error.strerror})", "source_unreadable") from error
            kept = [e for e in found if not e.is_symlink()]
            stack += [Path(e.path) for e in reversed(kept) if e.is_dir() and not e.name.startswith(".")]
            for entry in kept:
                if entry.is_file() and PurePosixPath(entry.name).suffix.lower() in suffixes:
                    yield Path(entry.path).relative_to(self.root).as_posix()

    def resolve(self, reference: str, base: str = "") -> str:
        """Returns the path of a file that another file refers to, relative to the folder.

        Args:
            reference: As it stands in the file: relative to ``base``, with slashes or backslashes, or ``model://NAME/…`` and
                ``package://NAME/…`` with a folder of that name above ``base`` or beside one of these; without such a folder, the rest
                of the path from one of them.
            base: The folder of the file that refers to it, relative to the folder.

        Raises:
            MeshError: ``path_outside``: an absolute path, an address on a network, or a path that leaves the folder;
                ``file_missing``: there is no such file.
        """
        text = reference.strip()
        named = re.match(r"^(?:model|package)://([^/\\]+)/(.+)$", text)
        if named is None and (_SCHEME.match(text) or _DRIVE.match(text) or text.startswith(("/", "~"))):
            raise self._error(
                reference, "leaves the folder", "a path relative to the file; copy the file into the folder", "path_outside"
            )
        if "\0" in text or not text or len(text) > LONGEST_PATH:
            expected = f"the name of a file, at most {LONGEST_PATH:,} characters"
            raise self._error(reference, "is no path", expected, "file_missing")
        for place in self._places(PurePosixPath(base), *(named.groups() if named else ("", text))):
            path = self._inside(reference, place)
            if path is not None:
                return path
        raise self._error(reference, "does not exist", "a file of the folder; add it or correct the name", "file_missing")

    def _places(self, base: PurePosixPath, name: str, rest: str) -> Iterator[str]:
        """Where a reference may point to, likeliest first, each relative to the folder."""
        rest = rest.replace("\\", "/")
        for words in dict.fromkeys((rest, unquote(rest))):
            if not name:
                yield (base / words).as_posix()
                continue
            for folder in (base, *base.parents):
                if folder.name == name:
                    yield (folder / words).as_posix()
                yield (folder / name / words).as_posix()
            if self.root.name == name:
                yield words
            for folder in (base, *base.parents):  # the folder of the model or the package has another name here
                yield (folder / words).as_posix()

    def _inside(self, reference: str, place: str) -> str | None:
        """A place as a path of an existing file in the folder; None if there is none."""
        path = self.root / place
        try:
            found = Path(os.path.realpath(path))
            is_file = found.is_file()
        except (OSError, ValueError):  # too long, or a circle of links
            return None
        if not found.is_relative_to(self.root):
            raise self._error(
                reference, "leaves the folder", "a path inside of it; copy the file into the folder", "path_outside"
            )
        inside = found.relative_to(self.root)
        if is_file:
            return inside.as_posix()
        other = self._in_other_case(inside)
        return other.as_posix() if other is not None and (self.root / other).is_file() else None

    def _in_other_case(self, path: Path) -> Path | None:
        """A path whose names differ in case or composition of letters alone, as other systems ignore these; None if none or several.

        Links are not followed.
        """

        def plain(name: str) -> str:
            return unicodedata.normalize("NFC", name).casefold()

        found = Path()
        for name in path.parts:
            try:
                with os.scandir(self.root / found) as entries:
                    near = [e.name for e in entries if plain(e.name) == plain(name) and not e.is_symlink()]
            except OSError:
                return None
            if name not in near and len(near) != 1:
                return None
            found /= name if name in near else near[0]
        return found

    def read_bytes(self, path: str, limit: str = "max_file_bytes", group: Any = None) -> bytes:
        """Reads a file that :meth:`resolve` or :meth:`files` returned.

        Args:
            path: Relative to the folder.
            limit: The limit on its size, besides that on any file.
            group: The group of limits that has it; by default that of the boundary.

        Raises:
            MeshError: ``path_outside``, ``file_missing``, or ``file_too_large``.
        """
        place = self._inside(path, path)
        if place is None:
            raise self._error(path, "does not exist", "a file of the folder; add it or correct the name", "file_missing")
        group = self.limits if group is None else group
        if getattr(group, limit) > self.limits.max_file_bytes:
            limit, group = "max_file_bytes", self.limits
        num_bytes = getattr(group, limit)
        try:
            with (self.root / place).open("rb") as file:
                if not stat.S_ISREG(os.fstat(file.fileno()).st_mode):
                    raise self._error(path, "is no regular file", "a file", "file_missing")
                content = file.read(num_bytes + 1)
        except OSError as error:
            raise MeshError(f"{path}: cannot be read ({error.strerror or error})", "file_missing") from error
        if len(content) > num_bytes:
            raise self._error(path, "is larger", f"{at_most(group, limit, 'bytes')}", "file_too_large")
        if place not in self.opened:
            self.opened.add(place)
            self._bytes += len(content)
            if self._bytes > self.limits.max_bytes or len(self.opened) > self.limits.max_files:
                most = f"{at_most(self.limits, 'max_bytes', 'bytes')} in {at_most(self.limits, 'max_files')} files for an asset"
                raise self._error(path, f"is one of {len(self.opened)} files with {self._bytes} bytes", most, "file_too_large")
        return content

    def read_head(self, path: str, size: int) -> bytes:
        """Reads the first ``size`` bytes of a file that :meth:`files` or :meth:`resolve` returned; empty if it cannot be read.

        The readers look there for the names of further files. It does not count as an opened file.
        """
        try:
            if (self._inside(path, path) or "") != path:
                return b""
            with (self.root / path).open("rb") as file:
                return file.read(size)
        except (OSError, MeshError):
            return b""

    def _error(self, path: str, found: str, expected: str, code: str) -> MeshError:
        return MeshError(f"{quote_value(path)} {found}, expected {expected}", code)


def asset_id_of(name: str) -> str:
    """Returns an identifier made of the characters that every file system and table takes.

    Args:
        name: The name in the source, any characters.
    """
    decomposed = "".join(c for c in unicodedata.normalize("NFKD", name) if not unicodedata.combining(c))
    return _NOT_OF_AN_ID.sub("_", decomposed).strip("._-")[:120] or "asset"


def renamed_notice(asset_id: str, name: str) -> Notice | None:
    """The warning that an identifier differs from the name in the source; None if the name could be one."""
    if asset_id_of(name) == name:
        return None
    message = (
        f"asset {asset_id}: the source calls it {quote_value(name)}; the name has characters that an identifier cannot have"
    )
    return Notice(asset_id, "find", "name_changed", message)
