"""A training on Ray Train: several processes, each with a GPU if the cluster has GPUs, run the job's own loop.

The job's folder contains all that a process needs: the checkpoint and the cached data. Ray therefore moves no data, and a
training can continue with another number of processes.
"""

import os
from collections.abc import Callable
from pathlib import Path
from typing import Any, TypeAlias

import ray
import torch
from ray.train import RunConfig, ScalingConfig, TrainingFailedError, WorkerGroupError, get_context
from ray.train.torch import TorchTrainer, get_device

from models.training.distributed import ProcessContext
from pipelines.execution.ray_executor import WorkerPool, connect
from stable_data.errors import ConfigError, StableDataError

Work: TypeAlias = Callable[[ProcessContext], None]
"""Trains, or continues, in one process."""


def run_on_ray(work: Work, out: Path, workers: int, address: str | None) -> None:
    """Trains in the processes of Ray Train.

    Args:
        work: The part of one process; picklable.
        out: Folder of the training, which every process sees.
        workers: Number of processes.
        address: An existing Ray cluster; None starts a local one.

    Raises:
        ConfigError: Ray cannot be reached, or a process ended with an error; the checkpoint stays.
    """
    started = connect(WorkerPool(workers, address))
    num_gpus = int(ray.cluster_resources().get("GPU", 0))
    trainer = TorchTrainer(
        _work,
        train_loop_config={"work": work, "threads": torch.get_num_threads()},
        scaling_config=ScalingConfig(num_workers=workers, use_gpu=num_gpus >= workers),
        run_config=RunConfig(name="ray", storage_path=str(out)),
    )
    try:
        trainer.fit()
    except WorkerGroupError as error:
        raise _cause(next(iter(error.worker_failures.values()), error)) from error
    except (TrainingFailedError, ray.exceptions.RayError) as error:
        raise _cause(error) from error
    finally:
        if started:
            ray.shutdown()


def _cause(error: BaseException) -> StableDataError:
    """The error that a process raised, or a description of how it ended."""
    found: BaseException | None = error
    while found is not None:
        if isinstance(found, StableDataError):
            return found
        found = getattr(found, "cause", None) or found.__cause__
    line = str(error).strip().rpartition("\n")[2]
    return ConfigError(
        f"the training on Ray ended ({type(error).__name__}: {line}); run again to continue from its checkpoint", "ray_failed"
    )


def _work(config: dict[str, Any]) -> None:
    """The part of one process."""
    context = get_context()
    if os.environ.get("OMP_NUM_THREADS") is None:
        torch.set_num_threads(config["threads"])
    config["work"](ProcessContext(get_device(), context.get_world_rank(), context.get_world_size()))
