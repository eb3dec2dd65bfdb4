"""Does it pay to correct scenes, to have many of them, and to have real meshes? Success of policies that were trained in them.

``python -m benchmarks.policy DATA --out WORK [--scenes 10 100 1000] [--demonstrations 1000] [--seeds 5] [--tests 60]
[--robot panda] [--json FILE]``

DATA is a dataset in the MesaTask-10K format with real meshes: its scenes, corrected, are the test, and no training sees them or
their assets. A seed stands for training scenes, demonstrations and weights of its own:

1. tasks are sampled, and laid out four times: by the reasoner alone, or corrected (clean and at rest); with parametric meshes
   (the embedded world), or with real meshes first (``--assets real``);
2. in the first 10, 100, 1,000 scenes of each, the expert records picks, as many in all, which are drawn evenly from the scenes;
3. a policy is trained on the successful ones, the same number for each cell, and picks up objects in the test scenes.

Everything is kept in WORK; the same command continues after a stop, and a later one with more seeds adds them. Each cell is printed
when it is there; then the table, and the effects: differences of cells that differ in one respect only, by seed, with their mean
and a 95 % interval over the seeds (Student's t). At full size a seed takes about 16 hours of two cores; a tenth of the
demonstrations, in at most as many scenes, takes a tenth of it.
"""

import argparse
import csv
import json
import math
import os
import subprocess
import sys
import time
from collections.abc import Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import asdict, dataclass, fields
from itertools import pairwise, product
from pathlib import Path
from statistics import mean, stdev
from typing import Any, TypeVar

import numpy as np
from scipy.stats import t as student

from benchmarks.text_table import align_columns
from stable_data.atomic_files import write_file_atomically
from stable_data.cli import DONE, SOME_FAILED
from stable_data.robot.acting.success_rate import wilson_interval
from stable_data.storage.run_folder import RunFolder

LAYOUTS = {
    "left": ("--set", "corrects=never", "--set", "accept="),
    "corrected": (),
}
"""What becomes of the reasoner's layouts: they are left as they are, or corrected; with the options of generate."""

MESHES = {
    "parametric": ("--assets", "embedded"),
    "real": ("--assets", "real", "--assets", "embedded"),
}
"""Where the assets come from, with the options of generate."""

_SPARE = 1.3  # episodes for a wanted demonstration, because some fail or are too long
_SPARE_SCENES = 1.1  # scenes that are asked for, because some are rejected
_MAX_STEPS = 200  # of an episode of the policy
_NOISE = 0.05  # of the demonstrations, see demonstrate.noise
_ONE_CORE = {"OMP_NUM_THREADS": "1", "IGL_NUM_THREADS": "1"}


@dataclass(frozen=True, slots=True, order=True)
class Cell:
    """What a policy was trained on.

    Attributes:
        seed: Number of the repetition.
        layouts: A key of :data:`LAYOUTS`.
        meshes: A key of :data:`MESHES`.
        scenes: Scenes that the demonstrations are from.
    """

    seed: int
    layouts: str
    meshes: str
    scenes: int


@dataclass(frozen=True, slots=True)
class Result:
    """What came out of a cell.

    Attributes:
        demonstrations: That were trained on.
        recorded: Episodes of the expert that began.
        expert: Share of them that fulfil their goal.
        successes: Episodes of the policy that fulfil their goal.
        attempts: Episodes of the policy that began.
        seconds: Wall time of the demonstrations, the training and the evaluation.
    """

    demonstrations: int
    recorded: int
    expert: float
    successes: int
    attempts: int
    seconds: float

    @property
    def rate(self) -> float:
        """Share of the attempts that succeed."""
        return self.successes / self.attempts


_Kind = TypeVar("_Kind", Cell, Result)


class Experiment:
    """The experiment, in a folder of its own.

    Args:
        data: Dataset of the test scenes.
        work: Folder of everything that is made.
        options: The arguments of the command line.
    """

    def __init__(self, data: Path, work: Path, options: argparse.Namespace) -> None:
        self._data, self._work, self._options = data, work, options
        self._file = work / "results.csv"
        self.results: dict[Cell, Result] = {}
        if self._file.exists():
            with self._file.open(newline="", encoding="utf-8") as stream:
                rows = list(csv.DictReader(stream))
            self.results = {_read(Cell, row): _read(Result, row) for row in rows}

    def run(self, seeds: Sequence[int]) -> Iterator[tuple[Cell, Result]]:
        """Yields the results of all cells of some seeds, those that are there already too."""
        if set(self._cells(seeds)) <= set(self.results):
            yield from ((cell, self.results[cell]) for cell in self._cells(seeds))
            return
        tests = self._tests()
        for seed in seeds:
            cells = list(self._cells([seed]))
            if not set(cells) <= set(self.results):
                for layouts, meshes in product(LAYOUTS, MESHES):
                    self._lay_out(seed, layouts, meshes)
                recorded = {cell: self._demonstrate(cell) for cell in cells if cell not in self.results}
                with ThreadPoolExecutor(os.cpu_count()) as pool:
                    found = pool.map(lambda cell: self._train_and_test(cell, tests), recorded)
                    for cell, result in zip(recorded, found, strict=True):
                        self._keep(cell, recorded[cell] | result | {"seconds": recorded[cell]["seconds"] + result["seconds"]})
            yield from ((cell, self.results[cell]) for cell in cells)

    def _cells(self, seeds: Sequence[int]) -> Iterator[Cell]:
        for seed in seeds:
            for layouts, meshes, scenes in product(LAYOUTS, MESHES, sorted(self._options.scenes)):
                yield Cell(seed, layouts, meshes, scenes)

    def _tests(self) -> str:
        """Makes the test scenes; returns the condition that chooses them."""
        source, run = self._work / "source", self._work / "test"
        _command("preprocess", "--data", str(self._data), "--out", str(source), "--set", "num_pictures=0")
        _command("correct", "--scenes", str(source), "--out", str(run), *_set("settle=true", "judges=mujoco", "num_pictures=0"))
        rows = _rows(run, "scenes", ["scene_id", "clean", "stable"])
        return _among(
            sorted(_shuffled([row["scene_id"] for row in rows if row["clean"] and row["stable"]], 0)[: self._options.tests])
        )

    def _pool(self, seed: int, layouts: str, meshes: str) -> Path:
        return self._work / f"seed_{seed}" / f"{layouts}_{meshes}"

    def _lay_out(self, seed: int, layouts: str, meshes: str) -> None:
        words = [*LAYOUTS[layouts], *MESHES[meshes], "--count", str(math.ceil(_SPARE_SCENES * max(self._options.scenes)))]
        out = self._pool(seed, layouts, meshes) / "scenes"
        _command("generate", *words, "--seed", str(1000 + seed), "--out", str(out), "--set", "num_pictures=0")

    def _demonstrate(self, cell: Cell) -> dict[str, Any]:
        """Records the demonstrations of a cell; returns what is known of them."""
        began = time.perf_counter()
        pool = self._pool(cell.seed, cell.layouts, cell.meshes)
        names = _shuffled([row["scene_id"] for row in _rows(pool / "scenes", "scenes", ["scene_id"])], cell.seed)
        chosen = names[: cell.scenes]  # the smaller sets are parts of the larger ones
        if len(chosen) < cell.scenes:
            raise SystemExit(f"{pool / 'scenes'} has {len(chosen)} scenes, expected {cell.scenes}; its table failures says why")
        episodes = math.ceil(_SPARE * self._options.demonstrations / cell.scenes)
        out = pool / f"demonstrations_{cell.scenes}"
        words = ["--scenes", str(pool / "scenes"), "--out", str(out), "--where", _among(chosen), "--robot", self._options.robot]
        sets = ("task=pick", f"episodes={episodes}", f"noise={_NOISE}", f"seed={cell.seed}", "num_pictures=0")
        _command("demonstrate", *words, *_set(*sets))
        counts = _manifest(out)["counts"]
        return {
            "recorded": counts["episodes"],
            "expert": counts["successes"] / max(1, counts["episodes"]),
            "seconds": time.perf_counter() - began,
        }

    def _train_and_test(self, cell: Cell, tests: str) -> dict[str, Any]:
        """Trains a policy and lets it act, in one process each; returns what is known of it."""
        began = time.perf_counter()
        pool = self._pool(cell.seed, cell.layouts, cell.meshes)
        policy, out = pool / f"policy_{cell.scenes}", pool / f"result_{cell.scenes}"
        words = ["--episodes", str(pool / f"demonstrations_{cell.scenes}"), "--out", str(policy)]
        train = (f"max_episodes={self._options.demonstrations}", f"seed={cell.seed}", "held_out=0")
        _command("train-policy", *words, *_set(*train))
        words = ["--policy", str(policy), "--scenes", str(self._work / "test"), "--where", tests, "--out", str(out)]
        sets = ("task=pick", f"max_steps={_MAX_STEPS}", f"seed={cell.seed}", "num_pictures=0")
        _command("evaluate-policy", *words, *_set(*sets), "--workers", "0")
        counts = _manifest(out)["counts"]
        return {
            "demonstrations": _manifest(policy)["num_episodes"],
            "successes": counts["successes"],
            "attempts": counts["attempts"],
            "seconds": time.perf_counter() - began,
        }

    def _keep(self, cell: Cell, values: Mapping[str, Any]) -> None:
        self.results[cell] = Result(**{f.name: values[f.name] for f in fields(Result)})
        rows = [asdict(one) | asdict(result) for one, result in sorted(self.results.items())]
        lines = [",".join(rows[0]), *(",".join(str(value) for value in row.values()) for row in rows)]
        write_file_atomically(self._file, "\n".join(lines).encode() + b"\n")


def _command(*words: str) -> None:
    """Runs a command of the toolkit; its status must be 0 or 1."""
    done = subprocess.run(
        [sys.executable, "-m", "pipelines", *words], env=os.environ | _ONE_CORE, capture_output=True, text=True, check=False
    )
    if done.returncode not in (DONE, SOME_FAILED):
        raise SystemExit(f"python -m pipelines {' '.join(words)[:300]}\n{done.stderr.strip()[-2000:]}")


def _set(*settings: str) -> list[str]:
    return [word for setting in settings for word in ("--set", setting)]


def _shuffled(names: Sequence[str], seed: int) -> list[str]:
    return [str(name) for name in np.random.default_rng(seed).permutation(sorted(names))]


def _among(names: Sequence[str]) -> str:
    """The condition that chooses some scenes."""
    return f"scene_id in {list(names)!r}"


def _manifest(folder: Path) -> dict[str, Any]:
    found: dict[str, Any] = json.loads((folder / "manifest.json").read_text("utf-8"))
    return found


def _rows(run: Path, table: str, columns: Sequence[str]) -> list[dict[str, Any]]:
    found: list[dict[str, Any]] = RunFolder(str(run)).table(table, list(columns)).to_pylist()
    return found


def _read(kind: type[_Kind], row: Mapping[str, str]) -> _Kind:
    types: dict[str, Any] = {f.name: f.type for f in fields(kind)}
    return kind(**{name: of(row[name]) for name, of in types.items()})


def mean_interval(values: Sequence[float]) -> tuple[float, float, float]:
    """Returns the mean of repetitions and its 95 % interval (Student's t); infinitely wide for fewer than two."""
    centre = mean(values)
    if len(values) < 2:
        return centre, -math.inf, math.inf
    half = float(student.ppf(0.975, len(values) - 1)) * stdev(values) / math.sqrt(len(values))
    return centre, centre - half, centre + half


def effects(results: Mapping[Cell, Result]) -> dict[str, list[float]]:
    """Returns differences of success rates, for each seed the mean over all pairs of cells that differ in this respect only.

    Args:
        results: The results; every seed has all cells.
    """
    found: dict[str, list[float]] = {}
    counts = sorted({cell.scenes for cell in results})
    for seed in sorted({cell.seed for cell in results}):
        rates = {(c.layouts, c.meshes, c.scenes): r.rate for c, r in results.items() if c.seed == seed}
        pairs = {
            "corrected - left": [rates["corrected", m, n] - rates["left", m, n] for m in MESHES for n in counts],
            "real - parametric": [rates[k, "real", n] - rates[k, "parametric", n] for k in LAYOUTS for n in counts],
        }
        for few, many in pairwise(counts):
            pairs[f"{many} - {few} scenes"] = [rates[k, m, many] - rates[k, m, few] for k in LAYOUTS for m in MESHES]
        for name, differences in pairs.items():
            found.setdefault(name, []).append(mean(differences))
    return found


def show(results: Mapping[Cell, Result]) -> Iterator[str]:
    """Yields the lines of the tables: a cell over its seeds, then the effects."""
    rows = [
        ("layouts", "meshes", "scenes", "seeds", "demonstrations", "expert %", "success %", "95 % over seeds", "of", "minutes")
    ]
    for layouts, meshes, scenes in product(LAYOUTS, MESHES, sorted({cell.scenes for cell in results})):
        here = [r for c, r in results.items() if (c.layouts, c.meshes, c.scenes) == (layouts, meshes, scenes)]
        rates = [100 * r.rate for r in here]
        rows.append(
            (
                layouts,
                meshes,
                str(scenes),
                str(len(here)),
                f"{mean(r.demonstrations for r in here):.0f}",
                f"{100 * mean(r.expert for r in here):.0f}",
                f"{mean(rates):.1f}",
                _interval(rates),
                str(sum(r.attempts for r in here)),
                f"{sum(r.seconds for r in here) / 60:.1f}",
            )
        )
    yield align_columns(rows, 2)
    yield ""
    differences = {name: [100 * value for value in values] for name, values in effects(results).items()}
    head = ("difference of success, percentage points", "mean", "95 % over seeds")
    yield align_columns([head, *((name, f"{mean(v):+.1f}", _interval(v)) for name, v in differences.items())], 1)


def _interval(values: Sequence[float]) -> str:
    _, low, high = mean_interval(values)
    return "unknown" if math.isinf(low) else f"{low:+.1f} to {high:+.1f}"


def main() -> None:
    """Runs the benchmark."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("data", type=Path, help="dataset in the MesaTask-10K format with real meshes, for the test")
    parser.add_argument("--out", type=Path, required=True, help="folder of the runs; the same command continues there")
    parser.add_argument("--scenes", type=int, nargs="+", default=[10, 100, 1000], help="numbers of training scenes")
    parser.add_argument("--demonstrations", type=int, default=1000, help="demonstrations of each training")
    parser.add_argument("--seeds", type=int, default=5, help="repetitions")
    parser.add_argument("--tests", type=int, default=60, help="test scenes, one episode each")
    parser.add_argument("--robot", default="panda", help="the robot; stable-data robots")
    parser.add_argument("--json", type=Path, help="file of the figures")
    options = parser.parse_args()
    if options.demonstrations < max(options.scenes):
        parser.error(f"--demonstrations is {options.demonstrations}, expected at least the {max(options.scenes)} scenes")
    experiment, found = Experiment(options.data, options.out, options), dict[Cell, Result]()
    for cell, result in experiment.run(range(options.seeds)):
        found[cell] = result
        low, high = wilson_interval(result.successes, result.attempts)
        print(
            f"seed {cell.seed}, {cell.layouts}, {cell.meshes}, {cell.scenes} scenes: {result.successes} of {result.attempts} "
            f"({low:.0%} to {high:.0%}) after {result.demonstrations} demonstrations",
            flush=True,
        )
    print("\n".join(show(found)))
    if options.json is not None:
        rows = [asdict(cell) | asdict(result) for cell, result in found.items()]
        options.json.write_text(json.dumps({"cells": rows, "effects": effects(found)}, indent=2) + "\n", "utf-8")


if __name__ == "__main__":
    main()
