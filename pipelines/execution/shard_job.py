"""What all jobs share: items whose failure is a row, shards in their places, resume under one configuration only."""

import json
from collections import Counter
from collections.abc import Callable, Iterable, Mapping, Sequence
from typing import Any, Protocol, TypeAlias, TypeVar

from pipelines.execution.code_history import record_code, take_over_code, with_release
from pipelines.execution.item_progress import ItemProgress
from pipelines.execution.progress_bar import ProgressBar, ProgressTally
from pipelines.execution.ray_executor import ProcessFailure, Work, WorkerPool, alone
from stable_data.code_version import code_version
from stable_data.config_diff import differences
from stable_data.content_id import content_id
from stable_data.errors import ConfigError, Notice, StableDataError
from stable_data.storage import schemas
from stable_data.storage.run_folder import RunFolder

Rows: TypeAlias = dict[str, list[schemas.Row]]
"""Rows by table."""

I = TypeVar("I")  # noqa: E741 - an item
S = TypeVar("S", bound="Shard")

OF_DATASET = content_id("dataset")
"""The shard of rows that belong to no other: what is lost or odd of the input as a whole."""

_COMPARED = ("job", "code_version", "table_version", "dataset")


class Shard(Protocol):
    """Items that are done together."""

    @property
    def shard_id(self) -> str:
        """Content of its inputs and of the settings that shape it."""
        ...

    def __len__(self) -> int: ...


def rows_or_failure(
    item_id: str, progress: ItemProgress, make: Callable[[], Rows], *, of_the_run: tuple[type[Exception], ...] = (ConfigError,)
) -> Rows:
    """Rows of one item; where it cannot be used, a row of ``failures`` that says in which step and why.

    Args:
        item_id: What a failure is named by.
        progress: Which step it is at.
        make: Makes the rows.
        of_the_run: Errors that are not the item's but the run's, and are raised. What is read from outside can bring forth any
            but ConfigError; a job that makes its items itself names those that may pass, too.

    Raises:
        ConfigError: The run itself cannot go on.
    """
    try:
        return make()
    except of_the_run:
        raise
    except StableDataError as error:
        return {"failures": [schemas.notice_row(Notice(item_id, progress.step, error.code, str(error)))]}
    except Exception as error:  # noqa: BLE001 - the one place where what nobody foresaw becomes a row
        message = f"{item_id}: {unexpected(error)}"
        return {"failures": [schemas.notice_row(Notice(item_id, progress.step, "unexpected", message))]}


def unexpected(error: Exception) -> str:
    """What is said of an error that nobody foresaw, one line."""
    return f"{type(error).__name__}: {' '.join(str(error).split())}; please report this with the file"


def rows_alone(
    make: Callable[[I], Rows], item: I, item_id: str, *, seconds: float, prepare: Callable[[], object] | None = None
) -> Rows:
    """Rows of one item, made in a process of its own; a failure where that process dies or takes too long."""
    found = alone(make, item, seconds=seconds, prepare=prepare)
    if not isinstance(found, ProcessFailure):
        return found
    hint = {
        ProcessFailure.CRASHED: "the process that read it died; is the file hostile?",
        ProcessFailure.TIMED_OUT: f"took over {seconds:g} s; is it hostile, or is seconds_per_item too short for it?",
    }[found]
    return {"failures": [schemas.notice_row(Notice(item_id, "isolate", str(found), f"{item_id}: {hint}"))]}


def engine_off(failure: str) -> ConfigError:
    """What stops a run whose engine answers nothing any more, see :data:`models.semantic_reasoner.engines.protocol.OFF`."""
    return ConfigError(f"{failure}; what is done is kept, run again to go on", "engine_off")


def new_manifest(job: str, dataset: str, fingerprint: str, **more: Any) -> dict[str, Any]:
    """The manifest of a run that starts."""
    code = {"code_version": code_version(), "code_versions": [code_version()]}
    head = {"job": job, "status": "running", **code, "table_version": schemas.TABLE_VERSION}
    return {**head, "dataset": dataset, "input_fingerprint": fingerprint, **more}


def check_resume(
    folder: RunFolder, manifest: dict[str, Any], shaping: Mapping[str, Any], *, may_be_added: Sequence[str] = ()
) -> None:
    """Refuses to mix rows of two configurations, inputs or versions in one folder.

    Args:
        folder: The run.
        manifest: Of the run that starts; its ``inputs`` are compared one by one. Other sources of the same version are not
            refused, and :func:`run_missing` says so.
        shaping: The settings that shape rows.
        may_be_added: Keys of the manifest that are compared too, unless the former run had none of it.

    Raises:
        ConfigError: The folder is of another run: ``key: was -> now``.
    """
    content = folder.read_bytes("manifest.json")
    if content is None:
        tables_there = [table for table in schemas.SCHEMAS if folder.files(table)]
        if tables_there:
            raise ConfigError(
                f"{folder.uri}: holds {', '.join(tables_there)} but no manifest.json to say of what; choose a new folder",
                "manifest_missing",
            )
        return
    try:
        was = dict(json.loads(content))
        was_settings, was_inputs = dict(was.get("settings", {})), dict(was.get("inputs", {}))
    except (ValueError, TypeError) as error:
        raise ConfigError(
            f"{folder.uri}/manifest.json: not a JSON object ({error}); is this the folder of a run?", "manifest_invalid"
        ) from error
    compared = (*_COMPARED, *(key for key in may_be_added if was.get(key) is not None))
    before, now = with_release(was), with_release(manifest)
    changed = differences({k: before.get(k) for k in compared}, {k: now[k] for k in compared})
    changed += [f"inputs.{change}" for change in differences(was_inputs, manifest["inputs"])]
    changed += differences({k: was_settings.get(k) for k in shaping}, shaping)
    if changed:
        raise ConfigError(
            f"{folder.uri}: was made with another configuration ({'; '.join(changed)}); choose a new folder or restore it",
            "config_changed",
        )
    take_over_code(was, manifest)


def write_manifest(folder: RunFolder, manifest: Mapping[str, Any]) -> None:
    """Puts ``manifest.json`` in place."""
    text = json.dumps(manifest, indent=2, sort_keys=True, ensure_ascii=False) + "\n"
    folder.write_bytes("manifest.json", text.encode())


def run_missing(
    folder: RunFolder,
    manifest: dict[str, Any],
    shards: Sequence[S],
    tables_of: Callable[[S], Iterable[str]],
    work: Work[S, tuple[int, int]],
    workers: WorkerPool,
    name: str,
    unit: str = "item",
    tally: ProgressTally | None = None,
) -> None:
    """Does the shards whose tables are not all in place.

    Args:
        folder: The run.
        manifest: Of the run; where something is missing, the code of now is put into its ``code_versions``.
        shards: All shards.
        tables_of: Tables that a shard writes.
        work: Does one shard, and gives its items and how many of them failed.
        workers: Who does it.
        name: Of the job, on the progress bar.
        unit: Of what is counted there.
        tally: What the work tells of the shards that it is at; None: it tells nothing.
    """
    present = {table: folder.shard_ids(table) for table in {t for s in shards for t in tables_of(s)}}
    missing = [s for s in shards if not all(s.shard_id in present[table] for table in tables_of(s))]
    if missing and record_code(folder.uri, manifest):
        write_manifest(folder, manifest)
    total = sum(map(len, shards))
    with ProgressBar(name, unit, total, total - sum(map(len, missing)), tally) as bar:
        for left, (size, failures) in zip(
            reversed(range(len(missing))), workers.run(work, missing) if missing else (), strict=True
        ):
            bar.count(size, failures, left)


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


def count_items(folder: RunFolder, table: str, column: str, planned: Iterable[str]) -> int:
    """How many planned items failed.

    Args:
        folder: The run, complete.
        table: Where the usable ones are.
        column: Their ids there.
        planned: Ids of all.

    Raises:
        ConfigError: An item is not exactly one row of its table or one failure.
    """
    usable = Counter(folder.table(table, [column])[column].to_pylist())
    # Of the same shards: other items of the run, or features of these, may fail under the same names.
    shard_ids = folder.shard_ids(table) | ({OF_DATASET} if table == "scenes" else set())
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
