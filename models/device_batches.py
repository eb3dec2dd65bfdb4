"""Runs a computation over batches that fit into the memory of a device, on one thread of the CPU.

The workers of a cluster have one thread each, and the last bits of sums depend on the number of threads: a single process with more
threads would give other results.
"""

import warnings
from collections.abc import Callable, Sequence
from typing import TypeVar

import torch

from models.torch_threads import one_thread
from stable_data.errors import ConfigError

T = TypeVar("T")
R = TypeVar("R")


class DeviceBatches:
    """Batches of a computation; where the device has too little memory, they are halved, and stay so.

    Args:
        name: What is computed, for messages.
        size: Largest number of items in a batch.
    """

    def __init__(self, name: str, size: int) -> None:
        self._name, self._size = name, size

    @one_thread()
    def run(self, items: Sequence[T], compute: Callable[[Sequence[T]], Sequence[R]]) -> list[R]:
        """Computes all items, in order.

        Raises:
            ConfigError: The memory is too small for one item (``out_of_memory``).
        """
        found: list[R] = []
        while len(found) < len(items):
            batch = items[len(found) : len(found) + self._size]
            try:
                found += compute(batch)
            except torch.OutOfMemoryError as error:
                if len(batch) == 1:
                    message = (
                        f"{self._name}: the device has too little memory for one scene, expected enough; set device to cpu"
                    )
                    raise ConfigError(message, "out_of_memory") from error
                self._size = len(batch) // 2
                message = (
                    f"{self._name}: the device has too little memory for {len(batch)} scenes; computing {self._size} at a time"
                )
                warnings.warn(message, RuntimeWarning, stacklevel=2)
        return found
