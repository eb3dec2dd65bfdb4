"""The run that is exported, made once."""

import pytest

from stable_data.assets import AssetStore
from stable_data.shards import RunFolder
from stable_data.table_assets import TableAssets
from tests.stable_data.export.runs import write_run


@pytest.fixture(scope="session")
def run(tmp_path_factory: pytest.TempPathFactory) -> RunFolder:
    return write_run(tmp_path_factory.mktemp("exported") / "run")


@pytest.fixture(scope="session")
def store(run: RunFolder, tmp_path_factory: pytest.TempPathFactory) -> AssetStore:
    return AssetStore(TableAssets(run, tmp_path_factory.mktemp("files")))
