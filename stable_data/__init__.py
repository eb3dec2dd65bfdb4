"""Scenes, geometry, verdicts and tables: the light library that policy-training jobs install.

The names below are what most users need first. Each is imported when it is first used, so that ``import stable_data`` itself
loads neither the tables nor the geometry; a missing extra is named with the command that installs it.
"""

from importlib import import_module
from typing import TYPE_CHECKING

__version__ = "0.1.0"

__all__ = [
    "AssetStore",
    "MesaTaskDataset",
    "RunFolder",
    "Scene",
    "SceneSelection",
    "TableDataset",
    "TableStream",
    "TabletopEnv",
    "audit_scene",
    "collate_scenes",
    "export_run",
    "lint_folder",
    "make_env",
    "parse_filter",
    "run_store",
    "scene_from_row",
]

if TYPE_CHECKING:
    from stable_data.assets.run_assets import run_store
    from stable_data.assets.store import AssetStore
    from stable_data.export.exporter import export_run
    from stable_data.mesatask.dataset import MesaTaskDataset
    from stable_data.mesatask.lint import lint_folder
    from stable_data.metrics.audit import audit_scene
    from stable_data.scene import Scene
    from stable_data.simulation.gym_env import TabletopEnv, make_env
    from stable_data.simulation.run_reader import SceneSelection
    from stable_data.storage.filter_expression import parse_filter
    from stable_data.storage.run_folder import RunFolder
    from stable_data.storage.schemas import scene_from_row
    from stable_data.storage.torch_dataset import TableDataset, TableStream, collate_scenes
else:
    _MODULE_OF_NAME = {
        "AssetStore": "assets.store",
        "MesaTaskDataset": "mesatask.dataset",
        "RunFolder": "storage.run_folder",
        "Scene": "scene",
        "SceneSelection": "simulation.run_reader",
        "TableDataset": "storage.torch_dataset",
        "TableStream": "storage.torch_dataset",
        "TabletopEnv": "simulation.gym_env",
        "audit_scene": "metrics.audit",
        "collate_scenes": "storage.torch_dataset",
        "export_run": "export.exporter",
        "lint_folder": "mesatask.lint",
        "make_env": "simulation.gym_env",
        "parse_filter": "storage.filter_expression",
        "run_store": "assets.run_assets",
        "scene_from_row": "storage.schemas",
    }

    def __getattr__(name: str) -> object:
        """A public name, imported from its module; module attributes are looked up here where they are not there yet."""
        if name not in _MODULE_OF_NAME:
            raise AttributeError(f"module {__name__} has no attribute {name}, expected one of {', '.join(__all__)}")
        try:
            found = getattr(import_module(f"{__name__}.{_MODULE_OF_NAME[name]}"), name)
        except ModuleNotFoundError as error:
            from stable_data.extras import install_hint

            hint = install_hint(error)
            if hint is None:
                raise
            raise ModuleNotFoundError(f"{__name__}.{name} {hint}", name=error.name) from error
        globals()[name] = found
        return found

    def __dir__() -> list[str]:
        return sorted({*globals(), *__all__})
