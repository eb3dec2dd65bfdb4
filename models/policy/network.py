"""The network of a policy: from what is seen of a state to where the hand opens or closes next, and to the actions on the way."""

from dataclasses import dataclass

import torch
from torch import Tensor, nn

from models.policy.pictures import PictureEncoder
from models.policy.sight import Sight
from models.policy.task_frame import NUM_ACTIONS, NUM_INPUTS, NUM_KEY, NUM_KEY_INPUTS, NUM_POINT_INPUTS
from models.settings import PositiveCount, Settings, Share
from stable_data.errors import ConfigError
from stable_data.robot.arm.assembly import CAMERAS

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

    point_width: PositiveCount = 96
    """Numbers by which a point of the subject is described."""

    horizon: PositiveCount = 16
    """Actions of a chunk."""

    dropout: Share = 0.2
    """Share of the hidden values that are dropped in training."""

    sees_objects: bool = True
    """Whether the network sees the states of the objects. Without them it sees pictures, and the robot itself; nothing tells it which
    object to take, so the pictures have to.
    """

    cameras: tuple[str, ...] = ()
    """Cameras whose pictures the network sees: ``wrist``, ``front``, ``top``. Empty: none."""

    picture_size: PositiveCount = 64
    """Pixels of a side to which the pictures are made small, a multiple of 16."""

    picture_width: PositiveCount = 64
    """Numbers that describe the pictures."""

    def check(self) -> None:
        """Refuses cameras that do not exist, sizes that cannot be halved four times, and a network that sees no object at all.

        Raises:
            ConfigError: See above (``setting_invalid``).
        """
        if set(self.cameras) - set(CAMERAS) or len(set(self.cameras)) < len(self.cameras):
            raise ConfigError(
                f"network.cameras is {', '.join(self.cameras)}, expected some of {', '.join(CAMERAS)}, each once",
                "setting_invalid",
            )
        if self.picture_size % 16:
            raise ConfigError(f"network.picture_size is {self.picture_size}, expected a multiple of 16", "setting_invalid")
        if not (self.sees_objects or self.cameras):
            raise ConfigError(
                "network.sees_objects is false and network.cameras is empty, expected cameras: the policy would see no object",
                "setting_invalid",
            )


class PolicyNetwork(nn.Module):
    """Two residual multilayer perceptrons: one says where the hand opens or closes next, the other how to get there.

    The first one sees also points of the subject, and proposes poses of the tool relative to each of them: what can be grasped is
    seen where it is. Pictures, if any, are encoded for both. The network keeps the normalisation of its inputs and actions.

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
        point = shape.point_width
        self.point_encoder = nn.Sequential(nn.Linear(NUM_POINT_INPUTS, point), nn.GELU(), nn.Linear(point, point), nn.GELU())
        self.picture_encoder = (
            PictureEncoder(len(shape.cameras), shape.picture_size, shape.picture_width) if shape.cameras else None
        )
        seen = NUM_INPUTS + (shape.picture_width if shape.cameras else 0)
        self.scene_encoder = _perceptron(seen + point, point, shape)
        self.proposals = nn.Sequential(
            nn.LayerNorm(point), _residual(point, shape), nn.LayerNorm(point), nn.Linear(point, shape.modes * (NUM_KEY + 1))
        )
        self.motions = _perceptron(seen + NUM_KEY_INPUTS, shape.horizon * NUM_ACTIONS, shape)

    def see(self, sight: Sight) -> Tensor:
        """Returns what both parts of the network take of what is seen, (B, W): normalised inputs, and the encoded pictures."""
        found = ((sight.inputs - self.input_mean) / self.input_scale).clamp(-_WIDEST, _WIDEST)
        return found if self.picture_encoder is None else torch.cat([found, self.picture_encoder(sight.pictures)], dim=1)

    def keys(self, seen: Tensor, points: Tensor) -> tuple[Tensor, Tensor]:
        """Proposes where the hand opens or closes next.

        Args:
            seen: (B, W) of :meth:`see`.
            points: (B, P, C), see :class:`Sight`.

        Returns:
            Normalised poses of the tool, (B, P, M, K), and their scores, (B, P, M).
        """
        each = self.point_encoder(points)
        scene = self.scene_encoder(torch.cat([seen, each.amax(dim=1)], dim=1))
        found = self.proposals(each + scene[:, None]).unflatten(2, (self._modes, NUM_KEY + 1))
        anchors = (points[..., :3] - self.key_mean[:3]) / self.key_scale[:3]
        poses = torch.cat([found[..., :3] + anchors[:, :, None], found[..., 3:-1]], dim=3)
        return poses, found[..., -1]

    def chunks(self, seen: Tensor, key_inputs: Tensor) -> Tensor:
        """Returns normalised chunks of actions, (B, H, A), that bring the tool to a pose.

        Args:
            seen: (B, W) of :meth:`see`.
            key_inputs: The pose, (B, L), see :meth:`TaskFrame.key_inputs`.
        """
        found: Tensor = self.motions(torch.cat([seen, key_inputs], dim=1))
        return found.reshape(-1, self._horizon, NUM_ACTIONS)

    def best(self, keys: Tensor, scores: Tensor) -> Tensor:
        """Returns the poses, (B, K), with the best score of what :meth:`keys` proposes, as :meth:`TaskFrame.keys`."""
        flat = keys.flatten(1, 2)
        return flat[torch.arange(len(flat)), scores.flatten(1).argmax(dim=1)] * self.key_scale + self.key_mean

    def actions(self, seen: Tensor, key_inputs: Tensor) -> Tensor:
        """Returns the actions of :meth:`chunks`, not normalised, task frame."""
        return self.chunks(seen, key_inputs) * self.action_scale + self.action_mean


class _Residual(nn.Module):
    def __init__(self, inner: nn.Module) -> None:
        super().__init__()
        self.inner = inner

    def forward(self, hidden: Tensor) -> Tensor:
        found: Tensor = hidden + self.inner(hidden)
        return found


def _residual(width: int, shape: PolicyShape) -> _Residual:
    return _Residual(
        nn.Sequential(
            nn.LayerNorm(width), nn.Linear(width, width), nn.GELU(), nn.Dropout(shape.dropout), nn.Linear(width, width)
        )
    )


def _perceptron(inputs: int, outputs: int, shape: PolicyShape) -> nn.Sequential:
    width = shape.width
    blocks = [_residual(width, shape) for _ in range(shape.depth)]
    return nn.Sequential(nn.Linear(inputs, width), *blocks, nn.LayerNorm(width), nn.Linear(width, outputs))
