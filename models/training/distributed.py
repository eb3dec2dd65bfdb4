"""Where a process trains."""

from dataclasses import dataclass, field

import torch


@dataclass(frozen=True, slots=True)
class ProcessContext:
    """Where a process trains.

    Attributes:
        device: Its device.
        rank: Its number among those that train together.
        world_size: How many they are; more than one need a ``torch.distributed`` process group.
    """

    device: torch.device = field(default_factory=lambda: torch.device("cpu"))
    rank: int = 0
    world_size: int = 1


CPU = ProcessContext()
"""Alone, on the CPU."""
