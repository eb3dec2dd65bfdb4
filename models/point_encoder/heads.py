"""The heads of pre-training: they predict the signed distance around an object and the clearance of two objects from codes."""

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
    """Appends sines and cosines at increasing frequencies to values, (…, n) to (…, n (1 + 2 · frequencies))."""
    angles = values[..., None] * (math.pi * 2.0 ** torch.arange(-1, frequencies - 1, device=values.device))
    return torch.cat([values, angles.sin().flatten(-2), angles.cos().flatten(-2)], dim=-1)


class _Answers(nn.Module):
    """A network of queries whose layers are scaled and shifted by a condition (Perez et al., FiLM, AAAI 2018).

    Args:
        known_channels: Channels of the condition.
        asked_channels: Channels of a query.
        out_channels: Channels of the output.
        width: Width of the layers.
        depth: Number of layers between the first and the last.
    """

    def __init__(self, known_channels: int, asked_channels: int, out_channels: int, width: int, depth: int) -> None:
        super().__init__()
        self.of_known = nn.Sequential(nn.Linear(known_channels, width), nn.SiLU(), nn.Linear(width, 2 * depth * width))
        self.of_asked = nn.Linear(asked_channels, width)
        self.layers = nn.ModuleList(nn.Linear(width, width) for _ in range(depth))
        self.last = nn.Linear(width, out_channels)

    def forward(self, known: Tensor, asked: Tensor) -> Tensor:
        """Maps conditions (N, K) and queries (N, Q, A) to outputs (N, Q, out)."""
        factors = self.of_known(known)[:, None].chunk(2 * len(self.layers), dim=-1)
        hidden = self.of_asked(asked)
        for k, layer in enumerate(self.layers):
            hidden = hidden + layer(functional.silu(hidden * (1 + factors[2 * k]) + factors[2 * k + 1]))
        result: Tensor = self.last(functional.silu(hidden))
        return result


class DistanceHead(nn.Module):
    """Predicts the signed distance at points around an object from its code and the proportions of its box."""

    def __init__(self, width: int = 160) -> None:
        super().__init__()
        self.answers = _Answers(FEATURE_CHANNELS + 3, 3 + 6 * _FREQUENCIES, 1, width, 3)

    def forward(self, codes: Tensor, proportions: Tensor, places: Tensor) -> Tensor:
        """Predicts distances (B, Q) in units of ``DISTANCE_LIMIT``; true values are within [-1, 1].

        Args:
            codes: (B, 64).
            proportions: Logarithms of the box's sides over half the largest, (B, 3).
            places: Query points, in units of half the largest extent, (B, Q, 3).
        """
        result: Tensor = self.answers(torch.cat([codes, proportions], dim=1), fourier_features(places))
        return result[..., 0]


class ClearanceHead(nn.Module):
    """Predicts the clearance of pairs from their codes, boxes and relative pose; without codes, it is the baseline of boxes.

    One network encodes each object's view of the other, in its own frame; the prediction is a function of the sum, so it does
    not depend on the order of the two.

    Args:
        with_codes: Whether it reads the codes.
        width: Width of its layers.
    """

    def __init__(self, *, with_codes: bool, width: int = 256) -> None:
        super().__init__()
        self.with_codes = with_codes
        asked = 2 * 3 + 1 + 5 * (1 + 2 * _PAIR_FREQUENCIES) + 4 * _HARMONICS
        self.towards = _Answers(3 + FEATURE_CHANNELS * with_codes, asked, width, width, 2)
        self.rest = nn.Sequential(nn.SiLU(), nn.Linear(width, width), nn.SiLU(), nn.Linear(width, 1))

    def forward(self, first: Tensor, second: Tensor, x: PretrainingTargets) -> Tensor:
        """Predicts clearances (R,) in units of ``CLEARANCE_LIMIT``.

        Args:
            first: Codes of the first objects, (R, 64).
            second: Codes of the second objects, (R, 64).
            x: Boxes and relative poses of the pairs.
        """
        # `back` is the offset of the first object in the frame of the second.
        offset, (c, s), z = x.poses[:, :2], x.poses[:, 3:].unbind(1), x.poses[:, 2:3]
        back = -torch.stack([c * offset[:, 0] + s * offset[:, 1], c * offset[:, 1] - s * offset[:, 0]], dim=1)
        views = []
        for code, box, other, way, up, turn in (
            (first, x.boxes[:, :3], x.boxes[:, 3:], offset, z, s),
            (second, x.boxes[:, 3:], x.boxes[:, :3], back, -z, -s),
        ):
            place = torch.cat([way, up, way.norm(dim=1, keepdim=True), x.box_clearances[:, None]], dim=1)
            angles = torch.stack([torch.atan2(way[:, 1], way[:, 0]), torch.atan2(turn, c)], dim=1)
            asked = [box, other, x.box_clearances[:, None], fourier_features(place, _PAIR_FREQUENCIES), _harmonics(angles)]
            known = torch.cat([box, code], dim=1) if self.with_codes else box
            views.append(self.towards(known, torch.cat(asked, dim=1)[:, None])[:, 0])
        result: Tensor = self.rest(views[0] + views[1])
        return result[:, 0]


def _harmonics(angles: Tensor) -> Tensor:
    """Cosines and sines of angles (R, n) and their multiples: the basis of a Fourier series over viewing directions."""
    multiples = angles[..., None] * torch.arange(1, _HARMONICS + 1, device=angles.device)
    return torch.cat([multiples.cos(), multiples.sin()], dim=-1).flatten(1)


class PretrainingModel(nn.Module):
    """The encoder with the heads of pre-training.

    Args:
        config: Configuration of the encoder; its output must not have 64 channels.
        preprocessing: Preprocessing of the encoder.
    """

    def __init__(self, config: TransformerConfig, preprocessing: Preprocessing) -> None:
        super().__init__()
        self.encoder = PointEncoder(config, preprocessing)
        # Outputs of an untrained encoder hardly differ between shapes; normalisation over the batch amplifies the differences.
        self.level = nn.BatchNorm1d(config.out_channels, affine=False)
        self.projection = nn.Linear(config.out_channels, FEATURE_CHANNELS, bias=False)
        nn.init.orthogonal_(self.projection.weight)
        self.distance, self.clearance = DistanceHead(), ClearanceHead(with_codes=True)
        self.box_clearance = ClearanceHead(with_codes=False)  # the baseline: its gradient does not reach the encoder

    def forward(self, x: PretrainingTargets) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        """Returns codes (B, 64), distances (B, Q), clearances (R,), and clearances of the baseline (R,)."""
        codes: Tensor = self.projection(self.level(self.encoder([p.cloud for p in x.posed])))
        first, second = codes[x.first], codes[x.second]
        return (
            codes,
            self.distance(codes, x.proportions, x.places),
            self.clearance(first, second, x),
            self.box_clearance(first, second, x),
        )

    def loss(self, x: PretrainingTargets, pair_weight: float, spread_weight: float) -> tuple[Tensor, dict[str, float]]:
        """Computes the loss and its parts: mean absolute errors of distance, clearance and the baseline's clearance, and spread."""
        codes, distances, clearances, of_boxes = self(x)
        parts = {
            "distance": (distances - x.distances).abs().mean(),
            "clearance": (clearances - x.clearances).abs().mean(),
            "box_clearance": (of_boxes - x.clearances).abs().mean(),
            "spread": spread_loss(codes),
        }
        total = parts["distance"] + pair_weight * (parts["clearance"] + parts["box_clearance"])
        return total + spread_weight * parts["spread"], {name: float(part.detach()) for name, part in parts.items()}

    def set_encoder_projection(self) -> None:
        """Sets the encoder's projection to the learned normalisation and projection: its codes become those of the heads."""
        assert self.level.running_mean is not None
        assert self.level.running_var is not None
        deviation = (self.level.running_var + self.level.eps).sqrt()
        self.encoder.set_projection(self.level.running_mean, self.projection.weight.detach() / deviation)


def spread_loss(codes: Tensor) -> Tensor:
    """Penalises channels of codes (B, 64) with a deviation below 1, and correlation between channels.

    The terms are the variance term of VICReg (Bardes et al., ICLR 2022, eq. 1), and its covariance term (eq. 4) of normalised
    codes, so that a smaller deviation does not reduce the second term.
    """
    centred = codes - codes.mean(0)
    deviation = (centred.square().sum(0) / (len(codes) - 1) + 1e-4).sqrt()
    normalised = centred / deviation
    correlation = normalised.T @ normalised / (len(codes) - 1)
    off_diagonal = correlation.square().sum() - correlation.diag().square().sum()
    return functional.relu(1 - deviation).mean() + off_diagonal / codes.shape[1]
