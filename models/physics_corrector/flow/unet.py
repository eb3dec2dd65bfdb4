"""The paper's denoising network: a 1D U-Net along the objects of a scene.

Objects have no order, so every convolution has kernel size 1 and stride 1: "down" and "up" are the two halves of a stack with
skip connections. Objects interact only through attention: linear attention at every level, one softmax attention in the middle.
Norms are over the channels of one object, and attention masks padding, so an object's result depends neither on the order of
the others nor on the amount of padding.

Context modulates every block by FiLM, per object; flow time does so per scene.
"""

import torch
from torch import Tensor, nn
from torch.nn import functional as F  # noqa: N812

_NORM_GROUPS = 8
_HEAD_CHANNELS = 32


class TokenGroupNorm(nn.Module):
    """Group norm over each object's own channels, (..., C) → (..., C)."""

    def __init__(self, channels: int) -> None:
        super().__init__()
        self.weight = nn.Parameter(torch.ones(channels))
        self.bias = nn.Parameter(torch.zeros(channels))

    def forward(self, x: Tensor) -> Tensor:
        """Normalises each group of channels to mean 0 and variance 1, then scales and shifts."""
        groups = x.reshape(*x.shape[:-1], _NORM_GROUPS, -1)
        return F.layer_norm(groups, groups.shape[-1:]).flatten(-2) * self.weight + self.bias


class FilmBlock(nn.Module):
    """Two pointwise layers with a residual; context and time scale and shift the first.

    Args:
        channels_in: Channels of the input; more than ``channels`` after a skip connection.
        channels: Channels of the output.
        context_channels: Channels of an object's context.
        time_channels: Channels of the embedded flow time.
    """

    def __init__(self, channels_in: int, channels: int, context_channels: int, time_channels: int) -> None:
        super().__init__()
        self.first, self.first_norm = nn.Linear(channels_in, channels), TokenGroupNorm(channels)
        self.second, self.second_norm = nn.Linear(channels, channels), TokenGroupNorm(channels)
        self.film_context = nn.Linear(context_channels, 2 * channels)
        self.film_time = nn.Linear(time_channels, 2 * channels, bias=False)
        self.shortcut = nn.Linear(channels_in, channels) if channels_in != channels else nn.Identity()

    def forward(self, x: Tensor, context: Tensor, time: Tensor) -> Tensor:
        """Maps x (B, N, C_in), context (B, N, C_c) and time (B, C_t) to (B, N, C)."""
        scale, shift = (self.film_context(F.silu(context)) + self.film_time(F.silu(time))[:, None]).chunk(2, -1)
        h = F.silu(self.first_norm(self.first(x)) * (1 + scale) + shift)
        h = F.silu(self.second_norm(self.second(h)))
        shortcut: Tensor = self.shortcut(x)
        return h + shortcut


class _Attention(nn.Module):
    """Pre-norm attention over the objects of a scene, added to its input."""

    def __init__(self, channels: int, heads: int, head_channels: int) -> None:
        super().__init__()
        self.heads = heads
        self.norm = nn.LayerNorm(channels)
        self.qkv = nn.Linear(channels, 3 * heads * head_channels, bias=False)
        self.out = nn.Linear(heads * head_channels, channels)

    def forward(self, x: Tensor, mask: Tensor) -> Tensor:
        """Maps x (B, N, C) and mask (B, N) bool to (B, N, C)."""
        q, k, v = self.qkv(self.norm(x)).unflatten(-1, (3, self.heads, -1)).permute(2, 0, 3, 1, 4)  # each (B, H, N, D)
        mixed: Tensor = self.out(self.mix(q, k, v, mask).transpose(1, 2).flatten(-2))
        return x + mixed

    def mix(self, q: Tensor, k: Tensor, v: Tensor, mask: Tensor) -> Tensor:
        """Mixes the values of a scene's objects, (B, H, N, D)."""
        raise NotImplementedError


class LinearAttention(_Attention):
    """Attention through one D × D summary of the scene per head: its cost is linear in the number of objects."""

    def mix(self, q: Tensor, k: Tensor, v: Tensor, mask: Tensor) -> Tensor:
        """Normalises queries over channels and keys over objects, then mixes."""
        is_object = mask[:, None, :, None]
        k = k.masked_fill(~is_object, torch.finfo(k.dtype).min).softmax(2) * is_object
        summary = k.transpose(-1, -2) @ (v * is_object)  # (B, H, D, D)
        return q.softmax(-1) @ summary


class SoftmaxAttention(_Attention):
    """Scaled dot-product attention of every object to every other."""

    def mix(self, q: Tensor, k: Tensor, v: Tensor, mask: Tensor) -> Tensor:
        """See the base class."""
        is_key = mask | ~mask.any(1, keepdim=True)  # a scene without objects attends to its padding: no key would give nan
        return F.scaled_dot_product_attention(q, k, v, is_key[:, None, None, :])


class _Level(nn.Module):
    """One level of the U-Net: two blocks, each with an optional skip connection, and linear attention."""

    def __init__(self, channels_in: int, channels: int, context_channels: int, time_channels: int, heads: int) -> None:
        super().__init__()
        self.first = FilmBlock(channels_in, channels, context_channels, time_channels)
        self.second = FilmBlock(channels_in, channels, context_channels, time_channels)
        self.attention = LinearAttention(channels, heads, _HEAD_CHANNELS)

    def forward(
        self, x: Tensor, skips: tuple[Tensor, Tensor] | None, context: Tensor, time: Tensor, mask: Tensor
    ) -> tuple[Tensor, Tensor]:
        """Returns the outputs of the first block and of the level, (B, N, C) each."""
        first: Tensor = self.first(x if skips is None else torch.cat([x, skips[0]], -1), context, time)
        second: Tensor = self.second(first if skips is None else torch.cat([first, skips[1]], -1), context, time)
        return first, self.attention(second, mask)


class UNet1d(nn.Module):
    """The U-Net between the input layer and the head.

    Args:
        channels: Width at all levels.
        levels: Number of levels down, and of levels up.
        heads: Attention heads of 32 channels.
        context_channels: Channels of an object's context.
        time_channels: Channels of the embedded flow time.
    """

    needs_pairs = False

    def __init__(self, *, channels: int, levels: int, heads: int, context_channels: int, time_channels: int) -> None:
        super().__init__()
        film = (channels, context_channels, time_channels)
        self.down = nn.ModuleList(_Level(channels, *film, heads) for _ in range(levels))
        self.middle_first, self.middle_second = FilmBlock(channels, *film), FilmBlock(channels, *film)
        self.middle_attention = SoftmaxAttention(channels, heads, _HEAD_CHANNELS)
        self.up = nn.ModuleList(_Level(2 * channels, *film, heads) for _ in range(levels))
        self.last = FilmBlock(2 * channels, *film)

    def forward(self, x: Tensor, context: Tensor, time: Tensor, mask: Tensor, pairs: Tensor | None = None) -> Tensor:
        """Computes new states of the objects.

        Args:
            x: States of the objects, (B, N, C).
            context: Their context, (B, N, C_c).
            time: Embedded flow time, (B, C_t).
            mask: True for objects, False for padding, (B, N) bool.
            pairs: Not used.

        Returns:
            (B, N, C); values of padding are undefined.
        """
        stem, skips = x, []
        for level in self.down:
            first, x = level(x, None, context, time, mask)
            skips.append((x, first))  # the level's blocks on the way up read them in reverse order
        x = self.middle_attention(self.middle_first(x, context, time), mask)
        x = self.middle_second(x, context, time)
        for level in self.up:
            _, x = level(x, skips.pop(), context, time, mask)
        last: Tensor = self.last(torch.cat([x, stem], -1), context, time)
        return last
