"""Space-filling curves: map integer coordinates to positions on a line such that neighbours on the line are neighbours in space.

There are four curves, as in Point Transformer V3: z-order, Hilbert, and both with x and y exchanged. The arithmetic is on
integers, so results are equal on every device. The Hilbert curve follows J. Skilling, Programming the Hilbert curve, AIP 707
(2004).

Pooling needs the prefix property of both: the code of ``coords >> 1`` at ``depth - 1`` is ``code >> 3``.

Dimension letters of this package: B clouds, V voxels, C channels, K points of an attention patch.
"""

from enum import StrEnum

import torch
from torch import Tensor

MAX_DEPTH = 16
"""Bits of a coordinate; three coordinates and the index of the cloud share 63 bits."""

CODE_BITS = 3 * MAX_DEPTH


class SpaceFillingCurve(StrEnum):
    """The curves, with the names of published configurations."""

    Z = "z"
    Z_TRANS = "z-trans"
    HILBERT = "hilbert"
    HILBERT_TRANS = "hilbert-trans"


CURVES = tuple(SpaceFillingCurve)


def encode(coords: Tensor, depth: Tensor, curve: SpaceFillingCurve) -> Tensor:
    """Computes positions on a curve.

    Args:
        coords: (V, 3) int64, each in [0, 2**depth).
        depth: Bits of the cube around each voxel's cloud, (V,) int64, at most 16. The orientation of a Hilbert curve depends on it.
        curve: The curve.

    Returns:
        Codes, (V,) int64, in [0, 8**depth).
    """
    x, y, z = coords.unbind(1)
    if curve in (SpaceFillingCurve.Z_TRANS, SpaceFillingCurve.HILBERT_TRANS):
        x, y = y, x
    return _interleaved(x, y, z) if curve in (SpaceFillingCurve.Z, SpaceFillingCurve.Z_TRANS) else _hilbert(x, y, z, depth)


def bit_length(values: Tensor) -> Tensor:
    """The number of bits of each value, same shape, int64: 0 for 0, 3 for 5."""
    bits = torch.arange(MAX_DEPTH + 2, device=values.device)
    return ((values.unsqueeze(-1) >> bits) > 0).sum(-1)


def _interleaved(x: Tensor, y: Tensor, z: Tensor) -> Tensor:
    return (_spread(x) << 2) | (_spread(y) << 1) | _spread(z)


def _spread(value: Tensor) -> Tensor:
    """Moves bit k to bit 3 k."""
    value = (value | (value << 32)) & 0x1F00000000FFFF
    value = (value | (value << 16)) & 0x1F0000FF0000FF
    value = (value | (value << 8)) & 0x100F00F00F00F00F
    value = (value | (value << 4)) & 0x10C30C30C30C30C3
    return (value | (value << 2)) & 0x1249249249249249


def _hilbert(x: Tensor, y: Tensor, z: Tensor, depth: Tensor) -> Tensor:
    axes = [x, y, z]
    for bit in range(int(depth.max()) - 1 if len(depth) else 0, 0, -1):
        # Bits above a cloud's own cube are zero and must not change the orientation.
        low = torch.where(depth > bit, (1 << bit) - 1, 0)
        for k in range(3):
            is_set = (axes[k] >> bit) & 1 == 1
            exchange = torch.where(is_set, 0, (axes[0] ^ axes[k]) & low)
            axes[0] = axes[0] ^ torch.where(is_set, low, exchange)
            if k:
                axes[k] = axes[k] ^ exchange
    code = _interleaved(*axes)
    for shift in (1, 2, 4, 8, 16, 32):  # Gray code to binary: each bit becomes the parity of itself and all higher bits
        code = code ^ (code >> shift)
    return code
