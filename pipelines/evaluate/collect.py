"""Reads what a system gave in one repetition from the runs of its scenes, pictures and ratings."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from pipelines.evaluate.figures import FIGURES, Repetition
from pipelines.generate.report import core_seconds
from stable_data.diversity.comparison import SAMPLE, compare_sets
from stable_data.diversity.pictures import PictureSet
from stable_data.diversity.scene_set import SceneSet
from stable_data.errors import ConfigError
from stable_data.rating.criteria import KEYS
from stable_data.scene import Scene
from stable_data.scores.set_distance import FeatureStatistics, frechet_distance, kernel_distance, vendi_at
from stable_data.scores.taste import POOLED, TrainingScenes, compare_scenes, placement_ratio, read_scenes
from stable_data.storage.row_groups import TableFiles
from stable_data.storage.run_folder import RunFolder
from stable_data.storage.schemas import SCHEMAS

_CARD = [figure.key for figure in FIGURES if figure.key in SCHEMAS["scenes"].names]
_RATED = [*KEYS, "average", "quality_pass"]


@dataclass(frozen=True, slots=True, eq=False)
class Reference:
    """The pictures with which those of systems are compared.

    Attributes:
        pictures: The features of its pictures; None if they could not be drawn.
        table_types: Types of the tables.
        training: What its scenes of the split train say.
        held_out: Its scenes of the splits validation and test.
    """

    pictures: PictureSet | None
    table_types: frozenset[str]
    training: TrainingScenes
    held_out: tuple[Scene, ...]


def read_reference(run: str, views: str, where: str) -> Reference:
    """Reads the reference.

    Args:
        run: The run of its scenes.
        views: The run of their pictures; empty if they could not be drawn.
        where: The condition on its scenes.
    """
    types = TableFiles(run, "scenes", ["table_type"], where=where or None)
    names = {name for group in range(len(types.groups)) for name in types.read([group])["table_type"].to_pylist()}
    pictures = PictureSet.read(views) if views else None
    held_out = tuple(read_scenes(run, ["validation", "test"]))
    return Reference(pictures, frozenset(names), TrainingScenes(read_scenes(run, ["train"])), held_out)


def read_repetition(place: str, tasks: Sequence[str], reference: Reference | None) -> tuple[Repetition, list[str]]:
    """Reads a repetition.

    Args:
        place: The folder with its runs ``scenes``, ``views`` and ``ratings``; the last two may be missing.
        tasks: Ids of all tasks.
        reference: What its pictures are compared with; None: nothing.

    Returns:
        The repetition, whose diversity is not known yet, and notes on what is unknown.
    """
    scenes, ratings = RunFolder(f"{place}/scenes"), RunFolder(f"{place}/ratings")
    found = scenes.table("scenes", ["scene_id", "table_type", *_CARD]).to_pylist()
    rated = {}
    if ratings.shard_ids("ratings"):
        rated = {row["scene_id"]: row for row in ratings.table("ratings", ["scene_id", *_RATED]).to_pylist()}
    rows = {row["scene_id"]: _row(row, rated.get(row["scene_id"], {})) for row in found}
    values, notes = _picture_values(place, {row["table_type"] for row in found}, reference)
    values |= _taste_values(f"{place}/scenes", reference) | _spent(scenes, len(tasks))
    return Repetition(tuple(tasks), rows, values), notes


def _row(card: Mapping[str, Any], rating: Mapping[str, Any]) -> dict[str, Any]:
    verdicts = (card["clean"], card["stable"])
    ready = False if False in verdicts else None if None in verdicts else True
    return {**card, **{key: rating.get(key) for key in _RATED}, "made": True, "ready": ready}


def _picture_values(place: str, types: set[str], reference: Reference | None) -> tuple[dict[str, float | None], list[str]]:
    """Distances of the pictures from the reference."""
    if reference is None or reference.pictures is None or not RunFolder(f"{place}/views").shard_ids("views"):
        return {}, []
    if strange := sorted(types - reference.table_types):
        return {}, [f"distances of pictures are unknown: the reference has no {', '.join(strange)}; choose another one"]
    try:
        own = PictureSet.read(f"{place}/views")
        if own.fingerprint != reference.pictures.fingerprint:
            return {}, ["distances of pictures are unknown: the features of the reference are others"]
        sets = own.features, reference.pictures.features
        return {"frechet": frechet_distance(*map(FeatureStatistics.of, sets)), "kernel": kernel_distance(*sets)}, []
    except ConfigError as error:
        return {}, [f"distances of pictures are unknown: {error}"]


def _taste_values(run: str, reference: Reference | None) -> dict[str, float | None]:
    """What occurs together and how it lies, compared with the reference."""
    if reference is None or not reference.training.num_scenes or not reference.held_out:
        return {}
    found = compare_scenes(list(read_scenes(run, [])), reference.held_out, reference.training)[POOLED]
    return {"pairs_unseen": found["pairs_unseen"].generated, "placement": placement_ratio(found)}


def _spent(scenes: RunFolder, num_tasks: int) -> dict[str, float | None]:
    """Core seconds, tokens and cost for each task, whether it got a scene or not."""
    spent = core_seconds(scenes)
    seconds = sum(value for name, value in spent.items() if name != "scenes")
    turns = scenes.table("turns", ["prompt_tokens", "reply_tokens", "cost"]).to_pylist()
    tokens = sum((turn["prompt_tokens"] or 0) + (turn["reply_tokens"] or 0) for turn in turns)
    n = max(1, num_tasks)
    return {"core_seconds": seconds / n, "tokens": tokens / n, "cost": sum(turn["cost"] or 0.0 for turn in turns) / n}


def set_diversity(repetitions: Sequence[tuple[Repetition, str]]) -> list[Repetition]:
    """Returns repetitions of systems on the same tasks with their Vendi scores, at one number of scenes for all.

    Args:
        repetitions: Each with the folder of its runs.
    """
    filled = [k for k, (one, _) in enumerate(repetitions) if len(one.rows) > 1]
    values: list[dict[str, float | None]] = [dict(one.values) for one, _ in repetitions]
    if filled:
        sets = [SceneSet.read(f"{repetitions[k][1]}/scenes") for k in filled]
        for k, found in zip(filled, compare_sets(sets).sets, strict=True):
            values[k]["vendi_layouts"] = found.layouts
    drawn = [k for k in filled if RunFolder(f"{repetitions[k][1]}/views").num_rows("views") > 1]
    features = {k: PictureSet.read(f"{repetitions[k][1]}/views").features for k in drawn}
    size = min([SAMPLE, *(len(rows) for rows in features.values())])
    for k, rows in features.items():
        values[k]["vendi_pictures"] = vendi_at(rows, size).mean
    return [Repetition(one.tasks, one.rows, value) for (one, _), value in zip(repetitions, values, strict=True)]
