"""The paper's rearrangement table: perturbed held-out scenes, put in order by the corrector's parts and by two learned rearrangers.

``python -m benchmarks.rearrangement RUN [--count 500] [--noise 0.1] [--seeds 3] [--method NAME ...] [--lego-net FILE]
[--struct-diffusion FILE] [--equal-flow FILE] [--flow FILE] [--split test ...] [--out FOLDER [--share K/N]] [--json FILE]``. RUN is a
preprocess run. Its clean scenes of the split ``test``, or of the named splits, are perturbed: Gaussian noise of one standard deviation
on x, y and z in metres and on yaw in radians, for every object by itself. FILE are weights of ``train-rearranger`` and
``train-corrector``; by default those of equal trainings in benchmarks/weights, and for ``flow`` those of the repository, which had a
longer training. A method without weights is not measured. ``--lego-steps`` and ``--diffusion-steps`` change the largest number of their
steps. With ``--out``, results are kept in FOLDER as they come, and a run that was stopped goes on; N processes with ``--share 1/N`` to
``N/N`` share the scenes, and the table is printed by the one that ends last, or by any later run.

The paper leaves open: the unit of the noise, taken as metres and radians; whether heights are perturbed too, which "translation" says
(``--plane`` leaves them); whether what carries what is known, which all methods are told here (``--infer``: they infer it from the
perturbed poses); whether the methods know the size of the noise (``--untold``: they do not); and the weight of a turn in the earth mover's
distance, here 0.1 m per radian. Objects may be off the table at the start.

All methods move the same objects, none may be dropped, and every result is judged by the exact audit. ``start`` is the perturbed layout.
``lego_net``, ``struct_diffusion`` and ``flow`` end with the same step that gives objects their exact heights by contact; with ``+ refine
+ certify``, the other parts of the corrector follow. Above the table stands how long and on what each network was trained.

- failed: scenes for which the method gave no layout; they count as they were at the start;
- unknown: scenes whose collisions by the paper's rule are not known; *OC sampled* leaves them out;
- moved, EMD: mean distance that objects moved, and earth mover's distance to the clean scene, metres, with identical objects matched, and
  with objects of the same category matched as in the paper;
- OC: colliding pairs as a share of all, deeper than 0.5 mm by exact meshes (unknown counts as colliding), and by the paper's rule, a
  sample of one surface inside the other; clean: share of scenes that are clean by the exact audit;
- s: seconds of a core for a scene, without what is prepared once for each asset.

A figure is the mean over the seeds of the means over the scenes, with half of the width of its 95 % interval over the seeds (Student's t).
The figures under *paper* are published, not measured here: on other scenes, with the authors' trainings.
"""

import json
import re
import time
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from hashlib import sha256
from pathlib import Path
from statistics import mean
from types import MappingProxyType
from typing import Annotated, Any

import numpy as np
import torch
import typer
from tqdm import tqdm

from benchmarks.correction import START, IdentityBaseline, judged
from benchmarks.corrector_parts import CorrectorParts, CorrectorTerms, SharedMover, corrector_parts
from benchmarks.layouts import StartLayout, held_out_scenes, noisy_layouts
from benchmarks.result_log import MeasuredLayout, ResultLog, Share
from models.baselines.outcome import Baseline
from models.physics_corrector.flow.checkpoint import DEFAULT_WEIGHTS as CORRECTOR
from models.physics_corrector.flow.expected_error import UNKNOWN_ERROR, ExpectedError
from models.physics_corrector.learned_flow import AUTO, NONE
from models.rearrangement.rearranger import open_rearranger
from models.rearrangement.settings import METHODS as REARRANGERS
from models.training.weights_file import read_notes
from pipelines.evaluate.published import REARRANGEMENT
from pipelines.reports.text_table import align_columns
from pipelines.sources.scenes import scene_source
from stable_data.assets.store import AssetStore
from stable_data.errors import ConfigError, StableDataError
from stable_data.scores.intervals import mean_text

PARTS = ("flow", "flow + refine", "flow + refine + certify", "certify")
"""The corrector's parts that are measured."""

REPAIR = " + refine + certify"
"""Ending of the name of a rearranger whose layouts the other parts of the corrector repair."""

EQUAL = "equal flow"
"""The flow after a training as long as those of the rearrangers."""

METHODS = (*(name + end for name in REARRANGERS for end in ("", REPAIR)), EQUAL, *PARTS)

WEIGHTS = Path(__file__).parent / "weights"
"""Weights of equal trainings."""

PUBLISHED: Mapping[str, tuple[float, float, float]] = MappingProxyType(
    {
        "lego_net": REARRANGEMENT["LEGO-Net"],
        "struct_diffusion": REARRANGEMENT["StructDiffusion"],
        "flow + refine + certify": REARRANGEMENT["Ours"],
    }
)
"""Distance moved, EMD and OC of the paper's table, by the methods that they belong to."""

NO_STEPS: Mapping[str, int] = MappingProxyType({})
"""The rearrangers take the steps of their weights."""

_SPLITS = ("test", "validation", "unseen")  # the choice of the shipped weights has seen `validation`
_FIGURES = ("moved", "moved_category", "emd", "emd_category", "oc", "oc_sampled", "clean", "seconds")
_HEAD = ("moved m", "by category", "EMD m", "by category", "OC", "OC sampled", "clean", "s", "paper: moved", "EMD", "OC")


@dataclass(frozen=True, slots=True)
class SeedFigures:
    """Means of one method over the scenes of one seed.

    Attributes:
        method: Name of the method.
        seed: Seed of the noise.
        scenes: Number of scenes.
        failed: Scenes for which it gave no layout.
        unknown: Scenes whose collisions by the paper's rule are not known; ``oc_sampled`` leaves them out.
        moved: Mean distance moved, identical objects matched, metres.
        moved_category: The same, objects of one category matched.
        emd: Earth mover's distance to the clean scene, identical objects matched, metres.
        emd_category: The same, objects of one category matched.
        oc: Share of pairs that collide deeper than 0.5 mm.
        oc_sampled: Share of pairs that collide by the paper's rule; None if it is not known of any scene.
        clean: Share of clean scenes.
        seconds: Mean seconds a scene.
    """

    method: str
    seed: int
    scenes: int
    failed: int
    unknown: int
    moved: float
    moved_category: float
    emd: float
    emd_category: float
    oc: float
    oc_sampled: float | None
    clean: float
    seconds: float


def figures_of(results: Sequence[MeasuredLayout]) -> list[SeedFigures]:
    """Returns the means of every method and seed, in the order of the results."""
    keys = dict.fromkeys((r.method, r.bucket) for r in results)
    return [_of_seed([r for r in results if (r.method, r.bucket) == key]) for key in keys]


def _of_seed(results: Sequence[MeasuredLayout]) -> SeedFigures:
    sampled = [r.oc_sdf for r in results if r.oc_sdf is not None]
    return SeedFigures(
        method=results[0].method,
        seed=int(results[0].bucket),
        scenes=len(results),
        failed=sum(r.failed for r in results),
        unknown=len(results) - len(sampled),
        moved=mean(r.move_mean_mm for r in results) / 1e3,
        moved_category=mean(r.move_category_mm for r in results) / 1e3,
        emd=mean(_known(r.emd_mm) for r in results) / 1e3,
        emd_category=mean(_known(r.emd_category_mm) for r in results) / 1e3,
        oc=mean(r.oc for r in results),
        oc_sampled=mean(sampled) if sampled else None,
        clean=mean(r.clean is True for r in results),
        seconds=mean(r.seconds for r in results),
    )


def _known(value: float | None) -> float:
    """A distance that every result has: all layouts have a target, and no object is dropped."""
    assert value is not None
    return value


def table(figures: Sequence[SeedFigures], methods: Sequence[str] = METHODS) -> str:
    """Returns a table of the means over the seeds, with the published figures beside them; ``-`` is not measured.

    Args:
        figures: The figures of methods and seeds.
        methods: The methods of the rows, after the start.
    """
    rows: list[tuple[str, ...]] = [("method", "scenes", "failed", "unknown", *_HEAD)]
    for method in (START, *methods):
        own = [f for f in figures if f.method == method]
        published = [f"{value:g}" for value in PUBLISHED[method]] if method in PUBLISHED else ["", "", ""]
        measured = [_written([getattr(f, name) for f in own], name) for name in _FIGURES]
        counts = [str(sum(getattr(f, name) for f in own)) if own else "-" for name in ("scenes", "failed", "unknown")]
        rows.append((method, *counts, *measured, *published))
    return align_columns(rows, 1)


def _written(values: Sequence[float | None], name: str) -> str:
    return mean_text(values, 2 if name == "seconds" else 3 if name == "clean" else 4) or "-"


def open_methods(
    wanted: Sequence[str], terms: CorrectorTerms, weights: Mapping[str, Path | None], steps: Mapping[str, int] = NO_STEPS
) -> tuple[dict[str, Baseline], list[str]]:
    """Loads the methods.

    Args:
        wanted: Names of METHODS; empty takes all that have weights.
        terms: What the methods are told, and the weights of the flow.
        weights: Rearranger or EQUAL -> its file.
        steps: Rearranger -> largest number of its steps; 0, or none, is that of its weights.

    Returns:
        The methods by name, in the order of METHODS; and those that are left out because they have no weights.

    Raises:
        ConfigError: A name is unknown or a wanted method has no weights (``usage``), or weights cannot be used.
    """
    if unknown := sorted(set(wanted) - set(METHODS)):
        raise ConfigError(f"--method {', '.join(unknown)}, expected of {', '.join(METHODS)}", "usage")
    chosen = [name for name in METHODS if not wanted or name in wanted]
    parts, found = corrector_parts(terms), dict[str, Baseline]()
    movers, left_out = dict[str, SharedMover](), list[str]()
    for mover in (*REARRANGERS, EQUAL):
        named, file = [name for name in chosen if name.removesuffix(REPAIR) == mover], weights.get(mover)
        if named and file is not None and mover == EQUAL:
            parts[EQUAL] = corrector_parts(replace(terms, weights=str(file)))["flow"]
        elif named and file is not None:
            movers[mover] = SharedMover(open_rearranger(file, steps.get(mover, 0), terms.error))
        elif named and wanted:
            option = _option(mover)
            raise ConfigError(f"--method {named[0]} has no weights, expected {option} FILE of train-rearranger", "usage")
        elif named:
            left_out.append(mover)
    for name in chosen:
        own, repairs = movers.get(name.removesuffix(REPAIR)), name.endswith(REPAIR)
        if name in parts:
            found[name] = parts[name]
        elif own is not None:
            found[name] = CorrectorParts(terms, flows=True, refines=repairs, certifies=repairs, mover=own)
    return found, left_out


def _option(mover: str) -> str:
    return "--" + re.sub("[_ ]", "-", mover)


def _own(name: str) -> Path | None:
    """The weights of this name in WEIGHTS, if there are any."""
    path = WEIGHTS / f"{name}.safetensors"
    return path if path.is_file() else None


def trained_on(files: Mapping[str, Path | None]) -> dict[str, dict[str, str | None]]:
    """Reads how long and on what networks were trained.

    Args:
        files: Name of a network -> its weights.

    Returns:
        Name -> the name of the file, its ``sha256``, and from its notes ``steps`` and ``data_fingerprint``; None where the notes lack one.

    Raises:
        ConfigError: A file cannot be read.
    """
    found = {}
    for name, file in files.items():
        if file is not None:
            notes = read_notes(file)
            noted = {key: notes.get(key) for key in ("steps", "data_fingerprint")}
            found[name] = {"file": file.name, "sha256": sha256(file.read_bytes()).hexdigest(), **noted}
    return found


def layouts_of(
    place: str, count: int, noise: float, seeds: int, splits: Sequence[str] = _SPLITS[:1], *, along_z: bool = True
) -> list[StartLayout]:
    """Makes the perturbed layouts of held-out scenes, scene after scene, each with all seeds.

    Raises:
        ConfigError: A split is not held out (``usage``), or the run has no clean scene of these splits (``set_empty``).
    """
    if unknown := sorted(set(splits) - set(_SPLITS)):
        raise ConfigError(f"--split {', '.join(unknown)}, expected of {', '.join(_SPLITS)}", "usage")
    scenes = held_out_scenes(place, count, splits)
    if not scenes:
        raise ConfigError(f"{place}: no clean scene of the split {' or '.join(splits)}, expected at least one", "set_empty")
    store = scene_source(place).store
    of_seed = [noisy_layouts(scenes, store, noise, seed, along_z=along_z) for seed in range(seeds)]
    return [layout for of_scene in zip(*of_seed, strict=True) for layout in of_scene]


def measure(
    layouts: Sequence[StartLayout], store: AssetStore, methods: Mapping[str, Baseline], log: ResultLog, limit: float = np.inf
) -> None:
    """Judges the layouts of the log's share, and each method on them, unless the log has the result already.

    Args:
        layouts: All layouts.
        store: Meshes of the assets.
        methods: Name -> method.
        log: Keeps the results.
        limit: Seconds after which no further layout is started; a started one is finished.
    """
    end, everyone = time.monotonic() + limit, {START: IdentityBaseline(), **methods}
    missing = [(one, name) for one in log.share.of_layouts(layouts) for name in everyone if log.known(name, one) is None]
    for layout, name in tqdm(missing, desc="rearrangement", unit="result", disable=None):
        if time.monotonic() > end and log.known(START, layout) is None:
            return
        log.add(judged(name, everyone[name], layout, store))


def main(
    place: Annotated[str, typer.Argument(metavar="RUN", help="A preprocess run.")],
    count: Annotated[int, typer.Option(min=1, help="Held-out scenes; the paper has 500.")] = 500,
    noise: Annotated[float, typer.Option(min=0.0, help="Standard deviation, metres and radians.")] = 0.1,
    seeds: Annotated[int, typer.Option(min=1, help="Repetitions with other noise.")] = 3,
    method: Annotated[list[str] | None, typer.Option(help=f"Of {', '.join(METHODS)}; all by default.")] = None,
    lego_net: Annotated[Path | None, typer.Option(help="Weights of lego_net; default: benchmarks/weights.")] = None,
    struct_diffusion: Annotated[Path | None, typer.Option(help="Weights of struct_diffusion; likewise.")] = None,
    equal_flow: Annotated[Path | None, typer.Option(help="Weights of the flow of an equal training; likewise.")] = None,
    lego_steps: Annotated[int, typer.Option(min=0, help="Largest number of steps of lego_net; 0: that of the weights.")] = 0,
    diffusion_steps: Annotated[int, typer.Option(min=0, help="The same of struct_diffusion.")] = 0,
    flow: Annotated[str, typer.Option(help="Weights of the flow; auto: those of the repository.")] = AUTO,
    split: Annotated[list[str] | None, typer.Option(help=f"Of {', '.join(_SPLITS)}; {_SPLITS[0]} by default.")] = None,
    is_plane: Annotated[bool, typer.Option("--plane", help="No noise along z.")] = False,
    infers: Annotated[bool, typer.Option("--infer", help="What carries what is inferred from the perturbed poses.")] = False,
    is_untold: Annotated[bool, typer.Option("--untold", help="The methods are not told the size of the noise.")] = False,
    limit: Annotated[float, typer.Option(help="Seconds after which no further layout is started.")] = np.inf,
    out: Annotated[Path | None, typer.Option(help="Folder in which results are kept, so that a stopped run goes on.")] = None,
    share: Annotated[str, typer.Option(metavar="K/N", help="The part of the scenes that this process measures.")] = "1/1",
    file: Annotated[Path | None, typer.Option("--json", help="File for the figures.")] = None,
) -> None:
    """Measures the methods on perturbed held-out scenes."""
    torch.set_num_threads(1)
    error = UNKNOWN_ERROR if is_untold or not noise else ExpectedError(noise, noise)
    terms = CorrectorTerms(flow, is_told=not infers, purpose="rearrange", error=error, keeps_all=True)
    try:
        weights = {
            "lego_net": lego_net or _own("lego_net"),
            "struct_diffusion": struct_diffusion or _own("struct_diffusion"),
            EQUAL: equal_flow or _own("flow"),
        }
        steps = {"lego_net": lego_steps, "struct_diffusion": diffusion_steps}
        methods, left_out = open_methods(method or (), terms, weights, steps)
        has_flow = flow != NONE and any(name.startswith("flow") for name in methods)
        used = {name: file for name, file in weights.items() if any(method.startswith(name) for method in methods)}
        networks = trained_on(used | ({"flow": CORRECTOR if flow == AUTO else Path(flow)} if has_flow else {}))
        asked: dict[str, Any] = {"noise": noise, "splits": split or _SPLITS[:1], "plane": is_plane, "infer": infers}
        asked |= {"untold": is_untold, "flow": flow, "steps": steps, "networks": networks}
        log = ResultLog(out, {"run": place, **asked}, Share.of(share))
        layouts = layouts_of(place, count, noise, seeds, split or _SPLITS[:1], along_z=not is_plane)
        measure(layouts, scene_source(place).store, methods, log, limit)
    except StableDataError as found:
        raise SystemExit(str(found)) from found
    every = [[log.known(name, layout) for name in (START, *methods)] for layout in layouts]
    results = [one for row in every if None not in row for one in row if one is not None]
    if len(results) < len(layouts) * (1 + len(methods)):
        print(
            f"{len(results)} of {len(layouts) * (1 + len(methods))} results are there; run again, with all shares, for the rest"
        )
        if not results or out is not None:
            return
    figures = figures_of(results)
    objects = sum(r.num_objects for r in results if r.method == START)
    print(
        f"{len(layouts)} layouts with {objects} objects, {seeds} seeds, noise {noise:g} along {'x, y' if is_plane else 'x, y, z'}"
    )
    for name, notes in networks.items():
        steps_done, data = (notes[key] or "unknown" for key in ("steps", "data_fingerprint"))
        print(f"{name}: {steps_done} steps in its last training, data {data}, {notes['file']}")
    for name in left_out:
        print(f"{name}: not measured, no weights ({_option(name)} FILE)")
    print("", table(figures, method or METHODS), sep="\n")
    if file is not None:
        document = _document(place, {"count": count, "seeds": seeds, **asked}, figures, results)
        file.write_text(json.dumps(document, indent=1) + "\n", "utf-8")


def _document(
    place: str, asked: Mapping[str, Any], figures: Sequence[SeedFigures], results: Sequence[MeasuredLayout]
) -> dict[str, Any]:
    """The figures as JSON: means, single results, and the published figures apart."""
    names = ("moved", "emd", "oc")
    return {
        "run": place,
        **asked,
        "figures": [asdict(f) for f in figures],
        "results": [asdict(r) for r in results],
        "published": {method: dict(zip(names, values, strict=True)) for method, values in PUBLISHED.items()},
    }


if __name__ == "__main__":
    typer.run(main)
