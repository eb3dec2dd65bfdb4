"""The embedded world made by many workers: scenes in shards, each scene by its seed and number alone."""

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from pipelines.execution.ray_executor import WorkerPool
from pipelines.execution.shard_size import split_groups
from pipelines.execution.shard_step import Shard
from stable_data.embedded_world.world import EmbeddedWorld, close_world, open_world, write_scenes
from stable_data.errors import SceneError

_SCENES_PER_SHARD = 20

Progress = Callable[[int, int], None]
"""Told after every shard how many scenes are done, and how many failed."""


@dataclass(frozen=True, slots=True)
class SceneWriter:
    """Writes shards of scenes; sent to the workers.

    Its rows are folders in the MesaTask-10K format, each whole or not there, so there is no table that tells what is missing.

    Attributes:
        out: The folder, as every worker sees it.
        world: What the scenes depend on.
    """

    out: str
    world: EmbeddedWorld

    def __call__(self, shard: Shard[int], *, isolated: bool = False) -> tuple[int, list[SceneError]]:
        """Writes the scenes of a shard that are missing; gives their number and those that could not be made."""
        return len(shard), write_scenes(Path(self.out), shard.items, self.world)


def synth(
    out: Path, num_scenes: int, world: EmbeddedWorld, workers: WorkerPool, progress: Progress | None = None
) -> list[SceneError]:
    """Writes a set of the embedded world, or what is missing of it, with many workers.

    Args:
        out: The folder; on a cluster one that every node sees under this name.
        num_scenes: How many scenes.
        world: What they depend on.
        workers: Who makes them.
        progress: Called after every shard.

    Returns:
        The scenes that could not be made.

    Raises:
        ConfigError: As for :func:`stable_data.embedded_world.world.write_world`, or Ray cannot be reached.
    """
    open_world(out, num_scenes, world)
    shards = [Shard(f"from {part[0]}", tuple(part)) for part in split_groups(range(num_scenes), _SCENES_PER_SHARD)]
    done, failures = 0, []
    for count, failed in workers.run(SceneWriter(str(out.resolve()), world), shards):
        done += count
        failures += failed
        if progress is not None:
            progress(done, len(failures))
    close_world(out, world)
    return failures
