"""A shard of a job over scenes with one batched computation: the flow in correct, the reasoner in edit.

Each item is checked alone, then the batch is computed for all valid items, then each item is finished alone. A batch that fails, or needs
too much time or memory, is computed again item by item, in a separate process. A bad item therefore costs no other item.
"""

from abc import abstractmethod
from collections import defaultdict
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, nullcontext
from dataclasses import dataclass, field, replace
from functools import partial
from typing import Any, Generic, Literal, Self, TypeAlias, TypeVar

import ray

from models.physics_corrector.certify import CertifyOptions, CorrectionStatus, DroppedObject
from models.physics_corrector.certify.correction import Correction
from models.physics_corrector.corrector import PhysicsCorrector
from pipelines.correct.settings import CorrectSettings
from pipelines.execution.corrector_pool import PooledCorrector, corrector_pool
from pipelines.execution.item_progress import ItemProgress
from pipelines.execution.progress_bar import ProgressTally
from pipelines.execution.ray_executor import IsolatedProcess, ProcessFailure, WorkerPool, connection, item_limited
from pipelines.execution.shard_step import (
    NOT_OF_AN_ITEM,
    Rows,
    Shard,
    ShardResult,
    ShardStep,
    batch_failure,
    batch_notices,
    failed_process,
    rows_isolated,
    rows_or_failure,
)
from pipelines.sources.scenes import SceneSource, SourceScene, contact_grid_cache
from stable_data.assets.contact_grids import ContactGrids
from stable_data.assets.store import AssetStore
from stable_data.errors import ConfigError, Notice
from stable_data.limits import is_out_of_memory
from stable_data.storage.table_rows import notice_row

S = TypeVar("S", bound=CorrectSettings)
I = TypeVar("I")  # noqa: E741 - an item
A = TypeVar("A")  # an answer
X = TypeVar("X")

WhenFull: TypeAlias = Literal["drop", "infeasible"]


class _BatchError(Exception):
    """The batched computation failed in this process."""


_OF_THE_RUN = (*NOT_OF_AN_ITEM, ray.exceptions.RayError)  # the flow may run on another node


@dataclass(frozen=True, eq=False)
class SceneWorkerState:
    """The objects that a process caches for its work.

    Attributes:
        source: The source of the scenes.
        corrector: The Physics Corrector.
        taken: The scenes of the shard; each is used several times.
    """

    source: SceneSource
    corrector: PhysicsCorrector
    taken: dict[str, SourceScene] = field(default_factory=dict)


@dataclass(frozen=True, slots=True)
class SceneWork(ShardStep[I], Generic[S, I, A]):
    """The work of one shard; sent to the workers.

    Attributes:
        scenes: The source of the scenes: an absolute path or a URI that every worker can read.
        settings: The job's settings.
        fingerprint: Hash of the inputs, the key of what a process caches of them.
        correctors: The shared flow and refinement, or None if each process has its own.
    """

    scenes: str
    settings: S
    fingerprint: str = ""
    correctors: PooledCorrector | None = field(default=None, kw_only=True)

    @contextmanager
    def sharing(self, workers: WorkerPool) -> Iterator[tuple[Self, ProgressTally | None]]:
        """Holds the shared flow and refinement, if there are any."""
        settings = self.settings
        if not settings.correctors:
            yield self, None
            return
        opens, may_grow = partial(_opened_corrector, self), workers.address is not None
        with (
            connection(workers),
            corrector_pool(opens, settings.correctors, settings.corrector_gpus, may_grow=may_grow) as shared,
        ):
            yield replace(self, correctors=shared), None

    def shard(self, shard: Shard[I], *, isolated: bool = False) -> ShardResult:
        """Computes the rows of a shard."""
        failure = ""
        if not isolated:
            try:
                return self._shard(shard, None)
            except _BatchError as error:  # the item is identified in a separate process
                failure = str(error)
            finally:
                self.opened().taken.clear()
        alone = replace(self, correctors=None, settings=self.settings.alone()) if self.correctors is not None else self
        with IsolatedProcess(partial(alone.prepare_to_ask, shard.items)) as process:
            return alone._shard(shard, process, failure)

    def _shard(self, shard: Shard[I], process: IsolatedProcess | None, failure: str = "") -> ShardResult:
        """Computes the rows of a shard in this process or in a separate one; item by item if ``failure`` says how the batch has failed.

        Raises:
            _BatchError: In this process, the batch failed.
        """
        rows: Rows = defaultdict(list)
        usable = []
        for item in shard.items:
            failed = self._limited(self._look, item, self.item_id(item), process)
            _add(rows, failed)
            if not failed:
                usable.append(item)
        answered = self._limited_answers(usable) if process is None else self._isolated_answers(usable, rows, process, failure)
        for pair in answered:
            _add(rows, self._limited(self._finish, pair, self.item_id(pair[0]), process))
        return ShardResult(rows)

    @abstractmethod
    def item_id(self, item: I) -> str:
        """The id of an item in its rows."""

    @abstractmethod
    def opened(self) -> SceneWorkerState:
        """The objects that this process caches, opened at the first call."""

    @abstractmethod
    def look(self, item: I, progress: ItemProgress) -> None:
        """Reads an item from its source; raises if it cannot be used."""

    @abstractmethod
    def answers(self, items: Sequence[I]) -> list[A]:
        """The batched computation for all valid items of a shard."""

    @abstractmethod
    def unanswered(self, loss: ProcessFailure, items: Sequence[I]) -> ConfigError:
        """The error if the process of the batched computation was lost for all items, and for each alone."""

    @abstractmethod
    def finished(self, item: I, answer: A) -> Rows:
        """The rows of an item from its answer; a failed item is a row of ``failures``."""

    @property
    def seconds_to_answer(self) -> float | None:
        """The time limit of the batched computation for each item, seconds; None if it has one of its own."""
        return self.settings.seconds_per_item

    def prepare_to_ask(self, items: Sequence[I]) -> None:
        """Opens in a separate process what the batched computation needs; this time does not count against its limit."""
        self.opened()

    def take(self, scene_id: str, progress: ItemProgress) -> SourceScene:
        """A scene of the source, read once for this shard."""
        opened = self.opened()
        if scene_id not in opened.taken:
            opened.taken[scene_id] = opened.source.take(scene_id, self.settings.scene_settings(), progress)
        return opened.taken[scene_id]

    def _look(self, item: I) -> Rows:
        progress = ItemProgress("read")

        def look() -> Rows:
            self.look(item, progress)
            return {}

        return rows_or_failure(self.item_id(item), progress, look)

    def _finish(self, pair: tuple[I, A]) -> Rows:
        return self.finished(*pair)

    def _limited_answers(self, items: Sequence[I]) -> list[tuple[I, A]]:
        """The items with their answers, in this process.

        Raises:
            _BatchError: They need too much memory, or one of them is the cause of an unexpected error.
        """
        # For an engine or for shared correctors, which others use too.
        waits = self.seconds_to_answer is None or self.correctors is not None
        if not items:
            return []
        try:
            with nullcontext() if waits else item_limited(self.settings.seconds_per_item, len(items)):
                return list(zip(items, self.answers(items), strict=True))
        except _OF_THE_RUN:
            raise
        except Exception as error:
            raise _BatchError(batch_failure(error, len(items))) from error

    def _isolated_answers(
        self, items: Sequence[I], rows: Rows, process: IsolatedProcess, failure: str = ""
    ) -> list[tuple[I, A]]:
        """The items with their answers, from a separate process; if the batch fails, each is asked for alone, and fails alone.

        Args:
            items: The items.
            rows: Gets the rows of items that fail, and a warning if the batch has failed.
            process: The process.
            failure: How the batch has failed already; empty if it has not been tried.

        Raises:
            ConfigError: The process was lost for each of several items: that is no fault of one of them.
        """
        num, seconds = len(items), self.seconds_to_answer
        if not failure and num > 1:
            limit = None if seconds is None else num * seconds
            found = process.call(self._answered, items, seconds=limit, num_items=num)
            if isinstance(found, list):
                return list(zip(items, found, strict=True))
            if isinstance(found, ProcessFailure):
                failure = f"it {found.told(self.settings.seconds_per_item, num)}"
            else:
                failure = str(found["failures"][0]["message"])
        if failure and items:
            _add(rows, {"warnings": list(map(notice_row, batch_notices(self.item_id(items[0]), num, failure)))})
        answered: list[tuple[I, A]] = []
        losses: list[ProcessFailure] = []
        for item in items:
            found = process.call(self._answered, [item], seconds=seconds)
            if isinstance(found, list):
                answered.append((item, found[0]))
                continue
            if isinstance(found, ProcessFailure):
                losses.append(found)
                found = failed_process(found, self.item_id(item), self.settings.seconds_per_item)
            _add(rows, found)
        if len(losses) == num > 1:
            raise self.unanswered(losses[0], items)
        return answered

    def _answered(self, items: Sequence[I]) -> list[A] | Rows:
        """The answers, or the row of ``failures`` of the first item if there are none."""
        answers: list[A] = []

        def answer() -> Rows:
            try:
                answers.extend(self.answers(items))
            except Exception as error:
                if is_out_of_memory(error):
                    raise MemoryError from error
                raise
            return {}

        of_the_run = (*NOT_OF_AN_ITEM, MemoryError)
        return rows_or_failure(self.item_id(items[0]), ItemProgress("answer"), answer, of_the_run=of_the_run) or answers

    def _limited(self, make: Callable[[X], Rows], item: X, item_id: str, process: IsolatedProcess | None) -> Rows:
        seconds = self.settings.seconds_per_item
        if process is not None:
            return rows_isolated(process, make, item, item_id, seconds=seconds)
        self.opened()  # this time does not count against the limit
        with item_limited(seconds):
            return make(item)


def _opened_corrector(work: SceneWork[Any, Any, Any]) -> tuple[PhysicsCorrector, AssetStore]:
    """The corrector of an actor, and the meshes of its scenes."""
    opened = work.opened()
    return opened.corrector, opened.source.store


def corrector_of(
    settings: CorrectSettings, store: AssetStore, shared: PooledCorrector | None = None, *, flows: bool = True
) -> PhysicsCorrector:
    """The corrector for the settings of a job.

    Args:
        settings: The settings.
        store: Meshes of the assets.
        shared: The shared flow and refinement; None if this process has its own.
        flows: Whether the flow moves objects before certification, if there are weights.
    """
    when_full: WhenFull = "infeasible" if settings.when_full == "infeasible" else "drop"
    options = CertifyOptions(when_full=when_full, restore=settings.restore)
    if shared is not None:
        flow, refiner = shared.flow, shared.refiner
        return PhysicsCorrector(flow, options, settings.judge_raw, refiner, settings.polish, settings.purpose)
    own_flow, own_refiner = None, None
    # Imported here: both need torch, which takes longer to import than an item of a process that needs neither.
    if flows:
        from models.physics_corrector.learned_flow import load_flow

        own_flow = load_flow(settings.weights, settings.steps, settings.error(), settings.device)
    if settings.refine or settings.polish != "certify":
        from models.physics_corrector.refinement.refiner import Refiner

        own_refiner = Refiner(store, ContactGrids(contact_grid_cache()), device=settings.device)
    return PhysicsCorrector(own_flow, options, settings.judge_raw, own_refiner, settings.polish, settings.purpose)


def dropped_notice(dropped: DroppedObject, scene_id: str) -> Notice:
    """A notice about a removed object, with the reason."""
    return Notice(scene_id, "certify", "dropped", f"{scene_id}: {dropped.instance} was removed: {dropped.reason}")


def notices_of(done: Correction, scene_id: str) -> list[Notice]:
    """The warnings about a correction."""
    notices = [dropped_notice(d, scene_id) for d in done.dropped]
    if done.rest is not None and done.rest.unsteady:
        message = f"{scene_id}: {', '.join(done.rest.unsteady)} do not stay at rest in the physics engine"
        notices.append(Notice(scene_id, "certify", "unsteady", message))
    if done.unsolved:
        message = f"{scene_id}: the post-processing has not reached its own goal: {done.unsolved}"
        notices.append(Notice(scene_id, "certify", "not_converged", message))
    if done.status in (CorrectionStatus.UNKNOWN, CorrectionStatus.UNCLEAN):
        notices.append(Notice(scene_id, "certify", str(done.status), f"{scene_id}: {done.reason}"))
    return notices + ([] if done.audit is None else list(done.audit.notices))


def _add(rows: Rows, new: Rows) -> None:
    for table, found in new.items():
        rows[table] += found
