"""Images of textures: of hostile files only mesh errors come, and what is stored has the pixels of the file alone."""

import hashlib
import io
import zlib
from random import Random

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from PIL import Image

from stable_data.errors import MeshError
from stable_data.geometry.images import decode_png, encode_texture, texture_pixels
from tests.bounds import limit

pytestmark = pytest.mark.sim
RNG = np.random.default_rng(0)


def encoded(image: Image.Image, file_format: str, **options: object) -> bytes:
    stream = io.BytesIO()
    image.save(stream, file_format, **options)
    return stream.getvalue()


def stored_pixels(image: Image.Image, file_format: str, **options: object) -> np.ndarray:
    texture = encode_texture(encoded(image, file_format), "thing", **options)  # type: ignore[arg-type]
    assert texture.sha256 == hashlib.sha256(texture.image).hexdigest()
    pixels = texture_pixels(texture.image, has_alpha=bool(options.get("has_alpha")))
    assert pixels.shape[:2] == (texture.height, texture.width)
    return pixels


def photo(side: int = 256) -> Image.Image:
    """Smooth hills with some noise, as a photo has."""
    x, y = np.meshgrid(*2 * [np.linspace(0, 6, side)])
    hills = np.stack([np.sin(x + k) * np.cos(y * (k + 1)) for k in range(3)], axis=2)
    return Image.fromarray(np.uint8(np.clip(128 + 90 * hills + RNG.normal(0, 6, hills.shape), 0, 255)))


def flat(side: int = 128) -> Image.Image:
    """An atlas of flat colours."""
    return Image.fromarray(np.repeat(np.repeat(RNG.integers(0, 256, (8, 8, 3)).astype(np.uint8), side // 8, 0), side // 8, 1))


@pytest.mark.parametrize("file_format", ["PNG", "BMP", "TGA", "WEBP", "JPEG"])
def test_all_formats_of_mesh_files_are_read(file_format: str) -> None:
    assert stored_pixels(Image.new("RGB", (16, 8), "#c08040"), file_format)[3, 3] == pytest.approx([192, 128, 64], abs=2)


def test_flat_colours_stay_exact_and_photos_become_small() -> None:
    atlas, picture = flat(1024), photo()
    assert (stored_pixels(atlas, "PNG") == np.asarray(atlas)).all()
    palette = Image.fromarray(RNG.integers(0, 256, (1, 256, 3)).astype(np.uint8))
    assert (stored_pixels(palette, "PNG") == np.asarray(palette)).all()
    assert encode_texture(encoded(atlas, "PNG"), "a").mime == "image/png"
    texture = encode_texture(encoded(picture, "PNG"), "a")
    assert texture.mime == "image/jpeg"
    assert len(texture.image) < 0.5 * len(encoded(picture, "PNG"))
    assert np.abs(texture_pixels(texture.image).astype(int) - np.asarray(picture)).mean() < 5


@pytest.mark.parametrize("mode", ["1", "L", "P", "CMYK", "LA", "RGBA", "I;16"])
def test_all_kinds_of_pixels_become_colours(mode: str) -> None:
    picture = photo(64)
    if mode == "I;16":
        grey = np.asarray(picture.convert("L"))
        source, wanted = Image.fromarray(grey.astype(np.uint16) * 257), np.repeat(grey[..., None], 3, 2)
    else:
        source = picture.convert(mode)
        wanted = np.asarray(source.convert("RGB"))
    found = stored_pixels(source, "JPEG" if mode == "CMYK" else "PNG")
    assert found.shape == (64, 64, 3)
    assert np.abs(found.astype(int) - wanted).mean() < 5


def test_a_large_image_is_reduced_and_its_palette_filtered() -> None:
    wide = photo(512).resize((1024, 256))
    assert stored_pixels(wide, "PNG", side=128).shape == (32, 128, 3)
    checks = np.indices((512, 512)).sum(axis=0) % 2 * 200  # black and grey pixels, which are a darker grey from afar
    assert stored_pixels(Image.fromarray(checks.astype(np.uint8)).convert("P"), "PNG", side=64)[20:40, 20:40].mean() == (
        pytest.approx(100, abs=3)
    )


def test_alpha_is_kept_where_it_counts_and_is_real() -> None:
    rgba = np.dstack([np.asarray(photo()), np.full((256, 256), 255, np.uint8)])
    opaque = Image.fromarray(rgba)
    assert stored_pixels(opaque, "PNG", has_alpha=True).shape[2] == 3
    rgba[:100, :, 3] = 0
    clear = encoded(Image.fromarray(rgba), "PNG")
    texture = encode_texture(clear, "a", has_alpha=True)
    assert texture.mime == "image/png"
    assert (texture_pixels(texture.image, has_alpha=True) == rgba).all()
    # Where alpha does not count, the colours under it do.
    kept = texture_pixels(encode_texture(clear, "a", side=128).image)
    assert np.abs(kept.astype(int) - np.asarray(photo().resize((128, 128)))).mean() < 8
    palette = flat(64).convert("P")
    palette.info["transparency"] = 0
    assert stored_pixels(palette, "PNG", has_alpha=True).shape[2] == 4


def test_the_same_pixels_give_the_same_bytes_and_no_word_of_the_file_is_kept() -> None:
    picture = photo(64)
    plain = encode_texture(encoded(picture, "PNG"), "a")
    exif = Image.Exif()
    exif[0x010E], exif[0x0112] = "a secret sentence", 6  # a description; and a turn, which glTF ignores
    odd = encoded(picture, "PNG", exif=exif, icc_profile=b"secret " * 300, dpi=(72, 72))
    assert b"secret" in odd
    assert encode_texture(odd, "a") == plain == encode_texture(encoded(picture, "BMP"), "b")
    assert encode_texture(plain.image, "a") == plain


@pytest.mark.parametrize("content", [b"", b"no picture", b"\x89PNG\r\n\x1a\n" + b"\0" * 60, b"\0\0\2" + b"\0" * 60])
def test_what_is_no_image_is_refused(content: bytes) -> None:
    with pytest.raises(MeshError, match=r"asset a: a texture cannot be read .*expected PNG, JPEG, WEBP, BMP or TGA") as caught:
        encode_texture(content, "asset a")
    assert caught.value.code == "texture_invalid"


@pytest.mark.parametrize("file_format", ["PNG", "JPEG", "WEBP", "BMP", "TGA"])
def test_a_truncated_file_is_refused(file_format: str) -> None:
    content = encoded(photo(64), file_format)
    with pytest.raises(MeshError) as caught:
        encode_texture(content[: len(content) // 2], "a")
    assert caught.value.code == "texture_invalid"


@pytest.mark.parametrize("file_format", ["EPS", "GIF", "TIFF", "PPM", "ICO", "PDF"])
def test_other_formats_are_not_opened(file_format: str) -> None:
    with pytest.raises(MeshError, match="another format"):
        encode_texture(encoded(Image.new("RGB", (16, 16)), file_format), "a")


def test_an_image_of_too_many_bytes_or_pixels_is_not_decoded() -> None:
    with pytest.raises(MeshError, match="67108865 bytes") as caught:
        encode_texture(b"\0" * (2**26 + 1), "a")
    assert caught.value.code == "texture_too_large"
    bomb = bytearray(encoded(Image.new("L", (8, 8)), "PNG"))
    bomb[16:24] = (50_000).to_bytes(4, "big") * 2
    bomb[29:33] = zlib.crc32(bomb[12:29]).to_bytes(4, "big")
    with pytest.raises(MeshError, match="DecompressionBomb") as caught:
        encode_texture(bytes(bomb), "a")
    assert caught.value.code == "texture_too_large"
    assert "at most 134,217,728 pixels (image.max_pixels in STABLE_DATA_LIMITS)" in str(caught.value)


@pytest.mark.parametrize(("most", "code"), [(99, "texture_too_large"), (90_000_000, ""), (None, "")])
def test_the_limit_of_pixels_is_ours_and_may_be_raised(most: int | None, code: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """Pillow alone would refuse more than 89,478,485."""
    large = encoded(Image.new("1", (10_000, 9_000)) if code == "" else Image.new("1", (10, 10)), "PNG")
    if most is not None:
        limit(monkeypatch, "image", max_pixels=most)
    if code:
        with pytest.raises(MeshError) as caught:
            encode_texture(large, "a")
        assert caught.value.code == code
    else:
        assert encode_texture(large, "a").width == 1024


@settings(max_examples=150, deadline=None)
@given(st.sampled_from(["PNG", "JPEG", "WEBP", "BMP", "TGA"]), st.booleans(), st.randoms(use_true_random=False))
def test_of_a_damaged_image_only_textures_and_mesh_errors_come(file_format: str, has_alpha: bool, random: Random) -> None:
    picture = Image.linear_gradient("L").resize((16, 16)).convert("P" if file_format == "PNG" else "RGB")
    content = bytearray(encoded(picture, file_format))
    for _ in range(random.choice((1, 3, 30))):
        content[random.randrange(len(content))] = random.choice((0, 255, random.randrange(256)))
    try:
        texture = encode_texture(bytes(content[: len(content) - random.choice((0, 0, 9))]), "a", side=32, has_alpha=has_alpha)
    except MeshError as error:
        assert error.code in ("texture_invalid", "texture_too_large")  # noqa: PT017 - not every damage is an error
    else:
        assert max(texture.width, texture.height) <= 32


def test_a_picture_of_a_run_is_a_png_or_nothing() -> None:
    picture = photo(64)
    assert (decode_png(encoded(picture, "PNG")) == np.asarray(picture)).all()
    assert decode_png(encoded(picture.convert("LA"), "PNG")).shape == (64, 64, 3)
    for content in (encoded(picture, "JPEG"), encoded(picture, "TIFF"), b"", b"%!PS-Adobe-3.0 EPSF-3.0\n"):
        with pytest.raises(ValueError, match=r"cannot be decoded \(another format\), expected a PNG file"):
            decode_png(content)
    with pytest.raises(ValueError, match=r"cannot be decoded \(.*expected a PNG file"):
        decode_png(encoded(picture, "PNG")[:-30])


def test_a_picture_of_a_run_is_limited(monkeypatch: pytest.MonkeyPatch) -> None:
    content = encoded(photo(64), "PNG")
    for name, most in (("max_pixels", 64 * 63), ("max_bytes", len(content) - 1)):
        with monkeypatch.context() as patch:
            limit(patch, "image", **{name: most})
            with pytest.raises(ValueError, match=rf"image\.{name}"):
                decode_png(content)
