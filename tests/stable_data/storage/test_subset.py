"""A selection is a run: every reader of runs reads it, and nothing of other scenes is in it."""

import json
import shutil
from pathlib import Path

import pyarrow as pa
import pyarrow.compute as pc
import pytest
from typer.testing import CliRunner

from stable_data.assets.run_assets import RunAssets
from stable_data.cli import app
from stable_data.errors import ConfigError
from stable_data.storage import subset
from stable_data.storage.run_folder import RunFolder
from stable_data.storage.schemas import SCHEMAS
from stable_data.storage.subset import count_selected, select
from stable_data.storage.table_rows import arrow_table
from stable_data.storage.torch_dataset import TableStream
from tests.pipelines.runs import content


@pytest.fixture(scope="module")
def where(clean_run: Path) -> str:
    """Takes the two largest of the four scenes."""
    counts = sorted(RunFolder(str(clean_run)).table("scenes", ["num_objects"])["num_objects"].to_pylist())
    return f"clean and num_objects >= {counts[-2]}"


@pytest.fixture(scope="module")
def selected(clean_run: Path, where: str, tmp_path_factory: pytest.TempPathFactory) -> Path:
    out = tmp_path_factory.mktemp("selected") / "out"
    select(RunFolder(str(clean_run)), where, RunFolder(str(out)))
    return out


def test_the_rows_are_those_of_the_scenes_and_of_their_assets_alone(clean_run: Path, selected: Path, where: str) -> None:
    run, chosen = RunFolder(str(clean_run)), RunFolder(str(selected))
    found, total = count_selected(run, where)
    scenes = chosen.table("scenes").to_pylist()
    assert 0 < found == len(scenes) < total == 4
    every = {row["scene_id"]: row for row in run.table("scenes").to_pylist()}
    assert scenes == [every[row["scene_id"]] for row in scenes]
    used = {o["asset_id"] for row in scenes for o in row["objects"]}
    for table in ("assets", "meshes"):
        assert set(chosen.table(table, ["asset_id"])["asset_id"].to_pylist()) == used
    assert set(chosen.table("sdf", ["asset_id"])["asset_id"].to_pylist()) <= used
    ids = {row["scene_id"] for row in scenes}
    mine = run.table("samples", where=pc.field("scene_id").isin(sorted(ids)))
    assert chosen.table("samples").sort_by("scene_id").num_rows == mine.num_rows > 0
    assert not chosen.files("failures")


def test_readers_of_runs_read_it(clean_run: Path, selected: Path, where: str, tmp_path: Path) -> None:
    scenes = list(TableStream(str(selected)))
    assert scenes == list(TableStream(str(clean_run), where=where))
    assets = RunAssets(RunFolder(str(selected)), tmp_path)
    assert all(assets.asset_path(o.asset_id) for scene in scenes for o in scene.objects if o.asset_id)


def test_what_was_broken_off_goes_on_to_the_same_bytes(clean_run: Path, selected: Path, where: str, tmp_path: Path) -> None:
    again = Path(shutil.copytree(selected, tmp_path / "again"))
    next((again / "scenes").glob("*.parquet")).unlink()
    select(RunFolder(str(clean_run)), where, RunFolder(str(again)))
    assert content(again) == content(selected)


def test_what_was_broken_off_by_other_code_is_not_gone_on_with(
    clean_run: Path, selected: Path, where: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """It cuts the rows into shards elsewhere; what is whole is taken as it is."""
    monkeypatch.setattr(subset, "_SHARD_BYTES", 10_000)
    again, run = Path(shutil.copytree(selected, tmp_path / "again")), RunFolder(str(clean_run))
    manifest = json.loads((again / "manifest.json").read_bytes()) | {"code_version": "0.1.0+other"}
    (again / "manifest.json").write_text(json.dumps(manifest))
    before = content(again)
    assert select(run, where, RunFolder(str(again))) == manifest["counts"]
    assert content(again) == before
    (again / "manifest.json").write_text(json.dumps(manifest | {"status": "running"}))
    with pytest.raises(ConfigError, match=r"started by another code version \(0\.1\.0\+other\)"):
        select(run, where, RunFolder(str(again)))
    (again / "manifest.json").write_text(json.dumps(manifest))
    next((again / "meshes").glob("*.parquet")).unlink()
    with pytest.raises(ConfigError, match="choose a new folder"):
        select(run, where, RunFolder(str(again)))


def test_nothing_is_mixed(clean_run: Path, selected: Path) -> None:
    run = RunFolder(str(clean_run))
    for target in (selected, clean_run):
        with pytest.raises(ConfigError, match="choose a new folder"):
            select(run, "num_objects > 0", RunFolder(str(target)))


def test_none_is_a_selection_too(clean_run: Path, tmp_path: Path) -> None:
    counts = select(RunFolder(str(clean_run)), "num_objects > 1000", RunFolder(str(tmp_path / "out")))
    assert set(counts.values()) == {0}
    with pytest.raises(ConfigError, match="has 0 rows"):
        TableStream(str(tmp_path / "out"))


def test_the_command_counts_writes_and_refuses(clean_run: Path, selected: Path, where: str, tmp_path: Path) -> None:
    counted = CliRunner().invoke(app, ["query", str(clean_run), where])
    assert counted.exit_code == 0
    assert "2 of 4 scenes" in counted.stdout
    written = CliRunner().invoke(app, ["query", str(clean_run), where, "--to", str(tmp_path / "out")])
    assert written.exit_code == 0
    assert content(tmp_path / "out") == content(selected)
    refused = CliRunner().invoke(app, ["query", str(clean_run), "num_objects >", "--to", str(tmp_path / "other")])
    assert refused.exit_code == 2
    assert "cannot be read" in refused.stderr
    assert not (tmp_path / "other").exists()


def parts_of(run: Path, folder: Path, *conditions: str) -> list[RunFolder]:
    found = [RunFolder(str(folder / str(number))) for number, _ in enumerate(conditions)]
    for condition, part in zip(conditions, found, strict=True):
        select(RunFolder(str(run)), condition, part)
    return found


def rows_in_order(run: RunFolder, table: str) -> pa.Table:
    """The rows by their ids, of which none may be there twice."""
    rows = run.table(table)
    keys = [name for name in ("scene_id", "asset_id", "id", "stage", "code") if name in rows.schema.names]
    assert len({*zip(*(rows[key].to_pylist() for key in keys), strict=True)}) == rows.num_rows
    return rows.sort_by([(key, "ascending") for key in keys])


def test_runs_that_overlap_are_joined_without_doubles(clean_run: Path, tmp_path: Path) -> None:
    ids = sorted(RunFolder(str(clean_run)).table("scenes", ["scene_id"])["scene_id"].to_pylist())
    first, second = parts_of(clean_run, tmp_path, f"scene_id in {ids[:3]}", f"scene_id in {ids[1:]}")
    whole, joined = RunFolder(str(tmp_path / "whole")), RunFolder(str(tmp_path / "joined"))
    select(RunFolder(str(clean_run)), "scene_id is not None", whole)
    counts = select(first, "scene_id is not None", joined, [second])
    manifest = json.loads((tmp_path / "joined" / "manifest.json").read_bytes())
    assert manifest["doubles"] == {"scenes": 2, "different": 0}
    assert counts == {table: whole.num_rows(table) for table in counts}
    for table in ("scenes", "assets", "meshes", "sdf", "samples"):
        assert rows_in_order(joined, table).equals(rows_in_order(whole, table)), table
    hashes = joined.table("textures", ["sha256"])["sha256"].to_pylist()
    assert len(hashes) == len(set(hashes))
    assert list(TableStream(joined.uri))  # every reader of runs reads it
    before = content(tmp_path / "joined")
    select(first, "scene_id is not None", joined, [second])
    assert content(tmp_path / "joined") == before


@pytest.mark.parametrize("is_first", [pytest.param(True, marks=pytest.mark.slow), False])
def test_grids_and_features_of_shared_assets_are_those_of_the_run_that_has_them(
    is_first: bool, clean_run: Path, tmp_path: Path
) -> None:
    """A run of generate has none, and its assets may be those of a run of preprocess."""
    whole, bare = parts_of(clean_run, tmp_path, "scene_id is not None", "scene_id is not None")
    assert whole.num_rows("sdf")
    assets = whole.table("assets", ["asset_id"])["asset_id"].to_pylist()
    rows = [dict.fromkeys(SCHEMAS["features"].names) | {"asset_id": name, "feature": [1.0]} for name in assets]
    whole.write_table("features", "0" * 16, arrow_table("features", rows))
    for table in ("sdf", "features", "scenes", "samples"):
        shutil.rmtree(Path(bare.root) / table, ignore_errors=True)
    scenes = whole.table("scenes").to_pylist()
    bare.write_table("scenes", "0" * 16, arrow_table("scenes", [row | {"scene_id": f"x{row['scene_id']}"} for row in scenes]))
    one, other = (whole, bare) if is_first else (bare, whole)
    joined = RunFolder(str(tmp_path / "joined"))
    counts = select(one, "scene_id is not None", joined, [other])
    assert counts["scenes"] == 2 * len(scenes)
    for table in ("assets", "meshes", "sdf", "features"):
        assert rows_in_order(joined, table).equals(rows_in_order(whole, table)), table
    warned = whole.table("warnings", ["id", "step", "code"]).to_pylist()
    assert sorted(map(str, joined.table("warnings", ["id", "step", "code"]).to_pylist())) == sorted(map(str, warned))


def test_a_scene_that_differs_is_that_of_the_first_run_and_is_counted(clean_run: Path, tmp_path: Path) -> None:
    first, second = parts_of(clean_run, tmp_path, "scene_id is not None", "scene_id is not None")
    rows = second.table("scenes")
    changed = rows.set_column(rows.schema.get_field_index("num_stacked"), "num_stacked", pc.add(rows["num_stacked"], 1))
    for shard_id in second.shard_ids("scenes"):
        second.write_table("scenes", shard_id, changed.cast(rows.schema))
    select(first, "scene_id is not None", RunFolder(str(tmp_path / "joined")), [second])
    manifest = json.loads((tmp_path / "joined" / "manifest.json").read_bytes())
    assert manifest["doubles"] == {"scenes": 4, "different": 4}
    assert rows_in_order(RunFolder(str(tmp_path / "joined")), "scenes").equals(rows_in_order(first, "scenes"))


def test_an_asset_with_two_meshes_is_refused(clean_run: Path, tmp_path: Path) -> None:
    first, second = parts_of(clean_run, tmp_path, "scene_id is not None", "scene_id is not None")
    for table, column, prefix in (("scenes", "scene_id", "other_"), ("meshes", "sha256", "0")):
        rows = second.table(table)
        place = rows.schema.get_field_index(column)
        other = rows.set_column(place, rows.schema.field(place), pc.binary_join_element_wise(prefix, rows[column], ""))
        for number, shard_id in enumerate(sorted(second.shard_ids(table))):
            second.write_table(table, shard_id, other if number == 0 else other.slice(0, 0))
        if table == "scenes":
            joined = RunFolder(str(tmp_path / "joined"))
            assert select(first, "scene_id is not None", joined, [second])["scenes"] == 8
            assert joined.num_rows("meshes") == first.num_rows("meshes")
    with pytest.raises(ConfigError, match="is not that in") as caught:
        select(first, "scene_id is not None", RunFolder(str(tmp_path / "again")), [second])
    assert caught.value.code == "asset_differs"
    assert not (tmp_path / "again").exists()  # nothing is left


def test_a_selection_within_its_own_run_is_refused(clean_run: Path, tmp_path: Path) -> None:
    run = Path(shutil.copytree(clean_run, tmp_path / "run"))
    before = sorted(run.rglob("*"))
    for place in (run, run / "selected"):
        done = CliRunner().invoke(app, ["query", str(run), "clean", "--to", str(place)])
        assert (done.exit_code, "name a new folder" in done.output) == (2, True), done.output
    assert sorted(run.rglob("*")) == before
