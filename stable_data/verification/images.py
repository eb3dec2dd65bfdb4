"""Whether an image file is whole, without a library that decodes it: its format, its size, and the checksums that a PNG carries."""

import struct
import zlib
from collections.abc import Iterator

_PNG, _JPEG = b"\x89PNG\r\n\x1a\n", b"\xff\xd8"
_FRAMES = frozenset({*range(0xC0, 0xD0)} - {0xC4, 0xC8, 0xCC})  # markers of a JPEG that state its size


def image_fault(content: bytes, mime: str, size: tuple[int, int] | None) -> str:
    """Returns why an image is not what is said of it; empty if it is.

    Args:
        content: The file.
        mime: ``image/png`` or ``image/jpeg``.
        size: Width and height, pixels; None if they are not stated.
    """
    kind = "image/png" if content.startswith(_PNG) else "image/jpeg" if content.startswith(_JPEG) else "unknown"
    if kind != mime:
        return f"is {kind}, expected {mime}"
    try:
        found = _png_size(content) if kind == "image/png" else _jpeg_size(content)
    except (ValueError, struct.error, zlib.error) as error:
        return f"is no whole {kind} file ({error})"
    if size is not None and found != size:
        return f"has {found[0]} x {found[1]} pixels, expected {size[0]} x {size[1]}"
    return ""


def _png_chunks(content: bytes) -> Iterator[tuple[bytes, bytes]]:
    place = len(_PNG)
    while place < len(content):
        length, kind = struct.unpack_from(">I4s", content, place)
        data = content[place + 8 : place + 8 + length]
        (stated,) = struct.unpack_from(">I", content, place + 8 + length)
        if zlib.crc32(data, zlib.crc32(kind)) != stated:
            raise ValueError(f"the checksum of its part {kind!r} is wrong")
        yield kind, data
        place += 12 + length


def _png_size(content: bytes) -> tuple[int, int]:
    chunks = list(_png_chunks(content))
    if not chunks or chunks[0][0] != b"IHDR" or chunks[-1][0] != b"IEND":
        raise ValueError("it has no head or no end")
    width, height = struct.unpack_from(">II", chunks[0][1])
    return int(width), int(height)


def _jpeg_size(content: bytes) -> tuple[int, int]:
    if not content.endswith(b"\xff\xd9"):
        raise ValueError("it has no end")
    place = 2
    while place < len(content):
        mark, kind, length = struct.unpack_from(">BBH", content, place)
        if mark != 0xFF:
            raise ValueError("a part does not begin where the last one ends")
        if kind in _FRAMES:
            height, width = struct.unpack_from(">HH", content, place + 5)
            return int(width), int(height)
        place += 2 + length
    raise ValueError("it states no size")
