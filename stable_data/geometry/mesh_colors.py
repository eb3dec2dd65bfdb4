"""The colours of a mesh, from the materials, textures and vertex colours of its GLB: few of them, each with its faces.

Instructions name colours ("the yellow block"), so what a camera sees must have them.
"""

import io
import warnings
from pathlib import Path
from typing import TypeAlias

import numpy as np
import numpy.typing as npt
from scipy.spatial import cKDTree

from stable_data.errors import MeshError
from stable_data.geometry.gltf_reader import MaterialGroup, load_material_groups
from stable_data.geometry.mesh import Mesh, double_areas
from stable_data.scene import FloatArray, IntArray

Paint: TypeAlias = tuple[tuple[str, IntArray], ...]
"""Colours as seen on a screen, with the faces that they are on, each face once: (``#rrggbb``, indices)."""

MOST_COLOURS = 8
"""Of a mesh: more than an instruction names, and few enough pieces to draw."""

_FORMATS = ("PNG", "JPEG", "WEBP")  # of textures in glTF; Pillow starts Ghostscript for others
_PIXELS = 512  # to which a texture is brought down along each side
_MOST_PIXELS = 2**27  # of all textures of a file as they come
_FEW = 20_000  # faces up to which many points of each are looked up
_STEP = 16  # of 256: colours of a mesh with many that fall into one such cell are one


@np.errstate(over="ignore", invalid="ignore")  # what is not finite is checked for
def load_paint(data: bytes | Path, asset_id: str, mesh: Mesh) -> Paint:
    """The colours of the faces of a mesh.

    Args:
        data: Its file, or the content; not trusted.
        asset_id: Named in messages.
        mesh: As :func:`stable_data.geometry.gltf_reader.load_glb` gave it, repaired or not: a face takes the colour of the
            file's nearest one.

    Returns:
        The colours, that of the largest surface first; none where the file says nothing of them.

    Raises:
        MeshError: What it says cannot be read; ``code`` is ``texture_invalid`` or one of
            :func:`stable_data.geometry.gltf_reader.load_glb`.
    """
    coats = load_material_groups(data, asset_id)
    if all(coat.factor is None and coat.corner_colours is None for coat in coats):
        return ()
    images = {id(coat.image): coat.image for coat in coats if coat.image is not None and coat.corner_uv is not None}
    textures = _textures(images, asset_id) if images else {}
    colours = np.concatenate([_colours(coat, textures.get(id(coat.image))) for coat in coats])
    triangles = np.concatenate([coat.triangles for coat in coats])
    low, high = triangles.min(axis=(0, 1)), triangles.max(axis=(0, 1))
    middles = triangles.mean(axis=1) - (low + high) / 2
    if not np.isfinite(np.square(4 * middles)).all():  # nor would the squares of distances be
        raise MeshError(
            f"asset {asset_id}: a vertex is not finite or too far from the origin, expected a mesh of usual size",
            "glb_nan_vertices",
        )
    nearest: IntArray = np.asarray(cKDTree(middles).query(mesh.triangles.mean(axis=1))[1])
    return _grouped(colours[nearest], double_areas(mesh))


def to_linear(on_screen: FloatArray) -> FloatArray:
    """Colours as light, which glTF has, from colours as seen on a screen (sRGB, IEC 61966-2-1), both 0 to 1, any shape."""
    return np.asarray(np.where(on_screen <= 0.04045, on_screen / 12.92, ((on_screen + 0.055) / 1.055) ** 2.4))


_LINEAR = to_linear(np.arange(256) / 255)


def _colours(coat: MaterialGroup, texture: npt.NDArray[np.uint8] | None) -> npt.NDArray[np.uint8]:
    """Colour of each face, (F, 3), as seen on a screen."""
    linear = np.tile(np.array(coat.factor or (1.0, 1.0, 1.0)), (len(coat.triangles), 1))
    if coat.corner_colours is not None:
        linear *= coat.corner_colours.mean(axis=1)
    if texture is not None and coat.corner_uv is not None:
        linear *= _looked_up(texture, coat.corner_uv)
    clipped = np.clip(np.nan_to_num(linear), 0.0, 1.0)
    on_screen = np.where(clipped <= 0.0031308, 12.92 * clipped, 1.055 * clipped ** (1 / 2.4) - 0.055)  # undoes `to_linear`
    return np.asarray(np.rint(255 * on_screen), np.uint8)


def _textures(images: dict[int, bytes], asset_id: str) -> dict[int, npt.NDArray[np.uint8]]:
    """Pictures of a file, not too large, (H, W, 3), as seen on a screen; by the keys of their contents."""
    from PIL import Image, UnidentifiedImageError  # only few files have textures, and not every installation has it

    textures, num_pixels = {}, 0
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            warnings.simplefilter("error", Image.DecompressionBombWarning)
            for key, image in images.items():
                with Image.open(io.BytesIO(image), formats=_FORMATS) as picture:  # reads the head alone
                    num_pixels += picture.width * picture.height
                    if num_pixels > _MOST_PIXELS:
                        raise ValueError(f"{num_pixels} pixels in all textures, of at most {_MOST_PIXELS}")
                    picture.thumbnail((_PIXELS, _PIXELS))
                    textures[key] = np.asarray(picture.convert("RGB"))
    except Exception as error:  # each of Pillow's decoders raises others
        found = "another format" if isinstance(error, UnidentifiedImageError) else f"{type(error).__name__}: {error}"
        message = f"asset {asset_id}: a texture cannot be read ({found:.200}), expected PNG, JPEG or WEBP; export it again"
        raise MeshError(message, "texture_invalid") from error
    return textures


def _looked_up(texture: npt.NDArray[np.uint8], corner_uv: FloatArray) -> FloatArray:
    """Mean colour of a texture over each face, (F, 3), linear."""
    height, width, _ = texture.shape
    uv = np.einsum("kc,fcd->fkd", _SPREAD if len(corner_uv) <= _FEW else _SPREAD.mean(axis=0, keepdims=True), corner_uv)
    uv = np.nan_to_num(uv) % 1.0
    column, row = (uv[..., 0] * width).astype(int) % width, (uv[..., 1] * height).astype(int) % height
    return np.asarray(_LINEAR[texture[row, column]].mean(axis=1))


def _spread(steps: int) -> FloatArray:
    """Points all over a triangle, (K, 3), as shares of its corners: the middles of the smaller ones that it is cut into."""
    thirds = [(3 * i + d, 3 * j + d) for d in (1, 2) for i in range(steps) for j in range(steps - i - (d == 2))]
    a, b = np.array(thirds).T / (3 * steps)
    return np.stack([a, b, 1 - a - b], axis=1)


_SPREAD = _spread(4)


def _grouped(colours: npt.NDArray[np.uint8], areas: FloatArray) -> Paint:
    """Faces by colour, of which there are at most MOST_COLOURS: the others become the nearest of those with the largest surface."""
    kept, group = np.unique(colours, axis=0, return_inverse=True)
    group = group.reshape(-1)
    if len(kept) > MOST_COLOURS:
        cells, group = np.unique(colours // _STEP, axis=0, return_inverse=True)
        group = group.reshape(-1)
        surface = np.bincount(group, areas, len(cells))
        weight = np.maximum(areas, 1e-300)
        total = np.bincount(group, weight, len(cells))
        means = np.stack([np.bincount(group, weight * colours[:, k], len(cells)) / total for k in range(3)], axis=1)
        largest = np.argsort(-surface, kind="stable")[:MOST_COLOURS]
        kept = np.rint(means[largest]).astype(np.uint8)
        group = np.asarray(cKDTree(means[largest]).query(means)[1])[group]
    surface = np.bincount(group, areas, len(kept))
    return tuple(
        ("#" + bytes(kept[k]).hex(), np.flatnonzero(group == k))
        for k in np.argsort(-surface, kind="stable")
        if (group == k).any()
    )
