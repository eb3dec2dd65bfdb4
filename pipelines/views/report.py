"""The report page of a views run: its pictures."""

import base64
from collections.abc import Iterable
from html import escape
from typing import Any

import pyarrow.compute as pc

from pipelines.reports.html import head, notices, page
from stable_data.storage.run_folder import RunFolder

_SHOWN = 24  # scenes


def write_views_report(folder: RunFolder, manifest: dict[str, Any]) -> None:
    """Writes ``report/index.html``.

    Args:
        folder: The run, with complete tables.
        manifest: Its manifest, with counts.
    """
    about = f"Features: {manifest['features']}. Distances of sets: {manifest['distance']}, {manifest['kernel_distance']}."
    body = [head(manifest), f'<p class="note">{escape(about)}</p>', *_pictures(folder), *notices(folder)]
    folder.write_bytes("report/index.html", page(f"{manifest['dataset']}: views", body))


def _pictures(folder: RunFolder) -> Iterable[str]:
    names = sorted(folder.table("views", ["scene_id"])["scene_id"].to_pylist())
    chosen = names[:: max(1, len(names) // _SHOWN)][:_SHOWN]
    rows = folder.table("views", ["scene_id", "views"], pc.field("scene_id").isin(chosen)).to_pylist()
    yield "<div class=grid>"
    for row in sorted(rows, key=lambda row: str(row["scene_id"])):
        for shown in row["views"]:
            said = f"{escape(row['scene_id'])}, {escape(shown['view'])}"
            address = f"data:image/png;base64,{base64.b64encode(shown['picture']).decode()}"
            yield f'<figure><img alt="{said}" src="{address}"><figcaption>{said}</figcaption></figure>'
    yield "</div>"
