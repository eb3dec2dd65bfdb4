"""Materials of tables and rooms in pictures: small repeating images, made in code, always the same."""

import io
from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from PIL import Image

from stable_data.scene import FloatArray

_LEVELS = 32  # colours of an image: few, so that its file is small
_WOOD_SIZE = _STONE_SIZE = 256  # pixels
_WOOD_TILE, _STONE_TILE = (1.2, 0.5), (0.6, 0.6)  # metres
_GROUT = 3  # width of a joint between tiles, pixels


@dataclass(frozen=True, slots=True)
class Material:
    """What a piece of furniture or of a room is made of.

    Attributes:
        name: Its name, letters and ``_``.
        colour: Its mean colour, ``#rrggbb``; the whole colour without an image.
        image: Content of a PNG file that repeats in both directions; None without one. Wood grain runs along its width.
        tile: Width and height of the image, metres.
        gloss: From 0 (matt) to 1.
        glow: How much brighter than lit it is drawn: light that walls and floor get from each other.
    """

    name: str
    colour: str
    image: bytes | None = None
    tile: tuple[float, float] = (1.0, 1.0)
    gloss: float = 0.1
    glow: float = 0.0


@lru_cache(maxsize=64)
def wood(name: str, dark: str, light: str, gloss: float = 0.15) -> Material:
    """Returns wood with its grain between two colours, ``#rrggbb``; the name seeds the grain."""
    rng, shape = _generator(name), (_WOOD_SIZE, _WOOD_SIZE)
    height = np.arange(shape[0])[:, None] / shape[0]
    bent = _noise(rng, shape, (0.3, 0.12))
    rings = np.sin(2 * np.pi * (7 * height + 0.55 * bent)) * (0.6 + 0.4 * _noise(rng, shape, (0.4, 0.2)))
    fibres, pores = _noise(rng, shape, (0.12, 0.006)), _noise(rng, shape, (0.03, 0.004))
    value = 0.3 * rings + 0.42 * fibres - 0.3 * np.maximum(pores - 1.2, 0) + 0.4 * _noise(rng, shape, (0.5, 0.15))
    return _material(name, value, dark, light, _WOOD_TILE, gloss)


@lru_cache(maxsize=64)
def planks(name: str, dark: str, light: str) -> Material:
    """Returns floor boards of a wood: five rows with their ends at different places."""
    rng, size, rows = _generator(name), 320, 5
    shape = (size, size)
    fibres = _noise(rng, shape, (0.1, 0.006)) * 0.25
    row = np.arange(size)[:, None] * rows // size
    start = rng.integers(0, size, rows)[row]
    second = (np.arange(size)[None, :] - start) % size < size // 2
    shade = rng.uniform(-1.2, 1.2, (rows, 2))[row, second.astype(int)]
    column = (np.arange(size)[None, :] - start) % (size // 2)
    seam = (np.arange(size)[:, None] % (size // rows) == 0) | (column == 0)
    return _material(name, fibres + shade - 2.0 * seam, dark, light, (1.8, 0.7), 0.1, 0.1)


@lru_cache(maxsize=64)
def stone(name: str, dark: str, light: str, gloss: float = 0.3) -> Material:
    """Returns speckled stone between two colours, ``#rrggbb``."""
    rng, shape = _generator(name), (_STONE_SIZE, _STONE_SIZE)
    clouds, grains, specks = (_noise(rng, shape, (length, length)) for length in (0.08, 0.008, 0.003))
    value = 0.25 * clouds + 0.45 * grains + 0.6 * np.where(abs(specks) > 1.4, specks, 0.0)
    return _material(name, value, dark, light, _STONE_TILE, gloss)


@lru_cache(maxsize=64)
def cloth(name: str, dark: str, light: str) -> Material:
    """Returns a carpet or another mottled, matt surface between two colours, ``#rrggbb``."""
    rng, shape = _generator(name), (128, 128)
    value = 0.5 * _noise(rng, shape, (0.008, 0.008)) + 0.3 * _noise(rng, shape, (0.1, 0.1))
    return _material(name, value, dark, light, (0.8, 0.8), 0.0, 0.1)


@lru_cache(maxsize=64)
def tiles(name: str, joint: str, light: str, side: tuple[float, float], glow: float) -> Material:
    """Returns tiles of a width and height, metres, of a colour with joints of another one; every second row is shifted."""
    width, height = 128, max(16, round(128 * side[1] / side[0]))
    rng = _generator(name)
    value = np.full((2 * height, 2 * width), 1.0)
    for row in range(2):
        for column in range(2):
            tile = np.full((height, width), rng.uniform(0.72, 1.0))
            tile[:_GROUT] = tile[:, :_GROUT] = -1.0
            value[row * height : (row + 1) * height, column * width : (column + 1) * width] = tile
    value[height:] = np.roll(value[height:], width // 2, axis=1)
    return _material(name, 2 * value, joint, light, (2 * side[0], 2 * side[1]), 0.2, glow)


@lru_cache(maxsize=64)
def basin(aspect: float, *, has_drain: bool) -> Material:
    """Returns the picture of a basin for a rectangle, once from edge to edge: a rim, a lighter ground, a drain.

    Args:
        aspect: Width divided by depth of the rectangle.
        has_drain: Without a drain it is a pale area with a rim.
    """
    long = 192
    width, height = (long, max(24, round(long / aspect))) if aspect > 1 else (max(24, round(long * aspect)), long)
    x, y = (np.arange(width) + 0.5)[None, :], (np.arange(height) + 0.5)[:, None]
    radius = 0.16 * min(width, height)

    def inside(margin: float) -> FloatArray:
        """Signed distance from a rounded rectangle, pixels, positive inside."""
        round_by = max(radius - margin, 1.0)
        dx, dy = (np.maximum(abs(v - n / 2) - (n / 2 - margin - round_by), 0.0) for v, n in ((x, width), (y, height)))
        return np.asarray(round_by - np.hypot(dx, dy))

    unit = min(width, height) / 24
    shades = np.where(inside(0.0) > 0, 0.74, 0.60)
    ground = inside(1.2 * unit)
    # Light comes from the near left: the wall of the basin is darker there.
    slope = 1 - np.clip(ground / (4 * unit), 0.0, 1.0)
    lean = np.clip(0.55 - 0.35 * ((x / width) - 0.5) + 0.35 * ((y / height) - 0.5), 0.0, 1.0)
    shades = np.where(ground > 0, 0.97 - (0.16 * slope * lean if has_drain else 0.0), shades)
    if has_drain:
        away = np.hypot(x - width / 2, y - 0.5 * height)
        shades = np.where(away < 1.5 * unit, 0.62, shades)
        shades = np.where(away < 0.9 * unit, 0.36, shades)
    grey = np.clip(255 * shades, 0, 255).round().astype(np.uint8)
    image = Image.fromarray(grey)
    mean = f"{round(float(grey.mean())):02x}" * 3
    return Material(f"basin_{width}_{height}_{int(has_drain)}", f"#{mean}", _png(image), (0.0, 0.0), 0.2)


def _generator(name: str) -> np.random.Generator:
    return np.random.default_rng(list(name.encode()))


def _noise(rng: np.random.Generator, shape: tuple[int, int], length: tuple[float, float]) -> FloatArray:
    """Noise of mean 0 and deviation 1 that repeats, (H, W), smooth over a share of the width and of the height."""
    along, across = np.fft.rfftfreq(shape[1], 1 / shape[1]), np.fft.fftfreq(shape[0], 1 / shape[0])[:, None]
    keep = np.exp(-2 * (np.pi * length[0] * along) ** 2 - 2 * (np.pi * length[1] * across) ** 2)
    smooth = np.fft.irfft2(np.fft.rfft2(rng.normal(size=shape)) * keep, s=shape)
    smooth -= smooth.mean()
    return np.asarray(smooth / smooth.std())


def _material(
    name: str, value: FloatArray, dark: str, light: str, tile: tuple[float, float], gloss: float, glow: float = 0.0
) -> Material:
    """The material with values from about -2 (dark) to 2 (light) as an image of few colours."""
    share = np.clip(0.5 + value / 4, 0.0, 1.0)
    level = np.minimum((share * _LEVELS).astype(np.uint8), _LEVELS - 1)
    ends = np.array([[int(colour[k : k + 2], 16) for k in (1, 3, 5)] for colour in (dark, light)], np.float64)
    ramp = (ends[0] + np.linspace(0, 1, _LEVELS)[:, None] * (ends[1] - ends[0])).round().astype(np.uint8)
    image = Image.fromarray(level)
    image.putpalette(ramp.ravel().tolist())
    mean = ramp[level].reshape(-1, 3).mean(axis=0).round().astype(int).tolist()
    return Material(name, "#" + "".join(f"{channel:02x}" for channel in mean), _png(image), tile, gloss, glow)


def _png(image: Image.Image) -> bytes:
    stream = io.BytesIO()
    image.save(stream, "png", optimize=False, compress_level=9)
    return stream.getvalue()
