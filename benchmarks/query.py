"""Queries of a large run: scenes by id, counts and selections by condition, each compared with a scan of the table.

``python -m benchmarks.query RUN FOLDER [--rows N] [--json FILE]``. RUN is any run with scenes. FOLDER gets a run of N scenes that
are made of those of RUN: each has an id and metrics of its own, and its objects are moved and resized a little (about 1.9 kB a
scene). It is used again if it exists; remove it afterwards. Each figure is of a process of its own, so that its memory is known;
the files are in the cache of the system. The index of FOLDER is in FOLDER. Run with ``OMP_NUM_THREADS=1``.
"""

import argparse
import json
import multiprocessing
import resource
import tempfile
import time
from collections.abc import Callable
from dataclasses import asdict, dataclass
from multiprocessing.connection import Connection
from pathlib import Path
from typing import Any, TypeAlias

import numpy as np
import pyarrow as pa

from stable_data.content_id import content_id
from stable_data.storage.filter_expression import parse_filter
from stable_data.storage.row_groups import TableFiles
from stable_data.storage.run_folder import RunFolder
from stable_data.storage.scene_index import SceneIndex
from stable_data.storage.schemas import SCHEMAS
from stable_data.storage.subset import count_selected, select

FILE_ROWS = 2048  # about as many as a file of `stable-data query --to` has
WHERE = "stable and num_stacked >= 2 and move_mean_mm < 1"
RARE = "stable and num_stacked >= 5 and move_mean_mm < 0.13"
"""A condition that about one scene in a hundred passes."""

Measured: TypeAlias = dict[str, float]
Task: TypeAlias = Callable[[str, Path], Measured]
"""A run and a folder for files -> what was measured."""


@dataclass(frozen=True, slots=True)
class QueryFigure:
    """The figures of one task.

    Attributes:
        task: What was done.
        way: ``index``, ``query``, or ``scan``: as it was done before.
        seconds: Its time: the median of repeated accesses.
        cpu_seconds: The time of the processor, which other programs of the machine lengthen less; the median likewise.
        seconds_p99: 99th percentile of repeated accesses.
        peak_mb: Largest memory of the process, MB, with about 150 MB of the libraries.
        rows: Number of rows that were found.
        ratio: Time of the scan divided by this time; None: the scan was not measured.
    """

    task: str
    way: str
    seconds: float
    cpu_seconds: float
    seconds_p99: float
    peak_mb: float
    rows: int
    ratio: float | None


def write_rows(source: RunFolder, target: RunFolder, num_rows: int) -> None:
    """Writes a run of many scenes that are made of those of another run, unless it is there."""
    base, existing = source.table("scenes").combine_chunks(), target.shard_ids("scenes")
    for start in range(0, num_rows, FILE_ROWS):
        name = content_id("benchmark", start)
        if name not in existing:
            target.write_table("scenes", name, rows_of(base, start, min(FILE_ROWS, num_rows - start)))


def rows_of(base: pa.Table, start: int, count: int) -> pa.Table:
    """Makes some rows: the same ones for the same start."""
    random = np.random.default_rng([29, start])
    rows = base.take(random.integers(0, len(base), count)).combine_chunks()
    metrics: dict[str, pa.Array] = {
        "scene_id": pa.array([scene_name(start + k) for k in range(count)]),
        "objects": _moved(rows["objects"].combine_chunks(), random),
        "num_stacked": pa.array(random.integers(0, 6, count)),
        "stable": pa.array(random.random(count) < 0.9, mask=random.random(count) < 0.05),
    }
    metrics |= {
        name: pa.array(random.gamma(1.0, 2.0, count)) for name in ("move_mean_mm", "drift_mm", "jitter_mm", "max_gap_mm")
    }
    for name, values in metrics.items():
        number = rows.schema.get_field_index(name)
        rows = rows.set_column(number, rows.schema.field(number), values)
    return rows.cast(SCHEMAS["scenes"])


def scene_name(number: int) -> str:
    """The id of a scene of the benchmark."""
    return f"scene-{content_id(number)}"


def _moved(objects: pa.ListArray, random: np.random.Generator) -> pa.ListArray:
    """Objects with other positions and sizes, so that the numbers compress as those of real scenes."""
    flat, columns = objects.values, []
    for field in flat.type:
        column = flat.field(field.name)
        if field.name in ("position", "size", "scale"):
            values = column.values.to_numpy(zero_copy_only=False) * random.uniform(0.999, 1.001, len(column.values))
            column = pa.ListArray.from_arrays(
                column.offsets, pa.array(values), mask=column.is_null() if column.null_count else None
            )
        elif field.name == "yaw":
            column = pa.array(column.to_numpy() + random.normal(0.0, 1.0, len(column)))
        columns.append(column)
    return pa.ListArray.from_arrays(objects.offsets, pa.StructArray.from_arrays(columns, fields=list(flat.type)))


def _names(run: str, count: int, seed: int) -> list[str]:
    total = RunFolder(run).num_rows("scenes")
    return [
        scene_name(number) for number in np.random.default_rng(seed).choice(total, min(count, total), replace=False).tolist()
    ]


def _repeated(access: Callable[[], object], times: int) -> Measured:
    seconds: list[float] = []
    processor: list[float] = []
    for _ in range(times):
        start, cpu = time.perf_counter(), time.process_time()
        access()
        seconds.append(time.perf_counter() - start)
        processor.append(time.process_time() - cpu)
    return {
        "seconds": float(np.median(seconds)),
        "cpu_seconds": float(np.median(processor)),
        "seconds_p99": float(np.percentile(seconds, 99)),
    }


def build(run: str, folder: Path) -> Measured:
    """Makes the index."""
    for path in folder.glob("*.index"):
        path.unlink()
    measured = _repeated(lambda: SceneIndex(run, folder=folder), 1)
    index = SceneIndex(run, folder=folder)
    return measured | {"rows": len(index), "bytes": float(index.path.stat().st_size)}


def reopen(run: str, folder: Path) -> Measured:
    """Opens the stored index."""
    return _repeated(lambda: SceneIndex(run, folder=folder), 5) | {"rows": float(len(SceneIndex(run, folder=folder)))}


def one_warm(run: str, folder: Path) -> Measured:
    """Reads scenes of one open index, one at a time: 200 that were read before in other order."""
    index, names = SceneIndex(run, folder=folder), _names(run, 200, 1)
    index.scenes(names)
    rest = iter(names)
    return _repeated(lambda: index.scene(next(rest)), len(names)) | {"rows": 1}


def one_anywhere(run: str, folder: Path) -> Measured:
    """Reads 500 scenes of the whole run, one at a time, most of them of files that were not opened yet."""
    index, names = SceneIndex(run, folder=folder), iter(_names(run, 501, 2))
    index.scene(next(names))
    rest = list(names)
    scenes = iter(rest)
    return _repeated(lambda: index.scene(next(scenes)), len(rest)) | {"rows": 1}


def many(run: str, folder: Path) -> Measured:
    """Reads 256 random scenes at once, after 2,048 others of one open index."""
    index = SceneIndex(run, folder=folder)
    index.scenes(_names(run, 2048, 3))
    draws = iter([_names(run, 256, seed) for seed in range(4, 13)])
    return _repeated(lambda: index.scenes(next(draws)), 9) | {"rows": 256}


def _scan_ids(run: str, names: list[str]) -> int:
    files = TableFiles(run, "scenes", None, where=f"scene_id in {names!r}")
    return sum(files.read([group]).num_rows for group in range(len(files.groups)))


def one_by_scan(run: str, folder: Path) -> Measured:
    """Reads a scene without an index."""
    return _repeated(lambda: _scan_ids(run, _names(run, 1, 2)), 1) | {"rows": 1}


def many_by_scan(run: str, folder: Path) -> Measured:
    """Reads 256 random scenes without an index."""
    return _repeated(lambda: _scan_ids(run, _names(run, 256, 3)), 1) | {"rows": 256}


def count(run: str, folder: Path) -> Measured:
    """Counts the scenes that pass a condition."""
    return _repeated(lambda: count_selected(RunFolder(run), WHERE), 1) | {"rows": count_selected(RunFolder(run), WHERE)[0]}


def count_by_scan(run: str, folder: Path) -> Measured:
    """Counts with a scan of pyarrow that keeps the ids."""
    expression, found = parse_filter(WHERE, SCHEMAS["scenes"]).expression, list[int]()

    def scan() -> None:
        found.append(RunFolder(run).table("scenes", ["scene_id"], expression).num_rows)
        RunFolder(run).num_rows("scenes")

    return _repeated(scan, 1) | {"rows": found[0]}


def choose(run: str, folder: Path) -> Measured:
    """Writes the scenes that pass a rare condition."""
    with tempfile.TemporaryDirectory(dir=folder) as place:
        measured = _repeated(lambda: select(RunFolder(run), RARE, RunFolder(place)), 1)
        return measured | {"rows": RunFolder(place).num_rows("scenes")}


def choose_by_scan(run: str, folder: Path) -> Measured:
    """Writes them with two scans of pyarrow: one for the ids, one for the rows."""
    expression, scene_ids = parse_filter(RARE, SCHEMAS["scenes"]).expression, set[str]()
    source = RunFolder(run)

    def scan(target: RunFolder) -> None:
        for part in source.batches("scenes", ["scene_id", "objects", "surface"], expression):
            scene_ids.update(part["scene_id"].to_pylist())
        pending: list[pa.Table] = []
        for number, batch in enumerate(source.batches("scenes", where=expression)):
            pending += [pa.Table.from_batches([batch])] if batch.num_rows else []
            if sum(part.nbytes for part in pending) > 64 * 10**6:
                target.write_table("scenes", content_id(number), pa.concat_tables(pending))
                pending.clear()
        target.write_table(
            "scenes", content_id("rest"), pa.concat_tables([source.dataset("scenes").schema.empty_table(), *pending])
        )

    with tempfile.TemporaryDirectory(dir=folder) as place:
        return _repeated(lambda: scan(RunFolder(place)), 1) | {"rows": float(len(scene_ids))}


def _measure(task: Task, run: str, folder: Path, end: Connection) -> None:
    measured = task(run, folder)
    end.send(measured | {"peak_mb": resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1e3})


def alone(task: Task, run: str, folder: Path) -> Measured:
    """Measures a task in a process of its own."""
    context = multiprocessing.get_context("spawn")
    receiver, sender = context.Pipe(duplex=False)
    process = context.Process(target=_measure, args=(task, run, folder, sender))
    process.start()
    sender.close()
    try:
        measured: Measured = receiver.recv()
    finally:
        process.join()
    return measured


TASKS: tuple[tuple[str, str, Task, Task | None], ...] = (
    ("index, made", "index", build, None),
    ("index, opened", "index", reopen, None),
    ("a scene by id, read before", "index", one_warm, one_by_scan),
    ("a scene by id, anywhere", "index", one_anywhere, one_by_scan),
    ("256 scenes by id", "index", many, many_by_scan),
    ("scenes counted by condition", "query", count, count_by_scan),
    ("scenes selected by condition", "query", choose, choose_by_scan),
)


def measure(run: str, folder: Path, words: list[str], *, with_scans: bool = True) -> tuple[list[QueryFigure], Measured]:
    """Measures tasks, those of the scan too.

    Args:
        run: The large run.
        folder: A folder for indexes and selections.
        words: Only tasks whose names have one of these words; all if empty.
        with_scans: Whether the ways before are measured.

    Returns:
        The figures; and rows, bytes of the table a row, and bytes of the index a row.
    """
    figures: list[QueryFigure] = []
    scans: dict[Task, Measured] = {}
    sizes: Measured = {}

    def add(task: str, way: str, m: Measured, ratio: float | None) -> None:
        seconds, cpu, p99 = (round(m[name], 5) for name in ("seconds", "cpu_seconds", "seconds_p99"))
        rounded = None if ratio is None else round(ratio, 1)
        figure = QueryFigure(task, way, seconds, cpu, p99, round(m["peak_mb"]), int(m["rows"]), rounded)
        figures.append(figure)
        print(_line(figure), flush=True)

    for name, way, task, before in TASKS:
        if words and not any(word in name for word in words):
            continue
        found = alone(task, run, folder)
        if "bytes" in found:
            sizes["index_bytes"] = round(found["bytes"] / found["rows"], 1)
        if before is not None and with_scans and before not in scans:
            scans[before] = alone(before, run, folder)
            add(name.partition(",")[0], "scan", scans[before], 1.0)
        add(name, way, found, scans[before]["seconds"] / found["seconds"] if before in scans else None)
    stamps = RunFolder(run).file_stamps("scenes")
    total = RunFolder(run).num_rows("scenes")
    return figures, {"rows": total, "files": len(stamps), "row_bytes": round(sum(s for _, s, _ in stamps) / total, 1)} | sizes


def _line(f: QueryFigure) -> str:
    times = f"{f.seconds:10.4f} {f.cpu_seconds:10.4f} {f.seconds_p99:10.4f}"
    return f"{f.task:30} {f.way:6} {times} {f.peak_mb:8.0f} {f.rows:9} {'' if f.ratio is None else f'{f.ratio:7.1f}x'}"


def main() -> None:
    """Prints the figures."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("run", help="a run folder whose scenes are multiplied")
    parser.add_argument("folder", type=Path, help="folder for the large run")
    parser.add_argument("--rows", type=int, default=1_000_000, help="number of scenes")
    parser.add_argument("--json", type=Path, help="file for the figures")
    parser.add_argument("--tasks", nargs="*", default=[], help="only tasks whose names have one of these words")
    parser.add_argument("--no-scans", action="store_true", help="leave out the ways before, which take minutes for many rows")
    arguments = parser.parse_args()
    large, indexes = arguments.folder / f"rows-{arguments.rows}", arguments.folder / "indexes"
    write_rows(RunFolder(arguments.run), RunFolder(str(large)), arguments.rows)
    indexes.mkdir(exist_ok=True)
    print(f"{'task':30} {'way':6} {'median s':>10} {'CPU s':>10} {'p99 s':>10} {'peak MB':>8} {'rows':>9} {'ratio':>8}")
    figures, sizes = measure(str(large), indexes, arguments.tasks, with_scans=not arguments.no_scans)
    print(" · ".join(f"{name} {value:,}" for name, value in sizes.items()))
    if arguments.json:
        content: dict[str, Any] = {"sizes": sizes, "figures": [asdict(figure) for figure in figures]}
        arguments.json.write_text(json.dumps(content, indent=1) + "\n", "utf-8")


if __name__ == "__main__":
    main()
