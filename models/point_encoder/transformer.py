"""Point Transformer V3 (Wu et al., CVPR 2024) in plain torch: computes features of the voxels of a batch of clouds."""

from dataclasses import dataclass
from functools import partial

from torch import Tensor, nn
from torch.nn import functional

from models.point_encoder.blocks import Block, SubMConv3d, VoxelPooling, VoxelUnpooling
from models.point_encoder.level import VoxelLevel
from models.point_encoder.serialization import CURVES, SpaceFillingCurve
from stable_data.errors import ConfigError

STEMS, NORMS, POOLS = ("conv", "linear"), ("bn", "ln"), ("code", "grid")


@dataclass(frozen=True, slots=True)
class TransformerConfig:
    """Configuration of a Point Transformer V3. The flags distinguish the published generations.

    Attributes:
        in_channels: Input features of a voxel.
        stem: ``conv`` (5x5x5, first generation) or ``linear`` (Sonata, Concerto).
        norm: Normalisation of stem, pooling and unpooling, ``bn`` or ``ln``; blocks always have ``ln``.
        pool: Source of a coarser level's codes: ``code`` (the finer codes >> 3) or ``grid`` (coordinates // 2).
        enc_mode: Whether the network has no decoder; its output is then features of the coarsest voxels.
        layer_scale: Initial factor of the residual branches of blocks; None for no factor.
        legacy_stale_cpe: Whether the first convolution after an unpooling reads only the encoder's part of the features, as in
            the training of first-generation weights.
        curves: Curves of attention; block k of a stage uses curve k modulo their number.
        patch_size: Largest number of voxels in an attention patch.
        enc_depths: Number of blocks of each encoder stage.
        enc_channels: Channels of each encoder stage.
        enc_heads: Attention heads of each encoder stage.
        dec_depths: Number of blocks of each decoder stage, the finest first; one stage less than the encoder.
        dec_channels: Channels of each decoder stage.
        dec_heads: Attention heads of each decoder stage.
    """

    in_channels: int = 6
    stem: str = "conv"
    norm: str = "bn"
    pool: str = "code"
    enc_mode: bool = False
    layer_scale: float | None = None
    legacy_stale_cpe: bool = False
    curves: tuple[str, ...] = CURVES
    patch_size: int = 1024
    enc_depths: tuple[int, ...] = (2, 2, 2, 6, 2)
    enc_channels: tuple[int, ...] = (32, 64, 128, 256, 512)
    enc_heads: tuple[int, ...] = (2, 4, 8, 16, 32)
    dec_depths: tuple[int, ...] = (2, 2, 2, 2)
    dec_channels: tuple[int, ...] = (64, 64, 128, 256)
    dec_heads: tuple[int, ...] = (4, 4, 8, 16)

    def __post_init__(self) -> None:
        """Checks the values.

        Raises:
            ConfigError: A value is unknown, or depths, channels and heads do not match (``encoder_config``).
        """
        for name, allowed in (("stem", STEMS), ("norm", NORMS), ("pool", POOLS)):
            if getattr(self, name) not in allowed:
                raise ConfigError(
                    f"point encoder: {name} is {getattr(self, name)!r}, expected one of {allowed}", "encoder_config"
                )
        unknown = sorted(set(self.curves) - set(CURVES))
        if unknown or not self.curves:
            raise ConfigError(
                f"point encoder: curves {unknown or 'missing'}, expected of {tuple(map(str, CURVES))}", "encoder_config"
            )
        num_dec = 0 if self.enc_mode else len(self.enc_depths) - 1
        for part, num in (("enc", len(self.enc_depths)), ("dec", num_dec)):
            sizes = [getattr(self, f"{part}_{what}") for what in ("depths", "channels", "heads")]
            if any(len(size) < num for size in sizes) or any(c % h for c, h in zip(*sizes[1:], strict=False)):
                message = f"point encoder: {part}_depths, _channels, _heads are {sizes}, expected {num} stages with whole heads"
                raise ConfigError(message, "encoder_config")

    @property
    def out_channels(self) -> int:
        """Number of output channels."""
        return self.enc_channels[-1] if self.enc_mode or not self.dec_channels else self.dec_channels[0]


BASE = TransformerConfig(legacy_stale_cpe=True)
"""The published network of the first generation, 46.17 M parameters."""

EMBEDDED = TransformerConfig(
    norm="ln",
    enc_mode=True,
    patch_size=256,
    enc_depths=(1, 1, 2),
    enc_channels=(32, 64, 128),
    enc_heads=(2, 4, 8),
    dec_depths=(),
    dec_channels=(),
    dec_heads=(),
)
"""A network for a CPU. One code per cloud needs no decoder. With layer norms only, clouds are independent in training too."""


class PointTransformer(nn.Module):
    """The network.

    Args:
        config: Its configuration.
    """

    def __init__(self, config: TransformerConfig) -> None:
        super().__init__()
        self.config = config
        self._curves = tuple(SpaceFillingCurve(c) for c in config.curves)
        channels, num_stages = config.enc_channels, len(config.enc_depths)

        def blocks(depth: int, width: int, heads: int) -> dict[str, nn.Module]:
            num_curves = len(self._curves)
            make = partial(Block, width, heads, config.patch_size)
            return {f"block{k}": make(k % num_curves, config.layer_scale) for k in range(depth)}

        is_conv = config.stem == "conv"
        first: nn.Module = (
            SubMConv3d(config.in_channels, channels[0], 5, bias=False)
            if is_conv
            else nn.Linear(config.in_channels, channels[0])
        )
        stem = nn.ModuleDict({config.stem: first, "norm": self._norm(channels[0])})
        self.embedding = nn.ModuleDict({"stem": stem})
        self.enc = nn.ModuleDict()
        for s in range(num_stages):
            down = {"down": VoxelPooling(channels[s - 1], channels[s], self._norm(channels[s]))} if s else {}
            stage = {**down, **blocks(config.enc_depths[s], channels[s], config.enc_heads[s])}
            self.enc[f"enc{s}"] = nn.ModuleDict(stage)
        if not config.enc_mode:
            self.dec = nn.ModuleDict()
            widths = (*config.dec_channels[: num_stages - 1], channels[-1])
            for s in reversed(range(num_stages - 1)):
                up = VoxelUnpooling(widths[s + 1], channels[s], widths[s], [self._norm(widths[s]) for _ in range(2)])
                self.dec[f"dec{s}"] = nn.ModuleDict({"up": up, **blocks(config.dec_depths[s], widths[s], config.dec_heads[s])})
        self.apply(_initialise)

    def _norm(self, channels: int) -> nn.Module:
        return nn.BatchNorm1d(channels, eps=1e-3, momentum=0.01) if self.config.norm == "bn" else nn.LayerNorm(channels)

    def forward(self, coords: Tensor, batch: Tensor, features: Tensor) -> tuple[Tensor, VoxelLevel]:
        """Computes features of voxels.

        Args:
            coords: (V, 3) int64, from 0, below 2**16, distinct in each cloud.
            batch: Cloud of each voxel, (V,) int64; every cloud has a voxel.
            features: (V, in_channels) float32.

        Returns:
            Features (V', out_channels) float32 and their voxels, in the level's order; the coarsest voxels in ``enc_mode``.
        """
        by_code = self.config.pool == "code"
        level, rows = VoxelLevel.of_voxels(coords, batch, self._curves, with_margin=not by_code)
        stem = self.embedding["stem"]
        assert isinstance(stem, nn.ModuleDict)
        features = features[rows]
        features = stem["conv"](features, level) if self.config.stem == "conv" else stem["linear"](features)
        features = functional.gelu(stem["norm"](features))
        finer: list[tuple[Tensor, VoxelLevel, Tensor]] = []
        for stage in self.enc.values():
            assert isinstance(stage, nn.ModuleDict)
            for name, part in stage.items():
                if name == "down":
                    coarse, cluster = level.pooled(self._curves, by_code=by_code)
                    finer.append((features, level, cluster))
                    features, level = part(features, cluster, len(coarse)), coarse
                else:
                    features = part(features, level)
        return (features, level) if self.config.enc_mode else self._decode(features, finer)

    def _decode(self, features: Tensor, finer: list[tuple[Tensor, VoxelLevel, Tensor]]) -> tuple[Tensor, VoxelLevel]:
        for stage in self.dec.values():
            assert isinstance(stage, nn.ModuleDict)
            skip, level, cluster = finer.pop()
            stale: Tensor | None = None
            for name, part in stage.items():
                if name == "up":
                    features, own = part(features, skip, cluster)
                    stale = own if self.config.legacy_stale_cpe else None
                else:
                    features, stale = part(features, level, stale), None
        return features, level


def _initialise(module: nn.Module) -> None:
    if isinstance(module, nn.Linear):
        nn.init.trunc_normal_(module.weight, std=0.02)
        nn.init.zeros_(module.bias)
