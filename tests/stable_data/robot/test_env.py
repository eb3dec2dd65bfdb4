"""The robot's environment: gymnasium's own check, the same episode for the same seed, tasks that are fulfilled, bad input."""

import os
from dataclasses import replace
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env
from gymnasium.vector import AutoresetMode

from stable_data.condition import ConditionKind, GoalCondition
from stable_data.errors import ConfigError, GoalError, SceneError
from stable_data.robot.acting.recording import Lead, record_episode, replay
from stable_data.robot.env import Observation, RobotEnv, RobotOptions, make_robot_env
from stable_data.robot.envhub import make_suites, write_envhub
from stable_data.robot.episodes import Episode, EpisodeError
from stable_data.robot.observation import ENVIRONMENT_STATE_NAMES, GOAL_PART, POINTS, POINTS_PART, SLOT_SIZE
from stable_data.robot.pick_tasks import pick_order, with_pick_task
from stable_data.robot.randomization import RandomizationOptions
from stable_data.robot.vector import make_vector_env, scenes_by_task
from stable_data.scene import Scene, Tabletop, TaskInfo
from stable_data.simulation.offscreen import can_render
from stable_data.simulation.scene_geometry import SceneGeometry
from stable_data.storage.run_folder import RunFolder
from tests.bounds import limit
from tests.stable_data.export.runs import thing, write_run
from tests.stable_data.robot.tables import BOX, CAN, MUG, PLATE, TABLE, laid_table

SIMPLE = RobotOptions(robot="simple")


def asked(geometry: SceneGeometry, *conditions: GoalCondition) -> SceneGeometry:
    """The scene with a task of these conditions."""
    names = tuple(dict.fromkeys(name for c in conditions for name in c.subjects))
    task = TaskInfo("A kitchen.", "Do it.", goal=("It is done.",), task_objects=names, conditions=conditions)
    return replace(geometry, scene=replace(geometry.scene, task=task))


@pytest.fixture
def picking(geometry: SceneGeometry) -> RobotEnv:
    return RobotEnv(with_pick_task(geometry, CAN), options=SIMPLE)


def test_it_passes_gymnasiums_own_check(picking: RobotEnv) -> None:
    check_env(picking, skip_render_check=True)


def test_observations_say_where_the_object_is(picking: RobotEnv) -> None:
    observation, info = picking.reset(seed=3)
    assert info == {"is_success": False, "scene_id": "laid", "instruction": "Pick up the can.", "task_kind": "pick"}
    state = observation["environment_state"]
    assert state.shape == (len(ENVIRONMENT_STATE_NAMES),)
    can = picking.scene[CAN]
    assert state[0] == 1.0
    assert picking.built.mount.to_scene(state[1:4].astype(np.float64)) == pytest.approx(np.array(can.position), abs=1e-5)
    assert state[10:13] == pytest.approx(can.size, abs=1e-5)
    near = [state[k * SLOT_SIZE] for k in range(1, 4)]
    assert near == [1.0, 1.0, 1.0]
    assert state[GOAL_PART] == pytest.approx(0.0)  # it is to be put nowhere
    points = picking.built.mount.to_scene(state[POINTS_PART].reshape(POINTS, 3).astype(np.float64)) - can.position
    assert np.abs(points).max(axis=0) == pytest.approx(
        np.array(can.size) / 2, rel=0.1
    )  # all over the surface, upright as it is
    position, _ = picking.built.tool_pose(picking.world.data)
    names = picking.controller.names
    assert observation["agent_pos"][8:11] == pytest.approx(position, abs=1e-5)
    assert names[-1] == "opening"


def test_the_same_seed_gives_the_same_episode(picking: RobotEnv) -> None:
    def states(seed: int) -> np.ndarray[Any, Any]:
        observation, _ = picking.reset(seed=seed)
        picking.action_space.seed(0)
        after = [picking.step(picking.action_space.sample())[0]["agent_pos"] for _ in range(8)]
        return np.array([observation["agent_pos"], *after])

    assert np.array_equal(states(1), states(1))
    assert not np.array_equal(states(1), states(2))


@pytest.fixture(scope="module")
def picked(geometry: SceneGeometry) -> Episode:
    return record_episode(RobotEnv(with_pick_task(geometry, CAN), options=SIMPLE), number=0, seed=5, split="train", noise=0.05)


def test_the_expert_picks_and_everything_is_recorded(picked: Episode) -> None:
    assert (picked.success, picked.reason, picked.task_kind, picked.split) == (True, None, "pick", "train")
    assert picked.rewards[-1] == 1.0
    assert (np.diff(picked.rewards) > -0.5).all()
    can = picked.instances.index(CAN)
    assert picked.object_poses[-1, can, 2] > picked.object_poses[0, can, 2] + 0.02
    others = [k for k in range(len(picked.instances)) if k != can]
    assert picked.object_poses[-1, others, :3] == pytest.approx(picked.object_poses[0, others, :3], abs=0.01)


def test_a_replay_gives_the_same_states(picked: Episode, geometry: SceneGeometry) -> None:
    env = RobotEnv(with_pick_task(geometry, CAN), options=SIMPLE)
    again = replay(env, picked)
    assert again.object_poses == pytest.approx(picked.object_poses, abs=1e-6)
    assert again.is_success


def test_a_replay_that_misses_its_goal_says_so(picked: Episode, geometry: SceneGeometry) -> None:
    assert not replay(RobotEnv(with_pick_task(geometry, MUG), options=SIMPLE), picked).is_success


class _Still:
    """A policy that keeps still with an open hand, and counts how often it was asked."""

    num_asked = 0

    def reset(self) -> None:
        """Nothing is kept."""

    def act(self, observation: Observation) -> np.ndarray[Any, Any]:
        self.num_asked += 1
        return np.array([0.0] * 6 + [0.05])


def test_the_expert_goes_on_from_where_a_policy_came_to(geometry: SceneGeometry) -> None:
    env, policy = RobotEnv(with_pick_task(geometry, CAN), options=SIMPLE), _Still()
    led = record_episode(env, number=0, seed=5, lead=Lead(policy, "still", most_actions=20))
    assert policy.num_asked > 0
    assert (led.lead, led.policy, led.reason) == ("still", None, None)
    with pytest.raises(EpisodeError, match="policy still acted before the first action") as refused:
        replay(env, led)
    assert refused.value.code == "episode_led"
    alone = record_episode(env, number=0, seed=5, lead=Lead(policy, "still", most_actions=0))
    assert alone.lead is None
    assert replay(env, alone).object_poses == pytest.approx(alone.object_poses, abs=1e-6)


@pytest.mark.parametrize(
    ("kind", "condition"),
    [
        ("place_on", GoalCondition(CAN, ConditionKind.ON, PLATE)),
        ("place_beside", GoalCondition(CAN, ConditionKind.RIGHT_OF, MUG)),
        ("move", GoalCondition(CAN, ConditionKind.AT, "left")),
        ("hand_over", GoalCondition(CAN, ConditionKind.HELD, "front_edge")),
    ],
)
def test_the_expert_places(kind: str, condition: GoalCondition, geometry: SceneGeometry) -> None:
    env = RobotEnv(asked(geometry, condition), options=SIMPLE)
    episode = record_episode(env, number=0, seed=1)
    assert (episode.task_kind, episode.reason) == (kind, None)


def test_what_cannot_be_grasped_is_a_failure_with_its_reason(geometry: SceneGeometry) -> None:
    env = RobotEnv(with_pick_task(geometry, PLATE), options=replace(SIMPLE, max_steps=60))
    episode = record_episode(env, number=0, seed=1)
    if not episode.success:
        assert episode.reason is not None
        assert PLATE in episode.reason or episode.reason == "too_long"


def test_randomisation_varies_by_seed_and_is_recorded(geometry: SceneGeometry) -> None:
    varied = RandomizationOptions(light=0.3, colours=0.3, friction=0.3, mass=0.3, cameras=0.02, start=0.05)
    env = RobotEnv(with_pick_task(geometry, CAN), options=replace(SIMPLE, randomization=varied))
    mass = env.built.model.body_mass[1]
    drawn = []
    for seed in (1, 2, 1):
        env.reset(seed=seed)
        assert env.drawn is not None
        drawn.append((env.drawn.text, float(env.built.model.body_mass[1]), env.built.model.cam_pos.copy()))
    assert drawn[0][:2] == drawn[2][:2] != drawn[1][:2]
    assert np.array_equal(drawn[0][2], drawn[2][2])
    assert 0.7 * mass <= drawn[0][1] <= 1.3 * mass
    assert env.drawn is not None
    assert set(env.drawn.document) == {"light", "factors", "cameras", "start"}


def test_nothing_varies_without_randomisation(geometry: SceneGeometry) -> None:
    env = RobotEnv(with_pick_task(geometry, CAN), options=replace(SIMPLE, randomization=RandomizationOptions(start=0.0)))
    assert np.array_equal(env.reset(seed=1)[0]["agent_pos"], env.reset(seed=2)[0]["agent_pos"])
    assert env.drawn is not None
    assert env.drawn.document == {}


@pytest.mark.parametrize("camera", ["wrist", "front", "top"])
def test_pictures_show_the_scene(camera: str, geometry: SceneGeometry) -> None:
    if not can_render():
        pytest.skip("the machine cannot render")
    env = RobotEnv(with_pick_task(geometry, CAN), options=replace(SIMPLE, cameras=(camera,), image_size=(64, 48)))
    picture = env.reset(seed=0)[0]["pixels"][camera]
    assert picture.shape == (48, 64, 3)
    assert picture.std() > 10
    env.close()


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"robot": "ur99"}, "robot is 'ur99'"),
        ({"cameras": ("roof",)}, "cameras"),
        ({"max_steps": 0}, "max_steps is 0"),
        ({"mount": "roof"}, "mount is"),
        ({"control": "thought"}, "control is"),
        ({"image_size": (0, 5)}, "image_size"),
    ],
)
def test_options_that_cannot_be_are_refused(options: dict[str, Any], message: str, geometry: SceneGeometry) -> None:
    with pytest.raises(ConfigError, match=message):
        RobotEnv(with_pick_task(geometry, CAN), options=RobotOptions(**({"robot": "simple"} | options)))


@pytest.mark.parametrize("value", [-0.1, 1.0, float("nan")])
def test_amounts_that_make_no_sense_are_refused(value: float) -> None:
    with pytest.raises(ConfigError, match=r"randomization\.mass"):
        RandomizationOptions(mass=value)


def test_a_scene_without_a_goal_says_so(geometry: SceneGeometry) -> None:
    with pytest.raises(GoalError) as error:
        RobotEnv(replace(geometry, scene=replace(geometry.scene, task=None)), options=SIMPLE)
    assert error.value.code == "no_task"


def test_a_robot_that_starts_in_something_is_refused(tmp_path: Path) -> None:
    tower = thing("cereal_box/0", BOX, 0.5, 0.2, 0.0, scale=(2.0, 2.0, 2.4))
    scene = Scene("tower", TABLE, (tower, thing("can/0", CAN, 0.2, 0.3, 0.0)))
    run = write_run(tmp_path / "run", (scene,))
    with pytest.raises(SceneError, match="touches") as error:
        make_robot_env(run.uri, replace(scene, task=_pick()), robot="simple", mount="front")
    assert error.value.code == "robot_start_collides"


def _pick() -> TaskInfo:
    return TaskInfo("", "Pick up the can.", task_objects=(CAN,), conditions=(GoalCondition(CAN, ConditionKind.HELD),))


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> RunFolder:
    one = replace(laid_table(), task=_pick())
    other = replace(one, scene_id="other", objects=tuple(o for o in one.objects if o.instance != MUG))
    bare = Scene("bare", Tabletop("desk", (0.8, 0.6)), ())
    return write_run(tmp_path_factory.mktemp("vector") / "run", (one, other, bare))


def test_scenes_follow_each_other_at_once(run: RunFolder) -> None:
    assert scenes_by_task(run.uri) == {"pick": ["laid", "other"]}
    envs = make_vector_env(run.uri, ["laid", "other"], 1, robot="simple", max_steps=2)
    assert envs.metadata["autoreset_mode"] is AutoresetMode.SAME_STEP
    _, info = envs.reset(seed=[0])
    assert info["scene_id"].tolist() == ["laid"]
    for _ in range(2):
        observation, _, _, truncated, info = envs.step(np.zeros((1, 7), np.float32))
    assert truncated.tolist() == [True]
    assert info["final_info"]["is_success"].tolist() == [False]
    assert info["final_info"]["scene_id"].tolist() == ["laid"]
    assert info["scene_id"].tolist() == ["other"]
    assert envs.observation_space.contains(observation)
    assert envs.call("task_description") == ("Pick up the can.",)
    envs.close()


def test_a_scene_can_be_named(run: RunFolder) -> None:
    env = gymnasium.make("stable_data.robot.env:stable_data/Robot-v0", run=run.uri, scene="other", robot="simple")
    assert env.reset(seed=0)[1]["scene_id"] == "other"
    env.close()


def test_a_folder_for_envhub_makes_environments(run: RunFolder, tmp_path: Path) -> None:
    out = tmp_path / "hub"
    assert write_envhub(run, out, None, SIMPLE) == {"pick": 2}
    suites = make_suites(out, 2)
    assert list(suites) == ["pick"]
    observation, _ = suites["pick"][0].reset(seed=[0, 1])
    assert observation["environment_state"].shape[0] == 2
    suites["pick"][0].close()
    with pytest.raises(ConfigError, match="not empty"):
        write_envhub(run, out, None, SIMPLE)
    (out / "settings.json").write_text('{"robot": {}}', "utf-8")
    with pytest.raises(ConfigError, match=r"settings\.json: is no settings file"):
        make_suites(out)


def test_settings_of_an_envhub_folder_are_read_with_a_limit(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "settings.json").write_text('{"robot": {}, "scenes": {}}' + " " * 1000, "utf-8")
    limit(monkeypatch, "text", max_document_bytes=1000)
    with pytest.raises(ConfigError, match="is larger, expected at most"):
        make_suites(tmp_path)
    (tmp_path / "settings.json").unlink()
    os.mkfifo(tmp_path / "settings.json")
    with pytest.raises(ConfigError, match="not a regular file"):
        make_suites(tmp_path)


def test_a_run_without_goals_makes_no_folder(tmp_path: Path) -> None:
    run = write_run(tmp_path / "run", (replace(laid_table(), task=None),))
    with pytest.raises(ConfigError, match="stable-data tasks") as error:
        write_envhub(run, tmp_path / "hub", None, SIMPLE)
    assert error.value.code == "no_goal"


def test_carriers_are_not_drawn_for_picks() -> None:
    scene = laid_table()
    stacked = replace(scene, objects=(replace(scene.objects[0], support=PLATE), *scene.objects[1:]))
    assert PLATE not in pick_order(stacked, np.random.default_rng(0))
    assert set(pick_order(scene, np.random.default_rng(0))) == {CAN, MUG, BOX, PLATE}
