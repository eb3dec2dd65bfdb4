"""The surface of a mesh as it is seen: triangles with a material."""

from dataclasses import dataclass

from stable_data.scene import FloatArray


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
