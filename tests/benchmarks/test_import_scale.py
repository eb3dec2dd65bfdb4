"""The benchmark of the import of many assets."""

import json
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import pytest

from benchmarks.import_scale import MemorySample, _tenths, check_rows, different_rows, write_copies
from stable_data.geometry.gltf_reader import load_surfaces
from stable_data.geometry.gltf_writer import write_glb
from stable_data.geometry.mesh import Mesh
from stable_data.geometry.reduction import join_triangles
from stable_data.geometry.shape_hash import shape_hash
from stable_data.storage.run_folder import RunFolder
from stable_data.storage.schemas import SCHEMAS

PYRAMID = Mesh(
    np.array([[0.0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0], [0.5, 0.5, 2]]),
    np.array([[0, 2, 1], [0, 3, 2], [0, 1, 4], [1, 2, 4], [2, 3, 4], [3, 0, 4]]),
)


@pytest.fixture
def data(tmp_path: Path) -> Path:
    folder = tmp_path / "data"
    (folder / "Assets_library").mkdir(parents=True)
    for name in ("a", "b"):
        (folder / "Assets_library" / f"{name}.glb").write_bytes(write_glb(PYRAMID))
    (folder / "Asset_annotation.json").write_text(json.dumps({"a": {"category": "mug"}}), "utf-8")
    return folder


def test_copies_differ_and_are_the_same_each_time(data: Path, tmp_path: Path) -> None:
    for name in ("one", "two"):
        write_copies(data, tmp_path / name, 8)
    one, two = (sorted((tmp_path / name).rglob("*.glb")) for name in ("one", "two"))
    assert [path.read_bytes() for path in one] == [path.read_bytes() for path in two]
    assert sorted(path.stem for path in one)[0] == "mug_000000"
    surfaces = {path.stem: list(load_surfaces(path, path.stem)) for path in one}
    soups = {stem: [surface.triangles for surface in own] for stem, own in surfaces.items()}
    assert len({shape_hash(join_triangles(own, stem)[0]) for stem, own in soups.items()}) == 8
    images = [surface.image for own in surfaces.values() for surface in own if surface.image is not None]
    assert len(images) == len(set(images)) == 2


def write_run(folder: Path, shards: Sequence[Sequence[str]], failed: Sequence[str] = ()) -> Path:
    run = RunFolder(str(folder))
    for number, ids in enumerate(shards):
        for table in ("assets", "meshes"):
            rows = [dict.fromkeys(SCHEMAS[table].names) | {"asset_id": uid} for uid in ids]
            run.write_shard(table, f"{number:016x}", rows)
    for table in ("textures", "warnings"):
        run.write_shard(table, f"{0:016x}", [])
    run.write_shard("failures", f"{0:016x}", [{"id": uid, "step": "read", "code": "x", "message": "x"} for uid in failed])
    return folder


def test_each_asset_is_one_row_or_one_failure(tmp_path: Path) -> None:
    assert check_rows(write_run(tmp_path / "good", (("a", "b"), ("c",)), ("d",)), "abcd") == (3, 1)
    bad = {
        "lost": (("a", "b"), ()),
        "twice": (("a", "b"), ("b",)),
        "foreign": (("a", "b", "x"), ()),
        "both": (("a", "b"), ("c",)),
    }
    for name, shards in bad.items():
        run = write_run(tmp_path / name, shards, ("c",) if name != "lost" else ())
        with pytest.raises(RuntimeError, match="exactly one row"):
            check_rows(run, "abc")


def test_rows_of_two_imports_are_compared(tmp_path: Path) -> None:
    whole, part, other = (
        write_run(tmp_path / name, (ids,)) for name, ids in (("whole", "abc"), ("part", "ab"), ("other", "ad"))
    )
    assert set(different_rows(whole, part).values()) == {0}
    assert different_rows(whole, other)["assets"] == 1


def test_growth_is_of_the_second_and_the_last_tenth() -> None:
    samples = [MemorySample(float(k), k, 0.0, {}, {}) for k in range(100)]
    assert _tenths(samples, 100, [float(k) for k in range(100)]) == (14.5, 94.5, 99.0)
