"""What every test may ask for, and the order of the tests."""

import fcntl
import gc
import json
import logging
import os
import shutil
from collections import Counter
from collections.abc import Callable, Generator, Iterator
from contextlib import suppress
from pathlib import Path

os.environ.setdefault("OMP_NUM_THREADS", "1")  # before torch is imported: two threads on a busy machine wait for each other

import numpy as np
import pytest
import ray
from hypothesis import settings

from stable_data.cache_folder import user_cache
from stable_data.embedded_world import EmbeddedWorld, write_world
from stable_data.scene import Stage, Tabletop
from stable_data.storage.run_folder import RunFolder
from tests.broken_inputs import write_broken_inputs

# A run that fails fails again, and none fails because the machine is busy; `--hypothesis-profile=default` explores.
for _name, _examples in (("repeatable", 40), ("thorough", 200)):
    settings.register_profile(_name, derandomize=True, deadline=None, max_examples=_examples)
settings.load_profile("repeatable")

_SLOW_SECONDS = 1800
"""The time limit of a slow test on a busy machine; that of all others is in pyproject.toml."""

MakeOnce = Callable[[str, Callable[[Path], object]], Path]


@pytest.fixture(scope="session")
def shared_folder(tmp_path_factory: pytest.TempPathFactory, pytestconfig: pytest.Config) -> Path:
    """A folder of all processes of this run of the tests."""
    own = tmp_path_factory.getbasetemp()
    folder = (own.parent if hasattr(pytestconfig, "workerinput") else own) / "shared"
    folder.mkdir(exist_ok=True)
    return folder


@pytest.fixture(scope="session", autouse=True)
def own_cache(shared_folder: Path) -> Iterator[None]:
    """An empty cache, so that nothing depends on what a machine has made before, but for files that were downloaded."""
    downloaded = [folder for folder in (user_cache("robots"), user_cache("features")) if folder.is_dir()]
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("XDG_CACHE_HOME", str(shared_folder / "cache"))
        for folder in downloaded:
            here = user_cache(folder.name)
            here.parent.mkdir(parents=True, exist_ok=True)
            with suppress(FileExistsError):  # another process was faster
                here.symlink_to(folder)
        yield


@pytest.fixture(scope="session")
def make_once(shared_folder: Path) -> MakeOnce:
    """A function that makes a folder of a name, unless another process of the same test run has made it, and returns it."""

    def once(name: str, make: Callable[[Path], object]) -> Path:
        folder, done = shared_folder / name, shared_folder / f"{name}.made"
        with (shared_folder / f"{name}.lock").open("w") as lock:
            fcntl.flock(lock, fcntl.LOCK_EX)
            if not done.exists():
                shutil.rmtree(folder, ignore_errors=True)  # of a process that failed
                folder.mkdir()
                make(folder)
                done.touch()
        return folder

    return once


@pytest.fixture(scope="session")
def real_data() -> Path:
    """Twelve scenes over 25 real meshes, with truth.json, in the MesaTask-10K format: ``tests/data/README.md``."""
    return Path(__file__).parent / "data"


@pytest.fixture(scope="session")
def broken_data(real_data: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A dataset of ``tests.broken_inputs.BROKEN_INPUTS``: one scene for each, which has its name."""
    root = tmp_path_factory.mktemp("broken_inputs") / "data"
    write_broken_inputs(root, real_data)
    return root


@pytest.fixture(scope="session")
def shared_data() -> Path:
    """The development sets beside the checkout, larger than ``tests/data``; they are not part of the project."""
    folder = Path(__file__).resolve().parents[2] / "shared" / "data"
    if not folder.is_dir():
        pytest.skip("the development data beside the checkout (../shared/data) are absent")
    return folder


@pytest.fixture(scope="session", params=["small", pytest.param("large", marks=pytest.mark.slow)])
def measured_data(request: pytest.FixtureRequest) -> Path:
    """For tests of a rate: ``tests/data``, and among the slow tests the 120 scenes of ``mesa_real`` beside the checkout."""
    small: Path = request.getfixturevalue("real_data")
    return small if request.param == "small" else Path(request.getfixturevalue("shared_data")) / "mesa_real"


@pytest.fixture(scope="session")
def dataset(make_once: MakeOnce) -> Path:
    """Four embedded scenes. A test that changes one copies it first, since other processes use it."""
    return make_once("embedded", lambda folder: write_world(folder / "data", 4, EmbeddedWorld(seed=3, pictures=False))) / "data"


@pytest.fixture(scope="session")
def clean_run(dataset: Path, make_once: MakeOnce) -> Path:
    """A run of preprocess over ``dataset``. A test that changes it copies it first."""

    def make(folder: Path) -> None:
        from pipelines.execution.ray_executor import WorkerPool
        from pipelines.preprocess.job import preprocess
        from tests.pipelines.runs import SMALL

        preprocess(str(dataset), str(folder / "out"), SMALL, WorkerPool())

    return make_once("clean_run", make) / "out"


@pytest.fixture(scope="session")
def generated(dataset: Path, make_once: MakeOnce) -> Path:
    """Three scenes of three objects and two failures of the generate job, in three shards; settled.

    A test that changes the run copies it first.
    """
    return make_once("generated", lambda folder: _generate(dataset, folder)) / "run"


def _generate(dataset: Path, folder: Path) -> None:
    # Imported here: most tests need neither the jobs nor torch.
    from models.semantic_reasoner.engines.registry import EngineSettings
    from models.semantic_reasoner.staged_layout import LayoutTask
    from models.semantic_reasoner.text.prompt import WANTED
    from pipelines.execution.ray_executor import WorkerPool
    from pipelines.generate.job import generate
    from pipelines.generate.settings import GenerateSettings
    from pipelines.sources.assets import AssetLibraries
    from pipelines.sources.generation_tasks import TaskSource
    from tests.pipelines.scripts import entry

    shelf = AssetLibraries([str(dataset)])
    first, second, third = shelf.libraries[0].assets[1:4]
    script = {
        "Say nonsense": "what?",
        "That answer cannot be used": "what?",
        WANTED[Stage.TASK]: {"objects": [entry(first, 20.0)]},
        WANTED[Stage.IMPORTANT]: {"objects": [entry(second, 21.0)]},
        WANTED[Stage.SECONDARY]: {"objects": [entry(third, 22.0)]},
    }
    (folder / "script.json").write_text(json.dumps(script))
    engine = EngineSettings(f"scripted:{folder / 'script.json'}")
    settings = GenerateSettings(engine, weights="none", scenes_per_shard=2, keep_settled=True, num_pictures=0)
    desk = Tabletop("office_table", (1.2, 0.6))
    said = ("Lift it.", "Say nonsense", "Turn it.", "Say nonsense again", "Take it.")
    tasks = TaskSource("tasks", [LayoutTask(f"task_{n}", words, desk) for n, words in enumerate(said)])
    generate(tasks, str(folder / "run"), settings, WorkerPool(), [str(dataset)])


@pytest.fixture(scope="session")
def imported(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Twelve scanned assets with textures: a run of the import job that is part of the project, with checksums, which it lacks.

    Its table of failures, which has no rows, is not in the project.
    """
    from tests.stable_data.verification.editing import hide

    run = tmp_path_factory.mktemp("imported") / "run"
    shutil.copytree(Path(__file__).parents[1] / "pipelines" / "sources" / "real_library" / "ycb", run)
    RunFolder(str(run)).write_shard("failures", "0" * 16, [])
    hide(run)
    return run


@pytest.fixture
def rng() -> np.random.Generator:
    return np.random.default_rng(0)


@pytest.hookimpl(wrapper=True)
def pytest_collection() -> Generator[None, object, object]:
    """Keeps the garbage collector from traversing all modules and tests, which stay to the end, again and again."""
    gc.disable()
    try:
        return (yield)
    finally:
        gc.freeze()
        gc.enable()


def pytest_unconfigure() -> None:
    """Lets Python free at its end what was kept from the collector."""
    gc.unfreeze()


# --- a local Ray for many tests -----------------------------------------------------------------------------------------------

_RAY_FILES = pytest.StashKey[set[Path]]()


@pytest.fixture
def local_ray() -> None:
    """A local Ray with two cores, and one GPU that need not be there. It stays for the next tests that use it.

    A start takes longer than most tests. A test with the mark ``ray`` that does not use this fixture begins without a Ray.
    """
    if not ray.is_initialized():
        ray.init("local", num_cpus=2, num_gpus=1, include_dashboard=False, log_to_driver=False, logging_level=logging.ERROR)


def pytest_collection_modifyitems(session: pytest.Session, items: list[pytest.Item]) -> None:
    """Gives slow tests their time limit, and puts the files first that take the longest.

    So no worker of pytest-xdist is left with one at the end. They are the files that use Ray, and then those with at least a hundred
    tests, slow ones counted.
    """
    for item in items:
        if item.get_closest_marker("slow") is not None and item.get_closest_marker("timeout") is None:
            item.add_marker(pytest.mark.timeout(_SLOW_SECONDS))
    ray_files, num_tests = {item.path for item in items if item.get_closest_marker("ray")}, Counter(item.path for item in items)
    items.sort(key=lambda item: (item.path not in ray_files, -(num_tests[item.path] // 100)))
    session.stash[_RAY_FILES] = {item.path for item in items if _uses_local_ray(item)}


@pytest.hookimpl(trylast=True)
def pytest_runtest_teardown(item: pytest.Item, nextitem: pytest.Item | None) -> None:
    """Ends the shared Ray before a test that begins without one, and before a file that does not use it."""
    if not ray.is_initialized() or (nextitem is not None and _uses_local_ray(nextitem)):
        return
    is_last = nextitem is None or nextitem.path not in item.session.stash[_RAY_FILES]
    if is_last or (nextitem is not None and nextitem.get_closest_marker("ray") is not None):
        ray.shutdown()


def _uses_local_ray(item: pytest.Item) -> bool:
    return isinstance(item, pytest.Function) and "local_ray" in item.fixturenames
