"""The export formats. A new format is a module or an object with the members of ExportFormat, and an entry of FORMATS."""

from importlib import import_module
from pathlib import Path
from typing import Protocol

from stable_data.errors import ConfigError
from stable_data.export import arena, glb, manipvqa, mesatask, mjcf, mjcf_objects, sdformat, urdf
from stable_data.export.usd import UsdFormat
from stable_data.scene import Scene
from stable_data.simulation.scene_geometry import SceneGeometry


class ExportFormat(Protocol):
    """The members of a format's module: a constant and two functions."""

    @property
    def ABOUT(self) -> str:  # noqa: N802 - a constant of a module
        """Description of an export and how to open it."""
        ...

    def scene_path(self, scene: Scene, out: Path) -> Path:
        """The file of a scene that is written last: if it exists, the scene is exported."""
        ...

    def export_scene(self, geometry: SceneGeometry, out: Path) -> None:
        """Writes a scene; each file is written atomically.

        Args:
            geometry: The scene with its geometry.
            out: The folder of the export.

        Raises:
            OSError: The folder cannot be written.
        """
        ...


FORMATS: dict[str, ExportFormat] = {
    "arena": arena,
    "glb": glb,
    "manipvqa": manipvqa,
    "mesatask": mesatask,
    "mjcf": mjcf,
    "mjcf-objects": mjcf_objects,
    "sdformat": sdformat,
    "urdf": urdf,
    "usd": UsdFormat(),
    "usd:isaaclab": UsdFormat("isaaclab"),
}
"""Name -> format; ``NAME:FLAVOUR`` is a variant for one consumer. A program adds its own format here before it calls
``export_run``, see ``examples/own_exporter.py``. A format that imports an optional package when it exports a scene names the
package in ``NEEDS``; one with files about all scenes has a function ``finish(out)``, which returns a warning or None.
"""


def format_named(name: str) -> ExportFormat:
    """Returns the format of a name.

    Raises:
        ConfigError: There is none (``format_unknown``).
        ModuleNotFoundError: It needs a package that is not installed.
    """
    if name not in FORMATS:
        raise ConfigError(f"format is {name!r}, expected one of {', '.join(FORMATS)}", "format_unknown")
    for module in getattr(FORMATS[name], "NEEDS", ()):
        import_module(module)
    return FORMATS[name]
