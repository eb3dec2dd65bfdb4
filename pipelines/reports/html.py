"""Parts of a report page: one HTML file, which opens without a network."""

import base64
import io
from collections.abc import Iterable, Sequence
from html import escape
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import polars as pl
from PIL import Image

from stable_data.storage.run_folder import RunFolder

_STYLE, _SCRIPT = (Path(__file__).with_name(name) for name in ("report.css", "report.js"))
_SHOWN = 200  # notices of a table that the page lists


def page(title: str, body: Iterable[str]) -> bytes:
    """A complete page."""
    text = (
        '<!doctype html><html lang="en"><meta charset="utf-8"><meta name="viewport" content="width=device-width">'
        f"<title>{escape(title)}</title><style>{_STYLE.read_text('utf-8')}</style>"
        f"<main>{''.join(body)}</main><script>{_SCRIPT.read_text('utf-8')}</script></html>"
    )
    return text.encode()


def head(manifest: dict[str, Any]) -> str:
    """The title of a run with its code versions and inputs."""
    return (
        f"<h1>{escape(manifest['dataset'])}</h1>"
        f'<p class="note">{manifest["job"]}, code {escape(", ".join(manifest["code_versions"]))}, tables version '
        f"{manifest['table_version']}, inputs {manifest['input_fingerprint']}</p>"
    )


def tiles(figures: Iterable[tuple[str, str]]) -> str:
    """Large figures with their labels."""
    return '<div class="tiles">' + "".join(f'<div class="tile"><b>{a}</b><span>{b}</span></div>' for a, b in figures) + "</div>"


def notices(folder: RunFolder) -> Iterable[str]:
    """The tables ``failures`` and ``warnings``."""
    for name in ("failures", "warnings"):
        rows = folder.table(name).sort_by([("code", "ascending"), ("id", "ascending")])
        yield f"<h2>{name.capitalize()} ({rows.num_rows})</h2>"
        if not rows.num_rows:
            yield '<p class="note">None.</p>'
            continue
        columns = ("id", "step", "code", "message")
        shown = rows.slice(0, _SHOWN).to_pylist()
        yield table(columns, [[row[column] for column in columns] for row in shown])
        if rows.num_rows > len(shown):
            yield f'<p class="note">{rows.num_rows - len(shown)} more rows are in the table {name}.</p>'


def image_uri(picture: Any) -> str:
    """A picture, (H, W, 3) uint8, as a data URI."""
    stream = io.BytesIO()
    Image.fromarray(picture).convert("RGB").save(stream, "JPEG", quality=88)
    return "data:image/jpeg;base64," + base64.b64encode(stream.getvalue()).decode()


def table(head: Sequence[str], rows: Iterable[Sequence[str]]) -> str:
    """A table."""
    body = "".join("<tr>" + "".join(f"<td>{escape(str(cell))}</td>" for cell in row) + "</tr>" for row in rows)
    return "<table><tr>" + "".join(f"<th>{escape(h)}</th>" for h in head) + f"</tr>{body}</table>"


def histogram(title: str, values: pl.Series, edges: Sequence[float]) -> str:
    """A histogram of values; null counts as unknown."""
    known = values.drop_nulls().to_numpy()
    counts = np.histogram(known, edges)[0]
    step = 1 if values.dtype.is_integer() else 0  # ranges of whole numbers end one below the next, such as 4 – 7
    labels = [
        f"{a:g}" if a == b - step else f"{a:g} – {b - step:g}" if b < 1000 else f"{a:g} or more" for a, b in pairwise(edges)
    ]
    if len(edges) > 1 and edges[1] == 1e-9:
        labels[:2] = ["0", f"under {edges[2]:g}"]
    rows = [*zip(labels, counts.tolist(), strict=True)]
    if values.null_count():
        rows.append(("unknown", values.null_count()))
    return _chart(title, rows)


def bars(title: str, values: pl.Series) -> str:
    """A bar for the count of each value."""
    counted = values.cast(pl.String).fill_null("none").value_counts(sort=True, name="n")
    return _chart(title, list(counted.iter_rows()))


def _chart(title: str, rows: Sequence[tuple[str, int]]) -> str:
    most = max((n for _, n in rows), default=0) or 1
    rows_html = "".join(
        f'<div class="row"><span>{escape(label)}</span><i style="width:{100 * n / most:.1f}%"></i><span>{n}</span></div>'
        for label, n in rows
    )
    return f'<div class="chart"><h3>{escape(title)}</h3>{rows_html}</div>'
