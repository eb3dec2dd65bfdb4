"""Targets: assets as binary glTF with textures, and images."""

import io
from pathlib import Path

import numpy as np

from benchmarks.fuzzing.cases import Base, Target
from benchmarks.fuzzing.targets.results import DATA, check_finite, check_notices, check_surfaces
from stable_data.assets.store import AssetStore
from stable_data.geometry.gltf_reader import load_colliders, load_surfaces
from stable_data.geometry.gltf_writer import write_glb, write_look
from stable_data.geometry.images import encode_texture, texture_pixels
from stable_data.geometry.mesh import Mesh
from stable_data.geometry.mesh_colors import load_paint
from stable_data.geometry.primitive_shapes import box_triangles, cylinder_triangles
from stable_data.geometry.reduction import join_triangles
from stable_data.geometry.surface import Surface
from stable_data.importers.rigid_models import welded
from stable_data.scene import UPRIGHT

_WORDS = (
    *(
        "accessors",
        "bufferViews",
        "buffers",
        "images",
        "textures",
        "materials",
        "meshes",
        "nodes",
        "scenes",
        "scene",
        "primitives",
        "mode",
    ),
    *(
        "attributes",
        "POSITION",
        "NORMAL",
        "TEXCOORD_0",
        "TEXCOORD_1",
        "COLOR_0",
        "indices",
        "componentType",
        "count",
        "type",
        "VEC3",
        "MAT4",
    ),
    *(
        "byteOffset",
        "byteLength",
        "byteStride",
        "bufferView",
        "matrix",
        "translation",
        "rotation",
        "scale",
        "children",
        "skin",
        "sparse",
    ),
    *(
        "KHR_draco_mesh_compression",
        "KHR_texture_transform",
        "KHR_materials_unlit",
        "KHR_mesh_quantization",
        "EXT_texture_webp",
    ),
    *(
        "extensionsRequired",
        "extensions",
        "baseColorTexture",
        "baseColorFactor",
        "pbrMetallicRoughness",
        "alphaMode",
        "MASK",
        "uri",
    ),
    *(
        "part_faces",
        "colliders",
        "mimeType",
        "image/png",
        "image/webp",
        "normalized",
        "min",
        "max",
        "extras",
        "morphTargets",
        "targets",
    ),
)


def picture(kind: str, side: int = 8) -> bytes:
    """A small picture in a format of Pillow."""
    from PIL import Image

    levels = np.arange(side * side * 3, dtype=np.uint8).reshape(side, side, 3)
    image = Image.fromarray(levels)
    if kind == "PALETTE":
        image, kind = image.quantize(8), "PNG"
    elif kind == "ALPHA":
        image, kind = image.convert("RGBA"), "PNG"
    elif kind == "GREY16":
        image, kind = Image.fromarray(levels[:, :, 0].astype(np.uint16) * 200), "PNG"
    stream = io.BytesIO()
    image.save(stream, kind, **({"progressive": True} if kind == "JPEG" else {}))
    return stream.getvalue()


def _box() -> Mesh:
    return welded(box_triangles() * 0.1)


def _assets() -> list[Base]:
    triangles = box_triangles() * 0.1
    uv = np.tile(np.array([[0.0, 0.0], [1.0, 0.0], [1.0, 1.0]]), (len(triangles), 1, 1))
    painted = [
        Surface(triangles, None, None, picture("PNG"), uv),
        Surface(cylinder_triangles(0.02, 0.1), (0.5, 0.2, 0.1), None, None, None, 0.5),
    ]
    joined = join_triangles([surface.triangles for surface in painted], "a")[0]
    contents = {
        "plain": write_glb(_box()),
        "painted": write_glb(joined, surfaces=painted),
        "photo": write_glb(_box(), surfaces=[Surface(triangles, None, None, picture("JPEG"), uv)]),
        "look": write_look(painted),
        "parts": write_glb(_box(), is_z_up=True, parts=(_box(), welded(cylinder_triangles(0.02, 0.1)))),
    }
    for uid in (
        "sink_cube",
        "3cc47c3f78d34985bf4314de2f8196dd",
        "2a26f3f3-5b13-b670-e575-38878aa2fa39",
        "77ccd3c23a304f58e0b2bb07c89f2234",
    ):
        contents[uid] = (DATA / "Assets_library" / f"{uid}.glb").read_bytes()
    return [Base(name, {"asset.glb": content}) for name, content in contents.items()]


class _OneAsset:
    """An asset source with one file."""

    def __init__(self, folder: Path) -> None:
        self._path = folder / "asset.glb"

    def asset_path(self, asset_id: str) -> Path | None:
        return self._path


def _read_asset(folder: Path, base: str) -> bool:
    store = AssetStore(_OneAsset(folder))
    asset = store.asset("a")
    check_notices(asset.notices)
    check_finite("mesh", asset.mesh.vertices)
    if len(asset.mesh.faces) and not 0 <= asset.mesh.faces.min() <= asset.mesh.faces.max() < len(asset.mesh.vertices):
        raise IndexError("a face names a vertex that is not there")
    shape = store.shape_at("a", (1.0, 0.5, 2.0), UPRIGHT)
    check_finite("shape", shape.vertices, shape.size)
    if base != "look":  # its images are rows of a table
        load_paint(folder / "asset.glb", "a", asset.mesh)
    for part in load_colliders(folder / "asset.glb", "a"):
        check_finite("collider", part.vertices)
    image = picture("PNG") if base == "look" else None
    check_surfaces(load_surfaces(folder / "asset.glb", "a", textures=None if image is None else lambda _: image))
    return True


def _images() -> list[Base]:
    kinds = {
        "png": "PNG",
        "palette": "PALETTE",
        "alpha": "ALPHA",
        "grey16": "GREY16",
        "jpeg": "JPEG",
        "webp": "WEBP",
        "bmp": "BMP",
        "tga": "TGA",
    }
    found = [Base(name, {"image.bin": picture(kind, 16)}) for name, kind in kinds.items()]
    return [base for base in found if _is_read(base.files["image.bin"])]


def _is_read(content: bytes) -> bool:
    from stable_data.errors import MeshError

    try:
        texture_pixels(content)
    except MeshError:
        return False
    return True


def _read_image(folder: Path, base: str) -> bool:
    content = (folder / "image.bin").read_bytes()
    pixels = texture_pixels(content, has_alpha=True)
    assert pixels.ndim == 3
    encode_texture(content, "image", side=8)
    return True


TARGETS = (
    Target("glb", 40, _assets, _read_asset, _WORDS),
    Target("image", 50, _images, _read_image),
)
"""The targets of this module."""
