"""The network of a policy: from what is seen of a state to where the hand opens or closes next, and to the actions on the way."""

from dataclasses import dataclass

import torch
from torch import Tensor, nn

from models.policy.task_frame import NUM_ACTIONS, NUM_INPUTS, NUM_KEY, NUM_KEY_INPUTS, NUM_POINT_INPUTS
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

    modes: PositiveCount = 2
    """Poses that are proposed at each point of the subject for the next closing or opening of the hand: an object may be grasped in
    several ways, and their mean is none of them.
    """

    point_width: PositiveCount = 64
    """Numbers by which a point of the subject is described."""

    horizon: PositiveCount = 16
    """Actions of a chunk."""

    dropout: Share = 0.2
    """Share of the hidden values that are dropped in training."""


class PolicyNetwork(nn.Module):
    """Two residual multilayer perceptrons: one says where the hand opens or closes next, the other how to get there.

    The first one sees also points of the subject, and proposes poses of the tool relative to each of them: what can be grasped is
    seen where it is. The network keeps the normalisation of its inputs and actions.

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
        width, point = shape.width, shape.point_width
        self.point = nn.Sequential(nn.Linear(NUM_POINT_INPUTS, point), nn.GELU(), nn.Linear(point, point), nn.GELU())
        self.where = _perceptron(NUM_INPUTS + point, width, shape)
        self.at_point = nn.Sequential(
            nn.Linear(width + point, width), nn.GELU(), nn.Dropout(shape.dropout), nn.Linear(width, shape.modes * (NUM_KEY + 1))
        )
        self.how = _perceptron(NUM_INPUTS + NUM_KEY_INPUTS, shape.horizon * NUM_ACTIONS, shape)

    def keys(self, inputs: Tensor, points: Tensor) -> tuple[Tensor, Tensor]:
        """Proposes where the hand opens or closes next.

        Args:
            inputs: (B, D) of :meth:`TaskFrame.inputs`.
            points: (B, P, C) of :meth:`TaskFrame.points`.

        Returns:
            Normalised poses of the tool, (B, P, M, K), and their scores, (B, P, M).
        """
        each = self.point(points)
        scene = self.where(torch.cat([self._seen(inputs), each.amax(dim=1)], dim=1))
        found = self.at_point(torch.cat([each, scene[:, None].expand(-1, each.shape[1], -1)], dim=2))
        found = found.unflatten(2, (self._modes, NUM_KEY + 1))
        anchors = (points[..., :3] - self.key_mean[:3]) / self.key_scale[:3]
        poses = torch.cat([found[..., :3] + anchors[:, :, None], found[..., 3:-1]], dim=3)
        return poses, found[..., -1]

    def chunks(self, inputs: Tensor, key_inputs: Tensor) -> Tensor:
        """Returns normalised chunks of actions, (B, H, A), that bring the tool to a pose."""
        found: Tensor = self.how(torch.cat([self._seen(inputs), key_inputs], dim=1))
        return found.reshape(-1, self._horizon, NUM_ACTIONS)

    def _seen(self, inputs: Tensor) -> Tensor:
        return ((inputs - self.input_mean) / self.input_scale).clamp(-_WIDEST, _WIDEST)

    def aim(self, inputs: FloatArray32, points: FloatArray32) -> FloatArray32:
        """Returns where the hand shall close or open next, (B, K) float32, see :meth:`TaskFrame.keys`.

        Args:
            inputs: (B, D), see :meth:`TaskFrame.inputs`.
            points: (B, P, C), see :meth:`TaskFrame.points`.
        """
        found: FloatArray32 = self.best(*self.keys(torch.from_numpy(inputs), torch.from_numpy(points))).numpy()
        return found

    def best(self, keys: Tensor, scores: Tensor) -> Tensor:
        """Returns the poses, (B, K), with the best score of what :meth:`keys` proposes, not normalised."""
        flat = keys.flatten(1, 2)
        return flat[torch.arange(len(flat)), scores.flatten(1).argmax(dim=1)] * self.key_scale + self.key_mean

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
