"""Looking at scenes: pages a second, bytes of a scene, and the time to the first scene of a long run.

``python -m benchmarks.viewing RUN [--scenes N] [--rows N] [--json FILE]``. The long run has the scenes of RUN again and again, each
under another id, and its assets. Run with ``OMP_NUM_THREADS=1``.
"""

import argparse
import json
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pyarrow as pa
import pyarrow.parquet as pq

from stable_data.simulation.run_reader import NEEDED, RunScenes, SceneSelection
from stable_data.storage.run_folder import RunFolder
from stable_data.storage.table_rows import scene_from_row
from stable_data.viewer.facts import AssetNotes, SceneFacts
from stable_data.viewer.live import LiveViewer
from stable_data.viewer.page import SCRIPT_NAME, PageScene, html_page

_SHARD = 10_000  # scenes of a file of the long run


def pages(run: RunFolder, num_scenes: int) -> dict[str, Any]:
    """Makes a page of each scene, as a report does, and measures time and size."""
    scenes, notes = RunScenes(run, SceneSelection(limit=num_scenes)), AssetNotes(run)
    sizes, start = list[int](), time.perf_counter()
    for row in scenes.rows():
        geometry = scenes.geometry(scene_from_row(row))
        shown = PageScene.of(geometry, SceneFacts.of(geometry, notes, row))
        sizes.append(len(html_page(row["scene_id"], [shown], script_path=f"../{SCRIPT_NAME}")))
    seconds = time.perf_counter() - start
    return {
        "scenes": len(sizes),
        "pages_per_second": round(len(sizes) / seconds, 1),
        "kilobytes_mean": round(sum(sizes) / len(sizes) / 1e3),
        "kilobytes_max": round(max(sizes) / 1e3),
    }


def write_long_run(run: RunFolder, out: Path, num_rows: int) -> RunFolder:
    """Writes a run with many scenes."""
    rows = run.table("scenes")
    for table in {*NEEDED, "textures"} - {"scenes"}:
        for path in run.files(table):
            target = out / table / Path(path).name
            target.parent.mkdir(parents=True, exist_ok=True)
            target.symlink_to(Path(path).resolve())
    (out / "scenes").mkdir(parents=True)
    where = rows.schema.get_field_index("scene_id")
    for start in range(0, num_rows, _SHARD):
        numbers = range(start, min(start + _SHARD, num_rows))
        part = rows.take([number % len(rows) for number in numbers])
        ids = pa.array([f"scene_{number:08d}" for number in numbers])
        part = part.set_column(where, rows.schema.field("scene_id"), ids)
        pq.write_table(part, out / "scenes" / f"part-{start:016x}.parquet", compression="zstd", row_group_size=1024)
    return RunFolder(str(out))


def first_scene(run: RunFolder) -> dict[str, Any]:
    """Opens the live viewer on a run and pages through it, and measures times."""
    start = time.perf_counter()
    with LiveViewer(run) as viewer:
        figures: dict[str, Any] = {"scenes": viewer.num_scenes, "first_scene_seconds": time.perf_counter() - start}
        actions: dict[str, Callable[[], None]] = {
            "next_scene_seconds": lambda: viewer.show(viewer.number + 1),
            "far_scene_seconds": lambda: viewer.show(viewer.num_scenes // 2),
            "to_an_id_seconds": lambda: viewer.go_to(f"scene_{viewer.num_scenes - 3:08d}"),
            "filter_seconds": lambda: viewer.filter("clean and num_objects >= 12"),
        }
        for name, act in actions.items():
            start = time.perf_counter()
            act()
            figures[name] = time.perf_counter() - start
            assert not viewer.message, viewer.message
    return {name: round(value, 3) for name, value in figures.items()}


def main() -> None:
    """Prints the figures."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("run", help="a local run folder")
    parser.add_argument("--scenes", type=int, default=60, help="scenes of which pages are made")
    parser.add_argument("--rows", type=int, default=100_000, help="scenes of the long run")
    parser.add_argument("--json", type=Path, help="file for the figures")
    arguments = parser.parse_args()
    run = RunFolder(arguments.run)
    figures = {"pages": pages(run, arguments.scenes)}
    with tempfile.TemporaryDirectory() as folder:
        figures["live"] = first_scene(write_long_run(run, Path(folder) / "long", arguments.rows))
    print(json.dumps(figures, indent=1))
    if arguments.json:
        arguments.json.write_text(json.dumps(figures, indent=1) + "\n", "utf-8")


if __name__ == "__main__":
    main()
