"""Surfaces, frames and poses: what is imported goes back exactly."""

import math
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from stable_data.assets.store import AssetStore
from stable_data.errors import SceneError
from stable_data.importers.boundary import Boundary
from stable_data.importers.scenes import convex_solids
from stable_data.importers.scenes.layouts import has_moved, moved_bodies, scenes_of_file, settled_object
from stable_data.importers.scenes.mjcf_scenes import read_mjcf_scene
from stable_data.importers.scenes.scene_assets import SceneAssets
from stable_data.importers.scenes.scene_file import Ground, SceneBody, SceneFile
from stable_data.importers.scenes.supports import find_supports
from stable_data.metrics.audit import audit_scene
from stable_data.rotations import quat_of, yaw_quat
from stable_data.scene import QuatXyzw, Vec3
from stable_data.storage.table_rows import scene_from_row, scene_row
from tests.scene_files import write_corner

BOX = convex_solids.box(np.array([0.03, 0.04, 0.05]))


def body(
    name: str, position: Vec3, quat: QuatXyzw = (0, 0, 0, 1), *, is_free: bool = True, half: Vec3 | None = None
) -> SceneBody:
    part = BOX if half is None else convex_solids.box(np.array(half))
    return SceneBody(name, position, quat, (part,), is_free)


def table(position: Vec3 = (0.5, 0.0, -0.02), yaw: float = 0.0) -> SceneBody:
    return body("table", position, yaw_quat(yaw), is_free=False, half=(0.5, 0.3, 0.02))


def test_the_surface_of_a_turned_table_is_its_top(tmp_path: Path) -> None:
    write_corner(tmp_path)
    (surface,) = find_supports(read_mjcf_scene(Boundary(tmp_path), "scene.xml").file)
    assert surface.owner == "table"
    assert math.degrees(surface.yaw) == pytest.approx(20)
    assert surface.size_xy == pytest.approx((1.0, 0.7), abs=1e-3)
    corner = Rotation.from_euler("z", 20, degrees=True).apply([-0.5, -0.35, 0]) + np.array([0.5, 0, 0])
    np.testing.assert_allclose(surface.origin, corner, atol=2e-4)


def test_a_body_with_nothing_below_it_is_judged_with_the_most_others() -> None:
    mug, lost = body("mug", (0.2, 0.1, 0.05)), body("lost", (5.0, 0.0, 1.0))
    (imported,) = scenes_of_file(SceneFile("a.xml", "0" * 64, "initial", (table(), mug, lost), (), ()))
    assert imported.scene.source is not None
    assert imported.scene.source["bodies"] == ["mug", "lost"]
    assets = SceneAssets()
    assets.add([imported])
    _, shapes, _ = AssetStore(assets).resolved(imported.scene)
    card = audit_scene(imported.scene, shapes).card()
    assert (card.clean, card.float_rate, card.out_of_bounds_rate) == (False, 0.5, 0.5)


@pytest.mark.parametrize("position", [(1e308, 0.0, 1.0), (0.0, -2e4, 1.0)])
def test_a_body_that_is_kilometres_away_is_an_error_of_its_scene(position: Vec3) -> None:
    file = SceneFile("a.xml", "0" * 64, "initial", (table(), body("mug", (0.2, 0.1, 0.05)), body("lost", position)), (), ())
    with pytest.raises(SceneError, match=r"'lost' is at .*, expected at most 10,000 m from the origin") as caught:
        scenes_of_file(file)
    assert caught.value.code == "pose_implausible"


def test_each_body_belongs_to_the_surface_below_it() -> None:
    bodies = (
        table(),
        body("shelf", (0.5, 0.0, 0.5), is_free=False, half=(0.2, 0.15, 0.01)),
        body("small", (0.9, 0.0, 0.02), is_free=False, half=(0.02, 0.02, 0.02)),
        body("on_table", (0.2, 0.1, 0.05)),
        body("on_small", (0.9, 0.0, 0.09)),
        body("sunk", (0.3, -0.1, 0.0)),
        body("on_shelf", (0.5, 0.0, 0.56)),
        body("on_floor", (3.0, 0.0, -0.7)),
    )
    file = SceneFile("a.xml", "", "initial", bodies, (Ground("world", -0.8),))
    found = {surface.owner: surface.names for surface in find_supports(file)}
    assert found == {"table": ("on_table", "on_small", "sunk"), "shelf": ("on_shelf",), "world": ("on_floor",)}
    (forced,) = find_supports(file, "table")
    assert len(forced.names) == 5
    with pytest.raises(SceneError) as caught:
        find_supports(file, "chair")
    assert caught.value.code == "table_unknown"


def test_a_round_table_has_a_rectangle_inside() -> None:
    disc = SceneBody("table", (0, 0, 0), (0, 0, 0, 1), (convex_solids.cylinder(0.5, 0.02),), is_free=False)
    (surface,) = find_supports(SceneFile("a.xml", "", "initial", (disc, body("a", (0, 0, 0.07)))))
    assert 0.94 * 0.5 < np.prod(surface.size_xy) <= 0.5  # the largest one in a disc is a square of half a square metre
    corners = np.array([[x, y] for x in (0, surface.size_xy[0]) for y in (0, surface.size_xy[1])])
    placed = Rotation.from_euler("z", surface.yaw).apply(np.column_stack([corners, np.zeros(4)])) + surface.origin
    assert (np.linalg.norm(placed[:, :2], axis=1) <= 0.5 + 1e-3).all()


def test_bodies_over_nothing_are_refused() -> None:
    with pytest.raises(SceneError) as caught:
        find_supports(SceneFile("a.xml", "", "initial", (body("a", (0, 0, 0)),)))
    assert caught.value.code == "no_table"


def test_obstacles_are_near_and_above_the_surface() -> None:
    bodies = (
        table(),
        body("leg", (0.1, 0.0, -0.3), is_free=False),
        body("arm", (0.5, 0.0, 0.3), is_free=False),
        body("far", (5.0, 0.0, 0.1), is_free=False),
        body("cube", (0.5, 0.2, 0.05)),
    )
    (imported,) = scenes_of_file(SceneFile("a.xml", "", "initial", bodies))
    assert [o.description for o in imported.scene.objects] == ["cube", "arm"]
    assert imported.scene.fixed == {imported.scene.objects[1].instance}


def test_the_audit_sees_the_scene_of_the_file(tmp_path: Path) -> None:
    write_corner(tmp_path)
    (imported,) = scenes_of_file(read_mjcf_scene(Boundary(tmp_path), "scene.xml").file)
    assets = SceneAssets()
    assets.add([imported])
    scene, shapes, notices = AssetStore(assets).resolved(imported.scene)
    audit = audit_scene(scene, shapes)
    name_of = {o.instance: o.description for o in scene.objects}
    assert not notices
    assert [{name_of[p.first], name_of[p.second]} for p in audit.pairs if p.penetration] == [{"box_a", "box_b"}]
    assert {name_of[o.instance] for o in audit.objects if o.floats} == {"floating"}
    assert audit.card().num_objects == 6
    assert audit.card().table_penetration_mm == pytest.approx(8.6, abs=0.05)
    assert audit.card().out_of_bounds_rate == 0
    assert scene_from_row(scene_row(scene)) == scene
    assert not moved_bodies([scene])


angles = st.floats(-math.pi, math.pi)
lengths = st.floats(-2, 2)


@settings(max_examples=40, deadline=None)
@given(
    st.tuples(lengths, lengths, lengths),
    st.tuples(angles, angles, angles),
    angles,
    st.tuples(lengths, lengths, lengths),
    angles,
)
def test_moved_poses_go_back_exactly(
    place: Vec3, turn: tuple[float, float, float], yaw: float, goal: Vec3, spin: float
) -> None:
    x, y, z = Rotation.from_euler("z", yaw).apply([0.2, 0.1, 0.0]) + place
    quat = quat_of(Rotation.from_euler("xyz", turn))
    file = SceneFile("a.xml", "", "initial", (table(place, yaw), body("cube", (x, y, z + 0.1), quat)))
    (imported,) = scenes_of_file(file)
    scene = imported.scene
    cube, mesh = scene.objects[0], next(iter(imported.assets.values())).mesh
    assert not has_moved(cube)
    wanted = quat_of(Rotation.from_euler("z", spin) * Rotation.from_quat(quat))
    moved = settled_object(cube, mesh, scene, (goal, wanted))
    found = moved_bodies([scene.__class__(scene.scene_id, scene.table, (moved,), source=scene.source)])["cube"]
    np.testing.assert_allclose(found[0], goal, atol=1e-9)
    assert (Rotation.from_quat(found[1]) * Rotation.from_quat(wanted).inv()).magnitude() < 1e-7


def test_removed_objects_cannot_be_written() -> None:
    (imported,) = scenes_of_file(SceneFile("a.xml", "", "initial", (table(), body("cube", (0.5, 0.2, 0.05)))))
    scene = imported.scene
    with pytest.raises(SceneError) as caught:
        moved_bodies([scene.__class__(scene.scene_id, scene.table, (), source=scene.source)])
    assert caught.value.code == "object_dropped"


def test_equal_shapes_of_one_kind_are_one_asset() -> None:
    bodies = (table(), body("cube_1", (0.3, 0.2, 0.05)), body("cube_2", (0.6, 0.2, 0.05), yaw_quat(1.0)))
    (imported,) = scenes_of_file(SceneFile("a.xml", "", "initial", bodies))
    assert len(imported.assets) == 1
    assert [o.instance for o in imported.scene.objects] == ["0_cube_0", "1_cube_1"]
