"""Flow and refinement that several workers share: Ray actors, each with a part of a GPU, which the job starts and ends.

The scenes of all workers that wait for an actor become one batch. Certification and simulation stay in the workers, on their cores; a
worker that waits for an actor releases its core to another shard.
"""

import asyncio
import os
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field, replace
from functools import partial
from typing import Any, Literal, TypeAlias

import ray

from models.physics_corrector.certify.correction import Fixed
from models.physics_corrector.corrector import PhysicsCorrector, SceneMover
from models.physics_corrector.refinement.layouts import LayoutToRefine, RefinedLayout
from pipelines.execution.engine_pool import ActorPool, check_gpus, first_answer
from pipelines.execution.ray_executor import ACTOR
from stable_data.assets.store import AssetStore
from stable_data.errors import ConfigError
from stable_data.geometry.shape import Shape
from stable_data.scene import Scene

OpenCorrector: TypeAlias = Callable[[], tuple[PhysicsCorrector, AssetStore]]
"""Opens the corrector of a job, and the meshes of its scenes."""

_Step: TypeAlias = Literal["move", "rest", "refine"]


@dataclass(frozen=True, slots=True)
class CorrectorCounts:
    """What an actor has done.

    Attributes:
        num_calls: Calls of workers.
        num_batches: Batches that they became.
        num_scenes: Scenes of all calls.
    """

    num_calls: int
    num_batches: int
    num_scenes: int


class _CorrectorActor:
    """Flow and refinement in an actor. Layouts come without shapes, which the actor reads itself."""

    def __init__(self, open_corrector: OpenCorrector) -> None:
        self._corrector, self._store = open_corrector()
        self._thread = ThreadPoolExecutor(1)
        self._waiting: dict[_Step, list[tuple[Sequence[LayoutToRefine], asyncio.Future[list[Any]]]]] = {}
        self._works: asyncio.Task[None] | None = None
        self._num_calls = self._num_batches = self._num_scenes = 0

    async def parts(self) -> tuple[bool, bool]:
        """Whether there is a flow, and whether there is a refinement."""
        return self._corrector.flow is not None, self._corrector.refiner is not None

    async def compute(self, step: _Step, layouts: Sequence[LayoutToRefine]) -> list[Any]:
        """Computes a step of some layouts, in one batch with those of other calls that wait."""
        self._num_calls += 1
        self._num_scenes += len(layouts)
        found: asyncio.Future[list[Any]] = asyncio.get_running_loop().create_future()
        self._waiting.setdefault(step, []).append((layouts, found))
        if self._works is None or self._works.done():
            self._works = asyncio.create_task(self._work())
        return await found

    async def counts(self) -> CorrectorCounts:
        """What the actor has done."""
        return CorrectorCounts(self._num_calls, self._num_batches, self._num_scenes)

    async def _work(self) -> None:
        while self._waiting:
            step = next(iter(self._waiting))
            calls = self._waiting.pop(step)
            try:
                results = await self._computed(step, [layout for layouts, _ in calls for layout in layouts])
            except Exception as error:  # noqa: BLE001 - it is told to the worker whose layouts cause it
                await self._compute_apart(step, calls, error)
                continue
            for layouts, found in calls:
                found.set_result(results[: len(layouts)])
                results = results[len(layouts) :]

    async def _compute_apart(
        self, step: _Step, calls: Sequence[tuple[Sequence[LayoutToRefine], asyncio.Future[list[Any]]]], error: Exception
    ) -> None:
        """Computes each call alone after an error, so that it fails only the call that causes it."""
        for layouts, found in calls:
            try:
                if len(calls) == 1:
                    raise error
                found.set_result(await self._computed(step, layouts))
            except Exception as own:  # noqa: BLE001 - see above
                found.set_exception(own)

    async def _computed(self, step: _Step, layouts: Sequence[LayoutToRefine]) -> list[Any]:
        self._num_batches += 1
        return await asyncio.get_running_loop().run_in_executor(self._thread, partial(self._compute, step, layouts))

    def _compute(self, step: _Step, layouts: Sequence[LayoutToRefine]) -> list[Any]:
        resolved = [self._store.resolved(layout.scene)[:2] for layout in layouts]
        if step == "move":
            assert self._corrector.flow is not None
            scenes, shapes = [scene for scene, _ in resolved], [own for _, own in resolved]
            return list(self._corrector.flow(scenes, shapes, [frozenset(layout.fixed) for layout in layouts]))
        assert self._corrector.refiner is not None
        whole = [replace(layout, scene=scene, shapes=own) for layout, (scene, own) in zip(layouts, resolved, strict=True)]
        return list(self._corrector.refiner.rest(whole) if step == "rest" else self._corrector.refiner.refine(whole))


@dataclass(slots=True, eq=False)
class PooledCorrector(ActorPool):
    """The flow and the refinement of some actors; sent to the workers. It is itself the refinement.

    Attributes:
        flows: Whether they have a flow.
        refines: Whether they have a refinement.
    """

    flows: bool = False
    refines: bool = False
    _calls: Counter[_Step] = field(default_factory=Counter)

    @property
    def flow(self) -> SceneMover | None:
        """The flow, if there is one."""
        return self.move if self.flows else None

    @property
    def refiner(self) -> "PooledCorrector | None":
        """The refinement, if there is one."""
        return self if self.refines else None

    def move(self, scenes: Sequence[Scene], shapes: Sequence[Sequence[Shape]], fixed: Sequence[Fixed]) -> list[Scene | None]:
        """Moves the objects of scenes, as :class:`~models.physics_corrector.learned_flow.LearnedFlow`."""
        del shapes  # the actor reads them itself
        layouts = [LayoutToRefine(scene, (), own) for scene, own in zip(scenes, fixed, strict=True)]
        return self._compute("move", layouts)

    def rest(self, layouts: Sequence[LayoutToRefine]) -> list[Scene]:
        """Gives objects exact heights, as :class:`~models.physics_corrector.refinement.refiner.Refiner`."""
        return self._compute("rest", layouts)

    def refine(self, layouts: Sequence[LayoutToRefine]) -> list[RefinedLayout | None]:
        """Refines layouts, as :class:`~models.physics_corrector.refinement.refiner.Refiner`."""
        return self._compute("refine", layouts)

    def counts(self) -> list[CorrectorCounts]:
        """What each actor has done."""
        found: list[CorrectorCounts] = ray.get([actor.counts.remote() for actor in self.actors])
        return found

    def close(self) -> None:
        """Ends the actors."""
        if ray.is_initialized():
            with suppress(ray.exceptions.RayError):  # what is lost needs no end
                for actor in self.actors:
                    ray.kill(actor)

    def _compute(self, step: _Step, layouts: Sequence[LayoutToRefine]) -> list[Any]:
        if not layouts:
            return []
        # Each step goes round by itself, from another actor in each process: a shard alternates between the steps.
        actor = self.actors[(os.getpid() + self._calls[step]) % len(self.actors)]
        self._calls[step] += 1
        try:
            found: list[Any] = ray.get(actor.compute.remote(step, [replace(layout, shapes=()) for layout in layouts]))
        except ray.exceptions.RayTaskError as error:
            raise (error.cause or error) from error
        except ray.exceptions.RayActorError as error:  # it was started again as often as Ray can
            raise ConfigError("a shared corrector was lost; run again to continue", "corrector_pool") from error
        return found


@contextmanager
def corrector_pool(open_corrector: OpenCorrector, count: int, gpus: float, *, may_grow: bool) -> Iterator[PooledCorrector]:
    """Starts actors on the cluster that this process is connected to, and ends them after the body, also after an error.

    Args:
        open_corrector: Opens the corrector; called in each actor.
        count: Number of actors.
        gpus: GPUs of each; may be a fraction. Actors reserve no CPU cores in Ray.
        may_grow: Whether the cluster may get more GPUs; false for a Ray that this process has started.

    Yields:
        The flow and the refinement.

    Raises:
        ConfigError: They cannot be opened, or the GPUs have no place for all actors and the cluster cannot grow.
    """
    if not may_grow:
        check_gpus({"correctors": (count, gpus)})
    actor = ray.remote(num_gpus=gpus, max_task_retries=-1, **ACTOR)(_CorrectorActor)
    pool = PooledCorrector(tuple(actor.remote(open_corrector) for _ in range(count)))
    try:
        parts = [each.parts.remote() for each in pool.actors]
        pool.flows, pool.refines = first_answer("correctors", parts, gpus, "the corrector cannot be opened by an actor")
        yield pool
    finally:
        pool.close()
