"""Textures travel with the assets that show them: into copies, selections and the outputs of jobs, each image once in a shard."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest

from pipelines.correct.job import correct
from pipelines.correct.settings import CorrectSettings
from pipelines.execution.item_progress import ItemProgress
from pipelines.execution.ray_executor import WorkerPool
from pipelines.execution.shard_step import Shard
from pipelines.preprocess.asset import AssetSettings, AssetUse, preprocess_asset
from pipelines.reach.job import ReachJob
from pipelines.reach.settings import ReachSettings
from pipelines.sources.asset_copies import CopyAssets
from pipelines.sources.assets import AssetLibraries
from pipelines.sources.carried_tables import carry_tables, refuse_links_out
from stable_data.assets.annotation import AssetAnnotation
from stable_data.assets.looks import LookRows, look_rows
from stable_data.assets.run_assets import RunAssets
from stable_data.assets.store import AssetStore, LookSource
from stable_data.errors import ConfigError
from stable_data.geometry.gltf_reader import load_surfaces
from stable_data.geometry.gltf_writer import SurfaceParts, pack, y_up
from stable_data.geometry.surface import Surface
from stable_data.mesatask import MesaTaskDataset, write_annotations, write_scene
from stable_data.mesatask.writing import write_asset
from stable_data.storage.run_folder import RunFolder
from stable_data.storage.subset import select
from tests.bounds import limit
from tests.stable_data.assets.test_looks import ball
from tests.textured_assets import SIZE, picture_box, rows_of, scene_of, textured, thing, write_run

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
    assert carry_tables(run, out) == ["assets", "meshes", "textures"]
    assert AssetStore(RunAssets(out, tmp_path / "files")).look("other")[0] is not None


def linked_out(run: RunFolder, path: Path, content: bytes) -> str:
    """Puts a link to a file outside of a run in the place of one of its files; returns its name."""
    elsewhere = Path(run.root).parent / "elsewhere"
    elsewhere.write_bytes(content)
    path.unlink(missing_ok=True)
    path.symlink_to(elsewhere)
    return path.relative_to(run.root).as_posix()


@pytest.mark.parametrize("table", ["meshes", "features"])
@pytest.mark.parametrize("is_table", [True, False])
def test_what_lies_behind_a_link_out_of_a_run_is_not_carried(
    table: str, is_table: bool, run: RunFolder, tmp_path: Path
) -> None:
    run.write_shard("features", "0" * 16, [])
    path = Path(run.root) / table / f"part-{'0' * 16}.parquet"
    name = linked_out(run, path, path.read_bytes() if is_table else b"a private key")
    out = RunFolder(str(tmp_path / "out"))
    for refuse in (lambda: carry_tables(run, out), lambda: refuse_links_out(run)):
        with pytest.raises(ConfigError, match=f"{name}: is a link out of the run") as caught:
            refuse()
        assert caught.value.code == "link_leaves"
    assert not (Path(out.root) / name).exists()


def test_a_job_refuses_links_out_of_its_run_before_it_begins(run: RunFolder, tmp_path: Path) -> None:
    path = Path(run.files("meshes")[0])
    linked_out(run, path, path.read_bytes())
    for start in (
        lambda: correct(run.root, str(tmp_path / "out"), CorrectSettings(), WorkerPool()),
        lambda: ReachJob(run.root, ReachSettings("simple")),
    ):
        with pytest.raises(ConfigError, match="is a link out of the run"):
            start()
    assert not (tmp_path / "out").exists()


def test_links_within_a_run_are_carried(run: RunFolder, tmp_path: Path) -> None:
    path = Path(run.files("meshes")[0])
    path.rename(Path(run.root) / "kept.parquet")
    path.symlink_to("../kept.parquet")
    out = RunFolder(str(tmp_path / "out"))
    carry_tables(run, out)
    assert out.num_rows("meshes") == run.num_rows("meshes")
    assert not Path(out.files("meshes")[0]).is_symlink()


def test_only_files_of_the_table_are_carried(run: RunFolder, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    meshes, out = Path(run.files("meshes")[0]), RunFolder(str(tmp_path / "out"))
    content = meshes.read_bytes()
    for other, code in (
        (b"no table", "shard_unreadable"),
        (Path(run.files("assets")[0]).read_bytes(), "column_missing"),
        (_written(pa.table({"asset_id": ["a"]})), "table_version"),
    ):
        meshes.write_bytes(other)
        with pytest.raises(ConfigError, match=r"meshes/part-0+\.parquet") as caught:
            carry_tables(run, out, ["meshes"])
        assert caught.value.code == code
    meshes.write_bytes(content)
    limit(monkeypatch, "table", max_decoded_bytes=len(content) - 1)
    with pytest.raises(ConfigError, match=r"table\.max_decoded_bytes in STABLE_DATA_LIMITS") as caught:
        carry_tables(run, out, ["meshes"])
    assert caught.value.code == "shard_too_big"
    limit(monkeypatch, "table", max_decoded_bytes=len(content))
    assert carry_tables(run, out, ["meshes"]) == ["meshes"]


def _written(table: pa.Table) -> bytes:
    sink = pa.BufferOutputStream()
    pq.write_table(table, sink)
    content: bytes = sink.getvalue().to_pybytes()
    return content


def test_tables_of_meshes_and_images_have_small_row_groups(tmp_path: Path) -> None:
    run = RunFolder(str(tmp_path))
    _, _, (texture,) = textured("a")
    noise = np.random.default_rng(0).bytes(3_000_000)
    run.write_shard("textures", "0" * 16, [texture | {"sha256": f"{k:064x}", "image": noise} for k in range(8)])
    file = pq.ParquetFile(run.files("textures")[0])
    assert [file.metadata.row_group(k).num_rows for k in range(file.num_row_groups)] == [2, 2, 2, 2]


def dataset_of(root: Path, *surfaces: Surface) -> MesaTaskDataset:
    """A dataset with one asset, away from the origin of its file."""
    parts = SurfaceParts()
    moved = [replace(s, triangles=s.triangles + np.array([0.3, -0.2, 0.5])) for s in surfaces]
    primitives = [parts.primitive(surface, y_up) for surface in moved]
    scene = {"scene": 0, "scenes": [{"nodes": [0]}], "nodes": [{"mesh": 0}], "meshes": [{"primitives": primitives}]}
    write_asset(root, "a", pack(scene | parts.document(parts.embedded_images()), parts.arrays, parts.images))
    write_annotations(root, {"a": AssetAnnotation("a", "box", "a box", extents_z_up=SIZE)})
    write_scene(root, scene_of(thing("0_box_0", "a", 0.2, 0.2)))
    return MesaTaskDataset(root)


def test_textures_of_a_dataset_become_looks(tmp_path: Path) -> None:
    given = picture_box()
    store = AssetStore(dataset_of(tmp_path, given))
    made = preprocess_asset(use("a"), AssetAnnotation("a"), store, AssetSettings(), ItemProgress("read"))
    (texture,) = made.textures
    (found,) = load_surfaces(made.mesh["look"], "a", textures={texture["sha256"]: texture["image"]}.get)
    np.testing.assert_allclose(found.triangles, given.triangles, atol=1e-6)
    assert made.mesh["look_distance"] == 0.0
    assert not made.notices
    rows = CopyAssets((str(tmp_path),), "", 60.0).shard(Shard("0" * 16, (use("a"),))).rows
    assert rows["textures"] == [texture]
    assert rows["meshes"][0]["look"] == made.mesh["look"]


def test_a_dataset_without_textures_has_no_looks(tmp_path: Path) -> None:
    plain = replace(picture_box(), image=None, corner_uv=None, colour=(0.5, 0.2, 0.1))
    store = AssetStore(dataset_of(tmp_path, plain))
    made = preprocess_asset(use("a"), AssetAnnotation("a"), store, AssetSettings(), ItemProgress("read"))
    assert (made.mesh["look"], made.mesh["look_distance"], made.textures) == (None, None, ())


def test_a_look_that_does_not_lie_on_the_mesh_is_left_out(tmp_path: Path) -> None:
    """A triangle beyond the box that is there twice, in both directions, is dropped by the repair: the centre is another one."""
    given = picture_box()
    far = np.array([[[0.0, 0.0, 0.1], [0.1, 0.0, 0.3], [0.0, 0.1, 0.3]]])
    flags = Surface(np.concatenate([far, far[:, ::-1]]), (1.0, 0.0, 0.0))
    store = AssetStore(dataset_of(tmp_path, given, flags))
    made = preprocess_asset(use("a"), AssetAnnotation("a"), store, AssetSettings(), ItemProgress("read"))
    assert store.asset("a").mesh.extents[2] == pytest.approx(0.12)
    assert (made.mesh["look"], made.textures) == (None, ())


def test_a_row_that_lacks_parts_keeps_its_look(tmp_path: Path) -> None:
    asset, mesh, textures = textured("a")
    run = write_run(tmp_path / "run", [(asset, mesh | {"parts": None}, textures)])
    rows = CopyAssets((run.root,), "", 60.0).shard(Shard("0" * 16, (use("a"),))).rows
    assert rows["meshes"][0]["parts"]
    assert rows["meshes"][0]["look"] == mesh["look"]
    assert rows["textures"] == textures
