"""Exports of a run: the speed of each format, and whether the scenes stay at rest in MuJoCo alone.

``python -m benchmarks.export RUN [--scenes N] [--json FILE]``. The MJCF files are opened in a process that imports mujoco and
numpy and nothing of stable-data. A scene is at rest if in 4 s no object moves more than 10 mm or turns more than 5 degrees
(DESIGN section 7). Run with ``OMP_NUM_THREADS=1``.
"""

import argparse
import json
import subprocess
import sys
import tempfile
import time
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from stable_data.export.exporter import export_run
from stable_data.export.formats import FORMATS
from stable_data.simulation.run_reader import RunScenes, SceneSelection
from stable_data.simulation.settling import settle
from stable_data.storage.run_folder import RunFolder

ALONE = """
import json, sys
import mujoco
import numpy as np

for path in map(str.strip, sys.stdin):
    try:
        model = mujoco.MjModel.from_xml_path(path)
        data = mujoco.MjData(model)
        mujoco.mj_resetDataKeyframe(model, data, model.key("home").id)
        mujoco.mj_kinematics(model, data)
        start, moved, turned = (data.xpos[1:].copy(), data.xquat[1:].copy()), 0.0, 0.0
        for _ in range(200):
            mujoco.mj_step(model, data, nstep=10)
            mujoco.mj_kinematics(model, data)
            if not np.isfinite(data.xpos).all():
                moved, turned = float("inf"), float("inf")
                break
            moved = max(moved, float(np.linalg.norm(data.xpos[1:] - start[0], axis=1).max(initial=0.0)))
            cosine = np.abs((data.xquat[1:] * start[1]).sum(axis=1))
            turned = max(turned, float(np.degrees(2 * np.arccos(np.minimum(cosine, 1.0))).max(initial=0.0)))
        print(json.dumps([True, 1e3 * moved, turned]), flush=True)
    except ValueError:
        print(json.dumps([False, None, None]), flush=True)
assert not any(name.startswith("stable_data") for name in sys.modules)
"""
"""A program that reads paths of MJCF files and prints for each: whether it loads, the largest move, mm, and turn, degrees."""


@dataclass(frozen=True, slots=True)
class ExportFigure:
    """The figures of one format.

    Attributes:
        format: Its name.
        num_scenes: Scenes that were written.
        num_failed: Scenes that could not be written.
        seconds: Time for all scenes with their meshes.
        scenes_per_second: Written scenes a second.
        megabytes: Size of the folder.
    """

    format: str
    num_scenes: int
    num_failed: int
    seconds: float
    scenes_per_second: float
    megabytes: float


def written(run: RunFolder, out: Path, name: str, choice: SceneSelection) -> ExportFigure:
    """Exports to an empty folder."""
    start = time.perf_counter()
    result = export_run(run, out, name, choice)
    seconds = time.perf_counter() - start
    size = sum(path.stat().st_size for path in out.rglob("*") if path.is_file())
    return ExportFigure(
        name,
        result.num_written,
        len(result.failures),
        round(seconds, 2),
        round(result.num_written / seconds, 1),
        round(size / 1e6, 1),
    )


def at_rest(run: RunFolder, out: Path, choice: SceneSelection) -> dict[str, Any]:
    """Compares the verdicts of MuJoCo alone on the MJCF files with those of this library on the same scenes."""
    scenes = RunScenes(run, choice)
    known = [(FORMATS["mjcf"].scene_path(scene, out), scene) for scene in scenes]
    known = [(path, scene) for path, scene in known if path.exists()]
    paths = "".join(f"{path}\n" for path, _ in known)
    done = subprocess.run([sys.executable, "-I", "-c", ALONE], input=paths, capture_output=True, text=True, check=True)
    found = [json.loads(line) for line in done.stdout.splitlines()]
    rests = [loads and moved <= 10 and turned <= 5 for loads, moved, turned in found]
    verdicts = [settle(scenes.geometry(scene).bodies, scene.table) for _, scene in known]
    moves = [
        abs(moved - verdict.settle_move_max_mm)
        for (_, moved, _), verdict in zip(found, verdicts, strict=True)
        if moved is not None and verdict.settle_move_max_mm is not None
    ]
    return {
        "num_scenes": len(known),
        "loads": sum(loads for loads, _, _ in found),
        "at_rest": sum(rests),
        "same_verdict": sum(bool(v.stable) == r for v, r in zip(verdicts, rests, strict=True)),
        "largest_difference_mm": max(moves, default=0.0),
    }


def main() -> None:
    """Prints the figures."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("run", help="a run folder")
    parser.add_argument("--scenes", type=int, default=100, help="number of scenes")
    parser.add_argument("--json", type=Path, help="file for the figures")
    arguments = parser.parse_args()
    run, choice = RunFolder(arguments.run), SceneSelection(limit=arguments.scenes)
    with tempfile.TemporaryDirectory() as folder:
        figures = [written(run, Path(folder) / name, name, choice) for name in FORMATS]
        rest = at_rest(run, Path(folder) / "mjcf", choice)
    print(f"{'format':10} {'scenes':>7} {'failed':>7} {'scenes/s':>9} {'MB':>8}")
    for f in figures:
        print(f"{f.format:10} {f.num_scenes:7} {f.num_failed:7} {f.scenes_per_second:9.1f} {f.megabytes:8.1f}")
    print(f"MuJoCo alone: {rest}")
    if arguments.json:
        content = {"formats": [asdict(figure) for figure in figures], "mujoco_alone": rest}
        arguments.json.write_text(json.dumps(content, indent=1) + "\n", "utf-8")


if __name__ == "__main__":
    main()
