"""Point encoder: Point Transformer V3 in plain torch, from an object's surface points to 64 numbers.

``cloud`` is what goes in, ``encoder`` what it is asked, ``checkpoint`` its weights on disk, ``pretrain`` how they are made;
below them ``transformer``, ``blocks``, ``level`` and ``serialization`` are the network.
"""

from models.point_encoder.checkpoint import DEFAULT_WEIGHTS, load, load_default, load_published, save
from models.point_encoder.cloud import PUBLISHED, PointCloud, Preprocessing
from models.point_encoder.encoder import FEATURE_CHANNELS, PointCodes, PointEncoder, one_thread
from models.point_encoder.transformer import BASE, EMBEDDED, TransformerConfig

__all__ = [
    "BASE",
    "DEFAULT_WEIGHTS",
    "EMBEDDED",
    "FEATURE_CHANNELS",
    "PUBLISHED",
    "PointCloud",
    "PointCodes",
    "PointEncoder",
    "Preprocessing",
    "TransformerConfig",
    "load",
    "load_default",
    "load_published",
    "one_thread",
    "save",
]
