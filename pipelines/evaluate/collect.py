"""Reads what a system gave in one repetition from the runs of its scenes, pictures and ratings."""

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

from models.semantic_reasoner.engines.protocol import UNANSWERED
from pipelines.evaluate.figures import FIGURES, Repetition
from pipelines.generate.report import TimeSpent
from stable_data.diversity.comparison import SAMPLE, compare_sets
from stable_data.diversity.pictures import PictureSet
from stable_data.diversity.scene_set import SceneSet
from stable_data.errors import ConfigError
from stable_data.rating.criteria import KEYS
from stable_data.scene import Scene
from stable_data.scores.set_distance import FeatureStatistics, frechet_distance, kernel_distance, vendi_at
from stable_data.scores.taste import (
    LEAST,
    LEAST_TRAINING,
    POOLED,
    TrainingStatistics,
    compare_scenes,
    placement_ratio,
    read_scenes,
)
from stable_data.storage.row_groups import TableFiles
from stable_data.storage.run_folder import RunFolder
from stable_data.storage.schemas import SCHEMAS
from stable_data.totals import total

_CARD = [figure.key for figure in FIGURES if figure.key in SCHEMAS["scenes"].names]
_RATED = [*KEYS, "average", "quality_pass"]


@dataclass(frozen=True, slots=True, eq=False)
class Reference:
    """The pictures with which those of systems are compared.

    Attributes:
        pictures: The features of its pictures; None if they could not be drawn.
        table_types: Types of the tables of its scenes.
        training: What its scenes of the split train say.
        held_out: Its scenes of the splits validation and test.
    """

    pictures: PictureSet | None
    table_types: frozenset[str]
    training: TrainingStatistics
    held_out: tuple[Scene, ...]


def read_reference(run: str, views: str, where: str) -> Reference:
    """Reads the reference.

    Args:
        run: The run of its scenes.
        views: The run of their pictures; empty if they could not be drawn.
        where: The condition on its scenes.
    """
    pictures = PictureSet.read(views) if views else None
    held_out = tuple(read_scenes(run, ["validation", "test"], where))
    return Reference(pictures, table_types(run, where), TrainingStatistics(read_scenes(run, ["train"], where)), held_out)


def table_types(run: str, where: str) -> frozenset[str]:
    """Returns the types of the tables of a run's scenes.

    Args:
        run: The run.
        where: The condition on its scenes; empty: all.

    Raises:
        ConfigError: It is no run with scenes, none fulfils the condition, or the condition cannot be used.
    """
    types = TableFiles(run, "scenes", ["table_type"], where=where or None)
    found = {name for group in range(len(types.groups)) for name in types.read([group])["table_type"].to_pylist()}
    if not found:
        raise ConfigError(f"{run}: no scene to compare with, expected at least one; change reference_where", "source_empty")
    return frozenset(found)


@dataclass(frozen=True, slots=True)
class RunsOfSystem:
    """The runs of a system in one repetition.

    Attributes:
        scenes: The run of its scenes.
        views: The run of their pictures; empty if these could not be made as it was asked for.
        ratings: The run of their ratings; empty likewise.
        is_priced: Whether what the language model cost is known.
        is_foreign: Whether another system made its scenes, whose time and cost are not known.
        lost_pictures: Number of its scenes whose pictures could not be made.
    """

    scenes: str
    views: str = ""
    ratings: str = ""
    is_priced: bool = True
    is_foreign: bool = False
    lost_pictures: int = 0


def read_repetition(
    runs: RunsOfSystem, tasks: Sequence[str], reference: Reference | None, unlabelled: Collection[str] = ()
) -> tuple[Repetition, list[str]]:
    """Reads a repetition.

    Args:
        runs: Its runs.
        tasks: Ids of all tasks.
        unlabelled: Those without labels.
        reference: What its scenes are compared with; None: nothing.

    Returns:
        The repetition, whose diversity is not known yet, and notes on what is unknown.
    """
    scenes = RunFolder(runs.scenes)
    found = scenes.table("scenes", ["scene_id", "table_type", *_CARD]).to_pylist()
    rated = {}
    if runs.ratings and RunFolder(runs.ratings).shard_ids("ratings"):
        rows = RunFolder(runs.ratings).table("ratings", ["scene_id", *_RATED]).to_pylist()
        rated = {row["scene_id"]: row for row in rows}
    values, notes = _spent(scenes, len(tasks), runs), list[str]()
    unanswered = _unanswered(scenes)
    if unanswered:
        notes.append(
            f"{len(unanswered)} tasks are unknown: the endpoint did not answer, see the table failures; run again with another --out"
        )
    if reference is not None:
        if strange := sorted({row["table_type"] for row in found} - reference.table_types):
            notes.append(
                f"what is compared with the reference is unknown: it has no {', '.join(strange)}; choose another reference"
            )
        else:
            pictures, about = _picture_values(runs, reference)
            notes += about
            values |= pictures | _taste_values(runs.scenes, reference)
    made = {row["scene_id"]: figures_row(row, rated.get(row["scene_id"], {})) for row in found}
    return Repetition(tuple(tasks), made, values, frozenset(unlabelled), unanswered), notes


def _unanswered(scenes: RunFolder) -> frozenset[str]:
    if not scenes.shard_ids("failures"):
        return frozenset()
    rows = scenes.table("failures", ["id", "code"]).to_pylist()
    return frozenset(row["id"] for row in rows if row["code"] in UNANSWERED)


def figures_row(card: Mapping[str, Any], rating: Mapping[str, Any]) -> dict[str, Any]:
    """Returns the values of a scene that figures are means of.

    Args:
        card: Its columns of the table ``scenes``.
        rating: Those of its rating; empty without one.
    """
    verdicts = (card["clean"], card["stable"])
    ready = False if False in verdicts else None if None in verdicts else True
    rated = {key: rating.get(key) for key in _RATED}
    if rated["average"] is None:  # else the criteria and their average would be means over different scenes
        rated |= dict.fromkeys(KEYS)
    return {**card, **rated, "made": True, "ready": ready}


def _picture_values(runs: RunsOfSystem, reference: Reference) -> tuple[dict[str, float | None], list[str]]:
    """Distances of the pictures from the reference."""
    if reference.pictures is None or not _has_pictures(runs):
        return {}, []
    try:
        own = PictureSet.read(runs.views)
        if own.fingerprint != reference.pictures.fingerprint:
            return {}, ["distances of pictures are unknown: the features of the reference are others"]
        sets = own.features, reference.pictures.features
        return {"frechet": frechet_distance(*map(FeatureStatistics.of, sets)), "kernel": kernel_distance(*sets)}, []
    except ConfigError as error:
        return {}, [f"distances of pictures are unknown: {error}"]


def _has_pictures(runs: RunsOfSystem) -> bool:
    """Whether the pictures of all its scenes are there: a set without those that failed would be another one."""
    run = RunFolder(runs.views) if runs.views and not runs.lost_pictures else None
    return run is not None and bool(run.shard_ids("views")) and run.num_rows("views") > 0


def _taste_values(run: str, reference: Reference) -> dict[str, float | None]:
    """What occurs together and how it lies, compared with the reference."""
    found = compare_scenes(list(read_scenes(run, [])), reference.held_out, reference.training)[POOLED]
    pairs = found["pairs_unseen"]
    is_known = reference.training.num_scenes >= LEAST_TRAINING and pairs.num_generated >= LEAST
    return {"pairs_unseen": pairs.generated if is_known else None, "placement": placement_ratio(found)}


def _spent(scenes: RunFolder, num_tasks: int, runs: RunsOfSystem) -> dict[str, float | None]:
    """Time, tokens and cost for each task, whether it got a scene or not."""
    if runs.is_foreign:
        return dict.fromkeys(("processor_seconds", "seconds", "tokens", "cost"))
    spent = TimeSpent.of_run(scenes)
    turns = scenes.table("turns", ["prompt_tokens", "reply_tokens", "cost"]).to_pylist()
    tokens = total(turn[key] for turn in turns for key in ("prompt_tokens", "reply_tokens"))
    n, cost = max(1, num_tasks), total(turn["cost"] for turn in turns)
    return {
        "processor_seconds": None if spent.processor is None else spent.processor / n,
        "seconds": spent.seconds / n,
        "tokens": None if tokens is None else tokens / n,
        "cost": cost / n if cost is not None and (runs.is_priced or tokens == 0) else None,
    }


def set_diversity(repetitions: Sequence[tuple[Repetition, RunsOfSystem]]) -> tuple[list[Repetition], list[str]]:
    """Returns repetitions of systems on the same tasks with their Vendi scores, at one number of scenes for all.

    A set that is less than half as large as the largest one has no score, since it would make this number small for all.

    Args:
        repetitions: Each with its runs.

    Returns:
        The repetitions in the same order, and notes: the number of scenes, and what is unknown.
    """
    values: list[dict[str, float | None]] = [dict(one.values) for one, _ in repetitions]
    layouts = {k: SceneSet.read(runs.scenes) for k, (_, runs) in enumerate(repetitions)}
    compared = of_similar_size({k: len(one) for k, one in layouts.items()})
    notes = list[str]()
    if compared:
        for k, found in zip(compared, compare_sets([layouts[k] for k in compared]).sets, strict=True):
            values[k]["vendi_layouts"] = found.layouts
        notes.append(
            f"Vendi scores of layouts are of {min(SAMPLE, *(len(layouts[k]) for k in compared))} scenes of each system"
        )
    pictures = {k: PictureSet.read(runs.views) for k, (_, runs) in enumerate(repetitions) if _has_pictures(runs)}
    drawn = of_similar_size({k: len(one) for k, one in pictures.items()})
    for k in (k for k in pictures if k not in drawn and values[k].get("frechet") is not None):
        values[k]["frechet"] = None
        few = f"the Frechet distance (FID) of a system with {len(pictures[k])} pictures is unknown: others have over twice as many"
        notes.append(few)
    if len({one.fingerprint for one in pictures.values()}) > 1:
        notes.append("Vendi scores of pictures are unknown: the features of the systems are not the same")
    elif drawn:
        size = min(SAMPLE, *(len(pictures[k]) for k in drawn))
        for k in drawn:
            values[k]["vendi_pictures"] = vendi_at(pictures[k].features, size).mean
        notes.append(f"Vendi scores of pictures are of {size} scenes of each system, by {pictures[drawn[0]].extractor}")
    numbers = sorted({len(own) for k, own in pictures.items() if values[k].get("frechet") is not None})
    if len(numbers) > 1:
        notes.append(
            f"the Frechet distances (FID) of systems are of {numbers[0]} to {numbers[-1]} pictures, and that of fewer pictures is larger; "
            "compare kernel distances"
        )
    return [replace(one, values=value) for (one, _), value in zip(repetitions, values, strict=True)], notes


def of_similar_size(sizes: Mapping[int, int]) -> list[int]:
    """Returns the keys of the sets that have at least two scenes, and half as many as the largest one.

    Args:
        sizes: Key -> number of scenes.
    """
    return [k for k, size in sizes.items() if size > 1 and 2 * size >= max(sizes.values())]
