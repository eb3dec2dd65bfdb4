"""The coordinates in which the flow runs: residual to the coarse pose, or the paper's absolute ones. Yaw is right across ±π.

A pose x is (x, y, z, yaw), metres and radians, world frame. A coordinate y is dimensionless: lengths over ``length_unit``, yaw
over ``yaw_unit``. Both forms are affine in x, so the linear path of the paper is a linear path in either; what differs is the
scale that the network sees and where yaw is cut open. Yaw is a circle: a coordinate of it means the same one turn further, and
every difference of two takes the short way round. That rule is stated here and nowhere else.
"""

import math
from dataclasses import dataclass
from typing import Literal, TypeAlias

import torch
from torch import Tensor

from models.settings import Positive, Settings

Form: TypeAlias = Literal["residual", "absolute"]


def wrap_angle(angle: Tensor) -> Tensor:
    """The same angle in (−π, π], radians, up to one rounding; angles that lie there come back bit for bit, the gradient is 1."""
    return angle - 2 * math.pi * torch.ceil((angle - math.pi) / (2 * math.pi))


@dataclass(frozen=True, slots=True)
class PoseCoordinates(Settings):
    """How a pose is written for the network."""

    form: Form = "residual"
    """``residual``: y = (p − p^c, wrap(r − r^c)) in units, so that 0 is the coarse pose; ``absolute``: y = (p, wrap(r))."""

    length_unit: Positive = 0.05
    """Metres; one unit of a position."""

    yaw_unit: Positive = 0.5
    """Radians; one unit of yaw."""

    def encode(self, poses: Tensor, coarse: Tensor) -> Tensor:
        """The coordinates of poses, (B, N, 4), yaw wrapped.

        Args:
            poses: x, y, z in metres and yaw in radians, world frame, (B, N, 4) float.
            coarse: The coarse poses x^c, the same.
        """
        delta = poses - coarse if self.form == "residual" else poses
        return torch.cat([delta[..., :3] / self.length_unit, wrap_angle(delta[..., 3:]) / self.yaw_unit], -1)

    def decode(self, y: Tensor, coarse: Tensor) -> Tensor:
        """The poses of coordinates, (B, N, 4), yaw wrapped: the inverse of :meth:`encode`.

        Args:
            y: Coordinates, (B, N, 4) float.
            coarse: The coarse poses x^c, as for :meth:`encode`.
        """
        delta = torch.cat([y[..., :3] * self.length_unit, y[..., 3:] * self.yaw_unit], -1)
        poses = coarse + delta if self.form == "residual" else delta
        return torch.cat([poses[..., :3], wrap_angle(poses[..., 3:])], -1)

    def difference(self, start: Tensor, end: Tensor) -> Tensor:
        """From start to end, yaw the short way round, (B, N, 4)."""
        delta = end - start
        return torch.cat([delta[..., :3], wrap_angle(delta[..., 3:] * self.yaw_unit) / self.yaw_unit], -1)

    def on_circle(self, y: Tensor) -> Tensor:
        """Coordinates as a network reads them: position, sine and cosine of yaw, (B, N, 5), continuous across ±π."""
        yaw = y[..., 3:] * self.yaw_unit
        return torch.cat([y[..., :3], yaw.sin(), yaw.cos()], -1)
