"""Which surface is seen at each pixel of a picture of a scene."""

from collections.abc import Sequence

import numpy as np

from stable_data.geometry.mesh import Mesh, double_areas
from stable_data.scene import FloatArray, IntArray, Scene
from stable_data.simulation.mujoco_import import mujoco
from stable_data.simulation.offscreen import draw_segments
from stable_data.simulation.render import View, add_camera, add_triangles, set_lighting
from stable_data.simulation.scene_geometry import SceneGeometry

NOTHING = -1
"""Value of a pixel at which no surface is seen."""

_FLATTEST = 1e-14  # double area of a face that is not drawn, m²


def segment_view(
    scene: Scene, surfaces: Sequence[Mesh], low: FloatArray, high: FloatArray, *, size: tuple[int, int], view: View
) -> IntArray:
    """Returns the index of the surface that is seen at each pixel, (H, W) int64; NOTHING where none is.

    The camera is that of :func:`stable_data.simulation.render.render_scene`, so that the pixels are those of its picture. Table and
    room hide nothing.

    Args:
        scene: The scene, whose table decides from how high the camera looks below a ceiling.
        surfaces: The surfaces, world frame, metres; one without an area is not seen.
        low: Lowest corner of what the picture shows, (3,), metres (``scene_bounds``).
        high: Highest corner.
        size: Width and height, pixels.
        view: The side from which the camera looks.

    Raises:
        ConfigError: The machine cannot render (``no_gl``).
    """
    spec = mujoco.MjSpec()
    set_lighting(spec, size)
    spec.visual.quality.offsamples = 0  # a mean of two indices is a third one
    drawn = list[int]()
    for k, surface in enumerate(surfaces):
        triangles = surface.triangles[double_areas(surface) > _FLATTEST]  # MuJoCo refuses a surface without an area
        if len(triangles):
            add_triangles(spec, f"surface_{k}", triangles)
            drawn.append(k)
    spec.stat.center, spec.stat.extent = ((low + high) / 2).tolist(), float((high - low).max())
    add_camera(spec, low, high, view, size, scene.table)
    geoms = draw_segments(spec.compile(), "view", size)
    return np.append(np.array(drawn, np.int64), NOTHING)[geoms]  # geom -1, none, reads the last one


def segment_scene(
    geometry: SceneGeometry, surfaces: Sequence[Mesh], *, size: tuple[int, int], view: View = "front"
) -> IntArray:
    """Returns the index of the surface that is seen at each pixel of a picture of a scene, (H, W) int64; NOTHING where none is.

    Args:
        geometry: The scene; the pixels are those of :func:`stable_data.simulation.views.draw_geometry`.
        surfaces: The surfaces, world frame, metres.
        size: Width and height, pixels.
        view: The side from which the camera looks.

    Raises:
        ConfigError: The machine cannot render (``no_gl``).
    """
    low, high = geometry.seen_bounds
    return segment_view(geometry.scene, surfaces, low, high, size=size, view=view)
