"""Textures travel with the assets that show them: into copies, selections and the outputs of jobs, each image once in a shard."""

from pathlib import Path

import numpy as np
import pyarrow.parquet as pq
import pytest

from pipelines.correct.job import _carry_assets
from pipelines.execution.shard_step import Shard
from pipelines.preprocess.asset import AssetUse
from pipelines.sources.asset_copies import CopyAssets
from pipelines.sources.assets import AssetLibraries
from pipelines.sources.scenes import TableSource
from stable_data.assets.looks import LookRows, look_rows
from stable_data.assets.run_assets import RunAssets
from stable_data.assets.store import AssetStore, LookSource
from stable_data.storage.run_folder import RunFolder
from stable_data.storage.subset import select
from tests.stable_data.assets.test_looks import ball
from tests.textured_assets import rows_of, scene_of, textured, thing, write_run

OTHER = rows_of("other", look_rows([ball()], np.zeros(3)))


@pytest.fixture
def run(tmp_path: Path) -> RunFolder:
    """Two assets with one image, one with an image of its own, and one without a look."""
    scene = scene_of(thing("0_box_0", "a", 0.2, 0.2), thing("1_box_0", "plain", 0.4, 0.2))
    assets = [textured("a"), textured("b"), OTHER, rows_of("plain", LookRows(None))]
    return write_run(tmp_path / "run", assets, scene)


def use(asset_id: str) -> AssetUse:
    return AssetUse(asset_id, "", (1.0, 1.0, 1.0), (), ())


def test_copies_of_assets_take_their_textures_along(run: RunFolder, tmp_path: Path) -> None:
    step = CopyAssets((run.root,), "", 60.0)
    rows = step.shard(Shard("0" * 16, tuple(map(use, ("a", "b", "plain"))))).rows
    assert not rows.get("failures")
    copy = RunFolder(str(tmp_path / "copy"))
    for table in step.TABLES:
        copy.write_shard(table, "0" * 16, rows.get(table, ()))
    (texture,) = copy.table("textures").to_pylist()  # the shared image once, the other one not
    assert texture == textured("a")[2][0]
    given, copied = (AssetStore(RunAssets(r, tmp_path / "files")) for r in (run, copy))
    for asset_id in ("a", "b", "plain"):
        (was, _), (now, notices) = given.look(asset_id), copied.look(asset_id)
        assert notices == ()
        assert (was is None) == (now is None) == (asset_id == "plain")
        if was and now:
            assert now[0].image == was[0].image
            np.testing.assert_array_equal(now[0].triangles, was[0].triangles)


def test_a_lost_texture_is_a_warning_of_the_copy(run: RunFolder) -> None:
    (Path(run.root) / "textures" / f"part-{'0' * 16}.parquet").unlink()
    rows = CopyAssets((run.root,), "", 60.0).shard(Shard("0" * 16, (use("a"),))).rows
    assert [(row["id"], row["code"]) for row in rows["warnings"]] == [("a", "texture_missing")]
    assert len(rows["meshes"]) == 1


def test_libraries_in_order_give_the_looks_of_their_assets(run: RunFolder, tmp_path: Path) -> None:
    second = write_run(tmp_path / "second", [rows_of("a", LookRows(None)), rows_of("c", look_rows([ball()], np.zeros(3)))])
    shelf = AssetLibraries((run.root, second.root))
    assert isinstance(shelf, LookSource)
    store = AssetStore(shelf)
    assert store.look("a")[0] is not None  # of the first library
    assert store.look("c")[0] is not None
    assert store.look("plain")[0] is None
    assert [row["sha256"] for row in shelf.textures("c")] == [OTHER[2][0]["sha256"]]


def test_a_selection_has_the_textures_of_its_assets(run: RunFolder, tmp_path: Path) -> None:
    target = RunFolder(str(tmp_path / "selected"))
    counts = select(run, "num_objects >= 0", target)
    assert (run.num_rows("textures"), counts["textures"], counts["meshes"]) == (2, 1, 2)
    assert AssetStore(RunAssets(target, tmp_path / "files")).look("a")[0] is not None


def test_jobs_that_change_scenes_carry_textures(run: RunFolder, tmp_path: Path) -> None:
    out = RunFolder(str(tmp_path / "out"))
    assert _carry_assets(TableSource(run.root, RunAssets(run, tmp_path / "files")), out) == ["assets", "meshes", "textures"]
    assert AssetStore(RunAssets(out, tmp_path / "files")).look("other")[0] is not None


def test_tables_of_meshes_and_images_have_small_row_groups(tmp_path: Path) -> None:
    run = RunFolder(str(tmp_path))
    _, _, (texture,) = textured("a")
    noise = np.random.default_rng(0).bytes(3_000_000)
    run.write_shard("textures", "0" * 16, [texture | {"sha256": f"{k:064x}", "image": noise} for k in range(8)])
    file = pq.ParquetFile(run.files("textures")[0])
    assert [file.metadata.row_group(k).num_rows for k in range(file.num_row_groups)] == [2, 2, 2, 2]
