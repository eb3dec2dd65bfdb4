"""The interface of extractors of picture features."""

from typing import Any, Protocol, TypeAlias

import numpy as np
import numpy.typing as npt

from stable_data.errors import ConfigError

Pictures: TypeAlias = npt.NDArray[np.uint8]
"""(N, H, W, 3) uint8, red, green, blue."""

Rows: TypeAlias = npt.NDArray[np.float32]
"""(N, D) float32, one row for each picture."""

BATCH = 2
"""Pictures that a network sees at a time, as many as a scene has. It is fixed, and the last batch is filled up: a row then depends on its
picture alone, because a matrix product of another shape may sum in another order."""


class FeatureExtractor(Protocol):
    """Computes a row of numbers for each picture."""

    @property
    def name(self) -> str:
        """Its name, as :func:`models.picture_features.extractor_named` takes it."""
        ...

    @property
    def fingerprint(self) -> str:
        """16 hex digits of a hash of all that determines the rows; rows of different fingerprints are not comparable."""
        ...

    @property
    def distance_name(self) -> str:
        """What the Fréchet distance of its features is called: FID for Inception's alone."""
        ...

    @property
    def kernel_distance_name(self) -> str:
        """What the kernel distance of its features is called: KID for Inception's alone."""
        ...

    def __call__(self, pictures: Pictures, /) -> Rows:
        """Computes the features of pictures of one size.

        Raises:
            ConfigError: They are no pictures (``pictures_invalid``).
        """
        ...


def check_pictures(pictures: npt.NDArray[Any]) -> None:
    """Refuses what is not (N, H, W, 3) uint8 with at least one pixel.

    Raises:
        ConfigError: See above (``pictures_invalid``).
    """
    if pictures.ndim != 4 or pictures.shape[3] != 3 or 0 in pictures.shape[1:] or pictures.dtype != np.uint8:
        raise ConfigError(
            f"pictures have the shape {pictures.shape} and the type {pictures.dtype}, expected (N, H, W, 3) of uint8",
            "pictures_invalid",
        )
