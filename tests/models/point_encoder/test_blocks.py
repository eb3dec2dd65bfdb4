import pytest
import torch
from torch.nn import functional

from models.point_encoder.blocks import PatchAttention, SubMConv3d, VoxelPooling
from tests.models.point_encoder.clouds import level_of


@pytest.mark.parametrize("size", [3, 5])
def test_a_sparse_convolution_is_a_dense_one_read_at_the_voxels(size: int) -> None:
    torch.manual_seed(0)
    level, span = level_of((60, 25), 6), 6
    layer = SubMConv3d(4, 5, size, bias=True).double()
    features = torch.randn(len(level), 4, dtype=torch.float64, requires_grad=True)
    dense = torch.zeros(2, span, span, span, 4, dtype=torch.float64)
    where = (level.batch, *level.coords.unbind(1))
    filled = dense.index_put(where, features).permute(0, 4, 1, 2, 3)
    expected = functional.conv3d(filled, layer.weight.permute(0, 4, 1, 2, 3), layer.bias, padding=size // 2)
    expected = expected.permute(0, 2, 3, 4, 1)[where]
    found = layer(features, level)
    assert torch.allclose(found, expected, atol=1e-12)
    inputs = [features, layer.weight]
    weights = torch.randn_like(found)
    for ours, theirs in zip(
        torch.autograd.grad(found, inputs, weights), torch.autograd.grad(expected, inputs, weights), strict=True
    ):
        assert torch.allclose(ours, theirs, atol=1e-12)


def test_attention_is_softmax_over_each_patch() -> None:
    torch.manual_seed(0)
    level = level_of((37, 5), 4)
    layer = PatchAttention(8, 2, patch_size=16, curve=2).double()
    features = torch.randn(len(level), 8, dtype=torch.float64)
    expected = torch.empty_like(features)
    order = torch.stack([level.codes[2], level.batch], dim=1)
    for cloud in range(2):
        rows = torch.tensor(sorted((level.batch == cloud).nonzero()[:, 0].tolist(), key=lambda r: int(order[r, 0])))
        for start in range(0, len(rows), 16):
            own = rows[start : start + 16]
            seen = torch.cat([own, rows[start - 16 + len(own) : start]]) if start else own
            query, key, value = (t.unflatten(1, (2, 4)).transpose(0, 1) for t in layer.qkv(features[seen]).chunk(3, dim=1))
            answer = (query @ key.transpose(1, 2) / 2).softmax(-1) @ value
            expected[own] = layer.proj(answer.transpose(0, 1).flatten(1))[: len(own)].detach()
    assert torch.allclose(layer(features, level), expected, atol=1e-12)


def test_pooling_keeps_the_largest_of_the_voxels_that_merge() -> None:
    layer = VoxelPooling(3, 3, torch.nn.Identity())
    features, cluster = torch.randn(6, 3), torch.tensor([0, 0, 1, 2, 2, 2])
    largest = torch.stack([layer.proj(features)[cluster == n].amax(0) for n in range(3)])
    assert torch.allclose(layer(features, cluster, 3), functional.gelu(largest))
