"""Engines that several workers share: Ray actors on the nodes with GPUs.

A worker that waits for an engine releases its core to another shard, so engines and correctors work at the same time.
"""

import sys
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import ray
from tqdm import tqdm

from models.semantic_reasoner.engines.protocol import Completion, Request
from models.semantic_reasoner.engines.registry import EngineSettings, load_engine
from stable_data.errors import ConfigError

_QUIET_SECONDS = 30.0  # of waiting, after which a line tells the reason


class _EngineActor:
    """An engine in an actor."""

    def __init__(self, settings: EngineSettings) -> None:
        self._engine = load_engine(settings)

    def name(self) -> tuple[str, bool]:
        """The engine's name, and whether equal requests get equal completions."""
        return self._engine.name, self._engine.repeats

    def complete(self, requests: list[Request]) -> list[Completion]:
        """One completion for each request, in their order."""
        return self._engine.complete(requests)


@dataclass(slots=True, eq=False)
class PooledEngine:
    """An engine that sends each batch to one of several actors; sent to the workers.

    Attributes:
        actors: The actors.
        name: The name of the engine.
        repeats: Whether equal requests get equal completions.
    """

    actors: tuple[Any, ...]
    name: str
    repeats: bool

    def complete(self, requests: Sequence[Request]) -> list[Completion]:
        """One completion for each request, in their order.

        The batch determines the actor. Ray restarts an actor that is lost with its node and repeats the call.
        """
        if not requests:
            return []
        actor = self.actors[requests[0].seed % len(self.actors)]
        found: list[Completion] = ray.get(actor.complete.remote(list(requests)))
        return found


def engine_pool(settings: EngineSettings, count: int, gpus: float, *, may_grow: bool) -> PooledEngine:
    """Starts engines on the cluster that this process is connected to.

    On a cluster that may grow, the function waits until all engines have a place, and a line on stderr tells the user.

    Args:
        settings: The engine.
        count: Number of engines.
        gpus: GPUs of each engine; may be a fraction. Engines reserve no CPU cores in Ray.
        may_grow: Whether the cluster may get more GPUs; false for a Ray that this process has started.

    Raises:
        ConfigError: The engine cannot be loaded, or the GPUs have no place for all engines and the cluster cannot grow.
    """
    if not may_grow:
        _check_place(count, gpus)
    actor = ray.remote(num_gpus=gpus, num_cpus=0, max_restarts=-1, max_task_retries=-1)(_EngineActor)
    actors = tuple(actor.remote(settings) for _ in range(count))
    try:
        names = [each.name.remote() for each in actors]
        _, waiting = ray.wait(names, num_returns=count, timeout=_QUIET_SECONDS)
        if waiting:
            there = ray.cluster_resources().get("GPU", 0)
            tqdm.write(
                f"{len(waiting)} of {count} engines have not started; each needs {gpus:g} GPUs and the cluster has {there:g} in all; "
                "waiting for nodes with free GPUs, or for the model to load",
                file=sys.stderr,
            )
        name, repeats = ray.get(names)[0]
    except ray.exceptions.RayError as error:
        cause = getattr(error, "cause", None)
        raise ConfigError(
            f"engine {settings.engine} cannot be loaded by an actor ({cause or str(error).strip().splitlines()[-1]})",
            "engine_pool",
        ) from error
    return PooledEngine(actors, name, repeats)


def _check_place(count: int, gpus: float) -> None:
    """Refuses more engines than the present GPUs can hold.

    Raises:
        ConfigError: There is no place for all engines (``engine_pool``).
    """
    there = int(ray.cluster_resources().get("GPU", 0))
    # A fraction never spans two GPUs. The 1e-9 is for fractions whose inverse is rounded below a whole number.
    places = count if gpus == 0 else int(there / gpus) if gpus >= 1 else there * int(1 / gpus + 1e-9)
    if count > places:
        raise ConfigError(
            f"engines={count} with engine_gpus={gpus:g} need {count * gpus:g} GPUs, but this machine has {there}, enough for {places} "
            "engines; lower one of the two, or name a cluster with --address",
            "engine_pool",
        )
