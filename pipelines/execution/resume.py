"""What of a run's manifest is compared when the run resumes, and what of the run is checked when it ends."""

from collections.abc import Iterable, Mapping, Sequence, Set
from typing import Any

from pipelines.execution.code_history import take_over_code, with_release
from stable_data.code_version import code_version
from stable_data.config_diff import refuse_changed
from stable_data.content_id import content_id
from stable_data.errors import ConfigError
from stable_data.limits import LIMITS
from stable_data.storage import schemas
from stable_data.storage.manifest import read_manifest
from stable_data.storage.run_folder import RunFolder

OF_DATASET = content_id("dataset")
"""The shard of rows that belong to no other shard: failures and warnings about the input as a whole."""

REPLACED = "replaced_shards"
"""The key of the shards that are deleted when a grown run is complete, by table: later steps replace them."""

_COMPARED = ("job", "code_version", "table_version", "dataset")


def new_manifest(job: str, dataset: str, inputs: Mapping[str, Any], **more: Any) -> dict[str, Any]:
    """The manifest of a new run."""
    code = {"code_version": code_version(), "code_versions": [code_version()]}
    head = {"job": job, "status": "running", **code, "table_version": schemas.TABLE_VERSION}
    limits = {"limits": changed} if (changed := LIMITS.changed()) else {}
    return {**head, "dataset": dataset, "inputs": dict(inputs), "input_fingerprint": content_id(dict(inputs)), **limits, **more}


def check_resume(
    folder: RunFolder,
    manifest: dict[str, Any],
    shaping: Mapping[str, Any],
    *,
    may_be_added: Sequence[str] = (),
    grown: Set[str] = frozenset(),
) -> None:
    """Refuses to mix rows of two configurations, inputs or versions in one folder.

    Args:
        folder: The run.
        manifest: The manifest of this run; its ``inputs`` are compared one by one. Changed source code of the same version is
            not refused but recorded, see :func:`pipelines.execution.code_history.record_code`. The list ``work`` of the former
            run is copied into it, and the shards that its growth replaces.
        shaping: The settings that shape rows.
        may_be_added: Further keys of the manifest to compare if the former run has them.
        grown: Keys that may differ because the run grows, such as ``inputs.tasks``.

    Raises:
        ConfigError: The folder belongs to another run; the message lists ``key: was -> now``.
    """
    was = read_manifest(folder)
    if was is None:
        if there := [table for table in schemas.SCHEMAS if folder.files(table)]:
            raise ConfigError(
                f"{folder.uri}: contains the tables {', '.join(there)} but no manifest.json; choose a new folder",
                "manifest_missing",
            )
        return
    if was.get("job") != manifest["job"]:
        raise ConfigError(
            f"{folder.uri}: is a run of {was.get('job')}, expected a new folder or a run of {manifest['job']}; choose another folder",
            "config_changed",
        )
    keys = (*_COMPARED, *(key for key in may_be_added if was.get(key) is not None))

    def compared(found: Mapping[str, Any], settings: Mapping[str, Any]) -> dict[str, Any]:
        inputs = {f"inputs.{kind}": content for kind, content in found["inputs"].items()}
        limits = {f"limits.{name}": value for name, value in dict(found.get("limits") or {}).items()}
        every = {key: with_release(found).get(key) for key in keys} | inputs | limits
        every |= {key: settings.get(key) for key in shaping}
        return {key: value for key, value in every.items() if key not in grown}

    refuse_changed(folder.uri, compared(was, was["settings"]), compared(manifest, shaping))
    take_over_code(was, manifest)
    manifest |= {key: was[key] for key in ("work", REPLACED) if key in was}


def check_shards(folder: RunFolder, planned: Mapping[str, set[str]], carried: Mapping[str, Set[str]]) -> None:
    """Refuses a folder whose shards are not those of the plan: its rows would be of several runs.

    Args:
        folder: The run.
        planned: Ids of the shards, by table.
        carried: Ids of further shards that may be there, by table: copies from another run.

    Raises:
        ConfigError: A table has other shards, or lacks some.
    """
    for table, expected in planned.items():
        found = folder.shard_ids(table) - (carried.get(table, set()) - expected)
        if found != expected:
            foreign, absent = sorted(found - expected), sorted(expected - found)
            raise ConfigError(
                f"{folder.uri}/{table}: {len(foreign)} shards are not of this run {foreign[:3]} and {len(absent)} are missing "
                f"{absent[:3]}, expected exactly the shards of the plan; choose a new folder, or remove those shards and run again",
                "shards_differ",
            )


def count_items(folder: RunFolder, table: str, column: str, planned: Iterable[str], *, with_lost: bool = False) -> int:
    """Counts the planned items that failed.

    Args:
        folder: The run, complete.
        table: The table of the usable items.
        column: The column of their ids.
        planned: Ids of all items.
        with_lost: Whether failures of :data:`OF_DATASET` (items that failed before shards were planned) count too.

    Raises:
        ConfigError: An item is not exactly one row of its table or one failure.
    """
    usable = folder.count_values(table, [column])[column]
    # Only failures of the same shards: items of other tables may fail under the same ids.
    shard_ids = folder.shard_ids(table) | ({OF_DATASET} if with_lost else set())
    failed = folder.count_values("failures", ["id"], shard_ids)["id"]
    wanted = set(planned)
    odd = sorted({i for i in wanted if usable[i] + failed[i] != 1} | (usable.keys() - wanted))
    if odd:
        raise ConfigError(
            f"{folder.uri}: {len(odd)} {table} such as {odd[0]} are not in exactly one row of {table} or failures; "
            "choose a new folder",
            "rows_differ",
        )
    return len(wanted - usable.keys())


def count_rows(folder: RunFolder, names: Iterable[str]) -> dict[str, Any]:
    """The number of rows by table, of warnings by code, and of failures by code and step."""
    warnings, failures = folder.count_values("warnings", ["code"]), folder.count_values("failures", ["code", "step"])
    return {
        **{table: folder.num_rows(table) for table in names},
        "warnings_by_code": _sorted(warnings["code"]),
        "failures_by_code": _sorted(failures["code"]),
        "failures_by_step": _sorted(failures["step"]),
    }


def _sorted(counts: Mapping[str, int]) -> dict[str, int]:
    return dict(sorted(counts.items()))
