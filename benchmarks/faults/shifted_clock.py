"""A clock that jumps, for processes that are started with its environment.

libfaketime (https://github.com/wolfcw/libfaketime) shifts it for all of a process, C++ too. Clocks that cannot be set, such as
``time.monotonic``, stay as they are, as on a machine. With such clocks, libfaketime lets ``time.sleep`` of Python fail (``[Errno 22]
Invalid argument``), so the processes sleep in another way.
"""

import os
import subprocess
import sys
import time
from collections.abc import Mapping
from pathlib import Path

import numpy as np

from stable_data.atomic_files import write_file_atomically
from stable_data.errors import ConfigError

_FARTHEST_HOURS = 12.0
_SURE_SECONDS = 1000.0  # a shift that no delay of a process explains
_SLEEP = """import threading, time

_never = threading.Event()
time.sleep = lambda seconds: None if _never.wait(seconds) else None
"""
_LIBRARY_VARIABLE = "FAKETIME_LIBRARY"
_LIBRARIES = ("usr/lib/*/faketime/libfaketimeMT.so.1", "usr/lib*/faketime/libfaketimeMT.so.1")


class ShiftedClock:
    """The clock.

    Args:
        path: File with the shift, which the processes read. Beside it lies the folder with what Python does first in them.

    Raises:
        ConfigError: libfaketime is not there, or does not shift the clock of a process (``clock_not_shifted``).
    """

    def __init__(self, path: Path) -> None:
        self._path, startup = path, path.with_name(f"{path.name}-startup")
        startup.mkdir(parents=True, exist_ok=True)
        write_file_atomically(startup / "sitecustomize.py", _SLEEP.encode())
        self._modules = os.pathsep.join(filter(None, (str(startup), os.environ.get("PYTHONPATH"))))
        found = (str(library) for pattern in _LIBRARIES for library in sorted(Path("/").glob(pattern)))
        self._library = os.environ.get(_LIBRARY_VARIABLE) or next(found, "")
        self.set(_SURE_SECONDS)
        if not (self._library and self._is_shifted()):
            raise ConfigError(
                f"the clock cannot be shifted with libfaketime ({self._library or 'not found'}); install it (apt install faketime) or "
                f"name libfaketimeMT.so.1 in {_LIBRARY_VARIABLE}, or leave the fault clock out",
                "clock_not_shifted",
            )
        self.set(0.0)

    @property
    def environment(self) -> Mapping[str, str]:
        """Environment variables of processes that see the clock."""
        return {
            "LD_PRELOAD": self._library,
            "FAKETIME_TIMESTAMP_FILE": str(self._path),
            "FAKETIME_CACHE_DURATION": "1",
            "FAKETIME_DONT_FAKE_MONOTONIC": "1",
            "NO_FAKE_STAT": "1",
            "PYTHONPATH": self._modules,
        }

    def set(self, seconds: float) -> None:
        """Sets how far the clock is from the right time."""
        write_file_atomically(self._path, f"{seconds:+.3f}".encode())

    def jump(self, rng: np.random.Generator) -> None:
        """Lets the clock jump by up to twelve hours, back or forth."""
        self.set(float(rng.uniform(-3600, 3600) * _FARTHEST_HOURS))

    def is_seen_by(self, process: int) -> bool:
        """Whether a process sees the clock: it has loaded the library, which reads the file once a second."""
        try:
            return Path(self._library).name in Path(f"/proc/{process}/maps").read_text("utf-8")
        except OSError:
            return False

    def _is_shifted(self) -> bool:
        command = [sys.executable, "-c", "import time; time.sleep(0.01); print(time.time())"]
        done = subprocess.run(command, capture_output=True, text=True, env=os.environ | dict(self.environment))
        return done.returncode == 0 and abs(float(done.stdout) - time.time() - _SURE_SECONDS) < _SURE_SECONDS / 2
