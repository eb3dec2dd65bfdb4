"""The file of a policy: one safetensors file with weights, normalisation, what it observes and commands, and what it was trained on."""

import json
from collections.abc import Mapping
from dataclasses import asdict, dataclass
from pathlib import Path

from models.policy.network import PolicyNetwork, PolicyShape
from models.settings import fill_settings
from models.training.weights_file import build_no_larger_than, read_weights, save_weights
from stable_data.errors import ConfigError
from stable_data.json_text import quote_value
from stable_data.robot.episodes import EpisodeFeatures

FILE = "weights/policy.safetensors"
"""The file in the folder of a training."""

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
        features = found["features"]
        names = {name: tuple(features[name]) for name in _NAMES}
        size = features["image_size"]
        known = EpisodeFeatures(
            features["robot"],
            features["fps"],
            features["control"],
            **names,
            cameras=tuple(features["cameras"]),
            image_size=None if size is None else (size[0], size[1]),
        )
        shape = fill_settings(PolicyShape, found["network"], "network")
        network = build_no_larger_than(path, lambda: PolicyNetwork(shape))
        network.load_state_dict(tensors)
    except (ArithmeticError, LookupError, TypeError, ValueError, RuntimeError) as error:
        line = " ".join(str(error).split())[:200]
        raise ConfigError(
            f"{path}: {line}; expected the file of a policy of this version, see train-policy; train again if it is older",
            "weights_invalid",
        ) from error
    if broken := [name for name, value in tensors.items() if not value.isfinite().all()]:
        raise ConfigError(f"{path}: {broken[0]} has values that are not finite, expected finite weights", "weights_invalid")
    assets = found["assets"]
    return PolicyWeights(
        network.eval(), shape, known, int(found["execute"]), None if assets is None else frozenset(assets), header
    )


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
