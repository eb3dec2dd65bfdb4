"""The layers of Point Transformer V3: sparse convolution, patch attention, their block, pooling and unpooling.

Submodules have the names of published checkpoints, so that their state dicts load unchanged.
"""

from collections.abc import Sequence
from typing import Any

import torch
from torch import Tensor, nn
from torch.nn import functional

from models.point_encoder.level import KernelMap, VoxelLevel


class SubMConv3d(nn.Module):
    """Convolution (cross-correlation) over occupied voxels only, weight (out, kx, ky, kz, in) as published ("KRSC").

    Args:
        in_channels: Input channels.
        out_channels: Output channels.
        kernel_size: Odd kernel size.
        bias: Whether to add a bias.
    """

    def __init__(self, in_channels: int, out_channels: int, kernel_size: int, *, bias: bool) -> None:
        super().__init__()
        self.kernel_size = kernel_size
        self.weight = nn.Parameter(torch.empty(out_channels, *[kernel_size] * 3, in_channels))
        self.bias = nn.Parameter(torch.zeros(out_channels)) if bias else None
        nn.init.trunc_normal_(self.weight, std=0.02)

    def forward(self, features: Tensor, level: VoxelLevel) -> Tensor:
        """Maps features of a level's voxels, (V, in) to (V, out)."""
        kernel = level.kernel_map(self.kernel_size)
        result: Tensor = _SubM.apply(features, self.weight.flatten(1, 3), kernel)  # type: ignore[no-untyped-call]
        return result if self.bias is None else result + self.bias


class _SubM(torch.autograd.Function):
    """One matrix product per kernel offset; each product adds to a voxel at most once, so sums have a fixed order everywhere."""

    @staticmethod
    def forward(ctx: Any, features: Tensor, weight: Tensor, kernel: KernelMap) -> Tensor:
        ctx.save_for_backward(features, weight)
        ctx.kernel = kernel
        result = features @ weight[:, len(kernel.pairs) // 2].T
        for k, pair in enumerate(kernel.pairs):
            if pair is not None and len(pair[0]):
                result.index_add_(0, pair[0], features.index_select(0, pair[1]) @ weight[:, k].T)
        return result

    @staticmethod
    def backward(ctx: Any, *gradients: Tensor) -> tuple[Tensor, Tensor, None]:
        features, weight = ctx.saved_tensors
        gradient = gradients[0].contiguous()
        middle = len(ctx.kernel.pairs) // 2
        of_features, of_weight = gradient @ weight[:, middle], torch.zeros_like(weight)
        of_weight[:, middle] = gradient.T @ features
        for k, pair in enumerate(ctx.kernel.pairs):
            if pair is not None and len(pair[0]):
                part = gradient.index_select(0, pair[0])
                of_features.index_add_(0, pair[1], part @ weight[:, k])
                of_weight[:, k] = part.T @ features.index_select(0, pair[1])
        return of_features, of_weight, None


class PatchAttention(nn.Module):
    """Softmax attention within patches along a space-filling curve.

    Args:
        channels: C.
        num_heads: Number of attention heads.
        patch_size: Largest number of voxels in a patch.
        curve: Index of the curve.
    """

    def __init__(self, channels: int, num_heads: int, patch_size: int, curve: int) -> None:
        super().__init__()
        self.num_heads, self.patch_size, self.curve = num_heads, patch_size, curve
        self.qkv = nn.Linear(channels, 3 * channels)
        self.proj = nn.Linear(channels, channels)

    def forward(self, features: Tensor, level: VoxelLevel) -> Tensor:
        """Maps features of a level's voxels, (V, C) to (V, C)."""
        patches, channels = level.patches(self.curve, self.patch_size), features.shape[1]
        qkv, found = self.qkv(features), []
        for bucket in patches.buckets:
            parts = qkv.index_select(0, bucket.rows.flatten()).unflatten(0, bucket.rows.shape)  # (P, K, 3 C)
            query, key, value = parts.unflatten(2, (3, self.num_heads, -1)).permute(2, 0, 3, 1, 4)  # (P, heads, K, C / heads)
            attended = functional.scaled_dot_product_attention(query, key, value, attn_mask=bucket.is_key)
            found.append(attended.transpose(1, 2).reshape(-1, channels))
        result: Tensor = self.proj(torch.cat(found).index_select(0, patches.places))
        return result


class Mlp(nn.Module):
    """A two-layer perceptron per voxel."""

    def __init__(self, channels: int, ratio: int = 4) -> None:
        super().__init__()
        self.fc1 = nn.Linear(channels, ratio * channels)
        self.fc2 = nn.Linear(ratio * channels, channels)

    def forward(self, features: Tensor) -> Tensor:
        """(V, C) to (V, C)."""
        result: Tensor = self.fc2(functional.gelu(self.fc1(features)))
        return result


class LayerScale(nn.Module):
    """A learned factor for each channel."""

    def __init__(self, channels: int, value: float) -> None:
        super().__init__()
        self.gamma = nn.Parameter(torch.full((channels,), value))

    def forward(self, features: Tensor) -> Tensor:
        """(V, C) to (V, C)."""
        return features * self.gamma


class Block(nn.Module):
    """Conditional positional encoding by convolution, then attention, then an MLP, each with a residual connection.

    Args:
        channels: C.
        num_heads: Number of attention heads.
        patch_size: Largest number of voxels in a patch.
        curve: Index of the curve.
        layer_scale: Initial factor of the outputs of attention and MLP; None for no factor.
    """

    def __init__(self, channels: int, num_heads: int, patch_size: int, curve: int, layer_scale: float | None) -> None:
        super().__init__()

        def scale() -> nn.Sequential:
            return nn.Sequential(nn.Identity() if layer_scale is None else LayerScale(channels, layer_scale))

        self.cpe = nn.ModuleList(
            [SubMConv3d(channels, channels, 3, bias=True), nn.Linear(channels, channels), nn.LayerNorm(channels)]
        )
        self.norm1 = nn.Sequential(nn.LayerNorm(channels))
        self.ls1 = scale()
        self.attn = PatchAttention(channels, num_heads, patch_size, curve)
        self.norm2 = nn.Sequential(nn.LayerNorm(channels))
        self.ls2 = scale()
        self.mlp = nn.Sequential(Mlp(channels))

    def forward(self, features: Tensor, level: VoxelLevel, convolved: Tensor | None = None) -> Tensor:
        """Maps features of a level's voxels, (V, C) to (V, C); the convolution reads ``convolved`` instead, if given."""
        position = self.cpe[0](features if convolved is None else convolved, level)
        features = features + self.cpe[2](self.cpe[1](position))
        features = features + self.ls1(self.attn(self.norm1(features), level))
        result: Tensor = features + self.ls2(self.mlp(self.norm2(features)))
        return result


class VoxelPooling(nn.Module):
    """Projects features to a coarser level and takes the maximum over merged voxels."""

    def __init__(self, in_channels: int, out_channels: int, norm: nn.Module) -> None:
        super().__init__()
        self.proj = nn.Linear(in_channels, out_channels)
        self.norm = nn.Sequential(norm)

    def forward(self, features: Tensor, cluster: Tensor, num_voxels: int) -> Tensor:
        """Maps (V, in) to (num_voxels, out); ``cluster`` is the coarse voxel of each voxel, (V,)."""
        features = self.proj(features)
        index = cluster[:, None].expand_as(features)
        largest = features.new_zeros(num_voxels, features.shape[1]).scatter_reduce(
            0, index, features, "amax", include_self=False
        )
        return functional.gelu(self.norm(largest))


class VoxelUnpooling(nn.Module):
    """Adds projected features of a coarser level to projected features of the encoder at a finer level."""

    def __init__(self, in_channels: int, skip_channels: int, out_channels: int, norms: Sequence[nn.Module]) -> None:
        super().__init__()
        self.proj = nn.Sequential(nn.Linear(in_channels, out_channels), norms[0], nn.GELU())
        self.proj_skip = nn.Sequential(nn.Linear(skip_channels, out_channels), norms[1], nn.GELU())

    def forward(self, features: Tensor, skip: Tensor, cluster: Tensor) -> tuple[Tensor, Tensor]:
        """Returns the features of the finer voxels, (V, out), and the encoder's part of the sum, (V, out)."""
        own = self.proj_skip(skip)
        return own + self.proj(features).index_select(0, cluster), own
