"""Takes the folders of the machine that made a run out of what is published: of rows, of the manifest and of the card."""

import re
from pathlib import Path
from typing import Any

import pyarrow as pa
import pyarrow.compute as pc

_NEXT = r"(?=[^\s/\\:'\",;()])"
_NAME = r"[^\s/\\:'\",;()]+"
_FILE_ADDRESS = re.compile(r"\bfile:/{1,3}(?=[^\s/])")
_HOME = re.compile(rf"(?<![\w./])(?:/(?:home|Users)/{_NAME}|/root(?![\w.-])|[A-Za-z]:[/\\]{{1,2}}Users[/\\]{{1,2}}{_NAME})")
_POSIX = re.compile(rf"(?<![\w./~])(?:(?:/{_NAME})+/|~(?:/{_NAME})*/){_NEXT}")
_WINDOWS = re.compile(
    rf"(?<!\w)[A-Za-z]:(?:[/\\]{{1,2}}{_NAME})+[/\\]{{1,2}}{_NEXT}|(?<![\w\\])\\\\{_NAME}(?:\\{_NAME})*\\{_NEXT}"
)
_BELOW_HOME = re.compile(rf"~(?:[/\\]{{1,2}}{_NAME})*[/\\]{{1,2}}{_NEXT}")
_IS_ABSOLUTE = re.compile(r"(?:/|~|[A-Za-z]:[/\\]|\\\\|file:/)")
_MAY_HAVE_ONE = r"[/\\]"

_PATHS = frozenset({"layout_path", "source_path", "licence_where", "source", "source_url"})
"""Columns that may be paths: all of the text is one then, also if it has spaces."""


def without_folders(text: str) -> str:
    """Returns a text in which absolute paths of files are reduced to their last part, and a home folder to ``~``.

    Addresses of the web, paths in a folder, and what JSON escapes stay as they are.

    Example:
        >>> without_folders("asset cup: /home/me/data/cup.glb cannot be read")
        'asset cup: cup.glb cannot be read'
    """
    text = _POSIX.sub("", _BELOW_HOME.sub("", _with_short_home(text)))
    return text if text.lstrip().startswith(("{", "[")) else _WINDOWS.sub("", text)  # in JSON, a backslash separates no folders


def without_folder(path: str) -> str:
    """Returns the last part of a path if it is absolute; any other text as :func:`without_folders`."""
    if _IS_ABSOLUTE.match(path) and "\n" not in path:
        return re.split(r"[/\\]", _with_short_home(path).rstrip("/\\"))[-1]
    return without_folders(path)


def rows_without_folders(rows: pa.Table) -> pa.Table:
    """Returns rows without the folders of the machine that made them, in texts of all columns."""
    for place, column in enumerate(rows.schema):
        if _may_have_paths(rows[column.name]):
            change = without_folder if column.name in _PATHS else without_folders
            values = [_changed(value, change) for value in rows[column.name].to_pylist()]
            rows = rows.set_column(place, column, pa.array(values, column.type))
    return rows


def public_value(value: Any) -> Any:
    """Returns a value of a manifest without folders, and without addresses of stores and servers."""
    if isinstance(value, dict):
        return {without_folders(str(key)): public_value(entry) for key, entry in value.items()}
    if isinstance(value, list):
        return [public_value(entry) for entry in value]
    if isinstance(value, str) and "://" in value:
        return ""
    return without_folder(value) if isinstance(value, str) else value


def _with_short_home(text: str) -> str:
    """A text with ``~`` for home folders, and with paths for addresses of files."""
    text, home = _FILE_ADDRESS.sub("/", text), str(Path.home())
    if home.count("/") > 1:
        text = re.sub(rf"(?<![\w./]){re.escape(home)}(?![\w.-])", "~", text)
    return _HOME.sub("~", text)


def _may_have_paths(values: pa.ChunkedArray | pa.Array) -> bool:
    """Whether a text of a column has a separator of folders."""
    kind = values.type
    if pa.types.is_list(kind):
        return _may_have_paths(pc.list_flatten(values))
    if pa.types.is_struct(kind):
        return any(_may_have_paths(pc.struct_field(values, each.name)) for each in kind)
    return bool(pa.types.is_string(kind) and pc.any(pc.match_substring_regex(values, _MAY_HAVE_ONE)).as_py())


def _changed(value: Any, change: Any) -> Any:
    if isinstance(value, str):
        return change(value)
    if isinstance(value, list):
        return [_changed(entry, change) for entry in value]
    return {key: _changed(entry, change) for key, entry in value.items()} if isinstance(value, dict) else value
