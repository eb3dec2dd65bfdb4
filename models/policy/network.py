"""The network of a policy: from what is seen of a state to several chunks of actions, with a score each."""

from dataclasses import dataclass

import torch
from torch import Tensor, nn

from models.policy.task_frame import NUM_ACTIONS, NUM_INPUTS
from models.settings import PositiveCount, Settings, Share

_WIDEST = 5.0  # inputs farther from the mean are clipped to this, standard deviations


@dataclass(frozen=True, slots=True)
class PolicyShape(Settings):
    """The shape of the network."""

    width: PositiveCount = 256
    """Numbers of a hidden layer."""

    depth: PositiveCount = 3
    """Residual blocks of two layers."""

    modes: PositiveCount = 5
    """Chunks that are proposed for a state: a task may be done in several ways, and their mean does none of them."""

    horizon: PositiveCount = 16
    """Actions of a chunk."""

    dropout: Share = 0.1
    """Share of the hidden values that are dropped in training."""


class PolicyNetwork(nn.Module):
    """A residual multilayer perceptron. It keeps the normalisation of its inputs and actions.

    Args:
        shape: Its shape.
    """

    input_mean: Tensor
    input_scale: Tensor
    action_mean: Tensor
    action_scale: Tensor

    def __init__(self, shape: PolicyShape) -> None:
        super().__init__()
        self._chunks_shape = (shape.modes, shape.horizon, NUM_ACTIONS)
        for name, count in (("input", NUM_INPUTS), ("action", NUM_ACTIONS)):
            self.register_buffer(f"{name}_mean", torch.zeros(count))
            self.register_buffer(f"{name}_scale", torch.ones(count))
        self.first = nn.Linear(NUM_INPUTS, shape.width)
        self.blocks = nn.ModuleList(_block(shape.width, shape.dropout) for _ in range(shape.depth))
        self.last = nn.LayerNorm(shape.width)
        self.chunks = nn.Linear(shape.width, shape.modes * shape.horizon * NUM_ACTIONS)
        self.scores = nn.Linear(shape.width, shape.modes)

    def forward(self, inputs: Tensor) -> tuple[Tensor, Tensor]:
        """Returns normalised chunks, (B, M, H, A), and their scores, (B, M), for inputs (B, D) of :class:`TaskFrame`."""
        hidden = self.first(((inputs - self.input_mean) / self.input_scale).clamp(-_WIDEST, _WIDEST))
        for block in self.blocks:
            hidden = hidden + block(hidden)
        hidden = self.last(hidden)
        return self.chunks(hidden).reshape(-1, *self._chunks_shape), self.scores(hidden)

    def normalised(self, actions: Tensor) -> Tensor:
        """Returns actions (..., A) of the task frame as the network states them."""
        return (actions - self.action_mean) / self.action_scale

    def plan(self, inputs: Tensor) -> Tensor:
        """Returns the chunk with the highest score, (B, H, A), in units of actions, task frame."""
        chunks, scores = self(inputs)
        return best_chunks(chunks, scores) * self.action_scale + self.action_mean


def best_chunks(chunks: Tensor, scores: Tensor) -> Tensor:
    """Returns the chunk with the highest score of each state, (B, H, A)."""
    return chunks[torch.arange(len(chunks)), scores.argmax(dim=1)]


def _block(width: int, dropout: float) -> nn.Sequential:
    return nn.Sequential(nn.LayerNorm(width), nn.Linear(width, width), nn.GELU(), nn.Dropout(dropout), nn.Linear(width, width))
