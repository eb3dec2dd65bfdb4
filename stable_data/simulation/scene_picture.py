"""Pictures of scenes with all that is known of their looks, and which surface is seen at each of their pixels."""

from collections.abc import Sequence

from stable_data.geometry.mesh import Mesh
from stable_data.geometry.mesh_colors import Paint
from stable_data.scene import IntArray
from stable_data.simulation.offscreen import Picture
from stable_data.simulation.render import View, object_colour, render_scene
from stable_data.simulation.scene_geometry import SceneGeometry
from stable_data.simulation.segmentation import segment_view


def draw_scene(geometry: SceneGeometry, *, size: tuple[int, int], view: View = "front") -> Picture:
    """Draws a scene with the looks or the colours of its assets if they are known.

    Args:
        geometry: The scene.
        size: Width and height, pixels.
        view: The side from which the camera looks.

    Raises:
        ConfigError: The machine cannot render (``no_gl``).
    """
    meshes = [Mesh(s.vertices, s.faces) if s.is_exact else None for s in geometry.shapes]
    colors: list[str | Paint] = [geometry.store.paint_of(o) or object_colour(o) for o in geometry.scene.objects]
    looks = [None if mesh is None else geometry.look(k) for k, mesh in enumerate(geometry.meshes)]
    return render_scene(geometry.scene, meshes, size=size, view=view, colors=colors, looks=looks, support=geometry.support)


def segment_scene(
    geometry: SceneGeometry, surfaces: Sequence[Mesh], *, size: tuple[int, int], view: View = "front"
) -> IntArray:
    """Returns the index of the surface that is seen at each pixel of :func:`draw_scene`, (H, W) int64, -1 where none is.

    Args:
        geometry: The scene.
        surfaces: The surfaces, world frame, metres.
        size: Width and height, pixels.
        view: The side from which the camera looks.

    Raises:
        ConfigError: The machine cannot render (``no_gl``).
    """
    low, high = geometry.seen_bounds
    return segment_view(geometry.scene, surfaces, low, high, size=size, view=view)
