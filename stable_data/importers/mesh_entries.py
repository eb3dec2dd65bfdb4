"""What a manifest or a preset says about a mesh file, checked."""

import csv
import io
import math
import re
from collections.abc import Iterator, Mapping
from pathlib import PurePosixPath
from typing import Any, TypedDict, cast, get_args

from stable_data.errors import ConfigError, MeshError, Notice
from stable_data.importers.boundary import Boundary, asset_id_of
from stable_data.importers.mesh_files import SUFFIXES
from stable_data.importers.source import Axis
from stable_data.json_text import json_value, number, quote_value

_MOST_TEXT = 2000  # characters of a value that is kept
_SEPARATORS = re.compile(r"[\s,;x×]+")
_TEXTS = ("category", "description", "licence", "author", "url", "set")
_COLUMNS: Mapping[str, str] = {
    "file": "file",
    "path": "file",
    "id": "id",
    "name": "name",
    "category": "category",
    "description": "description",
    "tags": "tags",
    "licence": "licence",
    "license": "licence",
    "author": "author",
    "url": "url",
    "set": "set",
    "unit_m": "unit_m",
    "scale": "unit_m",
    "size_m": "size_m",
    "size_cm": "size_cm",
    "mass": "mass",
    "mass_kg": "mass",
    "up": "up",
    "front": "front",
}


class MeshEntry(TypedDict, total=False):
    """What is known about an asset without its mesh; plain JSON.

    ``name`` as the source writes it; ``category``, ``description``, ``tags``, ``author``, ``url``, ``set`` (the set that it belongs
    to); ``licence`` with ``licence_where`` it stands, ``licence_file`` beside it; ``unit_m`` metres for each unit; ``size_m`` three
    sides of its box, z up, metres; ``mass`` kg; ``up`` and ``front`` axes of the file; ``ignored`` the columns of the manifest that
    are not known, on its first asset.
    """

    name: str
    category: str
    description: str
    tags: list[str]
    licence: str
    licence_where: str
    licence_file: str
    author: str
    url: str
    set: str
    unit_m: float
    size_m: list[float]
    mass: float
    up: str
    front: str
    ignored: str


def manifest_entries(root: Boundary, manifest: str) -> Iterator[tuple[str, str, MeshEntry] | Notice]:
    """Reads a manifest: CSV with a line of column names, or JSONL with an object a line (``.jsonl``, ``.ndjson``, ``.json``).

    Columns: ``file`` (needed; relative to the manifest), ``id``, ``name``, ``category``, ``description``, ``tags`` (separated by
    commas or semicolons, or a list), ``licence``, ``author``, ``url``, ``set``, ``scale`` or ``unit_m`` (metres for each unit of
    the file), ``size_m`` or ``size_cm`` (three sides, z up, such as ``12 8 5.5``, or a list), ``mass`` (kg), ``up`` and ``front``
    (axes of the file, such as ``y`` or ``-x``). Empty values do not count; other columns are left out.

    Args:
        root: The boundary of the source folder.
        manifest: Its path, relative to the folder.

    Yields:
        A mesh file, relative to the folder, the identifier that the row asks for (empty for none) and what the row says; or a
        notice about a row that cannot be used.

    Raises:
        ConfigError: ``manifest_unreadable``: it does not exist, is too large, no UTF-8, or has no column ``file``.
    """
    try:
        text = root.read_bytes(root.resolve(manifest), "max_manifest_bytes").decode("utf-8-sig")
    except (MeshError, UnicodeDecodeError) as error:
        raise ConfigError(
            f"manifest {manifest}: {error}; expected a CSV or JSONL file in the folder", "manifest_unreadable"
        ) from error
    folder = PurePosixPath(manifest).parent.as_posix()
    is_json = PurePosixPath(manifest).suffix.lower() in (".jsonl", ".ndjson", ".json")
    ignored: set[str] = set()
    is_first = True
    for line, row in _json_rows(text) if is_json else _csv_rows(text, manifest):
        try:
            if isinstance(row, str):
                raise ValueError(row)
            known, unknown = _known_columns(row)
            path, entry = _checked(root, folder, known)
        except (ValueError, MeshError) as error:
            message = f"{manifest} line {line}: {error}; the row is left out"
            yield Notice(_id_of_row(row, line), "find", "manifest_row_invalid", message)
            continue
        if new := sorted(unknown - ignored):
            ignored |= unknown
            if is_first:
                entry["ignored"] = ", ".join(map(quote_value, new))[:_MOST_TEXT]
        is_first = False
        entry["licence_where"] = PurePosixPath(manifest).name
        yield path, str(known.get("id", "")), entry


def _json_rows(text: str) -> Iterator[tuple[int, dict[str, Any] | str]]:
    """The rows of a JSONL, each with its line; a text says what is wrong with one."""
    for index, line in enumerate(text.splitlines(), 1):
        if not line.strip():
            continue
        try:
            row = json_value(line)
        except ValueError as error:
            yield index, f"no JSON ({error}), expected an object"
        else:
            yield index, row if isinstance(row, dict) else f"holds a {type(row).__name__}, expected an object"


def _csv_rows(text: str, manifest: str) -> Iterator[tuple[int, dict[str, Any] | str]]:
    reader = csv.reader(io.StringIO(text, newline=""))
    try:
        header = [name.strip().lower() for name in next(reader, [])]
    except csv.Error as error:
        raise ConfigError(
            f"manifest {manifest}: no CSV ({error}), expected a line of column names", "manifest_unreadable"
        ) from error
    if not {"file", "path"} & set(header):
        found = quote_value(", ".join(header))
        raise ConfigError(f"manifest {manifest}: the columns are {found}, expected one named file", "manifest_unreadable")
    while True:
        try:
            values = next(reader, None)
        except csv.Error as error:
            yield reader.line_num, f"no CSV ({error})"
            continue
        if values is None:
            return
        if len(values) > len(header):
            yield reader.line_num, f"has {len(values)} values for {len(header)} columns; are commas inside a value quoted?"
        elif any(value.strip() for value in values):
            yield reader.line_num, dict(zip(header, values, strict=False))


def _known_columns(row: dict[str, Any]) -> tuple[dict[str, Any], set[str]]:
    """The columns with a meaning and a value, by their first name, and the names of the others."""
    known: dict[str, Any] = {}
    unknown = set()
    for name, value in row.items():
        column = _COLUMNS.get(name.strip().lower())
        if column is None:
            unknown.add(name)
        elif value is not None and value not in ("", []) and not (isinstance(value, str) and not value.strip()):
            known.setdefault(column, value)
    return known, unknown


def _id_of_row(row: dict[str, Any] | str, line: int) -> str:
    named = "" if isinstance(row, str) else row.get("id") or row.get("file") or ""
    return asset_id_of(str(named)) if named else f"line_{line}"


def _checked(root: Boundary, folder: str, row: Mapping[str, Any]) -> tuple[str, MeshEntry]:
    """A row as an entry.

    Raises:
        ValueError: A value is not understood; the message says which.
        MeshError: The file is missing or outside of the folder.
    """
    if "file" not in row:
        raise ValueError("has no file, expected the path of a mesh file")
    path = root.resolve(str(row["file"]), folder)
    if PurePosixPath(path).suffix.lower() not in SUFFIXES:
        raise ValueError(f"the file is {quote_value(path)}, expected one of {', '.join(SUFFIXES)}")
    entry = MeshEntry(name=str(row.get("name") or PurePosixPath(path).stem))
    texts = {column: " ".join(str(row[column]).split())[:_MOST_TEXT] for column in _TEXTS if column in row}
    entry |= cast(MeshEntry, texts)
    if "tags" in row:
        entry["tags"] = words_of(row["tags"])
    if "unit_m" in row:
        entry["unit_m"] = _positive(row["unit_m"], "the unit", "metres for each unit of the file, more than 0")
    if "mass" in row:
        entry["mass"] = _positive(row["mass"], "the mass", "kilograms, more than 0")
    for column, unit_m in (("size_cm", 0.01), ("size_m", 1.0)):
        if column in row:
            entry["size_m"] = [unit_m * side for side in _sides(row[column], column)]
    if "up" in row:
        entry["up"] = _axis(row["up"], "up")
    if "front" in row:
        entry["front"] = _axis(row["front"], "front")
    if entry.get("up", " ")[-1] == entry.get("front", "")[-1:]:
        raise ValueError("up and front are one axis, expected two")
    return path, entry


def words_of(value: object) -> list[str]:
    """Returns a list of words from a list, or from a text with commas or semicolons."""
    items = value if isinstance(value, list) else re.split(r"[,;]", str(value))
    return [word for item in items if (word := str(item).strip()[:200])][:100]


def _positive(value: object, what: str, expected: str) -> float:
    found = number_of(value)
    if found is None or not 0 < found < math.inf:
        raise ValueError(f"{what} is {quote_value(value)}, expected {expected}")
    return found


def number_of(value: object) -> float | None:
    """Returns a number, or the number that a text holds; None for anything else."""
    if isinstance(value, str):
        try:
            return float(value)
        except ValueError:
            return None
    return number(value)


def _sides(value: object, column: str) -> list[float]:
    items = value if isinstance(value, list) else [word for word in _SEPARATORS.split(str(value).strip()) if word]
    sides = [number_of(item) for item in items]
    found = [side for side in sides if side is not None and 0 < side < math.inf]
    if len(sides) != 3 or len(found) != 3:
        raise ValueError(f"{column} is {quote_value(value)}, expected three sides, more than 0")
    return found


def _axis(value: object, column: str) -> str:
    text = str(value).strip().lower().removeprefix("+")
    if not text or text not in get_args(Axis):
        raise ValueError(f"{column} is {quote_value(value)}, expected x, y, z, -x, -y or -z")
    return text
