"""What is asked of codes in pre-training: the signed distance around an object, and the clearance between two."""

import math

import torch
from torch import Tensor, nn
from torch.nn import functional

from models.point_encoder.cloud import Preprocessing
from models.point_encoder.encoder import FEATURE_CHANNELS, PointEncoder
from models.point_encoder.pretraining_targets import PretrainingTargets
from models.point_encoder.transformer import TransformerConfig

_FREQUENCIES, _PAIR_FREQUENCIES = 5, 3
_HARMONICS = 4


def fourier_features(values: Tensor, frequencies: int = _FREQUENCIES) -> Tensor:
    """Numbers with sines and cosines of them, (…, n) to (…, n (1 + 2 · frequencies))."""
    angles = values[..., None] * (math.pi * 2.0 ** torch.arange(-1, frequencies - 1, device=values.device))
    return torch.cat([values, angles.sin().flatten(-2), angles.cos().flatten(-2)], dim=-1)


class _Answers(nn.Module):
    """A network of what is asked, in which every layer is scaled and shifted by what is known (Perez et al., FiLM, AAAI 2018).

    Args:
        known_channels: Of what is known.
        asked_channels: Of what is asked.
        out_channels: Of an answer.
        width: Of the layers.
        depth: Layers between the first and the last.
    """

    def __init__(self, known_channels: int, asked_channels: int, out_channels: int, width: int, depth: int) -> None:
        super().__init__()
        self.of_known = nn.Sequential(nn.Linear(known_channels, width), nn.SiLU(), nn.Linear(width, 2 * depth * width))
        self.of_asked = nn.Linear(asked_channels, width)
        self.layers = nn.ModuleList(nn.Linear(width, width) for _ in range(depth))
        self.last = nn.Linear(width, out_channels)

    def forward(self, known: Tensor, asked: Tensor) -> Tensor:
        """Known (N, K) and asked (N, Q, A) to answers (N, Q, out)."""
        factors = self.of_known(known)[:, None].chunk(2 * len(self.layers), dim=-1)
        hidden = self.of_asked(asked)
        for k, layer in enumerate(self.layers):
            hidden = hidden + layer(functional.silu(hidden * (1 + factors[2 * k]) + factors[2 * k + 1]))
        result: Tensor = self.last(functional.silu(hidden))
        return result


class DistanceHead(nn.Module):
    """Signed distance at points around an object, from its code and the proportions of its box."""

    def __init__(self, width: int = 160) -> None:
        super().__init__()
        self.answers = _Answers(FEATURE_CHANNELS + 3, 3 + 6 * _FREQUENCIES, 1, width, 3)

    def forward(self, codes: Tensor, proportions: Tensor, places: Tensor) -> Tensor:
        """Distances in units of ``DISTANCE_LIMIT``; what is asked lies within [-1, 1].

        Args:
            codes: (B, 64).
            proportions: Logarithm of the box over half its largest side, (B, 3).
            places: In half the largest extent, (B, Q, 3).

        Returns:
            (B, Q).
        """
        result: Tensor = self.answers(torch.cat([codes, proportions], dim=1), fourier_features(places))
        return result[..., 0]


class ClearanceHead(nn.Module):
    """Clearance of pairs, from their codes, boxes and relative pose; without codes it is the baseline that knows boxes alone.

    Each of the two says what it is towards the other, as seen from itself, by one network for both; the answer is of the sum.

    Args:
        with_codes: Whether it sees the codes.
        width: Of its layers.
    """

    def __init__(self, *, with_codes: bool, width: int = 256) -> None:
        super().__init__()
        self.with_codes = with_codes
        asked = 2 * 3 + 1 + 5 * (1 + 2 * _PAIR_FREQUENCIES) + 4 * _HARMONICS
        self.towards = _Answers(3 + FEATURE_CHANNELS * with_codes, asked, width, width, 2)
        self.rest = nn.Sequential(nn.SiLU(), nn.Linear(width, width), nn.SiLU(), nn.Linear(width, 1))

    def forward(self, first: Tensor, second: Tensor, x: PretrainingTargets) -> Tensor:
        """Clearances in units of ``CLEARANCE_LIMIT``.

        Args:
            first: Codes, (R, 64).
            second: Codes, (R, 64).
            x: What is asked of the pairs.

        Returns:
            (R,).
        """
        offset, (c, s), z = x.poses[:, :2], x.poses[:, 3:].unbind(1), x.poses[:, 2:3]
        back = -torch.stack([c * offset[:, 0] + s * offset[:, 1], c * offset[:, 1] - s * offset[:, 0]], dim=1)
        said = []
        for code, box, other, way, up, turn in (
            (first, x.boxes[:, :3], x.boxes[:, 3:], offset, z, s),
            (second, x.boxes[:, 3:], x.boxes[:, :3], back, -z, -s),
        ):
            place = torch.cat([way, up, way.norm(dim=1, keepdim=True), x.box_clearances[:, None]], dim=1)
            angles = torch.stack([torch.atan2(way[:, 1], way[:, 0]), torch.atan2(turn, c)], dim=1)
            asked = [box, other, x.box_clearances[:, None], fourier_features(place, _PAIR_FREQUENCIES), _harmonics(angles)]
            known = torch.cat([box, code], dim=1) if self.with_codes else box
            said.append(self.towards(known, torch.cat(asked, dim=1)[:, None])[:, 0])
        result: Tensor = self.rest(said[0] + said[1])
        return result[:, 0]


def _harmonics(angles: Tensor) -> Tensor:
    """Cosines and sines of angles (R, n) and their multiples: what is seen of a shape from around it is a series of these."""
    multiples = angles[..., None] * torch.arange(1, _HARMONICS + 1, device=angles.device)
    return torch.cat([multiples.cos(), multiples.sin()], dim=-1).flatten(1)


class PretrainingModel(nn.Module):
    """The encoder and the heads that question it.

    Args:
        config: Of the encoder; one that gives other than 64 channels.
        preprocessing: Of the encoder.
    """

    def __init__(self, config: TransformerConfig, preprocessing: Preprocessing) -> None:
        super().__init__()
        self.encoder = PointEncoder(config, preprocessing)
        # What untrained weights give hardly differs between shapes; levelled over a batch, what differs is what goes on.
        self.level = nn.BatchNorm1d(config.out_channels, affine=False)
        self.projection = nn.Linear(config.out_channels, FEATURE_CHANNELS, bias=False)
        nn.init.orthogonal_(self.projection.weight)
        self.distance, self.clearance = DistanceHead(), ClearanceHead(with_codes=True)
        self.box_clearance = ClearanceHead(with_codes=False)  # the baseline: learns beside, and teaches the encoder nothing

    def forward(self, x: PretrainingTargets) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        """Codes (B, 64), distances (B, Q), clearances (R,), and those of the baseline (R,)."""
        codes: Tensor = self.projection(self.level(self.encoder([p.cloud for p in x.posed])))
        first, second = codes[x.first], codes[x.second]
        return (
            codes,
            self.distance(codes, x.proportions, x.places),
            self.clearance(first, second, x),
            self.box_clearance(first, second, x),
        )

    def loss(self, x: PretrainingTargets, pair_weight: float, spread_weight: float) -> tuple[Tensor, dict[str, float]]:
        """What is minimised, and its parts: mean absolute errors of distance, clearance and the baseline's clearance, and spread."""
        codes, distances, clearances, of_boxes = self(x)
        parts = {
            "distance": (distances - x.distances).abs().mean(),
            "clearance": (clearances - x.clearances).abs().mean(),
            "box_clearance": (of_boxes - x.clearances).abs().mean(),
            "spread": spread_loss(codes),
        }
        total = parts["distance"] + pair_weight * (parts["clearance"] + parts["box_clearance"])
        return total + spread_weight * parts["spread"], {name: float(part.detach()) for name, part in parts.items()}

    def hand_over(self) -> None:
        """Gives the encoder the levelling and projection that were learned with it: from then on its codes are those of the heads."""
        assert self.level.running_mean is not None
        assert self.level.running_var is not None
        deviation = (self.level.running_var + self.level.eps).sqrt()
        self.encoder.set_projection(self.level.running_mean, self.projection.weight.detach() / deviation)


def spread_loss(codes: Tensor) -> Tensor:
    """How far codes (B, 64) are from unit deviation and from no correlation.

    The variance term of VICReg (Bardes et al., ICLR 2022, eq. 1), and its covariance term (eq. 4) of levelled codes, so that
    one is not bought with the other.
    """
    centred = codes - codes.mean(0)
    deviation = (centred.square().sum(0) / (len(codes) - 1) + 1e-4).sqrt()
    levelled = centred / deviation
    correlation = levelled.T @ levelled / (len(codes) - 1)
    apart = correlation.square().sum() - correlation.diag().square().sum()
    return functional.relu(1 - deviation).mean() + apart / codes.shape[1]
