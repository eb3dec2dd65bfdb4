"""Colours of meshes: those of the file, on the faces that have them, through repair, the tables of a run and the exports."""

import io
import struct
import zlib
from collections.abc import Callable
from pathlib import Path
from random import Random
from typing import Any

import numpy as np
import pytest
import trimesh
from hypothesis import given, settings
from hypothesis import strategies as st
from PIL import Image

from stable_data.assets.store import AssetStore
from stable_data.embedded_world.families.catalogue import asset
from stable_data.errors import MeshError
from stable_data.export.glb import scene_glb
from stable_data.geometry.gltf_reader import load_glb
from stable_data.geometry.gltf_writer import write_glb
from stable_data.geometry.mesh import double_areas
from stable_data.geometry.mesh_colors import MOST_COLOURS, Paint, load_paint
from stable_data.geometry.mesh_repair import repair_mesh
from stable_data.scene import Scene, SceneObject, Tabletop
from stable_data.simulation.mujoco_model import VISUAL_GROUP, engine_spec
from stable_data.simulation.scene_geometry import SceneGeometry
from tests.bounds import limit
from tests.stable_data.geometry.glb_files import document_of, edited, rebuilt

pytestmark = pytest.mark.sim


class Folder:
    """Files by the name of their asset."""

    def __init__(self, root: Path) -> None:
        self.root = root

    def asset_path(self, asset_id: str) -> Path | None:
        return self.root / f"{asset_id}.glb"


def painted(content: bytes) -> Paint:
    mesh, _ = load_glb(content, "a")
    return load_paint(content, "a", repair_mesh(mesh, "a")[0])


def textured(image: Image.Image, uv: list[list[float]] | None = None) -> bytes:
    """A unit square in the plane z = 0 of the file's own two triangles, with a texture."""
    mesh = trimesh.Trimesh([[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0]], [[0, 1, 2], [0, 2, 3]], process=False)
    material = trimesh.visual.material.PBRMaterial(baseColorTexture=image)
    mesh.visual = trimesh.visual.TextureVisuals(uv=uv or [[0, 0], [1, 0], [1, 1], [0, 1]], material=material)
    return bytes(trimesh.Scene([mesh]).export(file_type="glb"))


@pytest.mark.parametrize("key", ["mug/0", "banana/0", "laptop/0", "vase/0", "chess_piece/0"])
def test_a_thing_has_the_colours_that_it_was_painted_with(key: str) -> None:
    thing = asset(key)
    areas = double_areas(thing.mesh)
    wanted = {colour: areas[rows].sum() / areas.sum() for colour, rows in thing.paint}
    mesh, _ = load_glb(thing.glb, key)
    mesh = repair_mesh(mesh, key)[0]
    found, areas = load_paint(thing.glb, key, mesh), double_areas(mesh)
    assert sorted(np.concatenate([rows for _, rows in found])) == list(range(len(mesh.faces)))
    assert {colour: areas[rows].sum() / areas.sum() for colour, rows in found} == pytest.approx(wanted, abs=0.02)


def test_what_is_written_is_read_again_with_the_same_colours() -> None:
    mesh = repair_mesh(load_glb(asset("laptop/0").glb, "a")[0], "a")[0]
    given = load_paint(asset("laptop/0").glb, "a", mesh)
    content = write_glb(mesh, paint=given)
    again = load_glb(content, "a")[0]
    once_more = load_paint(content, "a", again)
    assert [colour for colour, _ in once_more] == [colour for colour, _ in given]
    for (_, rows), (_, other) in zip(given, once_more, strict=True):
        was, now = (np.sort(m.triangles[r].mean(axis=1), axis=0) for m, r in ((mesh, rows), (again, other)))
        np.testing.assert_allclose(now, was, atol=1e-5 * mesh.extents.max())


def test_a_file_without_materials_has_no_colours() -> None:
    assert painted(write_glb(asset("mug/0").mesh)) == ()


def test_a_texture_gives_each_face_its_mean_colour() -> None:
    image = Image.new("RGB", (64, 64), "#20c040")
    image.paste("#f08020", (0, 0, 32, 64))
    left, right = [[0.1, 0.1], [0.4, 0.1], [0.4, 0.9], [0.1, 0.9]], [[1.6, 0.1], [1.9, 0.1], [1.9, 0.9], [1.6, 0.9]]
    assert [colour for colour, _ in painted(textured(image, left))] == ["#f08020"]
    assert [colour for colour, _ in painted(textured(image, right))] == ["#20c040"]  # the texture repeats


def test_a_picture_of_many_pieces_is_read_once(monkeypatch: pytest.MonkeyPatch) -> None:
    content = edited(
        textured(Image.new("RGB", (8, 8), "#f08020")),
        lambda d: d["meshes"][0]["primitives"].extend(8 * d["meshes"][0]["primitives"]),
    )
    limit(monkeypatch, "image", max_pixels=64)
    assert [colour for colour, _ in painted(content)] == ["#f08020"]


def with_pictures(*pictures: bytes) -> bytes:
    """A square for each of some textures, whatever they are."""
    document, binary = document_of(textured(Image.new("RGB", (8, 8))))
    views, (primitive,) = document["bufferViews"], document["meshes"][0]["primitives"]
    document["images"], document["textures"], document["materials"], document["meshes"][0]["primitives"] = [], [], [], []
    for k, picture in enumerate(pictures):
        document["images"].append({"bufferView": len(views)})
        document["textures"].append({"source": k})
        document["materials"].append({"pbrMetallicRoughness": {"baseColorTexture": {"index": k}}})
        document["meshes"][0]["primitives"].append({**primitive, "material": k})
        views.append({"buffer": 0, "byteOffset": len(binary), "byteLength": len(picture)})
        binary += picture
    return rebuilt(document, binary)


def encoded(image: Image.Image, file_format: str) -> bytes:
    stream = io.BytesIO()
    image.save(stream, file_format)
    return stream.getvalue()


@pytest.mark.parametrize("file_format", ["PNG", "JPEG", "WEBP"])
def test_textures_of_the_formats_of_gltf_are_read(file_format: str) -> None:
    ((colour, _),) = painted(with_pictures(encoded(Image.new("RGB", (16, 16), "#808080"), file_format)))
    assert colour == "#808080"


@pytest.mark.parametrize("file_format", ["EPS", "GIF", "TIFF", "PPM", "ICO", "PDF", "JPEG2000"])
def test_a_texture_of_another_format_is_not_opened(file_format: str) -> None:
    """Pillow starts a program, Ghostscript, to read EPS."""
    with pytest.raises(MeshError, match=r"another format.*expected PNG, JPEG, WEBP, BMP or TGA") as caught:
        painted(with_pictures(encoded(Image.new("RGB", (16, 16)), file_format)))
    assert caught.value.code == "texture_invalid"


def test_a_picture_of_thousands_of_scans_is_not_decoded() -> None:
    picture = Image.linear_gradient("L")
    stream = io.BytesIO()
    picture.save(stream, "JPEG", progressive=True)
    assert painted(with_pictures(stream.getvalue()))
    scans = stream.getvalue()
    last = scans[scans.rindex(b"\xff\xda") : -2]
    with pytest.raises(MeshError, match="more scans, expected at most 100") as caught:
        painted(with_pictures(scans[:-2] + 1000 * last + scans[-2:]))
    assert caught.value.code == "texture_invalid"


def png_of(width: int, height: int) -> bytes:
    """A PNG that claims a size and has no pixels."""
    chunks = [(b"IHDR", struct.pack(">2I5B", width, height, 8, 2, 0, 0, 0)), (b"IDAT", b""), (b"IEND", b"")]
    return b"\x89PNG\r\n\x1a\n" + b"".join(
        struct.pack(">I", len(content)) + name + content + struct.pack(">I", zlib.crc32(name + content))
        for name, content in chunks
    )


@pytest.mark.parametrize("size", [(12_000, 12_000), (20_000, 20_000), (2**31 - 1, 2**31 - 1)])
def test_a_texture_of_too_many_pixels_is_not_decoded(size: tuple[int, int]) -> None:
    with pytest.raises(MeshError, match="DecompressionBomb") as caught:
        painted(with_pictures(png_of(*size)))
    assert caught.value.code == "texture_too_large"


def test_the_pixels_of_all_textures_are_limited(monkeypatch: pytest.MonkeyPatch) -> None:
    picture = encoded(Image.new("RGB", (8, 8), "#f08020"), "PNG")
    limit(monkeypatch, "image", max_pixels=128)
    assert [colour for colour, _ in painted(with_pictures(picture, picture))] == ["#f08020"]
    with pytest.raises(MeshError, match=r"192 pixels in all textures.*expected at most 128"):
        painted(with_pictures(picture, picture, picture))


@settings(max_examples=150, deadline=None)
@given(st.sampled_from(["PNG", "JPEG", "WEBP"]), st.randoms(use_true_random=False))
def test_of_a_damaged_texture_only_colours_and_mesh_errors_come(file_format: str, random: Random) -> None:
    num_faces = len(repair_mesh(load_glb(with_pictures(b""), "a")[0], "a")[0].faces)
    picture = bytearray(
        encoded(Image.linear_gradient("L").resize((16, 16)).convert("P" if file_format == "PNG" else "RGB"), file_format)
    )
    for _ in range(random.choice((1, 3, 30))):
        picture[random.randrange(len(picture))] = random.choice((0, 255, random.randrange(256)))
    try:
        found = painted(with_pictures(bytes(picture[: len(picture) - random.choice((0, 0, random.randrange(len(picture))))])))
    except MeshError as error:
        assert error.code in ("texture_invalid", "texture_too_large")  # noqa: PT017 - not every damage is an error
    else:
        assert sum(len(rows) for _, rows in found) == num_faces


def test_vertices_may_have_colours() -> None:
    box = trimesh.creation.box()
    box.visual.vertex_colors = [255, 0, 255, 255]
    ((colour, rows),) = painted(bytes(trimesh.Scene([box]).export(file_type="glb")))
    assert (colour, len(rows)) == ("#ff00ff", 12)


def test_of_many_colours_few_are_left_and_every_face_has_one() -> None:
    mesh = repair_mesh(load_glb(asset("vase/0").glb, "a")[0], "a")[0]
    rng = np.random.default_rng(0)
    noisy = [
        (f"#{r:02x}{g:02x}{b:02x}", np.array([k])) for k, (r, g, b) in enumerate(rng.integers(0, 256, (len(mesh.faces), 3)))
    ]
    found = painted(write_glb(mesh, paint=noisy))
    assert len(found) == MOST_COLOURS
    assert sum(len(rows) for _, rows in found) == len(mesh.faces)


@pytest.mark.parametrize("content", [b"no picture", b"", b"\x89PNG\r\n\x1a\n" + b"\0" * 60])
def test_a_texture_that_cannot_be_read_is_said_and_the_mesh_used(content: bytes, tmp_path: Path) -> None:
    stream = io.BytesIO()
    Image.new("RGB", (64, 64), "#20c040").save(stream, "png")
    good = textured(Image.open(stream))
    start = good.index(b"\x89PNG")
    broken = good[:start] + content + b"\0" * (len(stream.getvalue()) - len(content)) + good[start + len(stream.getvalue()) :]
    with pytest.raises(MeshError, match="texture cannot be read") as caught:
        painted(broken)
    assert caught.value.code == "texture_invalid"
    (tmp_path / "a.glb").write_bytes(broken)
    found, (notice,) = AssetStore(Folder(tmp_path)).paint("a")
    assert (found, notice.code) == ((), "texture_invalid")


@pytest.mark.parametrize(
    "change",
    [
        lambda document: document["materials"].clear(),
        lambda document: document["materials"][0].update(pbrMetallicRoughness={"baseColorFactor": ["red", 0, 0, 1]}),
        lambda document: document["materials"][0].update(pbrMetallicRoughness={"baseColorTexture": {"index": 9}}),
        lambda document: document["materials"].__setitem__(0, 7),
    ],
)
def test_materials_that_break_the_format_are_an_error_of_ours(change: Callable[[dict[str, Any]], object]) -> None:
    content = edited(asset("mug/0").glb, change)
    mesh, _ = load_glb(content, "a")
    with pytest.raises(MeshError) as caught:
        load_paint(content, "a", mesh)
    assert caught.value.code == "glb_invalid"


def test_a_texture_elsewhere_is_not_opened() -> None:
    content = textured(Image.new("RGB", (4, 4), "#20c040"))
    outside = edited(content, lambda d: d["images"].__setitem__(0, {"uri": "file:///etc/passwd"}))
    assert [colour for colour, _ in painted(outside)] == ["#ffffff"]


def test_what_an_instruction_calls_by_its_colour_is_seen_in_it(tmp_path: Path) -> None:
    """The colours of a library's file, in the table of a run and in what is made of it."""
    key = "laptop/0"
    (tmp_path / "a.glb").write_bytes(asset(key).glb)
    store = AssetStore(Folder(tmp_path))
    mesh = store.asset("a").mesh
    x, y, z = mesh.extents.tolist()
    o = SceneObject("1_laptop_0", "laptop", (0.5, 0.3, z / 2), 0.4, (x, y, z), asset_id="a", scale=(1.0, 1.0, 1.0))
    solid = SceneGeometry.of(Scene("desk_0000", Tabletop("office_table", (1.0, 0.6), None), (o,)), store)
    wanted = {colour for colour, _ in asset(key).paint}
    assert {colour for colour, _ in solid.paint(0)} == wanted
    model = engine_spec(solid).compile()
    seen = model.geom_rgba[(model.geom_group == VISUAL_GROUP) & (model.geom_bodyid > 0)]
    assert {"#" + bytes(np.rint(255 * rgba[:3]).astype(np.uint8)).hex() for rgba in seen} == wanted
    assert {colour for colour, _ in painted(scene_glb(solid))} >= wanted
