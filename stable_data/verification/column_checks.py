"""Checks the schema of every file, and every value of every column, a row group at a time."""

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc

from stable_data.code_version import code_version
from stable_data.scene import IntArray
from stable_data.storage.schema_checks import missing_columns, version_of
from stable_data.storage.schemas import REQUIRED, SCHEMAS, TABLE_VERSION
from stable_data.verification.column_rules import RULES, ColumnRules
from stable_data.verification.findings import Findings
from stable_data.verification.shard_files import ShardFile, as_array

_UNIT = 1e-5  # largest difference of the norm of a quaternion from 1


class SchemaCheck:
    """Compares the schemas of the files of a run with those of its tables, and with one another.

    Args:
        made_by: Versions of the code that made the run, as the manifest lists them: a run of this code has every column.
        carried: Tables that may come from another run, whose code may have been older.
        findings: Where damage is noted.
    """

    def __init__(self, made_by: list[str], carried: frozenset[str], findings: Findings) -> None:
        self._is_of_this_code, self._is_of_one_code = made_by == [code_version()], len(made_by) == 1
        self._carried, self._findings = carried, findings
        self._first: dict[str, tuple[str, list[str]]] = {}

    def check(self, schema: pa.Schema, file: ShardFile) -> bool:
        """Checks the schema of a file; returns whether its rows can be checked."""
        table, expected, is_usable = file.table, SCHEMAS[file.table], True
        name = (schema.metadata or {}).get(b"stable_data.table", b"none").decode(errors="replace")
        if name != table:
            self._findings.damage(file.name, f"its metadata say table {name}, expected {table}")
        if version_of(schema) != str(TABLE_VERSION):
            self._findings.damage(file.name, f"is of table version {version_of(schema)}, expected {TABLE_VERSION}")
            is_usable = False
        for column in schema:
            if column.name not in expected.names:
                self._findings.damage(file.name, f"has a column {column.name}, which table {table} does not have")
            elif not _is_part(column.type, expected.field(column.name).type):
                self._findings.damage(
                    file.name, f"column {column.name} is {column.type}, expected {expected.field(column.name).type}"
                )
                is_usable = False
        if len(set(schema.names)) < len(schema.names):
            self._findings.damage(file.name, "has two columns of one name")
            return False
        if lost := sorted(set(REQUIRED[table]) - set(schema.names)):
            self._findings.damage(file.name, f"column {', '.join(lost)} is missing, expected in every table {table}")
            return False
        self._compare_missing(missing_columns(schema, expected), file)
        return is_usable

    def _compare_missing(self, missing: list[str], file: ShardFile) -> None:
        """Looks for columns that were there when the file was written."""
        first, was = self._first.setdefault(file.table, (file.name, missing))
        if missing and self._is_of_this_code and file.table not in self._carried:
            self._findings.damage(
                file.name, f"column {', '.join(missing)} is missing, but the code that made the run writes it"
            )
        elif missing != was and self._is_of_one_code and file.table not in self._carried:
            there = ", ".join(sorted(set(missing) ^ set(was)))
            self._findings.damage(file.name, f"column {there} is in one of {first} and this file alone, expected equal columns")


def _is_part(found: pa.DataType, expected: pa.DataType) -> bool:
    """Whether a type is another one, perhaps without some of the fields of its structs."""
    if pa.types.is_list(expected):
        return bool(pa.types.is_list(found)) and _is_part(found.value_type, expected.value_type)
    if pa.types.is_struct(expected):
        names = {each.name: each.type for each in expected}
        return bool(pa.types.is_struct(found)) and all(
            each.name in names and _is_part(each.type, names[each.name]) for each in found
        )
    return bool(found == expected)


def check_values(rows: pa.Table, start: int, file: ShardFile, findings: Findings) -> None:
    """Checks every value of some rows against the rules of their table; numbers are finite, and elements of lists are not null.

    Args:
        rows: Rows of a file.
        start: Number of the first of them in the file.
        file: The file.
        findings: Where damage is noted; of one column only its first row with each fault.
    """
    rules, numbers = RULES[file.table], np.arange(start, start + rows.num_rows)
    for name in rows.column_names:
        for fault, row in _faults(as_array(rows[name]), name, numbers, rules):
            findings.damage(file.name, fault, int(row))


def _faults(values: pa.Array, path: str, rows: IntArray, rules: ColumnRules) -> list[tuple[str, int]]:
    """The faults of the values of a column or of one of its fields, each with its first row."""
    found = list[tuple[str, int]]()
    if values.null_count:
        is_null = values.is_null().to_numpy(zero_copy_only=False)
        if path in rules.given:
            found.append((f"{path} is null, expected a value", rows[is_null][0]))
        values, rows = values.drop_null(), rows[~is_null]
    if not len(values):
        return found
    if pa.types.is_list(values.type):
        return found + _faults_of_list(values, path, rows, rules)
    if pa.types.is_struct(values.type):
        for each in values.type:
            found += _faults(as_array(pc.struct_field(values, each.name)), f"{path}.{each.name}", rows, rules)
        return found
    if path in rules.words:
        is_odd = ~pc.is_in(values, pa.array(sorted(rules.words[path]), pa.string())).to_numpy(zero_copy_only=False)
        if is_odd.any():
            odd = values[int(is_odd.argmax())].as_py()
            found.append((f"{path} is {odd!r:.60}, expected one of {', '.join(sorted(rules.words[path]))}", rows[is_odd][0]))
    if pa.types.is_floating(values.type) or pa.types.is_integer(values.type):
        found += _faults_of_numbers(values, path, rows, rules)
    return found


def _faults_of_list(values: pa.Array, path: str, rows: IntArray, rules: ColumnRules) -> list[tuple[str, int]]:
    found, lengths = list[tuple[str, int]](), pc.list_value_length(values).to_numpy(zero_copy_only=False)
    if path in rules.lengths and (lengths != rules.lengths[path]).any():
        odd = lengths != rules.lengths[path]
        return [(f"{path} has {lengths[odd][0]} elements, expected {rules.lengths[path]}", rows[odd][0])]
    inner, inner_rows = values.flatten(), np.repeat(rows, lengths)
    if inner.null_count:
        is_null = inner.is_null().to_numpy(zero_copy_only=False)
        return [(f"{path} has an element that is null, expected values", inner_rows[is_null][0])]
    found += _faults(inner, path, inner_rows, rules)
    if path in rules.units and not found and len(inner):
        norms = np.linalg.norm(inner.to_numpy(zero_copy_only=False).reshape(-1, rules.lengths[path]), axis=1)
        is_odd = ~(np.abs(norms - 1) <= _UNIT)
        if is_odd.any():
            found.append((f"{path} has norm {norms[is_odd][0]:.6g}, expected 1", rows[is_odd][0]))
    return found


def _faults_of_numbers(values: pa.Array, path: str, rows: IntArray, rules: ColumnRules) -> list[tuple[str, int]]:
    numbers = values.to_numpy(zero_copy_only=False)
    limits = {"a finite number": ~np.isfinite(numbers)}
    with np.errstate(invalid="ignore"):
        if path in rules.shares:
            limits["a share from 0 to 1"] = (numbers < 0) | (numbers > 1 + 1e-12)
        if path in rules.counts:
            limits["a number from 0"] = numbers < 0
    for expected, is_odd in limits.items():
        if is_odd.any():
            return [(f"{path} is {numbers[is_odd][0]}, expected {expected}", rows[is_odd][0])]
    return []
