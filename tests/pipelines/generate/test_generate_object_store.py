"""The generate job with an object store that refuses requests now and then, and for a while all of them."""

import json
import random
import threading
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import Any

import pyarrow as pa
import pytest

from benchmarks.faults.s3_server import Application
from models.semantic_reasoner.engines.registry import EngineSettings
from models.semantic_reasoner.staged_layout import LayoutTask
from pipelines.execution.ray_executor import WorkerPool
from pipelines.generate.job import generate
from pipelines.generate.settings import GenerateSettings
from pipelines.generate.shard import GenerateWork
from pipelines.sources.assets import AssetLibraries
from pipelines.sources.generation_tasks import TaskSource
from stable_data.errors import ConfigError
from stable_data.scene import Tabletop
from stable_data.storage.run_folder import RunFolder
from tests.object_store import object_store
from tests.pipelines.scripts import one_thing_a_stage

TASKS = [LayoutTask(f"task_{n}", "Lift it.", Tabletop("office_table", (1.2, 0.6))) for n in range(4)]
REFUSALS = (("500 Internal Server Error", "InternalError"), ("503 Slow Down", "SlowDown"))


class Refusing:
    """An S3 that refuses a share of the requests, at random.

    Attributes:
        share: From 0 to 1.
        asked: Requests so far.
        refused: Those of them that were refused.
    """

    def __init__(self) -> None:
        self.share, self.asked, self.refused = 0.0, 0, 0
        self._rng, self._lock = random.Random(0), threading.Lock()  # noqa: S311

    def around(self, application: Application) -> Application:
        """Stands before a store."""
        self._application = application
        return self

    def __call__(self, environment: dict[str, Any], start: Any) -> Iterable[bytes]:
        with self._lock:
            is_refused = self._rng.random() < self.share
            status, code = self._rng.choice(REFUSALS)
            self.asked += 1
            self.refused += is_refused
        if not is_refused:
            return self._application(environment, start)
        environment["wsgi.input"].read(int(environment.get("CONTENT_LENGTH") or 0))
        body = f"<?xml version='1.0'?><Error><Code>{code}</Code><Message>try again later</Message></Error>".encode()
        start(status, [("Content-Type", "application/xml"), ("Content-Length", str(len(body)))])
        return [body]


@pytest.fixture
def store() -> Iterator[tuple[Refusing, str]]:
    """The store, and the URI of a run folder in it."""
    refusing = Refusing()
    with object_store(refusing.around) as uri:
        yield refusing, uri


@pytest.fixture(scope="module")
def settings(dataset: Path, tmp_path_factory: pytest.TempPathFactory) -> GenerateSettings:
    """An engine that puts one thing on the table in each stage; nothing is learned, and the physics engine is not asked."""
    assets = AssetLibraries([str(dataset)]).libraries[0].assets[1:4]
    path = tmp_path_factory.mktemp("script") / "script.json"
    path.write_text(json.dumps(one_thing_a_stage(assets)))
    return GenerateSettings(
        EngineSettings(f"scripted:{path}"), weights="none", settle=False, accept="clean", scenes_per_shard=2
    )


@pytest.fixture(scope="module")
def local(dataset: Path, settings: GenerateSettings, tmp_path_factory: pytest.TempPathFactory) -> RunFolder:
    out = str(tmp_path_factory.mktemp("local") / "run")
    generate(TaskSource("tasks", TASKS), out, settings, WorkerPool(), [str(dataset)])
    return RunFolder(out)


def assert_same(first: RunFolder, second: RunFolder) -> None:
    for table in GenerateWork.TABLES:
        assert first.table(table).equals(second.table(table)), table


@pytest.mark.slow
def test_a_store_that_refuses_some_requests_gets_the_same_rows(
    dataset: Path, settings: GenerateSettings, local: RunFolder, store: tuple[Refusing, str]
) -> None:
    refusing, uri = store
    refusing.share = 0.05
    manifest = generate(TaskSource("tasks", TASKS), uri, settings, WorkerPool(), [str(dataset)])
    assert manifest["counts"]["scenes"] == len(TASKS)
    assert refusing.refused >= 5
    assert_same(RunFolder(uri), local)


@pytest.mark.slow
def test_a_store_that_is_gone_ends_the_run_with_one_line_and_what_is_there_stays(
    dataset: Path, settings: GenerateSettings, local: RunFolder, store: tuple[Refusing, str], monkeypatch: pytest.MonkeyPatch
) -> None:
    refusing, uri = store
    write, calls = RunFolder.write_table, 0

    def goes_away(self: RunFolder, table: str, shard_id: str, rows: pa.Table) -> None:
        nonlocal calls
        calls += 1
        refusing.share = float(calls > len(GenerateWork.TABLES) + 4)  # in the middle of the second shard's tables
        write(self, table, shard_id, rows)

    monkeypatch.setattr(RunFolder, "write_table", goes_away)
    with pytest.raises(ConfigError, match=r"cannot be written .*then run again") as caught:
        generate(TaskSource("tasks", TASKS), uri, settings, WorkerPool(), [str(dataset)])
    assert caught.value.code == "output_unwritable"
    assert "\n" not in str(caught.value)
    monkeypatch.undo()
    refusing.share = 0.0
    assert len(RunFolder(uri).shard_ids("scenes")) == 1
    generate(TaskSource("tasks", TASKS), uri, settings, WorkerPool(), [str(dataset)])
    assert_same(RunFolder(uri), local)
