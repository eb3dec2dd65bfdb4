"""One shard of the generate job: Algorithm 1 makes its scenes concurrently, then each scene is judged.

The rows of a shard depend on the shard alone, except for rounding on a GPU or with shared correctors: batches follow from the order of its
tasks, and the time limit of a correction is the same in every process.
"""

import json
from collections import defaultdict
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack, contextmanager, nullcontext
from dataclasses import dataclass, field, replace
from functools import lru_cache, partial
from time import perf_counter, process_time
from typing import ClassVar, TypeVar

import ray

from models.baselines.layout.drafting import layout_drafting
from models.baselines.layout.holodeck import holodeck
from models.baselines.layout.idesign import idesign
from models.baselines.layout.imported_layout import imported_layout
from models.baselines.placement.problem import Placement, PlacementProblem, Search
from models.dual_system.algorithm1 import dual_system
from models.dual_system.batching import QueueCounts, run_batched
from models.dual_system.requests import GenerationResult, Loop
from models.dual_system.variant_comparison import compare_variant
from models.dual_system.variant_task import VariantTask
from models.dual_system.variants import NO_VARIANT, VariantWorld, vary
from models.physics_corrector.certify import CertifyOptions
from models.physics_corrector.certify.correction import CertificationRequest, Correction, CorrectionOptions
from models.physics_corrector.corrector import PhysicsCorrector
from models.physics_corrector.flow.expected_error import PROPOSAL_ERROR
from models.physics_corrector.learned_flow import load_flow
from models.physics_corrector.refinement.refiner import Refiner
from models.semantic_reasoner.engines.protocol import OFF
from models.semantic_reasoner.factory import embedded_interpreter, load_reasoner
from models.semantic_reasoner.language.interpreter import InstructionInterpreter
from models.semantic_reasoner.staged_layout import LayoutTask
from pipelines.correct.judging import judge_scene
from pipelines.correct.reaching import reach_scene
from pipelines.correct.scene_shard import dropped_notice, notices_of
from pipelines.execution.corrector_pool import PooledCorrector, corrector_pool
from pipelines.execution.engine_pool import PooledEngine, check_gpus, engine_pool
from pipelines.execution.item_progress import ItemProgress
from pipelines.execution.progress_bar import LocalTally, ProgressReporter, ProgressTally, SharedTally
from pipelines.execution.ray_executor import IsolatedProcess, ProcessFailure, WorkerPool, connection, item_limited
from pipelines.execution.shard_step import (
    NOT_OF_AN_ITEM,
    Rows,
    Shard,
    ShardResult,
    ShardStep,
    batch_failure,
    batch_notices,
    engine_stopped,
    rows_or_failure,
    unexpected_failure,
    unexpected_notice,
)
from pipelines.generate.answers import LocalCertifier, LocalRequestHandler, failed_correction
from pipelines.generate.rows import settled_row, turn_row, variant_columns, why_rejected, with_alignment, with_movement
from pipelines.generate.settings import GenerateSettings
from pipelines.sources.assets import AssetLibraries
from pipelines.sources.generation_tasks import Task
from pipelines.sources.layout_files import STEP as LAYOUT_STEP
from pipelines.sources.layout_files import LayoutFiles
from pipelines.sources.scene_variants import SceneVariant
from pipelines.sources.scenes import TableSource, contact_grid_cache
from stable_data.assets.contact_grids import ContactGrids
from stable_data.assets.store import AssetStore
from stable_data.errors import ConfigError, Notice, SceneError
from stable_data.limits import resident_memory
from stable_data.mesatask.dataset_split import split_of
from stable_data.mesatask.near_duplicates import duplicate_group
from stable_data.metrics.audit import PosedScene, audit_posed_scene
from stable_data.metrics.card import add_counts
from stable_data.metrics.reach_columns import REASON
from stable_data.metrics.related_scene import relate_scene
from stable_data.metrics.sampled_collision import add_sampled_collisions
from stable_data.metrics.verdicts import TOLERANCE
from stable_data.random_seeds import named_seed
from stable_data.scene import Scene
from stable_data.storage import schemas
from stable_data.storage.table_rows import card_row, notice_row, scene_row
from stable_data.tasks.compiling import holds_at_start
from stable_data.tasks.geometry import TaskGeometry

T = TypeVar("T")
R = TypeVar("R")

SOURCE = "generated"
"""The ``source`` of rows of ``scenes``."""

TIMING_FOLDER = "timing"
"""Files in the run's folder with the process seconds of each shard. They are no table, because they differ between runs."""

KEPT = "kept_bytes"
"""What a file of the timing calls the memory of the process when the shard began: all that it keeps from shard to shard."""

_DEPTH = 0.8 * TOLERANCE
"""Largest accepted penetration, metres; a margin, because a judge with fewer directions measures up to an eighth more."""

_PLACES = 6
"""Number of places that are tried for an unsteady object; half of the time of further tries goes into objects that fail anyway."""

_NOT_OF_AN_ITEM = (*NOT_OF_AN_ITEM, ray.exceptions.RayError)  # the engines may run on another node

REJECTED = "rejected"
"""Code of a scene that the rule of acceptance rejects."""

NOT_KEPT = "not_kept"
"""Code of a variant that differs from its source in more than its axis."""


@dataclass(frozen=True, eq=False)
class GenerateWorkerState:
    """The objects that a process caches for its work.

    Attributes:
        answers: Proposes, retrieves and corrects.
        shelf: The asset libraries.
        interpret: Interprets instructions, or None if the engine has no statistics of categories.
        serves: Whether the libraries have a wanted thing, by its category.
        world: What variants are made with.
    """

    answers: LocalRequestHandler
    shelf: AssetLibraries
    interpret: InstructionInterpreter | None
    serves: Callable[[str], bool]
    world: VariantWorld

    def holds(self, category: str) -> bool | None:
        """Whether assets of a category can contain others; None if it is not known."""
        found = {asset.is_container for asset in self.world.alternatives(category)}
        return True if True in found else None if None in found or not found else False


@dataclass(frozen=True, slots=True)
class GenerateWork(ShardStep[Task]):
    """The work of one shard; sent to the workers.

    Attributes:
        assets: The asset libraries, see :class:`~pipelines.sources.assets.AssetLibraries`.
        settings: The job's settings.
        fingerprint: Hash of the inputs, the key of what a process caches of them.
        supports: The run with the supports of the tasks, or with the scenes that are varied; None without both.
        pool: The shared engines, or None if each process has its own.
        correctors: The shared flow and refinement, or None if each process has its own.
        tally: Receives the progress of the scenes, or None.
    """

    TABLES: ClassVar = ("warnings", "failures", "turns", "settled", "grasps", "rejected", "scenes")
    UNIT: ClassVar = "scene"

    assets: tuple[str, ...]
    settings: GenerateSettings
    fingerprint: str = ""
    supports: str | None = None
    pool: PooledEngine | None = None
    correctors: PooledCorrector | None = None
    tally: ProgressTally | None = field(default=None, compare=False)

    @contextmanager
    def sharing(self, workers: WorkerPool) -> Iterator[tuple["GenerateWork", ProgressTally | None]]:
        """Holds the shared engines and correctors, if there are any, and the tally."""
        if workers.are_this_process:
            here = LocalTally()
            yield replace(self, tally=here), here
            return
        may_grow = workers.address is not None
        with ExitStack() as stack:
            stack.enter_context(connection(workers))
            work, settings = self, self.settings
            wanted = {
                "engines": (settings.engines, settings.engine_gpus),
                "correctors": (settings.correctors, settings.corrector_gpus),
            }
            if not may_grow and settings.engines and settings.correctors:
                check_gpus(wanted)
            if settings.engines:
                engines = engine_pool(settings.engine, settings.engines, settings.engine_gpus, may_grow=may_grow)
                work = replace(work, pool=stack.enter_context(engines))
            if settings.correctors:
                opens = partial(_opened_corrector, self)
                shared = corrector_pool(opens, settings.correctors, settings.corrector_gpus, may_grow=may_grow)
                work = replace(work, correctors=stack.enter_context(shared))
            tally = SharedTally.started()
            yield replace(work, tally=tally), tally

    def shard(self, shard: Shard[Task], *, isolated: bool = False) -> ShardResult:
        """Makes the scenes of a shard.

        Raises:
            ConfigError: The engine no longer answers (``engine_off``).
        """
        with (
            IsolatedProcess(partial(_prepare, self._physics(), _varies(shard))) as apart,
            ProgressReporter(self.tally, shard.shard_id, begin=len(shard)) as tell,
        ):
            return self._made(shard, apart if isolated else None, tell)

    def _made(self, shard: Shard[Task], process: IsolatedProcess | None, tell: ProgressReporter) -> ShardResult:
        began, processor, kept = perf_counter(), process_time(), resident_memory()
        opened = _opened(self)
        seconds = opened.answers.seconds
        seconds.update(dict.fromkeys(seconds, 0.0))
        opened.answers.certifier.warnings.clear()
        opened.answers.certify = partial(self._certified, process=process)
        opened.answers.move = None if process is None else partial(self._moved, process, opened.answers.certifier.warnings)
        opened.answers.limited = (
            partial(item_limited, self.settings.seconds_per_item) if self.correctors is None else lambda _: nullcontext()
        )
        opened.answers.search = partial(self._searched, process=process)
        opened.answers.fault_of = lru_cache(maxsize=None)(partial(self._fault_of, process=process))
        rows: Rows = defaultdict(list)
        if process is None:
            _prepare(self, _varies(shard))
        tasks = list(self._tasks(shard, rows, opened, process))
        for made in self._generated(tasks, opened, process, tell):
            if off := next((turn.proposal for turn in made.turns if turn.proposal.code in OFF), None):
                raise engine_stopped(f"{made.task.scene_id}: {off.failure}")
            for table, found in self._rows(made).items():
                rows[table] += found
        rows["warnings"] += map(notice_row, dict.fromkeys(opened.answers.certifier.warnings))
        judge = perf_counter() - began - sum(seconds.values())
        spent = {**seconds, "judge": judge, "processor": process_time() - processor, "scenes": len(shard), KEPT: kept}
        return ShardResult(rows, {f"{TIMING_FOLDER}/{shard.shard_id}.json": json.dumps(spent).encode()})

    def _tasks(
        self, shard: Shard[Task], rows: Rows, opened: GenerateWorkerState, process: IsolatedProcess | None
    ) -> Iterator[LayoutTask]:
        """The tasks of a shard; a task that cannot be sampled or read is a failure."""
        for task in shard.items:
            try:
                if isinstance(task, SceneVariant):
                    found = self._limited(_read_variant, task, process)
                    if isinstance(found, ProcessFailure):
                        raise SceneError(f"{task.scene_id}: its scene {self._told(found)}", str(found))
                    yield found
                else:
                    yield task if isinstance(task, LayoutTask) else task.sample(opened.serves)
            except SceneError as error:
                rows["failures"].append(notice_row(Notice(task.scene_id, "tasks", error.code, str(error))))

    def _generated(
        self,
        tasks: Sequence[LayoutTask],
        opened: GenerateWorkerState,
        process: IsolatedProcess | None,
        tell: ProgressReporter,
    ) -> Iterator[GenerationResult]:
        """Generates scenes concurrently; after an unexpected error one by one, so that it costs one scene only."""

        def made(some: Sequence[LayoutTask], watch: Callable[[QueueCounts], None] | None = None) -> list[GenerationResult]:
            return run_batched([self._loop(task, opened, process) for task in some], opened.answers, watch)

        def watch(queues: QueueCounts) -> None:
            tell(propose=queues.reasoner, correct=queues.corrector, judge=queues.made)

        try:
            for number, found in enumerate(made(tasks, watch)):
                tell(judge=len(tasks) - number)
                yield found
        except _NOT_OF_AN_ITEM:
            raise
        except Exception as error:  # noqa: BLE001 - the scene is identified below
            failure = batch_failure(error, len(tasks))
            opened.answers.certifier.warnings.extend(batch_notices(tasks[0].scene_id, len(tasks), failure))
            for number, task in enumerate(tasks):
                tell(propose=len(tasks) - number)
                try:
                    found = made([task])[0]
                except _NOT_OF_AN_ITEM:
                    raise
                except Exception as error:  # noqa: BLE001 - an unexpected error becomes a row
                    notice = unexpected_notice(task.scene_id, "generate", error)
                    found = GenerationResult(task, None, task.empty_scene, (), failure=notice)
                yield found

    def _loop(self, task: LayoutTask, opened: GenerateWorkerState, process: IsolatedProcess | None) -> Loop:
        """The coroutine that makes the scene of a task."""
        settings, interpret = self.settings.loop, opened.interpret
        if isinstance(task, VariantTask):
            return vary(task, self.settings.seed, settings, opened.world)
        seed = named_seed(self.settings.seed, task.scene_id)
        drafting = None if self.settings.chats else layout_drafting(interpret, opened.holds)
        if self.settings.layout == "holodeck":
            return holodeck(task, seed, settings, interpret, drafting)
        if self.settings.layout == "idesign":
            return idesign(task, seed, settings, interpret, drafting)
        if self.settings.layout == "files":
            began = perf_counter()
            found, remarks = self._layout_of(task.scene_id, process)
            seconds = opened.answers.seconds
            seconds["read"] = seconds.get("read", 0.0) + perf_counter() - began
            return imported_layout(task, found, settings, interpret, remarks)
        return dual_system(task, seed, settings, interpret, is_done=partial(self._is_done, process))

    def _limited(
        self, function: Callable[["GenerateWork", T], R], item: T, process: IsolatedProcess | None, num_items: int = 1
    ) -> R | ProcessFailure:
        """Calls a function within the limits of its items; in a separate process if workers died while they processed its shard."""
        seconds = self.settings.seconds_per_item
        if process is not None:
            return process.call(function, self._physics(), item, seconds=num_items * seconds, num_items=num_items)
        try:
            with item_limited(seconds, num_items):
                return function(self, item)
        except MemoryError:
            return ProcessFailure.OUT_OF_MEMORY

    def _told(self, found: ProcessFailure) -> str:
        return f"{found.told(self.settings.seconds_per_item)}; is it hostile?"

    def _layout_of(self, scene_id: str, process: IsolatedProcess | None) -> tuple[Scene | Notice, tuple[Notice, ...]]:
        """The layout of another system for a task, and what its reader remarked."""
        found = self._limited(_read_layout, scene_id, process)
        if isinstance(found, ProcessFailure):
            return Notice(scene_id, LAYOUT_STEP, str(found), f"{scene_id}: its layout {self._told(found)}"), ()
        return found

    def _is_done(self, process: IsolatedProcess | None, scene: Scene) -> bool:
        """Whether the goal of a scene's task holds; False if it cannot be checked."""
        found = self._limited(_holds, scene, process)
        return found is True

    def _searched(self, search: Search, problem: PlacementProblem, *, process: IsolatedProcess | None) -> Placement:
        """Finds places, in a separate process if workers died while they processed its shard."""
        seconds = self.settings.seconds_per_item
        if process is None:
            try:
                with item_limited(seconds):
                    return search(problem)
            except ConfigError:
                raise
            except Exception as error:  # noqa: BLE001 - else the whole shard would be made again, and its questions be asked again
                reason = f"the search for places failed: {unexpected_failure(error)}"
                return Placement((), dict.fromkeys((o.instance for o in problem.objects), reason))
        found = process.call(search, problem, seconds=seconds)
        if not isinstance(found, ProcessFailure):
            return found
        reason = f"the search for places {found.told(seconds)}"
        return Placement((), dict.fromkeys((o.instance for o in problem.objects), reason))

    def _moved(
        self,
        process: IsolatedProcess,
        warnings: list[Notice],
        scenes: Sequence[Scene],
        options: Sequence[CorrectionOptions],
    ) -> list[CertificationRequest | Correction]:
        """Moves and refines scenes in a separate process: together, and if that is lost, one by one, which is added to ``warnings``."""
        together = self._limited(_move, (scenes, options), process, len(scenes))
        if not isinstance(together, ProcessFailure):
            warnings += together[1]
            return list(together[0])
        failure = f"it {together.told(self.settings.seconds_per_item, len(scenes))}"
        warnings += batch_notices(scenes[0].scene_id, len(scenes), failure)
        found: list[CertificationRequest | Correction] = []
        for scene, option in zip(scenes, options, strict=True):
            one = self._limited(_move, ([scene], [option]), process)
            if isinstance(one, ProcessFailure):
                found.append(failed_correction(CertificationRequest(scene, None), f"the flow {self._told(one)}"))
            else:
                found += one[0]
        return found

    def _certified(self, asked: CertificationRequest, *, process: IsolatedProcess | None) -> Correction:
        """Certifies one scene, in a separate process if workers died while they processed its shard."""
        found = self._limited(_certify, asked, process)
        return failed_correction(asked, f"the correction {self._told(found)}") if isinstance(found, ProcessFailure) else found

    def _fault_of(self, asset_id: str, *, process: IsolatedProcess | None) -> str | None:
        """Why an asset cannot be used; if workers died over the shard, a separate process reads it first."""
        found = None if process is None else self._limited(_fault_of, asset_id, process)
        if not isinstance(found, ProcessFailure):
            found = self._limited(_fault_of, asset_id, None)
        return f"asset {asset_id}: reading it {self._told(found)}" if isinstance(found, ProcessFailure) else found

    def _physics(self) -> "GenerateWork":
        """The work for a separate process, which is no worker of Ray and cannot reach shared engines or the tally."""
        return replace(self, settings=self.settings.alone(), pool=None, correctors=None, tally=None)

    def _rows(self, made: GenerationResult) -> Rows:
        """All rows of one scene."""
        name = made.task.scene_id
        rows: Rows = {
            "turns": [turn_row(name, number, turn) for number, turn in enumerate(made.turns)],
            "warnings": [notice_row(n) for n in made.warnings],
        }
        if made.scene is None:
            assert made.failure is not None
            return rows | {"failures": [notice_row(made.failure)]}
        progress = ItemProgress("judge")
        with item_limited(self.settings.seconds_per_item):
            make = partial(self._judged, made, made.scene, progress)
            judged = rows_or_failure(name, progress, make, of_the_run=_NOT_OF_AN_ITEM)
        return rows | judged | {"warnings": [*rows["warnings"], *judged.get("warnings", [])]}

    def _judged(self, made: GenerationResult, scene: Scene, progress: ItemProgress) -> Rows:
        """The rows of a generated scene: accepted, or rejected with the reason."""
        opened, name = _opened(self), scene.scene_id
        progress.step = "mesh"
        scene, shapes, notices = opened.answers.certifier.store.resolved(scene)
        progress.step = "audit"
        posed = PosedScene(scene, shapes)
        audit = audit_posed_scene(posed) if made.correction is None else made.correction.audit or audit_posed_scene(posed)
        progress.step = "relations"
        containers = opened.shelf.containers(scene)
        seen = relate_scene(posed, audit, containers)
        scene = seen.scene
        progress.step = "settle"
        rest = None if made.correction is None else made.correction.rest  # the correction may have simulated this scene
        judged = judge_scene(scene, shapes, opened.answers.certifier.store, self.settings, rest)
        rest = judged.rest
        progress.step = "card"
        card = add_sampled_collisions(add_counts(audit.card(), scene), scene, posed.shapes, audit)
        card = with_movement(card, made, scene, posed, audit, opened.answers.certifier.store)
        card, not_as_said = with_alignment(card, seen, containers, made.task, opened.interpret)
        card = judged.filled(card)
        progress.step, began = "reach", perf_counter()
        reach = reach_scene(scene, opened.answers.certifier.store, self.settings, containers)
        if self.settings.robot:
            seconds = opened.answers.seconds
            seconds["reach"] = seconds.get("reach", 0.0) + perf_counter() - began
        group = duplicate_group(scene)
        origin = {
            "source": SOURCE,
            "split": split_of(group, scene.table.table_type),
            "layout_path": None,
            "layout_sha256": None,
            "duplicate_group": group,
        }
        row = {**scene_row(scene), **card_row(card), **judged.columns, **reach.columns, **audit.rows(), **origin}
        compared = None
        if isinstance(made.task, VariantTask):
            compared = compare_variant(made.task.source, scene, made.task.axis, opened.shelf.containers)
            row |= variant_columns(made.task, compared)
        told = [Notice(name, n.step, n.code, n.message) for n in (*notices, *audit.notices)]
        told += [Notice(name, "card", "not_as_said", f"{name}: {text}") for text in not_as_said]
        told += [dropped_notice(d, name) for d in made.dropped]
        if made.correction is not None:
            told += notices_of(made.correction, name)
        told += judged.notices
        found: Rows = {"warnings": [notice_row(n) for n in dict.fromkeys(told)], "grasps": reach.grasps}
        if rest is not None and self.settings.keep_settled:
            found["settled"] = [settled_row(name, rest)]
        query, code, reason = self.settings.accepting, "", ""
        if compared is not None and not compared.is_varied:
            code, reason = NO_VARIANT, "it equals its source"
        elif compared is not None and compared.lost:
            code, reason = NOT_KEPT, f"it does not keep what it must: {'; '.join(compared.lost)}"
        elif query is not None and not query.passes(row, schemas.SCHEMAS["scenes"]):
            code, reason = (
                REJECTED,
                why_rejected(query.text, {column: row[column] for column in query.columns}, judged, row[REASON]),
            )
        if not code:
            return found | {"scenes": [row]}
        failure = Notice(name, "accept", code, f"{name}: {reason}")
        return found | {"rejected": [row | {"code": code, "reason": reason}], "failures": [notice_row(failure)]}


def _varies(shard: Shard[Task]) -> bool:
    return any(isinstance(task, SceneVariant) for task in shard.items)


def _prepare(work: GenerateWork, varies: bool) -> None:
    """Opens what items need; this time does not count against their limit."""
    _open_certifier(work)
    if work.settings.layout == "files":
        _open_layouts(work)
    if varies:
        _open_varied(work)


def _read_variant(work: GenerateWork, variant: SceneVariant) -> VariantTask:
    return variant.read(_open_varied(work))


def _read_layout(work: GenerateWork, scene_id: str) -> tuple[Scene | Notice, tuple[Notice, ...]]:
    return _open_layouts(work).of_task(scene_id)


def _holds(work: GenerateWork, scene: Scene) -> bool:
    """Whether the goal of a scene's task holds."""
    resolved, shapes, _ = _open_certifier(work).store.resolved(scene)
    return holds_at_start(TaskGeometry(resolved, shapes, _open_shelf(work).containers(resolved)))


def _move(
    work: GenerateWork, asked: tuple[Sequence[Scene], Sequence[CorrectionOptions]]
) -> tuple[list[CertificationRequest], list[Notice]]:
    """Moves and refines scenes as one batch; also returns the warning if they could not be refined together."""
    certifier = _open_certifier(work)
    certifier.warnings.clear()
    return certifier.prepared(certifier.moved(*asked)), list(certifier.warnings)


def _certify(work: GenerateWork, asked: CertificationRequest) -> Correction:
    return _open_certifier(work)(asked)


def _fault_of(work: GenerateWork, asset_id: str) -> str | None:
    return _open_certifier(work).store.fault_of(asset_id)


@lru_cache(maxsize=1)
def _open_shelf(work: GenerateWork) -> AssetLibraries:
    return AssetLibraries(work.assets, scenes=work.supports, offers_scenes=False)


@lru_cache(maxsize=1)
def _open_layouts(work: GenerateWork) -> LayoutFiles:
    """The layouts of another system."""
    return LayoutFiles(work.settings.layout_files, _open_shelf(work))


@lru_cache(maxsize=1)
def _open_varied(work: GenerateWork) -> TableSource:
    """The run of the scenes that are varied."""
    assert work.supports is not None
    return TableSource(work.supports, _open_shelf(work))


@lru_cache(maxsize=1)
def _open_certifier(work: GenerateWork) -> LocalCertifier:
    return _certifier(work.settings, _open_shelf(work), work.correctors)


def _opened_corrector(work: GenerateWork) -> tuple[PhysicsCorrector, AssetStore]:
    """The corrector of an actor, and the meshes of its scenes."""
    certifier = _open_certifier(work)
    assert isinstance(certifier.corrector, PhysicsCorrector)
    return certifier.corrector, certifier.store


def _certifier(settings: GenerateSettings, shelf: AssetLibraries, shared: PooledCorrector | None = None) -> LocalCertifier:
    options, store = CertifyOptions(depth=_DEPTH, places=_PLACES, twice=False), AssetStore(shelf)
    if settings.corrector != "stable":
        # Imported here because MuJoCo's import is slow.
        from models.baselines.post_processing import PostProcessor

        return LocalCertifier(PostProcessor.named(settings.corrector), store)
    if shared is not None:
        return LocalCertifier(PhysicsCorrector(shared.flow, options, False, shared.refiner, settings.polish), store)
    needs_grids = settings.refine or settings.polish != "certify"
    refiner = Refiner(store, ContactGrids(contact_grid_cache()), _DEPTH, settings.device) if needs_grids else None
    flow = load_flow(settings.weights, settings.steps, PROPOSAL_ERROR, settings.device)
    return LocalCertifier(PhysicsCorrector(flow, options, False, refiner, settings.polish), store)


@lru_cache(maxsize=1)
def _opened(work: GenerateWork) -> GenerateWorkerState:
    settings, shelf = work.settings, _open_shelf(work)
    reasoner, interpret = load_reasoner(settings.engine, settings.reasoner, work.pool)
    interpret = interpret or embedded_interpreter()  # all systems are judged by a reading of their instruction
    retriever, certifier = shelf.retriever(settings.retrieval), _open_certifier(work)
    answers = LocalRequestHandler(reasoner, retriever, certifier, settings.seed, settings.settle)
    known = shelf.by_category(settings.retrieval)
    world = VariantWorld(interpret, lambda category: known.get(category, ()), shelf.containers)
    return GenerateWorkerState(answers, shelf, interpret, shelf.serves(settings.retrieval), world)
