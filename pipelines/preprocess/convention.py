"""The setting ``position_convention`` of a job, and how ``auto`` is resolved."""

from typing import Any, Literal, Protocol, Self, TypeAlias, TypeVar

from pipelines.execution.ray_executor import ProcessFailure, WorkerPool, run_isolated
from stable_data.errors import ConfigError

ConventionChoice: TypeAlias = Literal["auto", "box_centre", "mesh_centre"]
"""A position convention, or ``auto``: the convention that the dataset shows."""

_MEASURED_ITEMS = 64  # scenes that the check may read, each within the time limit of an item


class ConventionSettings(Protocol):
    """Settings with a position convention."""

    @property
    def position_convention(self) -> ConventionChoice:
        """The convention, or ``auto``."""
        ...

    @property
    def seconds_per_item(self) -> float:
        """The time limit of an item, seconds."""
        ...

    def settled(self, source: Any, /) -> Self:
        """The settings with ``auto`` replaced by the convention that a source of scenes shows."""
        ...


S = TypeVar("S", bound=ConventionSettings)


def resolve_convention(settings: S, source: object, name: str, workers: WorkerPool) -> S:
    """Replaces ``auto`` in a job's settings.

    The check reads meshes, and a broken mesh can crash or block its reader. If the job has worker processes, the check therefore
    runs in a process of its own.

    Args:
        settings: The settings as given.
        source: The scenes that ``settings.settled`` reads.
        name: The name of the source in messages.
        workers: The workers of the job.

    Returns:
        The settings without ``auto``.

    Raises:
        ConfigError: The check crashed or took too long (``convention_unknown``).
    """
    if settings.position_convention != "auto" or workers.are_this_process:
        return settings.settled(source)
    seconds = settings.seconds_per_item
    resolved = run_isolated(settings.settled, source, seconds=_MEASURED_ITEMS * seconds)
    if isinstance(resolved, ProcessFailure):
        num_items = _MEASURED_ITEMS if resolved is ProcessFailure.TIMED_OUT else 1  # of the memory it has that of one
        raise ConfigError(
            f"{name}: the check of what positions mean {resolved.told(seconds, num_items)}, over a layout or mesh; set "
            "position_convention to box_centre or mesh_centre",
            "convention_unknown",
        )
    return resolved
