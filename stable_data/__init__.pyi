from stable_data.assets.run_assets import run_store as run_store
from stable_data.assets.store import AssetStore as AssetStore
from stable_data.export.exporter import export_run as export_run
from stable_data.mesatask.dataset import MesaTaskDataset as MesaTaskDataset
from stable_data.mesatask.lint import lint_folder as lint_folder
from stable_data.metrics.audit import audit_scene as audit_scene
from stable_data.scene import Scene as Scene
from stable_data.simulation.gym_env import TabletopEnv as TabletopEnv
from stable_data.simulation.gym_env import make_env as make_env
from stable_data.simulation.run_reader import SceneSelection as SceneSelection
from stable_data.storage.filter_expression import parse_filter as parse_filter
from stable_data.storage.run_folder import RunFolder as RunFolder
from stable_data.storage.scene_index import SceneIndex as SceneIndex
from stable_data.storage.table_rows import scene_from_row as scene_from_row
from stable_data.storage.torch_dataset import TableDataset as TableDataset
from stable_data.storage.torch_dataset import TableStream as TableStream
from stable_data.storage.torch_dataset import collate_scenes as collate_scenes

__version__: str
__all__ = [
    "AssetStore",
    "MesaTaskDataset",
    "RunFolder",
    "Scene",
    "SceneIndex",
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
