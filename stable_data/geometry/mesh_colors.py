"""The colours of a mesh, from the materials, textures and vertex colours of its GLB: few colours, each with its faces.

Instructions name colours ("the yellow block"), so rendered images must show them.
"""

from pathlib import Path
from typing import TypeAlias

import numpy as np
import numpy.typing as npt
from scipy.spatial import cKDTree

from stable_data.errors import MeshError
from stable_data.geometry.gltf_reader import load_surfaces
from stable_data.geometry.images import decode_images
from stable_data.geometry.mesh import Mesh, double_areas
from stable_data.geometry.surface import Surface
from stable_data.scene import FloatArray, IntArray

Paint: TypeAlias = tuple[tuple[str, IntArray], ...]
"""Display colours and the faces that have them, each face once: (``#rrggbb``, indices)."""

MOST_COLOURS = 8
"""Largest number of colours of a mesh: more than an instruction names, and few enough pieces to render."""

_PIXELS = 512  # side to which a texture is reduced
_MAX_SAMPLED_FACES = 20_000  # faces; up to this number a texture is read at many points of each face
_CELL = 16  # of 256: side of the colour cells that are merged if a mesh has many colours


@np.errstate(over="ignore", invalid="ignore")  # values that are not finite are checked below
def load_paint(data: bytes | Path, asset_id: str, mesh: Mesh) -> Paint:
    """Reads the colours of the faces of a mesh.

    Args:
        data: The file of the mesh, or its content; not trusted.
        asset_id: The asset's name in messages.
        mesh: As returned by :func:`stable_data.geometry.gltf_reader.load_glb`, repaired or not: a face gets the colour of the
            nearest face of the file.

    Returns:
        The colours, that of the largest surface first; none if the file gives no colour.

    Raises:
        MeshError: The colours cannot be read; ``code`` is ``texture_invalid``, ``texture_too_large`` or one of
            :func:`stable_data.geometry.gltf_reader.load_glb`.
    """
    surfaces = load_surfaces(data, asset_id)
    if all(surface.colour is None and surface.corner_colours is None for surface in surfaces):
        return ()
    images = {
        id(surface.image): surface.image for surface in surfaces if surface.image is not None and surface.corner_uv is not None
    }
    decoded = decode_images(images, f"asset {asset_id}", side=_PIXELS) if images else {}
    textures = {key: np.asarray(image) for key, image in decoded.items()}
    colours = np.concatenate([_face_colours(surface, textures.get(id(surface.image))) for surface in surfaces])
    triangles = np.concatenate([surface.triangles for surface in surfaces])
    low, high = triangles.min(axis=(0, 1)), triangles.max(axis=(0, 1))
    middles = triangles.mean(axis=1) - (low + high) / 2
    # The tree compares squared distances, so they must be finite too.
    if not np.isfinite(np.square(4 * middles)).all():
        message = f"asset {asset_id}: a vertex is not finite or too far from the origin, expected a mesh of usual size"
        raise MeshError(message, "glb_nan_vertices")
    nearest: IntArray = np.asarray(cKDTree(middles).query(mesh.triangles.mean(axis=1))[1])
    return _group_by_colour(colours[nearest], double_areas(mesh))


def to_linear(on_screen: FloatArray) -> FloatArray:
    """Converts display colours (sRGB, IEC 61966-2-1) to the linear colours of glTF; both from 0 to 1, any shape."""
    return np.asarray(np.where(on_screen <= 0.04045, on_screen / 12.92, ((on_screen + 0.055) / 1.055) ** 2.4))


def to_display(linear: FloatArray) -> FloatArray:
    """Converts linear colours to display colours, see :func:`to_linear`; they are clipped to 0 to 1."""
    clipped = np.clip(np.nan_to_num(linear), 0.0, 1.0)
    return np.asarray(np.where(clipped <= 0.0031308, 12.92 * clipped, 1.055 * clipped ** (1 / 2.4) - 0.055))


_LINEAR = to_linear(np.arange(256) / 255)


def _face_colours(surface: Surface, texture: npt.NDArray[np.uint8] | None) -> npt.NDArray[np.uint8]:
    """Display colour of each face, (F, 3)."""
    linear = np.tile(np.array(surface.colour or (1.0, 1.0, 1.0)), (len(surface.triangles), 1))
    if surface.corner_colours is not None:
        linear *= surface.corner_colours.mean(axis=1)
    if texture is not None and surface.corner_uv is not None:
        linear *= _mean_texture_colours(texture, surface.corner_uv)
    return np.asarray(np.rint(255 * to_display(linear)), np.uint8)


def _mean_texture_colours(texture: npt.NDArray[np.uint8], corner_uv: FloatArray) -> FloatArray:
    """Mean colour of a texture over each face, (F, 3), linear."""
    many, one = _TRIANGLE_POINTS, _TRIANGLE_POINTS.mean(axis=0, keepdims=True)
    uv = np.einsum("kc,fcd->fkd", many if len(corner_uv) <= _MAX_SAMPLED_FACES else one, corner_uv)
    return np.asarray(texture_colours(texture, uv).mean(axis=1))


def texture_colours(texture: npt.NDArray[np.uint8], uv: FloatArray) -> FloatArray:
    """Reads a texture at some places.

    Args:
        texture: Display colours, (H, W, 3).
        uv: Texture coordinates (..., 2) from the upper left; the texture repeats.

    Returns:
        Linear colours of the nearest pixels, (..., 3).
    """
    height, width, _ = texture.shape
    uv = np.nan_to_num(uv) % 1.0
    column, row = (uv[..., 0] * width).astype(int) % width, (uv[..., 1] * height).astype(int) % height
    return np.asarray(_LINEAR[texture[row, column]])


def _triangle_points(steps: int) -> FloatArray:
    """Barycentric coordinates (K, 3) of points all over a triangle: the centres of the small triangles that divide it."""
    thirds = [(3 * i + d, 3 * j + d) for d in (1, 2) for i in range(steps) for j in range(steps - i - (d == 2))]
    a, b = np.array(thirds).T / (3 * steps)
    return np.stack([a, b, 1 - a - b], axis=1)


_TRIANGLE_POINTS = _triangle_points(4)


def _group_by_colour(colours: npt.NDArray[np.uint8], areas: FloatArray) -> Paint:
    """Groups faces by colour; if there are more than MOST_COLOURS, the others join the nearest of those with the largest surface."""
    palette, group = np.unique(colours, axis=0, return_inverse=True)
    group = group.reshape(-1)
    if len(palette) > MOST_COLOURS:
        cells, group = np.unique(colours // _CELL, axis=0, return_inverse=True)
        group = group.reshape(-1)
        surface = np.bincount(group, areas, len(cells))
        weight = np.maximum(areas, 1e-300)  # so that faces without area have a mean colour too
        total = np.bincount(group, weight, len(cells))
        means = np.stack([np.bincount(group, weight * colours[:, k], len(cells)) / total for k in range(3)], axis=1)
        largest = np.argsort(-surface, kind="stable")[:MOST_COLOURS]
        palette = np.rint(means[largest]).astype(np.uint8)
        group = np.asarray(cKDTree(means[largest]).query(means)[1])[group]
    surface = np.bincount(group, areas, len(palette))
    return tuple(
        ("#" + bytes(palette[k]).hex(), np.flatnonzero(group == k))
        for k in np.argsort(-surface, kind="stable")
        if (group == k).any()
    )
