"""A policy that sees pictures: small ones, and without objects nothing of their states."""

import io
from dataclasses import replace

import numpy as np
import pytest
import torch
from PIL import Image

from models.policy.chunk_policy import Policy
from models.policy.network import PolicyNetwork, PolicyShape
from models.policy.pictures import episode_pictures, observed_pictures
from models.policy.task_frame import check_clonable
from models.policy.weights import PolicyWeights, check_environment
from stable_data.errors import ConfigError
from stable_data.robot.env import AGENT, ENVIRONMENT, PIXELS
from stable_data.robot.episodes import EpisodeError
from stable_data.robot.observation import ENVIRONMENT_STATE_NAMES
from tests.stable_data.robot.synthetic_episodes import episode

SHAPE = PolicyShape(width=16, depth=1, sees_objects=False, cameras=("front", "wrist"), picture_size=32)


def test_pictures_are_made_small_and_put_behind_each_other() -> None:
    pixels = {"wrist": np.full((48, 64, 3), 200, np.uint8), "front": np.zeros((48, 64, 3), np.uint8)}
    found = observed_pictures(pixels, ("front", "wrist"), 32)
    assert found.shape == (6, 32, 32)
    assert (found[:3] == 0).all()
    assert (found[3:] == 200).all()
    assert observed_pictures({}, (), 32).shape == (0, 32, 32)


def test_pictures_of_an_episode_are_those_that_were_observed() -> None:
    one = episode(steps=3, cameras=("front",))
    found = episode_pictures(one, ("front",), 16)
    assert found.shape == (3, 3, 16, 16)
    for k, file in enumerate(one.pictures["front"]):
        picture = np.asarray(Image.open(io.BytesIO(file)))
        assert np.array_equal(found[k], observed_pictures({"front": picture}, ("front",), 16))


@pytest.mark.parametrize("share", [0.5, 0.98])
def test_a_broken_picture_names_its_episode(share: float) -> None:
    one = episode(steps=2, cameras=("front",))
    first, second = one.pictures["front"]
    broken = replace(one, pictures={"front": (first, second[: int(share * len(second))])})
    with pytest.raises(EpisodeError, match=f"{one.episode_id}: picture 1 of camera front cannot be decoded") as caught:
        episode_pictures(broken, ("front",), 16)
    assert caught.value.code == "episode_invalid"


def test_a_policy_without_objects_sees_pictures_alone() -> None:
    torch.manual_seed(0)
    one = episode(steps=2)
    policy = Policy(PolicyWeights(PolicyNetwork(SHAPE).eval(), SHAPE, one.features, 4, None, {}))
    rng = np.random.default_rng(0)
    state = np.concatenate([np.zeros(7), [0.04, 0.4, 0.1, 0.3, 1, 0, 0, 0, 1, 0]]).astype(np.float32)
    pictures = [{name: rng.integers(0, 255, (48, 64, 3)).astype(np.uint8) for name in SHAPE.cameras} for _ in range(2)]
    worlds = rng.normal(size=(2, len(ENVIRONMENT_STATE_NAMES))).astype(np.float32)

    def actions(world: int, picture: int) -> np.ndarray:
        policy.reset()
        return policy.act({AGENT: state, ENVIRONMENT: worlds[world], PIXELS: pictures[picture]})

    assert actions(0, 0) == pytest.approx(actions(1, 0), abs=0)
    assert np.abs(actions(0, 0) - actions(0, 1)).max() > 0


def test_missing_cameras_are_named() -> None:
    features = episode(steps=2).features
    with pytest.raises(ConfigError) as caught:
        check_clonable(features, ["front"])
    assert caught.value.code == "policy_features"
    needs = episode(steps=2, cameras=("front",)).features
    with pytest.raises(ConfigError, match=r"it needs pictures of front.*--set .cameras=") as caught:
        check_environment(needs, features, "mine")
    assert caught.value.code == "policy_mismatch"


@pytest.mark.parametrize(
    ("values", "words"),
    [
        ({"cameras": ("roof",)}, "roof"),
        ({"cameras": ("front", "front")}, "each once"),
        ({"cameras": ("front",), "picture_size": 40}, "multiple of 16"),
        ({"sees_objects": False}, "would see no object"),
    ],
)
def test_a_network_that_cannot_see_is_refused(values: dict[str, object], words: str) -> None:
    with pytest.raises(ConfigError, match=words):
        PolicyShape(**values).check()  # type: ignore[arg-type]
