"""The velocity field v_θ(x_t, t, C) of the corrector: maps coordinates, flow time and condition to a rate of x, y, z and yaw.

Two backbones share the inputs: the encoding of the objects (:mod:`~models.physics_corrector.flow.object_encoding`), instance
codes, the earlier clean estimate (self-conditioning) and the embedded flow time. The head is zero before training, so an
untrained network moves nothing. The velocity of padding and fixed objects is exactly zero.

Instance codes distinguish equal objects. The caller gives each object a rank; the code is the row of a learned table at the
rank modulo the number of codes. Training draws new ranks at every call (``Condition.random_ranks``), so that a rank has no
meaning. Inference derives them from the content (``Condition.content_ranks``), so that permuting the objects permutes the
result.
"""

import math
from dataclasses import dataclass
from typing import Annotated, Literal, TypeAlias

import torch
from annotated_types import Interval
from torch import Tensor, nn

from models.physics_corrector.flow import object_encoding
from models.physics_corrector.flow.condition import Condition
from models.physics_corrector.flow.pose_coordinates import PoseCoordinates
from models.physics_corrector.flow.set_transformer import SetTransformer
from models.physics_corrector.flow.unet import UNet1d
from models.settings import Settings
from stable_data.errors import ConfigError

Backbone: TypeAlias = Literal["unet1d", "set_transformer"]
Width: TypeAlias = Annotated[int, Interval(ge=1, le=4096)]  # bounded: settings in files are untrusted input

_TIME_SCALE = 1000.0  # stretches flow time, [0, 1], to the range of the sinusoids, which are designed for hundreds of steps
_STATE_CHANNELS = 5 + 6 + object_encoding.PLACE_CHANNELS


@dataclass(frozen=True, slots=True)
class VelocityNetworkSettings(Settings):
    """The shape of a velocity network."""

    backbone: Backbone = "unet1d"
    """``unet1d`` (the paper's) or ``set_transformer``."""

    channels: Width = 512
    """Hidden width, a multiple of 8."""

    levels: Annotated[int, Interval(ge=1, le=64)] = 4
    """Levels of the U-Net, or blocks of the transformer."""

    heads: Annotated[int, Interval(ge=1, le=64)] = 4
    """Attention heads: of 32 channels each in the U-Net; in the transformer they divide the hidden width."""

    context_channels: Width = 512
    """Width of an object's context."""

    time_channels: Width = 2048
    """Width of the embedded flow time."""

    pair_channels: Width = 64
    """Width of an embedded pair of objects; only the transformer uses it."""

    num_features: Annotated[int, Interval(ge=0, le=4096)] = 64
    """Point features g_i of an object, 64 in the paper; 0 makes a network without them, for ablation."""

    num_texts: Annotated[int, Interval(ge=0, le=65536)] = 0
    """Text features of an object's category and of the kind of table, 384 with the packaged text encoder; the paper has none."""

    text_channels: Width = 64
    """Width to which text features are reduced."""

    reads_errors: bool = False
    """Whether the network is told the expected errors of the coarse poses; not in the paper."""

    reads_order: bool = False
    """Whether the network is told known directions between objects; only the transformer can be. Not in the paper."""

    num_codes: Annotated[int, Interval(ge=0, le=65536)] = 64
    """Number of instance codes. With 0 the network is exactly permutation-equivariant and cannot separate two equal objects."""

    code_channels: Width = 128
    """Width of an instance code."""

    def check(self) -> None:
        """Refuses a width that its groups or heads do not divide; see the base class."""
        if self.reads_order and self.backbone != "set_transformer":
            raise ConfigError(f"network.reads_order needs the set_transformer, found {self.backbone}", "config_invalid")
        if self.channels % math.lcm(8, self.heads if self.backbone == "set_transformer" else 1):
            raise ConfigError(
                f"network.channels is {self.channels}, expected a multiple of 8 (and of the transformer's {self.heads} heads)",
                "config_invalid",
            )


class VelocityNetwork(nn.Module):
    """The velocity field v_θ(y_t, t, C) in the coordinates of the flow.

    Args:
        settings: The shape of the network.
        coordinates: The coordinates of its input and output.
    """

    def __init__(self, settings: VelocityNetworkSettings, coordinates: PoseCoordinates) -> None:
        super().__init__()
        self.settings, self.coordinates = settings, coordinates
        width, context, time = settings.channels, settings.context_channels, settings.time_channels
        self.state = nn.Linear(_STATE_CHANNELS, width)
        self.features = nn.LayerNorm(settings.num_features) if settings.num_features else None
        self.codes = nn.Embedding(settings.num_codes, settings.code_channels) if settings.num_codes else None
        known = object_encoding.CONTEXT_CHANNELS + settings.num_features + (settings.code_channels if settings.num_codes else 0)
        known += object_encoding.ERROR_CHANNELS if settings.reads_errors else 0
        self.texts: nn.Linear | None = None
        if settings.num_texts:
            self.texts = nn.Linear(settings.num_texts, settings.text_channels)
            self.table_text = nn.Linear(settings.num_texts, settings.text_channels)
            known += 2 * settings.text_channels
        self.context = nn.Sequential(nn.Linear(known, context), nn.SiLU(), nn.Linear(context, context))
        self.time = nn.Sequential(nn.Linear(width, time), nn.SiLU(), nn.Linear(time, time))
        shape = {"channels": width, "levels": settings.levels, "heads": settings.heads}
        inputs = {"context_channels": context, "time_channels": time}
        self.backbone: UNet1d | SetTransformer
        if settings.backbone == "unet1d":
            self.backbone = UNet1d(**shape, **inputs)
        else:
            inputs_of_pair = object_encoding.PAIR_CHANNELS + (object_encoding.ORDER_CHANNELS if settings.reads_order else 0)
            pair = {"pair_channels": settings.pair_channels, "pair_inputs": inputs_of_pair}
            self.backbone = SetTransformer(**shape, **inputs, **pair)
        last = nn.Linear(width, 4)
        nn.init.zeros_(last.weight)
        nn.init.zeros_(last.bias)
        self.head = nn.Sequential(nn.LayerNorm(width), last)

    def forward(self, y: Tensor, t: Tensor, condition: Condition, ranks: Tensor, y1_hat: Tensor | None = None) -> Tensor:
        """Computes the velocity of every object.

        Args:
            y: Coordinates y_t, (B, N, 4) float32.
            t: Flow time in [0, 1], (B,) float32.
            condition: The scenes.
            ranks: The instance code of each object, modulo the number of codes, (B, N) int64.
            y1_hat: An earlier estimate of the clean coordinates, (B, N, 4) float32, or None.

        Returns:
            dy/dt, (B, N, 4) float32: position and yaw in coordinate units; 0 for padding and fixed objects.

        Raises:
            ConfigError: The condition has another number of features than the network (``features_mismatch``).
        """
        is_object = condition.mask[..., None]
        y = torch.where(is_object, y, 0)
        poses = torch.where(is_object, self.coordinates.decode(y, condition.poses), 0)
        x = self.state(self._state(y, poses, condition, y1_hat))
        pairs = self._pairs(poses, condition) if self.backbone.needs_pairs else None
        time = self.time(time_embedding(t, self.settings.channels))
        x = self.backbone(x, self._context(condition, ranks), time, condition.mask, pairs)
        velocity: Tensor = self.head(x)
        return torch.where(condition.is_movable[..., None], velocity.float(), 0)

    def _state(self, y: Tensor, poses: Tensor, condition: Condition, y1_hat: Tensor | None) -> Tensor:
        if y1_hat is None:
            estimate = y.new_zeros((*y.shape[:2], 6))
        else:
            y1_hat = torch.where(condition.mask[..., None], y1_hat, 0)
            # The last channel marks that there is an estimate.
            estimate = torch.cat([self.coordinates.on_circle(y1_hat), torch.ones_like(y[..., :1])], -1)
        return torch.cat([self.coordinates.on_circle(y), estimate, object_encoding.place_features(poses, condition)], -1)

    def _pairs(self, poses: Tensor, condition: Condition) -> Tensor:
        pairs = object_encoding.pair_features(poses, condition)
        if not self.settings.reads_order:
            return pairs
        order = condition.order
        shape = (*pairs.shape[:-1], object_encoding.ORDER_CHANNELS)
        return torch.cat([pairs, pairs.new_zeros(shape) if order is None else order], -1)

    def _context(self, condition: Condition, ranks: Tensor) -> Tensor:
        known = [object_encoding.context_features(condition)]
        if self.features is not None:
            found = 0 if condition.features is None else condition.features.shape[-1]
            if condition.features is None or found != self.settings.num_features:
                raise ConfigError(
                    f"the scenes have {found} point features per object, the corrector expects {self.settings.num_features}; "
                    "compute them with the encoder that it was trained with",
                    "features_mismatch",
                )
            known.append(self.features(condition.features))
        if self.texts is not None:
            known += self._texts(condition)
        if self.settings.reads_errors:
            known.append(object_encoding.error_features(condition))
        if self.codes is not None:
            known.append(self.codes(ranks % self.settings.num_codes))
        embedded: Tensor = self.context(torch.cat(known, -1))
        return embedded

    def _texts(self, condition: Condition) -> list[Tensor]:
        """Reduces the text features of objects and table, each (B, N, text_channels)."""
        assert self.texts is not None
        shape, count = condition.mask.shape, self.settings.num_texts
        texts, table = condition.texts, condition.table_text
        texts = condition.poses.new_zeros(*shape, count) if texts is None else texts
        table = condition.poses.new_zeros(len(condition), count) if table is None else table
        for found in (texts, table):
            if found.shape[-1] != count:
                raise ConfigError(
                    f"the scenes have {found.shape[-1]} text features per object, the corrector expects {count}; "
                    "compute them with the text encoder that it was trained with",
                    "features_mismatch",
                )
        of_table: Tensor = self.table_text(table)
        return [self.texts(texts), of_table[:, None].expand(*shape, -1)]


def time_embedding(t: Tensor, channels: int) -> Tensor:
    """Sines and cosines of 1000 t at wavelengths from 2π to 20000π, (B,) → (B, channels)."""
    half = channels // 2
    rates = torch.exp(-math.log(10_000.0) / max(half - 1, 1) * torch.arange(half, device=t.device, dtype=torch.float32))
    phase = _TIME_SCALE * t.float()[:, None] * rates
    return torch.cat([phase.sin(), phase.cos()], -1)
