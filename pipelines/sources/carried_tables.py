"""Tables that a job copies from the run that it reads, so that its output can be used by itself."""

from collections.abc import Iterable
from pathlib import Path

import pyarrow as pa

from stable_data.errors import ConfigError, cannot_read
from stable_data.limits import LIMITS, at_most
from stable_data.storage.parquet_files import open_parquet
from stable_data.storage.run_folder import RunFolder
from stable_data.storage.schema_checks import check_schema

CARRIED_TABLES = ("assets", "meshes", "textures", "sdf", "features")
"""The tables of assets, which training and export need."""


def refuse_links_out(run: RunFolder, tables: Iterable[str] = CARRIED_TABLES) -> None:
    """Refuses a run whose tables cannot be carried, before a job begins; see :func:`carry_tables`.

    Raises:
        ConfigError: A file of a table is a link out of the run (``link_leaves``), or the folder cannot be read.
    """
    for table in tables:
        for path in run.files(table):
            run.refuse_link_out(f"{table}/{Path(path).name}")


def carry_tables(run: RunFolder, folder: RunFolder, tables: Iterable[str] = CARRIED_TABLES) -> list[str]:
    """Copies tables file by file, those that are not there yet.

    Args:
        run: The run that has them.
        folder: The run to which they are copied.
        tables: Their names; those that the run does not have are left out.

    Returns:
        The names of the copied tables.

    Raises:
        ConfigError: A file is a link out of the run (``link_leaves``), is too large (``shard_too_big``), is no Parquet file, or none of
            its table (``table_version``, ``column_missing``), or cannot be read or written.
    """
    carried = []
    for table in tables:
        files, there = ({Path(path).name for path in each.files(table)} for each in (run, folder))
        # The first file of a shard, which has no number, is copied last: if it exists, the others do.
        for file in sorted(files - there, key=lambda name: (-name.count("-"), name)):
            folder.write_bytes(f"{table}/{file}", _checked(run, table, file))
        carried += [table] if files else []
    return carried


def _checked(run: RunFolder, table: str, file: str) -> bytes:
    """The content of a file of a table, which is one of that table and lies in the run."""
    name = f"{table}/{file}"
    run.refuse_link_out(name)
    content = run.read_bytes(name, LIMITS.table.max_decoded_bytes + 1)
    assert content is not None  # it was just listed
    if len(content) > LIMITS.table.max_decoded_bytes:
        raise ConfigError(
            f"{run.uri}/{name}: is larger, expected {at_most(LIMITS.table, 'max_decoded_bytes', 'bytes')} also after it is decoded",
            "shard_too_big",
        )
    try:
        with open_parquet(pa.BufferReader(content)) as opened:
            schema = opened.schema_arrow
    except (pa.ArrowException, OSError) as error:
        raise cannot_read(run.uri, name, error) from error
    check_schema(schema, table, f"{run.uri}/{name}")
    return content
