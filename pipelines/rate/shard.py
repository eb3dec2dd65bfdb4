"""The step of the rate job: the scenes of a run, each with its rating.

Scenes are read, audited and drawn one by one. A judge by rules then rates each at once; the questions to a language model are asked
together, for all scenes of a shard.
"""

from collections import defaultdict
from dataclasses import dataclass
from functools import lru_cache, partial
from typing import ClassVar

from models.scene_rating.judge import RatingJudge
from models.scene_rating.rating_case import RatingCase
from models.scene_rating.settings import load_judge
from models.semantic_reasoner.engines.protocol import OFF
from pipelines.execution.item_progress import ItemProgress
from pipelines.execution.ray_executor import ProcessFailure, item_limited, run_isolated
from pipelines.execution.shard_step import Rows, Shard, ShardResult, ShardStep, engine_stopped, failed_process, rows_or_failure
from pipelines.rate.settings import RateSettings
from stable_data.rating.rating import rating_row
from stable_data.simulation.run_reader import RunScenes, SceneSelection
from stable_data.simulation.views import draw_scored_views
from stable_data.storage.run_folder import RunFolder
from stable_data.storage.table_rows import scene_from_row


@dataclass(frozen=True, slots=True)
class RateStep(ShardStep[str]):
    """Rates scenes; an item is a scene id.

    Attributes:
        run: The run of the scenes; readable for every worker.
        settings: The job's settings.
    """

    TABLES: ClassVar = ("warnings", "failures", "ratings")
    UNIT: ClassVar = "scene"

    run: str
    settings: RateSettings

    def shard(self, shard: Shard[str], *, isolated: bool = False) -> ShardResult:
        """Rates the scenes of a shard.

        Raises:
            ConfigError: The engine no longer answers (``engine_off``), or the machine cannot render (``no_gl``).
        """
        rows: Rows = defaultdict(list)
        cases = []
        for scene_id in shard.items:
            found, case = self._isolated(scene_id) if isolated else self._limited(scene_id)
            for table, of_table in found.items():
                rows[table] += of_table
            cases += [] if case is None else [case]
        if cases:
            judge = _opened_judge(self)
            for rating in judge.rate(cases):
                if rating.code in OFF:
                    raise engine_stopped(rating.reason)
                rows["ratings"].append(rating_row(rating))
        return ShardResult(rows)

    def _limited(self, scene_id: str) -> tuple[Rows, RatingCase | None]:
        self.prepare()
        with item_limited(self.settings.seconds_per_item):
            return self.item(scene_id)

    def _isolated(self, scene_id: str) -> tuple[Rows, RatingCase | None]:
        seconds = self.settings.seconds_per_item
        found = run_isolated(self.item, scene_id, seconds=seconds, prepare=self.prepare)
        return (failed_process(found, scene_id, seconds), None) if isinstance(found, ProcessFailure) else found

    def prepare(self) -> None:
        """Opens what scenes need; this time does not count against the limit of a scene."""
        _opened_run(self.run)
        if not self.settings.rating.asks_model:
            _opened_judge(self)

    def item(self, scene_id: str) -> tuple[Rows, RatingCase | None]:
        """The rows of one scene, and the scene if a language model is to be asked about it."""
        progress, asked = ItemProgress("scene"), list[RatingCase]()
        rows = rows_or_failure(scene_id, progress, partial(self._rows, scene_id, progress, asked))
        return rows, asked[0] if asked else None

    def _rows(self, scene_id: str, progress: ItemProgress, asked: list[RatingCase]) -> Rows:
        known, rating = _opened_run(self.run), self.settings.rating
        scenes = known.select(SceneSelection(scene_ids=(scene_id,)))
        progress.step = "mesh"
        geometry = scenes.geometry(scene_from_row(scenes.row(0)))
        if rating.asks_model:
            progress.step = "pictures"
            size = self.settings.picture_size
            pictures = draw_scored_views(geometry, (size, size)).values()
            progress.step = "audit"
            asked.append(RatingCase.of(geometry, *pictures).without_geometry())
            return {}
        progress.step = "audit"
        case = RatingCase.of(geometry)
        progress.step = "rate"
        return {"ratings": [rating_row(found) for found in _opened_judge(self).rate([case])]}


@lru_cache(maxsize=1)
def _opened_run(run: str) -> RunScenes:
    """The run, with its meshes open."""
    return RunScenes(RunFolder(run))


@lru_cache(maxsize=1)
def _opened_judge(step: RateStep) -> RatingJudge:
    categories = RunFolder(step.run).table("assets", ["category"])["category"].unique().to_pylist()
    return load_judge(step.settings.rating, [category for category in categories if category])
