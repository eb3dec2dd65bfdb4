"""Reads and writes the MesaTask-10K format. Only this package knows its centimetres, xyzw rotations and z_rotation.

``dataset`` opens a folder; ``layout`` reads a layout.json or a language model's reply, and ``entry`` one object of it;
``writing`` writes them; ``task_info`` reads and writes the file of that name; ``library`` reads annotations and asset files;
``features`` reads and writes text features; ``asset_catalog`` makes an asset library of a folder; ``lint`` audits its scenes.
"""

from stable_data.assets.annotation import AssetAnnotation, category_of
from stable_data.mesatask.dataset import TABLE_TYPES, MesaTaskDataset
from stable_data.mesatask.features import read_text_features, write_text_features
from stable_data.mesatask.layout import read_layout, read_reply_layout
from stable_data.mesatask.library import AssetFolder, read_annotation, write_annotation
from stable_data.mesatask.task_info import read_task_info, write_task_info
from stable_data.mesatask.writing import write_annotations, write_asset, write_layout, write_reply_layout, write_scene
from stable_data.position_convention import PositionConvention, has_size, keeps_box, reveals_convention, to_box_centre
from stable_data.rotations import yaw_frame_box

__all__ = [
    "TABLE_TYPES",
    "AssetAnnotation",
    "AssetFolder",
    "MesaTaskDataset",
    "PositionConvention",
    "category_of",
    "has_size",
    "keeps_box",
    "read_annotation",
    "read_layout",
    "read_reply_layout",
    "read_task_info",
    "read_text_features",
    "reveals_convention",
    "to_box_centre",
    "write_annotation",
    "write_annotations",
    "write_asset",
    "write_layout",
    "write_reply_layout",
    "write_scene",
    "write_task_info",
    "write_text_features",
    "yaw_frame_box",
]
