"""The evaluate job: systems on the same tasks, each generated, drawn and rated by the jobs of that name, then compared.

``OUT/seed_K/LABEL`` has the runs ``scenes``, ``views`` and ``ratings`` of one system in one repetition, and ``OUT/reference`` the pictures
of the reference. The ratings of another judge than the symbolic one are in ``ratings_JUDGE``. Each of these is a run of its own, with every
item exactly once; the same command continues after a stop, and further systems, repetitions or judges can be added later.
"""

import json
import re
import sys
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import replace
from typing import Any, TypeAlias

from models.picture_features.inception import InceptionFeatures
from models.scene_rating.judge import SYMBOLIC
from models.semantic_reasoner.staged_layout import LayoutTask
from pipelines.evaluate.collect import Reference, RunsOfSystem, read_reference, read_repetition, set_diversity, table_types
from pipelines.evaluate.evaluation import Evaluation, SystemResult, to_json
from pipelines.evaluate.figures import estimate_figures
from pipelines.evaluate.report import write_evaluation_report
from pipelines.evaluate.settings import EvaluateSettings
from pipelines.evaluate.systems import parse_systems
from pipelines.execution.ray_executor import WorkerPool, connection
from pipelines.generate.job import GenerateJob, run_generation
from pipelines.rate.job import rate
from pipelines.sources.generation_tasks import TaskSource
from pipelines.views.job import draw_views
from stable_data.errors import ConfigError
from stable_data.scores.taste import LEAST, LEAST_TRAINING
from stable_data.storage.manifest import DIGEST, manifest_digest
from stable_data.storage.run_folder import RunFolder
from stable_data.verification.evaluation_folder import EVALUATION

Tasks: TypeAlias = Callable[[int], TaskSource]
"""The tasks of a repetition, by its seed."""

_EMPTY = "source_empty"
_PAPER_VIEWS = ("none", 299, 299)
_ENOUGH = 10_000  # pictures from which FID hardly depends on their number


def evaluate(
    tasks: Tasks, out: str, settings: EvaluateSettings, workers: WorkerPool, assets: Sequence[str] = (), *, report: bool = True
) -> Evaluation:
    """Runs all systems in all repetitions, or what is missing, and writes ``evaluation.json`` and the report page.

    A system that cannot run, or whose pictures or ratings cannot be made, has a note and unknown figures; the others go on.

    Raises:
        ConfigError: The settings cannot be used, or the reference is no run with scenes.
    """
    results = [SystemResult(system, system.row(settings.generate)) for system in parse_systems(settings.systems)]
    seeds = [settings.generate.seed + k for k in range(settings.repetitions)]
    sources = {seed: tasks(seed) for seed in seeds}
    names = {"frechet": "Frechet distance", "kernel": "kernel distance", "judge": settings.rate.rating.judge}
    for result in results:
        if lacking := result.system.lacks(settings.generate):
            result.has_failed = (
                settings.systems != EvaluateSettings().systems
            )  # of all systems, those that can be run are enough
            result.note(f"not run: needs {lacking}")
        elif settings.repetitions > 1 and not result.system.is_repeated():
            result.note("its layouts are the same in each repetition, and are read once; {seed} in PLACE names those of each")
    with connection(workers):
        reference, notes = _reference(out, settings, workers)
        for seed in seeds:
            for result in results:
                if result.system.lacks(settings.generate) or (seed != seeds[0] and not result.system.is_repeated()):
                    continue
                place = f"{out.rstrip('/')}/seed_{seed}/{result.system.label}"
                _run_system(result, place, sources[seed], seed, settings, workers, assets, reference, names)
            done = [result for result in results if _has(result, seed)]
            changed, about = set_diversity([(result.repetitions[-1], result.runs[-1]) for result in done])
            for result, one in zip(done, changed, strict=True):
                result.repetitions[-1] = one
            notes += [note for note in about if note not in notes]
    notes += _what_more(names, settings)
    estimates = estimate_figures({result.system.label: result.repetitions for result in results})
    evaluation = Evaluation(out, len(sources[seeds[0]].tasks), tuple(results), estimates, names, tuple(notes))
    folder = RunFolder(out)
    document = to_json(evaluation)
    document[DIGEST] = manifest_digest(document)
    folder.write_bytes(EVALUATION, json.dumps(document, indent=2).encode() + b"\n")
    if report:
        write_evaluation_report(folder, evaluation, settings)
    return evaluation


def plan(tasks: Tasks, settings: EvaluateSettings, assets: Sequence[str] = ()) -> dict[str, Any]:
    """Describes what an evaluation would do, for ``--dry-run``.

    Raises:
        ConfigError: The settings or the tasks cannot be used, or the reference is no run with scenes.
    """
    seed, found = settings.generate.seed, {}
    if settings.reference:
        table_types(settings.reference, settings.reference_where)
    for system in parse_systems(settings.systems):
        lacking = system.lacks(settings.generate)
        if lacking:
            found[system.label] = f"not run: needs {lacking}"
            continue
        GenerateJob(tasks(seed), system.settings(settings.generate, seed), assets).inputs()
        found[system.label] = system.compared.about
    return {
        "job": "evaluate",
        "num_tasks": len(tasks(seed).tasks),
        "seeds": [seed + k for k in range(settings.repetitions)],
        "systems": found,
        "judge": settings.rate.rating.judge,
        "features": settings.views.resolved().features,
        "reference": settings.reference or None,
    }


def _has(result: SystemResult, seed: int) -> bool:
    return bool(result.runs) and result.runs[-1].scenes.endswith(f"/seed_{seed}/{result.system.label}/scenes")


def _what_more(names: Mapping[str, str], settings: EvaluateSettings) -> Iterator[str]:
    """Yields what has to be given for those of the paper's figures that others stand for."""
    if names["frechet"] != InceptionFeatures.distance_name:
        yield (
            f"{names['frechet']} is no FID: it needs Inception's weights, stable-data features --fetch inception, then another --out "
            "(docs/picture_distances.md)"
        )
    elif settings.reference and (views := settings.views) and (views.surroundings, views.width, views.height) != _PAPER_VIEWS:
        yield (
            f"FID is of pictures of {views.width} x {views.height} with surroundings={views.surroundings}; "
            "MesaTask's, which the paper follows, is of 299 x 299 on black: --set views.surroundings=none --set views.width=299 "
            "--set views.height=299, and another --out"
        )
    if names["judge"] == SYMBOLIC:
        yield (
            "the ratings are by rules, and not the paper's GPT-score: that needs a model that sees, --judge openai:MODEL with its key or "
            "address (docs/scene_rating.md)"
        )


def _reference(out: str, settings: EvaluateSettings, workers: WorkerPool) -> tuple[Reference | None, list[str]]:
    if not settings.reference:
        return None, ["distances from other scenes are unknown: give a run of scenes to compare with, --reference RUN"]
    place, notes, lost = settings.reference_pictures or f"{out.rstrip('/')}/reference", list[str](), 0
    try:
        manifest = draw_views(settings.reference, place, settings.views, workers, where=settings.reference_where)
        lost = manifest["counts"]["failures"]
    except ConfigError as error:  # a reference that is none is refused below
        place = ""
        notes.append(f"distances of pictures are unknown, the reference was not drawn: {error}")
    reference = read_reference(settings.reference, place, settings.reference_where)
    if reference.pictures is not None:
        about = f"the reference has {len(reference.pictures)} pictures" + (f"; {lost} could not be drawn" if lost else "")
        if len(reference.pictures) < _ENOUGH:
            about += f"; with fewer than {_ENOUGH:,} the Frechet distance (FID) is far too large, the kernel distance is not"
        notes.append(about)
    about = f"{reference.training.num_scenes} scenes of the split train and {len(reference.held_out)} of validation and test"
    notes.append(
        f"pairs of categories and placement are compared with {about} of the reference; pairs are unknown with fewer than "
        f"{LEAST_TRAINING} of train, placement with fewer than {2 * LEAST} held-out ones, and both with fewer than {LEAST} of a system"
    )
    return reference, notes


def _run_system(
    result: SystemResult,
    place: str,
    source: TaskSource,
    seed: int,
    settings: EvaluateSettings,
    workers: WorkerPool,
    assets: Sequence[str],
    reference: Reference | None,
    names: dict[str, str],
) -> None:
    """Generates, draws and rates, and adds a repetition to the result."""
    _say(f"{result.system.label}, seed {seed}")
    try:
        own = result.system.settings(settings.generate, seed)
        job = GenerateJob(source, own, assets)
        for notice in job.odd():
            result.note(notice.message)
        run_generation(job, f"{place}/scenes", workers)
    except ConfigError as error:
        result.has_failed = True
        result.note(f"seed {seed} was not run: {error}")
        return
    judge = settings.rate.rating.judge
    runs = RunsOfSystem(f"{place}/scenes", is_priced=own.engine.is_priced, is_foreign=own.layout == "files")
    for verb in ("pictures", "ratings"):
        try:
            if verb == "pictures":
                manifest = draw_views(runs.scenes, f"{place}/views", settings.views, workers)
                names |= {"frechet": manifest["distance"], "kernel": manifest["kernel_distance"]}
                runs = replace(runs, views=f"{place}/views")
            else:
                ratings = "ratings" if judge == SYMBOLIC else f"ratings_{re.sub(r'[^A-Za-z0-9.-]+', '_', judge)}"
                manifest = rate(runs.scenes, f"{place}/{ratings}", settings.rate, workers)
                runs = replace(runs, ratings=f"{place}/{ratings}")
        except ConfigError as error:
            if error.code != _EMPTY:  # without a scene there is nothing to draw
                result.has_failed = True
                result.note(f"seed {seed}: {verb} are unknown: {error}")
        else:
            if lost := manifest["counts"]["failures"]:
                result.has_failed = True
                result.note(f"seed {seed}: {verb} of {lost} scenes are unknown, see the table failures")
                runs = replace(runs, lost_pictures=lost) if verb == "pictures" else runs
            if codes := manifest["counts"].get("unknown_by_code"):
                result.has_failed = True
                told = ", ".join(f"{code} {n}" for code, n in codes.items())
                result.note(f"seed {seed}: some averages of ratings are unknown: {told} (docs/scene_rating.md)")
    # Drawn tasks have other names in the job, where they are limited to what the libraries serve.
    _add_repetition(result, job.tasks, runs, reference)


def _add_repetition(result: SystemResult, source: TaskSource, runs: RunsOfSystem, reference: Reference | None) -> None:
    """Reads what a system gave for the tasks of its run, and adds it to the result."""
    tasks, lost = source.tasks, [notice.item_id for notice in source.lost]
    labels = {task.scene_id: task.reference for task in tasks if isinstance(task, LayoutTask)}  # sampled ones have theirs later
    unlabelled = [name for name, one in labels.items() if one is None]
    if len(unlabelled) == len(tasks):  # then the invalid ones had none either
        unlabelled += lost
    repetition, found = read_repetition(runs, [*(task.scene_id for task in tasks), *lost], reference, unlabelled)
    if num := sum(one is not None and one.graph is None for one in labels.values()):
        found.append(f"AwS is unknown for {num} of {len(tasks)} tasks: their labels have no scene graph")
    if runs.is_foreign:
        found.append("its time, tokens and cost are those of the system that made its scenes, and are not known here")
    elif repetition.values["tokens"] is None:
        found.append("tokens and cost are unknown: the endpoint did not count the tokens of all replies (no usage)")
    elif repetition.values["cost"] is None:
        found.append("the cost is unknown: --set generate.engine.http.prompt_price and reply_price give prices")
    for text in found:
        result.note(text)
    result.repetitions.append(repetition)
    result.runs.append(runs)


def _say(text: str) -> None:
    with suppress(OSError):
        sys.stderr.write(f"{text}\n")
