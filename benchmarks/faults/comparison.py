"""Whether two runs of a job have the same rows."""

from collections import Counter
from pathlib import Path, PurePosixPath
from typing import Any

from stable_data.storage.run_folder import RunFolder
from stable_data.storage.schemas import SCHEMAS, Row


def compared(clean: RunFolder, other: RunFolder) -> dict[str, Any]:
    """Compares all tables of a disturbed run with those of an undisturbed one.

    No table has a column that measures time. Rows are compared as a set, with all columns; shards of the same bytes are not decoded.

    Returns:
        ``rows``: rows of the undisturbed run; ``lost``: those that the other run lacks; ``different``: those that it has with other
        values; ``doubled``: rows of the other run beyond those, of the same scene or asset; ``added``: those of other ones;
        ``files_that_differ``: files of the corrected dataset; ``columns_that_differ``, as ``table.column``.
    """
    figures, columns = Counter(rows=0, lost=0, different=0, doubled=0, added=0), list[str]()
    for table in [table for table in SCHEMAS if clean.files(table) or other.files(table)]:
        found = _compared_table(clean, other, table)
        columns += found.pop("columns")
        figures.update(found)
    return dict(figures) | {"files_that_differ": _files_that_differ(clean, other), "columns_that_differ": columns}


def _compared_table(clean: RunFolder, other: RunFolder, table: str) -> dict[str, Any]:
    first, second = ({PurePosixPath(path).name: path for path in run.files(table)} for run in (clean, other))
    same = {name for name in first.keys() & second.keys() if _content(clean, table, name) == _content(other, table, name)}
    expected, found = (
        [row for name, path in sorted(files.items()) if name not in same for row in run.read_file(table, path).to_pylist()]
        for run, files in ((clean, first), (other, second))
    )
    key = SCHEMAS[table].names[0]
    known: set[Any] = set(clean.table(table, [key])[key].to_pylist()) if first else set()
    missing, further = _without(expected, found), _without(found, expected)
    of_missing, of_further = Counter(row[key] for row in missing), Counter(row[key] for row in further)
    different, beyond = (of_missing & of_further).total(), of_further - of_missing
    changed = [row for row in missing if row[key] in of_further]
    by_key = {row[key]: row for row in further}
    names = [name for name in SCHEMAS[table].names if any(repr(row[name]) != repr(by_key[row[key]][name]) for row in changed)]
    return {
        "rows": clean.num_rows(table) if first else 0,
        "lost": len(missing) - different,
        "different": different,
        "doubled": sum(count for name, count in beyond.items() if name in known),
        "added": sum(count for name, count in beyond.items() if name not in known),
        "columns": [f"{table}.{name}" for name in names],
    }


def _without(rows: list[Row], others: list[Row]) -> list[Row]:
    """The rows that are not among others, each of which counts once."""
    left = Counter(map(repr, others))
    found = []
    for row in rows:
        text = repr(row)
        if left[text]:
            left[text] -= 1
        else:
            found.append(row)
    return found


def _content(run: RunFolder, table: str, name: str) -> bytes | None:
    return run.read_bytes(f"{table}/{name}")


def _files_that_differ(clean: RunFolder, other: RunFolder) -> int:
    """Files of the dataset that ``correct`` writes beside its tables; 0 unless both runs are on this machine."""
    if not (clean.is_local and other.is_local):
        return 0
    first, second = (
        {path.relative_to(root): path for path in root.rglob("*") if path.is_file()}
        for root in (Path(run.root) / "dataset" for run in (clean, other))
    )
    same = sum(first[name].read_bytes() == second[name].read_bytes() for name in first.keys() & second.keys())
    return len(first.keys() | second.keys()) - same
