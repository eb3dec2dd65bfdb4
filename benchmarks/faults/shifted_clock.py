"""A clock that jumps, for processes that are started with its environment.

With libfaketime (https://github.com/wolfcw/libfaketime) all of a process sees the shifted clock, C++ too. Without it only
Python's ``time.time`` is shifted. Clocks that cannot be set, such as ``time.monotonic``, stay as they are, as on a machine.
"""

import os
from collections.abc import Mapping
from pathlib import Path

import numpy as np

from stable_data.atomic_files import write_file_atomically

_FARTHEST_HOURS = 12.0
_LIBRARIES = ("/usr/lib/*/faketime/libfaketimeMT.so.1", "/usr/lib*/faketime/libfaketimeMT.so.1")
_PATCH = Path(__file__).parent / "shifted"  # its sitecustomize.py is run by each Python that starts


class ShiftedClock:
    """The clock.

    Args:
        path: File with the shift, which the processes read.

    Attributes:
        reach: What sees the shift: ``libfaketime`` or ``time.time``.
    """

    def __init__(self, path: Path) -> None:
        self._path = path
        found = os.environ.get("FAKETIME_LIBRARY") or next(
            (str(library) for pattern in _LIBRARIES for library in sorted(Path("/").glob(pattern.lstrip("/")))), None
        )
        self._library, self.reach = found, "libfaketime" if found else "time.time"
        self.set(0.0)

    @property
    def environment(self) -> Mapping[str, str]:
        """Environment variables of processes that see the clock."""
        if self._library is None:
            paths = [str(_PATCH), *filter(None, [os.environ.get("PYTHONPATH")])]
            return {"PYTHONPATH": os.pathsep.join(paths), "SHIFTED_CLOCK": str(self._path)}
        return {
            "LD_PRELOAD": self._library,
            "FAKETIME_TIMESTAMP_FILE": str(self._path),
            "FAKETIME_CACHE_DURATION": "1",
            "FAKETIME_DONT_FAKE_MONOTONIC": "1",
            "NO_FAKE_STAT": "1",
        }

    def set(self, seconds: float) -> None:
        """Sets how far the clock is from the right time."""
        write_file_atomically(self._path, f"{seconds:+.3f}".encode())

    def jump(self, rng: np.random.Generator) -> None:
        """Lets the clock jump by up to twelve hours, back or forth."""
        self.set(float(rng.uniform(-3600, 3600) * _FARTHEST_HOURS))
