"""A run with two scenes, and demonstrations in them, made once."""

from dataclasses import replace
from pathlib import Path

import pytest

from pipelines.demonstrate.job import demonstrate
from pipelines.demonstrate.settings import DemonstrateSettings
from pipelines.execution.ray_executor import WorkerPool
from tests.stable_data.export.runs import write_run
from tests.stable_data.robot.tables import CAN, MUG, laid_table


@pytest.fixture(scope="session")
def two_scenes(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Two tables with a can and a mug."""
    scene = laid_table()
    few = replace(scene, objects=tuple(o for o in scene.objects if o.instance in (CAN, MUG)))
    other = replace(
        few, scene_id="laid_too", objects=(replace(few.objects[0], position=(0.5, 0.3, few.objects[0].position[2])),)
    )
    return Path(write_run(tmp_path_factory.mktemp("scenes") / "run", (few, other)).root)


@pytest.fixture(scope="session")
def demonstrations(two_scenes: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """One demonstration in each scene."""
    out = tmp_path_factory.mktemp("demonstrations") / "out"
    settings = DemonstrateSettings(robot="simple", task="pick")
    manifest = demonstrate(str(two_scenes), str(out), settings, WorkerPool(), report=False)
    assert manifest["counts"]["successes"] == 2
    return out
