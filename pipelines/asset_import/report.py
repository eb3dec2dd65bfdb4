"""The report page of an import: pictures of all assets at their true size, and what their properties rest on."""

from collections import Counter
from collections.abc import Iterable, Iterator, Sequence
from functools import partial
from html import escape
from typing import Any

import numpy as np

from pipelines.reports.html import head, notices, page, table, tiles
from pipelines.reports.scene_pictures import SceneGrids, ShownScene
from pipelines.sources.scenes import mesh_cache
from stable_data.assets.run_assets import RunAssets
from stable_data.assets.store import AssetStore
from stable_data.rotations import yaw_frame_box
from stable_data.scene import UPRIGHT, QuatXyzw, Scene, SceneObject, Tabletop, Vec3
from stable_data.storage.run_folder import RunFolder

_COLUMNS = (
    "asset_id", "category", "category_source", "extents", "typical_scale", "scale_source", "scale_confidence", "resting_tilts",
    "rest_source", "mass", "mass_source", "licence", "is_container", "is_static", "geometry_hash",
)  # fmt: skip
_PER_PICTURE = 8
_GAP = 0.25  # between assets, share of the largest of a picture
_RULER = 0.1  # metres; side of the box that shows the scale
_LISTED = 500  # assets in the table of the page


def write_import_report(folder: RunFolder, manifest: dict[str, Any], num_pictures: int) -> None:
    """Writes ``report/index.html``.

    Args:
        folder: The run, with complete tables.
        manifest: Its manifest, with counts.
        num_pictures: Number of assets that are drawn, evenly chosen by size.
    """
    rows = sorted(folder.table("assets", _COLUMNS).to_pylist(), key=lambda row: (max(_size(row)), row["asset_id"]))
    store = AssetStore(RunAssets(folder, mesh_cache()))
    chosen = rows[:: max(1, -(-len(rows) // num_pictures))] if num_pictures else []
    body = [
        head(manifest),
        _tiles(manifest, rows),
        "<h2>Pictures</h2>" if chosen else "",
        *SceneGrids(folder, store).grid((group[0]["asset_id"], partial(_shown, group, store)) for group in _groups(chosen)),
        *_sources(rows),
        *_listed(rows),
        *notices(folder),
    ]
    folder.write_bytes("report/index.html", page(f"{manifest['dataset']}: import", body))


def _tiles(manifest: dict[str, Any], rows: Sequence[dict[str, Any]]) -> str:
    counts = manifest["counts"]
    figures = [
        (f"{counts['assets']} / {manifest['num_assets']}", "assets usable"),
        (str(counts["failed_assets"]), "assets refused"),
        (str(sum(row["scale_source"] in ("given", "stated_size", "option") for row in rows)), "sizes given"),
        (str(sum(row["mass_source"] == "given" for row in rows)), "masses given"),
        (str(counts["textures"]), "textures"),
        (str(counts["copies"]), "copies of another asset's mesh"),
        (str(counts["warnings"]), "warnings"),
    ]
    return tiles(figures)


def _groups(rows: Sequence[dict[str, Any]]) -> Iterator[Sequence[dict[str, Any]]]:
    """Assets of similar size, for one picture each."""
    start = 0
    for end in range(1, len(rows) + 1):
        full = end - start == _PER_PICTURE
        if full or end == len(rows) or max(_size(rows[end])) > 4 * max(_size(rows[start])):
            yield rows[start:end]
            start = end


def _shown(rows: Sequence[dict[str, Any]], store: AssetStore) -> list[ShownScene]:
    names = ", ".join(f"{escape(row['asset_id'])} ({100 * max(_size(row)):.1f})" for row in rows)
    caption = f"From the left, longest side in cm: {names}. The last box has 10 cm a side."
    return [ShownScene(_line_up(rows, store), caption, size=(1024, 420))]


def _line_up(rows: Sequence[dict[str, Any]], store: AssetStore) -> Scene:
    """A scene with assets side by side in their first resting poses, then a box of 10 cm."""
    sizes = [*(_resting_size(row, store) for row in rows), (_RULER, _RULER, _RULER)]
    gap = _GAP * max(max(size[:2]) for size in sizes)
    depth = max(size[1] for size in sizes) + 2 * gap
    objects, x = [], gap
    for k, (width, _, height) in enumerate(sizes):
        row = rows[k] if k < len(rows) else None
        objects.append(
            SceneObject(
                f"{k}_{'box' if row is None else row['category'] or 'object'}",
                "box" if row is None else row["category"] or "object",
                (x + width / 2, depth / 2, height / 2),
                0.0,
                sizes[k],
                None if row is None else row["asset_id"],
                None if row is None else tuple(row["typical_scale"]),
                UPRIGHT if row is None else _tilt(row),
            )
        )
        x += width + gap
    return Scene("assets", Tabletop("office_table", (x, depth)), tuple(objects))


def _tilt(row: dict[str, Any]) -> QuatXyzw:
    found = row["resting_tilts"]
    x, y, z, w = found[0]["tilt_quat_xyzw"] if found else UPRIGHT
    return x, y, z, w


def _size(row: dict[str, Any]) -> Vec3:
    """The box of an asset's mesh, metres."""
    x, y, z = np.multiply(row["extents"], row["typical_scale"]).tolist()
    return x, y, z


def _resting_size(row: dict[str, Any], store: AssetStore) -> Vec3:
    """The box of an asset in its first resting pose, metres."""
    low, high = yaw_frame_box(store.asset(row["asset_id"]).mesh.vertices, tuple(row["typical_scale"]), _tilt(row))
    x, y, z = (high - low).tolist()
    return x, y, z


def _sources(rows: Sequence[dict[str, Any]]) -> Iterable[str]:
    """What the properties rest on."""
    shown = (
        ("size", "scale_source"),
        ("category", "category_source"),
        ("mass", "mass_source"),
        ("resting pose", "rest_source"),
        ("licence", "licence"),
    )
    yield "<h2>What it rests on</h2>"
    counts = [(name, Counter(str(row[column]) for row in rows)) for name, column in shown]
    yield table(("property", "source"), [(name, ", ".join(f"{k} {n}" for k, n in c.most_common(20))) for name, c in counts])


def _listed(rows: Sequence[dict[str, Any]]) -> Iterable[str]:
    """One line for each asset."""
    yield f"<h2>Assets ({len(rows)})</h2>"
    columns = ("asset", "category", "size, cm", "scale", "mass, g", "mass from", "rests by", "licence", "flags")
    lines = [
        (
            row["asset_id"],
            f"{row['category']} ({row['category_source']})",
            " x ".join(f"{100 * side:.1f}" for side in _size(row)),
            row["scale_source"] + ("" if row["scale_confidence"] in (None, 1.0) else f" {100 * row['scale_confidence']:.0f} %"),
            "" if row["mass"] is None else f"{1000 * row['mass']:.0f}",
            row["mass_source"],
            row["rest_source"],
            row["licence"] or "unknown",
            ", ".join(name for name in ("container", "static") if row[f"is_{name}"]),
        )
        for row in sorted(rows, key=lambda row: str(row["asset_id"]))[:_LISTED]
    ]
    yield table(columns, lines)
    if len(rows) > len(lines):
        yield f'<p class="note">{len(rows) - len(lines)} more rows are in the table assets.</p>'
