"""The surface of a mesh as it is seen: triangles with a material."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt

from stable_data.scene import FloatArray, IntArray


@dataclass(frozen=True, slots=True, eq=False)
class Surface:
    """Triangles with one material.

    Attributes:
        triangles: (F, 3, 3) float64, z up, not welded.
        colour: The base colour, red, green, blue from 0 to 1, linear; multiplies the image. None without a material.
        corner_colours: Colours of the corners, (F, 3, 3), from 0 to 1, linear; multiply the others. None if there are none.
        image: The content of the texture's image file, as it came or re-encoded; None without one.
        corner_uv: Texture coordinates of the corners, (F, 3, 2), shares of width and height from the upper left; the texture
            repeats. None without an image.
        opacity: From 0 (not seen) to 1.
        has_alpha: Whether the alpha of the image is opacity too; else it is ignored, as formats of meshes do by default.
    """

    triangles: FloatArray
    colour: tuple[float, float, float] | None = None
    corner_colours: FloatArray | None = None
    image: bytes | None = None
    corner_uv: FloatArray | None = None
    opacity: float = 1.0
    has_alpha: bool = False

    def with_valid_look(self) -> "Surface":
        """Returns the surface with colours and opacity from 0 to 1 and texture coordinates that are numbers.

        A look from outside alone never refuses a mesh.
        """
        colour, corners, uv = self.colour, self.corner_colours, self.corner_uv
        if colour is not None:
            red, green, blue = np.clip(np.nan_to_num(np.array(colour)), 0.0, 1.0).tolist()
            colour = (red, green, blue)
        if corners is not None:
            corners = np.clip(np.nan_to_num(corners), 0.0, 1.0)
        if uv is not None:
            uv = np.nan_to_num(uv, posinf=0.0, neginf=0.0)
        opacity = float(np.clip(np.nan_to_num(self.opacity, nan=1.0), 0.0, 1.0))
        return replace(self, colour=colour, corner_colours=corners, corner_uv=uv, opacity=opacity)


@dataclass(frozen=True, slots=True, eq=False)
class IndexedSurface:
    """The triangles of a surface with each distinct corner once, as files store them.

    Attributes:
        points: (V, 3) float32.
        faces: (F, 3) int64.
        normals: (V, 3) float32; None if they were not given.
        uv: Texture coordinates, (V, 2) float32, from the upper left; None without an image.
        colours: (V, 3) float32, from 0 to 1, linear; None if there are none.
    """

    points: npt.NDArray[np.float32]
    faces: IntArray
    normals: npt.NDArray[np.float32] | None
    uv: npt.NDArray[np.float32] | None
    colours: npt.NDArray[np.float32] | None


def index_surface(
    surface: Surface, to_file: Callable[[FloatArray], FloatArray] = lambda points: points, normals: FloatArray | None = None
) -> IndexedSurface:
    """Joins equal corners of a surface.

    Args:
        surface: At least one triangle.
        to_file: Turns coordinates (V, 3) into those of the file.
        normals: Normals of the corners in the frame of the file, (F, 3, 3).
    """
    # Equal corners of a surface remain equal numbers; zeros lose their sign, which would make them differ.
    columns = [to_file(surface.triangles.reshape(-1, 3)).astype(np.float32) + 0.0]
    if normals is not None:
        columns.append(np.round(normals.reshape(-1, 3), 5).astype(np.float32) + 0.0)  # rounded, so that more are equal
    if surface.corner_uv is not None:
        columns.append(np.nan_to_num(surface.corner_uv.reshape(-1, 2)).astype(np.float32) + 0.0)
    if surface.corner_colours is not None:
        colours = np.clip(np.nan_to_num(surface.corner_colours.reshape(-1, 3)), 0.0, 1.0)
        columns.append(colours.astype(np.float32) + 0.0)
    first, corner = _distinct_rows(columns)
    found = iter([column[first] for column in columns])
    return IndexedSurface(
        points=next(found),
        faces=corner.reshape(-1, 3),
        normals=None if normals is None else next(found),
        uv=None if surface.corner_uv is None else next(found),
        colours=None if surface.corner_colours is None else next(found),
    )


def _distinct_rows(columns: Sequence[npt.NDArray[np.float32]]) -> tuple[IntArray, IntArray]:
    """The first of each group of equal rows (V,) of arrays with N rows each, in their order, and the group of each row, (N,)."""
    rows = np.ascontiguousarray(np.concatenate([c.view(np.uint8).reshape(len(c), -1) for c in columns], axis=1))
    _, first, group = np.unique(rows.view(np.dtype((np.void, rows.shape[1]))).ravel(), return_index=True, return_inverse=True)
    order = np.argsort(first)
    rank = np.empty_like(order)
    rank[order] = np.arange(len(order))
    return first[order], rank[group]
