"""Runs shards in this process or on Ray. The caller decides what a shard does and where its rows are written."""

import faulthandler
import logging
import os
import socket
import sys
import time
from collections import deque
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import ProcessPoolExecutor
from concurrent.futures import TimeoutError as FutureTimeoutError
from concurrent.futures.process import BrokenProcessPool
from contextlib import contextmanager
from dataclasses import dataclass
from enum import StrEnum
from multiprocessing import get_context
from pathlib import Path
from threading import Event, Thread
from typing import Any, Generic, Protocol, TypeVar

import ray
from tqdm import tqdm

from stable_data.commands.command_line import NOT_STARTED
from stable_data.errors import ConfigError, StableDataError
from stable_data.limits import LIMITS, at_most, memory_limited, worker_environment

T = TypeVar("T")
R = TypeVar("R")
R_co = TypeVar("R_co", covariant=True)
T_contra = TypeVar("T_contra", contravariant=True)

# Ray's head keeps a record of 3 kB of each of the last 100,000 calls, and these actors are called several times for each scene.
ACTOR: Mapping[str, Any] = {"num_cpus": 0, "max_restarts": -1, "enable_task_events": False}
"""Options of Ray of an actor that serves the workers: it reserves no core, is started again if it is lost, and leaves no records."""

_AHEAD = 2  # shards in flight for each worker: the next shard is ready when one ends, and memory stays bounded
_ISOLATE_FROM = 2  # worker deaths from which a shard runs isolated: the first death may have an outside cause
_MAX_DEATHS = 4  # worker deaths after which a shard is given up; a later run retries it
_MAX_NODES = 8  # node losses after which a shard is given up: it is rarely the cause, but retries must be bounded
_LOOK_SECONDS = 10.0  # between checks of the cluster while no shard ends
_RAY_HEAD_SECONDS = float(os.environ.get("RAY_gcs_rpc_server_reconnect_timeout_s", "60"))  # noqa: SIM112 - its name in Ray
_HEAD_SECONDS = _RAY_HEAD_SECONDS / 2  # how long Ray's head may be silent; after the whole time Ray itself ends the process
_HEAD_LOOK_SECONDS = 5.0
_SILENT_SECONDS = 120.0  # how long a node that Ray counts may not answer; Ray itself finds a lost node within a minute
_PATIENCE_SECONDS = 1800.0  # how long a cluster may have no core, for example while spot machines are replaced
_START_SECONDS = 600.0  # time limit for the start of a separate process
_CHECKOUT = Path(__file__).resolve().parents[2]
_NOT_SHIPPED = ["/.git", "/.venv", "/data", "/out", "/runs"]
_WORKER_LOST = (ray.exceptions.WorkerCrashedError, ray.exceptions.TaskCancelledError, ray.exceptions.OutOfMemoryError)
_NODE_LOST = (
    ray.exceptions.NodeDiedError,
    ray.exceptions.LocalRayletDiedError,
    ray.exceptions.ObjectLostError,
    ray.exceptions.RaySystemError,  # raised in a worker whose raylet is gone
    ray.exceptions.RuntimeEnvSetupError,  # also raised if a node is lost while its environment is prepared
)


class Work(Protocol[T_contra, R_co]):
    """The work for one shard. It must give the same rows every time, in every process."""

    def __call__(self, shard: T_contra, *, isolated: bool = False) -> R_co:
        """Processes a shard.

        Args:
            shard: The shard.
            isolated: Workers died while they processed this shard: run each item in a separate process.
        """
        ...


@dataclass(frozen=True, slots=True)
class WorkerPool:
    """The workers that run the shards.

    Attributes:
        count: Worker processes of a local Ray; with an existing cluster, the number of shards at once, where 0 is one for each
            core. 0 without a cluster runs in this process, without Ray.
        address: An existing Ray cluster; None starts a local one.
    """

    count: int = 0
    address: str | None = None

    @property
    def are_this_process(self) -> bool:
        """Whether shards run in this process; a crash then ends the run."""
        return self.count == 0 and self.address is None

    def run(self, work: Work[T, R], shards: Sequence[T]) -> Iterator[R]:
        """Processes every shard and yields the results in the order in which shards end.

        Raises:
            ConfigError: The work cannot continue: the disk is full, Ray cannot be reached, or the cluster stays without nodes.
                Also, after all other shards are done, if some shards lost their workers or nodes too often.
        """
        if self.are_this_process:
            return (work(shard) for shard in shards)
        return _RayRun(self, work, shards).results()


@dataclass
class _Attempt(Generic[T]):
    """A shard with its counts of lost workers and nodes."""

    shard: T
    deaths: int = 0
    nodes: int = 0

    def is_given_up(self, error: ray.exceptions.RayError) -> bool:
        """Counts a loss and returns whether the retry limit is reached."""
        if isinstance(error, _NODE_LOST):
            self.nodes += 1
        else:
            self.deaths += 1
        return self.deaths >= _MAX_DEATHS or self.nodes >= _MAX_NODES


class _RayRun(Generic[T, R]):
    """Shards on a Ray cluster, a few in flight for each worker."""

    def __init__(self, workers: WorkerPool, work: Work[T, R], shards: Sequence[T]) -> None:
        self._workers, self._shards = workers, shards
        self._empty_since: float | None = None
        self._silent_since: dict[str, float] = {}
        self._connected = connect(workers)
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
                    in_flight[self._task.remote(self._work, attempt.shard, attempt.deaths >= _ISOLATE_FROM)] = attempt
                ended, _ = ray.wait(list(in_flight), timeout=_LOOK_SECONDS)
                if not ended:
                    self._look_for_nodes()
                    self._look_for_silent_nodes()
                    continue
                self._empty_since, attempt = None, in_flight.pop(ended[0])
                try:
                    result = ray.get(ended[0])
                except (*_WORKER_LOST, *_NODE_LOST) as error:
                    if attempt.is_given_up(error):
                        lost.append(f"{attempt.shard} ({type(error).__name__})")
                    else:
                        waiting.append(attempt)  # last, so that it delays no other shard
                    continue
                yield result
        except ray.exceptions.RayTaskError as error:
            raise _cause(error, attempt.shard) from error
        except ray.exceptions.RayError as error:
            raise ConfigError(
                f"Ray stopped ({type(error).__name__}: {_first_line(error)}); run again: finished shards are kept", "ray_failed"
            ) from error
        finally:
            if self._connected:
                disconnect()
        if lost:
            raise ConfigError(
                f"{len(lost)} of {len(self._shards)} shards were lost, each with {_MAX_DEATHS} workers (in the last tries items "
                f"ran in separate processes) or {_MAX_NODES} nodes: {', '.join(lost[:3])}{', …' if len(lost) > 3 else ''}; free "
                "memory or use fewer workers and run again: finished shards are kept",
                "worker_lost",
            )

    def _look_for_nodes(self) -> None:
        """Waits for new nodes if the cluster has no core, and prints one line about it.

        Raises:
            ConfigError: The cluster had no core for too long.
        """
        if ray.cluster_resources().get("CPU", 0) >= 1:
            self._empty_since = None
            return
        minutes = f"{_PATIENCE_SECONDS / 60:g} min"
        if self._empty_since is None:
            self._empty_since = time.monotonic()
            tqdm.write(f"the cluster has no core at the moment; waiting for a node, up to {minutes}", file=sys.stderr)
        elif time.monotonic() - self._empty_since > _PATIENCE_SECONDS:
            raise ConfigError(
                f"the cluster at {self._workers.address} had no core for {minutes}, expected at least one; add "
                "nodes and run again: finished shards are kept",
                "cluster_empty",
            )

    def _look_for_silent_nodes(self) -> None:
        """Ends a run that waits for a node that is lost, but not for Ray.

        Ray's head times its health checks by the clock of its machine: if that jumps back, a node that is lost afterwards counts until
        the clock is where it was, and so long no call ends.

        Raises:
            ConfigError: Such a node does not answer for too long.
        """
        if self._workers.address is None or "://" in self._workers.address:  # a client need not see the nodes
            return
        counted = {f"{node['NodeManagerAddress']}:{node['NodeManagerPort']}" for node in ray.nodes() if node["Alive"]}
        now = time.monotonic()
        self._silent_since = {node: self._silent_since.get(node, now) for node in sorted(counted) if not _answers(node)}
        for node, since in self._silent_since.items():
            if now - since > _SILENT_SECONDS:
                raise ConfigError(
                    f"Ray's head still counts the node at {node}, which has not answered for {_SILENT_SECONDS / 60:g} min; did the "
                    "clock of the head jump back? Start the cluster again and run again: finished shards are kept",
                    "node_silent",
                )

    def _width(self) -> int:
        """The number of shards that may be in flight; read each time, because a cluster may grow."""
        if self._workers.address is None:
            return _AHEAD * self._workers.count
        return self._workers.count or max(1, _AHEAD * int(ray.cluster_resources().get("CPU", 0)))


def connect(workers: WorkerPool) -> bool:
    """Starts a local Ray or connects to the cluster; returns False if this process is connected already.

    Whoever connects ends the connection as soon as no shard is left, because while it lasts the loss of the head ends this process.

    Raises:
        ConfigError: Ray cannot be reached.
    """
    if ray.is_initialized():
        return False
    address = workers.address
    try:
        if address not in (None, "auto", "local"):
            _test_connection(address)  # Ray itself would wait for minutes before it fails
            _head.watch(address)
        if address is not None:
            ray.init(address=address, runtime_env=_runtime(), log_to_driver=False, logging_level=logging.ERROR)
        else:
            own = {"address": "local", "num_cpus": workers.count}  # without "local", Ray joins any cluster of this machine
            ray.init(**own, include_dashboard=False, log_to_driver=False, logging_level=logging.ERROR)
        if address in (None, "auto", "local"):
            _head.watch(ray.get_runtime_context().gcs_address)
    except Exception as error:  # Ray raises Exception itself if it does not start in time
        _head.leave()
        hint = "start it, or leave out --address"
        if "AuthToken" in str(error.__cause__):
            hint = "it requires a token: set RAY_AUTH_MODE=token, and RAY_AUTH_TOKEN unless ~/.ray/auth_token holds the token"
        raise ConfigError(
            f"Ray at {address or 'this machine'} cannot be reached ({error}); {hint}", "ray_unreachable"
        ) from error
    return True


def disconnect() -> None:
    """Ends the connection to Ray, and the local Ray."""
    _head.leave()
    ray.shutdown()


class _HeadWatch:
    """Ends this process with one line and the status of a job that stopped if Ray's head is lost.

    Ray itself would end it later, in whatever call it is, with status 1: that of a job that is done.
    """

    def __init__(self) -> None:
        self._left = Event()

    def watch(self, head: str) -> None:
        """Watches a head at ``host:port`` or ``ray://host:port``, from now on until :meth:`leave`."""
        self.leave()
        self._left = Event()
        Thread(target=self._look, args=(head, self._left), name="head watch", daemon=True).start()

    def leave(self) -> None:
        """Ends the watch."""
        self._left.set()

    @staticmethod
    def _look(head: str, left: Event) -> None:
        silent_since: float | None = None
        while not left.wait(_HEAD_LOOK_SECONDS):
            asked = time.monotonic()
            try:
                _test_connection(head)
                silent_since = None
            except OSError as error:
                silent_since = silent_since or asked
                if time.monotonic() - silent_since > _HEAD_SECONDS and not left.is_set():
                    advice = "start the cluster again and run again: finished shards are kept"
                    sys.stderr.write(f"\nerror: Ray's head at {head} is lost ({error}); {advice}\n")
                    sys.stderr.flush()
                    os._exit(NOT_STARTED)


_head = _HeadWatch()


@contextmanager
def connection(workers: WorkerPool) -> Iterator[None]:
    """Holds a local Ray or the connection to the cluster, which everything that runs meanwhile shares.

    Raises:
        ConfigError: Ray cannot be reached.
    """
    connected = not workers.are_this_process and connect(workers)
    try:
        yield
    finally:
        if connected:
            disconnect()


def _runtime() -> dict[str, Any] | None:
    """The runtime environment that ships this checkout and the limits to the nodes; None in a Ray job, which was submitted with one."""
    if "RAY_JOB_CONFIG_JSON_ENV_VAR" in os.environ:
        return None
    return {"working_dir": str(_CHECKOUT), "excludes": _NOT_SHIPPED, "env_vars": dict(worker_environment())}


def _test_connection(address: str) -> None:
    """Opens and closes a connection to ``host:port`` or ``ray://host:port``."""
    host, _, port = address.rpartition("://")[2].rpartition(":")
    socket.create_connection((host, int(port)), timeout=10).close()


def _answers(address: str) -> bool:
    """Whether something listens at ``host:port``."""
    try:
        _test_connection(address)
    except OSError:
        return False
    return True


def _call(work: Work[T, R], shard: T, isolated: bool) -> R:
    return work(shard, isolated=isolated)


def _cause(error: ray.exceptions.RayTaskError, shard: object) -> StableDataError:
    """The error that a task raised, without the worker's traceback in its message."""
    if isinstance(error.cause, StableDataError):
        return error.cause
    found = f"{type(error.cause).__name__}: {_first_line(error.cause)}"
    return ConfigError(f"{shard}: {found}; please report this, and run again: finished shards are kept", "unexpected")


def _first_line(error: BaseException) -> str:
    return str(error).strip().partition("\n")[0]


@contextmanager
def item_limited(seconds: float, num_items: int = 1) -> Iterator[None]:
    """Gives the body the time and the memory of its items if this process is a worker of Ray; in any other process there is no limit.

    The process ends if the body takes longer, because nothing else stops a parser that hangs in C code. Its shard is then run again,
    and from the second time on item by item, in separate processes. One body must not be within another.

    Args:
        seconds: The time limit of an item. That on memory is one of :class:`stable_data.limits.ItemLimits`.
        num_items: The number of items of a body that works on several at once.

    Raises:
        MemoryError: The body needs more memory; code in C may end the process instead.
    """
    if not (ray.is_initialized() and ray.get_runtime_context().worker.mode == ray.WORKER_MODE):
        yield
        return
    faulthandler.dump_traceback_later(num_items * seconds, exit=True)
    try:
        with memory_limited(num_items * LIMITS.item.max_memory_bytes):
            yield
    finally:
        faulthandler.cancel_dump_traceback_later()


class ProcessFailure(StrEnum):
    """How a separate process ended without a result."""

    CRASHED = "crashed"
    TIMED_OUT = "timed_out"
    OUT_OF_MEMORY = "out_of_memory"

    def told(self, seconds: float, num_items: int = 1) -> str:
        """Says what happened, as the end of a sentence.

        Args:
            seconds: The time limit of an item.
            num_items: The number of items of the call.
        """
        each = f" for each of {num_items} items" if num_items > 1 else ""
        if self is ProcessFailure.TIMED_OUT:
            return f"took over {seconds:g} s{each} (seconds_per_item)"
        found = "needed" if self is ProcessFailure.OUT_OF_MEMORY else "ended the process that did it, perhaps because it needed"
        return f"{found} more memory, expected {at_most(LIMITS.item, 'max_memory_bytes', 'bytes')}{each}"


class IsolatedProcess:
    """A separate process for calls that may crash it; after a crash, the next call starts a new one. Used in a ``with`` statement.

    Args:
        prepare: Called first in each process, for example to open a model.
    """

    def __init__(self, prepare: Callable[[], object] | None = None) -> None:
        self._prepare = prepare
        self._pool: ProcessPoolExecutor | None = None

    def __enter__(self) -> "IsolatedProcess":
        """Returns the object; the process starts with the first call."""
        return self

    def __exit__(self, *_: object) -> None:
        """Ends the process."""
        self._end()

    def call(
        self, function: Callable[..., R], *arguments: object, seconds: float | None, num_items: int = 1
    ) -> R | ProcessFailure:
        """Calls a function in the separate process.

        Args:
            function: A picklable function.
            arguments: Its arguments.
            seconds: The time limit of the call, without the start of the process; None: there is none.
            num_items: The number of items whose memory it may use.

        Returns:
            The result, or how the process ended: it died twice, or exceeded the limit of time or of memory.
        """
        for _ in range(2):  # the first death may have an outside cause
            try:
                if self._pool is None:
                    self._pool = ProcessPoolExecutor(1, mp_context=get_context("spawn"))
                    self._pool.submit(_begin, self._prepare).result(timeout=_START_SECONDS)
                return self._pool.submit(_bounded, num_items, function, *arguments).result(timeout=seconds)
            except BrokenProcessPool:
                self._end()
            except MemoryError:
                self._end()
                return ProcessFailure.OUT_OF_MEMORY
            except FutureTimeoutError:
                self._end(kill=True)
                return ProcessFailure.TIMED_OUT
        return ProcessFailure.CRASHED

    def _end(self, *, kill: bool = False) -> None:
        if self._pool is not None:
            for process in list(self._pool._processes.values()) if kill else ():
                process.kill()
            self._pool.shutdown()
            self._pool = None


def run_isolated(
    function: Callable[..., R],
    *arguments: object,
    seconds: float,
    num_items: int = 1,
    prepare: Callable[[], object] | None = None,
) -> R | ProcessFailure:
    """Calls a function in a separate process, see :meth:`IsolatedProcess.call`."""
    with IsolatedProcess(prepare) as process:
        return process.call(function, *arguments, seconds=seconds, num_items=num_items)


def _bounded(num_items: int, function: Callable[..., R], *arguments: object) -> R:
    with memory_limited(num_items * LIMITS.item.max_memory_bytes):
        return function(*arguments)


def _begin(prepare: Callable[[], object] | None) -> None:
    """Prepares a separate process, which has imported this module by then."""
    if prepare is not None:
        prepare()
