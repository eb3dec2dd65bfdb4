"""Conditional flow matching of poses: the linear path, its velocity, the clean estimate and the ODE (the paper's Method; appendix).

    x_0 = x^c + σ ε        x_t = (1 − t) x_0 + t x_1        v_target = x_1 − x_0        x̂_1 = x_t + (1 − t) v_θ(x_t, t, C)

All equations are in the coordinates y of :mod:`~models.physics_corrector.flow.pose_coordinates`. Yaw follows the shorter arc from
x_0 to x_1. Fixed objects and padding have x_0 = x_1 = x^c: they do not move on any path or in any sample.

The paper's method starts at x^c + σ ε, but its training details mention a standard Gaussian: ``source`` offers both. Inference
starts at the mean of the source, which is x^c in the first case, or at a sample of it.
"""

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Annotated, Literal, TypeAlias

import torch
from annotated_types import Interval
from torch import Tensor

from models.physics_corrector.flow.condition import Condition
from models.physics_corrector.flow.heights import Heights, at_first_heights, without_heights
from models.physics_corrector.flow.object_encoding import expected_shifts
from models.physics_corrector.flow.pose_coordinates import PoseCoordinates
from models.settings import NonNegative, Settings, Share

Source: TypeAlias = Literal["coarse", "expected", "gaussian"]
Solver: TypeAlias = Literal["euler", "midpoint", "heun"]
Velocity: TypeAlias = Callable[[Tensor, Tensor, Condition, Tensor, Tensor | None], Tensor]
"""v_θ: coordinates (B, N, 4), time (B,), condition, ranks (B, N), earlier clean estimate or None -> velocity (B, N, 4)."""

Mover: TypeAlias = Callable[[Condition, torch.Generator], Tensor]
"""Moves the objects of scenes with coarse poses: the scenes, a generator for what is drawn -> poses (B, N, 4)."""


@dataclass(frozen=True, slots=True)
class FlowSettings(Settings):
    """Settings of the paths and of the ODE solver."""

    coordinates: PoseCoordinates = field(default_factory=PoseCoordinates)
    """Coordinates of the flow."""

    source: Source = "coarse"
    """Start of a path: ``coarse`` is x_0 = x^c + σ ε, ``gaussian`` is y_0 = ε, standard normal in the coordinates. ``expected`` is
    like ``coarse``, but where the errors of positions are known, it starts where objects are expected by these errors alone
    (:func:`~models.physics_corrector.flow.object_encoding.expected_shifts`).
    """

    sigma: NonNegative = 0.2
    """σ in coordinate units: one unit is ``length_unit`` metres or ``yaw_unit`` radians."""

    heights: Heights = "learned"
    """``learned`` as in the paper; with ``geometry`` heights follow from the supports, and the flow changes x, y and yaw alone."""

    self_condition: Share = 0.5
    """Probability that training gives the network its earlier clean estimate; 0 also disables it at inference."""

    solver: Solver = "euler"
    """``euler``, ``midpoint`` or ``heun``."""

    steps: Annotated[int, Interval(ge=1, le=10_000)] = 8
    """Solver steps from t = 0 to 1; midpoint and heun evaluate the network twice per step."""


@dataclass(frozen=True, slots=True, eq=False)
class FlowPath:
    """One point on the path of each scene.

    Attributes:
        y: y_t, (B, N, 4) float32.
        t: Flow time, (B,) float32 in [0, 1].
        velocity: v_target = y_1 − y_0, (B, N, 4) float32.
    """

    y: Tensor
    t: Tensor
    velocity: Tensor


@dataclass(frozen=True, slots=True, eq=False)
class FlowPrediction:
    """The network's prediction at a point on a path.

    Attributes:
        velocity: v_θ, (B, N, 4) float32, coordinate units.
        poses: The clean estimate x̂_1, (B, N, 4) float32: x, y, z in metres and yaw in radians, world frame; exactly x^c for fixed
            objects and padding.
    """

    velocity: Tensor
    poses: Tensor


@dataclass(frozen=True, slots=True)
class FlowMatching:
    """Draws training paths and integrates the learned field. It depends on no network, only on a function :data:`Velocity`."""

    settings: FlowSettings

    def start(self, condition: Condition, generator: torch.Generator | None = None, *, draw: bool = True) -> Tensor:
        """Returns y_0 of every object, (B, N, 4) float32: a draw from the source, or its mean."""
        coarse = self.settings.coordinates.encode(condition.poses, condition.poses)
        is_coarse = self.settings.source != "gaussian"
        start = coarse if is_coarse else torch.zeros_like(coarse)
        if self.settings.source == "expected" and condition.error is not None:
            sigma = condition.error[:, 0]
            shift = expected_shifts(condition, torch.where(sigma.isfinite(), sigma, 1.0).clamp_min(1e-3))[1]
            shift = torch.where(sigma.isfinite()[:, None, None], shift, 0)
            shifted = torch.cat([condition.poses[..., :2] + shift, condition.poses[..., 2:]], -1)
            start = self.settings.coordinates.encode(shifted, condition.poses)
        if draw:
            noise = torch.randn(coarse.shape, device=coarse.device, generator=generator)
            start = start + (self.settings.sigma if is_coarse else 1.0) * self._free(noise)
        return torch.where(condition.is_movable[..., None], start, coarse)

    def path(
        self, condition: Condition, targets: Tensor, generator: torch.Generator | None = None, t: Tensor | None = None
    ) -> FlowPath:
        """Returns a point on the linear path to each scene's target.

        Args:
            condition: The scenes with their coarse poses.
            targets: Clean poses x_1 = x^*, (B, N, 4) float32, metres and radians, world frame.
            generator: Random generator on the condition's device.
            t: Flow times, (B,) float32; by default drawn from U[0, 1].
        """
        coordinates, condition = self.settings.coordinates, self.prepared(condition)
        y_0 = self.start(condition, generator)
        movable = condition.is_movable[..., None]
        y_1 = coordinates.encode(torch.where(movable, targets, condition.poses), condition.poses)
        if t is None:
            t = torch.rand(len(y_0), device=y_0.device, generator=generator)
        velocity = torch.where(movable, self._free(coordinates.difference(y_0, y_1)), 0)
        return FlowPath(y_0 + t[:, None, None] * velocity, t, velocity)

    def predict(
        self, network: Velocity, path: FlowPath, condition: Condition, generator: torch.Generator | None = None
    ) -> FlowPrediction:
        """Predicts the velocity and the clean estimate at a point on the path, for training.

        Self-conditioning as in Analog Bits: in a share of the calls the network is evaluated once without gradient, and its clean
        estimate is an input of the second evaluation. Each call draws new instance codes.
        """
        condition = self.prepared(condition)
        ranks = condition.random_ranks(generator)
        y1_hat = None
        # Drawn even without self-conditioning, so that the setting does not change later draws.
        coin = torch.rand((), device=path.y.device, generator=generator)
        if self.settings.self_condition and coin.item() < self.settings.self_condition:
            with torch.no_grad():
                y1_hat = self.clean(path.y, path.t, self._free(network(path.y, path.t, condition, ranks, None)))
        velocity = self._free(network(path.y, path.t, condition, ranks, y1_hat))
        return FlowPrediction(velocity, self.poses(self.clean(path.y, path.t, velocity), condition))

    def prepared(self, condition: Condition) -> Condition:
        """Returns the scenes at the heights with which the flow begins."""
        return at_first_heights(condition, self.settings.heights)

    def _free(self, change: Tensor) -> Tensor:
        """Returns a change of coordinates (B, N, 4) without that of the height, if heights follow from geometry."""
        return without_heights(change, self.settings.heights)

    @staticmethod
    def clean(y: Tensor, t: Tensor, velocity: Tensor) -> Tensor:
        """The clean estimate ŷ_1 = y_t + (1 − t) v, (B, N, 4)."""
        return y + (1 - t)[:, None, None] * velocity

    def poses(self, y: Tensor, condition: Condition) -> Tensor:
        """Decodes coordinates to poses, (B, N, 4); fixed objects and padding have their coarse pose, bit by bit."""
        return torch.where(
            condition.is_movable[..., None], self.settings.coordinates.decode(y, condition.poses), condition.poses
        )

    def sample(
        self,
        network: Velocity,
        condition: Condition,
        *,
        generator: torch.Generator | None = None,
        steps: int | None = None,
        solver: Solver | None = None,
        gradient_steps: int = 0,
    ) -> Tensor:
        """Computes corrected poses: integrates dx/dt = v_θ(x, t, C) from t = 0 to 1.

        Args:
            network: The velocity field.
            condition: The scenes with their coarse poses.
            generator: Draws the start; None starts at the source's mean, which for ``coarse`` is x^c as in the paper.
            steps: Solver steps; by default those of the settings.
            solver: The solver; by default that of the settings.
            gradient_steps: Number of last steps that record gradients, for fine-tuning through the sampler.

        Returns:
            Poses, (B, N, 4) float32, metres and radians, world frame, yaw in (−π, π]; coarse poses for fixed objects and padding.
            If heights follow from geometry, objects on the table stand on it, and others are as far above their support as before.
        """
        steps, solver = steps or self.settings.steps, solver or self.settings.solver
        condition = self.prepared(condition)
        ranks = condition.content_ranks()  # of the coarse poses: constant during the integration
        y = self.start(condition, generator, draw=generator is not None)
        y1_hat: Tensor | None = None

        def velocity(y: Tensor, time: float) -> Tensor:
            nonlocal y1_hat
            t = y.new_full((len(y),), time)
            v = self._free(network(y, t, condition, ranks, y1_hat))
            if self.settings.self_condition:
                y1_hat = self.clean(y, t, v)
            return v

        for step in range(steps):
            with torch.set_grad_enabled(step >= steps - gradient_steps):
                y = _advance(velocity, y, step / steps, 1 / steps, solver)
        with torch.set_grad_enabled(gradient_steps > 0):
            return self.poses(y, condition)

    def mover(self, network: Velocity) -> Mover:
        """Returns the flow of a network as at inference: from x^c, or from a draw of the source that does not depend on x^c."""
        is_drawn = self.settings.source == "gaussian"
        return lambda condition, generator: self.sample(network, condition, generator=generator if is_drawn else None)


def _advance(velocity: Callable[[Tensor, float], Tensor], y: Tensor, t: float, dt: float, solver: Solver) -> Tensor:
    """Returns the coordinates after one solver step, (B, N, 4)."""
    v = velocity(y, t)
    if solver == "midpoint":
        v = velocity(y + dt / 2 * v, t + dt / 2)
    elif solver == "heun":
        v = (v + velocity(y + dt * v, t + dt)) / 2
    return y + dt * v
