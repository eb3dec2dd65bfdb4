"""Shifts ``time.time`` by the seconds that a file states; Python runs this file when it starts, see ``shifted_clock.py``."""

import os
import time

_PATH = os.environ.get("SHIFTED_CLOCK", "")
_LOOK_SECONDS = 1.0
_time, _time_ns, _monotonic = time.time, time.time_ns, time.monotonic
_shift, _looked = 0.0, -_LOOK_SECONDS


def _seconds() -> float:
    global _shift, _looked
    if _monotonic() - _looked >= _LOOK_SECONDS:
        _looked = _monotonic()
        try:
            with open(_PATH) as stream:  # noqa: PTH123 - as little as possible is imported
                _shift = float(stream.read())
        except (OSError, ValueError):
            pass
    return _shift


def _shifted_time() -> float:
    return _time() + _seconds()


def _shifted_time_ns() -> int:
    return _time_ns() + int(1e9 * _seconds())


if _PATH:
    time.time, time.time_ns = _shifted_time, _shifted_time_ns
