"""What is compared of the scenes of a run: table, categories, assets, places and split."""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
import pyarrow as pa

from stable_data.assets.catalog import library_of_run
from stable_data.diversity.layout_similarity import SceneLayouts
from stable_data.errors import ConfigError
from stable_data.scene import FloatArray, Scene
from stable_data.storage.manifest import read_manifest
from stable_data.storage.row_groups import TableFiles
from stable_data.storage.run_folder import RunFolder
from stable_data.storage.scene_arrays import naming_broken_rows

_OBJECT = "objects.list.element"
_LEAVES = (
    "scene_id",
    "split",
    "table_type",
    "table_size",
    "fixed",
    *(f"{_OBJECT}.{name}" for name in ("instance", "category", "asset_id", "position")),
)


@dataclass(frozen=True, slots=True, eq=False)
class ComparedScene:
    """One scene, without the objects of its surroundings.

    Attributes:
        scene_id: Its identifier.
        split: Its split; None if it has none.
        table_type: Type of its table.
        table_size: Width and depth of the table, metres.
        categories: Category of each object, N.
        assets: Asset of each object, or None, N.
        positions: Centre of each object in the frame of the scene, (N, 3), metres.
    """

    scene_id: str
    split: str | None
    table_type: str
    table_size: tuple[float, float]
    categories: tuple[str, ...]
    assets: tuple[str | None, ...]
    positions: FloatArray

    @classmethod
    def of(cls, scene: Scene, split: str | None = None) -> "ComparedScene":
        """What is compared of a scene."""
        objects, table = scene.movable, scene.table
        categories, assets = tuple(o.category for o in objects), tuple(o.asset_id for o in objects)
        positions = np.array([o.position for o in objects], np.float64).reshape(-1, 3)
        return cls(scene.scene_id, split, table.table_type, table.size_xy, categories, assets, positions)


@dataclass(frozen=True, slots=True, eq=False)
class SceneSet:
    """Some scenes of a run.

    Attributes:
        name: The run.
        scenes: The scenes.
        num_all: Number of scenes from which these were drawn.
        library: Category of each asset that scenes may use, by its id; empty if it has none. None if the library is not known.
    """

    name: str
    scenes: tuple[ComparedScene, ...]
    num_all: int
    library: Mapping[str, str] | None = None

    @classmethod
    def read(cls, uri: str, *, where: str | None = None, limit: int = 0, seed: int = 0) -> "SceneSet":
        """Reads scenes of a run, a row group at a time.

        Args:
            uri: The run's folder or URI, with the table ``scenes``.
            where: A condition on ``scenes``; None: all.
            limit: Most scenes; of more, so many are drawn. 0: all.
            seed: Decides which are drawn.

        Raises:
            ConfigError: The table is missing or cannot be read, a row is none of a scene (``rows_invalid``), or ``where`` is no
                condition.
        """
        files = TableFiles(uri, "scenes", _LEAVES, where=where)
        total = len(files)
        chosen = np.arange(total)
        if limit and total > limit:
            chosen = np.sort(np.random.default_rng(seed).choice(total, limit, replace=False))
        scenes = list[ComparedScene]()
        for group, start in enumerate(files.starts[:-1].tolist()):
            own = chosen[(chosen >= start) & (chosen < files.starts[group + 1])] - start
            if len(own):
                rows = files.read([group]).take(own)
                with naming_broken_rows():
                    scenes += _compared(rows)
        return cls(uri, tuple(scenes), total)

    def __len__(self) -> int:
        """Number of scenes that were read."""
        return len(self.scenes)


def whole_library(uri: str) -> dict[str, str] | None:
    """Category of each asset that scenes may use, if a run holds all assets of its library; else None.

    A run of ``preprocess`` does, unless its setting ``all_assets`` is false. Other runs hold copies of the assets in use.

    Raises:
        ConfigError: The manifest or the table ``assets`` cannot be read.
    """
    run = RunFolder(uri)
    manifest = read_manifest(run)
    if manifest is None or manifest["settings"].get("all_assets") is not True or not run.files("assets"):
        return None
    try:
        return {asset.asset_id: asset.category for asset in library_of_run(run).assets if asset.is_offered}
    except ConfigError as error:
        if error.code != "library_empty":
            raise
        return {}


def layouts_of(scenes: Sequence[ComparedScene]) -> SceneLayouts:
    """The layouts of scenes."""
    return SceneLayouts.from_lists((s.table_type, s.table_size, s.categories, s.positions) for s in scenes)


def _compared(table: pa.Table) -> Iterator[ComparedScene]:
    for row in table.to_pylist():
        fixed, (width, depth) = set(row["fixed"] or ()), row["table_size"]
        objects = [o for o in row["objects"] if o["instance"] not in fixed]
        yield ComparedScene(
            row["scene_id"],
            row["split"],
            row["table_type"],
            (width, depth),
            tuple(o["category"] for o in objects),
            tuple(o["asset_id"] for o in objects),
            np.array([o["position"] for o in objects], np.float64).reshape(-1, 3),
        )
