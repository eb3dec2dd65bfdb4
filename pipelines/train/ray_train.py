"""A training on Ray Train: several processes, each with a GPU if the cluster has GPUs, run the job's own loop.

The job's folder contains all that a process needs: the checkpoint and the cached data. Ray therefore moves no data, and a
training can continue with another number of processes. If a process dies, all are started again from the checkpoint.
"""

import os
import sys
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, TypeAlias

import ray
import torch
from ray.train import RunConfig, ScalingConfig, TrainingFailedError, WorkerGroupError, get_context
from ray.train.torch import TorchTrainer, get_device

from models.training.distributed import ProcessContext
from pipelines.execution.ray_executor import WorkerPool, connect, disconnect
from stable_data.errors import ConfigError, StableDataError

Work: TypeAlias = Callable[[ProcessContext], None]
"""Trains, or continues, in one process."""

_MAX_RESTARTS = 3


def run_on_ray(work: Work, out: Path, workers: int, address: str | None) -> None:
    """Trains in the processes of Ray Train.

    If a process dies, for example for lack of memory or with its machine, all are started again, up to three times, and
    continue from the checkpoint. An error that a process raises itself ends the training.

    Args:
        work: The part of one process; picklable.
        out: Folder of the training, which every process sees.
        workers: Number of processes.
        address: An existing Ray cluster; None starts a local one.

    Raises:
        ConfigError: Ray cannot be reached, a process ended with an error, or processes died too often; the checkpoint stays.
    """
    connected = connect(WorkerPool(workers, address))
    try:
        for restarts in range(_MAX_RESTARTS + 1):
            error = _attempt(work, out, workers)
            if error is None:
                return
            if not _is_lost(error) or restarts == _MAX_RESTARTS:
                raise _told(error, restarts) from error
            line = f"a process of the training was lost ({_line(error)}); restart {restarts + 1} of {_MAX_RESTARTS}"
            sys.stderr.write(f"{line} from the last checkpoint in {out}\n")
    finally:
        if connected:
            disconnect()


def _attempt(work: Work, out: Path, workers: int) -> Exception | None:
    """Trains in new processes; returns the error with which they ended."""
    num_gpus = int(ray.cluster_resources().get("GPU", 0))
    trainer = TorchTrainer(
        _work,
        train_loop_config={"work": work, "threads": torch.get_num_threads()},
        scaling_config=ScalingConfig(num_workers=workers, use_gpu=num_gpus >= workers),
        run_config=RunConfig(name="ray", storage_path=str(out)),
    )
    failures: tuple[type[Exception], ...] = (TrainingFailedError, ray.exceptions.RayError)
    try:
        trainer.fit()
    except failures as error:
        return error
    return None


def _is_lost(error: Exception) -> bool:
    """Whether a process died or lost its connection, and none raised an error of this project.

    When one process dies, the others fail in what they compute together, and which of them is seen first is chance.
    """
    found = list(_causes(error))
    if any(isinstance(cause, StableDataError) for cause in found):
        return False
    lost = (ray.exceptions.RayActorError, ray.exceptions.NodeDiedError, torch.distributed.DistError)
    return any(isinstance(cause, lost) or _is_of_gloo(cause) for cause in found)


def _is_of_gloo(error: BaseException) -> bool:
    return isinstance(error, RuntimeError) and "gloo" in str(error)  # it has no class of its own


def _causes(error: BaseException) -> Iterator[BaseException]:
    """An error with all that caused it, in all processes."""
    waiting, seen = [error], set[int]()
    while waiting:
        found = waiting.pop()
        if id(found) in seen:
            continue
        seen.add(id(found))
        yield found
        of_ray = [getattr(found, name, None) for name in ("cause", "health_check_failure", "controller_failure")]
        workers = found.worker_failures.values() if isinstance(found, WorkerGroupError) else ()
        waiting += [cause for cause in (*workers, *of_ray, found.__cause__) if isinstance(cause, BaseException)]


def _told(error: Exception, restarts: int) -> StableDataError:
    """The error that a process raised, or a description of how it ended."""
    for cause in _causes(error):
        if isinstance(cause, StableDataError):
            return cause
    often = f", after {restarts} restarts" if restarts else ""
    return ConfigError(
        f"the training on Ray ended ({_line(error)}){often}; run again to continue from its checkpoint", "ray_failed"
    )


def _line(error: Exception) -> str:
    """One line on how the processes ended."""
    first: BaseException = next(iter(error.worker_failures.values()), error) if isinstance(error, WorkerGroupError) else error
    last = str(first).strip().rpartition("\n")[2]
    return f"{type(first).__name__}: {last.partition('. ')[0]}"  # Ray adds general advice


def _work(config: dict[str, Any]) -> None:
    """The part of one process."""
    context = get_context()
    if os.environ.get("OMP_NUM_THREADS") is None:
        torch.set_num_threads(config["threads"])
    config["work"](ProcessContext(get_device(), context.get_world_rank(), context.get_world_size()))
