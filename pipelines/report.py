"""The report page of a preprocess run: one HTML file that needs no other, with counts, histograms and pictures."""

import base64
import io
from collections.abc import Iterable, Sequence
from html import escape
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import polars as pl
import pyarrow.compute as pc
from PIL import Image

from stable_data.assets import AssetStore
from stable_data.errors import ConfigError
from stable_data.mesh import Mesh
from stable_data.metrics.summary import summarise
from stable_data.render import render_scene
from stable_data.shards import RunFolder
from stable_data.tables import scene_from_row

_STYLE = Path(__file__).with_name("report.css")


def write_report(folder: RunFolder, manifest: dict[str, Any], store: AssetStore, num_pictures: int) -> None:
    """Writes ``report/index.html``.

    Args:
        folder: The run; its tables are complete.
        manifest: Its manifest, with counts.
        store: Geometry of the assets, for the pictures.
        num_pictures: Scenes that are drawn: half of them the worst, half an even choice.
    """
    columns = [
        c for c in folder.dataset("scenes").schema.names if c not in ("source_json", "relations", "task", "restricted_zone")
    ]
    scenes = pl.from_arrow(folder.table("scenes", columns))
    assert isinstance(scenes, pl.DataFrame)
    body = [
        f"<h1>{escape(manifest['dataset'])}</h1>",
        f'<p class="note">preprocess, code {escape(manifest["code_version"])}, tables version {manifest["table_version"]}, '
        f"inputs {manifest['input_fingerprint']}</p>",
        _tiles(manifest["counts"], manifest),
        *_audit(scenes),
        *_pictures(folder, scenes, store, num_pictures),
        *_staging(folder, scenes),
        *_assets(folder),
        *_notices(folder),
    ]
    page = (
        '<!doctype html><html lang="en"><meta charset="utf-8"><meta name="viewport" content="width=device-width">'
        f"<title>{escape(manifest['dataset'])}: preprocess</title><style>{_STYLE.read_text('utf-8')}</style>"
        f"<main>{''.join(body)}</main></html>"
    )
    folder.write_bytes("report/index.html", page.encode())


def _tiles(counts: dict[str, Any], manifest: dict[str, Any]) -> str:
    tiles = [
        (f"{counts['scenes']} / {manifest['num_scenes']}", "scenes usable"),
        (str(counts["failed_scenes"]), "scenes in failures"),
        (f"{counts['assets']} / {manifest['num_assets']}", "assets usable"),
        (str(manifest["num_assets_without_mesh"]), "assets without a mesh file"),
        (str(counts["samples"]), "staged samples"),
        (str(counts["sdf"]), "signed-distance grids"),
        (str(counts.get("features", 0)), f"point features of encoder {(manifest.get('encoder') or 'none')[:8]}"),
        (str(counts["warnings"]), "warnings"),
    ]
    return '<div class="tiles">' + "".join(f'<div class="tile"><b>{a}</b><span>{b}</span></div>' for a, b in tiles) + "</div>"


def _audit(scenes: pl.DataFrame) -> Iterable[str]:
    summary = summarise(scenes)
    rows = [(x.label, f"{x.count}", f"{x.total}", f"{100 * x.share:.1f} %", str(x.unknown or "")) for x in summary.lines]
    yield "<h2>Audit</h2><p class=note>Exact, against the triangle meshes, before anything is learned.</p>"
    yield _table(("", "count", "of", "share", "unknown"), rows)
    yield _table(("", ""), summary.figures)
    yield "<h2>Distributions</h2><div class=grid>"
    yield _histogram("Objects a scene", scenes["num_objects"], [0, 4, 8, 12, 16, 20, 25, 30, 1000])
    yield _histogram("Deepest penetration of a scene, mm", scenes["max_penetration_mm"], [0, 1e-9, 0.5, 1, 3, 10, 30, 1000])
    yield _histogram("Largest gap of a scene, mm", scenes["max_gap_mm"], [0, 0.5, 1, 3, 10, 30, 1000])
    yield _bars("Table type", scenes["table_type"])
    yield _bars("Split", scenes["split"])
    yield "</div>"
    if summary.offenders:
        yield "<h2>Worst offenders</h2>" + _table(("scene", "what"), [(o.scene_id, o.what) for o in summary.offenders])


def _staging(folder: RunFolder, scenes: pl.DataFrame) -> Iterable[str]:
    objects = scenes.select(pl.col("objects").explode()).drop_nulls().unnest("objects") if scenes.height else pl.DataFrame()
    origins = folder.table("scenes", ["task"])["task"].to_pylist()
    yield "<h2>Tasks and stages</h2><div class=grid>"
    if objects.height:
        yield _bars("Objects by stage", objects["stage"])
    yield _bars("Task infos by origin", pl.Series("origin", [t["origin"] if t else "none" for t in origins], dtype=pl.String))
    yield _histogram("Stacked objects a scene", scenes["num_stacked"], [0, 1, 2, 3, 5, 8, 1000])
    yield _histogram("Contained objects a scene", scenes["num_contained"], [0, 1, 2, 3, 5, 8, 1000])
    yield "</div>"


def _assets(folder: RunFolder) -> Iterable[str]:
    reports = pl.DataFrame(folder.table("assets", ["report"])["report"].to_pylist())
    parts = folder.table("meshes", ["parts_method"])["parts_method"].to_pylist()
    errors = folder.table("sdf", ["mean_error", "sign_error", "spacing"]).to_pylist()
    if not reports.height:
        return
    faces = reports["num_faces"].to_numpy()
    rows = [
        ("watertight before repair", f"{reports['was_watertight'].sum()} of {reports.height}"),
        ("watertight after repair", f"{reports['is_watertight'].sum()} of {reports.height}"),
        ("open sheets, taken as thin shells", f"{reports['is_sheet'].sum()} of {reports.height}"),
        ("faces, median and most", f"{np.median(faces):.0f}, {faces.max()}"),
        ("convex parts: the hull is enough", f"{sum(p == 'hull' for p in parts)} of {len(parts)}"),
    ]
    if errors:
        share = [float(np.median([e[key] for e in errors])) for key in ("mean_error", "spacing")]
        rows.append(("grid error near the surface, median", f"{100 * share[0]:.3f} % of the largest extent"))
        rows.append(("grid spacing, median", f"{100 * share[1]:.2f} % of the largest extent"))
        rows.append(("wrong signs off the surface, mean", f"{100 * np.mean([e['sign_error'] for e in errors]):.3f} %"))
    yield "<h2>Assets</h2>" + _table(("", ""), rows)


def _notices(folder: RunFolder) -> Iterable[str]:
    for table in ("failures", "warnings"):
        rows = folder.table(table).to_pylist()
        yield f"<h2>{table.capitalize()} ({len(rows)})</h2>"
        if not rows:
            yield '<p class="note">None.</p>'
            continue
        shown = sorted(rows, key=lambda r: (r["code"], r["id"]))[:200]
        yield _table(("id", "step", "code", "message"), [(r["id"], r["step"], r["code"], r["message"]) for r in shown])
        if len(rows) > len(shown):
            yield f'<p class="note">and {len(rows) - len(shown)} more in the table {table}.</p>'


def _pictures(folder: RunFolder, scenes: pl.DataFrame, store: AssetStore, count: int) -> Iterable[str]:
    if not scenes.height or count <= 0:
        return
    worst_first = scenes.sort(["clean", "max_penetration_mm", "scene_id"], descending=[False, True, False], nulls_last=True)
    worst = worst_first["scene_id"].to_list()[: count // 2]
    rest = sorted(set(scenes["scene_id"]) - set(worst))
    chosen = [*worst, *rest[:: max(1, len(rest) // (count - len(worst)))]][:count]
    rows = folder.table("scenes", where=pc.field("scene_id").isin(chosen)).to_pylist()
    yield "<h2>Pictures</h2><div class=grid>"
    for row in sorted(rows, key=lambda r: chosen.index(r["scene_id"])):
        name = escape(row["scene_id"])
        try:
            scene = scene_from_row(row)
            shapes, _ = store.shapes(scene)
            picture = render_scene(scene, [Mesh(s.vertices, s.faces) if s.is_exact else None for s in shapes])
        except ConfigError as error:  # this machine draws nothing at all
            yield f'</div><p class="note">{escape(str(error))}</p>'
            return
        except Exception as error:  # noqa: BLE001 - a scene that cannot be drawn is no reason to be without the page
            yield f'<p class="note">{name} cannot be drawn: {escape(f"{type(error).__name__}: {error}")}</p>'
            continue
        verdict = {True: '<span class="good">clean</span>', False: '<span class="bad">not clean</span>', None: "unknown"}[
            row["clean"]
        ]
        task = escape(row["task"]["task"]) if row["task"] else ""
        caption = f"<figcaption><b>{name}</b> {verdict}<br>{task}</figcaption>"
        yield f'<figure><img alt="{name}" src="{_data_uri(picture)}">{caption}</figure>'
    yield "</div>"


def _data_uri(picture: Any) -> str:
    stream = io.BytesIO()
    Image.fromarray(picture).convert("RGB").save(stream, "JPEG", quality=88)
    return "data:image/jpeg;base64," + base64.b64encode(stream.getvalue()).decode()


def _table(head: Sequence[str], rows: Iterable[Sequence[str]]) -> str:
    body = "".join("<tr>" + "".join(f"<td>{escape(str(cell))}</td>" for cell in row) + "</tr>" for row in rows)
    return "<table><tr>" + "".join(f"<th>{escape(h)}</th>" for h in head) + f"</tr>{body}</table>"


def _histogram(title: str, values: pl.Series, edges: Sequence[float]) -> str:
    known = values.drop_nulls().to_numpy()
    counts = np.histogram(known, edges)[0]
    step = 1 if values.dtype.is_integer() else 0  # 4 – 7, but 0.5 – 1
    labels = [
        f"{a:g}" if a == b - step else f"{a:g} – {b - step:g}" if b < 1000 else f"{a:g} or more" for a, b in pairwise(edges)
    ]
    if len(edges) > 1 and edges[1] == 1e-9:
        labels[:2] = ["0", f"under {edges[2]:g}"]
    rows = [*zip(labels, counts.tolist(), strict=True)]
    if values.null_count():
        rows.append(("unknown", values.null_count()))
    return _chart(title, rows)


def _bars(title: str, values: pl.Series) -> str:
    counted = values.cast(pl.String).fill_null("none").value_counts(sort=True, name="n")
    return _chart(title, list(counted.iter_rows()))


def _chart(title: str, rows: Sequence[tuple[str, int]]) -> str:
    most = max((n for _, n in rows), default=0) or 1
    bars = "".join(
        f'<div class="row"><span>{escape(label)}</span><i style="width:{100 * n / most:.1f}%"></i><span>{n}</span></div>'
        for label, n in rows
    )
    return f'<div class="chart"><h3>{escape(title)}</h3>{bars}</div>'
