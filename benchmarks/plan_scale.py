"""What a million scenes cost the driver: to plan them, to list and resume their run, and to end it.

``python -m benchmarks.plan_scale [--scenes 1000000] [--latency-ms 2] [--json FILE]``. The run is in a simulated object store: a file
system that knows the names of all shards and answers each request after a latency, 1,000 names a listing. Its files have the columns
and the footers of real ones, but no values except ids. Each figure is of a process of its own, at 10,000, 100,000, ... scenes.

- ``plan``: tasks, fingerprints and shards of a generate job.
- ``resume``: from the start of the job, nine tenths of whose shards are there, to its first missing shard.
- ``end``: from its last shard to its end: shards are checked, rows are counted, the manifest is written.
- ``list``: ``stable-data inspect``.
"""

import argparse
import io
import json
import multiprocessing
import pickle
import tempfile
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import redirect_stderr, redirect_stdout, suppress
from dataclasses import asdict, dataclass, field
from multiprocessing.connection import Connection
from pathlib import Path, PurePosixPath
from typing import Any, ClassVar

import fsspec
import pyarrow as pa
import pyarrow.parquet as pq

from pipelines.execution.ray_executor import WorkerPool
from pipelines.execution.shard_job import run_job
from pipelines.execution.shard_step import WrittenShard
from pipelines.generate.job import GenerateJob
from pipelines.generate.settings import GenerateSettings
from pipelines.sources.generation_tasks import sample_tasks
from stable_data.commands.runs import inspect
from stable_data.storage.run_folder import PART
from stable_data.storage.schemas import SCHEMAS

URI = "fsspec+simulated://store/run"
_ROOT = URI.rpartition("://")[2]
_PAGE = 1000  # names that an object store lists at once
_THERE = 0.9


class SimulatedStore(fsspec.AbstractFileSystem):  # type: ignore[misc]  # fsspec has no types
    """An object store that makes the content of a shard when it is read.

    Attributes:
        ids: Ids of the scenes of each file of the table ``scenes``, by its name.
        names: Names of the files of shards, by table.
        files: Contents of other files, by path.
        latency: Seconds of a request.
        requests: Number of requests.
    """

    protocol: ClassVar = "simulated"
    cachable = True  # all that open the URI in a process share the store

    def __init__(self, **options: Any) -> None:
        super().__init__(**options)
        self.ids: dict[str, list[str]] = {}
        self.names: dict[str, dict[str, None]] = {}
        self.files: dict[str, bytes] = {}
        self.latency, self.requests = 0.0, 0
        self._empty: dict[str, bytes] = {}

    def add(self, name: str, tables: Sequence[str], tasks: Sequence[Any]) -> None:
        """Adds a shard of some tables: a file of each."""
        for table in tables:
            self.names.setdefault(table, {})[name] = None
        if "scenes" in tables:
            self.ids[name] = [task.scene_id for task in tasks]

    def find(self, path: str, maxdepth: int | None = None, withdirs: bool = False, **_: Any) -> dict[str, dict[str, Any]]:
        """Lists a folder."""
        parts = PurePosixPath(self._strip_protocol(path)).relative_to(_ROOT).parts
        if not parts:
            self._ask()
            return {f"{_ROOT}/{table}": _entry(f"{_ROOT}/{table}") for table in self.names}
        names = self.names.get(parts[0], {})
        for _page in range(0, max(1, len(names)), _PAGE):
            self._ask()
        paths = [f"{_ROOT}/{parts[0]}/{name}" for name in names]
        return {found: _entry(found, 1000) for found in paths}

    def info(self, path: str, **_: Any) -> dict[str, Any]:
        """Returns what is at a path; not counted, because what follows is."""
        path = str(self._strip_protocol(path))
        table, _slash, name = path.removeprefix(f"{_ROOT}/").partition("/")
        if path in self.files:
            return _entry(path, len(self.files[path]))
        if name and name in self.names.get(table, {}):
            return _entry(path, 1000)
        if not name:
            return _entry(path)
        raise FileNotFoundError(path)

    def _open(self, path: str, mode: str = "rb", **_: Any) -> io.BytesIO:
        path = self._strip_protocol(path)
        self._ask()
        if "r" in mode:
            return io.BytesIO(self.files[path] if path in self.files else self._content(path))
        return _Written(self, path)

    def mkdir(self, path: str, create_parents: bool = True, **_: Any) -> None:
        """Makes nothing: an object store has no folders."""

    def _ask(self) -> None:
        self.requests += 1
        time.sleep(self.latency)

    def _content(self, path: str) -> bytes:
        table, name = path.split("/")[-2:]
        if table == "scenes":
            return _scene_file(self.ids[name])
        if table not in self._empty:
            self._empty[table] = _file_of(SCHEMAS[table].empty_table())
        return self._empty[table]


class _Written(io.BytesIO):
    """A file that is in the store once it is closed."""

    def __init__(self, store: SimulatedStore, path: str) -> None:
        super().__init__()
        self._store, self._path = store, path

    def close(self) -> None:
        if not self.closed:
            self._store.files[self._path] = self.getvalue()
            folder, _, name = self._path.removeprefix(f"{_ROOT}/").partition("/")
            if PART.fullmatch(name):
                self._store.names.setdefault(folder, {})[name] = None
        super().close()


def _entry(path: str, size: int | None = None) -> dict[str, Any]:
    return {"name": path, "size": size or 0, "type": "directory" if size is None else "file"}


_templates: dict[tuple[int, ...], tuple[bytearray, list[int]]] = {}


def _scene_file(ids: Sequence[str]) -> bytes:
    """A file of ``scenes`` without values except ids: they replace others of the same lengths in a file that is made once."""
    lengths = tuple(map(len, ids))
    if lengths not in _templates:
        words = [f"{number}".rjust(length, "~") for number, length in enumerate(lengths)]
        schema = SCHEMAS["scenes"]
        blank = [pa.array(words) if f.name == "scene_id" else pa.nulls(len(ids), f.type) for f in schema]
        template = _file_of(pa.Table.from_arrays(blank, schema=schema))
        _templates[lengths] = bytearray(template), [template.index(word.encode()) for word in words]
    content, places = _templates[lengths]
    for place, scene_id in zip(places, ids, strict=True):
        content[place : place + len(scene_id)] = scene_id.encode()
    return bytes(content)


def _file_of(rows: pa.Table) -> bytes:
    sink = io.BytesIO()
    pq.write_table(rows, sink, compression="none", use_dictionary=False, write_statistics=False)
    return sink.getvalue()


class _StopError(Exception):
    """The simulated run is stopped."""


@dataclass(frozen=True, slots=True)
class SimulatedWorkers(WorkerPool):
    """Workers that write shards of no content, at once.

    Attributes:
        store: The store.
        share: Share of the shards after which the run is stopped.
        told: Called before the first shard, and after the last one.
    """

    store: SimulatedStore = field(default_factory=SimulatedStore)
    share: float = 1.0
    told: Callable[[], None] = lambda: None

    def run(self, work: Any, shards: Sequence[Any]) -> Iterator[Any]:
        """Writes the shards."""
        self.told()
        for number, task in enumerate(shards):
            if number + 1 > self.share * len(shards):
                raise _StopError
            name, tables = f"part-{task.shard.shard_id}.parquet", work.steps[task.step].TABLES
            self.store.add(name, tables, task.shard.items)
            yield WrittenShard(len(task.shard), 0, {f"{table}/{name}": "0" * 64 for table in tables})
        self.told()


@dataclass(frozen=True, slots=True)
class ScaleFigure:
    """What a part of the driver's work costs.

    Attributes:
        part: The part.
        scenes: Number of scenes of the run.
        files: Number of its files when the part ended.
        seconds: Time.
        cpu_seconds: Time of the processor.
        requests: Requests to the store.
        peak_mb: Largest memory of the process during the part above that before it, MB.
    """

    part: str
    scenes: int
    files: int
    seconds: float
    cpu_seconds: float
    requests: int
    peak_mb: float


@dataclass(slots=True)
class _Meter:
    """Measures what follows: time, requests and memory."""

    store: SimulatedStore
    began: float = field(default_factory=time.perf_counter)
    cpu_began: float = field(default_factory=time.process_time)
    requests: int = 0
    memory: float = 0.0

    def __post_init__(self) -> None:
        self.requests, self.memory = self.store.requests, _memory_mb("VmRSS")
        Path("/proc/self/clear_refs").write_text("5")  # the peak of the memory is that of what follows

    def figure(self, part: str, scenes: int) -> ScaleFigure:
        seconds, cpu_seconds = time.perf_counter() - self.began, time.process_time() - self.cpu_began
        peak, files = _memory_mb("VmHWM") - self.memory, sum(map(len, self.store.names.values()))
        return ScaleFigure(part, scenes, files, seconds, cpu_seconds, self.store.requests - self.requests, peak)


def _memory_mb(key: str) -> float:
    lines = Path("/proc/self/status").read_text("utf-8").splitlines()
    return next(int(line.split()[1]) for line in lines if line.startswith(f"{key}:")) / 1024


def _job(num_scenes: int) -> GenerateJob:
    return GenerateJob(sample_tasks(num_scenes), GenerateSettings())


def _opened_store(latency: float, state: Path | None = None) -> SimulatedStore:
    """The store of this process, which also has what a run needs that has one scene."""
    fsspec.register_implementation("simulated", SimulatedStore, clobber=True)
    store: SimulatedStore = fsspec.filesystem("simulated")
    _plan(1)
    if state is not None:
        store.names, store.ids, store.files = pickle.loads(state.read_bytes())  # noqa: S301 - written by this program
    store.latency = latency
    return store


def _plan(num_scenes: int) -> None:
    job = _job(num_scenes)
    job.inputs()
    job.plan()
    job.expected()


def _run(num_scenes: int, workers: SimulatedWorkers) -> None:
    with redirect_stderr(io.StringIO()), suppress(_StopError):
        run_job(_job(num_scenes), URI, workers, report=False)


def _fill(num_scenes: int, share: float, state: Path, latency: float, pipe: Connection) -> None:
    """Makes a run with a share of its shards."""
    store = _opened_store(0.0)
    _run(num_scenes, SimulatedWorkers(store=store, share=share))
    state.write_bytes(pickle.dumps((store.names, store.ids, store.files)))
    pipe.send([])


def _measure_plan(num_scenes: int, share: float, state: Path, latency: float, pipe: Connection) -> None:
    meter = _Meter(_opened_store(latency))
    _plan(num_scenes)
    pipe.send([meter.figure("plan", num_scenes)])


def _measure_run(num_scenes: int, share: float, state: Path, latency: float, pipe: Connection) -> None:
    store, marks = _opened_store(latency, state), list[ScaleFigure]()
    meters = [_Meter(store)]

    def told() -> None:
        if len(marks) < 2:  # before the first shard and after the last one; the copies of assets follow
            marks.append(meters[-1].figure("resume" if not marks else "made", num_scenes))
            meters.append(_Meter(store))

    _run(num_scenes, SimulatedWorkers(store=store, told=told))
    pipe.send([marks[0], meters[-1].figure("end", num_scenes)])


def _measure_list(num_scenes: int, share: float, state: Path, latency: float, pipe: Connection) -> None:
    meter = _Meter(_opened_store(latency, state))
    with redirect_stdout(io.StringIO()):
        inspect(URI)
    pipe.send([meter.figure("list", num_scenes)])


def figures_of(num_scenes: int, latency: float) -> list[ScaleFigure]:
    """Measures all parts at a number of scenes, each in a process of its own."""
    found: list[ScaleFigure] = []
    context = multiprocessing.get_context("forkserver")
    context.set_forkserver_preload(["pipelines.generate.job"])  # the libraries are imported once
    steps = [(_measure_plan, 0.0), (_fill, _THERE), (_measure_run, 0.0), (_fill, 1.0), (_measure_list, 0.0)]
    with tempfile.TemporaryDirectory() as folder:
        for step, share in steps:
            mine, theirs = context.Pipe()
            process = context.Process(target=step, args=(num_scenes, share, Path(folder) / "state", latency, theirs))
            process.start()
            theirs.close()
            try:
                found += mine.recv()
            except EOFError:
                raise RuntimeError(f"{step.__name__} of {num_scenes} scenes ended without figures") from None
            process.join()
    return found


def show(found: Sequence[ScaleFigure]) -> None:
    """Prints the table."""
    print(f"{'part':8} {'scenes':>10} {'files':>8} {'seconds':>9} {'cpu s':>8} {'requests':>9} {'peak MB':>8} {'us/scene':>9}")
    for f in sorted(found, key=lambda f: f.part):
        each = 1e6 * f.cpu_seconds / f.scenes
        print(
            f"{f.part:8} {f.scenes:10,} {f.files:8,} {f.seconds:9.1f} {f.cpu_seconds:8.1f} {f.requests:9,} {f.peak_mb:8.0f} {each:9.1f}"
        )


def main() -> None:
    """Prints the figures."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--scenes", type=int, default=10**6, help="the largest number of scenes")
    parser.add_argument("--latency-ms", type=float, default=2.0, help="of a request to the store")
    parser.add_argument("--json", type=Path)
    arguments = parser.parse_args()
    found: list[ScaleFigure] = []
    for num_scenes in sorted({max(1, arguments.scenes // factor) for factor in (100, 10, 1)}):
        found += figures_of(num_scenes, arguments.latency_ms / 1000)
    show(found)
    if arguments.json:
        arguments.json.write_text(json.dumps([asdict(f) for f in found], indent=2) + "\n", "utf-8")


if __name__ == "__main__":
    main()
