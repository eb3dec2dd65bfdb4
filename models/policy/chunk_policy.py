"""A trained policy that acts in an environment, and how policies are opened by their name."""

import hashlib
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch

from models.policy.keyframes import HandMemory
from models.policy.pictures import observed_pictures
from models.policy.sight import Sight
from models.policy.task_frame import TaskFrame
from models.policy.weights import FILE, PolicyWeights, load_policy
from stable_data.content_id import content_id
from stable_data.errors import ConfigError
from stable_data.robot.acting.policies import ActingPolicy, import_policy, policy_identity
from stable_data.robot.env import AGENT, ENVIRONMENT, PIXELS, Observation
from stable_data.robot.episodes import EpisodeFeatures, FloatArray32
from stable_data.robot.grasps import PRESHAPE

_PATIENCE = 80  # actions for which an aim is kept
_CLOSING = PRESHAPE  # an opening below this is none that demonstrations hold: the hand closes, metres


class Policy:
    """Aims at a pose relative to the subject, and plans a chunk of actions that brings the tool there.

    It keeps its aim until the hand closes or opens, the subject is another one or held, or the aim is old: an aim that moves with
    every look is never reached.

    Args:
        weights: The trained policy.
    """

    def __init__(self, weights: PolicyWeights) -> None:
        self._weights = weights
        self.reset()

    def reset(self) -> None:
        """Begins a new episode."""
        self._aim: FloatArray32 | None = None
        self._memory, self._has_subject, self._left = HandMemory(), False, 0

    @torch.no_grad()
    def act(self, observation: Observation) -> FloatArray32:
        """Returns the next actions, (K, A) float32; K is ``execute`` of its training."""
        network, shape = self._weights.network, self._weights.shape
        pictures = observed_pictures(observation.get(PIXELS, {}), shape.cameras, shape.picture_size)
        frame = TaskFrame(observation[AGENT][None], observation[ENVIRONMENT][None], sees_objects=shape.sees_objects)
        sight = Sight.of(frame, np.array([self._memory.values], np.float32), pictures[None])
        seen = network.see(sight)
        if self._aim is None or self._left <= 0 or frame.has_subject[0] != self._has_subject:
            self._aim = network.best(*network.keys(seen, sight.points)).numpy()
            self._has_subject = bool(frame.has_subject[0])
            self._left = _PATIENCE if self._has_subject else 0  # without a subject an aim is relative to the tool, which moves
        key_inputs = torch.from_numpy(frame.key_inputs(self._aim))
        actions = frame.to_actions(network.actions(seen, key_inputs).numpy())[0, : self._weights.execute]
        is_open = actions[:, -1] >= _CLOSING
        # That of the aim: one that follows from the measured opening drifts.
        actions[:, -1] = np.where(is_open, max(float(self._aim[0, -1]), _CLOSING), 0.0)
        self._left -= len(actions)
        for opening in actions[:, -1].tolist():
            before = self._memory.values[0]
            self._memory.told(opening)
            if self._memory.values[0] != before:
                self._left = 0  # the hand begins to close or to open: a new aim
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
        ConfigError: There is none (``policy_missing``), or it is not usable (``checkpoint_invalid``,
            ``weights_invalid``, ``policy_invalid``).
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
    return OpenedPolicy(name, content_id(name, *policy_identity(name, policy)), policy, getattr(policy, "features", None))
