"""The point encoder: clouds of objects to 64 numbers each, and the logarithm of their extents."""

import hashlib
import json
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import asdict, dataclass

import numpy as np
import numpy.typing as npt
import torch
from torch import Tensor, nn

from models.point_encoder.cloud import PointCloud, Preprocessing, voxelise
from models.point_encoder.transformer import PointTransformer, TransformerConfig
from stable_data.errors import ConfigError, MeshError

FEATURE_CHANNELS = 64

_SMALLEST_EXTENT = 1e-4  # metres: a sheet has a logarithm too


@dataclass(frozen=True, slots=True, eq=False)
class PointCodes:
    """What is known of B clouds.

    Attributes:
        codes: (B, 64) float32, of the normalised cloud.
        log_extents: Natural logarithm of the box of the cloud as given, metres, (B, 3) float32.
        fingerprint: The encoder that made them; features of different encoders are never mixed.
    """

    codes: npt.NDArray[np.float32]
    log_extents: npt.NDArray[np.float32]
    fingerprint: str


class PointEncoder(nn.Module):
    """Point Transformer V3, mean-pooled over the voxels of each cloud.

    Where the network gives more or less than 64 channels, `fit_projection` must be called once, on the assets it will serve,
    unless its weights came with a projection that was learned with them.

    Args:
        config: The network.
        preprocessing: What its weights expect of a cloud.

    Raises:
        ConfigError: The preprocessing makes other channels than the network takes.
    """

    def __init__(self, config: TransformerConfig, preprocessing: Preprocessing) -> None:
        super().__init__()
        if config.in_channels != preprocessing.num_channels:
            message = (
                f"point encoder takes {config.in_channels} channels, its preprocessing makes {preprocessing.num_channels} "
                f"({', '.join(preprocessing.channels)}); give the preprocessing that the weights were trained with"
            )
            raise ConfigError(message, "encoder_config")
        self.preprocessing = preprocessing
        self.backbone = PointTransformer(config)
        self.needs_projection = config.out_channels != FEATURE_CHANNELS
        if self.needs_projection:
            self.register_buffer("mean", torch.zeros(config.out_channels))
            self.register_buffer("basis", torch.zeros(FEATURE_CHANNELS, config.out_channels))

    @property
    def config(self) -> TransformerConfig:
        """What the network looks like."""
        return self.backbone.config

    @property
    def device(self) -> torch.device:
        """Where it is."""
        return next(self.parameters()).device

    def forward(self, clouds: Sequence[PointCloud]) -> Tensor:
        """Means over the voxels of each cloud, (B, out_channels) float32, not yet projected."""
        voxels = voxelise(clouds, self.preprocessing, self.device)
        features, level = self.backbone(voxels.coords, voxels.batch, voxels.features)
        lengths = torch.tensor(level.lengths, device=features.device)
        # Not index_add_: it sums in a fixed order on every device.
        return torch.segment_reduce(features, "mean", lengths=lengths, axis=0, unsafe=True)

    def encode(self, clouds: Sequence[PointCloud], batch_size: int = 16) -> PointCodes:
        """Features of clouds with what they are kept with; see :meth:`codes`."""
        extents = np.array([cloud.size for cloud in clouds], np.float32).reshape(-1, 3)
        return PointCodes(self.codes(clouds, batch_size), np.log(np.maximum(extents, _SMALLEST_EXTENT)), self.fingerprint())

    def codes(self, clouds: Sequence[PointCloud], batch_size: int = 16) -> npt.NDArray[np.float32]:
        """Features of clouds, (B, 64) float32, each independent of the others and of the order of its points.

        Args:
            clouds: Any number, as :meth:`PointCloud.of_shape` makes them with ``preprocessing.num_points``.
            batch_size: Clouds at once.

        Raises:
            MeshError: A cloud has other than ``preprocessing.num_points`` points: its code would be another.
            ConfigError: The encoder gives other than 64 channels and no projection was fitted.
        """
        codes = self._pooled(clouds, batch_size)
        if self.needs_projection:
            if not self.basis.any():
                message = (
                    f"point encoder gives {codes.shape[1]} channels, expected {FEATURE_CHANNELS}; call fit_projection first"
                )
                raise ConfigError(message, "encoder_unprojected")
            codes = (codes - self.mean.cpu()) @ self.basis.T.cpu()
        return codes.numpy()

    def fit_projection(self, clouds: Sequence[PointCloud], batch_size: int = 16) -> None:
        """Fits what turns the network's channels into 64: the whitened principal directions over clouds, more than 64 of them.

        Raises:
            ConfigError: They span less than 64 dimensions, or there is nothing to fit.
        """
        if not self.needs_projection:
            raise ConfigError("point encoder gives 64 channels by itself, expected others to project", "encoder_config")
        codes = self._pooled(clouds, batch_size).double()
        mean = codes.mean(0)
        _, spread, directions = torch.linalg.svd(codes - mean, full_matrices=False)
        rank = int((spread > 1e-6 * spread.max()).sum())
        if rank < FEATURE_CHANNELS:
            message = (
                f"{len(codes)} clouds span {rank} dimensions, expected at least {FEATURE_CHANNELS}; give more, unlike ones"
            )
            raise ConfigError(message, "encoder_rank")
        deviation = spread[:FEATURE_CHANNELS, None] / len(codes) ** 0.5
        # The sign of a direction is the solver's choice: its largest part is made positive.
        kept = directions[:FEATURE_CHANNELS]
        kept = kept * kept.gather(1, kept.abs().argmax(1, keepdim=True)).sign()
        self.set_projection(mean.float(), (kept / deviation).float())

    def set_projection(self, mean: Tensor, basis: Tensor) -> None:
        """Sets what turns the network's C channels into 64: ``basis @ (channels - mean)``.

        Args:
            mean: (C,) float32.
            basis: (64, C) float32.
        """
        assert self.needs_projection
        self.mean, self.basis = mean.clone().to(self.device), basis.clone().to(self.device)

    def fingerprint(self) -> str:
        """Names the encoder: a hash of weights, configuration and preprocessing, 32 hexadecimal digits."""
        digest = hashlib.sha256(json.dumps(self.settings(), sort_keys=True).encode())
        for name, tensor in sorted(self.state_dict().items()):
            digest.update(f"{name} {tensor.dtype} {tuple(tensor.shape)}".encode())
            digest.update(tensor.detach().cpu().contiguous().numpy().tobytes())
        return digest.hexdigest()[:32]

    def settings(self) -> dict[str, dict[str, object]]:
        """Configuration and preprocessing, plain values."""
        return {"config": asdict(self.config), "preprocessing": asdict(self.preprocessing)}

    @torch.no_grad()
    def _pooled(self, clouds: Sequence[PointCloud], batch_size: int) -> Tensor:
        wanted = self.preprocessing.num_points
        if odd := sorted({len(cloud.points) for cloud in clouds} - {wanted}):
            raise MeshError(f"clouds have {odd} points, expected the {wanted} of this encoder's preprocessing", "cloud_invalid")
        was_training = self.training
        self.eval()
        try:
            parts = [self(clouds[k : k + batch_size]).cpu() for k in range(0, len(clouds), batch_size)]
        finally:
            self.train(was_training)
        return torch.cat(parts) if parts else torch.zeros(0, self.config.out_channels)


@contextmanager
def one_thread() -> Iterator[None]:
    """Lets torch use one thread: how sums are cut among threads shows in their last bits."""
    before = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        yield
    finally:
        torch.set_num_threads(before)
