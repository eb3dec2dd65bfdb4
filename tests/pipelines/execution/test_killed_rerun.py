"""A driver that is killed leaves no checksum of a shard that was made anew."""

import shutil
from pathlib import Path

import pytest

from pipelines.execution import shard_job
from pipelines.execution.ray_executor import WorkerPool
from pipelines.preprocess.job import preprocess
from stable_data.storage.checksums import read_checksums
from stable_data.storage.run_folder import RunFolder
from tests.pipelines.runs import SMALL
from tests.whole import check_whole


def test_a_killed_rerun_keeps_no_old_checksum(
    dataset: Path, clean_run: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    run = RunFolder(str(shutil.copytree(clean_run, tmp_path / "run")))
    path = Path(run.files("scenes")[0])
    path.unlink()

    def killed(*_: object) -> None:
        raise KeyboardInterrupt

    with monkeypatch.context() as patch:
        patch.setattr(shard_job, "save_checksums", lambda _: None)  # the driver dies before it stores what it was told
        patch.setattr(shard_job, "check_shards", killed)
        with pytest.raises(KeyboardInterrupt):
            preprocess(str(dataset), run.uri, SMALL, WorkerPool())
    assert path.is_file()
    listed = {name for name in read_checksums(run) or {} if path.name in name}
    assert listed.isdisjoint({f"scenes/{path.name}", f"samples/{path.name}"})
    preprocess(str(dataset), run.uri, SMALL, WorkerPool())
    check_whole(run.uri, verdicts="none")
