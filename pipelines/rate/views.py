"""The two pictures of a scene that a judge sees."""

from stable_data.geometry.mesh import Mesh
from stable_data.simulation.offscreen import Picture
from stable_data.simulation.render import View, object_colour, render_scene
from stable_data.simulation.scene_geometry import SceneGeometry


def scene_views(geometry: SceneGeometry, size: int) -> tuple[Picture, Picture]:
    """Renders a scene from the front and from the left of the front.

    Args:
        geometry: The scene.
        size: Width and height, pixels.

    Returns:
        The front and the perspective picture, (H, W, 3) uint8 each.

    Raises:
        ConfigError: The machine cannot render (``no_gl``).
    """
    meshes = [Mesh(s.vertices, s.faces) if s.is_exact else None for s in geometry.shapes]
    colors = [geometry.store.paint_of(o) or object_colour(o) for o in geometry.scene.objects]
    looks = [None if mesh is None else geometry.look(k) for k, mesh in enumerate(geometry.meshes)]

    def seen(view: View) -> Picture:
        return render_scene(
            geometry.scene, meshes, size=(size, size), view=view, colors=colors, looks=looks, support=geometry.support
        )

    return seen("front"), seen("perspective")
