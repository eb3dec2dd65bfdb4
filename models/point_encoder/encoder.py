"""The point encoder: maps the cloud of an object to 64 numbers."""

import hashlib
import json
from collections.abc import Sequence
from dataclasses import asdict, dataclass

import numpy as np
import numpy.typing as npt
import torch
from torch import Tensor, nn

from models.point_encoder.cloud import PointCloud, Preprocessing, voxelise
from models.point_encoder.transformer import PointTransformer, TransformerConfig
from models.torch_threads import one_thread
from stable_data.assets.point_features import SMALLEST_EXTENT
from stable_data.errors import ConfigError, MeshError

FEATURE_CHANNELS = 64

_DEVICE_BATCH = 64  # clouds in a batch on a GPU; on a CPU, one: a batch saves no time there, and changes the last bits


@dataclass(frozen=True, slots=True, eq=False)
class PointCodes:
    """Point features of B clouds.

    Attributes:
        codes: Features of the normalised clouds, (B, 64) float32.
        log_extents: Natural logarithms of the sizes before normalisation, metres, (B, 3) float32.
        fingerprint: Fingerprint of the encoder; features of different encoders must not be mixed.
    """

    codes: npt.NDArray[np.float32]
    log_extents: npt.NDArray[np.float32]
    fingerprint: str


class PointEncoder(nn.Module):
    """Point Transformer V3, mean-pooled over the voxels of each cloud.

    If the network's output has not 64 channels, `fit_projection` must be called once, with the assets that will be encoded,
    unless the weights include a learned projection.

    Args:
        config: Configuration of the network.
        preprocessing: Preprocessing of the weights.

    Raises:
        ConfigError: The preprocessing and the network have different numbers of channels (``encoder_config``).
    """

    def __init__(self, config: TransformerConfig, preprocessing: Preprocessing) -> None:
        super().__init__()
        if config.in_channels != preprocessing.num_channels:
            message = (
                f"point encoder takes {config.in_channels} channels, its preprocessing makes {preprocessing.num_channels} "
                f"({', '.join(preprocessing.channels)}); use the preprocessing that the weights were trained with"
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
        """The configuration of the network."""
        return self.backbone.config

    @property
    def device(self) -> torch.device:
        """The device of the weights."""
        return next(self.parameters()).device

    def forward(self, clouds: Sequence[PointCloud]) -> Tensor:
        """Computes means over the voxels of each cloud, (B, out_channels) float32, before the projection."""
        voxels = voxelise(clouds, self.preprocessing, self.device)
        features, level = self.backbone(voxels.coords, voxels.batch, voxels.features)
        lengths = torch.tensor(level.lengths, device=features.device)
        # Unlike index_add_, segment_reduce sums in a fixed order on every device.
        return torch.segment_reduce(features, "mean", lengths=lengths, axis=0, unsafe=True)

    def encode(self, clouds: Sequence[PointCloud]) -> PointCodes:
        """Computes features with log extents and fingerprint; see :meth:`codes`."""
        extents = np.array([cloud.size for cloud in clouds], np.float32).reshape(-1, 3)
        return PointCodes(self.codes(clouds), np.log(np.maximum(extents, SMALLEST_EXTENT)), self.fingerprint())

    @one_thread()
    def codes(self, clouds: Sequence[PointCloud]) -> npt.NDArray[np.float32]:
        """Computes features, (B, 64) float32, each independent of the order of points and of the other clouds, except for rounding.

        On a CPU, the other clouds and the number of threads change no bit; on another device, the last bits depend on the clouds in
        the batch.

        Args:
            clouds: Any number of clouds of :meth:`PointCloud.of_shape` with ``preprocessing.num_points``.

        Raises:
            MeshError: A cloud has not ``preprocessing.num_points`` points, which would change its code (``cloud_invalid``).
            ConfigError: The output has not 64 channels and no projection was fitted (``encoder_unprojected``).
        """
        if self.needs_projection and not self.basis.any():
            message = f"point encoder gives {self.config.out_channels} channels, expected {FEATURE_CHANNELS}; call fit_projection first"
            raise ConfigError(message, "encoder_unprojected")
        parts = [self._projected(pooled).numpy() for pooled in self._pooled(clouds)]
        return np.concatenate(parts) if parts else np.zeros((0, FEATURE_CHANNELS), np.float32)

    def _projected(self, pooled: Tensor) -> Tensor:
        """The features of a batch; a product over more clouds at once may sum in another order."""
        return (pooled - self.mean.cpu()) @ self.basis.T.cpu() if self.needs_projection else pooled

    @one_thread()
    def fit_projection(self, clouds: Sequence[PointCloud]) -> None:
        """Fits the projection to 64 channels: whitened principal directions over clouds, more than 64 of them.

        Raises:
            ConfigError: The output has 64 channels already (``encoder_config``), or the clouds span less than 64 dimensions
                (``encoder_rank``).
        """
        if not self.needs_projection:
            raise ConfigError("point encoder has 64 output channels, expected another number to project", "encoder_config")
        codes = torch.cat([torch.zeros(0, self.config.out_channels), *self._pooled(clouds)]).double()
        mean = codes.mean(0)
        _, spread, directions = torch.linalg.svd(codes - mean, full_matrices=False)
        rank = int((spread > 1e-6 * spread.max()).sum())
        if rank < FEATURE_CHANNELS:
            message = f"{len(codes)} clouds span {rank} dimensions, expected at least {FEATURE_CHANNELS}; use more and different clouds"
            raise ConfigError(message, "encoder_rank")
        deviation = spread[:FEATURE_CHANNELS, None] / len(codes) ** 0.5
        # The sign of a singular vector is arbitrary: the largest component becomes positive.
        basis = directions[:FEATURE_CHANNELS]
        basis = basis * basis.gather(1, basis.abs().argmax(1, keepdim=True)).sign()
        self.set_projection(mean.float(), (basis / deviation).float())

    def set_projection(self, mean: Tensor, basis: Tensor) -> None:
        """Sets the projection of the network's C channels to 64: ``basis @ (channels - mean)``.

        Args:
            mean: (C,) float32.
            basis: (64, C) float32.
        """
        assert self.needs_projection
        self.mean, self.basis = mean.clone().to(self.device), basis.clone().to(self.device)

    def fingerprint(self) -> str:
        """Hashes weights, configuration and preprocessing, 32 hexadecimal digits."""
        digest = hashlib.sha256(json.dumps(self.settings(), sort_keys=True).encode())
        for name, tensor in sorted(self.state_dict().items()):
            digest.update(f"{name} {tensor.dtype} {tuple(tensor.shape)}".encode())
            digest.update(tensor.detach().cpu().contiguous().numpy().tobytes())
        return digest.hexdigest()[:32]

    def settings(self) -> dict[str, dict[str, object]]:
        """Configuration and preprocessing as plain values."""
        return {"config": asdict(self.config), "preprocessing": asdict(self.preprocessing)}

    @torch.no_grad()
    def _pooled(self, clouds: Sequence[PointCloud]) -> list[Tensor]:
        """Computes the means over the voxels of each batch of clouds, (batch, out_channels) each."""
        expected = self.preprocessing.num_points
        if others := sorted({len(cloud.points) for cloud in clouds} - {expected}):
            message = f"clouds have {others} points, expected the {expected} of this encoder's preprocessing"
            raise MeshError(message, "cloud_invalid")
        was_training, size = self.training, 1 if self.device.type == "cpu" else _DEVICE_BATCH
        self.eval()
        try:
            return [self(clouds[k : k + size]).cpu() for k in range(0, len(clouds), size)]
        finally:
            self.train(was_training)
