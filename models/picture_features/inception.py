"""The Inception v3 of FID and KID: 2048 numbers for each picture.

FID (Heusel et al. 2017) is defined with the network that TensorFlow published on 2015-12-05 (``pool3``). It differs from the Inception v3
of torchvision in three places: the padding of average pools is not counted, the last block has a maximum pool instead of an average
pool, and the weights are others. The batch normalisations, which have no scale, are folded into the convolutions.

Pictures are prepared as pytorch-fid does: values 0 to 255 become 0 to 1, the size becomes 299 x 299 with bilinear interpolation without
smoothing (``align_corners=False``), and then values become -1 to 1. Pictures of 299 x 299 keep their size. TensorFlow's own graph, and
torch-fidelity with it, maps 255 to 0.992 instead of 1 and interpolates from the corners of pixels, so its values are a little different.
"""

import hashlib
from collections.abc import Sequence
from functools import cached_property
from itertools import chain
from pathlib import Path

import numpy as np
import torch
from torch import Tensor, nn
from torch.nn import functional

from models.picture_features.extractor import BATCH, Pictures, Rows, check_pictures
from models.picture_features.inception_weights import LayerWeights, read_layers
from stable_data.errors import ConfigError
from stable_data.feature_files import INCEPTION

WIDTH = 2048
"""Numbers of a feature."""

_SIDE = 299  # pixels
_VERSION = "1"  # of the preparation of pictures


class InceptionFeatures:
    """The extractor of FID.

    Args:
        path: The weights in one of the known files, see :mod:`models.picture_features.inception_weights`.
        device: The torch device.

    Raises:
        ConfigError: The file is missing (``weights_missing``) or is not a known one (``hash_mismatch``).
    """

    name = INCEPTION
    distance_name = "FID"
    kernel_distance_name = "KID"

    def __init__(self, path: Path, device: str = "cpu") -> None:
        self._device = torch.device(device)
        self.network = inception_network(read_layers(path)).to(self._device)

    @cached_property
    def fingerprint(self) -> str:
        """Hash of the weights, whatever file they come from, and of the preparation of pictures."""
        digest = hashlib.sha256(_VERSION.encode())
        for tensor in self.network.state_dict().values():
            digest.update(tensor.cpu().numpy().tobytes())
        return digest.hexdigest()[:16]

    def __call__(self, pictures: Pictures, /) -> Rows:
        """Computes the features of pictures of one size, (N, 2048) float32.

        Raises:
            ConfigError: They are no pictures (``pictures_invalid``).
        """
        check_pictures(pictures)
        rows = np.zeros((len(pictures), WIDTH), np.float32)
        for start in range(0, len(pictures), BATCH):
            part = pictures[start : start + BATCH]
            filled = np.zeros((BATCH, *part.shape[1:]), np.uint8)
            filled[: len(part)] = part
            with torch.inference_mode():
                found = self.network(prepared(torch.from_numpy(filled).to(self._device)))
            rows[start : start + len(part)] = found[: len(part)].cpu().numpy()
        return rows


def prepared(pictures: Tensor) -> Tensor:
    """Prepares pictures (N, H, W, 3) uint8 for the network: (N, 3, 299, 299) float32, -1 to 1."""
    values = pictures.permute(0, 3, 1, 2).float() / 255
    scaled = 2 * functional.interpolate(values, size=(_SIDE, _SIDE), mode="bilinear", align_corners=False) - 1
    return scaled.contiguous(memory_format=torch.channels_last)  # a quarter faster on a CPU


class InceptionNetwork(nn.Sequential):
    """The network: prepared pictures (N, 3, 299, 299) float32 -> (N, 2048) float32."""

    def __init__(self) -> None:
        super().__init__(
            _conv(3, 32, 3, stride=2), _conv(32, 32, 3, pads=False), _conv(32, 64, 3), nn.MaxPool2d(3, 2),
            _conv(64, 80), _conv(80, 192, 3, pads=False), nn.MaxPool2d(3, 2),
            _block_a(192, 32), _block_a(256, 64), _block_a(288, 64),
            _block_b(288),
            _block_c(768, 128), _block_c(768, 160), _block_c(768, 160), _block_c(768, 192),
            _block_d(768),
            _block_e(1280, _average_pool()), _block_e(2048, nn.MaxPool2d(3, 1, 1)),
            nn.AdaptiveAvgPool2d(1), nn.Flatten(),
        )  # fmt: skip


def inception_network(layers: Sequence[LayerWeights]) -> InceptionNetwork:
    """Builds the network with the weights of its 94 convolutions, in its order.

    Raises:
        ConfigError: Number or shapes of the weights do not fit (``weights_invalid``).
    """
    with torch.device("meta"):  # nothing is initialised that is replaced
        network = InceptionNetwork()
    convolutions = [module for module in network.modules() if isinstance(module, _Convolution)]
    shapes = [tuple(module.weight.shape) for module in convolutions]
    if shapes != [tuple(layer.weight.shape) for layer in layers]:
        raise ConfigError(
            f"the weights have {len(layers)} convolutions, expected the {len(shapes)} of Inception v3 with its shapes",
            "weights_invalid",
        )
    folded = chain.from_iterable(layer.folded() for layer in layers)
    names = [
        f"{name}.{part}" for name, m in network.named_modules() if isinstance(m, _Convolution) for part in ("weight", "bias")
    ]
    laid_out = (tensor.contiguous(memory_format=torch.channels_last) if tensor.dim() == 4 else tensor for tensor in folded)
    network.load_state_dict(dict(zip(names, laid_out, strict=True)), assign=True)
    return network.eval().requires_grad_(False)


class _Convolution(nn.Conv2d):
    """A convolution and its ReLU."""

    def forward(self, input: Tensor) -> Tensor:  # noqa: A002 - the name of the superclass
        return functional.relu_(super().forward(input))


class _Branches(nn.ModuleList):
    """Modules with the same input, whose outputs are joined along the channels."""

    def forward(self, x: Tensor) -> Tensor:
        return torch.cat([branch(x) for branch in self], dim=1)


def _conv(inputs: int, outputs: int, kernel: int | tuple[int, int] = 1, stride: int = 1, *, pads: bool = True) -> _Convolution:
    """A convolution that keeps height and width; without padding if it has a stride or if ``pads`` is False."""
    sides = (kernel, kernel) if isinstance(kernel, int) else kernel
    padding = tuple(side // 2 for side in sides) if pads and stride == 1 else (0, 0)
    return _Convolution(inputs, outputs, sides, stride, (padding[0], padding[1]))


def _average_pool() -> nn.AvgPool2d:
    return nn.AvgPool2d(3, 1, 1, count_include_pad=False)


def _chain(*parts: nn.Module) -> nn.Sequential:
    return nn.Sequential(*parts)


def _block_a(inputs: int, pooled: int) -> _Branches:
    return _Branches([
        _conv(inputs, 64),
        _chain(_conv(inputs, 48), _conv(48, 64, 5)),
        _chain(_conv(inputs, 64), _conv(64, 96, 3), _conv(96, 96, 3)),
        _chain(_average_pool(), _conv(inputs, pooled)),
    ])  # fmt: skip


def _block_b(inputs: int) -> _Branches:
    return _Branches([
        _conv(inputs, 384, 3, stride=2),
        _chain(_conv(inputs, 64), _conv(64, 96, 3), _conv(96, 96, 3, stride=2)),
        nn.MaxPool2d(3, 2),
    ])  # fmt: skip


def _block_c(inputs: int, inner: int) -> _Branches:
    wide, high = (1, 7), (7, 1)
    return _Branches([
        _conv(inputs, 192),
        _chain(_conv(inputs, inner), _conv(inner, inner, wide), _conv(inner, 192, high)),
        _chain(
            _conv(inputs, inner), _conv(inner, inner, high), _conv(inner, inner, wide), _conv(inner, inner, high),
            _conv(inner, 192, wide),
        ),
        _chain(_average_pool(), _conv(inputs, 192)),
    ])  # fmt: skip


def _block_d(inputs: int) -> _Branches:
    return _Branches([
        _chain(_conv(inputs, 192), _conv(192, 320, 3, stride=2)),
        _chain(_conv(inputs, 192), _conv(192, 192, (1, 7)), _conv(192, 192, (7, 1)), _conv(192, 192, 3, stride=2)),
        nn.MaxPool2d(3, 2),
    ])  # fmt: skip


def _block_e(inputs: int, pool: nn.Module) -> _Branches:
    def split() -> _Branches:
        return _Branches([_conv(384, 384, (1, 3)), _conv(384, 384, (3, 1))])

    return _Branches([
        _conv(inputs, 320),
        _chain(_conv(inputs, 384), split()),
        _chain(_conv(inputs, 448), _conv(448, 384, 3), split()),
        _chain(pool, _conv(inputs, 192)),
    ])  # fmt: skip
