"""Scenes on one piece of furniture become one scene."""

from dataclasses import replace

import mujoco
import numpy as np
import pytest

from stable_data.errors import SceneError
from stable_data.geometry.mesh import Mesh, join_meshes
from stable_data.importers.scenes.layouts import fixed_scene
from stable_data.rotations import rotate_xy
from stable_data.scene import Scene, SceneObject, SupportFrame, Tabletop
from stable_data.simulation.mujoco_model import engine_spec
from stable_data.simulation.scene_geometry import SceneGeometry
from stable_data.simulation.settling import compile_spec
from stable_data.supports import as_tabletop, find_obstacles, find_surfaces, join_scenes, seen_from_open_side
from tests.models.physics_corrector.geometry.shapes import store
from tests.stable_data.supports.furniture import box, counter_with_sink, shelf

LOW, HIGH = np.array([-0.4, -0.15, 0.0]), np.array([0.4, 0.15, 1.2])


def on_board(name: str, height: float, yaw: float, support: str = "shelf_7") -> Scene:
    """A scene with one box of 10 cm, 20 cm from the left and 10 cm from the near edge."""
    x, y = rotate_xy(np.array([[-0.4, -0.15]]), yaw)[0].tolist()
    box = SceneObject("cube_0", "cube", (0.2, 0.1, 0.05), 0.3, (0.1, 0.1, 0.1), support="table")
    frame = SupportFrame(support, name, (x, y, height), yaw)
    return Scene(f"s_{name}", Tabletop("shelf", (0.8, 0.3)), (box,), frame=frame)


@pytest.mark.parametrize("yaw", [0.0, 0.7])
def test_joined_objects_are_where_they_were_on_the_support(yaw: float) -> None:
    scenes = [on_board("top", 1.2, yaw), on_board("shelf_1", 0.5, yaw + np.pi)]
    joined = join_scenes(scenes, LOW, HIGH)
    assert joined.scene_id == "shelf_7"
    assert {o.instance for o in joined.objects} == {"top_cube_0", "shelf_1_cube_0", "top_board_0", "shelf_1_board_0"}
    assert joined.fixed == {"top_board_0", "shelf_1_board_0"}
    frame = joined.frame
    assert frame is not None
    for scene in scenes:
        assert scene.frame is not None
        now = joined[f"{scene.frame.surface}_cube_0"]
        on_support = [
            np.append(rotate_xy(np.array([o.position[:2]]), f.yaw)[0], o.position[2]) + f.origin
            for o, f in ((scene["cube_0"], scene.frame), (now, frame))
        ]
        np.testing.assert_allclose(on_support[0], on_support[1], atol=1e-12)
        assert np.cos(now.yaw + frame.yaw - scene["cube_0"].yaw - scene.frame.yaw) == pytest.approx(1.0)
        assert joined[f"{scene.frame.surface}_board_0"].top == pytest.approx(now.bottom)
    assert joined["top_cube_0"].bottom == pytest.approx(1.2)  # above the floor


def test_a_joined_scene_stays_at_rest_in_mujoco() -> None:
    joined = join_scenes([on_board("top", 1.2, 0.0), on_board("shelf_1", 0.5, np.pi)], LOW, HIGH)
    model = compile_spec(engine_spec(SceneGeometry.of(joined, store())))
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    before = data.xpos.copy()
    for _ in range(500):
        mujoco.mj_step(model, data)
    np.testing.assert_allclose(data.xpos, before, atol=1e-3)


def sheet_shelf() -> Mesh:
    """Boards of 3 mm at 0.1 and 0.4 m between side walls, and a top of 3 mm."""
    sides = [box((x, 0.0, 0.0), (x + 0.02, 0.3, 0.7)) for x in (0.0, 0.78)]
    return join_meshes([*sides, *(box((0.02, 0.0, z), (0.78, 0.3, z + 0.003)) for z in (0.1, 0.4, 0.697))])


def stepped_desk() -> Mesh:
    """The back of the desk is 7 cm higher."""
    return join_meshes([box((0.0, 0.0, 0.7), (1.2, 0.6, 0.73)), box((0.0, 0.35, 0.73), (1.2, 0.6, 0.8))])


def desk_with_riser() -> Mesh:
    """A sheet of 5 mm on legs, 17 cm above the back of a desk."""
    legs = [box((x, 0.35, 0.73), (x + 0.005, 0.6, 0.9)) for x in (0.0, 1.195)]
    return join_meshes([box((0.0, 0.0, 0.7), (1.2, 0.6, 0.73)), box((0.0, 0.35, 0.9), (1.2, 0.6, 0.905)), *legs])


def full_scenes(support: Mesh) -> list[Scene]:
    """A scene on each surface; bars as high as there is room, up to 30 cm, stand at its corners and in its middle."""
    scenes = []
    for surface in find_surfaces(support):
        fit = seen_from_open_side(support, surface, as_tabletop(surface))
        table, frame = fit.tabletop, fit.frame(surface, "piece", "piece")
        empty = fixed_scene(surface.name, table, frame, find_obstacles(support, frame, table), "shelf").scene
        (width, depth), high = table.size_xy, min(0.3, (table.clearance or 1.0) - 0.002)
        places = [(x, y) for x in (0.02, width / 2, width - 0.02) for y in (0.02, depth / 2, depth - 0.02)]
        if table.restricted_zone is not None:
            places.pop(4)  # its middle is the sink
        bars = [SceneObject(f"bar_{k}", "bar", (x, y, high / 2), 0.0, (0.03, 0.03, high)) for k, (x, y) in enumerate(places)]
        scenes.append(replace(empty, objects=(*empty.objects, *bars)))
    return scenes


@pytest.mark.parametrize("support", [shelf(), sheet_shelf(), stepped_desk(), desk_with_riser(), counter_with_sink()])
def test_what_is_fixed_for_one_surface_takes_no_room_from_another(support: Mesh) -> None:
    """The bodies of the furniture are thicker than it: through a thin board they would reach into what stands on it."""
    scenes = full_scenes(support)
    joined = join_scenes(scenes, support.vertices.min(axis=0), support.vertices.max(axis=0))
    assert len(joined.movable) == sum(len(scene.movable) for scene in scenes) > 16
    assert len(scenes) > 1

    def box_of(o: SceneObject) -> tuple[np.ndarray, np.ndarray]:
        half = np.array(o.size) / 2
        half[:2] = half[1::-1] if abs(np.sin(o.yaw)) > 0.5 else half[:2]
        return o.position - half, o.position + half

    for o in joined.movable:
        for fixed in joined.surroundings:
            (low, high), (start, end) = box_of(o), box_of(fixed)
            shared = np.minimum(high, end) - np.maximum(low, start)
            assert shared.min() < 5e-4, (o.instance, fixed.instance, shared)


def test_scenes_on_two_pieces_are_not_joined() -> None:
    with pytest.raises(SceneError, match="one support"):
        join_scenes([on_board("top", 1.2, 0.0), on_board("top", 1.2, 0.0, "shelf_8")], LOW, HIGH)
    alone = Scene("s", Tabletop("table", (1.0, 1.0)), ())
    with pytest.raises(SceneError, match="one support"):
        join_scenes([alone], LOW, HIGH)
