"""Runs shards: in this process, or on Ray. What a shard does, and where its rows go, is the caller's."""

import logging
import socket
from collections import deque
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor
from concurrent.futures import TimeoutError as FutureTimeoutError
from concurrent.futures.process import BrokenProcessPool
from dataclasses import dataclass
from multiprocessing import get_context
from typing import Any, Generic, Protocol, TypeVar

import ray

from stable_data.errors import ConfigError

T = TypeVar("T")
R = TypeVar("R")
R_co = TypeVar("R_co", covariant=True)
T_contra = TypeVar("T_contra", contravariant=True)

_AHEAD = 2  # shards in flight for each worker: the next one is there when one ends, and memory stays flat
_RETRIES = 2


class Work(Protocol[T_contra, R_co]):
    """What is done with one shard. It must give the same rows each time, in whatever process."""

    def __call__(self, shard: T_contra, *, isolated: bool = False) -> R_co:
        """Does it.

        Args:
            shard: The shard.
            isolated: A worker died over this shard: run its items one by one, each in a process of its own.
        """
        ...


@dataclass(frozen=True, slots=True)
class Workers:
    """Who runs the shards.

    Attributes:
        count: Worker processes; 0 runs in this process, without Ray.
        address: An existing Ray cluster; None starts a local one.
        seconds_per_shard: A shard that takes longer is stopped and its items are run one by one.
    """

    count: int = 0
    address: str | None = None
    seconds_per_shard: float = 3600.0

    def run(self, work: Work[T, R], shards: Sequence[T]) -> Iterator[R]:
        """Does the work for every shard, in whatever order they end.

        Raises:
            ConfigError: The work cannot go on at all, such as when the disk is full, or Ray cannot be reached.
        """
        if self.count == 0 and self.address is None:
            return (work(shard) for shard in shards)
        return _RayRun(self, work, shards).results()


class _RayRun(Generic[T, R]):
    """Shards on a Ray cluster, a few in flight for each worker."""

    def __init__(self, workers: Workers, work: Work[T, R], shards: Sequence[T]) -> None:
        self._workers, self._shards = workers, shards
        self._started_ray = False
        if not ray.is_initialized():
            self._connect()
        self._work = ray.put(work)
        self._task = ray.remote(num_cpus=1, max_retries=_RETRIES)(_call)

    def _connect(self) -> None:
        address = self._workers.address
        try:
            if address not in (None, "auto", "local"):
                _knock(address)  # Ray itself waits for minutes before it says that nobody is there
            if address is None:
                ray.init(
                    num_cpus=self._workers.count, include_dashboard=False, log_to_driver=False, logging_level=logging.ERROR
                )
                self._started_ray = True
            else:
                ray.init(address=address, log_to_driver=False, logging_level=logging.ERROR)
        except (OSError, ValueError, RuntimeError) as error:
            raise ConfigError(
                f"Ray at {address or 'this machine'} cannot be reached ({error}); start it, or leave out --address",
                "ray_unreachable",
            ) from error

    def results(self) -> Iterator[R]:
        waiting = deque((shard, False) for shard in self._shards)
        in_flight: dict[Any, tuple[T, bool]] = {}
        width = _AHEAD * (self._workers.count or int(ray.cluster_resources().get("CPU", 1)))
        try:
            while waiting or in_flight:
                while waiting and len(in_flight) < width:
                    shard, isolated = waiting.popleft()
                    in_flight[self._task.remote(self._work, shard, isolated)] = (shard, isolated)
                done, _ = ray.wait(list(in_flight), timeout=self._workers.seconds_per_shard * _AHEAD)
                for reference in done or list(in_flight)[:1]:
                    shard, isolated = in_flight.pop(reference)
                    if not done:
                        ray.cancel(reference, force=True)
                    try:
                        yield ray.get(reference)
                    except (
                        ray.exceptions.WorkerCrashedError,
                        ray.exceptions.TaskCancelledError,
                        ray.exceptions.OutOfMemoryError,
                    ) as error:
                        if isolated:  # its items ran in processes of their own, so it is not they that ended the worker
                            raise ConfigError(
                                f"a worker was lost over {shard} even with its items run one by one "
                                f"({type(error).__name__}), expected the items alone to fail; free memory or take fewer "
                                "workers and run again: finished shards are kept",
                                "worker_lost",
                            ) from error
                        waiting.appendleft((shard, True))
                    except ray.exceptions.RayTaskError as error:
                        raise error.as_instanceof_cause() from None
        finally:
            if self._started_ray:
                ray.shutdown()


def _knock(address: str) -> None:
    """Opens and closes a connection to ``host:port`` or ``ray://host:port``."""
    host, _, port = address.rpartition("://")[2].rpartition(":")
    socket.create_connection((host, int(port)), timeout=10).close()


def _call(work: Work[T, R], shard: T, isolated: bool) -> R:
    return work(shard, isolated=isolated)


def alone(function: Callable[..., R], *arguments: object, seconds: float) -> R | None:
    """Calls a function in a process of its own.

    Args:
        function: A module-level function.
        arguments: What it is called with.
        seconds: How long it may take.

    Returns:
        What it returned, or None where the process died twice or took too long.
    """
    for _ in range(2):  # the first death may have come from outside
        with ProcessPoolExecutor(1, mp_context=get_context("spawn")) as pool:
            try:
                return pool.submit(function, *arguments).result(timeout=seconds)
            except BrokenProcessPool:
                continue
            except FutureTimeoutError:
                for process in list(pool._processes.values()):
                    process.kill()
                return None
    return None
