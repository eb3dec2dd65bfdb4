"""Whether a process that makes the same scenes again and again keeps more each time, or gets slower.

``python -m benchmarks.same_shard [LIBRARY ...] [--scenes 32] [--passes 40] [--warm-up 8] [--seed S] [--json FILE] [--set KEY=VALUE ...]``.
One process makes one shard of ``generate`` in every pass, as a worker does: sampled tasks, the embedded reasoner, the real and the embedded
assets unless libraries are named.

A worker of a long run meets new assets, shapes and words all the time, and its caches fill for thousands of scenes. ``benchmarks.soak``
therefore cannot tell a cache that fills from memory that is lost. Here nothing is new after the first pass: whatever still grows is lost,
or is kept without use.

Two quantities are judged by the criterion of ``benchmarks.soak``, without the first passes: the memory that the process has when a pass
begins, and the seconds of the processor that a pass takes. The files of all passes must be the same, byte for byte, save those of the
timing.

Status 0: both are flat or fall, and all passes gave the same files, with accepted scenes. 1: not so. 2: the benchmark could not start.
130: Ctrl-C.
"""

import argparse
import json
import sys
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

from benchmarks.chaos import status_of
from benchmarks.soak import LIBRARIES, MOST_MB, FinishedShard, Trend, print_trends, trend
from pipelines.execution.ray_executor import WorkerPool
from pipelines.execution.shard_step import ShardTask, ShardWriter
from pipelines.generate.job import GenerateJob
from pipelines.generate.settings import GenerateSettings
from pipelines.generate.shard import TIMING_FOLDER
from pipelines.settings import resolve_settings
from pipelines.sources.generation_tasks import sample_tasks
from stable_data.commands.command_line import DONE
from stable_data.storage.run_folder import RunFolder

MEMORY, TIME = "memory that the process keeps, MB", "processor seconds a scene"


@dataclass(frozen=True, slots=True)
class Pass:
    """What one pass tells.

    Attributes:
        kept_mb: Memory that the process had when the pass began, MB; None if the system does not tell.
        seconds: Seconds of the processor that the pass took.
        accepted: Rows of the table ``scenes``.
        files: SHA-256 of each file of the tables.
    """

    kept_mb: float | None
    seconds: float
    accepted: int
    files: dict[str, str]


def make_passes(job: GenerateJob, count: int) -> list[Pass]:
    """Makes the first shard of a job several times in this process, and prints a line for each.

    Raises:
        ConfigError: The job cannot start.
    """
    job.check_workers(WorkerPool())
    step = job.plan()[0]
    shard, found = ShardTask(0, step.shards[0]), list[Pass]()
    for number in range(count):
        with TemporaryDirectory() as folder:
            written = ShardWriter(folder, (step.step,))(shard)
            run = RunFolder(folder)
            told = FinishedShard.of_run(run, shard.shard.shard_id)
            files = {name: checksum for name, checksum in written.checksums.items() if not name.startswith(TIMING_FOLDER)}
            found.append(Pass(told.kept_mb, told.seconds, run.num_rows("scenes"), files))
        kept = "unknown" if told.kept_mb is None else f"{told.kept_mb:,.1f} MB"
        print(f"pass {number}: {kept} at its begin, {found[-1].seconds:.1f} s, {found[-1].accepted} scenes", flush=True)
    return found


def trends_of(passes: Sequence[Pass], scenes: int, warm_up: int) -> list[Trend]:
    """The trends of the memory and of the time, without the first passes.

    Args:
        passes: All passes.
        scenes: Scenes of a pass.
        warm_up: Number of passes that are left out.
    """
    kept, total = list(enumerate(passes))[warm_up:], scenes * len(passes)
    return [
        trend(MEMORY, [(0, float(k * scenes), one.kept_mb) for k, one in kept], total, MOST_MB),
        trend(TIME, [(0, float(k * scenes), one.seconds / scenes) for k, one in kept], total),
    ]


def is_steady(passes: Sequence[Pass], found: Sequence[Trend]) -> bool:
    """Whether nothing grows or is unknown, and all passes gave the same files, with accepted scenes."""
    is_same = passes[0].accepted > 0 and all(one.files == passes[0].files for one in passes)
    return is_same and all(one.verdict in ("flat", "falls") for one in found)


def run_campaign() -> int:
    """Prints the figures; returns the status that the text of the module tells.

    Raises:
        ConfigError: The benchmark cannot start.
    """
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("libraries", nargs="*", default=LIBRARIES, metavar="LIBRARY", help="as --assets of generate")
    parser.add_argument("--scenes", type=int, default=32, help="scenes of a pass")
    parser.add_argument("--passes", type=int, default=40)
    parser.add_argument("--warm-up", type=int, default=8, help="first passes that are left out")
    parser.add_argument("--seed", type=int, default=0, help="of the tasks")
    parser.add_argument("--set", action="append", default=[], metavar="KEY=VALUE", help="a setting of generate")
    parser.add_argument("--json", type=Path, help="output file of the figures")
    arguments = parser.parse_args()
    own = ["num_pictures=0", *arguments.set, f"scenes_per_shard={arguments.scenes}"]
    settings = resolve_settings(GenerateSettings, "generate", None, own)
    job = GenerateJob(sample_tasks(arguments.scenes, arguments.seed), settings, tuple(arguments.libraries))
    passes = make_passes(job, arguments.passes)
    found = trends_of(passes, arguments.scenes, arguments.warm_up)
    print_trends(found)
    same = sum(one.files == passes[0].files for one in passes)
    print(f"{same} of {len(passes)} passes gave the files of the first one")
    if arguments.json:
        figures: dict[str, Any] = {"command": sys.argv[1:], "trends": [asdict(one) for one in found]}
        figures["passes"] = [{"kept_mb": p.kept_mb, "seconds": p.seconds, "accepted": p.accepted} for p in passes]
        arguments.json.write_text(json.dumps(figures | {"same": same}) + "\n", "utf-8")
    return DONE if is_steady(passes, found) else 1


if __name__ == "__main__":
    raise SystemExit(status_of(run_campaign))
