"""Keeps the memory of a long training flat."""

from stable_data.limits import release_free_memory

_STEPS = 32  # between two calls, each of which takes some ten milliseconds


def trim_heap(step: int) -> None:
    """Returns free memory to the system every few steps: batches of many shapes fragment the heap of glibc, 6 GB in twenty minutes.

    Args:
        step: Number of the training's step.
    """
    if step % _STEPS == 0:
        release_free_memory()
