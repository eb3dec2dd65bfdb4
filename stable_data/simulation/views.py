"""Pictures of scenes with their geometry, and the two views of the paper's GPT-score and FID.

The paper follows MesaTask (appendix, GPT-score): each scene is rendered from the front and in perspective. :func:`draw_view` draws
these as the format does: the camera looks at the centre of objects and table, from the directions (0, -1, 0.6) and (-0.7, -0.7, 0.7),
through a 50 mm lens on a 36 mm sensor, so the field of view is fixed. Its distance is 1.5 times the largest dimension of table and
objects together, or more, so that the whole table and the highest object are in the picture. Light and surroundings are the same for
every scene: a plain grey floor, and neither walls nor labels.
"""

from stable_data.geometry.mesh import Mesh
from stable_data.simulation.offscreen import Picture
from stable_data.simulation.render import FRONT_SIZE, View, object_colour, render_scene
from stable_data.simulation.room import Surroundings
from stable_data.simulation.scene_geometry import SceneGeometry

SCORED_VIEWS: tuple[View, ...] = ("front", "perspective")
"""The views that a judge of pictures sees (paper, appendix, GPT-score). FID takes the first one."""


def draw_geometry(
    geometry: SceneGeometry,
    size: tuple[int, int],
    view: View = "front",
    surroundings: Surroundings = "room",
) -> Picture:
    """Draws a scene with the looks or the colours of its assets if they are known.

    Args:
        geometry: The scene.
        size: Width and height, pixels.
        view: The side from which the camera looks.
        surroundings: What is around the table.

    Returns:
        (H, W, 3) uint8; the same scene gives the same picture on one machine.

    Raises:
        ConfigError: The machine cannot render (``no_gl``).
    """
    meshes = [Mesh(s.vertices, s.faces) if s.is_exact else None for s in geometry.shapes]
    colors = [geometry.store.paint_of(o) or object_colour(o) for o in geometry.scene.objects]
    looks = [None if mesh is None else geometry.look(k) for k, mesh in enumerate(geometry.meshes)]
    return render_scene(
        geometry.scene,
        meshes,
        size=size,
        view=view,
        colors=colors,
        looks=looks,
        support=geometry.support,
        surroundings=surroundings,
    )


def draw_view(
    geometry: SceneGeometry,
    view: View = "front",
    size: tuple[int, int] = FRONT_SIZE,
    surroundings: Surroundings = "floor",
) -> Picture:
    """Draws a scene in neutral surroundings, for a judge or a distance of pictures.

    Args:
        geometry: The scene.
        view: The side from which the camera looks.
        size: Width and height, pixels; (299, 299) needs no change of size for Inception.
        surroundings: What is around the table; ``none`` is the black background on which MesaTask computes FID.

    Returns:
        (H, W, 3) uint8; the same scene gives the same picture on one machine.

    Raises:
        ConfigError: The machine cannot render (``no_gl``).
    """
    return draw_geometry(geometry, size, view, surroundings)


def draw_scored_views(
    geometry: SceneGeometry, size: tuple[int, int] = FRONT_SIZE, surroundings: Surroundings = "floor"
) -> dict[View, Picture]:
    """Draws the views of ``SCORED_VIEWS``, see :func:`draw_view`.

    Raises:
        ConfigError: The machine cannot render (``no_gl``).
    """
    return {view: draw_view(geometry, view, size, surroundings) for view in SCORED_VIEWS}
