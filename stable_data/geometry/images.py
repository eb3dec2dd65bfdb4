"""Images of textures: decodes untrusted image files within bounds, and encodes them again for the tables of a run."""

import hashlib
import io
import warnings
from collections.abc import Mapping
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import IO, TYPE_CHECKING, Any, TypeVar

import numpy as np
import numpy.typing as npt

from stable_data.errors import MeshError
from stable_data.limits import LIMITS, at_most

if TYPE_CHECKING:
    from PIL import Image

TEXTURE_SIDE = 1024
"""Largest side of a stored texture, pixels."""

# Formats of textures, as Pillow names them: those of glTF, and two that are usual beside other mesh files. For some of the others
# Pillow may start Ghostscript.
_FORMATS = ("PNG", "JPEG", "WEBP", "BMP", "TGA")
_ALPHA = ("LA", "PA", "RGBA", "La", "RGBa")  # Pillow's modes with transparency
_QUALITY = 90  # of a JPEG
_SMALL = 2**15  # bytes up to which an image is kept exact, whatever a JPEG would save

K = TypeVar("K")


@dataclass(frozen=True, slots=True)
class TextureImage:
    """A row of the table ``textures``: an image that was decoded and encoded again.

    Attributes:
        sha256: SHA-256 of ``image``.
        image: The content of the image file.
        mime: ``image/png`` or ``image/jpeg``.
        width: Pixels.
        height: Pixels.
    """

    sha256: str
    image: bytes
    mime: str
    width: int
    height: int


def encode_texture(content: bytes, name: str, *, side: int = TEXTURE_SIDE, has_alpha: bool = False) -> TextureImage:
    """Decodes the image file of a texture and encodes its pixels; no byte of the file is passed on.

    An image with transparency becomes a PNG. Others become a PNG if that is small or not larger than a JPEG, so that palettes and
    atlases of flat colours stay exact: a JPEG would mix the colours of neighbouring blocks. Else they become a JPEG of quality 90
    whose colours have the full resolution, for labels. Colour profiles and orientations of files are ignored, as glTF demands.

    Args:
        content: The file, PNG, JPEG, WEBP, BMP or TGA; not trusted.
        name: What the image belongs to, in messages.
        side: A larger image is reduced to this, pixels.
        has_alpha: Whether the image's alpha is opacity; else it is dropped.

    Raises:
        MeshError: The image cannot be read (``texture_invalid``), or is too large (``texture_too_large``).
    """
    if len(content) > LIMITS.image.max_bytes:
        found = f"has {len(content)} bytes, expected {at_most(LIMITS.image, 'max_bytes')}"
        raise MeshError(f"{name}: a texture {found}; reduce it", "texture_too_large")
    (picture,) = decode_images({0: content}, name, side=side, has_alpha=has_alpha).values()
    if picture.mode == "RGBA" and picture.getchannel("A").getextrema() == (255, 255):
        picture = picture.convert("RGB")
    picture = _without_metadata(picture)
    encoded, mime = _encoded(picture, "PNG", compress_level=4), "image/png"
    if picture.mode == "RGB" and len(encoded) > _SMALL:
        smaller = _encoded(picture, "JPEG", quality=_QUALITY, subsampling=0)
        if len(smaller) < len(encoded):
            encoded, mime = smaller, "image/jpeg"
    return TextureImage(hashlib.sha256(encoded).hexdigest(), encoded, mime, *picture.size)


@lru_cache(maxsize=16)
def texture_pixels(content: bytes, *, has_alpha: bool = False) -> npt.NDArray[np.uint8]:
    """Decodes an image of the table ``textures``, (H, W, 3) uint8, display colours, or (H, W, 4) with alpha; cached for recent ones.

    Raises:
        MeshError: As :func:`encode_texture`.
    """
    images = decode_images({0: content}, "table textures", side=TEXTURE_SIDE, has_alpha=has_alpha)
    pixels = np.asarray(images[0])
    pixels.setflags(write=False)  # shared by all who ask for it
    return pixels


def decode_images(images: Mapping[K, bytes], name: str, *, side: int, has_alpha: bool = False) -> dict[K, "Image.Image"]:
    """Decodes image files within bounds.

    Args:
        images: The files, PNG, JPEG, WEBP, BMP or TGA, by any key; not trusted. The pixels of all of them together are limited.
        name: What they belong to, in messages.
        side: Larger images are reduced to this, pixels.
        has_alpha: Whether transparency is kept.

    Returns:
        Images of mode ``RGB``, or ``RGBA`` where transparency is kept and the file has some, by the keys of ``images``.

    Raises:
        MeshError: As :func:`encode_texture`.
    """
    from PIL import Image, UnidentifiedImageError  # imported here: few files have textures, and Pillow may not be installed

    decoded: dict[K, Image.Image] = {}
    num_pixels = 0
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            for key, content in images.items():
                # Each scan of a progressive JPEG decodes the whole picture again. The marker cannot occur in coded data.
                if content.startswith(b"\xff\xd8") and content.count(b"\xff\xda") > LIMITS.image.max_scans:
                    raise ValueError(f"a JPEG with more scans, expected {at_most(LIMITS.image, 'max_scans')}")
                with open_image(io.BytesIO(content), _FORMATS) as picture:
                    num_pixels += picture.width * picture.height
                    if num_pixels > LIMITS.image.max_pixels:
                        raise Image.DecompressionBombError(f"{num_pixels} pixels in all textures")
                    decoded[key] = _reduced(picture, side, has_alpha=has_alpha)
    except Image.DecompressionBombError as error:
        found = f"a texture is too large ({type(error).__name__}: {error!s:.200})"
        most = at_most(LIMITS.image, "max_pixels", "pixels")
        raise MeshError(f"{name}: {found}, expected {most}; reduce it", "texture_too_large") from error
    except MemoryError:
        raise
    except Exception as error:  # each decoder of Pillow raises its own exceptions
        found = "another format" if isinstance(error, UnidentifiedImageError) else f"{type(error).__name__}: {error}"
        expected = f"{', '.join(_FORMATS[:-1])} or {_FORMATS[-1]}"
        message = f"{name}: a texture cannot be read ({found:.200}), expected {expected}; export it again"
        raise MeshError(message, "texture_invalid") from error
    return decoded


def decode_png(content: bytes) -> npt.NDArray[np.uint8]:
    """Decodes a PNG file of a run, (H, W, 3) uint8; not trusted.

    Raises:
        ValueError: It is no PNG, is damaged or is too large; the message, without the name of the file, says which.
    """
    from PIL import Image, UnidentifiedImageError  # imported here, as above

    if len(content) > LIMITS.image.max_bytes:
        raise ValueError(f"has {len(content)} bytes, expected {at_most(LIMITS.image, 'max_bytes')}")
    try:
        with open_image(io.BytesIO(content), ("PNG",)) as picture:
            return np.asarray(picture.convert("RGB"))
    except Image.DecompressionBombError as error:
        raise ValueError(f"is too large ({error!s:.200}), expected {at_most(LIMITS.image, 'max_pixels', 'pixels')}") from error
    except MemoryError:
        raise
    except Exception as error:  # each decoder of Pillow raises its own exceptions
        found = "another format" if isinstance(error, UnidentifiedImageError) else f"{type(error).__name__}: {error}"
        raise ValueError(f"cannot be decoded ({found:.200}), expected a PNG file") from error


def open_image(file: Path | IO[bytes], formats: tuple[str, ...]) -> "Image.Image":
    """Opens an image file; only its header is read.

    Args:
        file: The file.
        formats: The formats that are allowed, as Pillow names them.

    Raises:
        PIL.Image.DecompressionBombError: It has more pixels than the limit, which takes the place of Pillow's own.
    """
    from PIL import Image

    others = Image.MAX_IMAGE_PIXELS  # of whoever uses Pillow in this process
    Image.MAX_IMAGE_PIXELS = LIMITS.image.max_pixels
    with warnings.catch_warnings():
        warnings.simplefilter("error", Image.DecompressionBombWarning)  # up to twice as many are only a warning
        try:
            return Image.open(file, formats=formats)
        except Image.DecompressionBombWarning as error:
            raise Image.DecompressionBombError(str(error)) from error
        finally:
            Image.MAX_IMAGE_PIXELS = others


def _reduced(picture: "Image.Image", side: int, *, has_alpha: bool) -> "Image.Image":
    """A picture of mode RGB or RGBA whose sides are at most ``side``."""
    is_clear = has_alpha and (picture.mode in _ALPHA or "transparency" in picture.info)
    mode = "RGBA" if is_clear else "RGB"
    if picture.mode.startswith("I"):  # grey of 16 bits, which Pillow would clip to 255
        from PIL import Image

        grey = np.clip(np.asarray(picture, np.int64), 0, 65535) // 257
        picture = Image.fromarray(grey.astype(np.uint8))
    elif picture.mode in ("P", *_ALPHA) or is_clear:
        # Indices of a palette must not be mixed; and where alpha does not count, colours must not be weighed by it.
        picture = picture.convert(mode)
    picture.thumbnail((side, side))
    return picture.convert(mode)


def _without_metadata(picture: "Image.Image") -> "Image.Image":
    from PIL import Image

    return Image.frombytes(picture.mode, picture.size, picture.tobytes())


def _encoded(picture: "Image.Image", file_format: str, **options: Any) -> bytes:
    stream = io.BytesIO()
    picture.save(stream, file_format, **options)
    return stream.getvalue()
