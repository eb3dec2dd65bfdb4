import hashlib
from pathlib import Path

import numpy as np
import pytest

from stable_data.assets import AssetStore
from stable_data.errors import ConfigError
from stable_data.export.glb import write_glb
from stable_data.mesh import Mesh
from stable_data.shards import RunFolder
from stable_data.table_assets import TableAssets
from stable_data.tables import SCHEMAS
from tests.scenes import box


def run_of(root: Path, sha256: str | None = None) -> RunFolder:
    run = RunFolder(str(root))
    shape = box(0.1, 0.2, 0.3)
    glb = write_glb(Mesh(shape.vertices, shape.faces))
    row = dict.fromkeys(SCHEMAS["meshes"].names) | {"asset_id": "cube", "glb": glb}
    run.write_shard("meshes", "0" * 16, [row | {"sha256": sha256 or hashlib.sha256(glb).hexdigest()}])
    return run


def test_meshes_come_from_the_table(tmp_path: Path) -> None:
    run = run_of(tmp_path / "run")
    for _ in range(2):  # made, then found
        assets = TableAssets(run, tmp_path / "files")
        assert np.allclose(AssetStore(assets).asset("cube").mesh.extents, (0.1, 0.2, 0.3))
        assert assets.asset_path("other") is None
    assert len(list((tmp_path / "files").iterdir())) == 1


def test_a_content_that_is_no_name_is_refused(tmp_path: Path) -> None:
    """No path from data leaves the folder."""
    with pytest.raises(ConfigError, match="64 hex digits"):
        TableAssets(run_of(tmp_path / "run", "../" * 20 + "out"), tmp_path / "files")


def test_a_run_without_meshes_is_refused(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match="no table meshes"):
        TableAssets(RunFolder(str(tmp_path)), tmp_path / "files")
