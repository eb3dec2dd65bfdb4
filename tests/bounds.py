"""What tests of limits share: bounds on the time and the memory of a body, and other limits for one test."""

import gc
import time
import tracemalloc
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from typing import Any

import pytest

from stable_data.limits import LIMITS


@contextmanager
def soon(seconds: float = 1.0) -> Iterator[None]:
    """Asserts that its body takes little time of this process's processor."""
    gc.collect(1)
    gc.freeze()  # objects of earlier tests are not traversed again; to collect them all takes longer than most bodies
    start = time.process_time()
    yield
    elapsed = time.process_time() - start
    assert elapsed < seconds


@contextmanager
def little_memory(num_bytes: int) -> Iterator[None]:
    """Asserts that Python objects of its body never take more bytes at once, whatever the process had before."""
    tracemalloc.start()
    try:
        yield
        assert tracemalloc.get_traced_memory()[1] < num_bytes
    finally:
        tracemalloc.stop()


def limit(monkeypatch: pytest.MonkeyPatch, group: str, **values: Any) -> None:
    """Changes limits of a group for one test."""
    monkeypatch.setattr(LIMITS, group, replace(getattr(LIMITS, group), **values))
