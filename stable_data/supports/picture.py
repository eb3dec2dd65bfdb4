"""A picture of a support with its surfaces in colours."""

from collections.abc import Sequence

import numpy as np
import shapely

from stable_data.geometry.mesh import Mesh, double_areas
from stable_data.scene import FloatArray
from stable_data.simulation.mujoco_import import mujoco
from stable_data.simulation.offscreen import Picture, draw_model
from stable_data.simulation.render import PALETTE, View, add_camera, add_lights, add_triangles, rgba, set_lighting
from stable_data.supports.surface import SupportSurface

_BODY = "#9aa0a6"
_OPACITY = 0.35  # of the support, so that inner surfaces are seen
_RISE = 0.002  # of a coloured surface above its plane, metres
_FLATTEST = 1e-12  # double area of a face that is not drawn, m²


def draw_surfaces(
    mesh: Mesh, surfaces: Sequence[SupportSurface], *, size: tuple[int, int] = (512, 384), view: View = "perspective"
) -> Picture:
    """Draws a support, half transparent, and its surfaces, each in the colour :func:`surface_colour` gives it.

    Args:
        mesh: The support, metres, z up.
        surfaces: Its surfaces.
        size: Width and height, pixels.
        view: The side from which the camera looks.

    Raises:
        ConfigError: The machine cannot render (``no_gl``).
    """
    spec = mujoco.MjSpec()
    set_lighting(spec, size)
    add_triangles(spec, "support", mesh.triangles[double_areas(mesh) > _FLATTEST], rgba(_BODY, _OPACITY))
    for number, surface in enumerate(surfaces):
        add_triangles(
            spec, f"surface_{number}", np.add(region_triangles(surface), (0.0, 0.0, _RISE)), rgba(surface_colour(number))
        )
    low, high = mesh.vertices.min(axis=0), mesh.vertices.max(axis=0)
    add_lights(spec, low, high)
    add_camera(spec, low, high, view, size)
    lit, _ = draw_model(spec.compile(), "view", size)  # shadows would hide inner surfaces
    return np.ascontiguousarray(lit)


def surface_colour(number: int) -> str:
    """Returns the colour of the surface with that number in a picture, ``#rrggbb``."""
    return PALETTE[number % len(PALETTE)]


def region_triangles(surface: SupportSurface) -> FloatArray:
    """Returns the region of a surface as triangles (F, 3, 3), metres, in the frame of the support."""
    parts = shapely.get_parts(shapely.constrained_delaunay_triangles(shapely.Polygon(surface.outline, surface.holes)))
    flat = np.array([shapely.get_coordinates(shapely.orient_polygons(part))[:3] for part in parts])
    return surface.to_support(np.concatenate([flat, np.zeros((*flat.shape[:2], 1))], axis=2))
