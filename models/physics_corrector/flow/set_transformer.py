"""The alternative to the U-Net: a set transformer whose attention reads every pair's relative pose and size.

Collision is a relation of two objects. The features of the pair (i, j), of
:func:`~models.physics_corrector.flow.object_encoding.pair_features`, bias the logits of every head and are part of j's value:
object i receives, for example, that j overlaps it by 4 mm along −x. Context and time modulate and gate the blocks, which are
the identity before training.
"""

import torch
from torch import Tensor, nn
from torch.nn import functional as F  # noqa: N812


class PairAttention(nn.Module):
    """Attention over the objects of a scene with features of each pair.

    Args:
        channels: Width.
        heads: Attention heads.
        pair_channels: Channels of an embedded pair.
    """

    def __init__(self, channels: int, heads: int, pair_channels: int) -> None:
        super().__init__()
        self.heads = heads
        self.qkv = nn.Linear(channels, 3 * channels, bias=False)
        self.q_norm, self.k_norm = nn.RMSNorm(channels // heads), nn.RMSNorm(channels // heads)
        self.bias = nn.Linear(pair_channels, heads)
        self.pair_value = nn.Linear(heads * pair_channels, channels, bias=False)
        self.out = nn.Linear(channels, channels)

    def forward(self, x: Tensor, pairs: Tensor, is_key: Tensor) -> Tensor:
        """Maps x (B, N, C), embedded pairs (B, N, N, C_p) and the attended objects (B, N) bool to (B, N, C)."""
        q, k, v = self.qkv(x).unflatten(-1, (3, self.heads, -1)).permute(2, 0, 3, 1, 4)  # each (B, H, N, D)
        # The norms have float32 weights; under autocast q and k are bfloat16.
        logits = self.q_norm(q.float()) @ self.k_norm(k.float()).transpose(-1, -2) * q.shape[-1] ** -0.5
        logits = logits + self.bias(pairs).permute(0, 3, 1, 2)
        weights = logits.float().masked_fill(~is_key[:, None, None, :], -torch.inf).softmax(-1).to(v.dtype)  # (B, H, N, N)
        mixed: Tensor = self.out((weights @ v).transpose(1, 2).flatten(-2))
        mixed_pairs: Tensor = self.pair_value((weights.transpose(1, 2) @ pairs).flatten(-2))  # of (B, N, H, C_p)
        return mixed + mixed_pairs


class _Block(nn.Module):
    """Attention and a pointwise layer, each modulated and gated."""

    def __init__(self, channels: int, heads: int, pair_channels: int) -> None:
        super().__init__()
        self.modulation = nn.Linear(channels, 6 * channels)
        nn.init.zeros_(self.modulation.weight)
        nn.init.zeros_(self.modulation.bias)
        self.norm = nn.LayerNorm(channels, elementwise_affine=False)
        self.attention = PairAttention(channels, heads, pair_channels)
        self.pointwise = nn.Sequential(nn.Linear(channels, 4 * channels), nn.GELU(), nn.Linear(4 * channels, channels))

    def forward(self, x: Tensor, condition: Tensor, pairs: Tensor, is_key: Tensor) -> Tensor:
        """As :meth:`PairAttention.forward`; condition (B, N, C) combines context and time."""
        scale_a, shift_a, gate_a, scale_p, shift_p, gate_p = self.modulation(F.silu(condition)).chunk(6, -1)
        x = x + gate_a * self.attention(self.norm(x) * (1 + scale_a) + shift_a, pairs, is_key)
        y: Tensor = x + gate_p * self.pointwise(self.norm(x) * (1 + scale_p) + shift_p)
        return y


class SetTransformer(nn.Module):
    """The set transformer between the input layer and the head.

    Args:
        channels: Width.
        levels: Number of blocks.
        heads: Attention heads.
        context_channels: Channels of an object's context.
        time_channels: Channels of the embedded flow time.
        pair_channels: Channels of an embedded pair.
        pair_inputs: Channels of a pair's input features.
    """

    needs_pairs = True

    def __init__(
        self,
        *,
        channels: int,
        levels: int,
        heads: int,
        context_channels: int,
        time_channels: int,
        pair_channels: int,
        pair_inputs: int,
    ) -> None:
        super().__init__()
        self.context = nn.Linear(context_channels, channels)
        self.time = nn.Linear(time_channels, channels, bias=False)
        self.pairs = nn.Sequential(
            nn.Linear(pair_inputs, pair_channels),
            nn.GELU(),
            nn.Linear(pair_channels, pair_channels),
            nn.LayerNorm(pair_channels),
        )
        self.blocks = nn.ModuleList(_Block(channels, heads, pair_channels) for _ in range(levels))

    def forward(self, x: Tensor, context: Tensor, time: Tensor, mask: Tensor, pairs: Tensor | None = None) -> Tensor:
        """Computes new states of the objects.

        Args:
            x: States of the objects, (B, N, C).
            context: Their context, (B, N, C_c).
            time: Embedded flow time, (B, C_t).
            mask: True for objects, False for padding, (B, N) bool.
            pairs: Features of each pair at the present poses, (B, N, N, P).

        Returns:
            (B, N, C); values of padding are undefined.
        """
        assert pairs is not None
        is_key = mask | ~mask.any(1, keepdim=True)  # a scene without objects attends to its padding: no key would give nan
        condition = self.context(context) + self.time(time)[:, None]
        embedded = self.pairs(pairs)
        for block in self.blocks:
            x = block(x, condition, embedded, is_key)
        return x
