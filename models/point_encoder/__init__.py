"""Point encoder: Point Transformer V3 in plain torch, which maps an object's surface points to 64 numbers.

``cloud`` prepares the input, ``encoder`` computes features, ``checkpoint`` reads and writes weights, and ``pretrain`` trains
them. The network is in ``transformer``, ``blocks``, ``level`` and ``serialization``.
"""

from models.point_encoder.checkpoint import DEFAULT_WEIGHTS, load, load_default, load_published, save
from models.point_encoder.cloud import PUBLISHED, PointCloud, Preprocessing
from models.point_encoder.encoder import FEATURE_CHANNELS, PointCodes, PointEncoder
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
    "save",
]
