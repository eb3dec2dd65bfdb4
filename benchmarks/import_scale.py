"""The import of many assets: its rate, its memory over time, and what a kill in the middle costs.

``python -m benchmarks.import_scale DATA [--out OUT] [--assets 300] [--workers 2] [--subset 100] [--json FILE]``, with DATA a dataset in
the MesaTask-10K format. Copies of its meshes are written to ``OUT/source``, each with other proportions, so that no two have the same
geometry, and every fourth with a texture of its own. ``stable-data import mesh`` then makes a library of them in ``OUT/library``. When
half of the assets are done, its process is killed and started again. At the end:

- Each asset must be exactly one row of ``assets`` or of ``failures``.
- The rows of some assets must equal those of a second import of these alone, which nothing interrupts.
- Memory is read every few seconds, of the driver and of each worker, and is written to ``OUT/memory.jsonl``. The growth compares the
  medians of the second tenth and of the last tenth of the assets.

With ``--out``, the benchmark may be stopped and started again with the same arguments; else OUT is a temporary folder.
"""

import json
import os
import shutil
import signal
import subprocess
import sys
import time
from collections import Counter, defaultdict
from collections.abc import Iterable, Sequence
from dataclasses import asdict, dataclass, replace
from io import BytesIO
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Annotated, Any

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc
import typer
from tqdm import tqdm

from benchmarks.faults.processes import below
from pipelines.reports.text_table import align_columns
from stable_data.commands.command_line import DONE, SOME_FAILED
from stable_data.errors import MeshError
from stable_data.geometry.gltf_reader import load_surfaces
from stable_data.geometry.gltf_writer import SurfaceParts, pack, y_up
from stable_data.geometry.surface import Surface
from stable_data.storage.run_folder import RunFolder
from stable_data.storage.schemas import SCHEMAS, Row

_PROPORTIONS = (0.8, 1.25)  # factors along each axis
_LONGEST = (0.05, 0.3)  # metres
_TEXTURED = 4  # one of so many copies
_PIXELS = 64
_PER_FOLDER = 1000
_PER_SHARD = 16
_LOOK_SECONDS = 2.0
_STOPPED_SECONDS = 30.0  # without a sample, in which the benchmark did not run
_WAIT_SECONDS = 20.0  # for the processes of a killed driver to end
_WORKERS = ("ray::_call", "ray::IDLE")  # processes of Ray that work on shards, or wait for one
_TABLES = {"assets": "asset_id", "meshes": "asset_id", "warnings": "id", "failures": "id", "textures": "sha256"}


@dataclass(frozen=True, slots=True)
class MemorySample:
    """The memory of an import at one moment.

    Attributes:
        seconds: Time of the sample, since 1970.
        num_done: Assets that are written.
        driver_mb: Memory of the driver.
        worker_mb: Memory of each process that has worked on assets, by its number.
        cpu_seconds: Processor seconds of these workers up to now.
    """

    seconds: float
    num_done: int
    driver_mb: float
    worker_mb: dict[str, float]
    cpu_seconds: dict[str, float]


@dataclass(frozen=True, slots=True)
class ImportFigures:
    """The figures of an import.

    Attributes:
        num_assets: Assets of the source.
        num_rows: Rows of ``assets``.
        num_failures: Rows of ``failures``.
        num_copies: Assets that share the geometry of an earlier one; 0 is expected.
        per_minute: Assets a minute of wall time and worker; starts, what the kill costs, and the report are included.
        per_cpu_minute: Assets a minute of processor time of the workers.
        kills: How often the driver was killed.
        driver_mb: Memory of the driver, median of the second and of the last tenth, and its peak.
        worker_mb: The same of the largest worker.
        num_compared: Assets that were imported again without an interruption.
        num_different: Rows that differ from those of this second import, by table.
    """

    num_assets: int
    num_rows: int
    num_failures: int
    num_copies: int
    per_minute: float
    per_cpu_minute: float
    kills: int
    driver_mb: tuple[float, float, float]
    worker_mb: tuple[float, float, float]
    num_compared: int
    num_different: dict[str, int]


def write_copies(data: Path, folder: Path, num: int) -> None:
    """Writes copies of the meshes of a dataset, those that are not there yet; the same number gives the same file."""
    annotations: dict[str, Any] = json.loads((data / "Asset_annotation.json").read_text("utf-8"))
    originals: list[tuple[str, list[Surface]]] = []
    for path in sorted((data / "Assets_library").glob("*.glb")):
        try:
            found = list(load_surfaces(path, path.stem))
        except MeshError:
            continue
        if found:
            originals.append((annotations.get(path.stem, {}).get("category") or "object", found))
    for number in tqdm(range(num), "copies", unit="file"):
        category, surfaces = originals[number % len(originals)]
        path = folder / f"{number // _PER_FOLDER:03}" / f"{category}_{number:06}.glb"
        if not path.exists():
            path.parent.mkdir(parents=True, exist_ok=True)
            aside = path.with_suffix(".part")
            aside.write_bytes(_copy(surfaces, number))
            aside.replace(path)


def _copy(surfaces: Sequence[Surface], number: int) -> bytes:
    rng = np.random.default_rng(number)
    soups = [surface.triangles for surface in surfaces]
    extents = np.ptp(np.concatenate(soups).reshape(-1, 3), axis=0)
    scale = rng.uniform(*_PROPORTIONS, 3)
    scale *= rng.uniform(*_LONGEST) / float((scale * extents).max())
    made = [replace(surface, triangles=surface.triangles * scale) for surface in surfaces]
    if number % _TEXTURED == 0:
        image = _image(rng)
        made = [replace(s, image=image, corner_uv=s.triangles[:, :, :2] / max(scale * extents)) for s in made]
    else:
        made = [replace(s, image=None, corner_uv=None) for s in made]
    parts = SurfaceParts()
    primitives = [parts.primitive(surface, y_up) for surface in made if len(surface.triangles)]
    document = {"scene": 0, "scenes": [{"nodes": [0]}], "nodes": [{"mesh": 0}], "meshes": [{"primitives": primitives}]}
    return pack(document | parts.document(parts.embedded_images()), parts.arrays, parts.images)


def _image(rng: np.random.Generator) -> bytes:
    from PIL import Image

    content = BytesIO()
    Image.fromarray(rng.integers(0, 256, (_PIXELS, _PIXELS, 3), np.uint8)).save(content, "PNG")
    return content.getvalue()


def import_copies(source: Path, library: Path, workers: int, num: int, *, log: Path | None = None) -> None:
    """Imports a folder.

    Args:
        source: The folder.
        library: The library that is made.
        workers: Worker processes.
        num: Number of assets.
        log: File of the memory, continued if it exists. With it, the driver is killed when half of the assets are written, unless that
            was done before, and started again. None: nothing disturbs the import.

    Raises:
        RuntimeError: The import ended with an error.
    """
    words = f"--workers {workers} --licence CC0-1.0 --set assets_per_shard={_PER_SHARD} --set decomposes=false"
    words += " --set unit_m=1 --set num_pictures=24"
    command = [sys.executable, "-m", "stable_data", "import", "mesh", str(source), "--out", str(library), *words.split()]
    killed = None if log is None else log.with_name("killed")
    process = subprocess.Popen(command)
    while process.poll() is None:
        if log is not None and killed is not None:
            sample = _memory(process.pid, min(num, _PER_SHARD * len(RunFolder(str(library)).shard_ids("assets"))))
            with log.open("a", encoding="utf-8") as file:
                file.write(json.dumps(asdict(sample)) + "\n")
            if not killed.exists() and num // 2 <= sample.num_done < num:
                killed.touch()
                _kill_driver(process)
                process = subprocess.Popen(command)
        time.sleep(_LOOK_SECONDS)
    if process.returncode not in (DONE, SOME_FAILED):
        raise RuntimeError(f"the import ended with status {process.returncode}")


def _kill_driver(process: subprocess.Popen[bytes]) -> None:
    """Kills the process that runs the job, which is below the command, and waits for all processes to end."""
    tree = below([process.pid])
    driver = _driver(tree)
    os.kill(driver, signal.SIGKILL)
    process.wait()
    until = time.monotonic() + _WAIT_SECONDS
    while time.monotonic() < until and any(Path(f"/proc/{pid}").exists() for pid in tree):
        time.sleep(0.5)
    if left := {pid: words[:80] for pid, words in tree.items() if Path(f"/proc/{pid}").exists()}:
        print(f"{_WAIT_SECONDS:g} s after the driver was killed, processes are left: {left}", flush=True)


def _driver(tree: dict[int, str]) -> int:
    return next((pid for pid, words in tree.items() if "-m pipelines import" in words), min(tree))


def _memory(root: int, num_done: int) -> MemorySample:
    tree = below([root])
    workers = [pid for pid, words in tree.items() if words.startswith(_WORKERS)]
    memory = {str(pid): mb for pid in workers if (mb := _resident_mb(pid)) > 0}
    return MemorySample(
        round(time.time(), 1),
        num_done,
        _resident_mb(_driver(tree)) if tree else 0.0,
        memory,
        {pid: _cpu_seconds(int(pid)) for pid in memory},
    )


def _resident_mb(pid: int) -> float:
    """The memory that belongs to a process alone and its share of what it shares, MB; 0 if it has ended."""
    try:
        lines = Path(f"/proc/{pid}/smaps_rollup").read_text("utf-8").splitlines()
    except OSError:
        return 0.0
    return round(next((int(line.split()[1]) / 1024 for line in lines if line.startswith("Pss:")), 0.0), 1)


def _cpu_seconds(pid: int) -> float:
    try:
        words = Path(f"/proc/{pid}/stat").read_text("utf-8").rpartition(")")[2].split()
    except OSError:
        return 0.0
    return (int(words[11]) + int(words[12])) / os.sysconf("SC_CLK_TCK")


def check_rows(library: Path, expected: Iterable[str]) -> tuple[int, int]:
    """Checks that each asset is exactly one row of ``assets`` or one failure, and returns the numbers of both.

    Raises:
        RuntimeError: It is not.
    """
    folder = RunFolder(str(library))
    made = Counter(folder.table("assets", ["asset_id"])["asset_id"].to_pylist())
    failed = Counter(folder.table("failures", ["id"])["id"].to_pylist())
    meshes = Counter(folder.table("meshes", ["asset_id"])["asset_id"].to_pylist())
    ids = set(expected)
    odd = sorted(ids ^ (made + failed).keys()) + sorted(k for k, n in (made + failed).items() if n != 1)
    if odd or made != meshes:
        raise RuntimeError(f"{len(odd)} assets such as {odd[:3]} are not exactly one row or one failure")
    return made.total(), failed.total()


def different_rows(library: Path, alone: Path) -> dict[str, int]:
    """Counts the rows of a library that differ from those of a smaller one made of some of its assets, by table."""
    ids = RunFolder(str(alone)).table("assets", ["asset_id"])["asset_id"].to_pylist()
    found = {}
    for table, column in _TABLES.items():
        own = RunFolder(str(alone)).table("textures", [column])[column].to_pylist() if table == "textures" else ids
        one, other = (_rows_of(path, table, column, own) for path in (library, alone))
        found[table] = sum(one.get(key) != other.get(key) for key in {*one, *other})
    return found


def _rows_of(library: Path, table: str, column: str, ids: Sequence[str]) -> dict[str, list[Row]]:
    """The rows of some assets or textures. The same texture may be in several shards."""
    rows: dict[str, list[Row]] = defaultdict(list)
    for batch in RunFolder(str(library)).batches(
        table, SCHEMAS[table].names, pc.field(column).isin(pa.array(ids, pa.string()))
    ):
        for row in batch.to_pylist():
            if table != "textures" or row not in rows[row[column]]:
                rows[row[column]].append(row)
    return {key: sorted(found, key=str) for key, found in rows.items()}


def _samples(log: Path) -> list[MemorySample]:
    return [MemorySample(**json.loads(line)) for line in log.read_text("utf-8").splitlines()]


def _tenths(samples: Sequence[MemorySample], num: int, values: Sequence[float]) -> tuple[float, float, float]:
    """Medians of the second and of the last tenth of the assets, and the peak."""

    def median(low: float, high: float) -> float:
        part = [v for s, v in zip(samples, values, strict=True) if low * num <= s.num_done < high * num and v > 0]
        return round(float(np.median(part)), 1) if part else float("nan")

    return median(0.1, 0.2), median(0.9, 1.0), max(values, default=0.0)


def measure(data: Path, out: Path, num: int, workers: int, subset: int) -> ImportFigures:
    """Makes the copies, imports them, and compares."""
    source, library, log = out / "source", out / "library", out / "memory.jsonl"
    write_copies(data, source, num)
    files = sorted(source.rglob("*.glb"))
    if len(files) != num:
        raise RuntimeError(f"{source} has {len(files)} meshes, expected {num}; remove it")
    import_copies(source, library, workers, num, log=log)
    num_rows, num_failures = check_rows(library, (file.stem for file in files))
    some = files[:: max(1, num // subset)][:subset]
    alone = out / "subset"
    for path in (alone, out / "subset_library"):
        shutil.rmtree(path, ignore_errors=True)
    for file in some:
        (alone / file.parent.name).mkdir(parents=True, exist_ok=True)
        shutil.copy(file, alone / file.parent.name / file.name)
    import_copies(alone, out / "subset_library", workers, len(some))
    manifest = json.loads((library / "manifest.json").read_text("utf-8"))
    samples = _samples(log)
    cpu: dict[str, float] = {}
    for sample in samples:
        cpu |= sample.cpu_seconds
    gaps = np.diff([sample.seconds for sample in samples])
    largest = [max(s.worker_mb.values(), default=0.0) for s in samples]
    return ImportFigures(
        num,
        num_rows,
        num_failures,
        manifest["counts"]["copies"],
        round(60 * num / float(gaps[gaps < _STOPPED_SECONDS].sum()) / workers, 1),
        round(60 * num / max(sum(cpu.values()), 1e-9), 1),
        int((out / "killed").exists()),
        _tenths(samples, num, [s.driver_mb for s in samples]),
        _tenths(samples, num, largest),
        len(some),
        different_rows(library, out / "subset_library"),
    )


def main(
    data: Annotated[Path, typer.Argument(help="dataset in the MesaTask-10K format")],
    out: Annotated[Path | None, typer.Option(help="folder for the copies and the libraries; default: a temporary one")] = None,
    assets: Annotated[int, typer.Option(help="number of copies")] = 300,
    workers: Annotated[int, typer.Option(help="worker processes")] = 2,
    subset: Annotated[int, typer.Option(help="assets that are imported a second time, uninterrupted")] = 100,
    output: Annotated[Path | None, typer.Option("--json", help="file of the figures")] = None,
) -> None:
    """Measures the import of many assets."""
    with TemporaryDirectory() as folder:
        found = measure(data, out or Path(folder), assets, workers, subset)
    lines = [(name.replace("_", " "), str(value)) for name, value in asdict(found).items()]
    print(align_columns([("figure", "value"), *lines], 1))
    if output is not None:
        output.write_text(json.dumps(asdict(found), indent=2) + "\n", "utf-8")


if __name__ == "__main__":
    typer.run(main)
