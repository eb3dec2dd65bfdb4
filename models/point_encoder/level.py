"""One resolution of a batch of clouds: its voxels, who neighbours whom, who attends to whom, and the next coarser one.

What is derived is kept, because every block of a stage and of the decoder asks for the same again. Nothing of one cloud depends
on another: curves turn by each cloud's own depth, and patches are cut cloud by cloud.
"""

from dataclasses import dataclass
from itertools import product

import torch
from torch import Tensor

from models.point_encoder.serialization import CODE_BITS, MAX_DEPTH, SpaceFillingCurve, bit_length, encode

_BUCKETS = tuple(sorted({n for k in range(4, 13) for n in (2**k, 3 * 2 ** (k - 1))}))  # 16, 24, 32, 48, …
_MAX_CLOUDS = 1 << (62 - CODE_BITS)


@dataclass(frozen=True, slots=True, eq=False)
class KernelMap:
    """Which voxels a convolution joins: ``pairs[k]`` are the rows (written, read) of kernel place k; None for the middle."""

    pairs: tuple[tuple[Tensor, Tensor] | None, ...]


@dataclass(frozen=True, slots=True, eq=False)
class PatchBucket:
    """Patches of about one length, padded to the same.

    Attributes:
        rows: Voxel of each place, (P, K) int64.
        is_key: Which places are attended to, (P, 1, 1, K) bool; None where all are.
    """

    rows: Tensor
    is_key: Tensor | None


@dataclass(frozen=True, slots=True, eq=False)
class AttentionPatches:
    """How attention cuts the clouds of a level along a curve.

    Attributes:
        buckets: The patches.
        places: Where each voxel's own result is among the flattened places of all buckets, (V,) int64.
    """

    buckets: tuple[PatchBucket, ...]
    places: Tensor


class VoxelLevel:
    """Voxels of a batch of clouds at one resolution, rows in order of cloud and of the first curve's code.

    Args:
        coords: (V, 3) int64, from 0, no two alike in a cloud.
        batch: Cloud of each, (V,) int64, ascending; every cloud has a voxel.
        lengths: Voxels of each cloud.
        codes: Place of each along each curve, (curves, V) int64.
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
        """The level of voxels in any order.

        Args:
            coords: (V, 3) int64, from 0, below 2**16, no two alike in a cloud.
            batch: Cloud of each, (V,) int64; every cloud has a voxel.
            curves: Curves to order them by.
            with_margin: Whether the depth leaves room for one more coordinate, as the second generation of models has it.

        Returns:
            The level, and which row of the input each of its voxels was, (V,) int64.
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
        """The level of half the resolution.

        The voxels that merge are the same either way; what differs is the turn of the Hilbert curves.

        Args:
            curves: Curves to order it by.
            by_code: Whether its codes are these, shortened; else they are made anew from its coordinates.

        Returns:
            The level, and which of its voxels each of these became, (V,) int64.
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
        """Which voxels a convolution of that (odd) size joins."""
        if size not in self._kernel_maps:
            self._kernel_maps[size] = self._make_kernel_map(size)
        return self._kernel_maps[size]

    def patches(self, curve: int, size: int) -> AttentionPatches:
        """How attention cuts the clouds along a curve: a cloud of at most ``size`` voxels is one patch.

        A larger one is cut into patches of ``size``; the last has its own first, then borrows what stands at the same places of
        the patch before it.
        """
        if (curve, size) not in self._patches:
            self._patches[curve, size] = self._make_patches(curve, size)
        return self._patches[curve, size]

    def _make_kernel_map(self, size: int) -> KernelMap:
        reach = size // 2
        span = (self.coords.amax(0) + 1 + 2 * reach).tolist()  # room on both sides: an offset is one number, and never wraps
        assert len(self.lengths) * span[0] * span[1] * span[2] < 2**62
        step = torch.tensor([span[1] * span[2], span[2], 1], device=self.coords.device)
        key = self.batch * (span[0] * span[1] * span[2]) + ((self.coords + reach) * step).sum(1)
        sorted_key, rows = key.sort()
        offsets = torch.tensor(list(product(range(-reach, reach + 1), repeat=3)), device=self.coords.device)
        middle = len(offsets) // 2
        # The other half of the kernel joins the same voxels the other way round.
        wanted = key + (offsets[:middle] * step).sum(1)[:, None]
        found = torch.searchsorted(sorted_key, wanted).clamp(max=len(key) - 1)
        place, written = (sorted_key[found] == wanted).nonzero(as_tuple=True)
        read = rows[found[place, written]]
        counts = place.bincount(minlength=middle).tolist()
        half = list(zip(written.split(counts), read.split(counts), strict=True))
        return KernelMap((*half, None, *((r, w) for w, r in reversed(half))))

    def _make_patches(self, curve: int, size: int) -> AttentionPatches:
        if self._orders is None:
            self._orders = _by_cloud(self.batch, self.codes).argsort(dim=1)
        order = self._orders[curve]
        own: list[int] = []  # voxels of each patch that no patch before it has
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
            place = torch.arange(length, device=device)
            is_own, is_key = (n[chosen, None] > place for n in (own_of, keys_of))
            position = start[chosen, None] + place - torch.where(is_own, 0, size)
            rows = order[torch.where(is_key, position, start[chosen, None])]
            all_keys = all(keys[n] == length for n in chosen.tolist())
            buckets.append(PatchBucket(rows, None if all_keys else is_key[:, None, None]))
            places[rows[is_own]] = written + is_own.flatten().nonzero()[:, 0]
            written += is_own.numel()
        return AttentionPatches(tuple(buckets), places)


def _by_cloud(batch: Tensor, code: Tensor) -> Tensor:
    """Codes that sort by cloud first."""
    return (batch << CODE_BITS) | code
