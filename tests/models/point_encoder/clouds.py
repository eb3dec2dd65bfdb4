"""Clouds and voxels that the tests of the point encoder share."""

import numpy as np
import torch
from torch import Tensor

from models.point_encoder.cloud import PointCloud, Preprocessing
from models.point_encoder.encoder import PointEncoder
from models.point_encoder.level import VoxelLevel
from models.point_encoder.serialization import CURVES
from models.point_encoder.transformer import TransformerConfig
from stable_data.geometry.shape import Shape

TINY = TransformerConfig(
    norm="ln",
    patch_size=24,
    enc_depths=(1, 2),
    enc_channels=(16, 32),
    enc_heads=(1, 2),
    dec_depths=(1,),
    dec_channels=(64,),
    dec_heads=(4,),
)
"""Two stages, and patches so short that clouds have several."""


def tiny_encoder(config: TransformerConfig = TINY, preprocessing: Preprocessing | None = None) -> PointEncoder:
    torch.manual_seed(0)
    return PointEncoder(config, preprocessing or Preprocessing(num_points=128, grid_size=1 / 4)).eval()


def box_cloud(x: float, y: float, z: float, num_points: int = 128) -> PointCloud:
    return PointCloud.of_shape(Shape.box((x, y, z)), num_points)


def clouds() -> list[PointCloud]:
    return [box_cloud(0.1, 0.1, 0.1), box_cloud(0.3, 0.02, 0.05), box_cloud(0.2, 0.2, 0.01), box_cloud(0.04, 0.05, 0.4)]


def shuffled(cloud: PointCloud, rng: np.random.Generator) -> PointCloud:
    order = rng.permutation(len(cloud.points))
    return PointCloud(cloud.points[order], cloud.normals[order], cloud.size)


def random_voxels(num_each: tuple[int, ...], span: int, seed: int = 0) -> tuple[Tensor, Tensor]:
    """Coordinates and clouds of voxels in no order, none twice."""
    generator = torch.Generator().manual_seed(seed)
    coords, batch = [], []
    for cloud, num in enumerate(num_each):
        place = torch.randperm(span**3, generator=generator)[:num]
        coords.append(torch.stack([place // span**2, place // span % span, place % span], dim=1))
        batch.append(torch.full((num,), cloud))
    order = torch.randperm(sum(num_each), generator=generator)
    return torch.cat(coords)[order], torch.cat(batch)[order]


def level_of(num_each: tuple[int, ...], span: int, seed: int = 0) -> VoxelLevel:
    return VoxelLevel.of_voxels(*random_voxels(num_each, span, seed), CURVES, with_margin=False)[0]
