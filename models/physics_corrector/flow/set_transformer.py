"""The alternative to the U-Net: a set transformer whose attention sees every pair's relative pose and size.

Collision is a relation of two. Here what i sees of j (:func:`~models.physics_corrector.flow.object_encoding.pair_features`) biases the
logits of every head and is carried along with j's value, so that "it overlaps me by 4 mm on my left" reaches i as numbers.
Blocks are modulated and gated by context and time, and start as the identity.
"""

import torch
from torch import Tensor, nn
from torch.nn import functional as F  # noqa: N812


class PairAttention(nn.Module):
    """Attention over the objects of a scene with what they see of each other.

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

    def forward(self, x: Tensor, pairs: Tensor, seen: Tensor) -> Tensor:
        """Of x (B, N, C), embedded pairs (B, N, N, C_p) and who is seen (B, N) bool, (B, N, C)."""
        q, k, v = self.qkv(x).unflatten(-1, (3, self.heads, -1)).permute(2, 0, 3, 1, 4)  # each (B, H, N, D)
        # The norms are float32 like their weights: under autocast the rest is not.
        logits = self.q_norm(q.float()) @ self.k_norm(k.float()).transpose(-1, -2) * q.shape[-1] ** -0.5
        logits = logits + self.bias(pairs).permute(0, 3, 1, 2)
        weights = logits.float().masked_fill(~seen[:, None, None, :], -torch.inf).softmax(-1).to(v.dtype)  # (B, H, N, N)
        mixed: Tensor = self.out((weights @ v).transpose(1, 2).flatten(-2))
        heard: Tensor = self.pair_value((weights.transpose(1, 2) @ pairs).flatten(-2))  # (B, N, H, C_p), flat
        return mixed + heard


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

    def forward(self, x: Tensor, condition: Tensor, pairs: Tensor, seen: Tensor) -> Tensor:
        """Of x and condition (B, N, C), embedded pairs (B, N, N, C_p) and who is seen (B, N) bool, (B, N, C)."""
        scale_a, shift_a, gate_a, scale_p, shift_p, gate_p = self.modulation(F.silu(condition)).chunk(6, -1)
        x = x + gate_a * self.attention(self.norm(x) * (1 + scale_a) + shift_a, pairs, seen)
        y: Tensor = x + gate_p * self.pointwise(self.norm(x) * (1 + scale_p) + shift_p)
        return y


class SetTransformer(nn.Module):
    """The set transformer between stem and head.

    Args:
        channels: Width.
        levels: Number of blocks.
        heads: Attention heads.
        context_channels: Channels of the context of an object.
        time_channels: Channels of the time of a scene.
        pair_channels: Channels of an embedded pair.
        pair_inputs: Channels of a pair as it comes in.
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
        """What the objects become.

        Args:
            x: State of the objects, (B, N, C).
            context: Their context, (B, N, C_c).
            time: Embedded flow time, (B, C_t).
            mask: True where there is an object, (B, N) bool.
            pairs: What objects see of each other now, (B, N, N, P).

        Returns:
            (B, N, C); what padding holds means nothing.
        """
        assert pairs is not None
        seen = mask | ~mask.any(1, keepdim=True)  # a scene without objects attends to its padding, which is better than nan
        condition = self.context(context) + self.time(time)[:, None]
        embedded = self.pairs(pairs)
        for block in self.blocks:
            x = block(x, condition, embedded, seen)
        return x
