"""The device and rank of a training process."""

from dataclasses import dataclass, field

import torch


@dataclass(frozen=True, slots=True)
class ProcessContext:
    """The device and rank of a training process.

    Attributes:
        device: The device of the process.
        rank: Index of the process among the training processes.
        world_size: Number of training processes; more than one need a ``torch.distributed`` process group.
    """

    device: torch.device = field(default_factory=lambda: torch.device("cpu"))
    rank: int = 0
    world_size: int = 1


CPU = ProcessContext()
"""A single process on the CPU."""
