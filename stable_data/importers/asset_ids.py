"""Unique identifiers of the assets of a source folder."""

from collections.abc import Sequence
from pathlib import PurePosixPath

from stable_data.importers.boundary import asset_id_of


class AssetIds:
    """Gives identifiers, each once."""

    def __init__(self) -> None:
        self._given: set[str] = set()
        self._next: dict[str, int] = {}  # the number from which a name is tried: all below are given

    def claim(self, asset_id: str) -> bool:
        """Takes an identifier; False if another asset has it, whatever its case: some file systems do not tell case apart."""
        if asset_id.casefold() in self._given:
            return False
        self._given.add(asset_id.casefold())
        return True

    def of_path(self, name: str, path: str) -> str:
        """Returns the identifier of an asset without one of its own: its name; if that is taken, with that of its file and of folders.

        Args:
            name: The name in the source.
            path: Its main file, relative to the source folder.
        """
        stem = PurePosixPath(path).stem
        candidates = [name] if stem == name else [name, f"{name}_{stem}"]
        for folder in PurePosixPath(path).parents:
            if folder.name:
                candidates.append(f"{folder.name}_{candidates[-1]}")
        candidates.append(path)
        return self._first_free([asset_id_of(candidate) for candidate in candidates])

    def _first_free(self, candidates: Sequence[str]) -> str:
        for candidate in candidates:
            if self.claim(candidate):
                return candidate
        name = candidates[0]
        count = self._next.get(name.casefold(), 2)
        while not self.claim(f"{name}_{count}"):
            count += 1
        self._next[name.casefold()] = count + 1
        return f"{name}_{count}"
