"""Scenes as Gymnasium environments: they pass its own check, repeat themselves, and the hand pushes."""

import ctypes.util
import os
import re
import subprocess
import sys
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env

from stable_data.assets.run_assets import run_store
from stable_data.assets.store import AssetStore
from stable_data.errors import ConfigError, SceneError
from stable_data.scene import FloatArray, Scene
from stable_data.simulation.gym_env import HAND_RADIUS, HAND_SPEED, STEP_SECONDS, Observation, TabletopEnv, make_env
from stable_data.simulation.scene_geometry import SceneGeometry
from stable_data.storage.run_folder import RunFolder
from stable_data.storage.torch_dataset import TableDataset
from tests.stable_data.export.runs import EMPTY, ODD, SCENES, TABLE, at_rest, falling, thing, write_run

pytestmark = pytest.mark.sim

DOC = Path(__file__).parents[3] / "docs" / "loading.md"
RIGHT = np.array([1.0, 0.0, 0.0], np.float32)
STAY = np.zeros(3, np.float32)


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> RunFolder:
    return write_run(tmp_path_factory.mktemp("environment") / "run")


@pytest.fixture(scope="module")
def store(run: RunFolder) -> AssetStore:
    return run_store(run.uri)


def env_of(scene: Scene, store: AssetStore, **settings: Any) -> TabletopEnv:
    return TabletopEnv(SceneGeometry.of(scene, store), **settings)


def drawn(env: TabletopEnv, **rest: Any) -> Observation:
    """The first observation of an environment with pictures."""
    try:
        return env.reset(**rest)[0]
    except ConfigError as error:
        if error.code == "no_gl":
            pytest.skip(str(error))
        raise


def positions(observation: Observation) -> FloatArray:
    return np.asarray(observation["objects"][:, :3], np.float64)


@pytest.mark.parametrize("scene", [scene.scene_id for scene in SCENES])
def test_it_passes_gymnasiums_own_check(scene: str, run: RunFolder) -> None:
    check_env(gymnasium.make("stable_data.simulation.gym_env:stable_data/Tabletop-v0", run=run.uri, scene=scene).unwrapped)


def test_it_passes_with_pictures(run: RunFolder) -> None:
    settings: dict[str, Any] = {"cameras": ("front", "top"), "image_size": (48, 32), "render_mode": "rgb_array"}
    env = gymnasium.make("stable_data.simulation.gym_env:stable_data/Tabletop-v0", run=run.uri, scene=ODD, **settings)
    assert isinstance(env.unwrapped, TabletopEnv)
    drawn(env.unwrapped)
    check_env(env.unwrapped)


def test_a_reset_puts_everything_where_the_scene_has_it(store: AssetStore) -> None:
    scene = at_rest()
    env = env_of(scene, store)
    for seed in (0, 1):
        observation, info = env.reset(seed=seed)
        np.testing.assert_allclose(positions(observation), scene.poses()[:, :3], atol=1e-6)
        yaws = 2 * np.arctan2(observation["objects"][:, 5], observation["objects"][:, 6])
        np.testing.assert_allclose(yaws, scene.poses()[:, 3], atol=1e-6)
        for _ in range(10):
            env.step(np.array([0.3, 0.2, -1.0], np.float32))
    assert info["scene_id"] == ODD
    assert info["instruction"] == "Put the can on the plate."
    assert info["instances"] == tuple(o.instance for o in scene.objects)
    assert info["fallen"] == ()


def test_a_scene_at_rest_stays(store: AssetStore) -> None:
    env = env_of(at_rest(), store)
    first, _ = env.reset(seed=0)
    for _ in range(20):
        last, reward, terminated, truncated, _ = env.step(STAY)
    np.testing.assert_allclose(positions(last), positions(first), atol=1e-3)
    np.testing.assert_array_equal(last["hand"], first["hand"])
    assert (reward, terminated, truncated) == (0.0, False, False)


def test_the_same_seed_gives_the_same_episode(store: AssetStore) -> None:
    rng = np.random.default_rng(0)
    actions = rng.uniform(-1, 1, (15, 3)).astype(np.float32)

    def episode(seed: int) -> FloatArray:
        env = env_of(falling(), store)
        seen = [env.reset(seed=seed)[0], *(env.step(action)[0] for action in actions)]
        return np.array([np.concatenate([o["objects"].ravel(), o["hand"]]) for o in seen], np.float64)

    np.testing.assert_array_equal(episode(3), episode(3))
    assert (episode(3)[0, -3:] != episode(4)[0, -3:]).any()


def test_the_hand_goes_as_it_is_told_and_no_farther_than_it_may(store: AssetStore) -> None:
    env = env_of(at_rest(), store, max_steps=1000)
    start, _ = env.reset(options={"hand": (0.5, 0.4, 0.3)})
    np.testing.assert_allclose(start["hand"], (0.5, 0.4, 0.3), atol=1e-6)
    moved, *_ = env.step(5 * RIGHT)  # more than 1 counts as 1
    np.testing.assert_allclose(moved["hand"] - start["hand"], HAND_SPEED * STEP_SECONDS * RIGHT, atol=1e-6)
    for _ in range(100):
        last, *_ = env.step(np.array([-1.0, 1.0, 1.0], np.float32))
    assert env.observation_space.contains(last)


def test_the_hand_pushes_what_is_in_its_way_and_nothing_else(store: AssetStore) -> None:
    scene = at_rest()
    env = env_of(scene, store)
    can = scene.objects[0].position
    before, _ = env.reset(options={"hand": (can[0] - 0.07, can[1], 0.03)})
    for _ in range(16):
        after, *_ = env.step(RIGHT)
    moves = np.linalg.norm(positions(after) - positions(before), axis=1)
    assert moves[0] > 0.05
    assert moves[1:].max() < 2e-3


def test_what_is_pushed_off_the_table_has_fallen(store: AssetStore) -> None:
    can = thing("can/0", "0_can_0", 1.15, 0.3, 0.0)
    env = env_of(Scene("edge", TABLE, (can,)), store)
    env.reset(options={"hand": (1.07, 0.3, 0.03)})
    for _ in range(30):
        info = env.step(RIGHT)[-1]
    assert info["fallen"] == ("0_can_0",)


def test_the_reward_sees_what_was_and_what_is(store: AssetStore) -> None:
    env = env_of(at_rest(), store, reward=lambda before, after: float(after["hand"][0] - before["hand"][0]), max_steps=2)
    env.reset(options={"hand": (0.5, 0.4, 0.3)})
    _, reward, _, truncated, _ = env.step(RIGHT)
    assert reward == pytest.approx(HAND_SPEED * STEP_SECONDS, abs=1e-6)
    assert not truncated
    assert env.step(RIGHT)[3]


def test_pictures_show_what_moves(store: AssetStore) -> None:
    env = env_of(at_rest(), store, cameras=("top",), image_size=(64, 48), render_mode="rgb_array")
    first = drawn(env, options={"hand": (0.5, 0.4, 0.3)})
    again = drawn(env, options={"hand": (0.5, 0.4, 0.3)})
    moved, *_ = env.step(RIGHT)
    assert first["top"].shape == (48, 64, 3)
    np.testing.assert_array_equal(first["top"], again["top"])
    assert (first["top"] != moved["top"]).any()
    picture = env.render()
    assert picture is not None
    assert picture.shape == (48, 64, 3)
    env.close()
    assert env_of(at_rest(), store).render() is None


def test_an_empty_scene_is_a_table_and_a_hand(store: AssetStore) -> None:
    observation, _ = env_of(EMPTY, store).reset(seed=0)
    assert observation["objects"].shape == (0, 7)
    assert observation["hand"][2] >= HAND_RADIUS


def test_settled_objects_lie_where_the_engine_left_them(run: RunFolder, store: AssetStore) -> None:
    scene = TableDataset(run.uri, where="scene_id == 'falling'")[0]
    for env in (make_env(run.uri, scene, settled=True, store=store), make_env(run.uri, "falling", settled=True)):
        first, _ = env.reset(seed=0)
        assert abs(positions(first) - scene.poses()[:, :3]).max() > 0.005
        for _ in range(10):
            last, *_ = env.step(STAY)
        np.testing.assert_allclose(positions(last), positions(first), atol=1e-3)
    with pytest.raises(SceneError, match="no settled pose"):
        make_env(run.uri, Scene("unheard of", TABLE, falling().objects), settled=True, store=store)


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"cameras": ("left",)}, "cameras ['left'] are not known, expected some of front, top"),
        ({"max_steps": 0}, "max_steps is 0, expected at least 1"),
        ({"render_mode": "human"}, "render_mode is 'human', expected rgb_array or None"),
    ],
)
def test_settings_that_cannot_be_are_refused(settings: dict[str, Any], message: str, store: AssetStore) -> None:
    with pytest.raises(ConfigError, match=re.escape(message)):
        env_of(EMPTY, store, **settings)


@pytest.mark.parametrize("action", [[np.nan, 0.0, 0.0], [0.0, 0.0], [[0.0, 0.0, 0.0]], [np.inf, 0.0, 0.0]])
def test_an_action_that_is_none_is_refused_and_moves_nothing(action: list[Any], store: AssetStore) -> None:
    env = env_of(EMPTY, store)
    before, _ = env.reset(seed=0)
    with pytest.raises(ValueError, match="expected three finite numbers"):
        env.step(np.array(action, np.float32))
    after, *_ = env.step(np.zeros(3, np.float32))
    assert (after["hand"] == before["hand"]).all()


def test_without_a_display_it_is_said_that_mujoco_came_too_early(run: RunFolder) -> None:
    if ctypes.util.find_library("EGL") is None:
        pytest.skip("this machine has no EGL")
    code = (
        "import sys, mujoco; from stable_data.simulation.gym_env import make_env; "
        "make_env(sys.argv[1], sys.argv[2], cameras=('front',)).reset(seed=0)"
    )
    without = {k: v for k, v in os.environ.items() if k not in ("MUJOCO_GL", "DISPLAY", "WAYLAND_DISPLAY")}
    words = [sys.executable, "-c", code, run.uri, EMPTY.scene_id]
    found = subprocess.run(words, capture_output=True, text=True, check=False, env=without, cwd=DOC.parents[1])
    assert "import stable_data.simulation.gym_env before mujoco, or set MUJOCO_GL=egl for both" in found.stderr


def test_a_scene_that_the_run_does_not_have_is_refused(run: RunFolder) -> None:
    with pytest.raises(ConfigError, match="the run has no scenes"):
        make_env(run.uri, "nowhere")


def test_the_documented_training_runs(run: RunFolder) -> None:
    [block] = [b for b in re.findall(r"```python\n(.*?)```", DOC.read_text("utf-8"), re.DOTALL) if "make_env" in b]
    names: dict[str, Any] = {"RUN": run.uri}
    exec(block, names)  # noqa: S102
    assert names["truncated"]
    assert names["policy"].weight.grad.isfinite().all()
    assert names["policy"].weight.grad.abs().max() > 0
