"""The coordinates of the flow: residuals to the coarse pose, or the paper's absolute poses.

A pose x is (x, y, z, yaw), metres and radians, world frame. A coordinate y is dimensionless: lengths over ``length_unit``, yaw
over ``yaw_unit``. Both forms are affine in x, so the linear path of the paper is linear in either. They differ in the scale of
the network's inputs and in the angle at which yaw jumps by one turn. Yaw is periodic: differences follow the shorter arc. This
module alone implements that rule.
"""

import math
from dataclasses import dataclass
from typing import Literal, TypeAlias

import torch
from torch import Tensor

from models.settings import Positive, Settings

Form: TypeAlias = Literal["residual", "absolute"]


def wrap_angle(angle: Tensor) -> Tensor:
    """Wraps an angle to (−π, π], radians, up to one rounding error; angles in this range are unchanged. The gradient is 1."""
    return angle - 2 * math.pi * torch.ceil((angle - math.pi) / (2 * math.pi))


@dataclass(frozen=True, slots=True)
class PoseCoordinates(Settings):
    """The map between poses and coordinates of the flow."""

    form: Form = "residual"
    """``residual``: y = (p − p^c, wrap(r − r^c)) in units, so that 0 is the coarse pose; ``absolute``: y = (p, wrap(r))."""

    length_unit: Positive = 0.05
    """Metres; one coordinate unit of a position."""

    yaw_unit: Positive = 0.5
    """Radians; one coordinate unit of yaw."""

    def encode(self, poses: Tensor, coarse: Tensor) -> Tensor:
        """Converts poses to coordinates, (B, N, 4), yaw wrapped.

        Args:
            poses: x, y, z in metres and yaw in radians, world frame, (B, N, 4) float.
            coarse: The coarse poses x^c, in the same form.
        """
        delta = poses - coarse if self.form == "residual" else poses
        return torch.cat([delta[..., :3] / self.length_unit, wrap_angle(delta[..., 3:]) / self.yaw_unit], -1)

    def decode(self, y: Tensor, coarse: Tensor) -> Tensor:
        """Converts coordinates (B, N, 4) to poses (B, N, 4), yaw wrapped: the inverse of :meth:`encode`."""
        delta = torch.cat([y[..., :3] * self.length_unit, y[..., 3:] * self.yaw_unit], -1)
        poses = coarse + delta if self.form == "residual" else delta
        return torch.cat([poses[..., :3], wrap_angle(poses[..., 3:])], -1)

    def difference(self, start: Tensor, end: Tensor) -> Tensor:
        """Returns end − start, with yaw along the shorter arc, (B, N, 4)."""
        delta = end - start
        return torch.cat([delta[..., :3], wrap_angle(delta[..., 3:] * self.yaw_unit) / self.yaw_unit], -1)

    def on_circle(self, y: Tensor) -> Tensor:
        """Returns position, sine and cosine of yaw, (B, N, 5): network inputs that are continuous across ±π."""
        yaw = y[..., 3:] * self.yaw_unit
        return torch.cat([y[..., :3], yaw.sin(), yaw.cos()], -1)
