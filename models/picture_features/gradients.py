"""A feature of pictures without weights: histograms of colours and of oriented gradients.

It is the same on every machine and needs no file, but it knows nothing of objects: it sees colours, edges and where they are. Its
distance is not FID, and values of both cannot be compared.

A picture becomes 128 x 128 pixels, each the mean of the area that it covers. Then, with values from 0 to 1:

* Colours: brightness ``(R + G + B) / 3`` and the opponent colours ``(R - G + 1) / 2`` and ``((R + G) / 2 - B + 1) / 2``. Each gives
  histograms with 8 bins over 0 to 1, in which a value is shared by the two nearest bins: in 4 x 4 cells, in 2 x 2 cells and in the whole
  picture.
* Gradients of brightness at 128, 64 and 32 pixels, by central differences: a histogram of 8 orientations from 0 to 180 degrees, shared
  likewise, in 4 x 4 cells. A pixel counts by four times the length of its gradient, at most 1; what is missing to 1 goes to a ninth bin.

Each histogram sums to 1. The feature is the square root of all of them, 936 numbers: the Euclidean distance of two features is then
proportional to the Hellinger distance of their histograms.
"""

import hashlib
from pathlib import Path
from typing import Any, TypeAlias

import numpy as np
import numpy.typing as npt

from models.picture_features.extractor import Pictures, Rows, check_pictures
from stable_data.feature_files import GRADIENTS

_SIDE, _SCALES = 128, (1, 2, 4)
_BINS, _CELLS = 8, 4
_STRENGTH = 4.0
_CHUNK = 32  # pictures at a time, which bounds the memory

Planes: TypeAlias = npt.NDArray[np.floating[Any]]


class GradientFeatures:
    """The extractor of this module."""

    name = GRADIENTS
    distance_name = f"Frechet distance ({GRADIENTS})"
    kernel_distance_name = f"kernel distance ({GRADIENTS})"

    @property
    def fingerprint(self) -> str:
        """Hash of this module, which determines the rows."""
        return hashlib.sha256(Path(__file__).read_bytes()).hexdigest()[:16]

    def __call__(self, pictures: Pictures, /) -> Rows:
        """Computes the features of pictures of one size, (N, 936) float32.

        Raises:
            ConfigError: They are no pictures (``pictures_invalid``).
        """
        check_pictures(pictures)
        parts = [_rows(pictures[k : k + _CHUNK]) for k in range(0, len(pictures), _CHUNK)]
        return np.concatenate(parts) if parts else np.zeros((0, _rows(np.zeros((1, 1, 1, 3), np.uint8)).shape[1]), np.float32)


def _rows(pictures: Pictures) -> Rows:
    small = _reduced(pictures)  # (N, 128, 128, 3)
    red, green, blue = (small[..., k] for k in range(3))
    brightness: Planes = np.asarray((red + green + blue) / 3, np.float32)
    histograms = []
    for channel in (brightness, (red - green + 1) / 2, ((red + green) / 2 - blue + 1) / 2):
        shares = _shares(np.asarray(channel * (_BINS - 1), np.float32), _BINS)  # (8, N, 128, 128)
        histograms += [_cell_means(shares, cells) for cells in (_CELLS, 2, 1)]
    for scale in _SCALES:
        histograms.append(_orientations(_block_means(brightness, _SIDE // scale)))
    return np.asarray(np.sqrt(np.concatenate(histograms, axis=1)), np.float32)


def _reduced(pictures: Pictures) -> Planes:
    """Pictures of 128 x 128, (N, 128, 128, 3), 0 to 1; each pixel is the mean of the area that it covers."""
    rows, columns = (_area_weights(side) for side in pictures.shape[1:3])
    number, height, width, _ = pictures.shape
    high = rows @ (pictures.astype(np.float32) / 255).reshape(number, height, width * 3)
    return np.asarray(columns @ high.reshape(number, _SIDE, width, 3), np.float32)


def _area_weights(side: int) -> Planes:
    """The share of each of ``side`` pixels in each of 128, (128, side); the rows sum to 1."""
    edges = np.arange(_SIDE + 1) * (side / _SIDE)
    pixels = np.arange(side)
    low, high = np.maximum(edges[:-1, None], pixels), np.minimum(edges[1:, None], pixels + 1)
    return np.asarray(np.maximum(high - low, 0) * (_SIDE / side), np.float32)


def _shares(positions: Planes, bins: int) -> Planes:
    """The share of each bin in each value, (bins, …): 1 at the bin, 0 at the next one."""
    return np.stack([np.asarray(np.maximum(1 - np.abs(positions - k), 0)) for k in range(bins)])


def _orientations(brightness: Planes) -> Planes:
    """Histograms of orientations of (N, S, S) in cells, (N, 9 * cells)."""
    down, right = np.gradient(brightness, axis=(1, 2))
    strength = np.minimum(_STRENGTH * np.hypot(down, right), 1)
    position = np.mod(np.arctan2(down, right) / np.pi, 1) * _BINS
    shares = _shares(position, _BINS + 1)
    shares[0] += shares[-1]  # 180 degrees are 0 degrees
    shares[:-1] *= strength
    shares[-1] = 1 - strength
    return _cell_means(shares, _CELLS)


def _cell_means(shares: Planes, cells: int) -> Planes:
    """Means of planes (B, N, S, S) in cells x cells, (N, B * cells²)."""
    means = np.stack([_block_means(plane, cells) for plane in shares], axis=1)
    return np.ascontiguousarray(means.reshape(len(means), -1))


def _block_means(planes: Planes, side: int) -> Planes:
    """Means of (N, S, S) in blocks, (N, side, side)."""
    number, size, _ = planes.shape
    block = size // side
    return np.asarray(planes.reshape(number, side, block, side, block).mean(axis=(2, 4)), np.float32)
