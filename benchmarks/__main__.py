"""All benchmarks: ``python -m benchmarks --data DIR --out DIR [--quick]``. Each prints a table and leaves a JSON file."""

import argparse
import json
import os
import platform
import subprocess
import sys
from pathlib import Path


def main() -> None:
    """Runs them one after the other, each in a process of its own."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--data", type=Path, required=True, help="a dataset in the MesaTask-10K format, best with real meshes")
    parser.add_argument("--out", type=Path, required=True, help="folder of the JSON files")
    parser.add_argument("--quick", action="store_true", help="fewer assets and scenes")
    arguments = parser.parse_args()
    arguments.out.mkdir(parents=True, exist_ok=True)
    run = arguments.out / "run"
    machine = {"machine": platform.machine(), "processor": processor(), "python": platform.python_version()}
    (arguments.out / "machine.json").write_text(json.dumps(machine, indent=2) + "\n", "utf-8")
    print(machine)
    few = arguments.quick
    os.environ |= {"OMP_NUM_THREADS": "1", "IGL_NUM_THREADS": "1"}  # one process is one core, on both sides of a comparison
    jobs = {
        "sdf_grid": ["-m", "benchmarks.sdf_grid", f"{arguments.data}/Assets_library", *(["--limit", "12"] if few else [])],
        "audit": ["-m", "benchmarks.audit", str(arguments.data), *(["--scenes", "6"] if few else [])],
        "preprocess": ["-m", "benchmarks.preprocess", str(arguments.data), "--scenes", "160" if few else "1000"],
        "loader": ["-m", "benchmarks.loader", str(run), str(arguments.data)],
    }
    subprocess.run([sys.executable, "-m", "pipelines", "preprocess", "--data", arguments.data, "--out", run], check=True)
    for name, command in jobs.items():
        print(f"\n== {name}", flush=True)
        subprocess.run([sys.executable, *command, "--json", str(arguments.out / f"{name}.json")], check=True)


def processor() -> str:
    """Name of the processor, and how many cores this process may use."""
    names = [
        x.split(":")[1].strip() for x in Path("/proc/cpuinfo").read_text("utf-8").splitlines() if x.startswith("model name")
    ]
    return f"{names[0] if names else platform.processor()}, {len(os.sched_getaffinity(0))} cores"


if __name__ == "__main__":
    main()
