from pathlib import Path

import numpy as np
import pytest

from stable_data.assets.store import AssetStore
from stable_data.assets.user_cache import ArrayFiles, array_key
from stable_data.cache_folder import user_cache
from stable_data.mesatask import MesaTaskDataset
from stable_data.simulation import collision_bodies


def test_what_is_written_is_read_and_damage_is_nothing(tmp_path: Path) -> None:
    files = ArrayFiles(tmp_path / "deep")
    assert files.read("one") is None
    files.write("one", {"a": np.arange(3), "b": np.zeros((2, 2), np.float32)})
    found = files.read("one")
    assert found is not None
    assert found["a"].tolist() == [0, 1, 2]
    assert found["b"].dtype == np.float32
    path = tmp_path / "deep" / "one.npz"
    whole = path.read_bytes()
    for damaged in (b"", b"PK damaged", whole[:-30], whole[:60] + b"x" * 8 + whole[68:], whole[: len(whole) // 2]):
        path.write_bytes(damaged)
        assert files.read("one") is None
    nothing = ArrayFiles(None)
    nothing.write("one", {"a": np.arange(3)})
    assert nothing.read("one") is None


def test_a_folder_that_cannot_be_made_costs_nothing(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("in the way")
    files = ArrayFiles(tmp_path / "file")
    files.write("one", {"a": np.arange(3)})
    assert files.read("one") is None


def test_keys_depend_on_the_code_and_on_every_part(tmp_path: Path) -> None:
    code = tmp_path / "code.py"
    code.write_text("a = 1")
    keys = {array_key(code, b"ab", b"c"), array_key(code, b"a", b"bc"), array_key(tmp_path, b"ab", b"c", b"")}
    assert len(keys) == 3
    assert array_key(code, b"ab", b"c") in keys


def test_an_asset_is_decomposed_once_for_all_processes(dataset: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    assert user_cache("convex_parts") == tmp_path / "stable-data" / "convex_parts"
    source = MesaTaskDataset(dataset)
    store = AssetStore(source)
    asset_id = next(o.asset_id for o in source.read(source.scene_ids[0])[0].objects if o.asset_id is not None)
    mesh = store.asset(asset_id).mesh
    first = collision_bodies.asset_parts(asset_id, mesh, store)
    monkeypatch.setattr(collision_bodies, "collider_parts", None)  # a second decomposition would fail
    again = collision_bodies.asset_parts(asset_id, mesh, AssetStore(source))
    assert len(first) == len(again) > 0
    for one, other in zip(first, again, strict=True):
        assert np.array_equal(one.vertices, other.vertices)
        assert np.array_equal(one.faces, other.faces)
