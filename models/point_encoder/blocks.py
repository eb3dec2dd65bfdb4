"""The layers of Point Transformer V3: sparse convolution, patch attention, their block, pooling and unpooling.

Names of the parts are those of published checkpoints, so that a state dict loads as it is.
"""

from collections.abc import Sequence
from typing import Any

import torch
from torch import Tensor, nn
from torch.nn import functional

from models.point_encoder.level import KernelMap, VoxelLevel


class SubMConv3d(nn.Module):
    """Convolution over occupied voxels only, cross-correlation, weight (out, kx, ky, kz, in) as published ("KRSC").

    Args:
        in_channels: Read.
        out_channels: Written.
        kernel_size: Odd.
        bias: Whether one is added.
    """

    def __init__(self, in_channels: int, out_channels: int, kernel_size: int, *, bias: bool) -> None:
        super().__init__()
        self.kernel_size = kernel_size
        self.weight = nn.Parameter(torch.empty(out_channels, *[kernel_size] * 3, in_channels))
        self.bias = nn.Parameter(torch.zeros(out_channels)) if bias else None
        nn.init.trunc_normal_(self.weight, std=0.02)

    def forward(self, features: Tensor, level: VoxelLevel) -> Tensor:
        """Features of a level's voxels, (V, in) to (V, out)."""
        kernel = level.kernel_map(self.kernel_size)
        result: Tensor = _SubM.apply(features, self.weight.flatten(1, 3), kernel)  # type: ignore[no-untyped-call]
        return result if self.bias is None else result + self.bias


class _SubM(torch.autograd.Function):
    """One matrix product for each kernel place; a voxel is written once by each, so that sums have a fixed order everywhere."""

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
    """Softmax attention within patches along a curve.

    Args:
        channels: C.
        num_heads: Heads.
        patch_size: Longest patch.
        curve: Number of the curve.
    """

    def __init__(self, channels: int, num_heads: int, patch_size: int, curve: int) -> None:
        super().__init__()
        self.num_heads, self.patch_size, self.curve = num_heads, patch_size, curve
        self.qkv = nn.Linear(channels, 3 * channels)
        self.proj = nn.Linear(channels, channels)

    def forward(self, features: Tensor, level: VoxelLevel) -> Tensor:
        """Features of a level's voxels, (V, C)."""
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
    """Two layers, per voxel."""

    def __init__(self, channels: int, ratio: int = 4) -> None:
        super().__init__()
        self.fc1 = nn.Linear(channels, ratio * channels)
        self.fc2 = nn.Linear(ratio * channels, channels)

    def forward(self, features: Tensor) -> Tensor:
        """(V, C) to (V, C)."""
        result: Tensor = self.fc2(functional.gelu(self.fc1(features)))
        return result


class LayerScale(nn.Module):
    """A factor for each channel."""

    def __init__(self, channels: int, value: float) -> None:
        super().__init__()
        self.gamma = nn.Parameter(torch.full((channels,), value))

    def forward(self, features: Tensor) -> Tensor:
        """(V, C) to (V, C)."""
        return features * self.gamma


class Block(nn.Module):
    """Conditional position by convolution, then attention, then an MLP, each added to what comes in.

    Args:
        channels: C.
        num_heads: Heads of the attention.
        patch_size: Its longest patch.
        curve: Number of its curve.
        layer_scale: First value of the factors on what attention and MLP add; None for none.
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
        """Features of a level's voxels, (V, C); ``convolved`` is what the convolution sees where that is something else."""
        position = self.cpe[0](features if convolved is None else convolved, level)
        features = features + self.cpe[2](self.cpe[1](position))
        features = features + self.ls1(self.attn(self.norm1(features), level))
        result: Tensor = features + self.ls2(self.mlp(self.norm2(features)))
        return result


class VoxelPooling(nn.Module):
    """Features of a coarser level: projected, then the largest of the voxels that merged."""

    def __init__(self, in_channels: int, out_channels: int, norm: nn.Module) -> None:
        super().__init__()
        self.proj = nn.Linear(in_channels, out_channels)
        self.norm = nn.Sequential(norm)

    def forward(self, features: Tensor, cluster: Tensor, num_voxels: int) -> Tensor:
        """(V, in) to (num_voxels, out), by the coarse voxel of each, (V,)."""
        features = self.proj(features)
        index = cluster[:, None].expand_as(features)
        largest = features.new_zeros(num_voxels, features.shape[1]).scatter_reduce(
            0, index, features, "amax", include_self=False
        )
        return functional.gelu(self.norm(largest))


class VoxelUnpooling(nn.Module):
    """Features of a finer level: those of the coarser one handed down, and the encoder's own."""

    def __init__(self, in_channels: int, skip_channels: int, out_channels: int, norms: Sequence[nn.Module]) -> None:
        super().__init__()
        self.proj = nn.Sequential(nn.Linear(in_channels, out_channels), norms[0], nn.GELU())
        self.proj_skip = nn.Sequential(nn.Linear(skip_channels, out_channels), norms[1], nn.GELU())

    def forward(self, features: Tensor, skip: Tensor, cluster: Tensor) -> tuple[Tensor, Tensor]:
        """Features of the finer voxels (V, out), and the encoder's part of them alone, (V, out)."""
        own = self.proj_skip(skip)
        return own + self.proj(features).index_select(0, cluster), own
