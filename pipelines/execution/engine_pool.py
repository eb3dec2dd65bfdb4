"""Engines that several workers share: actors on the nodes that have the GPUs, asked over Ray.

A worker that waits for an engine gives its core to another shard meanwhile, so engines and correctors are busy at the same
time.
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

_QUIET_SECONDS = 30.0  # after which it is said what is waited for


class _EngineActor:
    """An engine in a process of its own."""

    def __init__(self, settings: EngineSettings) -> None:
        self._engine = load_engine(settings)

    def name(self) -> tuple[str, bool]:
        """The engine's name, and whether it repeats itself."""
        return self._engine.name, self._engine.repeats

    def complete(self, requests: list[Request]) -> list[Completion]:
        """One completion for each request, in their order."""
        return self._engine.complete(requests)


@dataclass(slots=True, eq=False)
class PooledEngine:
    """An engine that hands each batch to one of several actors; sent to the workers.

    Attributes:
        actors: The actors.
        name: As every engine has it.
        repeats: Likewise.
    """

    actors: tuple[Any, ...]
    name: str
    repeats: bool

    def complete(self, requests: Sequence[Request]) -> list[Completion]:
        """One completion for each request, in their order.

        Which actor answers follows from the batch. One that is lost with its node is started anew elsewhere and asked again.
        """
        if not requests:
            return []
        actor = self.actors[requests[0].seed % len(self.actors)]
        found: list[Completion] = ray.get(actor.complete.remote(list(requests)))
        return found


def engine_pool(settings: EngineSettings, count: int, gpus: float, *, may_grow: bool) -> PooledEngine:
    """Starts engines on a cluster that this process is connected to.

    Where they have no place yet on a cluster that may grow, they are waited for, and a line on stderr says so.

    Args:
        settings: The engine.
        count: How many.
        gpus: GPUs of each; a part of one, too. None of the cores that Ray reckons with is theirs.
        may_grow: Whether GPUs may come that are not there yet; never to a Ray that this process has started.

    Raises:
        ConfigError: It cannot be loaded there, or there is no place for so many and none can come.
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
                f"{len(waiting)} of {count} engines are not there yet, each wants {gpus:g} GPUs and the cluster has {there:g} in all; "
                "waiting for nodes that have them, or for the model to load",
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
    """Refuses more engines than the GPUs that are there can take.

    Raises:
        ConfigError: There is no place for all of them.
    """
    there = int(ray.cluster_resources().get("GPU", 0))
    # A part of a GPU is of one GPU. The little more is for parts whose inverse is rounded down to less than a whole number.
    places = count if gpus == 0 else int(there / gpus) if gpus >= 1 else there * int(1 / gpus + 1e-9)
    if count > places:
        raise ConfigError(
            f"engines={count} with engine_gpus={gpus:g} want {count * gpus:g} GPUs, but this machine has {there}, room for {places} "
            "of them; set one of the two lower, or name a cluster with --address",
            "engine_pool",
        )
