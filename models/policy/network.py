"""The network of a policy: from what is seen of a state to where the hand opens or closes next, and to the actions on the way."""

from dataclasses import dataclass

import torch
from torch import Tensor, nn

from models.policy.task_frame import NUM_ACTIONS, NUM_INPUTS, NUM_KEY, NUM_KEY_INPUTS
from models.settings import PositiveCount, Settings, Share
from stable_data.robot.episodes import FloatArray32

_WIDEST = 5.0  # inputs farther from the mean are clipped to this, standard deviations


@dataclass(frozen=True, slots=True)
class PolicyShape(Settings):
    """The shape of the network."""

    width: PositiveCount = 256
    """Numbers of a hidden layer."""

    depth: PositiveCount = 3
    """Residual blocks of two layers."""

    modes: PositiveCount = 5
    """Poses that are proposed for the next closing or opening of the hand: an object may be grasped in several ways, and their mean
    is none of them.
    """

    horizon: PositiveCount = 16
    """Actions of a chunk."""

    dropout: Share = 0.2
    """Share of the hidden values that are dropped in training."""


class PolicyNetwork(nn.Module):
    """Two residual multilayer perceptrons: one says where the hand opens or closes next, the other how to get there.

    It keeps the normalisation of its inputs and actions.

    Args:
        shape: Its shape.
    """

    input_mean: Tensor
    input_scale: Tensor
    key_mean: Tensor
    key_scale: Tensor
    action_mean: Tensor
    action_scale: Tensor

    def __init__(self, shape: PolicyShape) -> None:
        super().__init__()
        self._modes, self._horizon = shape.modes, shape.horizon
        for name, count in (("input", NUM_INPUTS), ("key", NUM_KEY), ("action", NUM_ACTIONS)):
            self.register_buffer(f"{name}_mean", torch.zeros(count))
            self.register_buffer(f"{name}_scale", torch.ones(count))
        self.where = _perceptron(NUM_INPUTS, shape.modes * (NUM_KEY + 1), shape)
        self.how = _perceptron(NUM_INPUTS + NUM_KEY_INPUTS, shape.horizon * NUM_ACTIONS, shape)

    def keys(self, inputs: Tensor) -> tuple[Tensor, Tensor]:
        """Returns normalised poses of the tool, (B, M, K), and their scores, (B, M), for inputs (B, D) of :class:`TaskFrame`."""
        found = self.where(self._seen(inputs)).reshape(-1, self._modes, NUM_KEY + 1)
        return found[..., :-1], found[..., -1]

    def chunks(self, inputs: Tensor, key_inputs: Tensor) -> Tensor:
        """Returns normalised chunks of actions, (B, H, A), that bring the tool to a pose."""
        found: Tensor = self.how(torch.cat([self._seen(inputs), key_inputs], dim=1))
        return found.reshape(-1, self._horizon, NUM_ACTIONS)

    def _seen(self, inputs: Tensor) -> Tensor:
        return ((inputs - self.input_mean) / self.input_scale).clamp(-_WIDEST, _WIDEST)

    def aim(self, inputs: FloatArray32) -> FloatArray32:
        """Returns where the hand shall close or open next, (B, K) float32, see :meth:`TaskFrame.keys`, for inputs (B, D)."""
        keys, scores = self.keys(torch.from_numpy(inputs))
        best = keys[torch.arange(len(keys)), scores.argmax(dim=1)] * self.key_scale + self.key_mean
        found: FloatArray32 = best.numpy()
        return found

    def plan(self, inputs: FloatArray32, key_inputs: FloatArray32) -> FloatArray32:
        """Returns the actions that bring the tool to given poses, (B, H, A), task frame.

        Args:
            inputs: (B, D), see :meth:`TaskFrame.inputs`.
            key_inputs: The poses, (B, L), see :meth:`TaskFrame.key_inputs`.
        """
        chunks = self.chunks(torch.from_numpy(inputs), torch.from_numpy(key_inputs))
        found: FloatArray32 = (chunks * self.action_scale + self.action_mean).numpy()
        return found


class _Residual(nn.Module):
    def __init__(self, inner: nn.Module) -> None:
        super().__init__()
        self.inner = inner

    def forward(self, hidden: Tensor) -> Tensor:
        found: Tensor = hidden + self.inner(hidden)
        return found


def _perceptron(inputs: int, outputs: int, shape: PolicyShape) -> nn.Sequential:
    width = shape.width
    blocks = [
        _Residual(
            nn.Sequential(
                nn.LayerNorm(width), nn.Linear(width, width), nn.GELU(), nn.Dropout(shape.dropout), nn.Linear(width, width)
            )
        )
        for _ in range(shape.depth)
    ]
    return nn.Sequential(nn.Linear(inputs, width), *blocks, nn.LayerNorm(width), nn.Linear(width, outputs))
