"""Reads a file of tasks row by row: each row becomes a task or a notice with the reason."""

import csv
import json
import math
import re
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Any

import pyarrow as pa

from models.semantic_reasoner.staged_layout import LayoutTask
from stable_data.errors import ConfigError, Notice, SceneError, cannot_write
from stable_data.json_text import bounded_lines, is_cut, is_unicode, json_value, quote_value, too_many_lines
from stable_data.limits import LIMITS, at_most
from stable_data.scene import Tabletop
from stable_data.storage.parquet_files import bounded_batches, open_parquet

KEYS = ("scene_id", "instruction", "table_type", "table_size_cm", "restricted_zone_cm")
"""Columns of the file; the first and the last are optional."""

STEP = "tasks"
"""The step in notices about tasks."""

LONGEST_CM = 1000.0
"""The largest width and depth of a table, cm."""

SHORTEST_CM = 1.0
"""The smallest width and depth of a table, cm."""

_PLAIN = re.compile(r"\w[\w.-]{0,119}")
_BETWEEN = re.compile(r"[\s,;x×\[\]()]+")
_ROWS = 1024  # of a Parquet file that are in memory at once, at most


def read_tasks(path: Path) -> Iterator[LayoutTask | Notice]:
    """Reads tasks lazily, one from each row.

    Args:
        path: A file that ends in .jsonl, .csv or .parquet, with the columns KEYS. Lengths are in centimetres: lists, or text such
            as ``120 x 60`` in CSV. The restricted zone is x_min, x_max, y_min, y_max. Empty lines are skipped.

    Yields:
        A task, or a notice with the reason why the row is not a task, in the file's order. The default ``scene_id`` is the
        number of the row, ``task_000002``; the id of a notice has a space instead, so that it cannot be the id of a task.

    Raises:
        ConfigError: The file cannot be read, has another format, or contains no row (``tasks_invalid``); it has too many lines
            (``too_many_lines``).
    """
    taken: set[str] = set()
    number = 0
    try:
        for number, read in _rows(path):
            try:
                task = task_of(read(), f"task_{number:06d}")
                if task.scene_id in taken:
                    raise SceneError(f"scene_id {task.scene_id} is used twice, expected a unique id", "task_invalid")
            except SceneError as error:
                yield Notice(f"row {number:06d}", STEP, error.code, f"{path.name}, row {number}: {error}")
            else:
                taken.add(task.scene_id)
                yield task
    except (OSError, csv.Error, pa.ArrowException) as error:
        reason = (isinstance(error, OSError) and error.strerror) or str(error).strip().partition("\n")[0]
        raise _invalid_file(path, f"cannot be read ({reason})") from error
    if not number:
        raise _invalid_file(path, "contains no tasks")


def write_tasks(path: Path, tasks: Iterable[LayoutTask]) -> int:
    """Writes tasks as a file that :func:`read_tasks` reads, for other systems that make scenes for them.

    Args:
        path: The file, .jsonl.
        tasks: The tasks. Labels are not written; surroundings are a restricted zone.

    Returns:
        The number of tasks.

    Raises:
        ConfigError: The file has another suffix (``tasks_invalid``) or cannot be written.
    """
    if path.suffix != ".jsonl":
        raise ConfigError(f"{path}: ends in {path.suffix or 'nothing'}, expected a file .jsonl for the tasks", "tasks_invalid")
    lines = [json.dumps(_row_of(task), ensure_ascii=False) for task in tasks]
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text("".join(f"{line}\n" for line in lines), "utf-8")
    except OSError as error:
        raise cannot_write(str(path), error) from error
    return len(lines)


def _row_of(task: LayoutTask) -> dict[str, Any]:
    """The row of a task; lengths to a micrometre."""
    table = task.shown_table
    row: dict[str, Any] = {"scene_id": task.scene_id, "instruction": task.instruction, "table_type": table.table_type}
    lengths = {"table_size_cm": table.size_xy, "restricted_zone_cm": table.restricted_zone}
    return row | {key: [round(100 * v, 4) for v in values] for key, values in lengths.items() if values is not None}


def task_of(row: Mapping[str, Any], scene_id: str) -> LayoutTask:
    """The task of a row.

    Args:
        row: Values by the names KEYS; None and empty values count as missing.
        scene_id: The id if the row has none.

    Raises:
        SceneError: ``instruction_invalid``, ``table_invalid`` or ``task_invalid``.
    """
    values = {key: value for key, value in row.items() if value is not None and value != ""}
    if unknown := [key for key in values if key not in KEYS]:
        raise SceneError(f"has {quote_value(unknown[0])}, expected only {', '.join(KEYS)}", "task_invalid")
    instruction, table_type = values.get("instruction"), values.get("table_type")
    if not isinstance(instruction, str) or not instruction.strip():
        raise SceneError(
            f"instruction is {quote_value(row.get('instruction'))}, expected a sentence that says what to do on the table",
            "instruction_invalid",
        )
    if len(instruction) > LIMITS.text.max_instruction:
        most = at_most(LIMITS.text, "max_instruction", "characters")
        raise SceneError(f"instruction has {len(instruction):,} characters, expected {most}; shorten it", "instruction_invalid")
    if not is_unicode(instruction):
        raise SceneError("instruction is not UTF-8; save the file as UTF-8", "instruction_invalid")
    name = _name(values.get("scene_id", scene_id), "scene_id", "task_invalid")
    kind = _name("_".join(str(table_type or "").lower().split()), "table_type", "table_invalid")
    return LayoutTask(name, instruction.strip(), tabletop(kind, values.get("table_size_cm"), values.get("restricted_zone_cm")))


def tabletop(table_type: str, size_cm: object, restricted_cm: object = None) -> Tabletop:
    """A table from its lengths in centimetres.

    Args:
        table_type: The table type.
        size_cm: Width and depth.
        restricted_cm: x_min, x_max, y_min, y_max of the restricted zone, or None.

    Raises:
        SceneError: The values are not such lengths (``table_invalid``).
    """
    size = _numbers(size_cm, 2)
    if size is None or not all(SHORTEST_CM <= side <= LONGEST_CM for side in size):
        raise SceneError(
            f"table_size_cm is {quote_value(size_cm)}, expected width and depth, each from {SHORTEST_CM:g} to {LONGEST_CM:g}",
            "table_invalid",
        )
    zone = None
    if restricted_cm is not None:
        zone = _numbers(restricted_cm, 4)
        if zone is None or not (0 <= zone[0] < zone[1] <= size[0] and 0 <= zone[2] < zone[3] <= size[1]):
            raise SceneError(
                f"restricted_zone_cm is {quote_value(restricted_cm)}, expected x_min, x_max, y_min, y_max on the table",
                "table_invalid",
            )
        zone = [side / 100 for side in zone]
    width, depth = (side / 100 for side in size)
    return Tabletop(table_type, (width, depth), None if zone is None else (zone[0], zone[1], zone[2], zone[3]))


def _rows(path: Path) -> Iterator[tuple[int, Callable[[], Mapping[str, Any]]]]:
    """Yields the number of each row, from 1, with a function that reads the row and may raise a SceneError."""
    if path.suffix == ".jsonl":
        numbered = enumerate(bounded_lines(path), 1)
        yield from ((number, partial(_parse_line, line)) for number, line in numbered if line.strip())
    elif path.suffix == ".csv":
        csv.field_size_limit(LIMITS.text.max_line)
        lines = _CsvLines(path)
        reader = csv.DictReader(lines, restkey="fields beyond the header")
        _check_columns(path, list(reader.fieldnames or ()))
        yield from enumerate(_csv_rows(reader, lines), 1)
    elif path.suffix == ".parquet":
        with open_parquet(path) as file:
            if file.metadata.num_rows > LIMITS.text.max_lines:
                raise too_many_lines(path)
            _check_columns(path, list(file.schema_arrow.names))
            number = 0
            for batch in bounded_batches(file, str(path), range(file.num_row_groups), most_rows=_ROWS):
                for index in range(batch.num_rows):
                    number += 1
                    yield number, partial(_parquet_row, batch, index)
    else:
        raise _invalid_file(path, f"ends in {path.suffix or 'nothing'}")


class _CsvLines:
    """The lines of a CSV file; one that is too long is replaced by a short one that opens or closes a quotation as it does.

    Attributes:
        has_cut: Whether a line was replaced since this was last set to False.
    """

    def __init__(self, path: Path) -> None:
        self._path = path
        self.has_cut = False

    def __iter__(self) -> Iterator[str]:
        for line in bounded_lines(self._path, newline=""):
            if is_cut(line):
                self.has_cut = True
                yield '"\n' if line.count('"') % 2 else "-\n"
            else:
                yield line


def _csv_rows(reader: Iterator[dict[str, Any]], lines: _CsvLines) -> Iterator[Callable[[], Mapping[str, Any]]]:
    while True:
        lines.has_cut = False
        try:
            row = next(reader)
        except StopIteration:
            return
        except csv.Error as error:  # concerns this row alone: the reader continues with the next line
            yield partial(_refused, str(error))
        else:
            too_long = f"a line is longer, expected {at_most(LIMITS.text, 'max_line', 'characters')}"
            yield partial(_refused, too_long) if lines.has_cut else partial(dict, row)


def _refused(reason: str) -> Mapping[str, Any]:
    raise SceneError(f"cannot be read ({reason})", "task_invalid")


def _parquet_row(batch: pa.RecordBatch, index: int) -> Mapping[str, Any]:
    try:
        return {name: batch.column(name)[index].as_py() for name in batch.schema.names}
    except (ValueError, OverflowError) as error:  # text that is not UTF-8, or a time outside the range of Python
        return _refused(str(error))


def _check_columns(path: Path, names: Sequence[str]) -> None:
    if missing := [key for key in KEYS[1:4] if key not in names]:
        raise _invalid_file(path, f"has no column {missing[0]}")
    if repeated := [name for name in KEYS if list(names).count(name) > 1]:
        raise _invalid_file(path, f"has the column {repeated[0]} twice")
    if unknown := [name for name in names if name not in KEYS]:  # otherwise only the rows with a value in it would fail
        raise _invalid_file(path, f"has a column {quote_value(unknown[0])}")


def _invalid_file(path: Path, found: str) -> ConfigError:
    return ConfigError(f"{path}: {found}, expected tasks as .jsonl, .csv or .parquet with {', '.join(KEYS)}", "tasks_invalid")


def _parse_line(line: str) -> Mapping[str, Any]:
    try:
        found = json_value(line)
    except ValueError as error:
        raise SceneError(f"is not JSON ({error})", "task_invalid") from error
    if not isinstance(found, dict):
        raise SceneError(f"is {type(found).__name__}, expected an object", "task_invalid")
    return found


def _name(value: object, key: str, code: str) -> str:
    """A value as a name that is valid for a folder."""
    is_number = isinstance(value, int) and not isinstance(value, bool) and 0 <= value < 10**120
    text = str(value) if isinstance(value, str) or is_number else ""
    if not _PLAIN.fullmatch(text):
        raise SceneError(f"{key} is {quote_value(value)}, expected a plain name of letters, digits, _, - and .", code)
    return text


def _numbers(value: object, count: int) -> list[float] | None:
    """Reads ``count`` finite numbers from a list or text; None if the value is anything else."""
    if isinstance(value, str):
        value = [part for part in _BETWEEN.split(value) if part]
    if not isinstance(value, list | tuple) or len(value) != count or any(isinstance(part, bool) for part in value):
        return None
    try:
        found = [float(part) for part in value]
    except (TypeError, ValueError, OverflowError):
        return None
    return found if all(map(math.isfinite, found)) else None
