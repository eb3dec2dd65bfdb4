"""Scenes on a report page: a picture of each, and beside the page a page on which the scene can be turned.

``report/scenes/NAME.html`` shows the scenes of one entry; all of these pages share ``report/model-viewer-umd.min.js``. The report is
written even if a scene cannot be drawn; where a machine cannot draw any picture, the pages to turn are still there.
"""

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from html import escape
from typing import Any

from pipelines.reports.html import image_uri
from stable_data.assets.store import AssetStore
from stable_data.atomic_files import safe_file_name
from stable_data.errors import ConfigError
from stable_data.scene import Scene
from stable_data.simulation.scene_geometry import SceneGeometry
from stable_data.simulation.views import draw_geometry
from stable_data.storage.run_folder import RunFolder
from stable_data.viewer.facts import AssetNotes, SceneFacts
from stable_data.viewer.page import SCRIPT_NAME, PageScene, html_page, script

_SIZE = (512, 320)  # of pictures on a page, pixels; wide, because tables are wide


@dataclass(frozen=True, eq=False)
class ShownScene:
    """A scene of a report.

    Attributes:
        scene: The scene.
        caption: Its caption, HTML.
        title: Its name on its own page, such as ``before``; empty: its id.
        row: Its row of ``scenes`` or ``rejected``, or the columns of a metric card; None if it was not judged.
        size: Width and height of its picture, pixels.
    """

    scene: Scene
    caption: str
    title: str = ""
    row: Mapping[str, Any] | None = None
    size: tuple[int, int] = _SIZE


def draw_scene(scene: Scene, store: AssetStore, size: tuple[int, int] = _SIZE) -> Any:
    """A picture of a scene, (H, W, 3) uint8, with the looks or the colours of its assets if they are known.

    Args:
        scene: The scene.
        store: Its assets.
        size: Width and height, pixels.

    Raises:
        ConfigError: The machine cannot render (``no_gl``).
    """
    return draw_geometry(SceneGeometry.of(scene, store), size)


class SceneGrids:
    """Grids of scenes on the report page of a run.

    Args:
        folder: The run, into which the pages of the scenes are written.
        store: The assets of the scenes.
    """

    def __init__(self, folder: RunFolder, store: AssetStore) -> None:
        self._folder, self._store, self._notes = folder, store, AssetNotes(folder)
        self._no_pictures = ""  # why this machine cannot draw pictures, once that is known
        self._has_script = False

    def grid(self, entries: Iterable[tuple[str, Callable[[], Sequence[ShownScene]]]]) -> Iterable[str]:
        """Yields the HTML of a grid, and writes the pages of its scenes.

        Args:
            entries: The name of each entry, unique in the report, and a function that returns its scenes, which share a page.
        """
        told = bool(self._no_pictures)
        yield "<div class=grid>"
        for name, scenes in entries:
            try:
                figures = list(self._figures(name, scenes()))
            except Exception as error:  # noqa: BLE001 - see the module
                figures = [_note(f"{name} cannot be shown", error)]
            yield from figures
        yield "</div>"
        if self._no_pictures and not told:
            yield f'<p class="note">{escape(self._no_pictures)} The scenes can be turned all the same.</p>'

    def _figures(self, name: str, scenes: Sequence[ShownScene]) -> Iterable[str]:
        shown = [(scene, SceneGeometry.of(scene.scene, self._store)) for scene in scenes]
        drawn = [self._picture(name, geometry, scene.size) for scene, geometry in shown]
        page, problem = self._page(name, shown)
        yield problem
        for k, (scene, (picture, problem)) in enumerate(zip(scenes, drawn, strict=True)):
            image = "" if picture is None else f'<img alt="{escape(name)}" src="{image_uri(picture)}">'
            opened, address = "", f"{page}#scene={k}"
            if page:
                image = f'<a class="turn{"" if image else " bare"}" href="{address}">{image}<span>turn</span></a>'
                opened = f' <a class="open" href="{address}">open</a>'
            yield f"<figure>{image}<figcaption>{scene.caption}{opened}{problem}</figcaption></figure>"

    def _picture(self, name: str, geometry: SceneGeometry, size: tuple[int, int]) -> tuple[Any, str]:
        """A picture of a scene, or None and a note, which is empty if this machine can draw no picture at all."""
        if self._no_pictures:
            return None, ""
        try:
            return draw_geometry(geometry, size), ""
        except Exception as error:  # noqa: BLE001 - see the module
            if isinstance(error, ConfigError) and error.code == "no_gl":
                self._no_pictures = str(error).rstrip(".") + "."
                return None, ""
            return None, _note(f"{name} cannot be rendered", error)

    def _page(self, name: str, shown: Sequence[tuple[ShownScene, SceneGeometry]]) -> tuple[str, str]:
        """Writes the page of an entry; its path below ``report``, or an empty one and a note."""
        path = f"scenes/{safe_file_name(name)}.html"
        try:
            scenes = [PageScene.of(g, SceneFacts.of(g, self._notes, scene.row), scene.title) for scene, g in shown]
            content = html_page(name, scenes, script_path=f"../{SCRIPT_NAME}")
        except Exception as error:  # noqa: BLE001 - see the module
            return "", _note(f"{name} cannot be turned", error)
        if not self._has_script:
            self._folder.write_bytes(f"report/{SCRIPT_NAME}", script())
            self._has_script = True
        self._folder.write_bytes(f"report/{path}", content)
        return path, ""


def _note(what: str, error: Exception) -> str:
    return f'<p class="note">{escape(what)}: {escape(f"{type(error).__name__}: {error}")}</p>'
