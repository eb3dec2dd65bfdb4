"""The mesh that a run stores is the mesh that was judged: the same vertices, and the same faces in the same order."""

import hashlib
from pathlib import Path

import numpy as np
import pytest

from stable_data.assets.asset_rows import file_columns
from stable_data.assets.run_assets import run_store
from stable_data.assets.store import AssetStore
from stable_data.errors import MeshError
from stable_data.geometry.gltf_reader import FACE_ORDER, load_stored_mesh
from stable_data.geometry.gltf_writer import write_glb
from stable_data.geometry.mesh import Mesh
from stable_data.mesatask import MesaTaskDataset
from stable_data.metrics.audit import PosedScene, audit_posed_scene
from stable_data.storage.run_folder import RunFolder
from stable_data.storage.schemas import SCHEMAS, Row
from tests.scenes import ball, box


def stored(run: Path, rows: list[Row]) -> AssetStore:
    empty = dict.fromkeys(SCHEMAS["meshes"].names) | {"parts": []}
    RunFolder(str(run)).write_shard("meshes", "0" * 16, [empty | row for row in rows])
    return run_store(str(run))


def painted(mesh: Mesh) -> bytes:
    """A mesh in two colours, by turns."""
    return write_glb(mesh, paint=[(f"#0000{k}0", np.arange(k, len(mesh.faces), 2)) for k in (0, 1)], keeps_order=True)


def test_what_a_run_gives_is_what_was_judged(real_data: Path, tmp_path: Path) -> None:
    dataset = MesaTaskDataset(real_data)
    before = AssetStore(dataset)
    names = sorted(path.stem for path in (real_data / "Assets_library").glob("*.glb"))
    rows = [file_columns(name, before.asset(name).mesh, before.paint(name)[0]) for name in names]
    assert any(FACE_ORDER.encode() in row["glb"] for row in rows)  # colours change the order of the faces of some
    after = stored(tmp_path, rows)
    for name in names:
        one, other = before.asset(name), after.asset(name)
        assert np.array_equal(one.mesh.vertices, other.mesh.vertices), name
        assert np.array_equal(one.mesh.faces, other.mesh.faces), name
        assert other.is_in_order
        assert (one.report.volume, one.report.is_sheet) == (other.report.volume, other.report.is_sheet), name
    for scene_id in dataset.scene_ids:
        scene = dataset.read(scene_id)[0]
        verdicts = [audit_posed_scene(PosedScene(*store.resolved(scene)[:2])).rows() for store in (before, after)]
        assert verdicts[0] == verdicts[1]


def test_a_mesh_of_a_run_is_not_repaired_again(tmp_path: Path) -> None:
    """A face is missing, which a repair would close."""
    shape = ball(0.1)
    mesh = Mesh(shape.vertices.astype(np.float32), shape.faces[1:])
    found = stored(tmp_path, [file_columns("ball", mesh, ())]).asset("ball")
    assert np.array_equal(found.mesh.faces, mesh.faces)
    assert np.array_equal(found.mesh.vertices, mesh.vertices)
    assert (found.report.is_watertight, found.report.was_watertight, found.report.num_boundary_edges) == (False, False, 3)


def test_the_order_of_the_faces_of_an_older_run_is_unknown(tmp_path: Path) -> None:
    shape = ball(0.1)
    mesh = Mesh(shape.vertices.astype(np.float32), shape.faces)
    for keeps_order in (True, False):
        glb = write_glb(
            mesh, paint=[("#112233", np.arange(9, len(mesh.faces))), ("#445566", np.arange(9))], keeps_order=keeps_order
        )
        row = {"asset_id": "ball", "glb": glb, "sha256": hashlib.sha256(glb).hexdigest()}
        found = stored(tmp_path / str(keeps_order), [row]).asset("ball")
        assert found.is_in_order is keeps_order
        assert np.array_equal(found.mesh.faces, mesh.faces if keeps_order else np.roll(mesh.faces, -9, axis=0))


def test_faces_that_are_already_in_order_are_known_to_be(tmp_path: Path) -> None:
    shape = ball(0.1)
    mesh = Mesh(shape.vertices.astype(np.float32), shape.faces)
    paint = (("#112233", np.arange(9)), ("#445566", np.arange(9, len(mesh.faces))))
    found = stored(tmp_path, [file_columns("ball", mesh, paint)]).asset("ball")
    assert found.is_in_order
    assert np.array_equal(found.mesh.faces, mesh.faces)


def test_a_mesh_from_elsewhere_is_still_checked(tmp_path: Path) -> None:
    shape = box(0.1, 0.2, 0.3)
    beside, _ = load_stored_mesh(write_glb(Mesh(shape.vertices + 1.0, shape.faces)), "beside")
    assert np.allclose(beside.vertices, shape.vertices, atol=1e-6)
    flat, broken = np.zeros_like(shape.vertices), shape.vertices.copy()
    broken[0, 0] = np.nan
    for vertices, code in ((flat, "glb_degenerate_only"), (broken, "glb_nan_vertices")):
        with pytest.raises(MeshError) as caught:
            load_stored_mesh(write_glb(Mesh(vertices, shape.faces)), "odd")
        assert caught.value.code == code
    glb = painted(Mesh(shape.vertices, shape.faces))
    with pytest.raises(MeshError, match="each number once"):
        load_stored_mesh(glb.replace(np.array([0, 2, 4], "<u4").tobytes(), np.array([0, 0, 4], "<u4").tobytes(), 1), "odd")
