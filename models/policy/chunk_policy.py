"""A trained policy that acts in an environment, and how policies are opened by their name."""

import hashlib
from dataclasses import dataclass
from pathlib import Path

import torch

from models.policy.task_frame import TaskFrame
from models.policy.weights import FILE, PolicyWeights, load_policy
from stable_data.content_id import content_id
from stable_data.errors import ConfigError
from stable_data.robot.env import AGENT, ENVIRONMENT, Observation
from stable_data.robot.episodes import EpisodeFeatures, FloatArray32
from stable_data.robot.grasps import PRESHAPE
from stable_data.robot.policies import ActingPolicy, import_policy, policy_source

_CLOSING = PRESHAPE  # an opening below this is none that demonstrations hold: the hand closes, metres


class Policy:
    """Plans a chunk of actions from what it observes; it remembers nothing.

    Args:
        weights: The trained policy.
    """

    def __init__(self, weights: PolicyWeights) -> None:
        self._weights = weights

    def reset(self) -> None:
        """Begins a new episode."""

    @torch.no_grad()
    def act(self, observation: Observation) -> FloatArray32:
        """Returns the next actions, (K, A) float32; K is ``execute`` of its training."""
        frame = TaskFrame(observation[AGENT][None], observation[ENVIRONMENT][None])
        chunk = self._weights.network.plan(frame)
        actions = frame.to_actions(chunk.numpy())[0, : self._weights.execute]
        actions[actions[:, -1] < _CLOSING, -1] = 0.0
        return actions


@dataclass(frozen=True, slots=True, eq=False)
class OpenedPolicy:
    """A policy that is ready to act.

    Attributes:
        name: Its name: the last part of its folder, or ``module:function``.
        fingerprint: Hash of its weights, or of the source of its module.
        policy: What acts.
        features: What it observes and commands; None: it does not say.
        assets: Assets that its demonstrations acted on; None: not known.
    """

    name: str
    fingerprint: str
    policy: ActingPolicy
    features: EpisodeFeatures | None = None
    assets: frozenset[str] | None = None


def open_policy(name: str) -> OpenedPolicy:
    """Opens a policy.

    Args:
        name: Folder of a training, its file of weights, or ``module:function``, which makes an object with ``reset()`` and
            ``act(observation)``.

    Raises:
        ConfigError: There is none (``policy_missing``), or it is not usable (``weights_invalid``, ``policy_invalid``).
    """
    path = Path(name).expanduser()
    file = path / FILE if path.is_dir() else path
    if file.is_file():
        weights = load_policy(file)
        return OpenedPolicy(
            path.resolve().name,
            hashlib.sha256(file.read_bytes()).hexdigest()[:16],
            Policy(weights),
            weights.features,
            weights.assets,
        )
    module, _, function = name.partition(":")
    if not (module and function) or "/" in module:
        raise ConfigError(
            f"policy {name}: there is no {file if path.is_dir() else 'such folder'}, expected a folder of train-policy, or module:function",
            "policy_missing",
        )
    policy = import_policy(name)
    return OpenedPolicy(name, content_id(name, policy_source(policy)), policy, getattr(policy, "features", None))
