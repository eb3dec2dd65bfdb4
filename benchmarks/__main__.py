"""All benchmarks: ``python -m benchmarks --data DIR --out DIR [--layouts FILE] [--quick]``. Each prints a table and leaves a JSON file."""

import argparse
import json
import os
import platform
import subprocess
import sys
import tempfile
from pathlib import Path

from stable_data.cli import DONE, SOME_FAILED


def main() -> None:
    """Runs them one after the other, each in a process of its own."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--data", type=Path, required=True, help="a dataset in the MesaTask-10K format, best with real meshes")
    parser.add_argument("--out", type=Path, required=True, help="folder of the JSON files")
    parser.add_argument("--layouts", type=Path, help="start layouts over its meshes, one JSON object a line, for correction")
    parser.add_argument("--quick", action="store_true", help="fewer assets and scenes")
    arguments = parser.parse_args()
    arguments.out.mkdir(parents=True, exist_ok=True)
    machine = {"machine": platform.machine(), "processor": processor(), "python": platform.python_version()}
    (arguments.out / "machine.json").write_text(json.dumps(machine, indent=2) + "\n", "utf-8")
    print(machine)
    few = arguments.quick
    layouts = ["--layouts", str(arguments.layouts)] if arguments.layouts else []
    os.environ |= {"OMP_NUM_THREADS": "1", "IGL_NUM_THREADS": "1"}  # one process is one core, on both sides of a comparison
    data, library = str(arguments.data), f"{arguments.data}/Assets_library"
    with tempfile.TemporaryDirectory(dir=arguments.out) as run:  # a run is of one dataset, and the next may be of another
        preprocess(data, run)
        jobs = {
            "sdf_candidates": ["benchmarks.sdf_candidates", library, "--limit", "12" if few else "24"],
            "sdf_grid": ["benchmarks.sdf_grid", library, *(["--limit", "12"] if few else [])],
            "audit": ["benchmarks.audit", data, *(["--scenes", "6"] if few else [])],
            "preprocess": ["benchmarks.preprocess", data, "--scenes", "160" if few else "1000"],
            "loader": ["benchmarks.loader", run, data],
            "export": ["benchmarks.export", run, *(["--scenes", "6"] if few else [])],
            "env": ["benchmarks.env", run, *(["--scenes", "2", "--steps", "10"] if few else [])],
            "corrector_losses": ["benchmarks.corrector_losses", run, data, *(["--batch", "8"] if few else [])],
            "correction": ["benchmarks.correction", data, *layouts, *(["--per-bucket", "1"] if few else [])],
            "correction_cost": ["benchmarks.correction_cost", data, *(["--scenes", "4", "--rounds", "1"] if few else [])],
            "flow_gain": [
                "benchmarks.flow_gain",
                run,
                data,
                *layouts,
                *(["--scenes", "2", "--per-bucket", "1"] if few else []),
            ],
            "corrector_ablation": ["benchmarks.corrector_ablation", run, *(["--steps", "20"] if few else [])],
            "retrieval": ["benchmarks.retrieval", data, *(["--assets", "1000", "--queries", "100"] if few else [])],
            "http_engine": ["benchmarks.http_engine", *(["--requests", "400"] if few else [])],
            "reasoner": ["benchmarks.reasoner", run, "--split", "test", "--scenes", "4" if few else "200"],
            "edits": ["benchmarks.edits", run, *(["--edits", "4"] if few else [])],
            "reasoner_speed": ["benchmarks.reasoner_speed", run, *(["--scenes", "4", "--rounds", "1"] if few else [])],
            "handwritten": ["benchmarks.handwritten", *(["--cases", "4"] if few else [])],
            "generation": [
                "benchmarks.generation",
                *(["--scenes", "4", "--serial-scenes", "2", "--scripted", "4"] if few else []),
            ],
            "alternation": [
                "benchmarks.alternation",
                run,
                *(["--where", "", "--scenes", "3", "--workers", "0"] if few else []),
            ],
            "generalisation": [
                "benchmarks.generalisation",
                data,
                *(["--scenes", "3", "--cases", "3", "--workers", "0"] if few else []),
            ],
            "chaos": ["benchmarks.chaos", *(["--scenes", "16", "--kills", "3", "--per-shard", "2"] if few else [])],
            "synth": ["benchmarks.synth", "--scenes", "20" if few else "200"],
        }
        failed = []
        for name, command in jobs.items():
            print(f"\n== {name}", flush=True)
            if subprocess.run([sys.executable, "-m", *command, "--json", str(arguments.out / f"{name}.json")]).returncode:
                failed.append(name)
    if failed:
        raise SystemExit(f"could not be measured: {', '.join(failed)}")


def preprocess(data: str, run: str) -> None:
    """Makes the tables; scenes and assets that cannot be used are left out of the figures.

    Raises:
        SystemExit: The job could not be done.
    """
    status = subprocess.run([sys.executable, "-m", "pipelines", "preprocess", "--data", data, "--out", run]).returncode
    if status not in (DONE, SOME_FAILED):
        raise SystemExit(status)


def processor() -> str:
    """Name of the processor, and how many cores this process may use."""
    names = [
        x.split(":")[1].strip() for x in Path("/proc/cpuinfo").read_text("utf-8").splitlines() if x.startswith("model name")
    ]
    return f"{names[0] if names else platform.processor()}, {len(os.sched_getaffinity(0))} cores"


if __name__ == "__main__":
    main()
