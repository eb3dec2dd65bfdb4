"""The rows of one scene: it is read, audited, related, and given a task and stages."""

import hashlib
from collections.abc import Iterator
from dataclasses import dataclass, replace

from pipelines.execution.item_progress import ItemProgress
from stable_data.assets.store import AssetStore
from stable_data.errors import Notice
from stable_data.instructions.deriving import derive_task, task_rng
from stable_data.instructions.task_info import TaskWriter, model_task, resolve_task_objects
from stable_data.json_text import as_text
from stable_data.mesatask import MesaTaskDataset, PositionConvention
from stable_data.mesatask.dataset_split import SplitShares, split_of
from stable_data.mesatask.near_duplicates import duplicate_group
from stable_data.metrics.audit import PosedScene, audit_posed_scene
from stable_data.metrics.card import add_counts
from stable_data.metrics.related_scene import relate_scene
from stable_data.metrics.sampled_collision import add_sampled_collisions
from stable_data.metrics.verdicts import Audit
from stable_data.scene import Scene
from stable_data.scene_graph.relations import SceneGraph
from stable_data.scene_graph.stage_samples import samples_of
from stable_data.scene_graph.staging import stage_scene
from stable_data.storage import schemas
from stable_data.storage.table_rows import card_row, object_row, scene_row


@dataclass(frozen=True, slots=True)
class SceneSettings:
    """Settings that the rows of a scene depend on.

    Attributes:
        important_threshold: Objects nearer than this to a task object are O^B, metres.
        seed: For the choice among task templates and for the split.
        train_share: Share of near-duplicate groups in the training split.
        validation_share: Share in the validation split; the rest is the test split.
        position_convention: The point of a tilted object that the files use as its position.
        tasks_per_scene: Number of tasks of a scene in ``samples``: its own, then others from templates. (MesaTask trains on five.)
    """

    important_threshold: float = 0.02
    seed: int = 0
    train_share: float = 0.9
    validation_share: float = 0.05
    position_convention: PositionConvention = PositionConvention.BOX_CENTRE
    tasks_per_scene: int = 1


@dataclass(frozen=True, slots=True)
class SceneRows:
    """The rows of one scene, by table."""

    scene: schemas.Row
    samples: tuple[schemas.Row, ...]
    notices: tuple[Notice, ...]


@dataclass(frozen=True, slots=True, eq=False)
class PreparedScene:
    """A scene with all that its rows are computed from.

    Attributes:
        scene: With supports, relations, task and stages.
        others: The same scene with other tasks and their stages.
        posed: Its meshes at their poses.
        audit: Its audit.
        notices: Warnings about it.
    """

    scene: Scene
    others: tuple[Scene, ...]
    posed: PosedScene
    audit: Audit
    notices: tuple[Notice, ...]


@dataclass(frozen=True, slots=True)
class CachedTaskWriter:
    """A model that writes task infos, and the cache of its answers.

    Attributes:
        write: The model.
        cache: Folder of its answers.
        name: Name of the model in the keys of the cache.
    """

    write: TaskWriter
    cache: str
    name: str


def preprocess_scene(
    dataset: MesaTaskDataset,
    scene_id: str,
    store: AssetStore,
    settings: SceneSettings,
    progress: ItemProgress,
    writer: CachedTaskWriter | None = None,
) -> SceneRows:
    """The rows of one scene; the arguments are those of :func:`prepare_scene`."""
    prepared = prepare_scene(dataset, scene_id, store, settings, progress, writer)
    scene, audit = prepared.scene, prepared.audit
    origin = origin_of(dataset, scene, settings)
    card = add_sampled_collisions(add_counts(audit.card(), scene), scene, prepared.posed.shapes, audit)
    row = {**scene_row(scene), **card_row(card), **audit.rows(), **origin}
    samples = (sample for one in (scene, *prepared.others) for sample in sample_rows(one, origin["split"]))
    return SceneRows(row, tuple(samples), prepared.notices)


def prepare_scene(
    dataset: MesaTaskDataset,
    scene_id: str,
    store: AssetStore,
    settings: SceneSettings,
    progress: ItemProgress,
    writer: CachedTaskWriter | None = None,
) -> PreparedScene:
    """Reads a scene, audits it, derives its relations, and gives it a task and stages.

    Args:
        dataset: The dataset of the scene.
        scene_id: Its id.
        store: The geometry of the assets.
        settings: Settings that shape the rows.
        progress: Receives the name of each step.
        writer: A model that writes the task info of a scene without one, or None to fill a template.

    Raises:
        SceneError: The scene cannot be used.
    """
    progress.step = "read"
    scene, read = dataset.read(scene_id)
    progress.step = "mesh"
    scene, shapes, meshed = store.resolved(scene, settings.position_convention)
    progress.step = "audit"
    posed = PosedScene(scene, shapes)
    audit = audit_posed_scene(posed)
    progress.step = "task"
    containers = {o.instance: dataset.annotation(o.asset_id).is_container if o.asset_id else None for o in scene.objects}
    related = relate_scene(posed, audit, containers)
    scene, graph = related.scene, related.graph
    notices: tuple[Notice, ...] = ()
    if scene.task is not None:
        task, notices = resolve_task_objects(scene.task, scene, graph)
    elif writer is not None:
        task, notices = model_task(scene, graph, writer.write, writer.cache, writer.name, settings.seed)
    else:
        task = derive_task(scene, graph, task_rng(scene.scene_id, settings.seed))
    progress.step = "stage"
    scene = stage_scene(replace(scene, task=task), settings.important_threshold)
    return PreparedScene(scene, other_tasks(scene, graph, settings), posed, audit, (*read, *meshed, *audit.notices, *notices))


def other_tasks(scene: Scene, graph: SceneGraph, settings: SceneSettings) -> tuple[Scene, ...]:
    """Copies of a staged scene with further tasks, as many as the settings request; all instructions differ."""
    instructions = {scene.task.task} if scene.task else set()
    others = []
    for k in range(1, settings.tasks_per_scene):
        task = derive_task(scene, graph, task_rng(f"{scene.scene_id}/{k}", settings.seed))
        if task.task not in instructions:
            instructions.add(task.task)
            others.append(stage_scene(replace(scene, task=task), settings.important_threshold))
    return tuple(others)


def sample_rows(scene: Scene, split: str) -> Iterator[schemas.Row]:
    """The rows of ``samples`` of a staged scene, one for each stage."""
    row = scene_row(scene) | {"split": split}
    head = {k: row[k] for k in ("scene_id", "split", "table_type", "table_size", "restricted_zone", "task")}
    for sample in samples_of(scene):
        yield {
            **head,
            "stage": str(sample.stage),
            "objects_in": [object_row(o, with_source=False) for o in sample.objects_in],
            "objects_out": [object_row(o, with_source=False) for o in sample.objects_out],
        }


def origin_of(dataset: MesaTaskDataset, scene: Scene, settings: SceneSettings) -> schemas.Row:
    """The columns of ``scenes`` that state the file and the split of a scene."""
    layout = dataset.layout_path(scene.scene_id)
    group = duplicate_group(scene)
    shares = SplitShares(settings.seed, settings.train_share, settings.validation_share)
    return {
        "source": dataset.root.name,
        "split": split_of(group, scene.table.table_type, shares),
        "layout_path": as_text(layout.relative_to(dataset.root).as_posix()),
        "layout_sha256": hashlib.sha256(layout.read_bytes()).hexdigest(),
        "duplicate_group": group,
    }
