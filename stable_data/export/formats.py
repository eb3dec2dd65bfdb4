"""The formats that scenes are exported to: a new one is a module or an object with these names, and an entry of FORMATS."""

from pathlib import Path
from typing import Protocol

from stable_data.errors import ConfigError
from stable_data.export import glb, mesatask, mjcf
from stable_data.scene import Scene
from stable_data.simulation.scene_geometry import SceneGeometry


class ExportFormat(Protocol):
    """What the module of a format has.

    Attributes:
        ABOUT: What an export is and how it is opened, for its README.
    """

    @property
    def ABOUT(self) -> str:  # noqa: N802 - a constant of a module
        """What an export is and how it is opened."""
        ...

    def scene_path(self, scene: Scene, out: Path) -> Path:
        """The file of a scene that is put in place last: where it is, the scene is exported."""
        ...

    def export_scene(self, solid: SceneGeometry, out: Path) -> None:
        """Writes a scene, each file in one step."""
        ...


FORMATS: dict[str, ExportFormat] = {"glb": glb, "mesatask": mesatask, "mjcf": mjcf}
"""Name -> format. A program adds a format of its own here before it calls ``export_run``: ``examples/own_exporter.py``."""


def format_named(name: str) -> ExportFormat:
    """The format of a name.

    Raises:
        ConfigError: There is none (``format_unknown``).
    """
    if name not in FORMATS:
        raise ConfigError(f"format is {name!r}, expected one of {', '.join(FORMATS)}", "format_unknown")
    return FORMATS[name]
