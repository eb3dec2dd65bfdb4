"""Pictures as the network of a policy sees them: small, those of all cameras behind each other."""

from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np
import numpy.typing as npt
from PIL import Image
from torch import Tensor, nn

from stable_data.robot.episodes import Episode, EpisodeFeatures
from stable_data.simulation.offscreen import Picture

SmallPictures = npt.NDArray[np.uint8]


def observed_pictures(pixels: Mapping[str, Picture], cameras: Sequence[str], size: int) -> SmallPictures:
    """Returns what the network sees of an observation, (3 C, S, S) uint8.

    Args:
        pixels: Camera -> picture (H, W, 3) uint8.
        cameras: The C cameras.
        size: Side S of a picture.
    """
    small = [np.asarray(Image.fromarray(pixels[name]).resize((size, size), Image.Resampling.BILINEAR)) for name in cameras]
    return np.concatenate(small, axis=2).transpose(2, 0, 1) if small else np.zeros((0, size, size), np.uint8)


def episode_pictures(episode: Episode, cameras: Sequence[str], size: int) -> SmallPictures:
    """Returns what the network sees before each action of an episode, (T, 3 C, S, S) uint8; see :func:`observed_pictures`.

    Raises:
        EpisodeError: A picture cannot be decoded (``episode_invalid``).
    """
    found = np.zeros((episode.num_steps, 3 * len(cameras), size, size), np.uint8)
    for k in range(episode.num_steps if cameras else 0):
        pixels = {name: episode.decoded_picture(name, k) for name in cameras}
        found[k] = observed_pictures(pixels, cameras, size)
    return found


def seen_features(features: EpisodeFeatures, cameras: Sequence[str]) -> EpisodeFeatures:
    """Returns the features of episodes with the pictures that a network sees of them alone."""
    return replace(features, cameras=tuple(cameras), image_size=features.image_size if cameras else None)


class PictureEncoder(nn.Module):
    """Convolutions that make a few numbers of the pictures of all cameras.

    Args:
        num_cameras: Cameras C, at least one.
        size: Side S of a picture, a multiple of 16.
        width: Numbers of the result.
    """

    def __init__(self, num_cameras: int, size: int, width: int) -> None:
        super().__init__()
        layers: list[nn.Module] = []
        channels = 3 * num_cameras
        for out, kernel in ((16, 5), (32, 3), (64, 3), (64, 3)):
            layers += [nn.Conv2d(channels, out, kernel, stride=2, padding=kernel // 2), nn.GELU()]
            channels = out
        self.layers = nn.Sequential(*layers, nn.Flatten(), nn.Linear(channels * (size // 16) ** 2, width), nn.GELU())

    def forward(self, pictures: Tensor) -> Tensor:
        """Encodes pictures, (B, 3 C, S, S) uint8, as (B, width)."""
        found: Tensor = self.layers(pictures.float() / 127.5 - 1.0)
        return found
