"""MuJoCo with its renderer chosen before the first import: ``from stable_data.simulation.mujoco_import import mujoco``.

On Linux MuJoCo renders without a display if EGL is installed. It reads this choice once, at its first import, by any module.
Therefore all modules of this project import it from here.
"""

import ctypes.util
import os
import sys

if sys.platform == "linux" and ctypes.util.find_library("EGL"):
    os.environ.setdefault("MUJOCO_GL", "egl")

import mujoco

__all__ = ["mujoco"]
