"""The report page of a propose run: what was asked, what was laid out, with pictures."""

import json
from collections import Counter, defaultdict
from collections.abc import Iterable, Iterator
from html import escape
from pathlib import Path
from typing import Any

import numpy as np
import polars as pl
from PIL import Image

from pipelines.reports.html import bars, head, image_uri, notices, page, table, tiles
from stable_data.mesatask.task_info import TASK_INFO_FILE
from stable_data.mesatask.writing import LAYOUT_FOLDER
from stable_data.storage.run_folder import RunFolder


def write_propose_report(folder: RunFolder, manifest: dict[str, Any], num_pictures: int) -> None:
    """Writes ``report/index.html``.

    Args:
        folder: The run, complete.
        manifest: Its manifest, with counts.
        num_pictures: Scenes that are shown.
    """
    root = Path(folder.root)
    counts, total, refused = manifest["counts"], Counter[str](), list[str]()
    chosen = sorted(root.glob(f"dataset/{LAYOUT_FOLDER}/*/*"), key=lambda path: path.name)[:num_pictures]
    stages: dict[str, list[dict[str, Any]]] = defaultdict(list)
    for row in _rows(root / "proposals.jsonl"):
        total.update(questions=1, tries=row["tries"], tokens=row["prompt_tokens"] + row["reply_tokens"])
        total["cost"] += row["cost"]
        refused += [code for one in row["refused"] for code in one["codes"]]
        if any(row["scene_id"] == path.name for path in chosen):
            stages[row["scene_id"]].append(row)
    tries = f"{total['tries'] / total['questions']:.2f}" if total["questions"] else "none"
    body = [
        head(manifest),
        f'<p class="note">Reasoner: {escape(manifest["engine"])}. Nothing here is corrected.</p>',
        tiles(
            [
                (f"{counts['scenes']} / {manifest['num_tasks']}", "tasks laid out"),
                (tries, "answers a question"),
                (f"{total['tokens']:,}", "tokens read and written"),
                (f"{total['cost']:.2f}", "cost, by the engine's prices"),
                (str(counts["failures"]), "rows in failures"),
                (str(counts["warnings"]), "warnings"),
            ]
        ),
        bars("Why answers were refused", pl.Series(refused, dtype=pl.String)),
        *(part for path in chosen for part in _scene(path, stages[path.name])),
        *notices(folder),
    ]
    folder.write_bytes("report/index.html", page(f"{manifest['dataset']}: propose", body))


def _rows(path: Path) -> Iterator[dict[str, Any]]:
    with path.open(encoding="utf-8") as lines:
        yield from map(json.loads, lines)


def _scene(folder: Path, stages: Iterable[dict[str, Any]]) -> Iterator[str]:
    task = json.loads((folder / TASK_INFO_FILE).read_text("utf-8"))
    yield f"<h3>{escape(task['Task'])}</h3><div class=grid>"
    picture, name = folder / "front.png", escape(folder.name)
    if picture.is_file():
        yield f'<figure><img alt="{name}" src="{image_uri(np.asarray(Image.open(picture, formats=("PNG",))))}">'
        yield f"<figcaption><b>{name}</b> {escape(folder.parent.name)}</figcaption></figure>"
    said = [(row["stage"], _objects(row["reply"])) for row in stages]
    yield table(("stage", "objects"), said) + "</div>"


def _objects(reply: str | None) -> str:
    return (
        ", ".join(f"{o['instance']} ({o['description']})" for o in json.loads(reply or '{"objects":[]}')["objects"]) or "none"
    )
