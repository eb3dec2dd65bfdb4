"""The generate job with what comes with it: the embedded engine, its weights and its library."""

from pathlib import Path

import pytest

from pipelines.execution.ray_executor import WorkerPool
from pipelines.generate.job import generate
from pipelines.generate.settings import GenerateSettings
from pipelines.sources.generation_tasks import sampled
from stable_data.storage.run_folder import RunFolder
from tests.pipelines.runs import content

pytestmark = [pytest.mark.usefixtures("local_ray"), pytest.mark.ray, pytest.mark.sim]


def test_drawn_tasks_become_scenes_that_stay_where_they_are_the_same_on_ray(tmp_path: Path) -> None:
    settings = GenerateSettings(num_pictures=0)
    here, on_ray = tmp_path / "here", tmp_path / "ray"
    manifest = generate(sampled(3), str(here), settings, WorkerPool(), report=False)
    assert manifest["counts"]["scenes"] == 3
    for row in RunFolder(str(here)).table("scenes").to_pylist():
        assert (row["clean"], row["stable"], row["awt"]) == (True, True, 1.0)
        assert row["num_objects"] >= 4
    generate(sampled(3), str(on_ray), settings, WorkerPool(1), report=False)
    assert content(on_ray) == content(here)
