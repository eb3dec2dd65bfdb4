"""Writes a set of the embedded world with many workers.

The output is a folder in the MesaTask-10K format and not a run with tables: a finished scene is a folder that exists. The job
therefore has no manifest, and resumes by skipping the scenes whose folders exist.
"""

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
"""Called after every shard with the number of finished and of failed scenes."""


@dataclass(frozen=True, slots=True)
class SceneWriter:
    """Writes shards of scenes; sent to the workers.

    Attributes:
        out: The folder, under the path that every worker sees.
        world: The settings of the set; a scene depends on them and on its number alone.
    """

    out: str
    world: EmbeddedWorld

    def __call__(self, shard: Shard[int], *, isolated: bool = False) -> tuple[int, list[SceneError]]:
        """Writes the missing scenes of a shard; returns the size of the shard and the errors of failed scenes."""
        return len(shard), write_scenes(Path(self.out), shard.items, self.world)


def synth(
    out: Path, num_scenes: int, world: EmbeddedWorld, workers: WorkerPool, progress: Progress | None = None
) -> list[SceneError]:
    """Writes a set of the embedded world, or its missing scenes, with many workers.

    Args:
        out: The folder; every node of a cluster must see it under this path.
        num_scenes: Number of scenes.
        world: The settings of the set.
        workers: The workers.
        progress: Called after every shard.

    Returns:
        The errors of the scenes that could not be made.

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
