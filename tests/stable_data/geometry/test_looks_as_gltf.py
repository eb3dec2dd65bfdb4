"""Surfaces with textures through a file: what is written is read again, and of addresses only those of the table are opened."""

import hashlib
import io
from typing import Any

import numpy as np
import pytest
import trimesh
from hypothesis import given, settings
from hypothesis import strategies as st
from PIL import Image

from stable_data.errors import MeshError
from stable_data.geometry.gltf_reader import load_glb, load_surfaces, texture_addresses
from stable_data.geometry.gltf_writer import SurfaceParts, pack, write_look, y_up
from stable_data.geometry.images import encode_texture
from stable_data.geometry.surface import Surface
from stable_data.limits import MeshLimits
from tests.stable_data.geometry.glb_files import document_of, edited

pytestmark = pytest.mark.sim


def picture(colour: str = "#4080c0", alpha: int = 255) -> bytes:
    stream = io.BytesIO()
    image = Image.new("RGBA", (8, 8), colour)
    image.putalpha(alpha)
    image.save(stream, "PNG")
    return encode_texture(stream.getvalue(), "a", has_alpha=True).image


def table_of(*images: bytes) -> dict[str, bytes]:
    return {hashlib.sha256(image).hexdigest(): image for image in images}


def random_surface(rng: np.random.Generator, num: int = 5, **rest: Any) -> Surface:
    """Triangles whose numbers single precision represents."""
    return Surface(rng.random((num, 3, 3), np.float32).astype(np.float64), **rest)


@settings(max_examples=60, deadline=None)
@given(st.integers(0, 2**32 - 1), st.booleans(), st.booleans(), st.sampled_from([1.0, 0.5, 0.0]), st.booleans())
def test_what_is_written_is_read_again(seed: int, is_textured: bool, is_painted: bool, opacity: float, has_alpha: bool) -> None:
    rng = np.random.default_rng(seed)
    image = picture() if is_textured else None
    given_surface = random_surface(
        rng,
        colour=tuple(rng.random(3).tolist()),
        corner_colours=rng.random((5, 3, 3)) if is_painted else None,
        image=image,
        corner_uv=rng.normal(0, 3, (5, 3, 2)).astype(np.float32).astype(np.float64) if is_textured else None,
        opacity=opacity,
        has_alpha=has_alpha,
    )
    content = write_look([given_surface, random_surface(rng)])
    found, other = load_surfaces(content, "a", textures=table_of(*([image] if image else [])).get)
    np.testing.assert_array_equal(found.triangles, given_surface.triangles)
    assert (found.colour, found.image, found.opacity) == (given_surface.colour, image, opacity)
    assert found.has_alpha == (opacity < 1 or (has_alpha and is_textured))
    if is_textured:
        np.testing.assert_array_equal(found.corner_uv, given_surface.corner_uv)
    if is_painted:
        assert found.corner_colours is not None
        assert given_surface.corner_colours is not None
        np.testing.assert_allclose(found.corner_colours, given_surface.corner_colours, atol=1e-5)
    assert (other.colour, other.corner_colours, other.image, other.opacity, other.has_alpha) == (None, None, None, 1.0, False)
    assert content == write_look([given_surface, other])


def test_corners_are_welded_where_all_that_is_said_of_them_is_equal() -> None:
    box = trimesh.creation.box()
    triangles = np.asarray(box.triangles)
    (plain,) = document_of(write_look([Surface(triangles)]))[0]["meshes"][0]["primitives"]
    document, _ = document_of(write_look([Surface(triangles)]))
    assert document["accessors"][plain["attributes"]["POSITION"]]["count"] == 8
    uv = np.tile([[0.0, 0.0], [1.0, 0.0], [1.0, 1.0]], (12, 1, 1))
    document, _ = document_of(write_look([Surface(triangles, image=picture(), corner_uv=uv)]))
    assert 8 < document["accessors"][0]["count"] <= 36


def test_surfaces_share_images_and_materials() -> None:
    rng = np.random.default_rng(0)
    image, uv = picture(), rng.random((5, 3, 2))
    surfaces = [random_surface(rng, image=bytes(bytearray(image)), corner_uv=uv) for _ in range(3)]
    document, _ = document_of(write_look([*surfaces, random_surface(rng, image=picture("red"), corner_uv=uv)]))
    assert [len(document[name]) for name in ("materials", "textures", "images")] == [2, 2, 2]


def test_the_geometry_of_a_look_is_read_as_of_any_file() -> None:
    sphere = trimesh.creation.icosphere(2)
    mesh, notices = load_glb(write_look([Surface(np.asarray(sphere.triangles))]), "a")
    assert notices == ()
    assert len(mesh.vertices) == len(sphere.vertices)


def test_of_addresses_only_those_of_the_table_are_opened() -> None:
    rng = np.random.default_rng(0)
    image = picture()
    content = write_look([random_surface(rng, image=image, corner_uv=rng.random((5, 3, 2)))])
    (sha256,) = table_of(image)
    assert texture_addresses(content) == (sha256,)
    assert load_surfaces(content, "a")[0].image is None  # without a table
    asked = list[str]()

    def lookup(name: str) -> bytes | None:
        asked.append(name)
        return None

    with pytest.raises(MeshError, match=f"asset a: its look names the image {sha256}") as caught:
        load_surfaces(content, "a", textures=lookup)
    assert caught.value.code == "texture_missing"
    assert asked == [sha256]
    for uri in ("file:///etc/passwd", "../texture.png", "texture:../x", f"texture:{sha256}/..", f"TEXTURE:{sha256}", 7, None):
        other = edited(content, lambda document, uri=uri: document["images"].__setitem__(0, {"uri": uri}))  # type: ignore[misc]
        assert load_surfaces(other, "a", textures=lookup)[0].image is None
        assert texture_addresses(other) == ()
    assert asked == [sha256]


def test_images_of_the_table_count_as_bytes_of_the_file() -> None:
    rng = np.random.default_rng(0)
    image = picture()
    content = write_look([random_surface(rng, image=image, corner_uv=rng.random((5, 3, 2)))])
    with pytest.raises(MeshError, match="max_bytes"):
        load_surfaces(content, "a", limits=MeshLimits(max_bytes=5000), textures=lambda _: bytes(5001))


@pytest.mark.parametrize(
    ("mode", "factor", "opacity", "has_alpha"),
    [("OPAQUE", 0.5, 1.0, False), ("BLEND", 0.5, 0.5, True), ("BLEND", 7.0, 1.0, True), ("MASK", 0.5, 1.0, True)],
)
def test_alpha_counts_where_the_material_says_so(mode: str, factor: float, opacity: float, has_alpha: bool) -> None:
    content = write_look([random_surface(np.random.default_rng(0), colour=(1.0, 0.5, 0.0))])
    material = {"alphaMode": mode, "pbrMetallicRoughness": {"baseColorFactor": [1.0, 0.5, 0.0, factor]}}
    (found,) = load_surfaces(edited(content, lambda document: document["materials"].__setitem__(0, material)), "a")
    assert (found.opacity, found.has_alpha) == (opacity, has_alpha)


def test_texture_coordinates_may_be_moved_by_the_material() -> None:
    """The matrices of the specification of KHR_texture_transform, written out."""
    rng = np.random.default_rng(0)
    uv, image = rng.random((5, 3, 2)).astype(np.float32), picture()
    content = write_look([random_surface(rng, image=image, corner_uv=uv)])
    moved = {"index": 0, "extensions": {"KHR_texture_transform": {"offset": [0.1, 0.2], "rotation": 0.3, "scale": [2.0, 0.5]}}}
    change = {"pbrMetallicRoughness": {"baseColorTexture": moved}}
    content = edited(content, lambda document: document["materials"].__setitem__(0, change))
    c, s = np.cos(0.3), np.sin(0.3)
    matrix = np.array([[1, 0, 0.1], [0, 1, 0.2], [0, 0, 1]]) @ [[c, s, 0], [-s, c, 0], [0, 0, 1]] @ np.diag([2.0, 0.5, 1.0])
    wanted = np.concatenate([uv, np.ones((5, 3, 1))], axis=2) @ matrix.T
    (found,) = load_surfaces(content, "a", textures=table_of(image).get)
    assert found.corner_uv is not None
    np.testing.assert_allclose(found.corner_uv, wanted[..., :2], atol=1e-6)


def test_another_program_sees_the_images_of_a_packed_file() -> None:
    image, sphere = picture("#c04020"), trimesh.creation.icosphere(1)
    uv = np.random.default_rng(0).random((len(sphere.faces), 3, 2))
    parts = SurfaceParts()
    primitive = parts.primitive(Surface(np.asarray(sphere.triangles), (1.0, 1.0, 1.0), None, image, uv), y_up)
    entries = parts.document([{"bufferView": len(parts.arrays), "mimeType": "image/png"}])
    document = {"scene": 0, "scenes": [{"nodes": [0]}], "nodes": [{"mesh": 0}], "meshes": [{"primitives": [primitive]}]}
    content = pack(document | entries, parts.arrays, parts.images)
    (mesh,) = trimesh.load(io.BytesIO(content), file_type="glb").geometry.values()
    assert np.asarray(mesh.visual.material.baseColorTexture.convert("RGB"))[3, 3].tolist() == [192, 64, 32]
    seen = np.asarray(mesh.visual.uv)[mesh.faces]
    np.testing.assert_allclose(seen * [1, -1] + [0, 1], uv, atol=1e-6)
    assert load_surfaces(content, "a")[0].image == image
