"""Speed and memory of ``stable-data verify``: the rows of a run by processor time, and the verdicts that are computed again.

``python -m benchmarks.verify RUN [--scenes N --folder FOLDER] [--sample N] [--json FILE]``. RUN is verified without verdicts and with
those of a sample. With ``--scenes``, a run with as many scenes is made in FOLDER, of the rows of RUN under other ids, and verified in a
process of its own for each of two sizes: its memory must not grow with the run.
"""

import argparse
import json
import resource
import subprocess
import sys
import time
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path

import pyarrow as pa

from stable_data.content_id import content_id
from stable_data.storage.manifest import PLANNED, read_manifest, write_manifest
from stable_data.storage.run_folder import RunFolder
from stable_data.verification.verifier import Verdicts, VerifyOptions, verify_run

_SHARD_SCENES = 512
_OF_SCENES = ("scenes", "turns", "settled", "grasps")


@dataclass(frozen=True, slots=True)
class VerifyFigure:
    """The figures of a verification.

    Attributes:
        what: What was verified.
        num_scenes: Scenes of the run.
        num_rows: Rows of all tables.
        megabytes: Size of its files, MB.
        seconds: Processor time.
        scenes_per_second: Scenes divided by seconds; of verdicts, those that were judged again.
        megabytes_per_second: Megabytes divided by seconds.
        memory_mib: Largest memory of the process, MiB.
        is_whole: Whether the run was found whole.
    """

    what: str
    num_scenes: int
    num_rows: int
    megabytes: float
    seconds: float
    scenes_per_second: float
    megabytes_per_second: float
    memory_mib: float
    is_whole: bool


def measure(uri: str, what: str, verdicts: Verdicts = "none", sample: int = 20) -> VerifyFigure:
    """Verifies a run in this process and measures it.

    Args:
        uri: The run.
        what: Name of the measurement.
        verdicts: Which verdicts are computed again.
        sample: Of how many scenes; 0: of all.
    """
    folder, began = RunFolder(uri), time.process_time()
    found = verify_run(folder, lambda finding: print(finding, file=sys.stderr), VerifyOptions(sample, verdicts=verdicts))
    seconds = time.process_time() - began
    size = sum(stamp[1] for table in folder.tables() for stamp in folder.file_stamps(table)) / 1e6
    count = found.rows.get("scenes", 0) if verdicts == "none" else found.num_audited
    memory = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024
    return VerifyFigure(
        what,
        found.rows.get("scenes", 0),
        sum(found.rows.values()),
        round(size, 1),
        round(seconds, 2),
        round(count / seconds, 1),
        round(size / seconds, 1),
        round(memory),
        found.is_whole,
    )


def write_copies(source: RunFolder, target: RunFolder, num_scenes: int) -> None:
    """Writes a run with as many scenes: the scenes of another one and what belongs to them, again and again under other ids.

    Args:
        source: A run of generate.
        target: The folder, empty.
        num_scenes: The number of scenes, rounded up to whole shards.
    """
    for table in ("assets", "meshes", "textures"):
        if source.files(table):
            target.write_table(
                table, content_id(table), _once(source.table(table), "sha256" if table == "textures" else "asset_id")
            )
    tables = {table: source.table(table) for table in _OF_SCENES if source.files(table)}
    own = tables["scenes"].num_rows
    copies = -(-_SHARD_SCENES // own)
    done = number = 0
    while done < num_scenes:
        for table, rows in tables.items():
            parts = [_renamed(rows, f"_{number}_{copy}") for copy in range(copies)]
            target.write_table(table, content_id("copies", number), pa.concat_tables(parts))
        done, number = done + copies * own, number + 1
    manifest = {key: value for key, value in (read_manifest(source) or {}).items() if not key.startswith("num_")}
    counts = {table: target.num_rows(table) for table in target.tables()}
    write_manifest(target, manifest | {"counts": counts, PLANNED: []})


def _renamed(rows: pa.Table, suffix: str) -> pa.Table:
    ids = pa.array([f"{name}{suffix}" for name in rows["scene_id"].to_pylist()], pa.string())
    return rows.set_column(rows.schema.get_field_index("scene_id"), rows.schema.field("scene_id"), ids)


def _once(rows: pa.Table, key: str) -> pa.Table:
    """Rows without those whose key an earlier row has."""
    first = {name: number for number, name in reversed(list(enumerate(rows[key].to_pylist())))}
    return rows.take(sorted(first.values()))


def _in_own_process(uri: str, what: str) -> VerifyFigure:
    code = (
        "import json; from dataclasses import asdict; from benchmarks.verify import measure; "
        f"print(json.dumps(asdict(measure({uri!r}, {what!r}))))"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    return VerifyFigure(**json.loads(done.stdout.splitlines()[-1]))


def main(arguments: Sequence[str] | None = None) -> list[VerifyFigure]:
    """Measures, prints and returns the figures."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("run", help="a run of generate")
    parser.add_argument("--scenes", type=int, default=0, help="scenes of the larger of two copies; 0: none is made")
    parser.add_argument("--folder", type=Path, help="folder for the copies")
    parser.add_argument("--sample", type=int, default=20, help="scenes whose verdicts are computed again; 0: all")
    parser.add_argument("--json", type=Path, help="output file")
    options = parser.parse_args(arguments)
    figures = [
        measure(options.run, "without verdicts"),
        measure(options.run, "with verdicts by audit", "audit", options.sample),
        measure(options.run, "with all verdicts", "all", options.sample),
    ]
    if options.scenes:
        if options.folder is None:
            parser.error("--scenes needs --folder")
        for count in (options.scenes // 10, options.scenes):
            target = RunFolder(str(options.folder / str(count)))
            write_copies(RunFolder(options.run), target, count)
            figures.append(_in_own_process(target.uri, f"copies, {count} scenes"))
    for figure in figures:
        print(figure)
    if options.json is not None:
        options.json.write_text(json.dumps([asdict(figure) for figure in figures], indent=2) + "\n", "utf-8")
    return figures


if __name__ == "__main__":
    main()
