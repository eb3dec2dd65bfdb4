"""What the network of a policy sees of some states."""

from dataclasses import dataclass

import torch
from torch import Tensor

from models.policy.pictures import SmallPictures
from models.policy.task_frame import TaskFrame
from stable_data.robot.episodes import FloatArray32


@dataclass(frozen=True, slots=True, eq=False)
class Sight:
    """What the network sees of B states.

    Attributes:
        inputs: (B, D) float32, see :meth:`TaskFrame.inputs`.
        points: (B, P, C) float32, see :meth:`TaskFrame.points`.
        pictures: (B, 3 C, S, S) uint8, see :func:`models.policy.pictures.observed_pictures`; no channels without cameras.
    """

    inputs: Tensor
    points: Tensor
    pictures: Tensor

    @classmethod
    def of(cls, frame: TaskFrame, memory: FloatArray32, pictures: SmallPictures) -> "Sight":
        """Returns what is seen of the states of a task frame.

        Args:
            frame: The states.
            memory: What is remembered of the hand, (B, 2).
            pictures: (B, 3 C, S, S) uint8.
        """
        return cls(*map(torch.from_numpy, (frame.inputs(memory), frame.points(), pictures)))

    def chosen(self, rows: Tensor, device: torch.device) -> "Sight":
        """Returns some of the states on a device."""
        return Sight(*(part[rows].to(device) for part in (self.inputs, self.points, self.pictures)))
