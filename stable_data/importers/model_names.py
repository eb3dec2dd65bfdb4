"""Names of models whose files are called like all others of their kind."""

from pathlib import PurePosixPath

_GENERAL = frozenset({"asset", "main", "mesh", "model", "object", "root", "textured"})


def name_of_path(path: str, folder: str) -> str:
    """Returns the name of a model: that of its file, or of its folder if the file has the name of a kind such as ``model``.

    Args:
        path: Its file, relative to the source folder.
        folder: The name of the source folder.
    """
    stem, above = PurePosixPath(path).stem, PurePosixPath(path).parent.name
    return (above or folder or stem) if stem.lower() in _GENERAL else stem
