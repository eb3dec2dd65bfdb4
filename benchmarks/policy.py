"""Does it pay to correct scenes, to have many of them, and to have real meshes? Success of policies that were trained in them.

``python -m benchmarks.policy DATA --out WORK [--scenes 10 100 1000] [--demonstrations 1000] [--seeds 5] [--tests 60]
[--robot panda] [--json FILE]``

DATA is a dataset in the MesaTask-10K format with real meshes. Its scenes, corrected, are the test: in each one pick, of an asset that
no training can have. The other half of its assets is the library of real meshes. A seed stands for training scenes, demonstrations and
weights of its own:

1. tasks are sampled, and laid out four times: by the reasoner alone (uncorrected), or corrected (clean and at rest); with
   parametric meshes (the embedded world), or with real ones first;
2. in 10, 100, 1,000 scenes of each, the same tasks in all four, the expert records picks, as many in all;
3. a policy is trained on the successful ones, the same number for all cells of a seed, as evenly from the scenes as can be, and picks
   up objects in the test scenes. With N demonstrations, each is from a scene of its own where there are N scenes.

The test scenes are clean and at rest, as corrected ones are; tasks that could not be laid out in one of the four ways are left out of all.
Everything is kept in WORK; the same command continues after a stop, and a later one with more seeds adds them. Each cell is printed
when it is there; then the table, and the effects: differences of cells that differ in one respect only, by seed, with their mean
and a 95 % interval over the seeds (Student's t). It tells of other training scenes, not of other test scenes, which are the same for
all seeds.
"""

import argparse
import csv
import json
import math
import os
import subprocess
import sys
from collections.abc import Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import asdict, dataclass, fields
from functools import partial
from itertools import pairwise, product
from pathlib import Path
from statistics import mean
from typing import Any, TypeVar

import numpy as np

from pipelines.evaluate_policy.job import UNSEEN
from pipelines.reports.text_table import align_columns
from stable_data.atomic_files import write_file_atomically
from stable_data.commands.command_line import DONE, SOME_FAILED
from stable_data.mesatask.asset_catalog import library_of_folder
from stable_data.mesatask.library import ANNOTATION_FILE, LIBRARY_FOLDER
from stable_data.scores.intervals import mean_interval, wilson_interval
from stable_data.storage.run_folder import RunFolder

LAYOUTS = {
    "uncorrected": ("--set", "corrects=never", "--set", "accept="),
    "corrected": (),
}
"""What becomes of the reasoner's layouts: nothing, or they are corrected; with the options of generate."""

MESHES = ("parametric", "real")
"""Where the assets come from: the embedded world alone, or before it half of the assets of DATA."""

_SPARE = 1.3  # episodes for a wanted demonstration, because some fail or are too long
_SPARE_SCENES = 1.1  # scenes that are asked for, because some are rejected
_TESTED = ("task=pick", "max_steps=200", "num_pictures=0")  # settings of the tests, the same picks for every policy
_LONGEST = 150  # demonstration that is trained on, actions
_NOISE = 0.05  # of the demonstrations, see demonstrate.noise
_ONE_CORE = {"OMP_NUM_THREADS": "1", "IGL_NUM_THREADS": "1"}


@dataclass(frozen=True, slots=True, order=True)
class Cell:
    """What a policy was trained on.

    Attributes:
        seed: Number of the repetition.
        layouts: A key of :data:`LAYOUTS`.
        meshes: One of :data:`MESHES`.
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
        used_scenes: Scenes that these are from.
        recorded: Episodes of the expert that began.
        expert: Share of them that fulfil their goal.
        successes: Episodes of the policy that fulfil their goal.
        attempts: Episodes of the policy that began.
    """

    demonstrations: int
    used_scenes: int
    recorded: int
    expert: float
    successes: int
    attempts: int

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
        if not (data / ANNOTATION_FILE).is_file():
            raise SystemExit(f"{data}: has no {ANNOTATION_FILE}, expected a dataset in the MesaTask-10K format")
        self._refuse_other_options()
        self.results: dict[Cell, Result] = {}
        if self._file.exists():
            with self._file.open(newline="", encoding="utf-8") as stream:
                rows = list(csv.DictReader(stream))
            self.results = {_read(Cell, row): _read(Result, row) for row in rows}

    def _refuse_other_options(self) -> None:
        """Refuses to add to results of other options; the number of seeds may grow."""
        shaping = {name: getattr(self._options, name) for name in ("demonstrations", "tests", "robot")} | {
            "data": str(self._data.resolve()),
            "scenes": sorted(self._options.scenes),
        }
        file = self._work / "options.json"
        if not file.exists():
            self._work.mkdir(parents=True, exist_ok=True)
            file.write_text(json.dumps(shaping, indent=2) + "\n", "utf-8")
        elif (was := json.loads(file.read_text("utf-8"))) != shaping:
            raise SystemExit(f"{self._work} is of other options, {json.dumps(was)}; choose another folder")

    def run(self, seeds: Sequence[int]) -> Iterator[tuple[Cell, Result]]:
        """Yields the results of all cells of some seeds, those that are there already too."""
        if set(self._cells(seeds)) <= set(self.results):
            yield from ((cell, self.results[cell]) for cell in self._cells(seeds))
            return
        tests = self._tests(self._library())
        for seed in seeds:
            cells = list(self._cells([seed]))
            if not set(cells) <= set(self.results):
                for layouts, meshes in product(LAYOUTS, MESHES):
                    self._lay_out(seed, layouts, meshes)
                names = self.common_scenes(seed)
                recorded = {cell: self._demonstrate(cell, names[: cell.scenes]) for cell in cells}
                count = min(self._options.demonstrations, *(values["usable"] for values in recorded.values()))
                if not count:  # max_episodes=0 would mean all
                    raise SystemExit(f"a cell of seed {seed} has no demonstration to train on, expected some: {recorded}")
                left = [cell for cell in cells if cell not in self.results]
                with ThreadPoolExecutor(os.cpu_count()) as pool:
                    for cell, result in zip(left, pool.map(partial(self._train_and_test, count, tests), left), strict=True):
                        self._keep(cell, recorded[cell] | result)
            yield from ((cell, self.results[cell]) for cell in cells)

    def _cells(self, seeds: Sequence[int]) -> Iterator[Cell]:
        for seed in seeds:
            for layouts, meshes, scenes in product(LAYOUTS, MESHES, sorted(self._options.scenes)):
                yield Cell(seed, layouts, meshes, scenes)

    def _library(self) -> frozenset[str]:
        """Makes the library of real meshes, half of the assets of DATA; returns their ids."""
        folder = self._work / "library"
        annotation = json.loads((self._data / ANNOTATION_FILE).read_text("utf-8"))
        names = _shuffled(list(annotation), 0)
        content = json.dumps({name: annotation[name] for name in sorted(names[: len(names) // 2])}, indent=1) + "\n"
        folder.mkdir(parents=True, exist_ok=True)
        (folder / ANNOTATION_FILE).write_text(content, "utf-8")
        meshes = folder / LIBRARY_FOLDER
        if not meshes.exists():
            meshes.symlink_to((self._data / LIBRARY_FOLDER).resolve())
        return frozenset(asset.asset_id for asset in library_of_folder(folder).assets)

    def _tests(self, library: frozenset[str]) -> str:
        """Makes the test scenes, and lets the expert act in them; returns the condition that chooses those with picks of new assets.

        Args:
            library: Assets that a training can have.
        """
        source, run, expert = (self._work / name for name in ("source", "test", "expert"))
        _command("preprocess", "--data", str(self._data), "--out", str(source), "--set", "num_pictures=0")
        _command("correct", "--scenes", str(source), "--out", str(run), *_set("settle=true", "judges=mujoco", "num_pictures=0"))
        words = ("--policy", "expert", "--scenes", str(run), "--where", "clean and stable", "--out", str(expert))
        _command("evaluate-policy", *words, *_set(*_TESTED, f"robot={self._options.robot}"))
        rows = _rows(expert, "episodes", ["scene_id", "success", "instances", "asset_ids", "subjects"])
        new = [
            row for row in rows if not {row["asset_ids"][row["instances"].index(name)] for name in row["subjects"]} & library
        ]
        chosen = set(_shuffled([row["scene_id"] for row in new], 0)[: self._options.tests])
        successes = sum(row["success"] for row in new if row["scene_id"] in chosen)
        print(
            f"tests: picks in {len(chosen)} scenes, of assets that no training has; {len(rows) - len(new)} others are of the library. The "
            f"expert succeeds in {successes}",
            flush=True,
        )
        return _among(sorted(chosen))

    def common_scenes(self, seed: int) -> list[str]:
        """Scenes whose tasks were laid out in all four ways, in an order by the seed: the smaller sets are parts of the larger ones."""
        pools = [self.pool(seed, layouts, meshes) for layouts, meshes in product(LAYOUTS, MESHES)]
        found = set.intersection(
            *({row["scene_id"] for row in _rows(pool / "scenes", "scenes", ["scene_id"])} for pool in pools)
        )
        if len(found) < max(self._options.scenes):
            raise SystemExit(
                f"{len(found)} tasks of seed {seed} were laid out in all four ways, expected {max(self._options.scenes)}"
            )
        return _shuffled(list(found), seed)

    def pool(self, seed: int, layouts: str, meshes: str) -> Path:
        """The folder of the scenes of one kind."""
        return self._work / f"seed_{seed}" / f"{layouts}_{meshes}"

    def _lay_out(self, seed: int, layouts: str, meshes: str) -> None:
        assets = (
            ["--assets", "embedded"]
            if meshes == "parametric"
            else ["--assets", str(self._work / "library"), "--assets", "embedded"]
        )
        words = [*LAYOUTS[layouts], *assets, "--count", str(math.ceil(_SPARE_SCENES * max(self._options.scenes)))]
        out = self.pool(seed, layouts, meshes) / "scenes"
        _command("generate", *words, "--seed", str(1000 + seed), "--out", str(out), "--set", "num_pictures=0")

    def _demonstrate(self, cell: Cell, names: Sequence[str]) -> dict[str, Any]:
        """Records the demonstrations of a cell; returns what is known of them, and how many can be trained on."""
        pool = self.pool(cell.seed, cell.layouts, cell.meshes)
        episodes = math.ceil(_SPARE * self._options.demonstrations / cell.scenes)
        out = pool / f"demonstrations_{cell.scenes}"
        words = ["--scenes", str(pool / "scenes"), "--out", str(out), "--where", _among(names), "--robot", self._options.robot]
        sets = ("task=pick", f"episodes={episodes}", f"noise={_NOISE}", f"seed={cell.seed}", "num_pictures=0")
        _command("demonstrate", *words, *_set(*sets))
        found = _rows(out, "episodes", ["success", "num_steps"])
        successes = [row for row in found if row["success"]]
        return {
            "recorded": len(found),
            "expert": len(successes) / max(1, len(found)),
            "usable": sum(row["num_steps"] <= _LONGEST for row in successes),
        }

    def _train_and_test(self, count: int, tests: str, cell: Cell) -> dict[str, Any]:
        """Trains a policy on some demonstrations and lets it act, in one process each; returns what is known of it."""
        pool = self.pool(cell.seed, cell.layouts, cell.meshes)
        policy, out = pool / f"policy_{cell.scenes}", pool / f"result_{cell.scenes}"
        words = ["--episodes", str(pool / f"demonstrations_{cell.scenes}"), "--out", str(policy)]
        train = (f"max_episodes={count}", f"max_actions={_LONGEST}", f"seed={cell.seed}", "held_out=0")
        _command("train-policy", *words, *_set(*train))
        words = ["--policy", str(policy), "--scenes", str(self._work / "test"), "--where", tests, "--out", str(out)]
        _command("evaluate-policy", *words, *_set(*_TESTED), "--workers", "0")
        counts, trained = _manifest(out)["counts"], _manifest(policy)
        if set(counts["by_assets"]) != {UNSEEN}:
            raise SystemExit(f"{out}: the tests are about assets {counts['by_assets']}, expected only some {UNSEEN}")
        return {
            "demonstrations": trained["num_episodes"],
            "used_scenes": trained["num_scenes"],
            "successes": counts["successes"],
            "attempts": counts["attempts"],
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
            "corrected - uncorrected": [rates["corrected", m, n] - rates["uncorrected", m, n] for m in MESHES for n in counts],
            "real - parametric": [rates[k, "real", n] - rates[k, "parametric", n] for k in LAYOUTS for n in counts],
        }
        for few, many in pairwise(counts):
            pairs[f"{many} - {few} scenes"] = [rates[k, m, many] - rates[k, m, few] for k in LAYOUTS for m in MESHES]
        for name, differences in pairs.items():
            found.setdefault(name, []).append(mean(differences))
    return found


def show(results: Mapping[Cell, Result]) -> Iterator[str]:
    """Yields the lines of the tables: a cell over its seeds, then the effects."""
    rows: list[Sequence[str]] = [
        (
            "layouts",
            "meshes",
            "scenes",
            "seeds",
            "demonstrations",
            "used scenes",
            "expert %",
            "success %",
            "95 % over seeds",
            "of",
        )
    ]
    for layouts, meshes, scenes in product(LAYOUTS, MESHES, sorted({cell.scenes for cell in results})):
        here = [r for c, r in results.items() if (c.layouts, c.meshes, c.scenes) == (layouts, meshes, scenes)]
        rates = [100 * r.rate for r in here]
        cells = (
            str(len(here)),
            f"{mean(r.demonstrations for r in here):.0f}",
            f"{mean(r.used_scenes for r in here):.0f}",
            f"{100 * mean(r.expert for r in here):.0f}",
            f"{mean(rates):.1f}",
            _interval(rates),
            str(sum(r.attempts for r in here)),
        )
        rows.append((layouts, meshes, str(scenes), *cells))
    yield align_columns(rows, 2)
    yield ""
    differences = {name: [100 * value for value in values] for name, values in effects(results).items()}
    head = ("difference of success, percentage points", "mean", "95 % over seeds")
    yield align_columns([head, *((name, f"{mean(v):+.1f}", _interval(v)) for name, v in differences.items())], 1)


def cost(work: Path) -> Iterator[str]:
    """Yields the wall time of the runs in a folder of the experiment, by job."""
    seconds: dict[str, float] = {}
    for file in sorted(work.rglob("manifest.json")):
        manifest = json.loads(file.read_text("utf-8"))
        spent = [part["seconds"] for part in manifest.get("work", ())]
        seconds[manifest["job"]] = seconds.get(manifest["job"], 0.0) + sum(spent)
    yield "minutes, as far as manifests have them: " + ", ".join(f"{job} {value / 60:.0f}" for job, value in seconds.items())


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
    print("\n".join([*show(found), "", *cost(options.out)]))
    if options.json is not None:
        rows = [asdict(cell) | asdict(result) for cell, result in found.items()]
        options.json.write_text(json.dumps({"cells": rows, "effects": effects(found)}, indent=2) + "\n", "utf-8")


if __name__ == "__main__":
    main()
