"""Checks of files against the schemas: versions, missing columns, and null for a column that a file lacks."""

import warnings
from collections.abc import Iterable, Sequence

import pyarrow as pa

from stable_data.errors import ConfigError, MissingColumnsWarning
from stable_data.storage.schemas import NONE_IF_NULL, REQUIRED, TABLE_VERSION

OLDEST_VERSION = 1
"""The oldest version of tables that can be brought up to date: its tables differ from those of today by columns that were added."""


def version_of(schema: pa.Schema) -> str:
    """The version of the tables with which a file was written, as text; ``none`` if the file does not say."""
    return str((schema.metadata or {}).get(b"stable_data.version", b"none").decode("utf-8", "backslashreplace"))[:40]


def is_older_version(version: str) -> bool:
    """Whether tables of a version can be brought up to date."""
    return version in map(str, range(OLDEST_VERSION, TABLE_VERSION))


def check_schema(schema: pa.Schema, table: str, where: str) -> None:
    """Checks that a file of a table can be read as the current version.

    Args:
        schema: Schema of the file.
        table: Name in SCHEMAS.
        where: The file or table, for the message.

    Raises:
        ConfigError: The version is not TABLE_VERSION (``table_version``), or a REQUIRED column is missing (``column_missing``).
    """
    found = version_of(schema)
    if found != str(TABLE_VERSION):
        remedy = (
            "bring the run up to date with: stable-data upgrade RUN"
            if is_older_version(found)
            else "install the version of stable-data that wrote it, or a newer one"
            if found.isascii() and found.isdigit() and int(found) > TABLE_VERSION
            else "run the job again into a new folder"
        )
        raise ConfigError(f"{where}: written as table version {found}, expected {TABLE_VERSION}; {remedy}", "table_version")
    check_required(schema, table, where)


def check_required(schema: pa.Schema, table: str, where: str) -> None:
    """Checks that a file of a table has the columns without which its rows cannot be used.

    Raises:
        ConfigError: A REQUIRED column is missing (``column_missing``).
    """
    if missing := set(REQUIRED[table]).difference(schema.names):
        raise ConfigError(
            f"{where}: column {', '.join(sorted(missing))} is missing, expected in every table {table}; "
            "run the job again into a new folder",
            "column_missing",
        )


def conform_to_schema(table: pa.Table, schema: pa.Schema) -> pa.Table:
    """Returns a table with the columns, order and types of a schema; missing columns and struct fields are null.

    Raises:
        ConfigError: A column occurs twice, or its values cannot have the type of the schema (``column_invalid``).
    """
    present = dict(zip(table.column_names, table.columns, strict=True))
    if len(present) < table.num_columns:
        raise _invalid_column("a column occurs twice, expected each once")
    columns = []
    for column in schema:
        found = present.get(column.name)
        if found is None:
            columns.append(pa.nulls(len(table), column.type))
            continue
        try:
            columns.append(found if found.type == column.type else found.cast(column.type))
        except (pa.ArrowException, ValueError) as error:
            what = f"column {column.name} has the type {found.type!s:.80} ({error!s:.120}), expected {column.type!s:.80}"
            raise _invalid_column(what) from error
    return pa.Table.from_arrays(columns, schema=schema)


def _invalid_column(what: str) -> ConfigError:
    return ConfigError(f"{what}; was the file written by this project? Run the job again into a new folder", "column_invalid")


def missing_columns(found: Iterable[pa.Field], expected: Iterable[pa.Field]) -> list[str]:
    """Returns the names of missing columns, and the dotted names of missing struct fields."""
    types, names = {column.name: column.type for column in found}, list[str]()
    for column in expected:
        if column.name not in types:
            names.append(column.name)
        else:
            names += (f"{column.name}.{name}" for name in missing_columns(_struct(types[column.name]), _struct(column.type)))
    return names


def _struct(type_: pa.DataType) -> Sequence[pa.Field]:
    """The fields of a struct or of a list of structs; empty for another type."""
    while pa.types.is_list(type_):
        type_ = type_.value_type
    return list(type_) if pa.types.is_struct(type_) else []


def warn_of_missing_columns(where: str, table: str, missing: Iterable[str], condition: Iterable[str] = ()) -> None:
    """Warns in one line of columns that a run lacks because it is older than they are; does nothing if no column is missing.

    Args:
        where: The run.
        table: Name in SCHEMAS.
        missing: Result of :func:`missing_columns`.
        condition: Columns that a condition on the rows names.
    """
    condition = list(dict.fromkeys(condition))
    missing = [name for name in dict.fromkeys(missing) if name in condition or name not in NONE_IF_NULL]
    if not missing:
        return
    message = f"{where}: table {table} was written before {', '.join(missing)} existed; they are read as null (unknown)"
    unknown = [name for name in condition if name in missing]
    if unknown:
        message += (
            f"; the condition names {', '.join(unknown)}, and rows with null there do not pass: "
            f'run the job again into a new folder, or write "{unknown[0]} is None or ..."'
        )
    warnings.warn(message, MissingColumnsWarning, stacklevel=3)
