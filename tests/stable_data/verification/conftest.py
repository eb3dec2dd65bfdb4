"""Small real runs to be damaged: made once, and copied for each damage."""

import json
import shutil
from pathlib import Path

import pytest

from models.semantic_reasoner.engines.registry import EngineSettings
from models.semantic_reasoner.staged_layout import LayoutTask
from models.semantic_reasoner.text.prompt import WANTED
from pipelines.execution.ray_executor import WorkerPool
from pipelines.generate.job import generate
from pipelines.generate.settings import GenerateSettings
from pipelines.sources.assets import AssetLibraries
from pipelines.sources.generation_tasks import TaskSource
from stable_data.scene import Stage, Tabletop
from stable_data.storage.run_folder import RunFolder
from tests.pipelines.scripts import entry
from tests.stable_data.verification.editing import hide

LIBRARY = Path(__file__).parents[3] / "pipelines" / "sources" / "real_library" / "ycb"


@pytest.fixture(scope="session")
def generated(dataset: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Three scenes of three objects and two failures of the generate job, in three shards; settled."""
    shelf = AssetLibraries([str(dataset)])
    first, second, third = shelf.libraries[0].assets[1:4]
    script = {
        "Say nonsense": "what?",
        "That answer cannot be used": "what?",
        WANTED[Stage.TASK]: {"objects": [entry(first, 20.0)]},
        WANTED[Stage.IMPORTANT]: {"objects": [entry(second, 21.0)]},
        WANTED[Stage.SECONDARY]: {"objects": [entry(third, 22.0)]},
    }
    folder = tmp_path_factory.mktemp("generated")
    (folder / "script.json").write_text(json.dumps(script))
    settings = GenerateSettings(
        EngineSettings(f"scripted:{folder / 'script.json'}"),
        weights="none",
        scenes_per_shard=2,
        keep_settled=True,
        num_pictures=0,
        robust_rest=0,
    )
    desk = Tabletop("office_table", (1.2, 0.6))
    said = ("Lift it.", "Say nonsense", "Turn it.", "Say nonsense again", "Take it.")
    tasks = TaskSource("tasks", [LayoutTask(f"task_{n}", words, desk) for n, words in enumerate(said)])
    generate(tasks, str(folder / "run"), settings, WorkerPool(), [str(dataset)])
    return folder / "run"


@pytest.fixture(scope="session")
def imported(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Twelve scanned assets with textures: a run of the import job that is part of the project, with checksums, which it lacks.

    Its table of failures, which has no rows, is not in the project.
    """
    run = tmp_path_factory.mktemp("imported") / "run"
    shutil.copytree(LIBRARY, run)
    RunFolder(str(run)).write_shard("failures", "0" * 16, [])
    hide(run)
    return run
