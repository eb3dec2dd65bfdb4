"""An asset that ends any process that reads it: importing this makes one of whatever the environment names."""

import os
from pathlib import Path

from pipelines.generate.shard import GenerateWork
from stable_data.assets import store
from stable_data.errors import Notice
from stable_data.geometry.gltf_reader import load_glb
from stable_data.geometry.mesh import Mesh

HOSTILE = "STABLE_DATA_TEST_HOSTILE"
"""Environment variable that names the asset."""


class HostileWork(GenerateWork):
    """Work that takes this module to each process."""


def _loaded(path: Path, asset_id: str) -> tuple[Mesh, tuple[Notice, ...]]:
    if asset_id == os.environ.get(HOSTILE):
        os.abort()
    return load_glb(path, asset_id)


setattr(store, "load_glb", _loaded)  # noqa: B010 - it is not exported from there
