"""All benchmarks: ``python -m benchmarks --data DIR --out DIR [--layouts FILE] [--quick]``. Each prints a table and writes a JSON file.

``benchmarks.policy`` and ``benchmarks.soak`` take hours, and ``benchmarks.replay`` needs recorded episodes: they are run by themselves
(docs/policy.md, docs/faults.md).
"""

import argparse
import json
import os
import platform
import subprocess
import sys
import tempfile
from pathlib import Path

from stable_data.commands.command_line import DONE, SOME_FAILED


def main() -> None:
    """Runs all benchmarks one after the other, each in its own process."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument(
        "--data", type=Path, required=True, help="a dataset in the MesaTask-10K format, preferably with real meshes"
    )
    parser.add_argument("--out", type=Path, required=True, help="folder of the JSON files")
    parser.add_argument("--layouts", type=Path, help="start layouts over its meshes, one JSON object a line, for correction")
    parser.add_argument("--quick", action="store_true", help="fewer assets and scenes")
    arguments = parser.parse_args()
    arguments.out.mkdir(parents=True, exist_ok=True)
    machine = {"machine": platform.machine(), "processor": processor(), "python": platform.python_version()}
    (arguments.out / "machine.json").write_text(json.dumps(machine, indent=2) + "\n", "utf-8")
    print(machine)
    layouts = ["--layouts", str(arguments.layouts)] if arguments.layouts else []
    os.environ |= {"OMP_NUM_THREADS": "1", "IGL_NUM_THREADS": "1"}  # one process is one core, on both sides of a comparison
    data, library = str(arguments.data), f"{arguments.data}/Assets_library"
    with tempfile.TemporaryDirectory(dir=arguments.out) as run:  # a run belongs to one dataset, and the next may be another one
        preprocess(data, run)
        # The arguments of each benchmark, and those that --quick adds: of an option that is given twice, the last value counts.
        jobs: dict[str, tuple[list[str], list[str]]] = {
            "sdf_candidates": ([library, "--limit", "24"], ["--limit", "12"]),
            "sdf_grid": ([library], ["--limit", "12"]),
            "audit": ([data], ["--scenes", "6"]),
            "preprocess": ([data, "--scenes", "1000"], ["--scenes", "160"]),
            "loader": ([run, data], []),
            "export": ([run], ["--scenes", "6"]),
            "manipulability": ([run], ["--scenes", "4"]),
            "viewing": ([run], ["--scenes", "6", "--rows", "200"]),
            "query": ([run, f"{run}/large", "--rows", "100000"], ["--rows", "2000"]),
            "verify": ([run, "--scenes", "5000", "--folder", f"{run}/copies"], ["--scenes", "20", "--sample", "2"]),
            "diversity": ([run], ["--scenes", "50"]),
            "judges": ([data, "--limit", "40"], ["--limit", "2"]),
            "env": ([run], ["--scenes", "2", "--steps", "10"]),
            "robot_environment": ([run, "--robot", "simple"], ["--scenes", "2", "--steps", "5"]),
            "corrector_losses": ([run, data], ["--batch", "8"]),
            "correction": ([data, *layouts], ["--per-bucket", "1"]),
            "rearrangement": ([run, "--count", "60", "--seeds", "1"], ["--count", "2"]),
            "correction_cost": ([data], ["--scenes", "4", "--rounds", "1"]),
            "refinement": ([data, "--layouts", "64"], ["--layouts", "4"]),
            "corrector_ablation": ([run], ["--steps", "20"]),
            "retrieval": ([data], ["--assets", "1000", "--queries", "100"]),
            "http_engine": ([], ["--requests", "400"]),
            "reasoner": ([run, "--split", "test", "--scenes", "200"], ["--scenes", "4"]),
            "edits": ([run], ["--edits", "4"]),
            "reasoner_speed": ([run], ["--scenes", "4", "--rounds", "1"]),
            "handwritten": ([], ["--cases", "4"]),
            "understanding": ([], []),
            "generation": ([], ["--scenes", "4", "--serial-scenes", "2", "--scripted", "4"]),
            "alternation": ([run], ["--where", "", "--scenes", "3", "--workers", "0"]),
            "generalisation": ([data], ["--scenes", "3", "--cases", "3", "--workers", "0"]),
            # Without a generated run: what scenes of training reach, whose pairs of categories are all known.
            "taste": ([run, run, "--generated-split", "train"], []),
            "set_distance": ([data], ["--scenes", "6", "--samples", "300", "--width", "128"]),
            "rating": ([run], ["--scenes", "3", "--bad", "1"]),
            # Without a full disk and a clock that jumps, which need the rights of root and libfaketime.
            "chaos": (
                [data, "--out", f"{run}/chaos", "--faults", "kill_driver,kill_worker,kill_node,kill_head,two_drivers"],
                ["--scenes", "6", "--kills", "4", "--per-shard", "1"],
            ),
            "plan_scale": (["--scenes", "1000000"], ["--scenes", "10000"]),
            "asset_import": ([data], ["--limit", "6"]),
            "supports": ([], ["--faces", "2000"]),
            "import_scale": ([data], ["--assets", "32", "--subset", "8"]),
            "synth": (["--scenes", "200"], ["--scenes", "20"]),
            "fuzz": ([f"{run}/fuzz", "--count", "20000"], ["--count", "500"]),
        }
        failed = []
        for name, (words, quick) in jobs.items():
            print(f"\n== {name}", flush=True)
            command = [sys.executable, "-m", f"benchmarks.{name}", *words, *(quick if arguments.quick else [])]
            if subprocess.run([*command, "--json", str(arguments.out / f"{name}.json")]).returncode:
                failed.append(name)
    if failed:
        raise SystemExit(f"could not be measured: {', '.join(failed)}")


def preprocess(data: str, run: str) -> None:
    """Preprocesses the dataset; scenes and assets that cannot be used are left out of the figures.

    Raises:
        SystemExit: The job failed.
    """
    status = subprocess.run([sys.executable, "-m", "pipelines", "preprocess", "--data", data, "--out", run]).returncode
    if status not in (DONE, SOME_FAILED):
        raise SystemExit(status)


def processor() -> str:
    """Returns the name of the processor and the number of cores that this process may use."""
    names = [
        x.split(":")[1].strip() for x in Path("/proc/cpuinfo").read_text("utf-8").splitlines() if x.startswith("model name")
    ]
    return f"{names[0] if names else platform.processor()}, {len(os.sched_getaffinity(0))} cores"


if __name__ == "__main__":
    main()
