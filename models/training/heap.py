"""Keeps the memory of a long training flat."""

import ctypes
import sys

_STEPS = 32  # between two calls of malloc_trim


def trim_heap(step: int) -> None:
    """Returns free memory to the system every few steps: batches of many shapes fragment the heap of glibc, 6 GB in twenty minutes.

    Args:
        step: Number of the training's step.
    """
    trim = getattr(ctypes.CDLL(None), "malloc_trim", None) if step % _STEPS == 0 and sys.platform == "linux" else None
    if trim is not None:
        trim(0)
