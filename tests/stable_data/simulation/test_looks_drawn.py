"""Textures in what is drawn: pictures, MuJoCo's model and the exports show the picture of each side of a box where it is."""

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import trimesh

from stable_data.assets.looks import LookRows
from stable_data.assets.run_assets import RunAssets
from stable_data.assets.store import AssetStore
from stable_data.errors import ConfigError
from stable_data.export import glb, mesatask, mjcf
from stable_data.geometry.gltf_reader import load_glb, load_surfaces
from stable_data.geometry.images import texture_pixels
from stable_data.geometry.mesh import Mesh
from stable_data.geometry.mesh_colors import to_display
from stable_data.geometry.surface import Surface
from stable_data.mesatask import MesaTaskDataset
from stable_data.scene import FloatArray, Scene, SceneObject
from stable_data.simulation.gym_env import TabletopEnv
from stable_data.simulation.look_meshes import look_meshes
from stable_data.simulation.mujoco_import import mujoco
from stable_data.simulation.mujoco_model import COLLIDER_GROUP, VISUAL_GROUP, engine_spec
from stable_data.simulation.offscreen import Picture, open_renderer
from stable_data.simulation.render import render_scene
from stable_data.simulation.scene_geometry import SceneGeometry
from stable_data.storage.schemas import Row
from tests.textured_assets import COLOURS, SIZE, atlas, picture_box, rows_of, scene_of, textured, thing, write_run

pytestmark = pytest.mark.sim
WIDE = (320, 240)
SIDES = {0.0: 2, np.pi / 2: 0, np.pi: 3, -np.pi / 2: 1}
"""Yaw -> number of the side that faces the viewer."""

Assets = tuple[Row, Row, list[Row]]


def solid(root: Path, assets: Assets, *objects: SceneObject) -> SceneGeometry:
    scene = scene_of(*(objects or (thing("0_box_0", "a", 0.3, 0.2),)))
    run = write_run(root / "run", [assets], scene)
    return SceneGeometry.of(scene, AssetStore(RunAssets(run, root / "files")))


def shown(model: mujoco.MjModel, camera: str = "front") -> tuple[Picture, Callable[[FloatArray], FloatArray]]:
    """A picture, and a function that reads its mean colour around a place in the world."""
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    try:
        with open_renderer(model, WIDE) as renderer:
            renderer.update_scene(data, camera)
            picture = renderer.render().copy()
    except ConfigError as error:
        pytest.skip(str(error))
    number = model.camera(camera).id
    focal = WIDE[1] / 2 / np.tan(np.radians(model.cam_fovy[number]) / 2)

    def colour_at(place: FloatArray) -> FloatArray:
        x, y, z = data.cam_xmat[number].reshape(3, 3).T @ (place - data.cam_xpos[number])
        column, row = round(WIDE[0] / 2 - focal * x / z), round(WIDE[1] / 2 + focal * y / z)
        return np.asarray(picture[row - 1 : row + 2, column - 1 : column + 2].mean(axis=(0, 1)))

    return picture, colour_at


def rgb(colour: str) -> FloatArray:
    return np.array([int(colour[k : k + 2], 16) for k in (1, 3, 5)], np.float64)


def likeness(one: FloatArray, other: FloatArray) -> float:
    """Of two colours, whatever the light."""
    return float(one @ other / np.linalg.norm(one) / np.linalg.norm(other))


def front(o: SceneObject, share: float) -> FloatArray:
    """A place on the side that faces the viewer, at a share of its height from its middle."""
    depth = SIZE[1 if abs(np.sin(o.yaw)) < 0.5 else 0] / 2
    return np.add(o.position, (0.0, -depth, share * o.size[2]))


@pytest.mark.parametrize("yaw", SIDES)
def test_each_side_shows_its_picture(yaw: float, tmp_path: Path) -> None:
    geometry = solid(tmp_path, textured("a"), thing("0_box_0", "a", 0.3, 0.2, yaw))
    (o,) = geometry.scene.objects
    for camera, place, side in (("front", front(o, 0.25), SIDES[yaw]), ("top", np.add(o.position, [0, 0, o.size[2] / 2]), 5)):
        _, colour_at = shown(engine_spec(geometry, WIDE).compile(), camera)
        found = [likeness(colour_at(place), rgb(colour)) for colour in COLOURS]
        assert np.argmax(found) == side
        assert found[side] > 0.98
    if SIDES[yaw] == 2:  # the lower half is white: the picture is not upside down
        _, colour_at = shown(engine_spec(geometry, WIDE).compile())
        assert likeness(colour_at(front(o, -0.25)), np.ones(3)) > 0.995


def test_the_exported_model_looks_like_the_one_that_was_exported(tmp_path: Path) -> None:
    geometry = solid(tmp_path, textured("a"), thing("0_box_0", "a", 0.2, 0.2, 0.5), thing("1_box_0", "a", 0.4, 0.2, scale=1.2))
    mjcf.export_scene(geometry, tmp_path / "out")
    read = mujoco.MjModel.from_xml_path(str(mjcf.scene_path(geometry.scene, tmp_path / "out")))
    one, other = (shown(model)[0].astype(int) for model in (read, engine_spec(geometry, WIDE).compile()))
    assert np.abs(one - other).mean() < 0.05
    images = [texture_pixels(path.read_bytes()) for path in (tmp_path / "out" / mjcf.MESH_FOLDER).rglob("*.png")]
    (image,) = [image for image in images if image.shape == (32, 192, 3)]  # once for both objects
    assert (image == texture_pixels(atlas())).all()


def test_the_environment_shows_textures(tmp_path: Path) -> None:
    geometry = solid(tmp_path, textured("a"))
    env = TabletopEnv(geometry, cameras=("front",), image_size=WIDE)
    try:
        picture = env.reset(seed=0, options={"hand": (0.0, 0.0, 0.3)})[0]["front"]
    except ConfigError as error:
        pytest.skip(str(error))
    finally:
        env.close()
    blue, magenta = (picture.reshape(-1, 3).astype(float) @ rgb(COLOURS[k]) for k in (2, 5))
    norms = np.linalg.norm(picture.reshape(-1, 3).astype(float), axis=1) + 1
    for found, k in ((blue, 2), (magenta, 5)):
        assert (found / norms / np.linalg.norm(rgb(COLOURS[k])) > 0.98).sum() > 100


def test_pictures_of_reports_show_textures(tmp_path: Path) -> None:
    geometry = solid(tmp_path, textured("a"), thing("0_box_0", "a", 0.3, 0.2, scale=1.3))
    meshes = [Mesh(shape.vertices, shape.faces) for shape in geometry.shapes]
    try:
        with_look = render_scene(geometry.scene, meshes, size=WIDE, colors=["#808080"], looks=[geometry.look(0)])
        plain = render_scene(geometry.scene, meshes, size=WIDE, colors=["#808080"], looks=[None])
        default = render_scene(geometry.scene, meshes, size=WIDE, colors=["#808080"])
    except ConfigError as error:
        pytest.skip(str(error))
    np.testing.assert_array_equal(plain, default)
    differs = np.abs(with_look.astype(int) - plain).max(axis=2) > 20
    rows, columns = np.nonzero(differs)
    assert differs.sum() > 500
    for k in (2, 5):
        pixels = with_look[rows, columns].astype(float)
        alike = pixels @ rgb(COLOURS[k]) / np.linalg.norm(pixels, axis=1) / np.linalg.norm(rgb(COLOURS[k])) > 0.97
        assert alike.sum() > 100


def test_what_collides_does_not_depend_on_the_look(tmp_path: Path) -> None:
    models = []
    for name, assets in (("look", textured("a")), ("plain", rows_of("a", LookRows(None)))):
        (tmp_path / name).mkdir()
        models.append(engine_spec(solid(tmp_path / name, assets)).compile())
    one, other = models
    assert one.ntex > other.ntex
    for name in ("body_mass", "body_inertia", "body_ipos", "body_iquat", "qpos0"):
        np.testing.assert_array_equal(getattr(one, name), getattr(other, name))
    collides = [model.geom_group == COLLIDER_GROUP for model in models]
    for name in ("geom_size", "geom_pos", "geom_quat", "geom_contype", "geom_friction", "geom_rbound"):
        np.testing.assert_array_equal(getattr(one, name)[collides[0]], getattr(other, name)[collides[1]])
    seen = one.geom_group == VISUAL_GROUP
    assert not one.geom_contype[seen].any()
    assert not one.geom_conaffinity[seen].any()


def test_opacity_is_seen(tmp_path: Path) -> None:
    geometry = solid(tmp_path, textured("a", picture_box(opacity=0.4)))
    model = engine_spec(geometry, WIDE).compile()
    (o,) = geometry.scene.objects
    assert model.mat_rgba[model.geom_matid[model.geom("0_box_0/visual").id]][3] == pytest.approx(0.4)
    opaque = engine_spec(solid(tmp_path / "other", textured("a")), WIDE).compile()
    clear, full = (likeness(shown(m)[1](front(o, 0.25)), rgb(COLOURS[2])) for m in (model, opaque))
    assert clear < full - 0.02


def test_colours_of_corners_become_a_texture() -> None:
    rng = np.random.default_rng(0)
    surface = replace(picture_box(), image=None, corner_uv=None, corner_colours=np.repeat(rng.random((12, 1, 3)), 3, axis=1))
    (mesh,) = look_meshes((surface,))
    assert mesh.corner_uv is not None
    assert mesh.pixels is not None
    assert surface.corner_colours is not None
    side = len(mesh.pixels)
    column, row = (mesh.corner_uv[:, 0] * side).astype(int).T
    np.testing.assert_allclose(mesh.pixels[row, column] / 255, to_display(surface.corner_colours[:, 0]), atol=0.5 / 255 + 1e-9)
    few = replace(surface, corner_colours=None, colour=(1.0, 0.0, 0.0))
    (mesh,) = look_meshes((few,))
    assert (mesh.pixels, mesh.rgba) == (None, (1.0, 0.0, 0.0, 1.0))


def test_thousands_of_colours_fit_into_a_texture() -> None:
    rng = np.random.default_rng(0)
    colours = np.repeat(rng.random((60_000, 1, 3)), 3, axis=1)
    (mesh,) = look_meshes((Surface(rng.random((60_000, 3, 3)), corner_colours=colours),))
    assert mesh.pixels is not None
    assert mesh.corner_uv is not None
    assert len(mesh.pixels) <= 182
    column, row = (mesh.corner_uv[:, 0] * len(mesh.pixels)).astype(int).T
    assert np.abs(mesh.pixels[row, column] / 255 - to_display(colours[:, 0])).max() < 0.02


@pytest.mark.parametrize("num", [1, 2])
def test_a_look_of_few_triangles_is_a_mesh(num: int, tmp_path: Path) -> None:
    """MuJoCo asks for four vertices; a triangle without an area is not drawn."""
    given = picture_box()
    assert given.corner_uv is not None
    flat = np.concatenate([given.triangles[:num], given.triangles[:1, [0, 0, 1]]])
    part = replace(given, triangles=flat, corner_uv=given.corner_uv[: num + 1])
    geometry = solid(tmp_path, textured("a", part))
    model = engine_spec(geometry).compile()
    assert model.mesh_facenum[model.mesh("0_box_0/visual").id] == num


def test_a_look_without_an_area_leaves_the_face_colours(tmp_path: Path) -> None:
    given = picture_box()
    flat = replace(given, triangles=given.triangles[:, [0, 0, 1]])
    model = engine_spec(solid(tmp_path, textured("a", flat))).compile()
    assert model.geom_matid[model.geom("0_box_0/visual").id] == -1


def test_glb_has_the_textures(tmp_path: Path) -> None:
    geometry = solid(
        tmp_path, textured("a", picture_box(opacity=0.5)), thing("0_box_0", "a", 0.2, 0.2), thing("1_box_0", "a", 0.4, 0.2)
    )
    glb.export_scene(geometry, tmp_path)
    loaded = trimesh.load(glb.scene_path(geometry.scene, tmp_path))
    assert loaded.graph["0_box_0"][1] == loaded.graph["1_box_0"][1] == "a"
    mesh = loaded.geometry["a"]
    assert (np.asarray(mesh.visual.material.baseColorTexture) == texture_pixels(atlas())).all()
    assert (mesh.visual.material.alphaMode, mesh.visual.material.baseColorFactor[3]) == ("BLEND", 128)
    given = picture_box()
    assert given.corner_uv is not None
    np.testing.assert_allclose(mesh.triangles, given.triangles, atol=1e-6)
    np.testing.assert_allclose(np.asarray(mesh.visual.uv)[mesh.faces] * [1, -1] + [0, 1], given.corner_uv, atol=1e-6)


def test_colours_of_corners_are_read_by_others(tmp_path: Path) -> None:
    colours = np.repeat(np.random.default_rng(0).random((12, 1, 3)), 3, axis=1)
    geometry = solid(tmp_path, textured("a", replace(picture_box(), image=None, corner_uv=None, corner_colours=colours)))
    glb.export_scene(geometry, tmp_path)
    mesh = trimesh.load(glb.scene_path(geometry.scene, tmp_path)).geometry["a"]
    found = np.asarray(mesh.visual.vertex_attributes["color"] if mesh.visual.kind == "texture" else mesh.visual.vertex_colors)
    np.testing.assert_allclose(found[mesh.faces][..., :3] / 255, colours, atol=0.01)


def mesatask_asset(geometry: SceneGeometry, out: Path) -> tuple[list[Surface], Mesh]:
    mesatask.export_scene(geometry, out)
    path = MesaTaskDataset(out).asset_path("a")
    assert path is not None
    return load_surfaces(path, "a"), load_glb(path, "a")[0]


def test_a_dataset_has_the_textures_of_unchanged_faces(tmp_path: Path) -> None:
    """The mesh in the dataset is the repaired one: the faces of the look are cut along the same diagonals, but for the front."""
    given = picture_box()
    assert given.corner_uv is not None
    geometry = solid(tmp_path, textured("a"))
    mesh = geometry.meshes[0]
    assert mesh is not None
    surfaces, again = mesatask_asset(geometry, tmp_path / "out")
    np.testing.assert_allclose(again.extents, mesh.extents, atol=1e-7)
    assert len(again.faces) == len(mesh.faces) == 12
    with_uv = [s for s in surfaces if s.image is not None]
    assert sum(len(s.triangles) for s in surfaces) == 12
    for s in with_uv:
        assert s.corner_uv is not None
        assert s.image is not None
        pixels = texture_pixels(s.image)
        for triangle, uv in zip(s.triangles, s.corner_uv, strict=True):
            (k,) = [n for n in range(12) if np.abs(given.triangles[n].mean(axis=0) - triangle.mean(axis=0)).max() < 1e-6]
            u, v = uv.mean(axis=0)
            assert rgb(COLOURS[k % 6]) == pytest.approx(pixels[int(32 * v), int(192 * u)]) or k % 6 == 2
    assert with_uv
    dataset = MesaTaskDataset(tmp_path / "out")
    assert AssetStore(dataset).colliders("a")


def test_a_mesh_that_was_changed_keeps_its_colours(tmp_path: Path) -> None:
    moved = picture_box()
    geometry = solid(tmp_path, textured("a", replace(moved, triangles=moved.triangles * [1.0, 1.0, 0.9])))
    surfaces, _ = mesatask_asset(geometry, tmp_path / "out")
    assert all(s.image is None for s in surfaces)
    assert sum(len(s.triangles) for s in surfaces) == 12


def test_without_its_image_an_object_is_drawn_in_its_colours(tmp_path: Path) -> None:
    asset, mesh, _ = textured("a")
    geometry = solid(tmp_path, (asset, mesh, []))
    assert geometry.look(0) is None
    for scene in (geometry.scene, Scene("other", geometry.scene.table, geometry.scene.objects)):
        model = engine_spec(replace(geometry, scene=scene)).compile()
        assert model.geom_matid[model.geom("0_box_0/visual").id] == -1


def test_sharp_edges_have_vertices_on_both_sides() -> None:
    (cube,) = look_meshes((picture_box(),))
    assert len(cube.vertices) == 24
    np.testing.assert_allclose(cube.vertices[cube.faces], picture_box().triangles, atol=1e-9)
    ball = trimesh.creation.icosphere(3)
    (smooth,) = look_meshes((Surface(np.asarray(ball.triangles)),))
    assert len(smooth.vertices) == len(ball.vertices)
    (flat,) = look_meshes((Surface(np.asarray(trimesh.creation.icosphere(0).triangles)),))  # 42 degrees from face to face
    assert len(flat.vertices) == 60
