"""Settings that all trainings of networks that move objects share."""

import math
from abc import ABC, abstractmethod
from dataclasses import asdict, dataclass, field, replace
from typing import Annotated, Any, Literal, Self

from annotated_types import Interval

from models.physics_corrector.flow.velocity_network import VelocityNetworkSettings
from models.physics_corrector.training.hints import HintSettings
from models.physics_corrector.training.perturbation import PerturbationSettings
from models.physics_corrector.training.sources import FeatureSource
from models.physics_corrector.training.stage_prefixes import PrefixSettings
from models.settings import Count, NonNegative, Positive, PositiveCount, Settings, Share
from stable_data.config_diff import flatten_config
from stable_data.errors import ConfigError


@dataclass(frozen=True, slots=True)
class LayoutTrainingSettings(Settings, ABC):
    """Samples, optimizer and length of a training; a subclass has the network and the loss."""

    seed: int = 0
    """Seed of the initial weights and of all draws."""

    steps: Count = 0
    """Optimizer steps; 0 uses ``epochs``."""

    epochs: Count = 5000
    """Passes over the scenes; read only if ``steps`` is 0."""

    batch_size: PositiveCount = 2048
    """Scenes per step."""

    chunk: PositiveCount = 256
    """Scenes per pass through the network. A step's scenes are sorted by their number of objects and split into chunks, whose
    gradients are summed; a smaller chunk needs less memory and less padding.
    """

    learning_rate: Positive = 2e-4
    """Learning rate of Adam."""

    warm_up: Count = 0
    """Number of first steps over which the learning rate rises to its value."""

    cool_down: Share = 0.0
    """Share of the steps, at the end, over which the learning rate falls to 0."""

    ema: Annotated[float, Interval(ge=0, lt=1)] = 0.999
    """Decay of the exponential moving average of the weights; the average is saved. 0 saves the weights themselves."""

    clip: NonNegative = 1.0
    """Largest norm of the gradient; 0 does not limit it."""

    precision: Literal["auto", "float32", "bfloat16"] = "auto"
    """Numbers of the network's matrix products; ``auto`` is bfloat16 on CUDA and float32 elsewhere. Weights, poses and losses are
    float32.
    """

    features: FeatureSource = "point"
    """The network's inputs of a shape: ``point`` (point features and extents) or ``box`` (extents alone)."""

    num_surface: PositiveCount = 256
    """Points of an object's surface: for L_obj-obj, and for the figures of validation."""

    num_bottom: PositiveCount = 64
    """Points of an object's bottom region for L_sup."""

    perturbation: PerturbationSettings = field(default_factory=PerturbationSettings)
    """Errors of the coarse layouts."""

    targets: Literal["clean", "repair"] = "clean"
    """Scenes that are not clean are left out (``clean``), or corrected first (``repair``)."""

    proposed: Share = 0.3
    """Share of samples that are proposals of a reasoner with their corrections, if a run with proposals is given."""

    scattered: Share = 0.0
    """Share of the other samples whose arrangement is replaced by a random one, so that habits of one world are not forced on all
    others.
    """

    hints: HintSettings = field(default_factory=HintSettings)
    """What a sample tells the network besides shapes and coarse poses."""

    prefixes: PrefixSettings = field(default_factory=PrefixSettings)
    """Parts of the scenes."""

    def check(self) -> None:
        """Refuses a run without steps; see the base class."""
        if self.steps + self.epochs == 0:
            raise ConfigError("steps and epochs are 0, expected at least one positive", "config_invalid")

    @property
    @abstractmethod
    def network(self) -> VelocityNetworkSettings:
        """The shape of the network."""

    @abstractmethod
    def with_network(self, network: VelocityNetworkSettings) -> Self:
        """Returns the settings with another network."""

    def resolved(self, num_scenes: int) -> Self:
        """Returns the settings with ``steps`` computed, and with no features of the network if ``features`` is ``box``."""
        steps = self.steps or max(1, math.ceil(self.epochs * num_scenes / self.batch_size))
        network = replace(self.network, num_features=0) if self.features == "box" else self.network
        return replace(self.with_network(network), steps=steps)

    def learning_rate_at(self, step: int) -> float:
        """Adam's learning rate at a step; ``steps`` must be positive."""
        grown = min(1.0, (step + 1) / self.warm_up) if self.warm_up else 1.0
        last = self.cool_down * self.steps
        left = min(1.0, (self.steps - step) / last) if last else 1.0
        return self.learning_rate * grown * left

    def flat(self) -> dict[str, Any]:
        """All settings by dotted key."""
        return flatten_config(asdict(self))
