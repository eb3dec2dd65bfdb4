"""Engines that several workers share: actors on the nodes that have the GPUs, asked over Ray.

A worker that waits for an engine gives its core to another shard meanwhile, so engines and correctors are busy at the same time.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import ray

from models.semantic_reasoner.engine import Completion, Request
from models.semantic_reasoner.engines import EngineSettings, load_engine
from stable_data.errors import ConfigError


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


def engine_pool(settings: EngineSettings, count: int, gpus: float) -> PooledEngine:
    """Starts engines on a cluster that this process is connected to.

    Args:
        settings: The engine.
        count: How many.
        gpus: GPUs of each; a part of one, too. None of the cores that Ray reckons with is theirs.

    Raises:
        ConfigError: It cannot be loaded there.
    """
    actor = ray.remote(num_gpus=gpus, num_cpus=0, max_restarts=-1, max_task_retries=-1)(_EngineActor)
    actors = tuple(actor.remote(settings) for _ in range(count))
    try:
        name, repeats = ray.get([each.name.remote() for each in actors])[0]
    except ray.exceptions.RayError as error:
        cause = getattr(error, "cause", None)
        raise ConfigError(
            f"engine {settings.engine} cannot be loaded by an actor ({cause or str(error).strip().splitlines()[-1]})",
            "engine_pool",
        ) from error
    return PooledEngine(actors, name, repeats)
