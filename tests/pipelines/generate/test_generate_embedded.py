"""The generate job with what comes with it: the embedded engine, its weights and its library."""

from pathlib import Path

import pytest

from pipelines.execution.ray_executor import WorkerPool
from pipelines.generate.job import generate
from pipelines.generate.settings import GenerateSettings
from pipelines.sources.generation_tasks import sample_tasks
from stable_data.storage.run_folder import RunFolder
from tests.pipelines.runs import content

pytestmark = pytest.mark.sim

TASKS = sample_tasks(1)
SETTINGS = GenerateSettings(num_pictures=0)


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory) -> Path:
    out = tmp_path_factory.mktemp("embedded") / "out"
    assert generate(TASKS, str(out), SETTINGS, WorkerPool(), report=False)["counts"]["scenes"] == len(TASKS.tasks)
    return out


def test_drawn_tasks_become_scenes_that_stay_where_they_are(made: Path) -> None:
    for row in RunFolder(str(made)).table("scenes").to_pylist():
        assert (row["clean"], row["stable"], row["awt"], row["read_as_labelled"]) == (True, True, 1.0, True)
        assert row["num_objects"] >= 4


@pytest.mark.slow
@pytest.mark.ray
@pytest.mark.usefixtures("local_ray")
def test_ray_gives_the_same_bytes_as_this_process(made: Path, tmp_path: Path) -> None:
    generate(TASKS, str(tmp_path), SETTINGS, WorkerPool(1), report=False)
    assert content(tmp_path) == content(made)
