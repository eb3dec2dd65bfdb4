"""The manifest of a run: what is compared where a run goes on, and what is checked where it ends."""

import json
from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from typing import Any

from pipelines.execution.code_history import take_over_code, with_release
from stable_data.code_version import code_version
from stable_data.config_diff import refuse_changed
from stable_data.content_id import content_id
from stable_data.errors import ConfigError
from stable_data.storage import schemas
from stable_data.storage.run_folder import RunFolder

OF_DATASET = content_id("dataset")
"""The shard of rows that belong to no other: what is lost or odd of the input as a whole."""

_COMPARED = ("job", "code_version", "table_version", "dataset")


def new_manifest(job: str, dataset: str, inputs: Mapping[str, Any], **more: Any) -> dict[str, Any]:
    """The manifest of a run that starts."""
    code = {"code_version": code_version(), "code_versions": [code_version()]}
    head = {"job": job, "status": "running", **code, "table_version": schemas.TABLE_VERSION}
    return {**head, "dataset": dataset, "inputs": dict(inputs), "input_fingerprint": content_id(dict(inputs)), **more}


def read_manifest(folder: RunFolder) -> dict[str, Any] | None:
    """The manifest that lies in a folder; None where there is none.

    Raises:
        ConfigError: It is not a manifest (``manifest_invalid``).
    """
    content = folder.read_bytes("manifest.json")
    if content is None:
        return None
    try:
        found = dict(json.loads(content))
        return found | {key: dict(found.get(key, {})) for key in ("settings", "inputs")}
    except (ValueError, TypeError) as error:
        raise ConfigError(
            f"{folder.uri}/manifest.json: not a JSON object ({error}); is this the folder of a run?", "manifest_invalid"
        ) from error


def check_resume(
    folder: RunFolder, manifest: dict[str, Any], shaping: Mapping[str, Any], *, may_be_added: Sequence[str] = ()
) -> None:
    """Refuses to mix rows of two configurations, inputs or versions in one folder.

    Args:
        folder: The run.
        manifest: Of the run that starts; its ``inputs`` are compared one by one. Other sources of the same version are not
            refused, but noted, see :func:`pipelines.execution.code_history.record_code`. How long the former run was at work
            is taken over.
        shaping: The settings that shape rows.
        may_be_added: Keys of the manifest that are compared too, unless the former run had none of it.

    Raises:
        ConfigError: The folder is of another run: ``key: was -> now``.
    """
    was = read_manifest(folder)
    if was is None:
        if there := [table for table in schemas.SCHEMAS if folder.files(table)]:
            raise ConfigError(
                f"{folder.uri}: holds {', '.join(there)} but no manifest.json to say of what; choose a new folder",
                "manifest_missing",
            )
        return
    keys = (*_COMPARED, *(key for key in may_be_added if was.get(key) is not None))

    def compared(found: Mapping[str, Any], settings: Mapping[str, Any]) -> dict[str, Any]:
        inputs = {f"inputs.{kind}": content for kind, content in found["inputs"].items()}
        return {key: with_release(found).get(key) for key in keys} | inputs | {key: settings.get(key) for key in shaping}

    refuse_changed(folder.uri, compared(was, was["settings"]), compared(manifest, shaping))
    take_over_code(was, manifest)
    manifest |= {"work": list(was.get("work", []))}


def write_manifest(folder: RunFolder, manifest: Mapping[str, Any]) -> None:
    """Puts ``manifest.json`` in place."""
    text = json.dumps(manifest, indent=2, sort_keys=True, ensure_ascii=False) + "\n"
    folder.write_bytes("manifest.json", text.encode())


def check_shards(folder: RunFolder, planned: Mapping[str, set[str]]) -> None:
    """Refuses a folder that holds other shards than the plan's: its rows would be of several runs.

    Args:
        folder: The run.
        planned: Table -> ids of its shards.

    Raises:
        ConfigError: A table has others, or lacks some.
    """
    for table, expected in planned.items():
        found = folder.shard_ids(table)
        if found != expected:
            foreign, absent = sorted(found - expected), sorted(expected - found)
            raise ConfigError(
                f"{folder.uri}/{table}: {len(foreign)} shards are not of this run {foreign[:3]} and {len(absent)} are missing "
                f"{absent[:3]}, expected those of the plan alone; choose a new folder, or remove the former and run again",
                "shards_differ",
            )


def count_items(folder: RunFolder, table: str, column: str, planned: Iterable[str], *, with_lost: bool = False) -> int:
    """How many planned items failed.

    Args:
        folder: The run, complete.
        table: Where the usable ones are.
        column: Their ids there.
        planned: Ids of all.
        with_lost: Whether items that were lost before there were shards (those of :data:`OF_DATASET`) are among them.

    Raises:
        ConfigError: An item is not exactly one row of its table or one failure.
    """
    usable = Counter(folder.table(table, [column])[column].to_pylist())
    # Of the same shards: other items of the run, or features of these, may fail under the same names.
    shard_ids = folder.shard_ids(table) | ({OF_DATASET} if with_lost else set())
    failed = Counter(folder.table("failures", ["id"], shard_ids=shard_ids)["id"].to_pylist())
    wanted = set(planned)
    odd = sorted({i for i in wanted if usable[i] + failed[i] != 1} | (usable.keys() - wanted))
    if odd:
        raise ConfigError(
            f"{folder.uri}: {len(odd)} {table} such as {odd[0]} are not exactly one row of {table} or failures, expected "
            "each to be; choose a new folder",
            "rows_differ",
        )
    return len(wanted - usable.keys())


def count_rows(folder: RunFolder, names: Iterable[str]) -> dict[str, Any]:
    """Rows by table, and warnings and failures by kind."""
    failures = folder.table("failures", ["code", "step"])
    return {
        **{table: folder.num_rows(table) for table in names},
        "warnings_by_code": _counted(folder.table("warnings", ["code"])["code"]),
        "failures_by_code": _counted(failures["code"]),
        "failures_by_step": _counted(failures["step"]),
    }


def _counted(column: Any) -> dict[str, int]:
    return dict(sorted(Counter(column.to_pylist()).items()))
