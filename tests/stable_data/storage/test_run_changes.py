"""Runs that change in their folder: older ones are brought up to date, and what was rejected is deleted."""

import json
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pyarrow as pa
import pyarrow.parquet as pq
import pytest

from stable_data.errors import ConfigError
from stable_data.storage import run_changes
from stable_data.storage.checksums import CHECKSUMS, forget_shards, read_checksums
from stable_data.storage.manifest import read_manifest
from stable_data.storage.run_changes import PRUNED, prune, upgrade
from stable_data.storage.run_folder import RunFolder
from stable_data.storage.schemas import SCHEMAS, TABLE_VERSION
from stable_data.storage.subset import select, used_assets
from stable_data.storage.torch_dataset import TableStream
from stable_data.verification.verifier import VerifyOptions, verify_run
from tests.pipelines.runs import content

STORED = Path(__file__).parents[2] / "data"


def copy_of(name: str, tmp_path: Path) -> RunFolder:
    return RunFolder(shutil.copytree(STORED / name, tmp_path / "run"))


def with_rejected(folder: Path) -> RunFolder:
    """A stored run of generate as if its first scene had been rejected."""
    run = copy_of("run_v3/generate", folder)
    every = run.table("scenes")
    assert len(every) > 1
    for table, rows in (("scenes", every.slice(1)), ("rejected", every.slice(0, 1))):
        for number, shard_id in enumerate(sorted(run.shard_ids(table))):
            own = rows if number == 0 else rows.slice(0, 0)
            run.write_table(table, shard_id, own.replace_schema_metadata(SCHEMAS[table].metadata))
    manifest = read_manifest(run) or {}
    counts = {table: run.num_rows(table) for table in ("scenes", "rejected")}
    (Path(run.root) / "manifest.json").write_text(json.dumps(manifest | {"counts": manifest["counts"] | counts}))
    return run


@pytest.mark.parametrize("version", [1, 2])
@pytest.mark.filterwarnings("error")
def test_a_run_of_an_older_version_is_read_after_one_call(version: int, tmp_path: Path) -> None:
    run = copy_of(f"run_v{version}", tmp_path)
    with pytest.raises(ConfigError, match=rf"written as table version {version}, .* stable-data upgrade RUN"):
        run.table("scenes")
    stored = pq.read_table(run.files("scenes")[0]).to_pylist()
    num_files = sum(len(run.files(table)) for table in SCHEMAS)
    assert upgrade(run).num_files == num_files > 7
    for table in filter(run.files, SCHEMAS):
        assert run.table(table).schema.equals(SCHEMAS[table], check_metadata=True)
    for was, row in zip(stored, run.table("scenes").to_pylist(), strict=True):
        assert {key: row[key] for key in was if key not in ("objects", "task")} == {
            key: value for key, value in was.items() if key not in ("objects", "task")
        }
        assert row["stable"] is None
        for before, now in zip(was["objects"], row["objects"], strict=True):
            assert before.items() <= now.items()
    assert len(list(TableStream(run.uri))) == 2
    manifest = read_manifest(run)
    assert manifest is not None
    assert (manifest["table_version"], manifest["upgraded_to"]) == (version, TABLE_VERSION)
    before = content(Path(run.uri))
    assert str(upgrade(run)) == "is up to date"
    assert content(Path(run.uri)) == before


def test_an_upgrade_that_was_stopped_goes_on(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    run = copy_of("run_v1", tmp_path)
    num_files, written = sum(len(run.files(table)) for table in SCHEMAS), RunFolder.write_file
    left = iter(range(3))

    def stopping(self: RunFolder, *arguments: object) -> None:
        if next(left, None) is None:
            raise KeyboardInterrupt
        written(self, *arguments)  # type: ignore[arg-type]

    with monkeypatch.context() as patch:
        patch.setattr(RunFolder, "write_file", stopping)
        with pytest.raises(KeyboardInterrupt):
            upgrade(run)
    assert upgrade(run).num_files == num_files - 3
    assert len(list(TableStream(run.uri))) == 2


def test_versions_that_nobody_knows_are_left_alone(tmp_path: Path) -> None:
    run = copy_of("run_v1", tmp_path)
    path = Path(run.files("scenes")[0])
    rows = pq.read_table(path)
    for version in ("0", "99", "\xff"):
        pq.write_table(rows.replace_schema_metadata({"stable_data.version": version.encode("latin-1")}), path)
        before = content(Path(run.uri))
        with pytest.raises(ConfigError, match="written as table version"):
            upgrade(run)
        assert content(Path(run.uri)) == before
    with pytest.raises(ConfigError, match=r"no manifest\.json"):
        upgrade(RunFolder(tmp_path / "nothing"))


def test_what_was_rejected_is_deleted_with_what_only_it_used(tmp_path: Path) -> None:
    run = with_rejected(tmp_path)
    scenes, turns, failures = (run.table(name) for name in ("scenes", "turns", "failures"))
    used, rejected = used_assets(scenes), run.table("rejected")
    ids = set(run.table("assets", ["asset_id"])["asset_id"].to_pylist())
    assert rejected.num_rows
    assert used < ids == used | used_assets(rejected)
    deleted = prune(run)
    assert deleted["rejected"] == rejected.num_rows
    assert deleted["assets"] == deleted["meshes"] == len(ids - used)
    assert not run.num_rows("rejected")
    for table in ("assets", "meshes"):
        assert set(run.table(table, ["asset_id"])["asset_id"].to_pylist()) == used
    assert set(run.table("settled", ["scene_id"])["scene_id"].to_pylist()) <= set(scenes["scene_id"].to_pylist())
    assert (run.table("scenes"), run.table("turns"), run.table("failures")) == (scenes, turns, failures)
    manifest = read_manifest(run)
    assert manifest is not None
    assert manifest["counts"]["assets"] == len(used)
    assert manifest[PRUNED] == deleted
    assert list(TableStream(run.uri))
    assert set(prune(run).values()) == {0}
    assert (read_manifest(run) or {})[PRUNED] == deleted


@pytest.mark.filterwarnings("ignore::stable_data.errors.MissingColumnsWarning")
def test_an_upgrade_says_that_it_added_checksums_and_a_plan(tmp_path: Path) -> None:
    run = copy_of("run_v3/generate", tmp_path)
    assert str(upgrade(run)) == "its files had no checksums, and have those of today"
    chosen = RunFolder(str(tmp_path / "chosen"))
    select(run, "num_objects >= 1", chosen)
    was = read_manifest(chosen) or {}
    (tmp_path / "chosen" / CHECKSUMS).unlink()
    (tmp_path / "chosen" / "manifest.json").write_text(
        json.dumps({key: value for key, value in was.items() if key not in ("planned", "digest", "checksums")})
    )
    assert not verify_run(chosen, print, VerifyOptions(verdicts="none")).is_whole
    assert "those that are there count as all" in str(upgrade(chosen))
    assert verify_run(chosen, print, VerifyOptions(verdicts="none")).is_whole


@pytest.mark.parametrize("change", [upgrade, prune])
@pytest.mark.parametrize("damage", ["changed", "removed", "edited manifest"])
def test_damage_is_not_hidden_by_a_change(damage: str, change: Callable[[RunFolder], object], tmp_path: Path) -> None:
    run = copy_of("run_v3/generate", tmp_path)
    upgrade(run)  # from now on it has checksums
    path = Path(run.files("assets")[0])
    if damage == "removed":
        path.unlink()
    elif damage == "changed":
        rows = pq.read_table(path)
        mass = rows.schema.get_field_index("mass")
        pq.write_table(rows.set_column(mass, rows.schema.field(mass), pa.array([99.0] * len(rows))), path)
    else:
        manifest = tmp_path / "run" / "manifest.json"
        manifest.write_text(manifest.read_text().replace('"seed": 0', '"seed": 1'))
    before = {file: file.read_bytes() for file in (tmp_path / "run").rglob("*") if file.is_file() and file.name != ".lock"}
    with pytest.raises(ConfigError) as caught:
        change(run)
    assert caught.value.code == ("manifest_changed" if damage == "edited manifest" else "shard_changed")
    assert {file: file.read_bytes() for file in before} == before


def test_checksums_of_shards_that_are_made_anew_are_forgotten(tmp_path: Path) -> None:
    run = copy_of("run_v3/generate", tmp_path)
    upgrade(run)
    known = read_checksums(run) or {}
    shard_id = min(run.shard_ids("scenes"))
    forget_shards(run, {"scenes": {shard_id}, "turns": {shard_id}, "meshes": set()})
    assert known.items() - (read_checksums(run) or {}).items() == {
        (name, known[name]) for name in (f"{table}/part-{shard_id}.parquet" for table in ("scenes", "turns"))
    }


def test_a_prune_that_was_stopped_is_completed_and_counts_all(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    run = with_rejected(tmp_path / "undisturbed")
    expected = prune(run)
    assert expected["assets"]
    again = with_rejected(tmp_path / "stopped")
    with monkeypatch.context() as patch:
        change, done = run_changes._change, list[str]()

        def stopped(run: RunFolder, table: str, *rest: Any) -> int:
            if len(done) == 2:
                raise KeyboardInterrupt
            done.append(table)
            return change(run, table, *rest)

        patch.setattr(run_changes, "_change", stopped)
        with pytest.raises(KeyboardInterrupt):
            prune(again)
    assert prune(again) == expected
    found = [read_manifest(one) or {} for one in (run, again)]
    assert found[1][PRUNED] == found[0][PRUNED] == expected
    assert found[1]["counts"] == found[0]["counts"]


def test_runs_that_cannot_be_pruned(tmp_path: Path) -> None:
    run = copy_of("run_v3/generate", tmp_path)
    (tmp_path / "run" / "manifest.json").write_text(json.dumps((read_manifest(run) or {}) | {"status": "running"}))
    before = content(tmp_path / "run")
    with pytest.raises(ConfigError, match="is not complete"):
        prune(run)
    assert content(tmp_path / "run") == before
    other = RunFolder(shutil.copytree(STORED / "run_v3" / "preprocess", tmp_path / "other"))
    with pytest.raises(ConfigError, match="no table rejected, expected a run of generate"):
        prune(other)
