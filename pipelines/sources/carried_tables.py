"""Tables that a job copies from the run that it reads, so that its output can be used by itself."""

from collections.abc import Iterable
from pathlib import Path

from stable_data.storage.run_folder import RunFolder

CARRIED_TABLES = ("assets", "meshes", "textures", "sdf", "features")
"""The tables of assets, which training and export need."""


def carry_tables(run: RunFolder, folder: RunFolder, tables: Iterable[str] = CARRIED_TABLES) -> list[str]:
    """Copies tables file by file, those that are not there yet.

    Args:
        run: The run that has them.
        folder: The run to which they are copied.
        tables: Their names; those that the run does not have are left out.

    Returns:
        The names of the copied tables.
    """
    carried = []
    for table in tables:
        files, there = ({Path(path).name for path in each.files(table)} for each in (run, folder))
        # The first file of a shard, which has no number, is copied last: if it exists, the others do.
        for file in sorted(files - there, key=lambda name: (-name.count("-"), name)):
            content = run.read_bytes(f"{table}/{file}")
            assert content is not None  # it was just listed
            folder.write_bytes(f"{table}/{file}", content)
        carried += [table] if files else []
    return carried
