"""Mesh files of props: read back, they are the parts and the look; they are written once."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image

from stable_data.assets.store import AssetStore
from stable_data.export.mesh_files import LIST_FILE, _within_image, obj_file, put_furniture_meshes, put_prop_meshes
from stable_data.export.props import placed_props, prop_parts, prop_surfaces
from stable_data.simulation.run_reader import RunScenes
from stable_data.simulation.scene_geometry import SceneGeometry
from tests import textured_assets
from tests.stable_data.export.runs import EMPTY, at_rest

pytestmark = pytest.mark.sim


def read_obj(path: Path) -> dict[str, list[Any]]:
    """The lines of a file by their first word, numbers as numbers; faces as corners of (vertex, texture, normal) rows."""
    found: dict[str, list[Any]] = {}
    for line in path.read_text("ascii").splitlines():
        word, *rest = line.split()
        if word == "f":
            found.setdefault(word, []).append([[int(n) - 1 if n else None for n in corner.split("/")] for corner in rest])
        else:
            found.setdefault(word, []).append(rest if word in ("mtllib", "usemtl") else [float(n) for n in rest])
    return found


def picture_of(mtl: Path) -> str | None:
    lines = [line.split() for line in mtl.read_text("ascii").splitlines()]
    return next((words[1] for words in lines if words[0] == "map_Kd"), None)


def test_parts_read_back_as_they_are(store: AssetStore, tmp_path: Path) -> None:
    for placed in placed_props(SceneGeometry.of(at_rest(), store)):
        folder = tmp_path / placed.prop.name
        files = put_prop_meshes(placed.prop, store, folder)
        parts = prop_parts(placed.prop, store)
        assert len(files.collision) == len(parts)
        for name, part in zip(files.collision, parts, strict=True):
            read = read_obj(folder / name)
            np.testing.assert_allclose(read["v"], part.vertices, rtol=1e-8, atol=1e-9)
            assert [[corner[0] for corner in face] for face in read["f"]] == part.faces.tolist()
        seen = np.concatenate([read_obj(folder / v.mesh)["v"] for v in files.visual])
        wanted = np.concatenate([s.triangles.reshape(-1, 3) for s in prop_surfaces(placed.prop, store)])
        np.testing.assert_allclose([seen.min(axis=0), seen.max(axis=0)], [wanted.min(axis=0), wanted.max(axis=0)], atol=1e-6)


def test_a_texture_is_a_file_beside_its_material(tmp_path: Path) -> None:
    scene = textured_assets.scene_of(textured_assets.thing("0_box_0", "box", 0.4, 0.3, 0.5, 1.5))
    run = textured_assets.write_run(tmp_path / "run", [textured_assets.textured("box", textured_assets.picture_box())], scene)
    scenes = RunScenes(run)
    [placed] = [p for s in scenes for p in placed_props(scenes.geometry(s))]
    files = put_prop_meshes(placed.prop, scenes.store, tmp_path / "out")
    [visual] = files.visual
    assert visual.texture is not None
    [library], [material] = (read_obj(tmp_path / "out" / visual.mesh)[word][0] for word in ("mtllib", "usemtl"))
    mtl = (tmp_path / "out" / visual.mesh).with_name(library)
    assert f"newmtl {material}\n" in mtl.read_text("ascii")
    assert picture_of(mtl) == Path(visual.texture).name
    pixels = np.asarray(Image.open(tmp_path / "out" / visual.texture).convert("RGB"))
    # The side that faces -y has the third field of the atlas, white in its lower half.
    read = read_obj(tmp_path / "out" / visual.mesh)
    vertices, uv, normals = (np.array(read[word]) for word in ("v", "vt", "vn"))
    for face in np.array(read["f"]):
        if normals[face[:, 2]].mean(axis=0)[1] < -0.9:
            for vertex, corner in zip(vertices[face[:, 0]], uv[face[:, 1]], strict=True):
                inward = corner + 0.1 * (uv[face[:, 1]].mean(axis=0) - corner)
                row = int((1 - inward[1]) * pixels.shape[0])
                is_white = pixels[row, int(inward[0] * pixels.shape[1])].min() > 200
                assert is_white == (vertex[2] < vertices[:, 2].mean())


def test_files_that_exist_are_not_written_again_and_a_damaged_list_is(store: AssetStore, tmp_path: Path) -> None:
    [placed, *_] = placed_props(SceneGeometry.of(at_rest(), store))
    files = put_prop_meshes(placed.prop, store, tmp_path / "a")
    stamps = {p: p.stat().st_mtime_ns for p in sorted((tmp_path / "a").rglob("*.*"))}
    assert put_prop_meshes(placed.prop, store, tmp_path / "a") == files
    assert {p: p.stat().st_mtime_ns for p in stamps} == stamps
    whole = (tmp_path / "a" / LIST_FILE).read_bytes()
    for damaged in (b"", b"[]", b'{"version": 0}', whole[:-20]):
        (tmp_path / "a" / LIST_FILE).write_bytes(damaged)
        assert put_prop_meshes(placed.prop, store, tmp_path / "a") == files
        assert (tmp_path / "a" / LIST_FILE).read_bytes() == whole


def test_tables_that_look_alike_share_their_files(store: AssetStore, tmp_path: Path) -> None:
    name, files = put_furniture_meshes(SceneGeometry.of(at_rest(), store), tmp_path)
    assert files.visual
    assert not files.collision
    assert put_furniture_meshes(SceneGeometry.of(at_rest(), store), tmp_path)[0] == name
    assert put_furniture_meshes(SceneGeometry.of(EMPTY, store), tmp_path)[0] != name
    assert len(list(tmp_path.iterdir())) == 2


def test_an_obj_file_counts_texture_rows_from_below() -> None:
    corners = np.array([[0.0, 0, 0], [1, 0, 0], [0, 1, 0]])
    text = obj_file(corners, np.array([[0, 1, 2]]), np.array([[0.25, 0.0]]), np.array([[0, 0, 0]]), material="m").decode()
    assert text == "mtllib m.mtl\nusemtl m\nv 0 0 0\nv 1 0 0\nv 0 1 0\nvt 0.25 1\nf 1/1 2/1 3/1\n"
    assert obj_file(corners, np.array([[0, 1, 2]]), normals=corners).decode().endswith("f 1//1 2//2 3//3\n")


def test_an_image_that_repeats_is_put_side_by_side(store: AssetStore, tmp_path: Path) -> None:
    name, files = put_furniture_meshes(SceneGeometry.of(at_rest(), store), tmp_path)
    for visual in files.visual:
        uv = np.array(read_obj(tmp_path / name / visual.mesh).get("vt", [[0.0, 0.0]]))
        assert uv.min() >= 0
        assert uv.max() <= 1
    rng = np.random.default_rng(0)
    pixels = rng.integers(0, 255, (4, 8, 3), np.uint8)
    corner_uv = np.array([[[-0.2, 3.1], [1.7, 3.4], [0.4, 4.9]]])
    found, image = _within_image(corner_uv, pixels)
    assert image.shape == (8, 24, 3)
    for was, now in zip(corner_uv[0], found[0], strict=True):
        x, y = (int(share * side) % side for share, side in zip(was % 1.0, (8, 4), strict=True))
        assert (image[int(now[1] * 8), int(now[0] * 24)] == pixels[y, x]).all()
    far = corner_uv * 1e4
    assert _within_image(far, pixels)[0] is far
