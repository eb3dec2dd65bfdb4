"""The gain of the alternation of reasoner and corrector: the same tasks by Algorithm 1, corrected once at the end, never, or in one reply.

``python -m benchmarks.alternation RUN [--where "split == 'test'"] [--scenes 200] [--workers 2] [--weights auto] [--json
FILE]``: RUN is a run with tasks. Every generated scene counts, accepted or not.

- OC, float, out: exact figures of the finished scenes. AwT, AwS: objects and relations that the instruction requires.
- rest: share of scenes that stay at rest in MuJoCo. moved: movement by the corrections, mean over the objects of a scene.
"""

import argparse
import json
import tempfile
from collections import Counter
from collections.abc import Iterable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import polars as pl

from pipelines.execution.ray_executor import WorkerPool
from pipelines.generate.job import generate
from pipelines.generate.settings import GenerateSettings
from pipelines.sources.generation_tasks import TaskSource, tasks_of_scenes
from stable_data.storage.run_folder import RunFolder

_MEASURES = ("clean", "oc", "float_rate", "out_of_bounds_rate", "stable", "awt", "aws", "num_objects", "move_mean_mm")
_HEAD = ("clean %", "OC %", "float %", "out %", "rest %", "AwT %", "AwS %", "objects", "moved mm")
_VERDICTS = frozenset({"clean", "stable"})
_COUNTS = frozenset({"num_objects", "num_stacked", "num_contained", "move_mean_mm"})


def variants(weights: str) -> dict[str, GenerateSettings]:
    """Returns the settings of each variant."""
    turns = GenerateSettings(weights=weights, accept="", num_pictures=0)
    return {
        "in turns": turns,
        "at the end": replace(turns, corrects="end"),
        "never": replace(turns, corrects="never", weights="none"),
        "at once, then corrected": replace(turns, schedule="whole"),
        "at once, never corrected": replace(turns, schedule="whole", corrects="never", weights="none"),
    }


def figures_of(folder: RunFolder, num_tasks: int, measures: Sequence[str] = _MEASURES) -> dict[str, Any]:
    """Returns means over a run's scenes, None if nothing is known. A scene with an unknown verdict counts as not passed."""
    frame = pl.from_arrow(folder.table("scenes", measures))
    assert isinstance(frame, pl.DataFrame)
    warnings = Counter(folder.table("warnings", ["code"])["code"].to_pylist())
    judged = frame.with_columns(pl.col(name).fill_null(value=False) for name in measures if name in _VERDICTS)
    means = judged.select(pl.col(measures).cast(pl.Float64).mean()).row(0, named=True)
    return {
        "tasks": num_tasks,
        "made": frame.height,
        "with_relations": int(frame["aws"].is_not_null().sum()),
        "dropped": warnings["dropped"],
        **{name: None if mean is None else mean * (1 if name in _COUNTS else 100) for name, mean in means.items()},
    }


def measure(tasks: TaskSource, workers: WorkerPool, weights: str) -> dict[str, Any]:
    """Measures the figures of every variant."""
    found = {}
    for name, settings in variants(weights).items():
        with tempfile.TemporaryDirectory(prefix="stable-data-") as out:
            generate(tasks, out, settings, workers, report=False)
            found[name] = figures_of(RunFolder(out), len(tasks.tasks))
    return found


def show(found: dict[str, Any]) -> Iterable[str]:
    """Yields the lines of a table of the figures."""
    yield f"{'':26}{'made':>10}" + "".join(f"{head:>10}" for head in _HEAD) + f"{'left out':>10}"
    for name, one in found.items():
        values = ("unknown" if one[key] is None else f"{one[key]:.1f}" for key in _MEASURES)
        yield f"{name:26}{one['made']:>5}/{one['tasks']:<4}" + "".join(f"{v:>10}" for v in values) + f"{one['dropped']:>10}"
    counts = ", ".join(str(one["with_relations"]) for one in found.values())
    yield f"scenes whose instructions give relations, for AwS: {counts}"


def main() -> None:
    """Prints the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("run", help="a run with scenes that have tasks")
    parser.add_argument("--where", default="split == 'test'", help="filter of the scenes")
    parser.add_argument("--scenes", type=int, default=200)
    parser.add_argument("--workers", type=int, default=2)
    parser.add_argument("--weights", default="auto", help="weights of the corrector")
    parser.add_argument("--json", type=Path)
    arguments = parser.parse_args()
    tasks = tasks_of_scenes(arguments.run, arguments.where)
    few = replace(tasks, tasks=tasks.tasks[: arguments.scenes])
    found = measure(few, WorkerPool(arguments.workers), arguments.weights)
    print("\n".join(show(found)))
    if arguments.json:
        arguments.json.write_text(json.dumps(found, indent=2) + "\n", "utf-8")


if __name__ == "__main__":
    main()
