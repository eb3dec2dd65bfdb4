"""Pictures of scenes on a report page; the page is written even if a picture fails."""

from collections.abc import Callable, Iterable, Sequence
from html import escape
from typing import Any, TypeAlias

from pipelines.reports.html import image_uri
from stable_data.assets.store import AssetStore
from stable_data.errors import ConfigError
from stable_data.geometry.mesh import Mesh
from stable_data.scene import Scene
from stable_data.simulation.render import object_colour, render_scene
from stable_data.simulation.scene_geometry import SceneGeometry

Shown: TypeAlias = Sequence[tuple[Any, str]]
"""Pictures, (H, W, 3) uint8, each with its caption in HTML."""

_SIZE = (512, 320)  # of pictures on a page, pixels; wide, because tables are wide


def draw_scene(scene: Scene, store: AssetStore, size: tuple[int, int] = _SIZE) -> Any:
    """A picture of a scene, (H, W, 3) uint8, with the looks or the colours of its assets if they are known.

    Args:
        scene: The scene.
        store: Its assets.
        size: Width and height, pixels.

    Raises:
        ConfigError: The machine cannot render (``no_gl``).
    """
    geometry = SceneGeometry.of(scene, store)
    meshes = [Mesh(s.vertices, s.faces) if s.is_exact else None for s in geometry.shapes]
    colors = [store.paint_of(o) or object_colour(o) for o in geometry.scene.objects]
    looks = [None if mesh is None else geometry.look(k) for k, mesh in enumerate(geometry.meshes)]
    return render_scene(geometry.scene, meshes, size=size, colors=colors, looks=looks, support=geometry.support)


def picture_grid(scenes: Iterable[tuple[str, Callable[[], Shown]]]) -> Iterable[str]:
    """A grid of pictures.

    Args:
        scenes: The name of each scene, and a function that draws its pictures.
    """
    yield "<div class=grid>"
    for name, draw in scenes:
        try:
            shown = draw()
        except ConfigError as error:  # this machine cannot render any picture
            yield f'</div><p class="note">{escape(str(error))}</p>'
            return
        except Exception as error:  # noqa: BLE001 - see the module
            yield f'<p class="note">{escape(name)} cannot be rendered: {escape(f"{type(error).__name__}: {error}")}</p>'
            continue
        for picture, caption in shown:
            yield f'<figure><img alt="{escape(name)}" src="{image_uri(picture)}"><figcaption>{caption}</figcaption></figure>'
    yield "</div>"
