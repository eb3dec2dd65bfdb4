"""Names of models whose files are called like all others of their kind."""

from pathlib import PurePosixPath

from stable_data.errors import Notice
from stable_data.importers.boundary import asset_id_of
from stable_data.json_text import quote_value

_GENERAL = frozenset({"asset", "main", "mesh", "model", "object", "root", "textured"})


def name_of_path(path: str, folder: str) -> str:
    """Returns the name of a model: that of its file, or of its folder if the file has the name of a kind such as ``model``.

    Args:
        path: Its file, relative to the source folder.
        folder: The name of the source folder.
    """
    stem, above = PurePosixPath(path).stem, PurePosixPath(path).parent.name
    return (above or folder or stem) if stem.lower() in _GENERAL else stem


def nameless_notice(path: str) -> Notice:
    """The failure of a file whose path is no Unicode, so that no table can hold it."""
    message = f"{quote_value(path)}: the name is no UTF-8, expected letters; rename the folder or file"
    return Notice(asset_id_of(path), "find", "name_not_unicode", message)
