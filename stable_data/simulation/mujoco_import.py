"""MuJoCo with its renderer chosen before the first import: ``from stable_data.simulation.mujoco_import import mujoco``.

On Linux MuJoCo renders without a display if EGL is installed. It reads this choice once, at its first import, by any module.
Therefore all modules of this project import it from here.
"""

import ctypes.util
import os
import sys
from collections.abc import Iterator
from contextlib import contextmanager

if sys.platform == "linux" and ctypes.util.find_library("EGL"):
    os.environ.setdefault("MUJOCO_GL", "egl")

import mujoco

__all__ = ["mujoco", "without_log_file"]


@contextmanager
def without_log_file() -> Iterator[None]:
    """Keeps MuJoCo from writing its warnings to a file in the working directory; what follows gives the same information."""
    before = mujoco.get_mju_user_warning()
    mujoco.set_mju_user_warning(lambda _: None)
    try:
        yield
    finally:
        mujoco.set_mju_user_warning(before)
