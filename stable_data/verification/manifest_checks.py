"""Checks the manifest of a run: that it is as it was written, and that the run has what it counts and planned."""

from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc

from stable_data.content_id import content_id
from stable_data.errors import ConfigError
from stable_data.json_text import document_of, number
from stable_data.limits import LIMITS
from stable_data.mesatask.dataset_split import SplitShares
from stable_data.metrics.judge_columns import FURTHER_COLUMNS, JUDGES, MUJOCO_COLUMNS, columns_not_filled
from stable_data.metrics.reach_columns import GRASPABLE, REACH_COLUMNS, REACHABLE, reach_columns_not_filled
from stable_data.storage.checksums import CHECKSUMS, checksum_of, checksums_in, read_checksum_file
from stable_data.storage.id_hashes import IdSet
from stable_data.storage.manifest import (
    CHECKED,
    COMPLETE,
    DIGEST,
    MANIFEST,
    PLANNED,
    PlannedItems,
    digest_of_ids,
    manifest_digest,
)
from stable_data.storage.run_folder import RunFolder
from stable_data.storage.schema_checks import is_older_version
from stable_data.storage.schemas import SCHEMAS, TABLE_VERSION
from stable_data.verification.findings import Findings
from stable_data.verification.known_ids import KEYS, leaves
from stable_data.verification.scene_checks import SplitRule, is_close
from stable_data.verification.shard_files import ShardFile

OF_DATASET = content_id("dataset")
"""The shard of failures and warnings about the input as a whole."""

_NUMBERS: Mapping[str, tuple[tuple[str, str, str, bool], ...]] = {
    "preprocess": (("scenes", "scene_id", "num_scenes", True), ("assets", "asset_id", "num_assets", False)),
    "generate": (("scenes", "scene_id", "num_tasks", True),),
    "edit": (("scenes", "scene_id", "num_edits", True),),
    **dict.fromkeys(("correct", "reach"), (("scenes", "scene_id", "num_scenes", True),)),
    "rate": (("ratings", "scene_id", "num_scenes", True),),
    "views": (("views", "scene_id", "num_scenes", True),),
    **dict.fromkeys(("demonstrate", "evaluate-policy"), (("episodes", "episode_id", "num_episodes", True),)),
    "import": (("assets", "asset_id", "num_assets", True),),
}
"""Job -> table, column, key of the number of items, and whether items lost before shards are among them: for runs that are older than
the list of planned items."""

SETTLING = frozenset({"generate", "correct", "edit"})
"""Jobs with the setting ``judges``."""

_SHARES = ("seed", "train_share", "validation_share")
"""Settings of preprocess from which the splits follow."""

_COUNTED: Mapping[str, Mapping[str, str]] = {
    "warnings": {"code": "warnings_by_code"},
    "failures": {"code": "failures_by_code", "step": "failures_by_step"},
    "corrections": {"status": "by_status"},
    "edits": {"kind": "by_kind"},
}
"""Table -> column -> key of the number of rows by its values."""


def read_raw_manifest(folder: RunFolder, findings: Findings) -> dict[str, Any] | None:
    """Returns the manifest as it stands in its file; None, and a finding, if it is missing or no manifest.

    Raises:
        ConfigError: The folder cannot be read.
    """
    content = folder.read_bytes(MANIFEST, LIMITS.text.max_document_bytes + 1)
    if content is None:
        findings.damage(MANIFEST, "is missing, expected the manifest of the run")
        return None
    try:
        found = document_of(content)
    except ValueError as error:
        findings.damage(MANIFEST, f"is no JSON text ({error})")
        return None
    if not isinstance(found, dict) or not isinstance(found.get("job"), str):
        findings.damage(MANIFEST, "is no manifest, expected a JSON object with the name of a job")
        return None
    return found


def check_manifest(manifest: Mapping[str, Any], findings: Findings) -> None:
    """Checks what a manifest says of itself."""
    digest = manifest.get(DIGEST)
    if digest is None:
        findings.cannot_know("the manifest has no digest: the run is older, and its settings may have been edited")
    elif digest != (expected := manifest_digest(manifest)):
        findings.damage(MANIFEST, f"its digest is {digest!r:.70}, expected {expected}: an entry was edited")
    inputs = manifest.get("inputs")
    if "code_versions" in manifest and manifest.get("input_fingerprint") != (expected := content_id(inputs)):
        findings.damage(
            MANIFEST, f"input_fingerprint is {manifest.get('input_fingerprint')}, expected {expected} by its inputs"
        )
    if (older := older_version(manifest)) is not None:
        findings.cannot_know(
            f"its tables are of the older version {older}, and nothing of them was checked: run stable-data upgrade RUN, and verify again"
        )
    elif TABLE_VERSION not in (manifest.get("table_version"), manifest.get("upgraded_to")):
        findings.damage(MANIFEST, f"table_version is {manifest.get('table_version')}, expected {TABLE_VERSION}")
    if manifest.get("job") == "preprocess" and settings_of(manifest).keys() >= {*_SHARES} and split_rule(manifest) is None:
        findings.damage(MANIFEST, f"its settings {', '.join(_SHARES)} are no numbers")


def older_version(manifest: Mapping[str, Any]) -> int | None:
    """Returns the version of the tables of a run that ``stable-data upgrade`` brings up to date; None for any other run."""
    version = manifest.get("upgraded_to", manifest.get("table_version"))
    return version if type(version) is int and is_older_version(str(version)) else None


def origin_of(manifest: Mapping[str, Any]) -> Mapping[str, Any]:
    """Returns the manifest of the run that made the rows: of a published run that of its origin."""
    origin = manifest.get("origin")
    return origin if manifest.get("job") == "publish" and isinstance(origin, dict) else manifest


def settings_of(manifest: Mapping[str, Any]) -> Mapping[str, Any]:
    """Returns the settings in a manifest; none if they are no mapping."""
    settings = manifest.get("settings")
    return settings if isinstance(settings, dict) else {}


def stated_checksums(folder: RunFolder, manifest: Mapping[str, Any] | None, findings: Findings) -> dict[str, str] | None:
    """Returns the checksums of a run; None, and what cannot be known, if it has none.

    Raises:
        ConfigError: The folder cannot be read.
    """
    stated = None if manifest is None else manifest.get(CHECKED)
    try:
        content = read_checksum_file(folder)
        found = None if content is None else checksums_in(content, folder)
    except ConfigError as error:
        if error.code != "checksums_invalid":
            raise
        findings.damage(CHECKSUMS, str(error))
        return None
    if content is None:
        if stated is None:
            findings.cannot_know(
                "there are no checksums: the run is older or not finished, and its files may have been changed"
            )
        else:
            findings.damage(CHECKSUMS, "is missing, expected the checksums of the run")
        return None
    if isinstance(stated, dict) and stated.get("sha256") != checksum_of(content):
        findings.damage(CHECKSUMS, f"is not the file that the manifest names ({stated.get('sha256')!r:.24}…); it was changed")
    return found


def split_rule(manifest: Mapping[str, Any]) -> SplitRule | None:
    """Returns how splits follow from scenes in a run; None if its job takes them from other runs, whose scenes may be changed."""
    manifest = origin_of(manifest)
    job, settings = manifest.get("job"), manifest.get("settings")
    if job == "preprocess" and isinstance(settings, dict):
        seed, (train, validation) = settings.get(_SHARES[0]), (number(settings.get(name)) for name in _SHARES[1:])
        if type(seed) is not int or train is None or validation is None:
            return None
        return SplitRule(SplitShares(seed, train, validation))
    return SplitRule(SplitShares(), "generated") if job == "generate" else None


def num_planned(manifest: Mapping[str, Any], table: str) -> int | None:
    """Returns how many items of a table a run had planned; None if its manifest does not say it."""
    listed = manifest.get(PLANNED)
    entries = [entry for entry in listed if isinstance(entry, dict)] if isinstance(listed, list) else []
    found = [entry.get("count") for entry in entries if entry.get("table") == table]
    return found[0] if len(found) == 1 and isinstance(found[0], int) else None


def important_threshold(manifest: Mapping[str, Any]) -> float | None:
    """Returns the setting with which a run of preprocess set the stages of its scenes; None for other runs, or without a number."""
    return number(settings_of(manifest).get("important_threshold")) if manifest.get("job") == "preprocess" else None


def unasked_columns(manifest: Mapping[str, Any]) -> dict[str, str]:
    """Returns the columns of ``scenes`` that a run leaves null: verdicts of judges and robots that its settings do not name.

    Args:
        manifest: The manifest of the run that made the rows.

    Returns:
        Column -> the judge, or the setting, that would fill it; none for a job that copies rows, or whose settings do not say it.
    """
    job, settings = manifest.get("job"), settings_of(manifest)
    if job not in (*SETTLING, "preprocess"):
        return {}
    asked = settings if job in SETTLING else {"judges": "", "arbiter": "", "robust_rest": 0, "robot": ""}
    judges, arbiter, robot, found = asked.get("judges"), asked.get("arbiter", ""), asked.get("robot"), dict[str, str]()
    if isinstance(judges, str) and isinstance(arbiter, str):
        named = [name for name in JUDGES if name in f"{judges},{arbiter}"]
        has_share = asked.get("robust_rest") != 0  # an older run does not have it
        found |= columns_not_filled((*MUJOCO_COLUMNS, *FURTHER_COLUMNS), named, has_share)
    if isinstance(robot, str):
        found |= reach_columns_not_filled(REACH_COLUMNS, robot, 1 if asked.get("grasp_tries") != 0 else 0)
    return found


@dataclass(slots=True)
class _Items:
    """Planned items, and those that were found."""

    planned: PlannedItems
    rows: IdSet
    failed: IdSet


class CountCheck:
    """Counts rows, and compares their numbers with those of the manifest.

    Args:
        manifest: The manifest.
        files: All files of the run.
        findings: Where damage is noted.
    """

    def __init__(self, manifest: Mapping[str, Any], files: Sequence[ShardFile], findings: Findings) -> None:
        self._manifest, self._findings = manifest, findings
        counts = manifest.get("counts")
        self._counts: Mapping[str, Any] = counts if isinstance(counts, dict) else {}
        self.rows = Counter[str](dict.fromkeys((file.table for file in files), 0))
        self._by_value = {key: Counter[str]() for keys in _COUNTED.values() for key in keys.values()}
        self._numbers = Counter[str]()
        self._by_task = dict[str, list[int]]()
        self._reasons, self._hashes = Counter[str](), IdSet()
        self._num_hashes, self._averages = 0, list[float]()
        self._shard_ids: dict[str, set[str]] = {}
        for file in files:
            self._shard_ids.setdefault(file.table, set()).add(file.shard_id)
        self._items = [_Items(planned, IdSet(), IdSet()) for planned in self._planned()]

    def _planned(self) -> list[PlannedItems]:
        """The planned items of the manifest; for an older one their numbers alone."""
        listed = self._manifest.get(PLANNED)
        if isinstance(listed, list):
            try:
                return list(map(_planned_items, listed))
            except TypeError as error:
                self._findings.damage(MANIFEST, f"{PLANNED} has an entry of another form ({error})")
                return []
        found = [
            PlannedItems(table, column, self._manifest[key], "", lost)
            for table, column, key, lost in _NUMBERS.get(str(self._manifest.get("job")), ())
            if isinstance(self._manifest.get(key), int)
        ]
        if not found:
            self._findings.cannot_know(
                "the manifest does not say which items were planned: the run is older, and rows may be missing"
            )
        return found

    def note(self, rows: pa.Table, file: ShardFile) -> None:
        """Counts the rows of a row group."""
        table = file.table
        self.rows[table] += rows.num_rows
        for column, key in _COUNTED.get(table, {}).items():
            for entry in pc.value_counts(_column(rows, table, column)).to_pylist():
                self._by_value[key][entry["values"]] += entry["counts"]
        for items in self._items:
            plan = items.planned
            if table == plan.table and plan.column.partition(".")[0] in rows.column_names:
                try:
                    ids = leaves(rows, plan.column, 0)[0]
                    if not pa.types.is_string(ids.type):
                        raise TypeError(f"they are {ids.type}")
                    items.rows.add(ids)
                except (pa.ArrowException, LookupError, TypeError, ValueError) as error:
                    self._findings.damage(MANIFEST, f"{PLANNED} names the column {plan.column}, which holds no ids ({error})")
            of_plan = self._shard_ids.get(plan.table, set()) | ({OF_DATASET} if plan.lost else set())
            if table == "failures" and file.shard_id in of_plan:
                items.failed.add(rows["id"])
        self._note_job(rows, table)

    def _note_job(self, rows: pa.Table, table: str) -> None:
        """Counts what the job of the run counts besides."""
        if table == "scenes":
            for name in (REACHABLE, GRASPABLE):
                if name in rows.column_names:
                    self._numbers[name] += pc.sum(rows[name]).as_py() or 0
        elif table == "assets" and "geometry_hash" in rows.column_names:
            hashes = [name for name in rows["geometry_hash"].to_pylist() if name]
            self._num_hashes += len(hashes)
            self._hashes.add(pa.array(hashes, pa.string()))
        elif table == "episodes":
            of_episodes = (_column(rows, table, name).to_pylist() for name in ("task_kind", "success", "reason"))
            for kind, success, reason in zip(*of_episodes, strict=True):
                done = self._by_task.setdefault(kind, [0, 0])
                done[0], done[1] = done[0] + bool(success), done[1] + 1
                if not success:
                    self._reasons[str(reason).partition(":")[0]] += 1
        elif table == "ratings":
            averages, passes = (_column(rows, table, name) for name in ("average", "quality_pass"))
            self._averages += [value for value in averages.to_pylist() if value is not None]
            self._numbers["passed"] += pc.sum(passes).as_py() or 0
            self._numbers["passes_known"] += rows.num_rows - passes.null_count

    def close(self, *, has_checksums: bool) -> None:
        """Compares the numbers.

        Args:
            has_checksums: Whether the run has checksums: then it may have tables that its job did not count.
        """
        for items in self._items:
            self._compare_items(items)
        if self._manifest.get("status") != COMPLETE:
            return
        for table, count in self.rows.items():
            stated = self._counts.get(table)
            if stated is None and count and not has_checksums:
                self._findings.cannot_know(f"table {table}: the manifest does not count its {count} rows")
            elif stated is not None and stated != count:
                self._findings.damage(table, f"has {count} rows, expected {stated} as the manifest counts")
        for table, stated in self._counts.items():
            if table in SCHEMAS and table not in self.rows:
                self._findings.damage(table, f"is missing, expected the {stated} rows that the manifest counts")
        for key, found in self._found().items():
            if key in self._counts and not _is_same(self._counts[key], found):
                self._findings.damage(MANIFEST, f"counts.{key} is {self._counts[key]}, expected {found} by the rows")

    def _found(self) -> dict[str, Any]:
        """Further counts by their keys in the manifest."""
        job, found = self._manifest.get("job"), dict[str, Any]({key: dict(counts) for key, counts in self._by_value.items()})
        if job == "reach":
            found |= {name: self._numbers[name] for name in (REACHABLE, GRASPABLE)}
        elif job == "import":
            found["copies"] = self._num_hashes - len(self._hashes)
        elif job in ("demonstrate", "evaluate-policy"):
            found["successes"] = sum(done for done, _ in self._by_task.values())
            if job == "demonstrate":
                found |= {"by_task": self._by_task, "by_reason": dict(self._reasons)}
        elif job == "rate":
            mean = round(float(np.mean(self._averages)), 4) if self._averages else None
            found |= {"rated": len(self._averages), "average": mean} | {n: self._numbers[n] for n in ("passed", "passes_known")}
        return found

    def _compare_items(self, items: _Items) -> None:
        plan, rows, failed = items.planned, items.rows, items.failed
        both = int((~_not_in(failed, rows)).sum())
        if both and plan.column in KEYS.get(plan.table, ()):
            self._findings.damage(plan.table, f"{both} items are rows and failures, expected each to be one of them")
        if self._manifest.get("status") != COMPLETE:
            return
        whole = IdSet.union(rows, failed)
        if len(whole) != plan.count:
            self._findings.damage(
                plan.table,
                f"{len(whole)} items are rows ({len(rows)}) or failures ({len(failed)}), expected the {plan.count} that were planned",
            )
        elif plan.digest and digest_of_ids(whole) != plan.digest:
            self._findings.damage(
                plan.table, f"its {plan.count} items are not those that were planned: one was renamed or exchanged"
            )
        stated = self._counts.get(plan.failed_key or "")
        if stated is not None and stated != plan.count - len(rows):
            self._findings.damage(
                MANIFEST, f"counts.{plan.failed_key} is {stated}, expected {plan.count - len(rows)} by the rows of {plan.table}"
            )


def _column(rows: pa.Table, table: str, name: str) -> pa.ChunkedArray | pa.Array:
    """A column of rows of a table; nulls if the file lacks it."""
    return rows[name] if name in rows.column_names else pa.nulls(rows.num_rows, SCHEMAS[table].field(name).type)


def _planned_items(entry: Any) -> PlannedItems:
    """The planned items of an entry of the manifest.

    Raises:
        TypeError: It has another form.
    """
    items = PlannedItems(**entry)
    texts = (items.table, items.column, items.digest, items.failed_key or "")
    if not all(type(text) is str for text in texts) or type(items.count) is not int or type(items.lost) is not bool:
        raise TypeError("a value has another type")
    return items


def _not_in(ids: IdSet, others: IdSet) -> np.ndarray[Any, np.dtype[np.bool_]]:
    return ~others.has_hashes(ids.hashes)


def _is_same(stated: Any, found: Any) -> bool:
    """Whether a count of the manifest is that of the rows."""
    if isinstance(found, Mapping):
        return isinstance(stated, dict) and {k: v for k, v in stated.items() if v} == {str(k): v for k, v in found.items() if v}
    return is_close(stated, found) or (isinstance(found, float) and isinstance(stated, float) and abs(stated - found) < 2e-4)
