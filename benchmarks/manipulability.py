"""Scores of two answers that need no detector on the handles of a run, and the speed of their export.

    python -m benchmarks.manipulability RUN [--scenes 50] [--json FILE]

Scenes of RUN are exported as with ``export --format manipvqa``. ``whole object`` answers with the box of the visible pixels of the object,
``moved by a tenth`` with the right box moved by a tenth of its width and height.
"""

import argparse
import json
import tempfile
import time
from collections.abc import Sequence
from pathlib import Path
from statistics import mean

from pipelines.reports.text_table import align_columns
from stable_data.export.exporter import export_run
from stable_data.export.manipvqa import QUESTIONS_FILE, SIZE
from stable_data.scores.detection import OVERLAPS, Box, DetectedBox, LabelledBox, read_labels, score_detections
from stable_data.simulation.run_reader import SceneSelection
from stable_data.storage.run_folder import RunFolder


def whole_objects(folder: Path, labels: Sequence[LabelledBox]) -> list[DetectedBox]:
    """The boxes of the objects whose handles are asked for."""
    found = dict[tuple[str, str], Box]()
    for path in (folder / "boxes").glob("*.json"):
        content = json.loads(path.read_text("utf-8"))
        for handle in content["handles"]:
            left, top, right, bottom = (value / SIZE for value in handle["whole"])
            found[content["image"], handle["category"]] = (left, top, right, bottom)
    return [DetectedBox(one.image, one.category, found[one.image, one.category]) for one in labels]


def moved(one: LabelledBox) -> DetectedBox:
    """The right box, moved by a tenth of its size."""
    left, top, right, bottom = one.box
    x, y = 0.1 * (right - left), 0.1 * (bottom - top)
    return DetectedBox(one.image, one.category, (left + x, top + y, right + x, bottom + y))


def main(arguments: Sequence[str] | None = None) -> None:
    """Prints a table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("run", help="a run with embedded assets")
    parser.add_argument("--scenes", type=int, default=50)
    parser.add_argument("--json", type=Path, help="file for the figures")
    given = parser.parse_args(arguments)
    with tempfile.TemporaryDirectory(prefix="stable-data-") as name:
        folder, began = Path(name), time.perf_counter()
        result = export_run(RunFolder(given.run), folder, "manipvqa", SceneSelection(limit=given.scenes))
        rate = result.num_written / (time.perf_counter() - began)
        questions = json.loads((folder / QUESTIONS_FILE).read_text("utf-8"))
        labels = read_labels(folder / QUESTIONS_FILE) if questions else []
        answers = {"whole object": whole_objects(folder, labels), "moved by a tenth": [moved(one) for one in labels]}
    print(
        f"{result.num_written} scenes, {rate:.2f} a second; {len(labels)} questions about {len({one.category for one in labels})} things"
    )
    rows: list[Sequence[str]] = [("answer", *(f"AP@{at}" for at in OVERLAPS))]
    figures: dict[str, float | None] = {"scenes_a_second": rate, "questions": len(labels)}
    for answer, boxes in answers.items():
        scores = score_detections(labels, boxes)
        for at in OVERLAPS:
            figures[f"{answer}@{at}"] = mean(one.precision[at] for one in scores) if scores else None
        rows.append(
            (answer, *("unknown" if (value := figures[f"{answer}@{at}"]) is None else f"{value:.2f}" for at in OVERLAPS))
        )
    print(align_columns(rows, 1))
    if given.json is not None:
        given.json.write_text(json.dumps(figures, indent=2) + "\n", "utf-8")


if __name__ == "__main__":
    main()
