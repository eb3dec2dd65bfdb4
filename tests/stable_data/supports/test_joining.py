"""Scenes on one piece of furniture become one scene."""

import mujoco
import numpy as np
import pytest

from stable_data.errors import SceneError
from stable_data.rotations import rotate_xy
from stable_data.scene import Scene, SceneObject, SupportFrame, Tabletop
from stable_data.simulation.mujoco_model import engine_spec
from stable_data.simulation.scene_geometry import SceneGeometry
from stable_data.simulation.settling import compile_spec
from stable_data.supports import join_scenes
from tests.models.physics_corrector.geometry.shapes import store

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
    assert {o.instance for o in joined.objects} == {"top_cube_0", "shelf_1_cube_0", "top_board", "shelf_1_board"}
    assert joined.fixed == {"top_board", "shelf_1_board"}
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
        assert joined[f"{scene.frame.surface}_board"].top == pytest.approx(now.bottom)
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


def test_scenes_on_two_pieces_are_not_joined() -> None:
    with pytest.raises(SceneError, match="one support"):
        join_scenes([on_board("top", 1.2, 0.0), on_board("top", 1.2, 0.0, "shelf_8")], LOW, HIGH)
    alone = Scene("s", Tabletop("table", (1.0, 1.0)), ())
    with pytest.raises(SceneError, match="one support"):
        join_scenes([alone], LOW, HIGH)
