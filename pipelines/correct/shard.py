"""One shard of the correct job: scenes are read, moved by the flow as one batch, and certified.

The rows of a shard depend on the shard alone, but for rounding with shared correctors.
"""

from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace
from functools import lru_cache
from typing import ClassVar

from models.physics_corrector.certify.correction import CertificationRequest, Correction, CorrectionOptions, shapes_by_instance
from pipelines.correct.judging import judge_scene
from pipelines.correct.reaching import reach_scene
from pipelines.correct.scene_shard import SceneWork, SceneWorkerState, corrector_of, notices_of
from pipelines.correct.settings import CorrectSettings
from pipelines.execution.item_progress import ItemProgress
from pipelines.execution.ray_executor import ProcessFailure
from pipelines.execution.shard_step import Rows, rows_or_failure
from pipelines.sources.scenes import scene_source
from stable_data.errors import ConfigError, Notice
from stable_data.metrics.audit import PosedScene
from stable_data.metrics.card import add_counts
from stable_data.metrics.related_scene import relate_scene
from stable_data.metrics.sampled_collision import add_sampled_collisions
from stable_data.scene import Scene
from stable_data.storage import schemas
from stable_data.storage.table_rows import card_row, notice_row, scene_row


@dataclass(frozen=True, slots=True)
class CorrectWork(SceneWork[CorrectSettings, str, CertificationRequest]):
    """The work of one shard: an item is a scene id, its answer the scene after the flow and the refinement."""

    TABLES: ClassVar = ("warnings", "failures", "corrections", "grasps", "scenes")
    UNIT: ClassVar = "scene"

    def item_id(self, item: str) -> str:
        """The scene's id."""
        return item

    def opened(self) -> SceneWorkerState:
        """The source and the corrector, cached in this process."""
        return _opened(self)

    def look(self, item: str, progress: ItemProgress) -> None:
        """Reads a scene."""
        self.take(item, progress)

    def answers(self, items: Sequence[str]) -> list[CertificationRequest]:
        """The scenes after the flow and the refinement."""
        opened, taken = self.opened(), [self.take(scene_id, ItemProgress("read")) for scene_id in items]
        options = [CorrectionOptions(self.settings.fixed_in(t.scene), asks_engine=self.settings.settle) for t in taken]
        audits, store = [t.audit for t in taken], opened.source.store
        return opened.corrector.prepare(opened.corrector.move([t.scene for t in taken], store, options, audits), store)

    def unanswered(self, loss: ProcessFailure, items: Sequence[str]) -> ConfigError:
        """The error if the process of the flow was lost."""
        found = f"the flow, for scenes such as {items[0]}, {loss.told(self.settings.seconds_per_item, len(items))}"
        return ConfigError(f"{found}; free memory, set scenes_per_shard lower, or set weights to none", "flow_failed")

    def finished(self, item: str, answer: CertificationRequest) -> Rows:
        """The rows of one scene from what the flow and the refinement made of it."""
        progress = ItemProgress("certify")
        return rows_or_failure(item, progress, lambda: self._rows(item, answer, progress))

    def _rows(self, scene_id: str, request: CertificationRequest, progress: ItemProgress) -> Rows:
        taken = self.take(scene_id, progress)
        progress.step = "certify"
        opened, notices = self.opened(), list(taken.notices)
        done = opened.corrector.certify(request, opened.source.store)
        if done.engine_fault:
            message = f"{scene_id}: the physics engine was not used: {done.engine_fault}"
            notices.append(Notice(scene_id, "certify", "not_settled", message))
        if done.card_before is not None and done.audit_before is not None:
            before = add_sampled_collisions(done.card_before, done.start, taken.shapes, done.audit_before)
            done = replace(done, card_before=before)
        found: Rows = {}
        if done.certified is None or done.audit is None or done.card_after is None:
            message = f"{scene_id}: {done.reason}"
            found["failures"] = [notice_row(Notice(scene_id, "certify", str(done.status), message))]
        else:
            progress.step = "relations"
            shape_of = shapes_by_instance(taken.scene, taken.shapes)
            posed = PosedScene(done.certified, [shape_of[o.instance] for o in done.certified.objects])
            scene = relate_scene(posed, done.audit, taken.containers).scene
            after, audit = add_sampled_collisions(done.card_after, done.certified, posed.shapes, done.audit), done.audit
            card, done = add_counts(after, scene), replace(done, card_after=after)
            progress.step = "settle"
            judged = judge_scene(scene, posed.shapes, opened.source.store, self.settings, done.rest)
            card = judged.filled(card)
            progress.step = "reach"
            reach = reach_scene(scene, opened.source.store, self.settings, taken.containers)
            columns = {**judged.columns, **reach.columns}
            found["scenes"] = [{**scene_row(scene), **card_row(card), **columns, **audit.rows(), **taken.origin}]
            found["grasps"] = reach.grasps
            notices += [*notices_of(done, scene_id), *judged.notices]
        return found | {"corrections": [correction_row(done)], "warnings": [notice_row(n) for n in notices]}


@lru_cache(maxsize=1)
def _opened(work: CorrectWork) -> SceneWorkerState:
    source = scene_source(work.scenes)
    return SceneWorkerState(source, corrector_of(work.settings, source.store, work.correctors))


def correction_row(done: Correction) -> schemas.Row:
    """The row of ``corrections`` for a correction."""
    kept = done.kept
    counted = ("on_in_held", "on_in_kept", "asked_broken", "asked_restored", "directional_held", "directional_kept")
    return {
        "scene_id": done.start.scene_id,
        "status": str(done.status),
        "reason": done.reason,
        "solved_by": None if done.solved_by is None else str(done.solved_by),
        "dropped": [{"instance": d.instance, "reason": d.reason} for d in done.dropped],
        "start": _pose_rows(done.start),
        "raw": None if done.raw is None else _pose_rows(done.raw),
        "card_before": None if done.card_before is None else asdict(done.card_before),
        "card_raw": None if done.card_raw is None else asdict(done.card_raw),
        "card_after": None if done.card_after is None else asdict(done.card_after),
        **{name: None if kept is None else getattr(kept, name) for name in counted},
    }


def _pose_rows(scene: Scene) -> list[schemas.Row]:
    return [{"instance": o.instance, "position": o.position, "yaw": o.yaw} for o in scene.objects]
