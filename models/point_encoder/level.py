"""One resolution of a batch of clouds: voxels, neighbours for convolution, patches for attention, and the next coarser level.

Derived tables are cached, because all blocks of a stage and of the decoder use the same ones. Clouds are independent of each
other: the orientation of curves depends on the cloud's own depth, and patches are formed per cloud.
"""

from dataclasses import dataclass
from itertools import product

import torch
from torch import Tensor

from models.point_encoder.serialization import CODE_BITS, MAX_DEPTH, SpaceFillingCurve, bit_length, encode

# Padded lengths of patches: 16, 24, 32, 48, …: few lengths, so few batches, yet little padding (a third at most from 16 on).
_BUCKETS = tuple(sorted({n for k in range(4, 13) for n in (2**k, 3 * 2 ** (k - 1))}))
_MAX_CLOUDS = 1 << (62 - CODE_BITS)


@dataclass(frozen=True, slots=True, eq=False)
class KernelMap:
    """Neighbours of a convolution: ``pairs[k]`` are the rows (written, read) of kernel offset k; None for the middle."""

    pairs: tuple[tuple[Tensor, Tensor] | None, ...]


@dataclass(frozen=True, slots=True, eq=False)
class PatchBucket:
    """Patches padded to one length.

    Attributes:
        rows: Voxels of each patch, (P, K) int64.
        is_key: False for padding, (P, 1, 1, K) bool; None without padding.
    """

    rows: Tensor
    is_key: Tensor | None


@dataclass(frozen=True, slots=True, eq=False)
class AttentionPatches:
    """The patches of a level along a curve.

    Attributes:
        buckets: The patches, grouped by padded length.
        places: Index of each voxel's result in the concatenated, flattened buckets, (V,) int64.
    """

    buckets: tuple[PatchBucket, ...]
    places: Tensor


class VoxelLevel:
    """Voxels of a batch of clouds at one resolution, sorted by cloud and by code of the first curve.

    Args:
        coords: (V, 3) int64, from 0, distinct in each cloud.
        batch: Cloud of each voxel, (V,) int64, ascending; every cloud has a voxel.
        lengths: Number of voxels of each cloud.
        codes: Codes of the voxels along each curve, (curves, V) int64.
    """

    def __init__(self, coords: Tensor, batch: Tensor, lengths: list[int], codes: Tensor) -> None:
        self.coords, self.batch, self.lengths, self.codes = coords, batch, lengths, codes
        self._orders: Tensor | None = None
        self._kernel_maps: dict[int, KernelMap] = {}
        self._patches: dict[tuple[int, int], AttentionPatches] = {}

    @classmethod
    def of_voxels(
        cls, coords: Tensor, batch: Tensor, curves: tuple[SpaceFillingCurve, ...], *, with_margin: bool
    ) -> tuple["VoxelLevel", Tensor]:
        """Builds the level of voxels in any order.

        Args:
            coords: (V, 3) int64, from 0, below 2**16, distinct in each cloud.
            batch: Cloud of each voxel, (V,) int64; every cloud has a voxel.
            curves: The space-filling curves.
            with_margin: Whether the depth includes one more coordinate, as in the second generation of models.

        Returns:
            The level, and the input row of each of its voxels, (V,) int64.
        """
        assert int(batch.max()) < _MAX_CLOUDS
        num_clouds = int(batch.max()) + 1
        largest = batch.new_zeros(num_clouds).scatter_reduce(0, batch, coords.amax(1), "amax")
        depth = bit_length(largest + int(with_margin))[batch].clamp(max=MAX_DEPTH)
        codes = torch.stack([encode(coords, depth, curve) for curve in curves])
        rows = _by_cloud(batch, codes[0]).argsort()
        lengths: list[int] = batch.bincount(minlength=num_clouds).tolist()
        return cls(coords[rows], batch[rows], lengths, codes[:, rows]), rows

    def __len__(self) -> int:
        """Number of voxels."""
        return len(self.batch)

    def pooled(self, curves: tuple[SpaceFillingCurve, ...], *, by_code: bool) -> tuple["VoxelLevel", Tensor]:
        """Builds the level of half the resolution.

        ``by_code`` does not change which voxels merge, but the orientation of the Hilbert curves.

        Args:
            curves: The space-filling curves.
            by_code: Whether codes are the present ones without their last 3 bits; else they are computed from coordinates.

        Returns:
            The level, and the coarse voxel of each of the present voxels, (V,) int64.
        """
        key = _by_cloud(self.batch, self.codes[0] >> 3)
        _, cluster, count = torch.unique_consecutive(key, return_inverse=True, return_counts=True)
        first = count.cumsum(0) - count
        coords, batch = self.coords[first] >> 1, self.batch[first]
        if by_code:
            lengths: list[int] = batch.bincount(minlength=len(self.lengths)).tolist()
            return VoxelLevel(coords, batch, lengths, self.codes[:, first] >> 3), cluster
        level, rows = VoxelLevel.of_voxels(coords, batch, curves, with_margin=True)
        return level, torch.empty_like(rows).scatter_(0, rows, torch.arange(len(rows), device=rows.device))[cluster]

    def kernel_map(self, size: int) -> KernelMap:
        """Returns the neighbours for a convolution of an odd kernel size."""
        if size not in self._kernel_maps:
            self._kernel_maps[size] = self._make_kernel_map(size)
        return self._kernel_maps[size]

    def patches(self, curve: int, size: int) -> AttentionPatches:
        """Returns the patches for attention along a curve: a cloud of at most ``size`` voxels is one patch.

        A larger cloud is split into patches of ``size``. The last patch starts with its own voxels and is filled with the voxels
        at the same positions of the patch before it.
        """
        if (curve, size) not in self._patches:
            self._patches[curve, size] = self._make_patches(curve, size)
        return self._patches[curve, size]

    def _make_kernel_map(self, size: int) -> KernelMap:
        reach = size // 2
        # With a margin on both sides, a kernel offset is one addition to the key and never reaches another row or cloud.
        span = (self.coords.amax(0) + 1 + 2 * reach).tolist()
        assert len(self.lengths) * span[0] * span[1] * span[2] < 2**62
        step = torch.tensor([span[1] * span[2], span[2], 1], device=self.coords.device)
        key = self.batch * (span[0] * span[1] * span[2]) + ((self.coords + reach) * step).sum(1)
        sorted_key, rows = key.sort()
        offsets = torch.tensor(list(product(range(-reach, reach + 1), repeat=3)), device=self.coords.device)
        middle = len(offsets) // 2
        # Only half of the offsets is searched: the opposite offset has the same pairs with read and written exchanged.
        neighbour = key + (offsets[:middle] * step).sum(1)[:, None]
        found = torch.searchsorted(sorted_key, neighbour).clamp(max=len(key) - 1)
        offset, written = (sorted_key[found] == neighbour).nonzero(as_tuple=True)
        read = rows[found[offset, written]]
        counts = offset.bincount(minlength=middle).tolist()
        half = list(zip(written.split(counts), read.split(counts), strict=True))
        return KernelMap((*half, None, *((r, w) for w, r in reversed(half))))

    def _make_patches(self, curve: int, size: int) -> AttentionPatches:
        if self._orders is None:
            self._orders = _by_cloud(self.batch, self.codes).argsort(dim=1)
        order = self._orders[curve]
        own: list[int] = []  # voxels of each patch that are in no earlier patch
        keys: list[int] = []
        for length in self.lengths:
            whole, rest = divmod(length, size)
            tail = [rest] if rest else []
            own += [size] * whole + tail
            keys += [size] * (whole + len(tail)) if whole else tail
        device = order.device
        own_of, keys_of = torch.tensor(own, device=device), torch.tensor(keys, device=device)
        start = own_of.cumsum(0) - own_of
        padded = [next((b for b in _BUCKETS if b >= k), k) if k < size else size for k in keys]
        buckets, places, written = [], torch.empty_like(order), 0
        for length in sorted(set(padded)):
            chosen = torch.tensor([n for n, b in enumerate(padded) if b == length], device=device)
            slot = torch.arange(length, device=device)
            is_own, is_key = (n[chosen, None] > slot for n in (own_of, keys_of))
            position = start[chosen, None] + slot - torch.where(is_own, 0, size)
            rows = order[torch.where(is_key, position, start[chosen, None])]
            all_keys = all(keys[n] == length for n in chosen.tolist())
            buckets.append(PatchBucket(rows, None if all_keys else is_key[:, None, None]))
            places[rows[is_own]] = written + is_own.flatten().nonzero()[:, 0]
            written += is_own.numel()
        return AttentionPatches(tuple(buckets), places)


def _by_cloud(batch: Tensor, code: Tensor) -> Tensor:
    """Prefixes codes with the cloud, so that they sort by cloud first."""
    return (batch << CODE_BITS) | code
