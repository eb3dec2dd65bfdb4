"""The look of an asset: its visible surface with colours and textures, as the tables ``meshes`` and ``textures`` store it."""

from collections import defaultdict
from collections.abc import Iterable, Sequence
from dataclasses import asdict, dataclass, replace

import numpy as np

from stable_data.errors import MeshError, Notice
from stable_data.geometry.gltf_writer import write_look
from stable_data.geometry.images import TEXTURE_SIDE, TextureImage, encode_texture
from stable_data.geometry.mesh import Mesh
from stable_data.geometry.mesh_colors import MOST_COLOURS
from stable_data.geometry.surface import Surface
from stable_data.geometry.surface_matching import oriented_as
from stable_data.geometry.surface_reduction import reduce_surfaces
from stable_data.scene import FloatArray
from stable_data.storage.schemas import Row

LOOK_FACES = 60_000
"""Largest number of triangles of a look."""


@dataclass(frozen=True, slots=True)
class LookRows:
    """What the tables store of a look.

    Attributes:
        glb: Column ``look`` of the table ``meshes``; None if face colours show as much.
        textures: Rows of the table ``textures``, each image once.
        num_faces: Triangles of the look.
        distance: Column ``look_distance``: by how much the look was moved when it was reduced, in the unit of the surfaces.
        notices: Textures that are left out, and the reduction.
    """

    glb: bytes | None
    textures: tuple[TextureImage, ...] = ()
    num_faces: int = 0
    distance: float = 0.0
    notices: tuple[Notice, ...] = ()


def look_rows(
    surfaces: Sequence[Surface],
    center: FloatArray,
    *,
    texture_side: int = TEXTURE_SIDE,
    max_faces: int = LOOK_FACES,
    asset_id: str = "",
    mesh: Mesh | None = None,
) -> LookRows:
    """Converts the surfaces of an asset to what the tables store.

    A texture that cannot be used is left out with a notice; its surface keeps its base colour. The result is the same for the same
    surfaces, byte by byte.

    Args:
        surfaces: The surfaces, z up, any unit; their images are not trusted.
        center: Subtracted from all corners, (3,), same unit, so that the look lies on the mesh of the asset.
        texture_side: Larger images are reduced to this, pixels.
        max_faces: Larger looks are reduced to this number of triangles.
        asset_id: The asset in notices.
        mesh: The repaired mesh of the asset, in the frame and unit of the look, if it is known: triangles that it turned over are
            turned over in the look too.
    """
    notices = list[Notice]()
    given = [s for s in surfaces if len(s.triangles)]
    images = {(s.image, s.has_alpha): None for s in given if s.image is not None and s.corner_uv is not None}
    stored: dict[tuple[bytes | None, bool], TextureImage | None] = {
        (image, has_alpha): _texture(image, has_alpha, texture_side, asset_id, notices) for image, has_alpha in images
    }
    kept = _joined([_with_texture(s, stored.get((s.image, s.has_alpha)), center) for s in given])
    is_plain = all(s.image is None and s.corner_colours is None and s.opacity >= 1 for s in kept)
    if is_plain and len({s.colour for s in kept}) <= MOST_COLOURS:
        return LookRows(None, notices=tuple(notices))
    if mesh is not None:
        kept = oriented_as(mesh, kept)
    num_faces = sum(len(s.triangles) for s in kept)
    kept, distance = reduce_surfaces(kept, max_faces)
    if distance > 0:
        size = np.ptp(np.concatenate([s.triangles.reshape(-1, 3) for s in kept]), axis=0).max()
        message = (
            f"asset {asset_id}: its surface has {num_faces} triangles, expected at most {max_faces}; its look was reduced and moved "
            f"by up to {distance / size:.2%} of its size"
        )
        notices.append(Notice(asset_id, "look", "look_reduced", message))
    textures = {t.sha256: t for t in stored.values() if t is not None and any(s.image == t.image for s in kept)}
    num_faces = sum(len(s.triangles) for s in kept)
    return LookRows(write_look(kept), tuple(textures[k] for k in sorted(textures)), num_faces, distance, tuple(notices))


def _texture(image: bytes, has_alpha: bool, side: int, asset_id: str, notices: list[Notice]) -> TextureImage | None:
    """An image as it is stored; None, and a notice, if it cannot be used."""
    try:
        return encode_texture(image, f"asset {asset_id}", side=side, has_alpha=has_alpha)
    except MeshError as error:
        notices.append(Notice(asset_id, "look", error.code, f"{error}; its surface is shown without it"))
        return None


def _with_texture(surface: Surface, texture: TextureImage | None, center: FloatArray) -> Surface:
    """A surface with its image as it is stored, or without one."""
    image, uv = (None, None) if texture is None or surface.corner_uv is None else (texture.image, surface.corner_uv)
    has_alpha = surface.has_alpha and image is not None
    return replace(surface, triangles=surface.triangles - np.asarray(center), image=image, corner_uv=uv, has_alpha=has_alpha)


def _joined(surfaces: Iterable[Surface]) -> list[Surface]:
    """Surfaces of one material as one, in the order of their first ones."""
    groups = defaultdict[object, list[Surface]](list)
    for s in surfaces:
        groups[s.image, s.colour, s.opacity, s.has_alpha, s.corner_colours is None].append(s)

    def together(arrays: list[FloatArray | None]) -> FloatArray | None:
        found = [array for array in arrays if array is not None]
        return np.concatenate(found) if found else None

    return [
        replace(
            group[0],
            triangles=np.concatenate([s.triangles for s in group]),
            corner_uv=together([s.corner_uv for s in group]),
            corner_colours=together([s.corner_colours for s in group]),
        )
        for group in groups.values()
    ]


def texture_rows(textures: Iterable[TextureImage]) -> list[Row]:
    """Returns rows of the table ``textures``."""
    return [asdict(texture) for texture in textures]
