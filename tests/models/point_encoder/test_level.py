import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from models.point_encoder.level import VoxelLevel
from models.point_encoder.serialization import CURVES
from tests.models.point_encoder.clouds import level_of, random_voxels

sizes = st.lists(st.integers(1, 40), min_size=1, max_size=4).map(tuple)


@given(num_each=sizes, size=st.sampled_from([3, 5]))
@settings(max_examples=30)
def test_a_kernel_map_joins_just_the_voxels_that_lie_in_its_reach(num_each: tuple[int, ...], size: int) -> None:
    level = level_of(num_each, 4)
    kernel, reach = level.kernel_map(size), size // 2
    offset = level.coords[None] - level.coords[:, None]  # (written, read, 3)
    near = (level.batch[:, None] == level.batch) & (offset.abs().amax(-1) <= reach)
    place = ((offset + reach) * torch.tensor([size * size, size, 1])).sum(-1)
    for k, pair in enumerate(kernel.pairs):
        expected = {tuple(p) for p in (near & (place == k)).nonzero().tolist()}
        found = (
            {(n, n) for n in range(len(level))} if pair is None else set(zip(*(rows.tolist() for rows in pair), strict=True))
        )
        assert found == expected


@given(num_each=sizes, size=st.sampled_from([5, 16, 24]), curve=st.integers(0, 3))
@settings(max_examples=30)
def test_patches_are_those_of_flash_attention(num_each: tuple[int, ...], size: int, curve: int) -> None:
    level = level_of(num_each, 4)
    patches = level.patches(curve, size)
    rows = torch.cat([bucket.rows.flatten() for bucket in patches.buckets])
    assert rows[patches.places].equal(torch.arange(len(level)))  # each voxel has a place of its own
    found = set()
    for bucket in patches.buckets:
        is_key = torch.ones_like(bucket.rows, dtype=torch.bool) if bucket.is_key is None else bucket.is_key[:, 0, 0]
        found |= {tuple(row[keys].tolist()) for row, keys in zip(bucket.rows, is_key, strict=True)}
    assert found == set(naive_patches(level, curve, size))


def naive_patches(level: VoxelLevel, curve: int, size: int) -> list[tuple[int, ...]]:
    patches = []
    for cloud in range(len(level.lengths)):
        rows = (level.batch == cloud).nonzero()[:, 0]
        line = rows[level.codes[curve, rows].argsort()].tolist()
        cut = [line[k : k + size] for k in range(0, len(line), size)]
        if len(cut) > 1:
            cut[-1] = cut[-1] + cut[-2][len(cut[-1]) :]
        patches += [tuple(patch) for patch in cut]
    return patches


@given(num_each=sizes)
@settings(max_examples=30)
def test_both_ways_of_pooling_merge_the_same_voxels(num_each: tuple[int, ...]) -> None:
    level = level_of(num_each, 8)
    for by_code in (True, False):
        coarse, cluster = level.pooled(CURVES, by_code=by_code)
        assert coarse.coords[cluster].equal(level.coords >> 1)
        assert coarse.batch[cluster].equal(level.batch)
        assert len(coarse) == len({(b, *c) for b, c in zip(level.batch.tolist(), (level.coords >> 1).tolist(), strict=True)})
        assert coarse.batch.equal(coarse.batch.sort().values)


def test_codes_of_a_pooled_level_are_those_of_its_coordinates() -> None:
    level = level_of((200,), 16)
    coarse, _ = level.pooled(CURVES, by_code=True)
    fresh, rows = VoxelLevel.of_voxels(coarse.coords, coarse.batch, CURVES, with_margin=False)
    assert coarse.coords.amax() == 7  # of the depth that is expected
    assert coarse.codes[:, rows].equal(fresh.codes)


@pytest.mark.parametrize("with_margin", [False, True])
def test_a_level_does_not_depend_on_the_order_of_its_voxels(with_margin: bool) -> None:
    coords, batch = random_voxels((30, 1, 17), 6)
    order = torch.randperm(len(batch), generator=torch.Generator().manual_seed(1))
    first, rows = VoxelLevel.of_voxels(coords, batch, CURVES, with_margin=with_margin)
    second, _ = VoxelLevel.of_voxels(coords[order], batch[order], CURVES, with_margin=with_margin)
    assert first.coords.equal(second.coords)
    assert first.codes.equal(second.codes)
    assert first.coords.equal(coords[rows])
    assert first.lengths == [30, 1, 17]
