"""The run that is exported, made once."""

import pytest

from stable_data.assets.run_assets import RunAssets
from stable_data.assets.store import AssetStore
from stable_data.storage.run_folder import RunFolder
from tests.stable_data.export.runs import write_run


@pytest.fixture(scope="session")
def run(tmp_path_factory: pytest.TempPathFactory) -> RunFolder:
    return write_run(tmp_path_factory.mktemp("exported") / "run")


@pytest.fixture(scope="session")
def store(run: RunFolder, tmp_path_factory: pytest.TempPathFactory) -> AssetStore:
    return AssetStore(RunAssets(run, tmp_path_factory.mktemp("files")))
