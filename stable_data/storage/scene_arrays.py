"""Scenes directly from the columns of the table ``scenes``, many at once.

Reading row by row spends most of its time on Python dictionaries and on parsing ``source_json``. This module avoids both: it
reads only the needed leaves and converts them column by column. It needs numpy only, so that a JAX or TensorFlow job can use
it; ``stable_data.storage.torch_dataset`` makes tensors from it.
"""

from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from itertools import pairwise
from typing import Any, TypeVar

import numpy as np
import numpy.typing as npt
import pyarrow as pa
import pyarrow.compute as pc

from stable_data.errors import ConfigError
from stable_data.limits import LIMITS, at_most
from stable_data.scene import FloatArray, IntArray, Relation, RelationKind, Scene, SceneObject, Stage, Tabletop
from stable_data.storage.schemas import OBJECT, TASK
from stable_data.storage.table_rows import ROW_ERRORS, surface_from_row, task_from_row

T = TypeVar("T")

_OBJECT_LEAVES = tuple(f"objects.list.element.{f.name}" for f in OBJECT if f.name != "source_json")
_TASK_LEAVES = tuple(f"task.{f.name}" for f in TASK if f.name != "source_json")
SCENE_LEAVES = (
    "scene_id",
    "table_type",
    "table_size",
    "restricted_zone",
    *_TASK_LEAVES,
    *_OBJECT_LEAVES,
    "relations",
    "fixed",
    "surface",
)
"""Leaves of ``scenes`` that :func:`scenes_from_table` needs, as Parquet names them."""

ARRAY_LEAVES = (
    "scene_id",
    "table_size",
    "task.task",
    *(
        f"objects.list.element.{name}"
        for name in ("instance", "asset_id", "position", "yaw", "size", "tilt_quat_xyzw", "stage")
    ),
)
"""Leaves of ``scenes`` that :meth:`SceneArrays.from_table` needs."""

_STAGE_INDEX: Mapping[str | None, int] = {None: -1, **{str(stage): index for index, stage in enumerate(Stage)}}
_STAGES: Mapping[str | None, Stage | None] = {None: None, **{str(stage): stage for stage in Stage}}
_KINDS = {str(kind): kind for kind in RelationKind}


def scenes_from_table(table: pa.Table) -> list[Scene]:
    """Returns the scenes of rows of ``scenes``, in order, without the ``source`` entries of the original files.

    The result equals that of :func:`stable_data.storage.table_rows.scene_from_row` on every row, except for ``source``, which
    that function includes; it takes several times as long.

    Args:
        table: Rows with at least SCENE_LEAVES.

    Raises:
        ConfigError: A value is missing or none of a scene (``rows_invalid``).
    """
    with naming_broken_rows():
        return _scenes(table)


@contextmanager
def naming_broken_rows() -> Iterator[None]:
    """Says of what fails in it that rows of ``scenes`` are not those of a job: a run may come from anywhere.

    Raises:
        ConfigError: A value is missing or none of a scene (``rows_invalid``).
    """
    try:
        yield
    except MemoryError:
        raise
    except (pa.ArrowException, *ROW_ERRORS) as error:
        reason = f"{type(error).__name__}: {error}"
        message = f"table scenes: rows cannot be used ({reason:.200}), expected what a job writes; make the run again"
        raise ConfigError(message, "rows_invalid") from error


def _scenes(table: pa.Table) -> list[Scene]:
    sizes, zones = map(tuple, _table_sizes(table).tolist()), _vectors(table["restricted_zone"], 4)
    surfaces = [surface_from_row(row) for row in table["surface"].to_pylist()]
    tables = map(Tabletop, _texts(table["table_type"]), sizes, zones, (clearance for _, clearance in surfaces))
    tasks = (task_from_row(None if task is None else {"source_json": None, **task}) for task in table["task"].to_pylist())
    if (most := pc.max(pc.list_value_length(table["objects"])).as_py() or 0) > LIMITS.table.max_objects:
        raise ValueError(f"a scene of {most:,} objects, expected {at_most(LIMITS.table, 'max_objects')}")
    objects = _split(_objects(_flat(table["objects"])), table["objects"])
    related = table["relations"]  # null in a run that was made before there were any
    relations = _split(_relations(related.combine_chunks().flatten()), related)
    heads = zip(_texts(table["scene_id"]), tables, objects, tasks, relations, strict=True)
    fixed = (frozenset(names or ()) for names in table["fixed"].to_pylist())
    return [Scene(*head, fixed=own, frame=frame) for head, own, (frame, _) in zip(heads, fixed, surfaces, strict=True)]


@dataclass(frozen=True, slots=True, eq=False)
class SceneArrays:
    """Scenes as arrays without padding: the M objects of all S scenes follow one another.

    Attributes:
        scene_ids: Identifiers, S.
        instructions: The instruction of each scene's task, or None, S.
        table_size: Table extents, (S, 2) float32, metres.
        counts: Number of objects of each scene, (S,) int64.
        instances: Names of the objects, M.
        asset_ids: Asset of each object, or None, M.
        poses: x, y, z in metres and yaw in radians, world frame, (M, 4) float32.
        size: Box in the yaw frame, (M, 3) float32, metres.
        tilt_quat_xyzw: Rotation before yaw, (M, 4) float32.
        stage: Index in ``Stage``, -1 if a scene has no stages, (M,) int64.
    """

    scene_ids: list[str]
    instructions: list[str | None]
    table_size: npt.NDArray[np.float32]
    counts: IntArray
    instances: list[str]
    asset_ids: list[str | None]
    poses: npt.NDArray[np.float32]
    size: npt.NDArray[np.float32]
    tilt_quat_xyzw: npt.NDArray[np.float32]
    stage: IntArray

    @classmethod
    def from_scenes(cls, scenes: Sequence[Scene]) -> "SceneArrays":
        """Returns the arrays of scenes."""
        objects = [o for scene in scenes for o in scene.objects]
        return cls(
            scene_ids=[scene.scene_id for scene in scenes],
            instructions=[None if scene.task is None else scene.task.task for scene in scenes],
            table_size=np.array([scene.table.size_xy for scene in scenes], np.float32).reshape(-1, 2),
            counts=np.array([len(scene.objects) for scene in scenes], np.int64),
            instances=[o.instance for o in objects],
            asset_ids=[o.asset_id for o in objects],
            poses=np.array([(*o.position, o.yaw) for o in objects], np.float32).reshape(-1, 4),
            size=np.array([o.size for o in objects], np.float32).reshape(-1, 3),
            tilt_quat_xyzw=np.array([o.tilt_quat_xyzw for o in objects], np.float32).reshape(-1, 4),
            stage=np.array([_STAGE_INDEX[o.stage] for o in objects], np.int64),
        )

    @classmethod
    def from_table(cls, table: pa.Table) -> "SceneArrays":
        """Returns the arrays of rows of ``scenes`` with at least ARRAY_LEAVES, equal to those of the scenes themselves.

        Raises:
            ConfigError: A value is missing or none of a scene (``rows_invalid``).
        """
        with naming_broken_rows():
            return cls._from_table(table)

    @classmethod
    def _from_table(cls, table: pa.Table) -> "SceneArrays":
        objects = _flat(table["objects"])
        position, yaw = _numbers(objects, "position", 3), _numbers(objects, "yaw", 1)
        return cls(
            scene_ids=_texts(table["scene_id"]),
            instructions=pc.struct_field(table["task"], "task").to_pylist(),
            table_size=_table_sizes(table).astype(np.float32),
            counts=_counts(table["objects"]),
            instances=_texts(pc.struct_field(objects, "instance")),
            asset_ids=pc.struct_field(objects, "asset_id").to_pylist(),
            poses=np.hstack([position, yaw]),
            size=_numbers(objects, "size", 3),
            tilt_quat_xyzw=_numbers(objects, "tilt_quat_xyzw", 4),
            stage=np.array([_STAGE_INDEX[stage] for stage in pc.struct_field(objects, "stage").to_pylist()], np.int64),
        )


def _given(column: Any) -> Any:
    """The column, which has no null: where it is flat, those that follow would belong to other rows."""
    if column.null_count:
        raise ValueError(f"{column.null_count} values of type {column.type!s:.50} are missing")
    return column


def _flat(column: pa.ChunkedArray) -> pa.Array:
    """Concatenates the elements of a list column."""
    return _given(column).combine_chunks().flatten()


def _counts(column: pa.ChunkedArray) -> IntArray:
    """Returns the number of elements of each list, 0 for null."""
    lengths: IntArray = pc.fill_null(pc.list_value_length(column), 0).to_numpy().astype(np.int64)
    return lengths


def _texts(column: Any) -> list[str]:
    """The texts of a column."""
    return list(_given(column).to_pylist())


def _finite(values: pa.Array) -> FloatArray:
    """Numbers as an array."""
    numbers: FloatArray = _given(values).to_numpy()
    if not np.isfinite(numbers).all():
        raise ValueError("a number is not finite")
    return numbers


def _table_sizes(table: pa.Table) -> FloatArray:
    """The extents of the tables, (S, 2)."""
    sizes = _finite(_flat(_of_length(table["table_size"], 2))).reshape(-1, 2)
    if not (sizes > 0).all():
        raise ValueError("a table has no extents")
    return sizes


def _split(items: Sequence[T], column: pa.ChunkedArray) -> Iterator[tuple[T, ...]]:
    """Groups the concatenated elements of a list column by row."""
    ends = np.cumsum(_counts(column)).tolist()
    return (tuple(items[start:end]) for start, end in pairwise([0, *ends]))


def _numbers(objects: pa.StructArray, name: str, width: int) -> npt.NDArray[np.float32]:
    """Returns a numeric field of every object, (M, width) float32."""
    values = _given(pc.struct_field(objects, name))
    flat = values if width == 1 else _of_length(values, width).flatten()
    return _finite(flat).astype(np.float32).reshape(-1, width)


def _of_length(column: Any, width: int) -> Any:
    """The column, whose lists have one length: another one would shift the numbers of all that follow."""
    if not pc.all(pc.equal(pc.list_value_length(column), width), min_count=0).as_py():
        raise ValueError(f"a list has another length than {width}")
    return column


def _vectors(column: pa.Array | pa.ChunkedArray, width: int) -> Iterator[Any]:
    """Yields lists of one length as tuples, and None for null."""
    array = column.combine_chunks() if isinstance(column, pa.ChunkedArray) else column
    whole = zip(*[iter(_finite(_of_length(array, width).flatten()).tolist())] * width, strict=True)
    return (next(whole) if valid else None for valid in column.is_valid().to_pylist())


def _objects(rows: pa.StructArray) -> list[SceneObject]:
    def given(name: str) -> pa.Array:
        return _given(pc.struct_field(rows, name))

    def values(name: str) -> list[Any]:
        return list(pc.struct_field(rows, name).to_pylist())

    # Positional, in the order of SceneObject's fields: keyword arguments would take a third of the time.
    columns = (
        _texts(given("instance")),
        _texts(given("category")),
        _vectors(given("position"), 3),
        _finite(given("yaw")).tolist(),
        _vectors(given("size"), 3),
        values("asset_id"),
        _vectors(pc.struct_field(rows, "scale"), 3),
        _vectors(given("tilt_quat_xyzw"), 4),
        _texts(given("description")),
        [_STAGES[stage] for stage in values("stage")],
        values("support"),
    )
    return list(map(SceneObject, *columns))


def _relations(rows: pa.StructArray) -> list[Relation]:
    subjects, kinds, targets = (pc.struct_field(rows, name).to_pylist() for name in ("subject", "kind", "target"))
    return [Relation(subject, _KINDS[kind], target) for subject, kind, target in zip(subjects, kinds, targets, strict=True)]
