"""The file of a policy: one safetensors file with weights, normalisation, what it observes and commands, and what it was trained on."""

import json
import math
from collections.abc import Mapping
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from models.policy.network import PolicyNetwork, PolicyShape
from models.settings import fill_settings
from models.training.weights_file import build_no_larger_than, read_weights, save_weights
from stable_data.errors import ConfigError
from stable_data.json_text import number, quote_value
from stable_data.limits import is_out_of_memory
from stable_data.robot.episodes import EpisodeFeatures

FILE = "weights/policy.safetensors"
"""The file in the folder of a training."""

_MOST = 100_000  # actions that are carried out, and pixels of a side
_KEYS = ("network", "features", "execute", "assets")
_NAMES = ("state_names", "environment_state_names", "action_names")


@dataclass(frozen=True, slots=True, eq=False)
class PolicyWeights:
    """A trained policy.

    Attributes:
        network: The network, in evaluation mode, on the CPU.
        shape: Its shape.
        features: What it observes and commands.
        execute: Actions of a chunk that are carried out.
        assets: Assets that the demonstrations acted on; None: not known.
        notes: Further notes of the header, such as the number of demonstrations.
    """

    network: PolicyNetwork
    shape: PolicyShape
    features: EpisodeFeatures
    execute: int
    assets: frozenset[str] | None
    notes: Mapping[str, str]


def save_policy(path: Path, policy: PolicyWeights) -> None:
    """Writes a policy atomically; equal policies give equal bytes."""
    features = {name: getattr(policy.features, name) for name in ("robot", "fps", "control", *_NAMES, "cameras", "image_size")}
    header = {
        "network": json.dumps(asdict(policy.shape), sort_keys=True),
        "features": json.dumps(features, sort_keys=True),
        "execute": json.dumps(policy.execute),
        "assets": json.dumps(None if policy.assets is None else sorted(policy.assets)),
    }
    save_weights(path, policy.network.state_dict(), {**policy.notes, **header})


def load_policy(path: Path) -> PolicyWeights:
    """Reads a policy from its file.

    Raises:
        ConfigError: The file cannot be read (``checkpoint_invalid``), is of something else, or has values that are not finite
            (``weights_invalid``).
    """
    tensors, header = read_weights(path)
    try:
        found = {key: json.loads(header.pop(key)) for key in _KEYS}
        known = _features_of(found["features"])
        execute, assets = found["execute"], found["assets"]
        if type(execute) is not int or not 0 < execute < _MOST or not (assets is None or _are_texts(assets)):
            raise TypeError(f"execute is {quote_value(execute)}, or assets are no names")
        shape = fill_settings(PolicyShape, found["network"], "network")
        network = build_no_larger_than(path, lambda: PolicyNetwork(shape))
        network.load_state_dict(tensors)
    except (ArithmeticError, LookupError, TypeError, ValueError, RuntimeError) as error:
        if isinstance(error, RuntimeError) and is_out_of_memory(error):
            raise
        line = " ".join(str(error).split())[:200]
        raise ConfigError(
            f"{path}: {line}; expected the file of a policy of this version, see train-policy; train again if it is older",
            "weights_invalid",
        ) from error
    if broken := [name for name, value in tensors.items() if not value.isfinite().all()]:
        raise ConfigError(f"{path}: {broken[0]} has values that are not finite, expected finite weights", "weights_invalid")
    return PolicyWeights(network.eval(), shape, known, execute, None if assets is None else frozenset(assets), header)


def _features_of(stated: Any) -> EpisodeFeatures:
    """The features of a header.

    Raises:
        LookupError, TypeError, ValueError: They have another form.
    """
    texts, lists, size = (
        [stated["robot"], stated["control"]],
        [stated[name] for name in (*_NAMES, "cameras")],
        stated["image_size"],
    )
    fps = number(stated["fps"])
    if not (_are_texts(texts) and all(map(_are_texts, lists)) and fps is not None and 0 < fps < math.inf):
        raise TypeError("features have values of other types")
    states, surroundings, actions, cameras = map(tuple, lists)
    image_size: tuple[int, int] | None = None
    if size is not None:
        height, width = size
        if not all(type(side) is int and 0 < side < _MOST for side in (height, width)):
            raise TypeError("image_size has values of other types")
        image_size = height, width
    return EpisodeFeatures(texts[0], fps, texts[1], states, surroundings, actions, cameras, image_size)


def _are_texts(values: Any) -> bool:
    return isinstance(values, list) and all(isinstance(value, str) for value in values)


def check_environment(policy: EpisodeFeatures, environment: EpisodeFeatures, name: str) -> None:
    """Refuses an environment that shows or takes something else than the policy was trained with.

    Raises:
        ConfigError: A feature differs (``policy_mismatch``).
    """
    for key in ("robot", "control", "fps", *_NAMES):
        was, now = getattr(policy, key), getattr(environment, key)
        if was != now:
            raise ConfigError(
                f"policy {name}: its {key} is {quote_value(was)}, but that of the environment is {quote_value(now)}, expected the "
                "same; train on episodes of this environment, or choose the robot and control of the policy",
                "policy_mismatch",
            )
    if policy.image_size and environment.image_size and policy.image_size != environment.image_size:
        raise ConfigError(
            f"policy {name}: it was trained with pictures of {policy.image_size[0]} x {policy.image_size[1]} pixels, but those of the "
            f"environment have {environment.image_size[0]} x {environment.image_size[1]}, expected the same",
            "policy_mismatch",
        )
    if missing := [camera for camera in policy.cameras if camera not in environment.cameras]:
        raise ConfigError(
            f"policy {name}: it needs pictures of {', '.join(missing)}, but the cameras of the environment are "
            f"{quote_value(list(environment.cameras))}, expected these too: --set 'cameras={json.dumps(list(policy.cameras))}'",
            "policy_mismatch",
        )
