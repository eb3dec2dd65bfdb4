"""The visible share of silhouettes: what is known by calculation, and MuJoCo's segmentation."""

from collections.abc import Sequence

import numpy as np
import pytest

from stable_data.geometry.shape import Shape
from stable_data.rotations import wxyz
from stable_data.scene import FloatArray, Scene, SceneObject, Tabletop, Vec3
from stable_data.simulation.mujoco_import import mujoco
from stable_data.simulation.offscreen import can_render
from stable_data.simulation.render import FIELD_OF_VIEW, View, camera_pose
from stable_data.simulation.scene_geometry import SceneGeometry
from stable_data.simulation.visibility import visible_shares
from tests.scenes import ball, box

TABLE = Tabletop("office_table", (1.0, 0.8))


def geometry_of(*placed: tuple[Shape, Vec3, float]) -> SceneGeometry:
    """Objects with shapes and poses on a table."""
    objects = []
    for k, (shape, position, yaw) in enumerate(placed):
        a, b, c = shape.size.tolist()
        objects.append(SceneObject(f"thing_{k}", "thing", position, yaw, (a, b, c)))
    store: object = None  # only a support needs it
    return SceneGeometry(Scene("s", TABLE, tuple(objects)), tuple(p[0] for p in placed), (None,) * len(placed), store)  # type: ignore[arg-type]


def test_objects_beside_each_other_are_seen_whole_and_one_in_a_box_or_below_the_table_not_at_all() -> None:
    inside, below = (box(0.04, 0.04, 0.04), (0.7, 0.4, 0.06), 0.0), (box(0.04, 0.04, 0.04), (0.5, 0.6, -0.04), 0.0)
    geometry = geometry_of(
        (box(0.1, 0.1, 0.1), (0.3, 0.4, 0.05), 0.3), (box(0.2, 0.2, 0.2), (0.7, 0.4, 0.1), 0.0), inside, below
    )
    for view in ("front", "perspective"):
        assert visible_shares(geometry, view).tolist() == [1.0, 1.0, 0.0, 0.0]


def test_what_has_hardly_a_pixel_is_unknown_and_not_hidden() -> None:
    geometry = geometry_of((box(0.1, 0.1, 0.1), (0.3, 0.4, 0.05), 0.0), (box(0.002, 0.002, 0.002), (0.7, 0.4, 0.001), 0.0))
    assert visible_shares(geometry, "front").tolist() == pytest.approx([1.0, float("nan")], nan_ok=True)
    assert visible_shares(geometry, "front", (4096, 4096))[1] == 1.0


def test_from_above_a_plate_shows_what_the_box_on_it_leaves() -> None:
    geometry = geometry_of((box(0.4, 0.4, 0.01), (0.5, 0.4, 0.005), 0.0), (box(0.2, 0.2, 0.01), (0.5, 0.4, 0.015), 0.0))
    plate, on_it = visible_shares(geometry, "top", (512, 512))
    assert on_it == 1.0
    assert plate == pytest.approx(0.75, abs=0.01)  # the box covers a quarter


def test_what_is_nearer_hides_what_is_farther_whatever_their_order() -> None:
    small, large = (box(0.1, 0.1, 0.1), (0.5, 0.5, 0.05), 0.0), (box(0.4, 0.05, 0.4), (0.5, 0.35, 0.2), 0.0)
    for order in ((0, 1), (1, 0)):
        both = [small, large]
        shares = visible_shares(geometry_of(*(both[k] for k in order)), "front")
        assert shares[order.index(1)] == 1.0
        assert shares[order.index(0)] < 0.05


@pytest.mark.sim
@pytest.mark.skipif(not can_render(), reason="the machine has no OpenGL")
@pytest.mark.parametrize("view", ["front", "perspective"])
def test_the_shares_are_those_of_mujocos_segmentation(view: View) -> None:
    placed = (
        (ball(0.09), (0.4, 0.35, 0.09), 0.0),
        (box(0.12, 0.2, 0.2), (0.45, 0.55, 0.1), 0.5),
        (box(0.3, 0.08, 0.05), (0.55, 0.2, 0.025), -0.4),
        (ball(0.05), (0.62, 0.3, 0.05), 0.0),
    )
    geometry = geometry_of(*placed)
    expected = segmented_shares(geometry, view, (256, 256))
    assert visible_shares(geometry, view) == pytest.approx(expected, abs=0.02)
    assert expected.min() < 0.95


def segmented_shares(geometry: SceneGeometry, view: View, size: tuple[int, int]) -> FloatArray:
    """The shares by MuJoCo: pixels of each object among all, divided by its pixels alone."""
    every = range(len(geometry.shapes))
    together = segmented(geometry, every, view, size)
    return np.array([(together == k).sum() / (segmented(geometry, [k], view, size) == 0).sum() for k in every])


def segmented(geometry: SceneGeometry, chosen: Sequence[int], view: View, size: tuple[int, int]) -> FloatArray:
    """The index of the object in each pixel."""
    spec, poses = mujoco.MjSpec(), geometry.scene.poses()
    position, quat = camera_pose(*geometry.seen_bounds, view, size, geometry.scene.table)
    spec.worldbody.add_camera(name="view", pos=list(position), quat=wxyz(quat), fovy=FIELD_OF_VIEW)
    for k in chosen:
        shape = geometry.shapes[k]
        spec.add_mesh(name=f"m{k}", uservert=shape.posed(poses[k]).ravel(), userface=shape.faces.ravel().astype(np.int32))
        spec.worldbody.add_geom(type=mujoco.mjtGeom.mjGEOM_MESH, meshname=f"m{k}")
    spec.visual.global_.offwidth, spec.visual.global_.offheight = size
    model = spec.compile()
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    with mujoco.Renderer(model, height=size[1], width=size[0]) as renderer:
        renderer.enable_segmentation_rendering()
        renderer.update_scene(data, "view")
        found: FloatArray = renderer.render()[:, :, 0]
    return found
