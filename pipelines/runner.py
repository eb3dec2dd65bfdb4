"""Runs shards: in this process, or on Ray. What a shard does, and where its rows go, is the caller's."""

import faulthandler
import logging
import os
import socket
from collections import deque
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor
from concurrent.futures import TimeoutError as FutureTimeoutError
from concurrent.futures.process import BrokenProcessPool
from contextlib import contextmanager
from dataclasses import dataclass
from enum import StrEnum
from multiprocessing import get_context
from pathlib import Path
from typing import Any, Generic, Protocol, TypeVar

import ray

from stable_data.errors import ConfigError, StableDataError

T = TypeVar("T")
R = TypeVar("R")
R_co = TypeVar("R_co", covariant=True)
T_contra = TypeVar("T_contra", contravariant=True)

_AHEAD = 2  # shards in flight for each worker: the next one is there when one ends, and memory stays flat
_MAX_DEATHS = 4  # of workers over one shard, before it is left to a later run
_START_SECONDS = 600.0  # in which a process of its own is there and ready
_CHECKOUT = Path(__file__).resolve().parents[1]
_NOT_SHIPPED = ["/.git", "/.venv", "/data", "/out", "/runs", "/shared"]
_LOST = (
    ray.exceptions.WorkerCrashedError,
    ray.exceptions.NodeDiedError,
    ray.exceptions.LocalRayletDiedError,
    ray.exceptions.ObjectLostError,
    ray.exceptions.TaskCancelledError,
    ray.exceptions.OutOfMemoryError,
)


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
        count: Worker processes of a local Ray, or how many shards an existing cluster does at once, where 0 is one for each
            of its cores. 0 without a cluster runs in this process, without Ray.
        address: An existing Ray cluster; None starts a local one.
    """

    count: int = 0
    address: str | None = None

    @property
    def are_this_process(self) -> bool:
        """Whether shards run here, where what kills the process ends the run."""
        return self.count == 0 and self.address is None

    def run(self, work: Work[T, R], shards: Sequence[T]) -> Iterator[R]:
        """Does the work for every shard, in whatever order they end.

        Raises:
            ConfigError: The work cannot go on at all, such as when the disk is full, or Ray cannot be reached; or, once all
                others are done, some shards were lost with their workers again and again.
        """
        if self.are_this_process:
            return (work(shard) for shard in shards)
        return _RayRun(self, work, shards).results()


@dataclass
class _Attempt(Generic[T]):
    """A shard, and how many workers were lost over it."""

    shard: T
    deaths: int = 0


class _RayRun(Generic[T, R]):
    """Shards on a Ray cluster, a few in flight for each worker."""

    def __init__(self, workers: Workers, work: Work[T, R], shards: Sequence[T]) -> None:
        self._workers, self._shards = workers, shards
        self._started_ray = connect(workers)
        self._work = ray.put(work)
        self._task = ray.remote(num_cpus=1, max_retries=0)(_call)  # a lost worker is counted here

    def results(self) -> Iterator[R]:
        waiting = deque(_Attempt(shard) for shard in self._shards)
        in_flight: dict[Any, _Attempt[T]] = {}
        lost: list[str] = []
        try:
            while waiting or in_flight:
                width = self._width()
                while waiting and len(in_flight) < width:
                    attempt = waiting.popleft()
                    in_flight[self._task.remote(self._work, attempt.shard, attempt.deaths > 0)] = attempt
                [reference], _ = ray.wait(list(in_flight))
                attempt = in_flight.pop(reference)
                try:
                    result = ray.get(reference)
                except _LOST as error:
                    attempt.deaths += 1
                    if attempt.deaths < _MAX_DEATHS:
                        waiting.append(attempt)  # behind the rest, so that it holds up nothing
                    else:
                        lost.append(f"{attempt.shard} ({type(error).__name__})")
                    continue
                yield result
        except ray.exceptions.RayTaskError as error:
            raise _cause(error, attempt.shard) from error
        except ray.exceptions.RayError as error:
            raise ConfigError(
                f"Ray stopped ({type(error).__name__}: {_first_line(error)}); run again: finished shards are kept", "ray_failed"
            ) from error
        finally:
            if self._started_ray:
                ray.shutdown()
        if lost:
            raise ConfigError(
                f"{len(lost)} of {len(self._shards)} shards were lost, each with {_MAX_DEATHS} workers although their items ran "
                f"one by one: {', '.join(lost[:3])}{', …' if len(lost) > 3 else ''}; free memory or take fewer workers and run "
                "again: finished shards are kept",
                "worker_lost",
            )

    def _width(self) -> int:
        """How many shards may be in flight; asked each time, for a cluster may grow."""
        if self._workers.address is None:
            return _AHEAD * self._workers.count
        return self._workers.count or max(1, _AHEAD * int(ray.cluster_resources().get("CPU", 0)))


def connect(workers: Workers) -> bool:
    """Starts a local Ray or connects to the cluster, where this process has none yet; gives whether it started one.

    Raises:
        ConfigError: Ray cannot be reached.
    """
    if ray.is_initialized():
        return False
    address = workers.address
    try:
        if address not in (None, "auto", "local"):
            _knock(address)  # Ray itself waits for minutes before it says that nobody is there
        if address is not None:
            ray.init(address=address, runtime_env=_checkout(), log_to_driver=False, logging_level=logging.ERROR)
            return False
        ray.init(num_cpus=workers.count, include_dashboard=False, log_to_driver=False, logging_level=logging.ERROR)
    except (OSError, ValueError, RuntimeError) as error:
        raise ConfigError(
            f"Ray at {address or 'this machine'} cannot be reached ({error}); start it, or leave out --address",
            "ray_unreachable",
        ) from error
    return True


def _checkout() -> dict[str, Any] | None:
    """The runtime environment that ships this checkout to the nodes; None in a Ray job, which was submitted with one."""
    if "RAY_JOB_CONFIG_JSON_ENV_VAR" in os.environ:
        return None
    return {"working_dir": str(_CHECKOUT), "excludes": _NOT_SHIPPED}


def _knock(address: str) -> None:
    """Opens and closes a connection to ``host:port`` or ``ray://host:port``."""
    host, _, port = address.rpartition("://")[2].rpartition(":")
    socket.create_connection((host, int(port)), timeout=10).close()


def _call(work: Work[T, R], shard: T, isolated: bool) -> R:
    return work(shard, isolated=isolated)


def _cause(error: ray.exceptions.RayTaskError, shard: object) -> StableDataError:
    """What a task raised, without the worker's traceback in its message."""
    if isinstance(error.cause, StableDataError):
        return error.cause
    found = f"{type(error.cause).__name__}: {_first_line(error.cause)}"
    return ConfigError(f"{shard}: {found}; please report this, and run again: finished shards are kept", "unexpected")


def _first_line(error: BaseException) -> str:
    return str(error).strip().partition("\n")[0]


@contextmanager
def limited(seconds: float) -> Iterator[None]:
    """Ends this process where it is a worker of Ray and the body takes longer; its shard is then run item by item.

    Nothing gentler stops a parser that hangs in C code. In any other process the body takes as long as it takes.

    Args:
        seconds: How long it may take.
    """
    if not (ray.is_initialized() and ray.get_runtime_context().worker.mode == ray.WORKER_MODE):
        yield
        return
    faulthandler.dump_traceback_later(seconds, exit=True)
    try:
        yield
    finally:
        faulthandler.cancel_dump_traceback_later()


class Loss(StrEnum):
    """How a process of its own ended without a result."""

    CRASHED = "crashed"
    TIMED_OUT = "timed_out"


def alone(
    function: Callable[..., R], *arguments: object, seconds: float, prepare: Callable[[], object] | None = None
) -> R | Loss:
    """Calls a function in a process of its own.

    Args:
        function: A function that can be pickled.
        arguments: What it is called with.
        seconds: How long it may take, once the process is there and prepared.
        prepare: Called first, such as to open what the function needs.

    Returns:
        What it returned, or how the process ended: it died twice, or took too long.
    """
    for _ in range(2):  # the first death may have come from outside
        with ProcessPoolExecutor(1, mp_context=get_context("spawn")) as pool:
            try:
                pool.submit(prepare or _nothing).result(timeout=_START_SECONDS)
                return pool.submit(function, *arguments).result(timeout=seconds)
            except BrokenProcessPool:
                continue
            except FutureTimeoutError:
                for process in list(pool._processes.values()):
                    process.kill()
                return Loss.TIMED_OUT
    return Loss.CRASHED


def _nothing() -> None:
    """Takes as long as the process takes to start."""
