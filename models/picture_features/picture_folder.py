"""Pictures of a folder, in batches of one size."""

from collections.abc import Iterator
from pathlib import Path

import numpy as np
from PIL import Image, UnidentifiedImageError

from models.picture_features.extractor import Pictures
from stable_data.errors import ConfigError
from stable_data.geometry.images import open_image
from stable_data.limits import LIMITS, at_most

SUFFIXES = (".jpeg", ".jpg", ".png", ".webp")
"""Endings of the files that are read."""

_FORMATS = ("JPEG", "PNG", "WEBP")  # as Pillow names them; for some of the others it may start Ghostscript


def picture_files(folder: Path, name: str = "") -> list[Path]:
    """Returns the pictures in a folder and its subfolders, in the order of their paths.

    Args:
        folder: The folder.
        name: Only files of this name, such as ``front.png``; empty: all pictures.

    Raises:
        ConfigError: There is no such folder, or no such picture in it (``pictures_missing``).
    """
    found = [p for p in sorted(folder.rglob(name or "*")) if p.suffix.lower() in SUFFIXES and p.is_file()]
    if not found:
        what = name or f"picture ({', '.join(SUFFIXES)})"
        raise ConfigError(f"{folder}: has no {what}, expected a folder with pictures", "pictures_missing")
    return found


def read_pictures(files: list[Path], batch: int = 32) -> Iterator[Pictures]:
    """Yields pictures of one size at a time, (N, H, W, 3), N at most ``batch``; what is transparent is black.

    Raises:
        ConfigError: A file is no picture, or is too large (``pictures_invalid``).
    """
    kept: list[Pictures] = []
    for path in files:
        picture = read_picture(path)
        if kept and (len(kept) == batch or kept[0].shape != picture.shape):
            yield np.stack(kept)
            kept = []
        kept.append(picture)
    if kept:
        yield np.stack(kept)


def read_picture(path: Path) -> Pictures:
    """Reads a picture, (H, W, 3) uint8; what is transparent is black.

    Raises:
        ConfigError: It is no picture, or is too large (``pictures_invalid``).
    """
    try:
        with open_image(path, _FORMATS) as image:
            clear = image.convert("RGBA")
    except Image.DecompressionBombError as error:
        most = at_most(LIMITS.image, "max_pixels", "pixels")
        raise ConfigError(f"{path}: is too large ({error}), expected {most}", "pictures_invalid") from error
    except (UnidentifiedImageError, OSError, ValueError, SyntaxError) as error:
        raise ConfigError(f"{path}: cannot be read ({error}), expected a picture", "pictures_invalid") from error
    return np.asarray(Image.alpha_composite(Image.new("RGBA", clear.size, "black"), clear).convert("RGB"))
