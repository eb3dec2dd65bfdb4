"""Engines that several workers share: Ray actors on the nodes with GPUs, which the job starts and ends.

The requests of all workers enter the running batch of an engine one by one, each as soon as there is a place, and each is
answered when its reply ends. An actor holds a bounded number of requests and refuses more; the workers keep those, and wait.
A worker that waits for an engine releases its core to another shard, so engines and correctors work at the same time.
"""

import asyncio
import sys
from collections import deque
from collections.abc import Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from typing import Any

import ray
from tqdm import tqdm

from models.semantic_reasoner.engines.protocol import Completion, Request, close_engine
from models.semantic_reasoner.engines.registry import EngineSettings, load_engine
from pipelines.execution.ray_executor import ACTOR, WorkerPool
from stable_data.errors import ConfigError

_QUIET_SECONDS = 30.0  # of waiting, after which a line tells the reason
_LOAD_SECONDS = 1.0  # for actors to tell their load; one that is restarted meanwhile gets no request
_CLOSE_SECONDS = 30.0  # for an engine to end by itself


@dataclass(frozen=True, slots=True)
class ActorCounts:
    """What an actor has done.

    Attributes:
        answered: Requests that were answered.
        refused: Requests that were refused, because the actor held as many as it may.
        most_held: The largest number of requests that it held, in the batch and waiting.
        num_steps: Decoding steps of the engine; 0 if it does not count them.
        num_tokens: Tokens that these steps have drawn; divided by ``num_steps``, the sequences of a step.
    """

    answered: int
    refused: int
    most_held: int
    num_steps: int
    num_tokens: int


class _EngineActor:
    """An engine in an actor."""

    def __init__(self, settings: EngineSettings) -> None:
        self._most = 2 * settings.num_at_once  # the batch, and as many that wait for it
        self._engine = load_engine(settings)
        self._threads = ThreadPoolExecutor(self._most)
        self._room = asyncio.Condition()
        self._held = self._answered = self._refused = self._most_held = 0

    async def name(self) -> tuple[str, bool]:
        """The engine's name, and whether equal requests get equal completions."""
        return self._engine.name, self._engine.repeats

    async def complete(self, request: Request) -> Completion | None:
        """The completion of a request; None if the actor holds too many, and refuses it."""
        if self._held == self._most:
            self._refused += 1
            return None
        self._held += 1
        self._most_held = max(self._most_held, self._held)
        try:
            (found,) = await asyncio.get_running_loop().run_in_executor(self._threads, self._engine.complete, [request])
        finally:
            async with self._room:
                self._held -= 1
                self._room.notify_all()
        self._answered += 1
        return found

    async def num_free(self) -> int:
        """How many further requests the actor can hold."""
        return self._most - self._held

    async def wait_for_room(self) -> None:
        """Returns as soon as the actor can hold a further request."""
        async with self._room:
            await self._room.wait_for(lambda: self._held < self._most)

    async def counts(self) -> ActorCounts:
        """What the actor has done."""
        steps, tokens = (getattr(self._engine, key, 0) for key in ("num_steps", "num_tokens"))
        return ActorCounts(self._answered, self._refused, self._most_held, steps, tokens)

    async def close(self) -> None:
        """Ends the engine, with its processes and its GPU memory."""
        await asyncio.get_running_loop().run_in_executor(None, close_engine, self._engine)


@dataclass(slots=True, eq=False)
class ActorPool:
    """Actors that workers share.

    Attributes:
        actors: The actors.
    """

    actors: tuple[Any, ...]

    def __eq__(self, other: object) -> bool:
        """Whether the actors are the same: what a process caches must not outlive them."""
        return isinstance(other, ActorPool) and self._ids == other._ids

    def __hash__(self) -> int:
        """A hash of the actors."""
        return hash(self._ids)

    @property
    def _ids(self) -> tuple[str, ...]:
        return tuple(actor._actor_id.hex() for actor in self.actors)


@dataclass(slots=True, eq=False)
class PooledEngine(ActorPool):
    """An engine that sends each request to one of several actors; sent to the workers.

    Attributes:
        name: The name of the engine.
        repeats: Whether equal requests get equal completions.
    """

    name: str
    repeats: bool

    def complete(self, requests: Sequence[Request]) -> list[Completion]:
        """One completion for each request, in their order.

        A request goes to the actor that holds the fewest; if all are full, this call waits. Ray restarts an actor that is lost
        with its node and repeats the requests that it has not answered.
        """
        waiting, rooms = deque(range(len(requests))), list[Any]()
        open_: dict[Any, int] = {}
        found: dict[int, Completion] = {}
        while waiting or open_:
            for actor in self._places(len(waiting)):
                number = waiting.popleft()
                open_[actor.complete.remote(requests[number])] = number
            if waiting and not rooms:
                rooms = [actor.wait_for_room.remote() for actor in self.actors]
            (ended,), _ = ray.wait([*open_, *(rooms if waiting else ())])
            if ended in rooms:
                rooms.remove(ended)
                continue
            number, completion = open_.pop(ended), ray.get(ended)
            if completion is None:  # another worker was faster
                waiting.append(number)
            else:
                found[number] = completion
        return [found[k] for k in range(len(requests))]

    def _places(self, count: int) -> Iterator[Any]:
        """Actors for at most ``count`` requests, one after another: always the one that holds the fewest."""
        if not count:
            return
        answers = {actor.num_free.remote(): k for k, actor in enumerate(self.actors)}
        told, _ = ray.wait(list(answers), num_returns=len(answers), timeout=_LOAD_SECONDS)
        free = {answers[answer]: num for answer, num in zip(told, ray.get(told), strict=True)}
        for _ in range(min(count, sum(free.values()))):
            freest = max(free, key=lambda k: free[k])
            free[freest] -= 1
            yield self.actors[freest]

    def counts(self) -> list[ActorCounts]:
        """What each actor has done."""
        found: list[ActorCounts] = ray.get([actor.counts.remote() for actor in self.actors])
        return found

    def close(self) -> None:
        """Ends the engines and their actors, whatever these do at present."""
        if not ray.is_initialized():
            return
        with suppress(ray.exceptions.RayError):  # what is lost needs no end
            if self.name:  # else an engine may still wait for its GPUs
                ray.wait([actor.close.remote() for actor in self.actors], num_returns=len(self.actors), timeout=_CLOSE_SECONDS)
            for actor in self.actors:
                ray.kill(actor)


@contextmanager
def engine_pool(settings: EngineSettings, count: int, gpus: float, *, may_grow: bool) -> Iterator[PooledEngine]:
    """Starts engines on the cluster that this process is connected to, and ends them after the body, also after an error.

    On a cluster that may grow, the function waits until all engines have a place, and a line on stderr tells the user.

    Args:
        settings: The engine.
        count: Number of engines.
        gpus: GPUs of each engine; may be a fraction. Engines reserve no CPU cores in Ray.
        may_grow: Whether the cluster may get more GPUs; false for a Ray that this process has started.

    Yields:
        The engines.

    Raises:
        ConfigError: The engine cannot be loaded, or the GPUs have no place for all engines and the cluster cannot grow.
    """
    if not may_grow:
        check_gpus({"engines": (count, gpus)})
    actor = ray.remote(num_gpus=gpus, max_task_retries=-1, **ACTOR)(_EngineActor)
    pool = PooledEngine(tuple(actor.remote(settings) for _ in range(count)), "", repeats=False)
    try:
        names = [each.name.remote() for each in pool.actors]
        pool.name, pool.repeats = first_answer("engines", names, gpus, f"engine {settings.engine} cannot be loaded by an actor")
        yield pool
    finally:
        pool.close()


def refuse_without_workers(what: str, count: int, workers: WorkerPool) -> None:
    """Refuses actors that nobody could share.

    Args:
        what: The setting with their number, such as engines.
        count: Their number.
        workers: The workers of the job.

    Raises:
        ConfigError: There are actors, but this process does the work (``config_invalid``).
    """
    if count and workers.are_this_process:
        raise ConfigError(
            f"{what} is {count}, but a single process (--workers 0) cannot share them; use more workers, or leave {what} at 0",
            "config_invalid",
        )


def check_gpus(wanted: Mapping[str, tuple[int, float]]) -> None:
    """Refuses more actors than the GPUs can hold.

    Args:
        wanted: Number of actors and GPUs of each, by the setting with their number, such as engines.

    Raises:
        ConfigError: There is no place for all (``engine_pool``).
    """
    there = int(ray.cluster_resources().get("GPU", 0))
    for what, (count, gpus) in wanted.items():
        # A fraction never spans two GPUs. The 1e-9 is for fractions whose inverse is rounded below a whole number.
        places = count if gpus == 0 else int(there / gpus) if gpus >= 1 else there * int(1 / gpus + 1e-9)
        if count > places:
            raise ConfigError(
                f"{what}={count} with {what.removesuffix('s')}_gpus={gpus:g} need {count * gpus:g} GPUs, but this machine has {there}, "
                f"enough for {places} {what}; lower one of the two, or name a cluster with --address",
                "engine_pool",
            )
    total = sum(count * gpus for count, gpus in wanted.values())
    if total > there + 1e-9:
        raise ConfigError(
            f"{' and '.join(wanted)} need {total:g} GPUs together, but this machine has {there}; lower their numbers, or name a cluster "
            "with --address",
            "engine_pool",
        )


def first_answer(what: str, answers: Sequence[Any], gpus: float, failure: str) -> Any:
    """Waits until all actors answer and returns the first answer; after a while, a line on stderr tells what it waits for.

    Args:
        what: The setting with the number of actors, such as engines.
        answers: A pending answer of each actor.
        gpus: GPUs of each.
        failure: What an error means.

    Raises:
        ConfigError: An actor cannot be started (``engine_pool``).
    """
    try:
        _, waiting = ray.wait(list(answers), num_returns=len(answers), timeout=_QUIET_SECONDS)
        if waiting:
            there = ray.cluster_resources().get("GPU", 0)
            tqdm.write(
                f"{len(waiting)} of {len(answers)} {what} have not started; each needs {gpus:g} GPUs and the cluster has {there:g} in "
                "all; waiting for nodes with free GPUs, or for the model to load",
                file=sys.stderr,
            )
        return ray.get(list(answers))[0]
    except ray.exceptions.RayError as error:
        cause = getattr(error, "cause", None)
        raise ConfigError(f"{failure} ({cause or str(error).strip().splitlines()[-1]})", "engine_pool") from error
