"""Pictures of MuJoCo models without a display.

A thread keeps its OpenGL context, because in software a new one compiles all its shaders again, which takes longer than a picture.
"""

import os
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from functools import lru_cache
from typing import Any, TypeAlias

import numpy as np
import numpy.typing as npt

from stable_data.errors import ConfigError
from stable_data.scene import FloatArray, IntArray
from stable_data.simulation.mujoco_import import mujoco

Picture: TypeAlias = npt.NDArray[np.uint8]
"""(H, W, 3) uint8, red, green, blue."""

_EMPTY = '<mujoco><worldbody><camera name="view"/></worldbody></mujoco>'
_MOST_GEOMS = 10_000  # of a picture
_SUNS, _SUN_RADIUS = 4, 0.04  # directions of a light whose shadows are averaged, and their angle to the middle, radians
_kept = threading.local()


def open_renderer(model: mujoco.MjModel, size: tuple[int, int]) -> mujoco.Renderer:
    """Opens an off-screen renderer of a model; its OpenGL context exists until it is closed.

    ``size`` is width and height, pixels.

    Raises:
        ConfigError: The machine cannot render (``no_gl``).
    """
    try:
        return mujoco.Renderer(model, height=size[1], width=size[0])
    except _FAILURES as error:
        raise _no_gl(error) from error


def draw_model(model: mujoco.MjModel, camera: str, size: tuple[int, int]) -> tuple[Picture, FloatArray]:
    """Draws a model in its first pose.

    Args:
        model: The model; its off-screen buffer has the size of the pictures or more.
        camera: Name of the camera.
        size: Width and height, pixels.

    Returns:
        The picture without shadows, and the mean of pictures whose light comes from several directions close to each other: the
        shadows of what is high have soft edges. Both are the same if no light casts shadows.

    Raises:
        ConfigError: The machine cannot render (``no_gl``).
    """
    with _drawing(model, camera) as (scene, context):
        shaded = [_read(scene, context, size) for _ in _sun_directions(scene)]
        scene.flags[mujoco.mjtRndFlag.mjRND_SHADOW] = 0
        plain = _read(scene, context, size)
        return plain, np.mean(shaded or [plain], axis=0)


def draw_segments(model: mujoco.MjModel, camera: str, size: tuple[int, int]) -> IntArray:
    """Draws which geom of a model is seen at each pixel, in its first pose.

    Args:
        model: The model; its off-screen buffer has the size of the picture or more, and one sample for each pixel.
        camera: Name of the camera.
        size: Width and height, pixels.

    Returns:
        The index of the geom, -1 where none is, (H, W) int64.

    Raises:
        ConfigError: The machine cannot render (``no_gl``).
    """
    with _drawing(model, camera) as (scene, context):
        scene.flags[mujoco.mjtRndFlag.mjRND_SEGMENT] = scene.flags[mujoco.mjtRndFlag.mjRND_IDCOLOR] = 1
        red, green, blue = np.moveaxis(_read(scene, context, size).astype(np.int64), 2, 0)
        geom = np.full(scene.ngeom + 1, -1, np.int64)
        for drawn in scene.geoms[: scene.ngeom]:
            if drawn.segid != -1 and drawn.objtype == mujoco.mjtObj.mjOBJ_GEOM:
                geom[drawn.segid + 1] = drawn.objid
        seen: IntArray = geom[red + 256 * green + 65536 * blue]  # black, 0, is the background
        return seen


@contextmanager
def _drawing(model: mujoco.MjModel, camera: str) -> Iterator[tuple[mujoco.MjvScene, mujoco.MjrContext]]:
    """What a camera sees of a model, and a context to draw it."""
    data, view = mujoco.MjData(model), mujoco.MjvCamera()
    mujoco.mj_forward(model, data)
    view.type, view.fixedcamid = mujoco.mjtCamera.mjCAMERA_FIXED, model.camera(camera).id
    scene = mujoco.MjvScene(model, maxgeom=_MOST_GEOMS)
    mujoco.mjv_updateScene(model, data, mujoco.MjvOption(), None, view, mujoco.mjtCatBit.mjCAT_ALL, scene)
    try:
        _make_context_current()
        context = mujoco.MjrContext(model, mujoco.mjtFontScale.mjFONTSCALE_100)
    except _FAILURES as error:
        raise _no_gl(error) from error
    try:
        mujoco.mjr_setBuffer(mujoco.mjtFramebuffer.mjFB_OFFSCREEN, context)
        yield scene, context
    finally:
        context.free()


def _sun_directions(scene: mujoco.MjvScene) -> Iterator[None]:
    """Turns the lights that cast shadows to one direction after the other; none without such lights."""
    lights = [light for light in scene.lights[: scene.nlight] if light.castshadow]
    if not lights:
        return
    middles = [np.array(light.dir) for light in lights]
    for angle in 2 * np.pi * np.arange(_SUNS) / _SUNS:
        for light, middle in zip(lights, middles, strict=True):
            right = np.cross(middle, [0.0, 1.0, 0.0])
            right /= np.linalg.norm(right)
            turned = middle + _SUN_RADIUS * (np.cos(angle) * right + np.sin(angle) * np.cross(right, middle))
            light.dir = turned / np.linalg.norm(turned)
        yield


@lru_cache(maxsize=1)
def can_render() -> bool:
    """Whether the machine can render."""
    try:
        draw_model(mujoco.MjSpec.from_string(_EMPTY).compile(), "view", (8, 8))
    except ConfigError:
        return False
    return True


def _make_context_current() -> None:
    if not hasattr(_kept, "context"):
        _kept.context = mujoco.GLContext(64, 64)
    _kept.context.make_current()


def _read(scene: mujoco.MjvScene, context: mujoco.MjrContext, size: tuple[int, int]) -> Picture:
    viewport, picture = mujoco.MjrRect(0, 0, *size), np.empty((size[1], size[0], 3), np.uint8)
    mujoco.mjr_render(viewport, scene, context)
    mujoco.mjr_readPixels(picture, None, viewport, context)
    return picture[::-1]


_FAILURES: Any = (ImportError, AttributeError, RuntimeError, mujoco.FatalError)


def _no_gl(error: Exception) -> ConfigError:
    # True if MuJoCo was imported before `stable_data.simulation.mujoco_import` chose the renderer.
    is_late = os.environ.get("MUJOCO_GL") == "egl" and "egl" not in getattr(mujoco, "GLContext", int).__module__
    late = "import stable_data.simulation.gym_env before mujoco, or set MUJOCO_GL=egl for both; else " if is_late else ""
    return ConfigError(
        f"rendering failed: OpenGL does not start ({type(error).__name__}: {error}); {late}"
        "install libegl1 and libgl1-mesa-dri, or set MUJOCO_GL to egl, osmesa or glfw, or continue without pictures",
        "no_gl",
    )
