"""Space-filling curves: integer coordinates to places on a line, so that neighbours on the line are neighbours in space.

Four curves, as Point Transformer V3 uses them: z-order, Hilbert, and both with x and y exchanged. All in whole numbers, so that
they are the same on every device. The Hilbert curve follows J. Skilling, Programming the Hilbert curve, AIP 707 (2004).

Both have the prefix property that pooling rests on: the code of ``coords >> 1`` at ``depth - 1`` is ``code >> 3``.

Dimension letters of this package: B clouds, V voxels, C channels, K points of an attention patch.
"""

from enum import StrEnum

import torch
from torch import Tensor

MAX_DEPTH = 16
"""Bits of a coordinate; three of them and the number of a cloud share 63 bits."""

CODE_BITS = 3 * MAX_DEPTH


class SpaceFillingCurve(StrEnum):
    """The curves, by the names that published configurations use."""

    Z = "z"
    Z_TRANS = "z-trans"
    HILBERT = "hilbert"
    HILBERT_TRANS = "hilbert-trans"


CURVES = tuple(SpaceFillingCurve)


def encode(coords: Tensor, depth: Tensor, curve: SpaceFillingCurve) -> Tensor:
    """Places of coordinates on a curve.

    Args:
        coords: (V, 3) int64, each in [0, 2**depth).
        depth: Bits of the cube that each lies in, (V,) int64, at most 16. A Hilbert curve turns with it.
        curve: Which one.

    Returns:
        Codes, (V,) int64, in [0, 8**depth).
    """
    x, y, z = coords.unbind(1)
    if curve in (SpaceFillingCurve.Z_TRANS, SpaceFillingCurve.HILBERT_TRANS):
        x, y = y, x
    return _interleaved(x, y, z) if curve in (SpaceFillingCurve.Z, SpaceFillingCurve.Z_TRANS) else _hilbert(x, y, z, depth)


def bit_length(values: Tensor) -> Tensor:
    """Bits that numbers take, same shape, int64: 0 for 0, 3 for 5."""
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
        # Bits above a cloud's own cube are zero and must not turn it.
        low = torch.where(depth > bit, (1 << bit) - 1, 0)
        for k in range(3):
            is_set = (axes[k] >> bit) & 1 == 1
            exchange = torch.where(is_set, 0, (axes[0] ^ axes[k]) & low)
            axes[0] = axes[0] ^ torch.where(is_set, low, exchange)
            if k:
                axes[k] = axes[k] ^ exchange
    code = _interleaved(*axes)
    for shift in (1, 2, 4, 8, 16, 32):  # Gray code to binary: each bit is the parity of those from it upwards
        code = code ^ (code >> shift)
    return code
