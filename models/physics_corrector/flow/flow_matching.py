"""Conditional flow matching of poses: the linear path, its velocity, the clean estimate and the ODE (the paper's Method; appendix).

    x_0 = x^c + σ ε        x_t = (1 − t) x_0 + t x_1        v_target = x_1 − x_0        x̂_1 = x_t + (1 − t) v_θ(x_t, t, C)

All of it in the coordinates y of :mod:`~models.physics_corrector.flow.pose_coordinates`. Yaw goes the short way round from x_0
to x_1. Fixed objects and padding have x_0 = x_1 = x^c: they stand still on every path and in every sample.

The paper's method starts at x^c + σ ε, its training details speak of a standard Gaussian: ``source`` has both. Inference starts
at the source's mean, which is x^c in the first case, or at a draw from it.
"""

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Annotated, Literal, TypeAlias

import torch
from annotated_types import Interval
from torch import Tensor

from models.physics_corrector.flow.condition import Condition
from models.physics_corrector.flow.pose_coordinates import PoseCoordinates
from models.settings import NonNegative, Settings, Share

Source: TypeAlias = Literal["coarse", "gaussian"]
Solver: TypeAlias = Literal["euler", "midpoint", "heun"]
Velocity: TypeAlias = Callable[[Tensor, Tensor, Condition, Tensor, Tensor | None], Tensor]
"""v_θ: coordinates (B, N, 4), time (B,), condition, ranks (B, N), earlier clean estimate or None -> velocity (B, N, 4)."""


@dataclass(frozen=True, slots=True)
class FlowSettings(Settings):
    """How paths are drawn and followed."""

    coordinates: PoseCoordinates = field(default_factory=PoseCoordinates)
    """Coordinates in which the flow runs."""

    source: Source = "coarse"
    """Start of a path: ``coarse`` is x_0 = x^c + σ ε, ``gaussian`` is y_0 = ε, standard normal in the coordinates."""

    sigma: NonNegative = 0.2
    """σ in coordinate units: times ``length_unit`` metres, times ``yaw_unit`` radians."""

    self_condition: Share = 0.5
    """Probability that training feeds the clean estimate back to the network; 0 switches it off at inference too."""

    solver: Solver = "euler"
    """``euler``, ``midpoint`` or ``heun``."""

    steps: Annotated[int, Interval(ge=1, le=10_000)] = 8
    """Solver steps from t = 0 to 1; midpoint and heun evaluate the network twice a step."""


@dataclass(frozen=True, slots=True, eq=False)
class FlowPath:
    """A point on each scene's path.

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
    """What the network makes of a point on a path.

    Attributes:
        velocity: v_θ, (B, N, 4) float32, coordinate units.
        poses: The clean estimate x̂_1, (B, N, 4) float32: x, y, z in metres and yaw in radians, world frame; x^c itself for
            fixed objects and padding.
    """

    velocity: Tensor
    poses: Tensor


@dataclass(frozen=True, slots=True)
class FlowMatching:
    """Draws paths to learn from, and follows the learned field. Knows no network, only a function of :data:`Velocity`."""

    settings: FlowSettings

    def start(self, condition: Condition, generator: torch.Generator | None = None, *, draw: bool = True) -> Tensor:
        """y_0 of every object, (B, N, 4) float32: drawn from the source, or its mean."""
        coarse = self.settings.coordinates.encode(condition.poses, condition.poses)
        is_coarse = self.settings.source == "coarse"
        start = coarse if is_coarse else torch.zeros_like(coarse)
        if draw:
            noise = torch.randn(coarse.shape, device=coarse.device, generator=generator)
            start = start + (self.settings.sigma if is_coarse else 1.0) * noise
        return torch.where(condition.is_movable[..., None], start, coarse)

    def path(
        self, condition: Condition, targets: Tensor, generator: torch.Generator | None = None, t: Tensor | None = None
    ) -> FlowPath:
        """A point on the linear path to each scene's target.

        Args:
            condition: The scenes, coarse poses among them.
            targets: Clean poses x_1 = x^*, (B, N, 4) float32, metres and radians, world frame.
            generator: Randomness, on the condition's device.
            t: Flow times, (B,) float32; by default drawn from U[0, 1].
        """
        coordinates = self.settings.coordinates
        y_0 = self.start(condition, generator)
        movable = condition.is_movable[..., None]
        y_1 = coordinates.encode(torch.where(movable, targets, condition.poses), condition.poses)
        if t is None:
            t = torch.rand(len(y_0), device=y_0.device, generator=generator)
        velocity = torch.where(movable, coordinates.difference(y_0, y_1), 0)
        return FlowPath(y_0 + t[:, None, None] * velocity, t, velocity)

    def predict(
        self, network: Velocity, path: FlowPath, condition: Condition, generator: torch.Generator | None = None
    ) -> FlowPrediction:
        """The network's velocity and clean estimate at a point on the path, for training.

        Self-conditioning as in Analog Bits: for a share of the calls the network is asked once without gradient, and its clean
        estimate is fed back. Instance codes are drawn anew.
        """
        ranks = condition.random_ranks(generator)
        y1_hat = None
        coin = torch.rand((), device=path.y.device, generator=generator)
        if self.settings.self_condition and coin.item() < self.settings.self_condition:
            with torch.no_grad():
                y1_hat = self.clean(path.y, path.t, network(path.y, path.t, condition, ranks, None))
        velocity = network(path.y, path.t, condition, ranks, y1_hat)
        return FlowPrediction(velocity, self.poses(self.clean(path.y, path.t, velocity), condition))

    @staticmethod
    def clean(y: Tensor, t: Tensor, velocity: Tensor) -> Tensor:
        """The clean estimate ŷ_1 = y_t + (1 − t) v, (B, N, 4)."""
        return y + (1 - t)[:, None, None] * velocity

    def poses(self, y: Tensor, condition: Condition) -> Tensor:
        """The poses of coordinates, (B, N, 4); fixed objects and padding keep their coarse pose bit for bit."""
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
        """Corrected poses: dx/dt = v_θ(x, t, C) followed from t = 0 to 1.

        Args:
            network: The velocity field.
            condition: The scenes, coarse poses among them.
            generator: Where the start is drawn from; None starts at the source's mean, which for ``coarse`` is x^c as in the
                paper.
            steps: Instead of the settings'.
            solver: Instead of the settings'.
            gradient_steps: How many of the last steps keep their gradient, for fine-tuning through the sampler.

        Returns:
            Poses, (B, N, 4) float32, metres and radians, world frame, yaw in (−π, π]; fixed objects and padding as they came.
        """
        steps, solver = steps or self.settings.steps, solver or self.settings.solver
        ranks = condition.content_ranks()
        y = self.start(condition, generator, draw=generator is not None)
        y1_hat: Tensor | None = None

        def velocity(y: Tensor, time: float) -> Tensor:
            nonlocal y1_hat
            t = y.new_full((len(y),), time)
            v = network(y, t, condition, ranks, y1_hat)
            if self.settings.self_condition:
                y1_hat = self.clean(y, t, v)
            return v

        for step in range(steps):
            with torch.set_grad_enabled(step >= steps - gradient_steps):
                y = _advance(velocity, y, step / steps, 1 / steps, solver)
        with torch.set_grad_enabled(gradient_steps > 0):
            return self.poses(y, condition)


def _advance(velocity: Callable[[Tensor, float], Tensor], y: Tensor, t: float, dt: float, solver: Solver) -> Tensor:
    """One step of a solver, (B, N, 4)."""
    v = velocity(y, t)
    if solver == "midpoint":
        v = velocity(y + dt / 2 * v, t + dt / 2)
    elif solver == "heun":
        v = (v + velocity(y + dt * v, t + dt)) / 2
    return y + dt * v
