import hashlib
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pytest

from stable_data.assets.annotation import AssetAnnotation
from stable_data.assets.run_assets import RunAssets, run_annotations
from stable_data.assets.store import AssetStore
from stable_data.errors import ConfigError, MeshError
from stable_data.geometry.gltf_writer import write_glb
from stable_data.geometry.mesh import Mesh
from stable_data.simulation.collision_bodies import asset_parts
from stable_data.storage.run_folder import RunFolder
from stable_data.storage.schemas import SCHEMAS, Row
from tests.scenes import box


def run_of(root: Path, sha256: str | None = None) -> RunFolder:
    run = RunFolder(str(root))
    shape = box(0.1, 0.2, 0.3)
    glb = write_glb(Mesh(shape.vertices, shape.faces))
    halves = [box(0.05, 0.2, 0.3).vertices + np.array([x, 0.0, 0.0]) for x in (-0.025, 0.025)]
    parts = [{"vertices": half.ravel(), "faces": shape.faces.ravel()} for half in halves]
    row = dict.fromkeys(SCHEMAS["meshes"].names) | {"asset_id": "cube", "glb": glb, "parts": parts}
    run.write_shard("meshes", "0" * 16, [row | {"sha256": sha256 or hashlib.sha256(glb).hexdigest()}])
    return run


def test_meshes_come_from_the_table(tmp_path: Path) -> None:
    run = run_of(tmp_path / "run")
    for _ in range(2):  # made, then found
        assets = RunAssets(run, tmp_path / "files")
        assert np.allclose(AssetStore(assets).asset("cube").mesh.extents, (0.1, 0.2, 0.3))
        assert assets.asset_path("other") is None
    assert len(list((tmp_path / "files").iterdir())) == 1


def test_files_are_written_when_they_are_asked_for(tmp_path: Path) -> None:
    assets = RunAssets(run_of(tmp_path / "run"), tmp_path / "files")
    assert not list((tmp_path / "files").iterdir())
    path = assets.asset_path("cube")
    assert path is not None
    assert path.is_file()


def test_convex_parts_are_those_of_the_table(tmp_path: Path) -> None:
    """And not cut anew: one box would do."""
    store = AssetStore(RunAssets(run_of(tmp_path / "run"), tmp_path / "files"))
    parts = asset_parts("cube", store.asset("cube").mesh, store)
    assert [part.vertices[:, 0].mean().round(3) for part in parts] == [-0.025, 0.025]
    assert store.stored_parts("other") == ()


def test_masses_come_from_the_rows_that_say_where_they_come_from(tmp_path: Path) -> None:
    run = run_of(tmp_path / "run")
    blank = dict.fromkeys(SCHEMAS["assets"].names) | {"extents": [0.1, 0.2, 0.3], "typical_scale": [2.0, 2.0, 2.0], "mass": 0.2}
    rows: list[Row] = [blank | {"asset_id": "cube", "mass_source": "category"}, blank | {"asset_id": "noted"}]
    run.write_shard("assets", "0" * 16, rows)
    store = AssetStore(RunAssets(run, tmp_path / "files"))
    known = store.physics("cube")
    assert known is not None
    assert (known.mass, known.typical_scale, known.inertia, known.friction) == (0.2, (2.0, 2.0, 2.0), None, None)
    assert store.physics("noted") is store.physics("other") is None


def test_a_run_without_assets_knows_no_masses(tmp_path: Path) -> None:
    assert RunAssets(run_of(tmp_path / "run"), tmp_path / "files").physics("cube") is None


def test_the_table_is_read_once_and_only_if_a_mass_is_asked_for(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    run = run_of(tmp_path / "run")
    run.write_shard("assets", "0" * 16, [dict.fromkeys(SCHEMAS["assets"].names) | {"asset_id": "cube", "extents": [1, 1, 1]}])
    read: list[str] = []
    table = RunFolder.table

    def count(self: RunFolder, name: str, *more: Any, **named: Any) -> pa.Table:
        read.append(name)
        return table(self, name, *more, **named)

    monkeypatch.setattr(RunFolder, "table", count)
    assets = RunAssets(run, tmp_path / "files")
    assert read == []
    for asset_id in ("cube", "other", "cube"):
        assets.physics(asset_id)
    assert read == ["assets"]


def test_annotations_come_from_the_table(tmp_path: Path) -> None:
    run = RunFolder(str(tmp_path))
    known: Row = {"category": "mug", "licence": "CC0", "extents": [1.0, 2.0, 3.0], "mass": 0.2, "is_container": True}
    rows: list[Row] = [{"asset_id": "known", **known}, {"asset_id": "bare", "extents": [1.0, 1.0, 1.0]}]
    run.write_shard("assets", "0" * 16, [dict.fromkeys(SCHEMAS["assets"].names) | row for row in rows])
    annotations = run_annotations(run)
    assert annotations["known"] == AssetAnnotation("known", "mug", mass=0.2, is_container=True, extents_z_up=(1.0, 2.0, 3.0))
    assert annotations["known"].licence == "CC0"
    assert annotations["bare"].licence is None


def test_lists_of_other_lengths_in_annotations_are_unknown(tmp_path: Path) -> None:
    run = RunFolder(str(tmp_path))
    values: Row = {"extents": [1.0, 2.0], "typical_scale": [1.0] * 4, "resting_tilts": [{"tilt_quat_xyzw": [0.0, 0.0, 1.0]}]}
    rows: list[Row] = [{"asset_id": "odd", **values}, {"asset_id": "none", **values, "resting_tilts": [None]}]
    run.write_shard("assets", "0" * 16, [dict.fromkeys(SCHEMAS["assets"].names) | row for row in rows])
    for found in run_annotations(run).values():
        assert (found.extents_z_up, found.typical_scale, found.resting_tilt) == (None, None, None)


def test_a_content_that_is_no_name_is_refused(tmp_path: Path) -> None:
    """No path from data leaves the folder."""
    with pytest.raises(ConfigError, match="64 hex digits"):
        RunAssets(run_of(tmp_path / "run", "../" * 20 + "out"), tmp_path / "files")


def test_a_run_cannot_put_its_mesh_in_the_place_of_another_run(tmp_path: Path) -> None:
    """Runs share the folder: a row that states the hash of another mesh fails, and the other run is served its own."""
    honest = run_of(tmp_path / "honest")
    [row] = honest.table("meshes").to_pylist()
    hostile = RunFolder(str(tmp_path / "hostile"))
    foreign = dict(row, glb=write_glb(Mesh(3 * box(1, 1, 1).vertices, box(1, 1, 1).faces)))
    sound = dict(row, asset_id="sound", glb=foreign["glb"], sha256=hashlib.sha256(foreign["glb"]).hexdigest())
    hostile.write_shard("meshes", "0" * 16, [foreign, sound, dict(row, asset_id="none", glb=None, sha256="f" * 64)])
    assets = RunAssets(hostile, tmp_path / "files")
    for asset_id in ("cube", "none"):
        with pytest.raises(MeshError, match=f"asset {asset_id}: the glb in table meshes does not have the hash") as caught:
            AssetStore(assets).asset(asset_id)
        assert caught.value.code == "mesh_differs"
    assert np.allclose(AssetStore(assets).asset("sound").mesh.extents, 3)
    assert [path.stem for path in (tmp_path / "files").iterdir()] == [sound["sha256"]]
    assert AssetStore(RunAssets(honest, tmp_path / "files")).asset("cube").mesh.extents.max() < 1


def test_a_file_that_was_changed_in_the_folder_is_written_again(tmp_path: Path) -> None:
    run = run_of(tmp_path / "run")
    path = RunAssets(run, tmp_path / "files").asset_path("cube")
    assert path is not None
    path.write_bytes(b"poison")
    assert np.allclose(AssetStore(RunAssets(run, tmp_path / "files")).asset("cube").mesh.extents, (0.1, 0.2, 0.3))


def test_a_run_without_meshes_is_refused(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match="no table meshes"):
        RunAssets(RunFolder(str(tmp_path)), tmp_path / "files")
