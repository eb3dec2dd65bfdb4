"""What tests of limits share: a bound on the time of a body, and other limits for one test."""

import gc
import time
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


def limit(monkeypatch: pytest.MonkeyPatch, group: str, **values: Any) -> None:
    """Changes limits of a group for one test."""
    monkeypatch.setattr(LIMITS, group, replace(getattr(LIMITS, group), **values))
