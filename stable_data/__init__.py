"""Scenes, geometry, verdicts and tables: the light library that policy-training jobs install.

The names below are what most users need first. Each is imported on first use, so ``import stable_data`` loads neither the tables
nor the geometry. If an extra is missing, the error names it and the command that installs it. Type checkers read
``__init__.pyi``.
"""

from importlib import import_module

__version__ = "0.1.0"

_MODULE_OF_NAME = {
    "AssetStore": "assets.store",
    "MesaTaskDataset": "mesatask.dataset",
    "RunFolder": "storage.run_folder",
    "Scene": "scene",
    "SceneIndex": "storage.scene_index",
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
    "scene_from_row": "storage.table_rows",
}
__all__ = sorted(_MODULE_OF_NAME)


def __getattr__(name: str) -> object:
    """Imports a public name on first use; Python calls this for each attribute that the module does not have yet."""
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
