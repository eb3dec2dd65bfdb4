"""The report page of a generate run: accepted and rejected scenes, quality, time and cost; with pictures."""

import io
import json
import math
from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from functools import partial
from html import escape
from typing import Any

import numpy as np
import polars as pl
import pyarrow.compute as pc
from PIL import Image

from pipelines.generate.settings import GenerateSettings
from pipelines.generate.shard import KEPT, TIMING_FOLDER
from pipelines.reports.agreement import judge_agreement
from pipelines.reports.html import bars, head, histogram, notices, page, table, tiles
from pipelines.reports.reach import reach_figures
from pipelines.reports.scene_pictures import SceneGrids, ShownScene, draw_scene
from pipelines.sources.scenes import TableSource, mesh_cache
from stable_data.assets.run_assets import RunAssets
from stable_data.assets.store import AssetStore
from stable_data.diversity.comparison import compare_sets
from stable_data.diversity.scene_set import SceneSet
from stable_data.errors import ConfigError
from stable_data.simulation.render import contact_sheet
from stable_data.storage.run_folder import RunFolder
from stable_data.storage.table_rows import scene_from_row
from stable_data.totals import total

SHEET = "report/contact_sheet.png"
"""Contact sheet of the pictures."""

_AT_ONCE = 16  # small files that are read in parallel, because each read from an object store has a delay
_COLUMNS = 5
_SMALL = (384, 240)
_COMPARED = 5000  # scenes whose layouts are compared, because the time grows with their square
_MEASURES = (
    ("objects", "num_objects", 1.0, ""),
    ("stacked", "num_stacked", 1.0, ""),
    ("contained", "num_contained", 1.0, ""),
    ("required objects that are present (AwT)", "awt", 100.0, " %"),
    ("stated relations that hold (AwS)", "aws", 100.0, " %"),
    ("required objects as the instruction was read", "awt_understood", 100.0, " %"),
    ("stated relations as the instruction was read", "aws_understood", 100.0, " %"),
    ("distractor rate", "distractor_rate", 100.0, " %"),
    ("object collision (OC)", "oc", 100.0, " %"),
    ("floating", "float_rate", 100.0, " %"),
    ("mean move by the corrections", "move_mean_mm", 1.0, " mm"),
    ("largest move in MuJoCo", "settle_move_max_mm", 1.0, " mm"),
)


def write_generate_report(
    folder: RunFolder,
    manifest: dict[str, Any],
    settings: GenerateSettings,
    library: Mapping[str, str],
    sources: TableSource | None = None,
) -> None:
    """Writes ``report/index.html`` and the contact sheet.

    Args:
        folder: The run, with complete tables.
        manifest: Its manifest, with counts.
        settings: The job's settings.
        library: Category of each asset that the job may use, by its id.
        sources: The scenes that are varied, with the assets of all libraries, which are drawn beside their variants; None without
            variants.
    """
    columns = [column for _, column, _, _ in _MEASURES] + [
        "scene_id",
        "clean",
        "stable",
        "read_as_labelled",
        "table_type",
        "move_max_mm",
        "varied",
        "variant_of",
        "num_varied",
    ]
    scenes, rejected = (_frame(folder, name, columns) for name in ("scenes", "rejected"))
    spent, turns = (
        TimeSpent.of_run(folder),
        _frame(folder, "turns", ["stage", "tries", "prompt_tokens", "reply_tokens", "cost", "code"]),
    )
    store = AssetStore(RunAssets(folder, mesh_cache())) if sources is None else sources.store
    grids = SceneGrids(folder, store)
    body = [
        head(manifest),
        f'<p class="note">{escape(_system(manifest, settings))}. Accepted: {escape(settings.accept or "all")}.</p>',
        _tiles(manifest, scenes, turns, spent, settings),
        *_variants(scenes, rejected),
        *_quality(scenes, rejected),
        *judge_agreement(folder, ("scenes", "rejected"), settings.judge_names),
        *_diversity(folder, library),
        *reach_figures(folder, ("scenes", "rejected")),
        *_stages(folder, turns),
        *_time(spent),
        *_pictures(folder, scenes, "scenes", "Pictures", grids, settings.num_pictures, sources),
        *_pictures(folder, rejected, "rejected", "Rejected scenes", grids, settings.num_pictures // 4, sources),
        *notices(folder),
    ]
    folder.write_bytes("report/index.html", page(f"{manifest['dataset']}: generate", body))
    _write_sheet(folder, scenes, store, settings.num_pictures)


def _system(manifest: dict[str, Any], settings: GenerateSettings) -> str:
    """Who lays out, and what corrects when."""
    laid_out = f"Layout: {settings.layout}" + (f" ({settings.layout_files})" if settings.layout_files else "")
    weights = f" ({settings.weights})" if settings.corrector == "stable" else ""
    corrected = "none" if settings.corrects == "never" else f"{settings.corrector}{weights}, {settings.corrects}"
    return f"Reasoner: {manifest['engine']}. {laid_out}. Corrector: {corrected}"


def _frame(folder: RunFolder, name: str, columns: Sequence[str]) -> pl.DataFrame:
    frame = pl.from_arrow(folder.table(name, columns))
    assert isinstance(frame, pl.DataFrame)
    return frame


@dataclass(frozen=True, slots=True)
class TimeSpent:
    """What a run took, summed over its worker processes, without what starts them.

    Attributes:
        steps: Kind of work -> seconds on the clock, waits for a language model and for other processes included.
        processor: Seconds of the processor, without those of engines and correctors that workers share; None if a shard of an older
            release does not say.
        num_scenes: Scenes that it was spent on.
    """

    steps: Mapping[str, float]
    processor: float | None
    num_scenes: int

    @classmethod
    def of_run(cls, folder: RunFolder) -> "TimeSpent":
        """Reads what the shards of a run say."""
        steps, processor, num_scenes = Counter[str](), 0.0, 0
        files = [f"{TIMING_FOLDER}/{shard_id}.json" for shard_id in folder.shard_ids("scenes")]
        with ThreadPoolExecutor(_AT_ONCE) as pool:
            for content in pool.map(folder.read_bytes, files):
                found = json.loads(content) if content is not None else {}
                num_scenes += found.pop("scenes", 0)
                processor += found.pop("processor", math.nan)
                found.pop(KEPT, None)
                steps.update(found)
        return cls(dict(steps), None if math.isnan(processor) else processor, num_scenes)

    @property
    def seconds(self) -> float:
        """Seconds on the clock of all steps."""
        return sum(self.steps.values())


def _tiles(
    manifest: dict[str, Any], scenes: pl.DataFrame, turns: pl.DataFrame, spent: TimeSpent, settings: GenerateSettings
) -> str:
    counts, num_scenes = manifest["counts"], max(1, spent.num_scenes)
    at_work = sum(work["seconds"] for work in manifest["work"])
    pace = f"{60 * sum(work['scenes'] for work in manifest['work']) / at_work:.0f}" if at_work else "unknown"
    seconds = spent.seconds if spent.processor is None else spent.processor
    unit = "worker" if spent.processor is None else "core"
    accepted = max(1, scenes.height)
    asked, tokens = total(turns["cost"]), total([*turns["prompt_tokens"], *turns["reply_tokens"]])
    machine = seconds / 3600 / accepted * settings.core_hour_price
    cost = "unknown" if asked is None else f"{1000 * (asked / accepted + machine):.2f}" if asked + machine else "no price given"
    return tiles(
        [
            (f"{scenes.height} / {manifest['num_tasks']}", "scenes accepted"),
            (f"{counts['rejected']}", "scenes rejected"),
            (f"{counts['failed_scenes'] - counts['rejected']}", "tasks without a scene"),
            (pace, "scenes per minute"),
            (f"{seconds / num_scenes:.2f}", f"{unit} seconds per scene"),
            (f"{1000 * seconds / 3600 / accepted:.2f}", f"{unit} hours per 1,000 accepted scenes"),
            (cost, "cost per 1,000 accepted scenes"),
            ("unknown" if tokens is None else f"{tokens:,}", "prompt and reply tokens"),
            (str(counts["assets"]), "used assets"),
        ]
    )


def _variants(scenes: pl.DataFrame, rejected: pl.DataFrame) -> Iterable[str]:
    """How many variants of how many scenes were made on each axis, and how much of them differs."""
    made = pl.concat([scenes.with_columns(accepted=True), rejected.with_columns(accepted=False)])
    made = made.filter(pl.col("varied").is_not_null())
    if made.height:
        rows = []
        for (axis,), own in made.group_by("varied", maintain_order=True):
            kept = own.filter("accepted")
            share = kept.select(pl.col("num_varied") / pl.col("num_objects")).to_series()
            counts = (str(own.height), str(kept.height), str(kept["variant_of"].n_unique()))
            rows.append((str(axis), *counts, _mean(kept["num_varied"], 1.0, ""), _mean(share, 100.0, " %")))
        yield "<h2>Variants</h2>"
        yield table(
            ("axis", "made", "accepted", "scenes with an accepted one", "objects that differ", "share of the objects"), rows
        )


def _quality(scenes: pl.DataFrame, rejected: pl.DataFrame) -> Iterable[str]:
    made = pl.concat([scenes, rejected])
    yield "<h2>Quality</h2><p class=note>Means over scenes. OC, floating and bounds: exact audit of the meshes.</p>"
    rows = [
        (label, *(_mean(frame[column], factor, unit) for frame in (scenes, made))) for label, column, factor, unit in _MEASURES
    ]
    rows += [
        (label, *(_share(frame[column]) for frame in (scenes, made)))
        for label, column in (
            ("instructions read as their labels say", "read_as_labelled"),
            ("clean", "clean"),
            ("stable in MuJoCo", "stable"),
        )
    ]
    yield table(("", f"accepted, {scenes.height}", f"all scenes made, {made.height}"), rows)
    yield "<h2>Distributions of the accepted scenes</h2><div class=grid>"
    yield histogram("Objects per scene", scenes["num_objects"], [0, 4, 8, 12, 16, 20, 25, 30, 1000])
    yield histogram("Stacked objects per scene", scenes["num_stacked"], [0, 1, 2, 3, 5, 8, 1000])
    yield histogram("Contained objects per scene", scenes["num_contained"], [0, 1, 2, 3, 5, 8, 1000])
    yield histogram("Largest move by the corrections, mm", scenes["move_max_mm"], [0, 1e-9, 1, 3, 10, 30, 100, 10_000])
    yield histogram("Largest move in MuJoCo, mm", scenes["settle_move_max_mm"], [0, 0.1, 0.5, 1, 3, 10, 1000])
    yield bars("Table type", scenes["table_type"])
    yield "</div>"


def _diversity(folder: RunFolder, library: Mapping[str, str]) -> Iterable[str]:
    """How different the accepted scenes are from each other, and how much of the library they use."""
    scenes = replace(SceneSet.read(folder.uri, limit=_COMPARED), library=library)
    if len(scenes):
        [found] = compare_sets([scenes]).sets
        drawn = f", drawn of {found.num_all}" if found.num_all > len(scenes) else ""
        yield f"<h2>Diversity</h2><p class=note>{found.num_scenes} accepted scenes{drawn}; stable-data diversity says more.</p>"
        yield f"<pre>{escape(chr(10).join(found.lines()))}</pre>"


def _stages(folder: RunFolder, turns: pl.DataFrame) -> Iterable[str]:
    """The proposals of each stage and their outcomes."""
    cards = [_cards(folder, column) for column in ("card_before", "card_after")]
    rows = []
    for stage in turns["stage"].unique(maintain_order=True).to_list():
        own = turns.filter(pl.col("stage") == stage)
        before_after = [card.filter(pl.col("stage") == stage) for card in cards]
        rows.append(
            (
                stage,
                str(own.height),
                _mean(own["tries"], 1.0, ""),
                *(_mean(card["oc"], 100.0, " %") if card.height else "unknown" for card in before_after),
                *(_share(card["clean"]) if card.height else "unknown" for card in before_after),
            )
        )
    yield "<h2>Stages</h2>"
    yield table(
        ("stage", "turns", "replies per turn", "OC proposed", "OC corrected", "clean proposed", "clean corrected"), rows
    )
    if (codes := turns["code"].filter(turns["code"] != "")).len():
        yield bars("Refused turns by reason", codes)


def _cards(folder: RunFolder, column: str) -> pl.DataFrame:
    """One column of the cards of turns that have a card; turns are many, so other columns are not read."""
    wanted = {"stage": pc.field("stage")} | {key: pc.field(column, key) for key in ("num_objects", "oc", "clean")}
    frame = pl.from_arrow(folder.table("turns", wanted))
    assert isinstance(frame, pl.DataFrame)
    return frame.filter(pl.col("num_objects").is_not_null())  # always known if there is a card


def _time(spent: TimeSpent) -> Iterable[str]:
    if spent.num_scenes:
        steps = [(name, f"{seconds / spent.num_scenes:.3f}") for name, seconds in spent.steps.items()]
        yield "<h2>Time</h2>" + table(("step", "seconds of one process per scene"), steps)


def _chosen(scenes: pl.DataFrame, count: int) -> list[str]:
    """An evenly spaced choice of scene ids."""
    names = sorted(scenes["scene_id"].to_list())
    return [names[k] for k in np.unique(np.linspace(0, len(names) - 1, min(count, len(names))).astype(int))] if names else []


def _pictures(
    folder: RunFolder,
    scenes: pl.DataFrame,
    name: str,
    title: str,
    grids: SceneGrids,
    count: int,
    sources: TableSource | None = None,
) -> Iterable[str]:
    if not (chosen := _chosen(scenes, count)):
        return
    rows = {row["scene_id"]: row for row in folder.table(name, where=pc.field("scene_id").isin(chosen)).to_pylist()}
    yield f"<h2>{title}</h2>"
    yield "" if sources is None else "<p class=note>Left: the scene that is varied. Right: the variant.</p>"
    yield from grids.grid((scene_id, partial(_shown, rows[scene_id], sources)) for scene_id in chosen)


def _shown(row: dict[str, Any], sources: TableSource | None = None) -> list[ShownScene]:
    said = escape(row["task"]["task"]) if row["task"] else ""
    why = f'<br><span class="bad">{escape(row["reason"])}</span>' if row.get("reason") else ""
    shown = ShownScene(scene_from_row(row), f"<b>{escape(row['scene_id'])}</b><br>{said}{why}", row=row)
    if sources is None:
        return [shown]
    was = sources.row(row["variant_of"])
    asked = escape(was["task"]["task"]) if was["task"] else ""
    before = ShownScene(scene_from_row(was), f"<b>{escape(was['scene_id'])}</b><br>{asked}", "source", was)
    return [before, replace(shown, title="variant")]


def _write_sheet(folder: RunFolder, scenes: pl.DataFrame, store: AssetStore, count: int) -> None:
    if not (chosen := _chosen(scenes, count)):
        return
    rows = {row["scene_id"]: row for row in folder.table("scenes", where=pc.field("scene_id").isin(chosen)).to_pylist()}
    try:
        images = [np.asarray(Image.fromarray(draw_scene(scene_from_row(rows[name]), store)).resize(_SMALL)) for name in chosen]
    except ConfigError:  # this machine cannot render, as the page states
        return
    stream = io.BytesIO()
    Image.fromarray(contact_sheet(images, chosen, _COLUMNS)).save(stream, "png")
    folder.write_bytes(SHEET, stream.getvalue())


def _mean(values: pl.Series, factor: float, unit: str) -> str:
    known = values.drop_nulls()
    unknown = f" ({values.null_count()} unknown)" if values.null_count() else ""
    return f"{factor * float(known.mean()):.2f}{unit}{unknown}" if len(known) else "unknown"  # type: ignore[arg-type]


def _share(values: pl.Series) -> str:
    unknown = values.null_count()
    share = f"{100 * values.sum() / len(values):.1f} %" if len(values) else "none"
    return share + (f", {unknown} unknown" if unknown else "")
