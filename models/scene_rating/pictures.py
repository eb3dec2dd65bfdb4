"""The pictures of a question: each with its name and a number below it, which a model that sees it can read."""

import io

import numpy as np
from PIL import Image, ImageDraw, ImageFont

from stable_data.random_seeds import named_seed
from stable_data.simulation.offscreen import Picture

_LOWEST, _HIGHEST = 100, 999  # numbers of three digits


def picture_number(scene_id: str, name: str) -> int:
    """Returns the number that stands below a picture of a scene; always the same one."""
    return _LOWEST + named_seed("picture number", scene_id, name) % (_HIGHEST - _LOWEST + 1)


def captioned(picture: Picture, name: str, number: int) -> Picture:
    """Adds a white strip below a picture, with its name and a number.

    Args:
        picture: (H, W, 3) uint8.
        name: Its name.
        number: The number.

    Returns:
        (H + S, W, 3) uint8; the picture itself is not changed.
    """
    height, width, _ = picture.shape
    strip = max(24, height // 12)
    sheet = Image.new("RGB", (width, height + strip), "white")
    sheet.paste(Image.fromarray(picture), (0, 0))
    font = ImageFont.load_default(size=0.7 * strip)
    ImageDraw.Draw(sheet).text((width / 2, height + strip / 2), f"{name} {number}", fill="black", font=font, anchor="mm")
    return np.asarray(sheet)


def png(picture: Picture) -> bytes:
    """Returns a picture (H, W, 3) uint8 as a PNG file."""
    stream = io.BytesIO()
    Image.fromarray(picture).save(stream, "PNG")
    return stream.getvalue()
