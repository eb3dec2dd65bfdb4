import numpy as np
import pytest

from stable_data.embedded_world.families.catalogue import asset
from stable_data.errors import ConfigError
from stable_data.geometry.mesh import Mesh
from stable_data.scene import Scene, SceneObject, Tabletop
from stable_data.simulation.mujoco_import import mujoco
from stable_data.simulation.offscreen import Picture
from stable_data.simulation.render import (
    View,
    add_camera,
    category_colour,
    contact_sheet,
    object_colour,
    render_scene,
    scene_bounds,
)

pytestmark = pytest.mark.sim


def thing(key: str, x: float, y: float) -> tuple[SceneObject, Mesh]:
    mesh, category = asset(key).mesh, asset(key).category
    a, b, c = mesh.extents.tolist()
    return SceneObject(f"1_{category}_0", category, (x, y, c / 2), 0.3, (a, b, c), asset_id=asset(key).uid), mesh


def scene_of(*objects: SceneObject, zone: tuple[float, float, float, float] | None = None) -> Scene:
    return Scene("bathroom_vanity_0000", Tabletop("bathroom_vanity", (0.8, 0.5), zone), objects)


def drawn(scene: Scene, meshes: list[Mesh | None], **rest: object) -> Picture:
    try:
        return render_scene(scene, meshes, **rest)  # type: ignore[arg-type]
    except ConfigError as error:
        if error.code == "no_gl":
            pytest.skip(str(error))
        raise


def reddish(picture: Picture) -> int:
    red, green, blue = (picture[:, :, k].astype(int) for k in range(3))
    return int(((red > 100) & (red > 2 * green) & (red > 2 * blue)).sum())


def test_picture_has_the_size_and_shows_the_object() -> None:
    o, mesh = thing("mug/0", 0.4, 0.25)
    picture = drawn(scene_of(o), [mesh], size=(160, 120), colors=["#ff0000"])
    assert picture.shape == (120, 160, 3)
    assert picture.dtype == np.uint8
    assert reddish(picture) > 50
    assert picture[0].min() > 150  # light, not black


def test_same_scene_gives_the_same_bytes() -> None:
    o, mesh = thing("mug/0", 0.4, 0.25)
    first, second = (drawn(scene_of(o), [mesh], size=(96, 96)) for _ in range(2))
    np.testing.assert_array_equal(first, second)


def test_object_on_the_left_is_drawn_on_the_left() -> None:
    o, mesh = thing("can/0", 0.1, 0.25)
    picture = drawn(scene_of(o), [mesh], size=(128, 128), colors=["#ff0000"])
    assert reddish(picture[:, :64]) > 0
    assert reddish(picture[:, 64:]) == 0


def test_view_from_the_top_has_far_things_at_the_top() -> None:
    o, mesh = thing("can/0", 0.4, 0.4)
    picture = drawn(scene_of(o), [mesh], size=(128, 128), view="top", colors=["#ff0000"])
    assert reddish(picture[:64]) > 0
    assert reddish(picture[64:]) == 0


def test_view_from_the_left_has_near_things_at_the_right() -> None:
    o, mesh = thing("can/0", 0.4, 0.05)
    picture = drawn(scene_of(o), [mesh], size=(128, 128), view="left", colors=["#ff0000"])
    assert reddish(picture[:, 64:]) > 0
    assert reddish(picture[:, :64]) == 0


def test_object_without_mesh_is_a_box_that_lets_the_table_through() -> None:
    o, mesh = thing("cereal_box/0", 0.4, 0.25)
    solid = drawn(scene_of(o), [mesh], size=(96, 96), colors=["#0000ff"])
    ghost = drawn(scene_of(o), [None], size=(96, 96), colors=["#0000ff"])
    empty = drawn(scene_of(), [], size=(96, 96))
    assert (ghost != empty).any()
    assert (ghost != solid).any()


def test_restricted_zone_is_seen() -> None:
    plain = drawn(scene_of(), [], size=(96, 96))
    sink = drawn(scene_of(zone=(0.3, 0.5, 0.1, 0.4)), [], size=(96, 96))
    assert (sink.min(axis=2) > plain.min(axis=2) + 50).sum() > 20


def test_heavy_mesh_is_drawn() -> None:
    o, mesh = thing("orange/0", 0.4, 0.25)
    heavy = mesh
    while len(heavy.faces) < 8000:
        heavy = _subdivided(heavy)
    assert reddish(drawn(scene_of(o), [heavy], size=(96, 96), colors=["#ff0000"])) > 20


def _subdivided(mesh: Mesh) -> Mesh:
    a, b, c = (mesh.triangles[:, k] for k in range(3))
    ab, bc, ca = (a + b) / 2, (b + c) / 2, (c + a) / 2
    soup = np.concatenate([np.stack(t, axis=1) for t in ((a, ab, ca), (ab, b, bc), (ca, bc, c), (ab, bc, ca))])
    vertices, index = np.unique(np.round(soup.reshape(-1, 3), 9), axis=0, return_inverse=True)
    return Mesh(vertices, index.reshape(-1, 3))


def test_mesh_without_area_is_drawn_as_its_box() -> None:
    o, mesh = thing("can/0", 0.4, 0.25)
    speck = Mesh(mesh.vertices * 0, mesh.faces)
    assert (drawn(scene_of(o), [speck], size=(64, 64)) != drawn(scene_of(), [], size=(64, 64))).any()


@pytest.mark.parametrize("view", ["front", "perspective", "top", "left"])
@pytest.mark.parametrize("size", [(512, 512), (320, 180), (90, 160)])
@pytest.mark.parametrize("high", [(0.8, 0.5, 0.2), (2.0, 0.4, 0.3), (0.3, 0.3, 1.2)])
def test_all_corners_are_in_the_picture_from_where_the_format_has_it_or_near(
    view: View, size: tuple[int, int], high: tuple[float, float, float]
) -> None:
    spec = mujoco.MjSpec()
    add_camera(spec, np.array([0.0, 0.0, -0.03]), np.array(high), view, size)
    model = spec.compile()
    corners = np.array([[x, y, z] for x in (0.0, high[0]) for y in (0.0, high[1]) for z in (-0.03, high[2])])
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    seen = (corners - data.cam_xpos[0]) @ data.cam_xmat[0].reshape(3, 3)  # x to the right, y up, z to the viewer
    half = np.tan(np.radians(model.cam_fovy[0]) / 2)
    share = abs(seen[:, :2]) / (-seen[:, 2:] * half * [size[0] / size[1], 1.0])  # of the way from the middle to the edge
    assert share.max() < 1
    if size[0] > size[1]:
        assert share.max() > 0.85
    else:
        assert np.linalg.norm(data.cam_xpos[0] - corners.mean(axis=0)) >= 1.5 * np.ptp(corners, axis=0).max() - 1e-9


def test_unknown_view_is_refused() -> None:
    with pytest.raises(ConfigError, match="view is 'below'"):
        render_scene(scene_of(), [], view="below")  # type: ignore[arg-type]


def test_bounds_hold_objects_and_table() -> None:
    o, mesh = thing("vase/0", 0.0, 0.0)
    low, high = scene_bounds(scene_of(o), [mesh])
    assert low[0] < -0.9 * mesh.extents[0] / 2
    assert high[2] == pytest.approx(mesh.extents[2])
    assert high[:2].tolist() == [0.8, 0.5]


def test_colours_are_stable_and_of_the_category() -> None:
    assert category_colour("banana") == "#f2d14b"
    assert category_colour("gizmo") == category_colour("gizmo")
    o, _ = thing("mug/0", 0.1, 0.1)
    assert object_colour(o).startswith("#")
    assert len(object_colour(o)) == 7


def test_contact_sheet_holds_every_picture() -> None:
    images = [np.full((40, 60, 3), 20 * k, np.uint8) for k in range(5)]
    sheet = contact_sheet(images, list("abcde"), 2)
    assert sheet.shape[1] > 120
    for image in images:
        assert (sheet == image[0, 0]).all(axis=2).sum() >= 40 * 60


def test_contact_sheet_of_nothing_is_refused() -> None:
    with pytest.raises(ConfigError, match="0 pictures"):
        contact_sheet([], [], 3)
