"""MuJoCo, told how to draw before it is first imported: ``from stable_data.simulation.mujoco_import import mujoco``.

On Linux it draws without a display where EGL is there. It reads that once, at its first import, whichever module does it: so
all of ours import it from here.
"""

import ctypes.util
import os
import sys

if sys.platform == "linux" and ctypes.util.find_library("EGL"):
    os.environ.setdefault("MUJOCO_GL", "egl")

import mujoco

__all__ = ["mujoco"]
