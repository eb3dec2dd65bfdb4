"""The looks of assets for MuJoCo: meshes with one texture or one colour each.

MuJoCo's renderer has no colours of corners and no transparency of images: colours of corners become a small texture with a colour
for each face, and the alpha of an image is not shown.
"""

import hashlib
from collections import defaultdict
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import lru_cache

import numpy as np
import numpy.typing as npt
from scipy.spatial.transform import Rotation

from stable_data.geometry.images import texture_pixels
from stable_data.geometry.mesh import area_vectors
from stable_data.geometry.mesh_colors import MOST_COLOURS, to_display
from stable_data.geometry.shading import split_at_creases, welded_corners
from stable_data.geometry.surface import Surface
from stable_data.scene import FloatArray, IntArray, QuatXyzw, Vec3
from stable_data.simulation.mujoco_import import mujoco

_FLAT = 1e-12  # a face of a smaller area, share of the squared extent, is not seen
_FEWEST_VERTICES = 4  # of a mesh in MuJoCo
_MANY_COLOURS = 4096  # more are rounded to 32 steps a channel


@dataclass(frozen=True, slots=True)
class ObjectLook:
    """What is seen of an object.

    Attributes:
        surfaces: The look of its asset, mesh units.
        scale: Metres per mesh unit, along the axes of the mesh.
        tilt_quat_xyzw: Rotation before yaw.
        offset: Centre of the mesh in the yaw frame, metres; the origin is the centre of the object's box.
    """

    surfaces: tuple[Surface, ...]
    scale: Vec3
    tilt_quat_xyzw: QuatXyzw
    offset: Vec3

    def placed(self) -> tuple[Surface, ...]:
        """The surfaces in metres, yaw frame, the centre of the object's box at the origin."""
        turn = Rotation.from_quat(self.tilt_quat_xyzw).as_matrix() * self.scale
        return tuple(replace(s, triangles=s.triangles @ turn.T + self.offset) for s in self.surfaces)

    @property
    def bounds(self) -> tuple[FloatArray, FloatArray]:
        """Lowest and highest corner of the placed surfaces, (3,) each, metres."""
        points = np.concatenate([s.triangles.reshape(-1, 3) for s in self.placed()])
        return points.min(axis=0), points.max(axis=0)


@dataclass(frozen=True, slots=True, eq=False)
class LookMesh:
    """Visible triangles with one texture or colour.

    Attributes:
        vertices: (V, 3) float64, at least four.
        faces: (F, 3).
        corner_uv: Texture coordinates of the corners, (F, 3, 2), from the upper left; None without a texture.
        pixels: The texture, (H, W, 3) uint8; None without one.
        rgba: Display colour and opacity, 0 to 1; multiplies the texture.
    """

    vertices: FloatArray
    faces: IntArray
    corner_uv: FloatArray | None
    pixels: npt.NDArray[np.uint8] | None
    rgba: tuple[float, float, float, float]


@lru_cache(maxsize=32)
def look_meshes(surfaces: tuple[Surface, ...]) -> tuple[LookMesh, ...]:
    """Returns the visible triangles of a look by texture and colour; cached for recent looks.

    Args:
        surfaces: The look, any unit; at least one triangle.

    Raises:
        MeshError: An image cannot be decoded.
    """
    found = []
    painted = defaultdict[float, list[Surface]](list)
    for surface in surfaces:
        if surface.image is None or surface.corner_uv is None:
            painted[surface.opacity].append(surface)
            continue
        pixels = np.ascontiguousarray(texture_pixels(surface.image, has_alpha=surface.has_alpha)[..., :3])
        colour = np.array(surface.colour or (1.0, 1.0, 1.0))
        if surface.corner_colours is not None:
            colour = colour * surface.corner_colours.mean(axis=(0, 1))
        found.append(_mesh(surface.triangles, surface.corner_uv, pixels, _rgba(to_display(colour), surface.opacity)))
    for opacity, group in painted.items():
        found += _painted_meshes(group, opacity)
    return tuple(mesh for mesh in found if mesh is not None)


def _painted_meshes(surfaces: Sequence[Surface], opacity: float) -> list[LookMesh | None]:
    """Meshes of surfaces without images: one for each of few colours, or one with a texture that has a pixel for each colour."""
    triangles, colours = np.concatenate([s.triangles for s in surfaces]), []
    for s in surfaces:
        linear = np.tile(np.array(s.colour or (1.0, 1.0, 1.0)), (len(s.triangles), 1))
        colours.append(linear if s.corner_colours is None else linear * s.corner_colours.mean(axis=1))
    shown = np.rint(255 * to_display(np.concatenate(colours))).astype(np.uint8)
    palette, colour = np.unique(shown, axis=0, return_inverse=True)
    if len(palette) > _MANY_COLOURS:
        palette, colour = np.unique(shown // 8 * 8 + 4, axis=0, return_inverse=True)
    colour = colour.reshape(-1)
    if len(palette) <= MOST_COLOURS:
        return [_mesh(triangles[colour == k], None, None, _rgba(one / 255, opacity)) for k, one in enumerate(palette)]
    side = int(np.ceil(np.sqrt(len(palette))))
    pixels = np.zeros((side * side, 3), np.uint8)
    pixels[: len(palette)] = palette
    uv = (np.stack([colour % side, colour // side], axis=1) + 0.5) / side
    corner_uv = np.repeat(uv[:, None], 3, axis=1)
    return [_mesh(triangles, corner_uv, pixels.reshape(side, side, 3), _rgba(np.ones(3), opacity))]


def _rgba(colour: FloatArray, opacity: float) -> tuple[float, float, float, float]:
    red, green, blue = colour.tolist()
    return red, green, blue, opacity


def _mesh(
    triangles: FloatArray,
    corner_uv: FloatArray | None,
    pixels: npt.NDArray[np.uint8] | None,
    rgba: tuple[float, float, float, float],
) -> LookMesh | None:
    """A mesh of those triangles that have an area; None without any."""
    if not len(triangles):
        return None
    vertices, faces = welded_corners(triangles)
    is_seen = np.linalg.norm(area_vectors(vertices[faces]), axis=1) > _FLAT * float(np.ptp(vertices, axis=0).max()) ** 2
    if not is_seen.any():
        return None
    faces, uv = faces[is_seen], None if corner_uv is None else corner_uv[is_seen]
    vertices, faces = split_at_creases(vertices, faces)
    if len(vertices) < _FEWEST_VERTICES:
        vertices = np.pad(vertices, ((0, _FEWEST_VERTICES - len(vertices)), (0, 0)), mode="edge")
    return LookMesh(vertices, faces, uv, pixels, rgba)


def add_look_material(spec: mujoco.MjSpec, mesh: LookMesh, name: str) -> str:
    """Adds the material of a mesh to a description, and its texture, which is shared by its content.

    Args:
        spec: The description.
        mesh: A mesh with a texture.
        name: The name of the material.

    Returns:
        The name of the material.
    """
    assert mesh.pixels is not None
    texture = f"texture_{hashlib.sha256(repr(mesh.pixels.shape).encode() + mesh.pixels.tobytes()).hexdigest()[:24]}"
    if spec.texture(texture) is None:
        added = spec.add_texture(name=texture, type=mujoco.mjtTexture.mjTEXTURE_2D)
        added.height, added.width, added.nchannel = mesh.pixels.shape
        added.data = mesh.pixels.tobytes()
    material = spec.add_material(name=name, rgba=list(mesh.rgba))
    material.textures[mujoco.mjtTextureRole.mjTEXROLE_RGB] = texture
    return name
