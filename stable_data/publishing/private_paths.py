"""Takes the folders of the machine that made a run out of what is published: of rows, of the manifest and of the card."""

import json
import re
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pyarrow as pa
import pyarrow.compute as pc

# A path is its root, folders, and its last part. A folder is a name with a separator and a further name behind it: so it may have signs
# that end a last part in a sentence, and a few spaces. No pattern repeats what can be read in two ways: time is linear in the length.
# Groups are repeated within atomic groups, since Python before 3.11.5 repeats them wrongly with possessive quantifiers.
_SEPARATORS = r"[/\\]++"
_NEXT = r"(?=[^\s/\\:\"<>|])"
_FILE_TYPES = (
    "csv|dae|glb|gltf|gz|jpe?g|jsonl?|md|mjcf|npz|obj|parquet|pkl|"
    "ply|png|pt|py|safetensors|sdf|stl|toml|txt|urdf|usd[acz]?|xml|ya?ml"
)


def _folder(without: str) -> "re.Pattern[str]":
    """The pattern of a folder; its names do not have some characters.

    Up to three spaces may be in a name, but not behind what ends a part of a sentence, or behind the name of a file.
    """
    word = rf"(?>(?:[^\s/\\:\"<>|{without}]|:(?![\s/\\]))+)"
    return re.compile(
        rf"(?:[A-Za-z]:|(?![^\s/\\]*\.(?:{_FILE_TYPES}) ){word}(?>(?:(?<![,;.!?]) {word}){{0,3}})){_SEPARATORS}{_NEXT}"
    )


_FOLDER, _FOLDER_OF_STORE = _folder(""), _folder("?")
_ROOT = re.compile(
    r"(?<![A-Za-z0-9+.-])(?P<scheme>[A-Za-z][A-Za-z0-9+.-]{0,30}+)://"
    rf"|(?:(?<![\w./\\~])(?:/++|~(?:[A-Za-z_][\w.-]*+)?{_SEPARATORS}|\\\\++)|(?<!\w)[A-Za-z]:{_SEPARATORS}){_NEXT}"
)
_HOMES = re.compile(r"(?:/+|[A-Za-z]:[/\\]+)(?:home|Users)[/\\]+")
_ROOT_HOME = re.compile(r"root(?![\w.-])")
_NAME_OF_HOME = re.compile(r"[^\s/\\:\"<>|,;()]*[^\s/\\:\"<>|,;().'!?]")
_BUCKET = re.compile(r"(?>(?:[^\s/\\:\"'<>|]|:(?!\s))*)[/\\]*+")
_NAME_OF_STORE = re.compile(r"([^\s/\\:\"'<>|?,;()]*+)(?>(?:[?][^\s\"'<>]*+)?)")
_WEB = re.compile(r"[^\s\"'<>?()\[\]{},;|]*+")
_USER = re.compile(r"\A[^/]*@")
_FILE_ADDRESS = re.compile(r"\bfile:/{1,3}(?=[^\s/])")
_CLOSING = {'"': re.compile(r'["\n]'), "`": re.compile(r"[`\n]"), "'": re.compile(r"'(?!\w)|\n"), "“": re.compile(r"[”\n]")}
_LONGEST_PATH = 1024  # characters of a path in quotation marks
_LITERAL = re.compile(r'"(?>(?:[^"\\]|\\.)*)"?+', re.DOTALL)
_MAY_HAVE_ONE = re.compile(r"[/\\]")

_PATHS = frozenset({"layout_path", "source_path", "licence_where", "source", "source_url"})
"""Columns that may be paths: all of the text is one then, also if it has spaces."""


def without_folders(text: str) -> str:
    """Returns a text in which absolute paths of files are reduced to their last part, and a home folder to ``~``.

    So are addresses of object stores and of other places that are not of the web; those of the web lose user and password. Paths in a
    folder, and what JSON escapes, stay as they are.

    Example:
        >>> without_folders("asset cup: /home/me/data/cup.glb cannot be read")
        'asset cup: cup.glb cannot be read'
    """
    if not _MAY_HAVE_ONE.search(text):
        return text
    if not text.lstrip().startswith(("{", "[")):
        return _changed_sentence(text)
    changed, end = list[str](), 0  # in the texts of JSON, a backslash separates no folders, but is one of two
    for literal in _LITERAL.finditer(text):
        changed += (_changed_sentence(text[end : literal.start()]), _changed_literal(literal[0]))
        end = literal.end()
    return "".join((*changed, _changed_sentence(text[end:])))


def without_folder(path: str) -> str:
    """Returns the last part of a path if it is absolute; any other text as :func:`without_folders`."""
    path = _with_short_home(path)
    root = _ROOT.match(path)
    return without_folders(path) if root is None or _is_web(root) or "\n" in path else _last_part(path, root)


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


def _changed_literal(literal: str) -> str:
    """A text of JSON, in its quotation marks, without folders."""
    try:
        text = json.loads(literal, strict=False)
    except ValueError:
        return _changed_sentence(literal)
    changed = without_folder(text)
    return literal if changed == text else json.dumps(changed)


def _changed_sentence(text: str) -> str:
    """A text that is no JSON without folders."""
    text = _with_short_home(text)
    changed, end = list[str](), 0
    while (root := _ROOT.search(text, end)) is not None:
        kept, begun = _reduced(text, root)
        changed += (text[end : root.start()], kept)
        end = begun
    return "".join((*changed, text[end:]))


def _reduced(text: str, root: "re.Match[str]") -> tuple[str, int]:
    """What is kept of an address, or of a path but for its last part, and where the text goes on."""
    if _is_web(root):
        found = _WEB.match(text, root.end())
        assert found is not None  # it may be empty
        return root[0] + _USER.sub("", found[0]), found.end()
    closing = _CLOSING.get(text[root.start() - 1 : root.start()])
    if closing is not None:
        end = closing.search(text, root.end(), root.end() + _LONGEST_PATH)
        if end is not None and end[0] != "\n":
            return _last_part(text[root.start() : end.start()], root), end.start()
    folder = _FOLDER_OF_STORE if root["scheme"] else _FOLDER
    last = root.end()
    while (found := folder.match(text, last)) is not None:
        last = found.end()
    if root["scheme"]:
        name = (_BUCKET if last == root.end() else _NAME_OF_STORE).match(text, last)
        assert name is not None  # it may be empty
        return root[0] if last == root.end() else name[1], name.end()
    if _HOMES.fullmatch(text, root.start(), last) and (name := _NAME_OF_HOME.match(text, last)):
        return "~", name.end()
    if last > root.end() or root[0].startswith("~"):
        return "", last
    home = _ROOT_HOME.match(text, last) if root[0] == "/" else None
    return (root[0], last) if home is None else ("~", home.end())


def _last_part(path: str, root: "re.Match[str]") -> str:
    """The last part of a text that is a path or an address of a store as a whole."""
    path = path.rstrip("/\\")
    if root["scheme"]:
        _, *folders = re.split(r"[/\\]+", path.split("?")[0][len(root[0]) :].lstrip("/\\"))
        return folders[-1] if folders else root[0]
    *folders, name = re.split(_SEPARATORS, path)
    is_home = path == "/root" or _HOMES.fullmatch(path[: len(path) - len(name)])
    return "~" if is_home else name


def _is_web(root: "re.Match[str]") -> bool:
    return (root["scheme"] or "").lower().endswith(("http", "https"))


def _with_short_home(text: str) -> str:
    """A text with ``~`` for the home folder of whoever publishes, and with paths for addresses of files."""
    text, home = _FILE_ADDRESS.sub("/", text), str(Path.home())
    if home.count("/") > 1:
        text = re.sub(rf"(?<![\w./]){re.escape(home)}(?![\w.-])", "~", text)
    return text


def _may_have_paths(values: pa.ChunkedArray | pa.Array) -> bool:
    """Whether a text of a column has a separator of folders."""
    kind = values.type
    if pa.types.is_list(kind):
        return _may_have_paths(pc.list_flatten(values))
    if pa.types.is_struct(kind):
        return any(_may_have_paths(pc.struct_field(values, each.name)) for each in kind)
    return bool(pa.types.is_string(kind) and pc.any(pc.match_substring_regex(values, _MAY_HAVE_ONE.pattern)).as_py())


def _changed(value: Any, change: Callable[[str], str]) -> Any:
    if isinstance(value, str):
        return change(value)
    if isinstance(value, list):
        return [_changed(entry, change) for entry in value]
    return {key: _changed(entry, change) for key, entry in value.items()} if isinstance(value, dict) else value
