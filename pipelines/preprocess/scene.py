"""One scene: read, audited, related, tasked, staged; its rows."""

import hashlib
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace

from pipelines.execution.item_progress import ItemProgress
from stable_data.assets.store import AssetStore
from stable_data.errors import Notice
from stable_data.instructions import derive_task, task_rng
from stable_data.instructions.task_info import TaskWriter, model_task, resolve_task_objects
from stable_data.mesatask import TABLE_TYPES, MesaTaskDataset, PositionConvention
from stable_data.metrics.audit import Audit, PosedScene, audit_posed
from stable_data.metrics.card import MetricCard
from stable_data.scene import TABLE, FloatArray, RelationKind, Scene, Stage
from stable_data.scene_graph.relations import SceneGraph, relations_of, scene_graph, supports
from stable_data.scene_graph.staging import samples_of, stage_scene
from stable_data.storage import schemas

_CONTACT_GAP = 3e-3  # layouts are written to 1 mm, so what carries an object may be a little below it, metres


@dataclass(frozen=True, slots=True)
class SceneSettings:
    """What shapes the rows of a scene.

    Attributes:
        important_threshold: Objects nearer than this to a task object are O^B, metres.
        seed: For the choice among task templates and of splits.
        train_share: Share of near-duplicate groups in the training split.
        validation_share: Share in the validation split; the rest is the test split.
        position_convention: Which point of a tilted object the files call its position.
        tasks_per_scene: Tasks that ``samples`` has of a scene: its own, then others by template. (MesaTask trains on five.)
    """

    important_threshold: float = 0.02
    seed: int = 0
    train_share: float = 0.9
    validation_share: float = 0.05
    position_convention: PositionConvention = PositionConvention.BOX_CENTRE
    tasks_per_scene: int = 1


@dataclass(frozen=True, slots=True)
class SceneRows:
    """Rows of one scene, by table."""

    scene: schemas.Row
    samples: tuple[schemas.Row, ...]
    notices: tuple[Notice, ...]


@dataclass(frozen=True, slots=True, eq=False)
class PreparedScene:
    """A scene that was read, judged, related, tasked and staged.

    Attributes:
        scene: With supports, relations, task and stages.
        others: The same with other tasks and the stages that go with them.
        posed: Its meshes where they stand.
        audit: Every verdict.
        notices: What about it deserves a look.
    """

    scene: Scene
    others: tuple[Scene, ...]
    posed: PosedScene
    audit: Audit
    notices: tuple[Notice, ...]


def preprocess_scene(
    dataset: MesaTaskDataset,
    scene_id: str,
    store: AssetStore,
    settings: SceneSettings,
    progress: ItemProgress,
    writer: "CachedTaskWriter | None" = None,
) -> SceneRows:
    """Everything that preprocess makes of one scene; see :func:`understand`."""
    understood = understand(dataset, scene_id, store, settings, progress, writer)
    scene, audit = understood.scene, understood.audit
    origin = origin_of(dataset, scene, settings)
    row = {**schemas.scene_row(scene), **schemas.card_row(with_counts(audit.card(), scene)), **audit.rows(), **origin}
    samples = (sample for told in (scene, *understood.others) for sample in sample_rows(told, origin["split"]))
    return SceneRows(row, tuple(samples), understood.notices)


def sample_rows(scene: Scene, split: str) -> Iterator[schemas.Row]:
    """Rows of ``samples`` of a staged scene: one a stage."""
    row = schemas.scene_row(scene) | {"split": split}
    head = {k: row[k] for k in ("scene_id", "split", "table_type", "table_size", "restricted_zone", "task")}
    for sample in samples_of(scene):
        yield {
            **head,
            "stage": str(sample.stage),
            "objects_in": [schemas.object_row(o, with_source=False) for o in sample.objects_in],
            "objects_out": [schemas.object_row(o, with_source=False) for o in sample.objects_out],
        }


def other_tasks(scene: Scene, graph: SceneGraph, settings: SceneSettings) -> tuple[Scene, ...]:
    """A staged scene with the further tasks that the settings ask for, each said in other words than those before it."""
    told = {scene.task.task} if scene.task else set()
    others = []
    for k in range(1, settings.tasks_per_scene):
        task = derive_task(scene, graph, task_rng(f"{scene.scene_id}/{k}", settings.seed))
        if task.task not in told:
            told.add(task.task)
            others.append(stage_scene(replace(scene, task=task), settings.important_threshold))
    return tuple(others)


def understand(
    dataset: MesaTaskDataset,
    scene_id: str,
    store: AssetStore,
    settings: SceneSettings,
    progress: ItemProgress,
    writer: "CachedTaskWriter | None" = None,
) -> PreparedScene:
    """Reads a scene and finds out all that later steps ask of it.

    Args:
        dataset: Where it is.
        scene_id: Its id.
        store: Geometry of the assets.
        settings: What shapes the rows.
        progress: Is told of each step.
        writer: A model that writes task infos, where the user gives one.

    Raises:
        SceneError: The scene cannot be used.
    """
    progress.step = "read"
    scene, read = dataset.read(scene_id)
    progress.step = "mesh"
    scene, shapes, meshed = store.resolved(scene, settings.position_convention)
    progress.step = "audit"
    posed = PosedScene(scene, shapes)
    audit = audit_posed(posed)
    progress.step = "task"
    containers = {o.instance: dataset.annotation(o.asset_id).is_container if o.asset_id else None for o in scene.objects}
    seen = related(posed, audit, containers)
    scene, graph = seen.scene, seen.graph
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


def origin_of(dataset: MesaTaskDataset, scene: Scene, settings: SceneSettings) -> schemas.Row:
    """Columns of ``scenes`` that say where a scene comes from."""
    layout = dataset.layout_path(scene.scene_id)
    group = duplicate_group(scene)
    return {
        "source": dataset.root.name,
        "split": split_of(group, scene.table.table_type, settings),
        "layout_path": layout.relative_to(dataset.root).as_posix(),
        "layout_sha256": hashlib.sha256(layout.read_bytes()).hexdigest(),
        "duplicate_group": group,
    }


@dataclass(frozen=True, slots=True, eq=False)
class RelatedScene:
    """A scene whose objects' relations were read from its meshes.

    Attributes:
        scene: With supports and relations.
        graph: Its scene graph.
        contacts: What each object rests on.
        footprints: Of each object, as the graph takes them.
    """

    scene: Scene
    graph: SceneGraph
    contacts: Mapping[str, tuple[str, ...]]
    footprints: Mapping[str, FloatArray]


def related(posed: PosedScene, audit: Audit, containers: Mapping[str, bool | None]) -> RelatedScene:
    """The scene with supports and relations.

    Args:
        posed: The scene's meshes where they stand.
        audit: Its verdicts.
        containers: Whether things can be put into an object; None or missing where it is not known.
    """
    scene = posed.scene
    contacts = _contacts(posed, audit)
    footprints = {o.instance: s.posed_footprint(p) for o, s, p in zip(scene.objects, posed.shapes, scene.poses(), strict=True)}
    carriers = supports(scene, contacts, footprints, containers)
    scene = replace(scene, objects=tuple(replace(o, support=carriers[o.instance]) for o in scene.objects))
    graph = scene_graph(scene, contacts, footprints, containers)
    return RelatedScene(replace(scene, relations=relations_of(graph)), graph, contacts, footprints)


@dataclass(frozen=True, slots=True)
class CachedTaskWriter:
    """A model that writes task infos, and where its answers are kept.

    Attributes:
        write: The model.
        cache: Folder of its answers.
        name: Names the model in the cache's keys.
    """

    write: TaskWriter
    cache: str
    name: str


def _contacts(posed: PosedScene, audit: Audit) -> Mapping[str, tuple[str, ...]]:
    """What each object rests on: what the audit finds, and all that is within a larger gap.

    The table is found by the audit or it is not touched: the larger gap reaches through a placemat.
    """
    found = {}
    for index, verdict in enumerate(audit.objects):
        near = verdict.supports if verdict.supports == (TABLE,) else posed.supports(index, _CONTACT_GAP) or ()
        if verdict.supports and TABLE not in verdict.supports:
            near = tuple(name for name in near if name != TABLE)
        found[verdict.instance] = near
    return found


def with_counts(card: MetricCard, scene: Scene) -> MetricCard:
    """A card with what the scene graph and the stages say: what stands on other things and in them, and what is no task object."""
    stacked, contained = num_carried(scene)
    stages = [o.stage for o in scene.objects]
    away = None if not stages or None in stages else sum(stage is not Stage.TASK for stage in stages) / len(stages)
    return replace(card, num_stacked=stacked, num_contained=contained, distractor_rate=away)


def num_carried(scene: Scene) -> tuple[int, int]:
    """Objects on another one, and objects in another one."""
    names = {o.instance for o in scene.objects}
    contained = {r.subject for r in scene.relations if r.kind is RelationKind.IN and r.target in names}
    stacked = {r.subject for r in scene.relations if r.kind is RelationKind.ON and r.target in names}
    return len(stacked - contained), len(contained)


def duplicate_group(scene: Scene) -> str:
    """Scenes that may be near-duplicates share this: the same table type with the same assets, wherever they stand."""
    content = sorted(f"{o.category}:{o.asset_id}" for o in scene.objects)
    return hashlib.sha256("\n".join([scene.table.table_type, *content]).encode()).hexdigest()[:16]


def split_of(group: str, table_type: str, settings: SceneSettings) -> str:
    """The split of a near-duplicate group: a hash, so it stays when scenes are added.

    Kinds of table that MesaTask-10K does not have are kept from training: their split is ``unseen``.
    """
    if table_type not in TABLE_TYPES:
        return "unseen"
    share = int(hashlib.sha256(f"{settings.seed}:{group}".encode()).hexdigest()[:8], 16) / 2**32
    if share < settings.train_share:
        return "train"
    return "validation" if share < settings.train_share + settings.validation_share else "test"
