"""The layouts of the Semantic Reasoner before any correction, compared with the data itself.

``python -m benchmarks.reasoner RUN [--engine embedded] [--split test,unseen] [--scenes N] [--one-shot] [--json FILE]``. RUN is
the folder of a preprocess run with scenes of splits that training never saw; the reasoner gets only their instructions and
tables.

- answered: share of layouts in which all stages have an answer without a hard fault; at once: share of questions whose first
  answer had no fault at all. An answer that cannot be read or used counts as none; ``left`` counts the remaining soft faults.
- parsed, valid: share of all answers, including refused ones, that have the form of a layout; that also pass the checks;
- AwT, AwS: required objects present, and entailed relations that hold, by boxes; without an answer there are none;
- distractors: objects that are not task objects; objects: their number; on and in: carried by another object. Each is shown
  beside the figure of the data;
- OC, floats, off table: of raw layouts after each stage, by their meshes: the work of the corrector;
- unmatched: objects for which retrieval found no asset; they are left out of OC, with all that they carry.

Run with ``OMP_NUM_THREADS=1``.
"""

import json
import tempfile
import time
from collections import Counter
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from statistics import mean
from typing import Annotated, Any

import polars as pl
import typer
from tqdm import tqdm

from models.semantic_reasoner.engines.registry import EngineSettings
from models.semantic_reasoner.factory import ReasonerSettings, load_reasoner
from models.semantic_reasoner.reasoner import Proposal
from models.semantic_reasoner.staged_layout import ONE_SHOT, PROGRESSIVE, StagedLayout, staged_layouts, task_of_scene
from pipelines.sources.assets import AssetLibraries
from stable_data.assets.assignment import assign_assets
from stable_data.assets.run_assets import RunAssets
from stable_data.assets.store import AssetStore
from stable_data.metrics.alignment import align, reference_of
from stable_data.metrics.alignment_summary import AlignmentSummary, summarise_alignment
from stable_data.metrics.audit import PosedScene, audit_posed_scene
from stable_data.metrics.card import MetricCard
from stable_data.metrics.reply_validity import reply_validity
from stable_data.scene import Scene, SceneObject, Stage
from stable_data.storage.run_folder import RunFolder
from stable_data.storage.table_rows import scene_from_row

ORDER = {stage: n for n, stage in enumerate(Stage)}


def held_out(run: str, split: str, most: int) -> list[Scene]:
    """Returns scenes of a split, spread over its kinds of table, the same ones each time."""
    rows = pl.scan_parquet(f"{run}/scenes/*.parquet").filter(pl.col("split") == split).collect()
    if rows.is_empty():
        raise typer.BadParameter(f"{run}: no scenes of the split {split!r}, expected some; is it a preprocess run?")
    rows = rows.sort(pl.col("scene_id").str.extract(r"(\d+)$").cast(pl.Int64), "scene_id").head(most)
    return [scene_from_row(row) for row in rows.iter_rows(named=True)]


class AssetAssigner:
    """Assigns assets to the objects of raw layouts, and judges the layouts by their meshes.

    Args:
        run: A preprocess run with the assets.
        folder: Folder for its unpacked meshes.
    """

    def __init__(self, run: str, folder: Path) -> None:
        self._retriever = AssetLibraries([run]).retriever()
        self._store = AssetStore(RunAssets(RunFolder(run), folder))

    def assign(self, scenes: Sequence[Scene]) -> list[tuple[Scene, int]]:
        """Returns the scenes with assets, and the number of objects without one; these are left out, with all that they carry."""
        return [(f.scene, len(f.unmatched)) for f in assign_assets(scenes, self._retriever)]

    def card(self, scene: Scene) -> MetricCard:
        """Computes the exact verdicts."""
        _, shapes, _ = self._store.resolved(scene)
        return audit_posed_scene(PosedScene(scene, shapes)).card()


def up_to(objects: Sequence[SceneObject], stage: Stage) -> tuple[SceneObject, ...]:
    """Returns the objects of a stage and of the stages before it."""
    return tuple(o for o in objects if o.stage is not None and ORDER[o.stage] <= ORDER[stage])


def raw_figures(layouts: Sequence[StagedLayout], assigner: AssetAssigner) -> dict[str, Any]:
    """Computes verdicts of raw layouts after each stage, means over layouts with two or more objects, percent."""
    assigned = assigner.assign([layout.scene for layout in layouts])
    found: dict[str, Any] = {"unmatched": sum(n for _, n in assigned)}
    for stage in Stage:
        cards = [
            assigner.card(replace(scene, objects=objects))
            for scene, _ in tqdm(assigned, desc=f"audit {stage}", leave=False)
            if len(objects := up_to(scene.objects, stage)) > 1
        ]
        for key in ("oc", "float_rate", "out_of_bounds_rate"):
            values = [v for card in cards if (v := getattr(card, key)) is not None]
            found[f"{stage}_{key}"] = round(100 * mean(values), 2) if values else None
        found[f"{stage}_unknown"] = sum(card.oc is None for card in cards)
    return found


def figures(layouts: Sequence[StagedLayout], truth: Sequence[Scene], seconds: float) -> dict[str, Any]:
    """Computes the figures that need no meshes."""
    proposals = [p for layout in layouts for _, p in layout.proposals]
    summary = summarise_alignment([align(x.scene, reference_of(s)) for x, s in zip(layouts, truth, strict=True)])
    itself = summarise_alignment([align(s, reference_of(s)) for s in truth])
    return {
        "layouts": len(layouts),
        "answered": _percent(sum(layout.is_whole for layout in layouts), len(layouts)),
        "at_once": _percent(sum(not p.refused for p in proposals), len(proposals)),
        "tries": round(mean(p.tries for p in proposals), 3),
        **_validity(proposals),
        **_aligned(summary),
        **{f"data_{key}": value for key, value in _aligned(itself).items() if key in ("distractors", "objects", "on", "in")},
        "refused": dict(Counter(f.code for p in proposals for r in p.refused for f in r.faults).most_common()),
        "left": dict(Counter(f.code for p in proposals for f in p.faults).most_common()),
        "failures": dict(Counter(p.code for p in proposals if p.reply is None)),
        "layouts_a_minute": round(60 * len(layouts) / seconds, 1),
        "tokens_a_second": round(sum(p.reply_tokens or 0 for p in proposals) / seconds),
    }


def _validity(proposals: Sequence[Proposal]) -> dict[str, Any]:
    """Computes the shares of all answers, including refused ones, that parse and that pass the checks."""
    found = reply_validity(
        num_valid=sum(p.reply is not None and p.tries > len(p.refused) for p in proposals),
        invalid=(refused.faults[0].code for p in proposals for refused in p.refused),
        num_unknown=sum(p.reply is None and not p.refused for p in proposals),
    )
    malformed = sum(count for code, count in found.invalid if code.startswith("reply_"))
    parsed = found.num_replies - found.num_unknown - malformed
    return {"parsed": _percent(parsed, found.num_replies), "valid": _percent(found.num_valid, found.num_replies)}


def _aligned(s: AlignmentSummary) -> dict[str, Any]:
    return {
        "awt": _rounded(s.awt),
        "aws": _rounded(s.aws.micro),
        "aws_relations": s.aws.num_relations,
        "aws_graph": _rounded(s.aws_graph.micro),
        "distractors": _rounded(s.distractor_rate),
        "objects": None if s.num_objects is None else round(s.num_objects, 2),
        "on": None if s.num_stacked is None else round(s.num_stacked, 2),
        "in": None if s.num_contained is None else round(s.num_contained, 2),
    }


def _rounded(share: float | None) -> float | None:
    return None if share is None else round(100 * share, 2)


def _percent(part: int, whole: int) -> float | None:
    return round(100 * part / whole, 2) if whole else None


def main(
    run: Annotated[str, typer.Argument(help="Folder of a preprocess run.")],
    engine: Annotated[str, typer.Option(help="Which engine; see models/semantic_reasoner/engines/registry.py.")] = "embedded",
    split: Annotated[str, typer.Option(help="Splits, joined by commas.")] = "test,unseen",
    scenes: Annotated[int, typer.Option(help="Scenes of each split.")] = 200,
    one_shot: Annotated[bool, typer.Option("--one-shot", help="Request the whole layout at once.")] = False,
    temperature: Annotated[float, typer.Option(help="Temperature of the sampling.")] = 0.7,
    tries: Annotated[int, typer.Option(help="Largest number of tries of a question.")] = 4,
    seed: Annotated[int, typer.Option(help="Seed of the sampling.")] = 0,
    meshes: Annotated[bool, typer.Option(help="Retrieve assets and judge raw layouts by their meshes.")] = True,
    show: Annotated[int, typer.Option(help="Number of layouts with defects to describe.")] = 0,
    json_file: Annotated[Path | None, typer.Option("--json", help="File for the figures.")] = None,
) -> None:
    """Prints a table with one column for each split."""
    chosen = EngineSettings(engine)
    reasoner, interpret = load_reasoner(
        replace(chosen, sampling=replace(chosen.sampling, temperature=temperature)), ReasonerSettings(tries=tries)
    )
    found: dict[str, dict[str, Any]] = {}
    with tempfile.TemporaryDirectory() as folder:
        assigner = AssetAssigner(run, Path(folder)) if meshes else None
        for name in split.split(","):
            truth = held_out(run, name, scenes)
            began = time.perf_counter()
            seeds = range(seed * 1_000_003, seed * 1_000_003 + len(truth))
            layouts = staged_layouts(
                reasoner, [task_of_scene(s) for s in truth], seeds, ONE_SHOT if one_shot else PROGRESSIVE, interpret
            )
            found[name] = figures(layouts, truth, time.perf_counter() - began)
            if assigner is not None:
                found[name] |= raw_figures(layouts, assigner)
            for layout, scene in zip(layouts, truth, strict=True):
                aligned = align(layout.scene, reference_of(scene))
                if show > 0 and (aligned.missing or aligned.broken or not layout.is_whole):
                    show -= 1
                    failed = [p.failure for _, p in layout.proposals if p.failure]
                    print(f"{scene.task.task if scene.task else ''}\n    {aligned} {failed}")
    keys = list(dict.fromkeys(key for column in found.values() for key in column))
    print(f"{'':28}" + "".join(f"{name:>28}" for name in found))
    for key in keys:
        print(f"{key:28}" + "".join(f"{_shown(column.get(key)):>28}" for column in found.values()))
    if json_file is not None:
        document = {"engine": engine, "one_shot": one_shot, "temperature": temperature, "tries": tries, "splits": found}
        json_file.write_text(json.dumps(document, indent=2) + "\n", "utf-8")


def _shown(value: Any) -> str:
    if isinstance(value, dict):
        return ", ".join(f"{k} {v}" for k, v in list(value.items())[:2]) or "none"
    return "unknown" if value is None else str(value)


if __name__ == "__main__":
    typer.run(main)
