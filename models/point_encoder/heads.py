"""What is asked of codes in pre-training: the signed distance around an object, and the clearance between two."""

import math

import torch
from torch import Tensor, nn
from torch.nn import functional

from models.point_encoder.cloud import Preprocessing
from models.point_encoder.encoder import FEATURE_CHANNELS, PointEncoder
from models.point_encoder.questions import Questions
from models.point_encoder.transformer import TransformerConfig

_FREQUENCIES = 5


def waves(values: Tensor) -> Tensor:
    """Numbers with sines and cosines of them, (…, n) to (…, n (1 + 2 · 5))."""
    angles = values[..., None] * (math.pi * 2.0 ** torch.arange(-1, _FREQUENCIES - 1, device=values.device))
    return torch.cat([values, angles.sin().flatten(-2), angles.cos().flatten(-2)], dim=-1)


class _Mlp(nn.Sequential):
    def __init__(self, in_channels: int, width: int, depth: int) -> None:
        layers: list[nn.Module] = []
        for _ in range(depth):
            layers += [nn.Linear(in_channels, width), nn.SiLU()]
            in_channels = width
        super().__init__(*layers, nn.Linear(width, 1))


class DistanceHead(nn.Module):
    """Signed distance at points around an object, from its code and the proportions of its box."""

    def __init__(self, width: int = 160) -> None:
        super().__init__()
        self.of_code = nn.Linear(FEATURE_CHANNELS + 3, width)
        self.of_place = nn.Linear(3 + 6 * _FREQUENCIES, width)
        self.rest = _Mlp(width, width, 2)

    def forward(self, codes: Tensor, proportions: Tensor, places: Tensor) -> Tensor:
        """Distances in units of ``DISTANCE_LIMIT``; what is asked lies within [-1, 1].

        Args:
            codes: (B, 64).
            proportions: Logarithm of the box over half its largest side, (B, 3).
            places: In half the largest extent, (B, Q, 3).

        Returns:
            (B, Q).
        """
        known = self.of_code(torch.cat([codes, proportions], dim=1))
        result: Tensor = self.rest(functional.silu(known[:, None] + self.of_place(waves(places))))
        return result[..., 0]


class ClearanceHead(nn.Module):
    """Clearance of pairs, from their codes, boxes and relative pose; without codes it is the baseline that knows boxes alone.

    Args:
        with_codes: Whether it sees the codes.
        width: Of its layers.
    """

    def __init__(self, *, with_codes: bool, width: int = 192) -> None:
        super().__init__()
        self.with_codes = with_codes
        poses = 6 + 5 * (1 + 2 * _FREQUENCIES)
        self.rest = _Mlp(poses + 2 * FEATURE_CHANNELS * with_codes, width, 3)

    def forward(self, first: Tensor, second: Tensor, boxes: Tensor, poses: Tensor) -> Tensor:
        """Clearances in units of ``CLEARANCE_LIMIT``.

        Args:
            first: Codes, (R, 64).
            second: Codes, (R, 64).
            boxes: Logarithm of both boxes in the pair's unit, (R, 6).
            poses: Of the second in the frame of the first: offset in the pair's unit, cosine and sine of its yaw, (R, 5).

        Returns:
            (R,).
        """
        known = [boxes, waves(poses)]
        if self.with_codes:
            known += [first, second]
        result: Tensor = self.rest(torch.cat(known, dim=1))
        return result[:, 0]


class Pretraining(nn.Module):
    """The encoder and the heads that question it.

    Args:
        config: Of the encoder.
        preprocessing: Of the encoder.
    """

    def __init__(self, config: TransformerConfig, preprocessing: Preprocessing) -> None:
        super().__init__()
        self.encoder = PointEncoder(config, preprocessing)
        # Codes of untrained weights hardly differ; levelled over a batch, what differs is what the heads see.
        self.level = nn.BatchNorm1d(FEATURE_CHANNELS, affine=False)
        self.distance, self.clearance = DistanceHead(), ClearanceHead(with_codes=True)
        self.box_clearance = ClearanceHead(with_codes=False)  # the baseline: learns beside, and teaches the encoder nothing

    def forward(self, x: Questions) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        """Codes (B, 64), distances (B, Q), clearances (R,), and those of the baseline (R,)."""
        codes: Tensor = self.encoder([p.cloud for p in x.posed])
        levelled = self.level(codes)
        first, second = levelled[x.first], levelled[x.second]
        clearances = self.clearance(first, second, x.boxes, x.poses)
        return (
            codes,
            self.distance(levelled, x.proportions, x.places),
            clearances,
            self.box_clearance(first, second, x.boxes, x.poses),
        )

    def loss(self, x: Questions, pair_weight: float) -> tuple[Tensor, dict[str, float]]:
        """What is minimised, and its parts: mean absolute errors of distance, clearance and the baseline's clearance."""
        _, distances, clearances, of_boxes = self(x)
        parts = {
            "distance": (distances - x.distances).abs().mean(),
            "clearance": (clearances - x.clearances).abs().mean(),
            "box_clearance": (of_boxes - x.clearances).abs().mean(),
        }
        total = parts["distance"] + pair_weight * (parts["clearance"] + parts["box_clearance"])
        return total, {name: float(part.detach()) for name, part in parts.items()}
