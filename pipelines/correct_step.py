"""One shard of the correct job: scenes taken, sent through the flow as one batch, certified; their rows.

A shard's rows depend on nothing but the shard.
"""

from collections import defaultdict
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from functools import lru_cache
from typing import Literal, TypeAlias, TypeVar

from models.physics_corrector.certify import CertifyOptions, Status
from models.physics_corrector.corrector import Correction, PhysicsCorrector
from models.physics_corrector.learned import load_flow
from pipelines.correct_settings import CorrectSettings
from pipelines.job import Rows, rows_alone, rows_or_failure
from pipelines.progress import Progress
from pipelines.runner import Loss, alone, limited
from pipelines.scene_source import SceneSource, Taken, scene_source
from pipelines.scene_step import num_carried, related
from stable_data import tables
from stable_data.colliders import bodies_of
from stable_data.errors import ConfigError, MeshError, Notice
from stable_data.metrics.audit import PosedScene
from stable_data.scene import FloatArray, Scene
from stable_data.shards import RunFolder

I = TypeVar("I")  # noqa: E741 - an item

WhenFull: TypeAlias = Literal["drop", "infeasible"]

CORRECT_TABLES = ("warnings", "failures", "corrections", "scenes")
"""Tables of a shard, in the order in which they are put in place."""


@dataclass(frozen=True, slots=True)
class CorrectShard:
    """Scenes that are done together.

    Attributes:
        shard_id: Content of its inputs, the weights and the settings that shape it.
        scenes: Scene ids.
    """

    shard_id: str
    scenes: tuple[str, ...]

    def __len__(self) -> int:
        return len(self.scenes)

    def __str__(self) -> str:
        return f"shard {self.shard_id} ({len(self.scenes)} scenes)"


@dataclass(frozen=True, slots=True)
class CorrectWork:
    """The work of one shard; sent to the workers.

    Attributes:
        scenes: Where the scenes are: an absolute path or a URI that every worker can read.
        out: The run's folder, which every worker can write, likewise.
        settings: The job's settings.
        fingerprint: Content of the inputs: what a process keeps of one is not used for another in the same place.
    """

    scenes: str
    out: str
    settings: CorrectSettings
    fingerprint: str = ""

    def __call__(self, shard: CorrectShard, *, isolated: bool = False) -> tuple[int, int]:
        """Does the shard and puts its tables in place; gives its scenes and how many of them failed."""
        rows: dict[str, list[tables.Row]] = defaultdict(list)
        usable = []
        for scene_id in shard.scenes:
            failed = self._limited(self.taken, scene_id, scene_id, isolated)
            _add(rows, failed)
            if not failed:
                usable.append(scene_id)
        for item in zip(usable, self._raw_poses(usable, isolated), strict=True):
            _add(rows, self._limited(self.corrected, item, item[0], isolated))
        if not isolated:  # else nothing was opened here
            _opened(self).taken.clear()
        out = RunFolder(self.out)
        for table in CORRECT_TABLES:
            out.write_shard(table, shard.shard_id, rows[table])
        return len(shard), len(rows["failures"])

    def taken(self, scene_id: str) -> Rows:
        """Takes a scene from its source; gives the row of its failure, or nothing."""
        progress = Progress("read")

        def take() -> Rows:
            self._take(scene_id, progress)
            return {}

        return rows_or_failure(scene_id, progress, take)

    def raw_poses(self, scene_ids: Sequence[str]) -> list[FloatArray | None]:
        """What the flow makes of scenes: poses of their objects, (N, 4) float64; None without a flow."""
        taken = [self._take(scene_id, Progress("read")) for scene_id in scene_ids]
        fixed = [self.settings.fixed_in(t.scene) for t in taken]
        raws = _opened(self).corrector.raw([t.scene for t in taken], [t.shapes for t in taken], fixed)
        return [None if raw is None else raw.poses() for raw in raws]

    def corrected(self, item: tuple[str, FloatArray | None]) -> Rows:
        """Rows of one scene, from where the flow put its objects."""
        scene_id, raw_poses = item
        progress = Progress("certify")
        return rows_or_failure(scene_id, progress, lambda: self._rows(scene_id, raw_poses, progress))

    def _rows(self, scene_id: str, raw_poses: FloatArray | None, progress: Progress) -> Rows:
        taken = self._take(scene_id, progress)
        progress.step = "certify"
        raw = None if raw_poses is None else taken.scene.with_poses(raw_poses)
        opened, fixed, notices = _opened(self), self.settings.fixed_in(taken.scene), list(taken.notices)
        bodies = None
        if self.settings.settle:
            progress.step = "convex parts"
            try:
                bodies = bodies_of(taken.scene, taken.shapes, opened.source.store)
            except MeshError as error:
                notices.append(Notice(scene_id, "certify", "not_settled", f"{scene_id}: the engine was not asked: {error}"))
            progress.step = "certify"
        done = opened.corrector.certified(taken.scene, taken.shapes, taken.audit, raw, fixed, bodies)
        found: Rows = {"corrections": [correction_row(done)]}
        if done.certified is None or done.audit is None or done.card_after is None:
            message = f"{scene_id}: {done.reason}"
            found["failures"] = [tables.notice_row(Notice(scene_id, "certify", str(done.status), message))]
        else:
            progress.step = "relations"
            shape_of = {o.instance: shape for o, shape in zip(taken.scene.objects, taken.shapes, strict=True)}
            posed = PosedScene(done.certified, [shape_of[o.instance] for o in done.certified.objects])
            scene, _ = related(posed, done.audit, taken.containers)
            stacked, contained = num_carried(scene)
            card = replace(done.card_after, num_stacked=stacked, num_contained=contained)
            found["scenes"] = [{**tables.scene_row(scene), **tables.card_row(card), **done.audit.rows(), **taken.origin}]
            notices += [
                Notice(scene_id, "certify", "dropped", f"{scene_id}: {d.instance} is left out: {d.reason}")
                for d in done.dropped
            ]
            if done.unsteady:
                message = f"{scene_id}: {', '.join(done.unsteady)} would not stay in the physics engine"
                notices.append(Notice(scene_id, "certify", "unsteady", message))
            if done.status is Status.UNKNOWN:
                notices.append(Notice(scene_id, "certify", "unknown", f"{scene_id}: {done.reason}"))
        return found | {"warnings": [tables.notice_row(n) for n in notices]}

    def _raw_poses(self, scene_ids: Sequence[str], isolated: bool) -> list[FloatArray | None]:
        if not isolated:
            return self.raw_poses(scene_ids)
        seconds = self.settings.seconds_per_item * max(1, len(scene_ids))
        found = alone(self.raw_poses, scene_ids, seconds=seconds, prepare=self._prepare)
        if isinstance(found, Loss):
            raise ConfigError(
                f"the flow {str(found).replace('_', ' ')} over {len(scene_ids)} scenes such as {scene_ids[0]}; free memory, take "
                "smaller shards, or set weights to none",
                "flow_failed",
            )
        return found

    def _limited(self, make: Callable[[I], Rows], item: I, scene_id: str, isolated: bool) -> Rows:
        seconds = self.settings.seconds_per_item
        if isolated:
            return rows_alone(make, item, scene_id, seconds=seconds, prepare=self._prepare)
        self._prepare()
        with limited(seconds):
            return make(item)

    def _prepare(self) -> None:
        """Opens what scenes need, outside of the time of the first one."""
        _opened(self)

    def _take(self, scene_id: str, progress: Progress) -> Taken:
        opened = _opened(self)
        if scene_id not in opened.taken:
            opened.taken[scene_id] = opened.source.take(scene_id, self.settings.scene_settings(), progress)
        return opened.taken[scene_id]


@dataclass(frozen=True, slots=True, eq=False)
class _Opened:
    """What a process keeps of its work.

    Attributes:
        source: Where the scenes are.
        corrector: Corrects them.
        taken: The scenes of the shard, each of which is asked for three times.
    """

    source: SceneSource
    corrector: PhysicsCorrector
    taken: dict[str, Taken]


@lru_cache(maxsize=1)
def _opened(work: CorrectWork) -> _Opened:
    settings = work.settings
    when_full: WhenFull = "infeasible" if settings.when_full == "infeasible" else "drop"
    options = CertifyOptions(when_full=when_full, restore=settings.restore)
    corrector = PhysicsCorrector(load_flow(settings.weights, settings.steps), options, settings.judge_raw)
    return _Opened(scene_source(work.scenes), corrector, {})


def correction_row(done: Correction) -> tables.Row:
    """A correction as a row of ``corrections``."""
    kept = done.kept
    counted = ("on_in_held", "on_in_kept", "asked_broken", "asked_restored", "directional_held", "directional_kept")
    return {
        "scene_id": done.start.scene_id,
        "status": str(done.status),
        "reason": done.reason,
        "dropped": [{"instance": d.instance, "reason": d.reason} for d in done.dropped],
        "start": _pose_rows(done.start),
        "raw": None if done.raw is None else _pose_rows(done.raw),
        "card_before": asdict(done.card_before),
        "card_raw": None if done.card_raw is None else asdict(done.card_raw),
        "card_after": None if done.card_after is None else asdict(done.card_after),
        **{name: None if kept is None else getattr(kept, name) for name in counted},
    }


def _add(rows: dict[str, list[tables.Row]], new: Mapping[str, Sequence[tables.Row]]) -> None:
    for table, found in new.items():
        rows[table] += found


def _pose_rows(scene: Scene) -> list[tables.Row]:
    return [{"instance": o.instance, "position": o.position, "yaw": o.yaw} for o in scene.objects]
