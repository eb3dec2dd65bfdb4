"""The look of an asset: what the tables store of its surfaces, reduced where it is too large, without textures that are broken."""

import hashlib
import io
import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import trimesh
from PIL import Image

from stable_data.assets import run_assets
from stable_data.assets.looks import LookRows, look_rows, texture_rows
from stable_data.assets.run_assets import RunAssets
from stable_data.assets.store import AssetStore
from stable_data.geometry.gltf_reader import load_surfaces, texture_addresses
from stable_data.geometry.gltf_writer import write_look
from stable_data.geometry.images import texture_pixels
from stable_data.geometry.mesh import Mesh
from stable_data.geometry.mesh_colors import texture_colours
from stable_data.geometry.surface import Surface
from stable_data.scene import FloatArray
from stable_data.storage.schemas import SCHEMAS
from stable_data.storage.table_rows import arrow_table
from tests.textured_assets import picture_box, rows_of, textured, write_run

pytestmark = pytest.mark.sim
ORIGIN = np.zeros(3)


def png(image: Image.Image) -> bytes:
    stream = io.BytesIO()
    image.save(stream, "PNG")
    return stream.getvalue()


def gradient() -> Image.Image:
    """Red grows to the right, green downward."""
    y, x = np.indices((128, 128)) * 2
    return Image.fromarray(np.stack([x, y, 0 * x], axis=2).astype(np.uint8))


def ball(subdivisions: int = 2, image: bytes | None = None) -> Surface:
    """A ball of radius 1; longitude and latitude are its texture coordinates."""
    triangles = np.asarray(trimesh.creation.icosphere(subdivisions).triangles)
    x, y, z = np.moveaxis(triangles, 2, 0)
    angle = np.arctan2(y, x) / (2 * np.pi) + 0.5
    angle += angle < angle.max(axis=1, keepdims=True) - 0.5  # triangles across the seam
    return Surface(triangles, None, None, image or png(gradient()), np.stack([angle, 0.5 - z / 2], axis=2))


def read(rows: LookRows) -> list[Surface]:
    assert rows.glb is not None
    assert texture_addresses(rows.glb) == tuple(texture.sha256 for texture in rows.textures)
    return load_surfaces(rows.glb, "a", textures={t.sha256: t.image for t in rows.textures}.get)


def plain(colours: int) -> list[Surface]:
    return [Surface(np.eye(3)[None] + k, (k / 20, 0.0, 0.0)) for k in range(colours)]


def test_a_look_lies_on_the_mesh_of_its_asset() -> None:
    given = ball()
    rows = look_rows([given], np.array([0.5, -1.0, 2.0]))
    (found,) = read(rows)
    np.testing.assert_allclose(found.triangles, given.triangles - [0.5, -1.0, 2.0], atol=1e-6)
    assert found.corner_uv is not None
    assert given.corner_uv is not None
    np.testing.assert_allclose(found.corner_uv, given.corner_uv, atol=1e-6)
    assert (rows.num_faces, rows.distance, rows.notices) == (len(given.triangles), 0.0, ())
    (row,) = texture_rows(rows.textures)
    assert arrow_table("textures", [row]).num_rows == 1
    assert row["sha256"] == hashlib.sha256(row["image"]).hexdigest()
    assert (np.asarray(gradient()) == texture_pixels(row["image"])).all()


def test_the_same_surfaces_give_the_same_bytes() -> None:
    given = [ball(4), *plain(2)]
    first, second = (look_rows(given, ORIGIN, max_faces=900) for _ in range(2))
    assert (first.glb, first.textures, first.distance) == (second.glb, second.textures, second.distance)


def test_what_face_colours_show_needs_no_look() -> None:
    assert look_rows(plain(8), ORIGIN) == LookRows(None)
    assert look_rows(plain(9), ORIGIN).glb is not None
    assert look_rows([Surface(np.eye(3)[None])], ORIGIN).glb is None
    assert look_rows([Surface(np.eye(3)[None], opacity=0.5)], ORIGIN).glb is not None
    assert look_rows([Surface(np.eye(3)[None], corner_colours=np.eye(3)[None])], ORIGIN).glb is not None
    assert look_rows([Surface(np.empty((0, 3, 3)), image=png(gradient()), corner_uv=np.empty((0, 3, 2)))], ORIGIN).glb is None


def test_a_broken_texture_costs_the_texture() -> None:
    good, broken = ball(), ball(image=b"no picture")
    rows = look_rows([broken, replace(good, triangles=good.triangles + 3), broken], ORIGIN, asset_id="thing")
    (notice,) = rows.notices
    assert (notice.item_id, notice.step, notice.code) == ("thing", "look", "texture_invalid")
    assert notice.message.startswith("asset thing: a texture cannot be read")
    bare, textured = read(rows)
    assert bare.image is None
    assert len(bare.triangles) == 2 * len(broken.triangles)
    assert textured.image is not None
    alone = look_rows([broken], ORIGIN)
    assert (alone.glb, len(alone.notices)) == (None, 1)


def test_one_image_of_many_surfaces_is_stored_once() -> None:
    rows = look_rows([ball(), ball(), replace(ball(), colour=(0.5, 0.5, 0.5))], ORIGIN)
    assert len(rows.textures) == 1
    assert len(read(rows)) == 2


def seen(surfaces: list[Surface], points: FloatArray) -> FloatArray:
    """The colours at the corners that are nearest to some points."""
    corners = np.concatenate([s.triangles.reshape(-1, 3) for s in surfaces])
    found = []
    for s in surfaces:
        colours = np.ones((len(s.triangles), 3, 3)) if s.corner_colours is None else s.corner_colours
        if s.image is not None and s.corner_uv is not None:
            colours = colours * texture_colours(texture_pixels(s.image), s.corner_uv)
        found.append(colours.reshape(-1, 3))
    nearest = np.linalg.norm(corners - points[:, None], axis=2).argmin(axis=1)
    return np.asarray(np.concatenate(found)[nearest])


@pytest.mark.parametrize("is_torn", [False, True])
def test_a_reduced_look_has_its_colours_at_their_places(is_torn: bool) -> None:
    """Also if each triangle is a chart of its own, so that the texture can only be sampled into colours of corners."""
    given = ball(4)
    if is_torn:
        assert given.corner_uv is not None
        given = replace(
            given, corner_uv=given.corner_uv + np.arange(len(given.triangles))[:, None, None]
        )  # the texture repeats
    rows = look_rows([given], ORIGIN, max_faces=1500)
    found = read(rows)
    assert rows.num_faces <= 1650
    assert [s.image is None for s in found] == [is_torn]
    assert [s.corner_colours is not None for s in found] == [is_torn]
    assert [notice.code for notice in rows.notices] == ["look_reduced"]
    corners = np.concatenate([s.triangles.reshape(-1, 3) for s in found])
    assert 0 < np.abs(np.linalg.norm(corners, axis=1) - 1).max() <= rows.distance + 0.01
    assert rows.distance < 0.03
    points = np.random.default_rng(0).normal(size=(60, 3))
    points /= np.linalg.norm(points, axis=1, keepdims=True)
    assert np.abs(seen(found, points) - seen([given], points)).mean() < 0.03


def test_surfaces_without_textures_are_reduced_with_their_colours() -> None:
    top, bottom = (replace(ball(4), image=None, corner_uv=None, opacity=opacity) for opacity in (1.0, 0.5))
    top = replace(top, triangles=top.triangles + np.array([0, 0, 3]), corner_colours=np.clip(top.triangles, 0, 1))
    solid, clear = read(look_rows([top, bottom], ORIGIN, max_faces=2000))
    assert (solid.opacity, clear.opacity) == (1.0, 0.5)
    assert clear.corner_colours is None
    assert solid.corner_colours is not None
    np.testing.assert_allclose(solid.corner_colours, np.clip(solid.triangles - [0, 0, 3], 0, 1), atol=0.1)
    assert solid.triangles[..., 2].min() > 1.9


@pytest.mark.slow
def test_a_million_triangles_are_clustered_first() -> None:
    given = ball(8)
    assert len(given.triangles) > 1_000_000
    rows = look_rows([given], ORIGIN, max_faces=5000)
    (found,) = read(rows)
    assert len(found.triangles) <= 5500
    assert rows.distance < 0.03
    points = np.random.default_rng(0).normal(size=(60, 3))
    points /= np.linalg.norm(points, axis=1, keepdims=True)
    wanted = seen([ball(5)], points)
    assert np.abs(seen([found], points) - wanted).mean() < 0.03


def test_a_row_that_is_no_look_names_no_textures() -> None:
    assert texture_addresses(None) == ()
    assert texture_addresses(b"junk") == ()


def test_the_table_is_the_one_that_is_described() -> None:
    (texture,) = look_rows([ball()], ORIGIN).textures
    assert set(SCHEMAS["textures"].names) == {"sha256", "image", "mime", "width", "height"}
    assert (texture.width, texture.height, texture.mime) == (128, 128, "image/png")


def test_a_run_gives_the_looks_of_its_assets(tmp_path: Path) -> None:
    given = picture_box()
    run = write_run(tmp_path / "run", [textured("a"), textured("b"), rows_of("plain", LookRows(None))])
    assets = RunAssets(run, tmp_path / "files")
    store = AssetStore(assets)
    for asset_id in ("a", "b"):
        surfaces, notices = store.look(asset_id)
        assert surfaces is not None
        assert notices == ()
        np.testing.assert_allclose(surfaces[0].triangles, given.triangles, atol=1e-7)
        assert surfaces[0].image == assets.textures(asset_id)[0]["image"]
    assert store.look("plain") == store.look("none") == (None, ())
    assert run.num_rows("textures") == 1


def test_without_its_image_an_asset_is_shown_in_its_face_colours(tmp_path: Path) -> None:
    asset, mesh, rows = textured("a")
    (texture,) = rows
    broken = b"no picture"
    cases = {
        "texture_missing": [],
        "texture_invalid": [texture | {"image": broken, "sha256": hashlib.sha256(broken).hexdigest()}],
    }
    for code, found in cases.items():
        if found:  # a look that names the broken image
            content = mesh["look"].replace(texture["sha256"].encode(), found[0]["sha256"].encode())
            mesh = mesh | {"look": content}
        run = write_run(tmp_path / code, [(asset, mesh, found)])
        surfaces, (notice,) = AssetStore(RunAssets(run, tmp_path / "files")).look("a")
        assert surfaces is None
        assert (notice.item_id, notice.step, notice.code) == ("a", "look", code)
        assert notice.message.endswith("its face colours are shown")


def test_an_image_without_the_hash_of_its_row_is_not_shown(tmp_path: Path) -> None:
    asset, mesh, (texture,) = textured("a")
    run = write_run(tmp_path / "run", [(asset, mesh, [texture | {"image": png(gradient())}])])
    assert AssetStore(RunAssets(run, tmp_path / "files")).look("a")[1][0].code == "texture_missing"


@pytest.mark.parametrize("number", [np.nan, np.inf])
def test_a_look_that_is_not_finite_is_not_shown(number: float, tmp_path: Path) -> None:
    given = picture_box()
    given.triangles[0, 0, 0] = number
    asset, mesh, rows = textured("a")
    run = write_run(tmp_path / "run", [(asset, mesh | {"look": write_look([replace(given, image=rows[0]["image"])])}, rows)])
    assert AssetStore(RunAssets(run, tmp_path / "files")).look("a")[1][0].code == "glb_nan_vertices"


def test_a_run_without_the_table_has_no_looks(tmp_path: Path) -> None:
    run = write_run(tmp_path / "run", [rows_of("a", LookRows(None))])
    shutil.rmtree(tmp_path / "run" / "textures")
    assets = RunAssets(run, tmp_path / "files")
    assert (assets.look("a"), assets.textures("a")) == ([], [])


def test_few_images_are_in_memory(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    pictures = [png(Image.new("RGB", (64, 64), (k, 0, 0))) for k in range(6)]
    looks = [look_rows([ball(image=picture)], ORIGIN) for picture in pictures]
    run = write_run(tmp_path / "run", [rows_of(f"a{k}", look) for k, look in enumerate(looks)])
    images = [look.textures[0] for look in looks]
    monkeypatch.setattr(run_assets, "_TEXTURE_BYTES", sum(len(t.image) for t in images[:2]) + 10)
    table = run_assets.RunTextures(run)
    for _ in range(2):
        for texture in images:
            assert table.image(texture.sha256) == texture.image
            assert len(table._recent) <= 2


def inside_out(surface: Surface, rows: slice = slice(None)) -> Surface:
    """A surface some of whose triangles are turned over."""
    assert surface.corner_uv is not None
    triangles, uv = surface.triangles.copy(), surface.corner_uv.copy()
    triangles[rows], uv[rows] = triangles[rows][:, ::-1], uv[rows][:, ::-1]
    return replace(surface, triangles=triangles, corner_uv=uv)


@pytest.mark.parametrize("rows", [slice(None), slice(0, 5), slice(1, 12, 3)])
def test_triangles_face_the_way_of_the_repaired_mesh(rows: slice) -> None:
    given = picture_box()
    mesh = Mesh(given.triangles.reshape(-1, 3), np.arange(36).reshape(-1, 3))
    (found,) = read(look_rows([inside_out(given, rows)], ORIGIN, mesh=mesh))
    (wanted,) = read(look_rows([given], ORIGIN))
    assert found.corner_uv is not None
    assert wanted.corner_uv is not None
    for now, was, uv, uv_was in zip(found.triangles, wanted.triangles, found.corner_uv, wanted.corner_uv, strict=True):
        (shift,) = [k for k in range(3) if np.allclose(np.roll(now, k, axis=0), was)]  # never the other way round
        np.testing.assert_allclose(np.roll(uv, shift, axis=0), uv_was)


def test_both_sides_of_a_sheet_stay() -> None:
    given = picture_box()
    both = [given, inside_out(given)]
    mesh = Mesh(given.triangles.reshape(-1, 3), np.arange(36).reshape(-1, 3))
    (with_mesh,), (without,) = read(look_rows(both, ORIGIN, mesh=mesh)), read(look_rows(both, ORIGIN))
    np.testing.assert_array_equal(with_mesh.triangles, without.triangles)
