"""Settings of the corrector's training, and their presets."""

import math
from dataclasses import asdict, dataclass, field, replace
from typing import Annotated, Any

from annotated_types import Interval

from models.physics_corrector.flow.presets import CorrectorSettings, preset
from models.physics_corrector.training.dataset import FeatureSource
from models.physics_corrector.training.losses import LossSettings
from models.physics_corrector.training.perturbation import PerturbationSettings
from models.physics_corrector.training.stage_prefixes import PrefixSettings
from models.settings import Count, NonNegative, Positive, PositiveCount, Settings, Share
from stable_data.config_diff import flatten_config
from stable_data.errors import ConfigError


@dataclass(frozen=True, slots=True)
class PhysicsSchedule(Settings):
    """When and on which scenes the physical losses apply; their weights are in ``LossSettings``."""

    share: Share = 0.25
    """Share of a step's scenes with physical losses, drawn at each step; their sum is scaled by its inverse.
    0 applies them to sampled poses only.
    """

    from_time: Share = 0.3
    """Flow time from which the losses count; earlier estimates of the clean poses are inaccurate."""

    power: NonNegative = 2.0
    """Exponent p of the weight w(t) = t^p of flow time t."""

    start: Count = 0
    """First step with the losses."""

    ramp: Count = 0
    """Number of steps from ``start`` over which the losses grow to their full weight."""

    limit: NonNegative = 0.0
    """A scene's weighted loss ℓ counts as limit · log(1 + ℓ / limit), so that one scene with a large loss does not dominate;
    0 disables the limit, as in the paper.
    """

    unroll_share: Share = 0.0
    """Share of the steps, at the end, in which the losses also apply to poses that are sampled as at inference."""

    unroll_scenes: Annotated[float, Interval(gt=0, le=1)] = 0.25
    """Share of the scenes of such a step that are sampled."""

    unroll_gradient: Count = 2
    """Number of last solver steps with gradients when poses are sampled."""

    unroll_weight: NonNegative = 1.0
    """Weight of the losses on sampled poses."""


@dataclass(frozen=True, slots=True)
class CorrectorTrainingSettings(Settings):
    """Settings that determine the weights; ``--set key=value`` or the table ``[train_corrector]`` of a TOML file."""

    seed: int = 0
    """Seed of the initial weights and of all draws."""

    initial: str = ""
    """File of a corrector with the same network whose weights initialise the training; empty draws weights from the seed."""

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
    """Decay of the exponential moving average of the weights; the average is saved."""

    clip: Positive = 1.0
    """Largest norm of the gradient."""

    features: FeatureSource = "point"
    """The network's inputs of a shape: ``point`` (point features and extents) or ``box`` (extents alone)."""

    num_surface: PositiveCount = 256
    """Points of an object's surface for L_obj-obj."""

    num_bottom: PositiveCount = 64
    """Points of an object's bottom region for L_sup."""

    perturbation: PerturbationSettings = field(default_factory=PerturbationSettings)
    """Errors of the coarse layouts."""

    prefixes: PrefixSettings = field(default_factory=PrefixSettings)
    """Parts of the scenes."""

    physics: PhysicsSchedule = field(default_factory=PhysicsSchedule)
    """Schedule of the physical losses."""

    losses: LossSettings = field(default_factory=LossSettings)
    """Weights and tolerances of the losses."""

    corrector: CorrectorSettings = field(default_factory=CorrectorSettings)
    """Network and flow."""

    def check(self) -> None:
        """Refuses a run without steps, and steps without a loss; see the base class."""
        if self.steps + self.epochs == 0:
            raise ConfigError("steps and epochs are 0, expected at least one positive", "config_invalid")
        has_path_loss = self.losses.flow_weight > 0 or self.physics.share > 0
        if not has_path_loss and (self.physics.unroll_share < 1 or self.physics.start > 0):
            found = f"physics.unroll_share {self.physics.unroll_share}, physics.start {self.physics.start}"
            raise ConfigError(
                f"{found}: with losses.flow_weight and physics.share 0 there are steps without a loss, expected 1 and 0",
                "config_invalid",
            )

    def resolved(self, num_scenes: int) -> "CorrectorTrainingSettings":
        """Returns the settings with ``steps`` computed, and with no features of the network if ``features`` is ``box``."""
        steps = self.steps or max(1, math.ceil(self.epochs * num_scenes / self.batch_size))
        network = self.corrector.network
        if self.features == "box":
            network = replace(network, num_features=0)
        return replace(self, steps=steps, corrector=replace(self.corrector, network=network))

    def learning_rate_at(self, step: int) -> float:
        """Adam's learning rate at a step; ``steps`` must be positive."""
        grown = min(1.0, (step + 1) / self.warm_up) if self.warm_up else 1.0
        last = self.cool_down * self.steps
        left = min(1.0, (self.steps - step) / last) if last else 1.0
        return self.learning_rate * grown * left

    def physics_at(self, step: int) -> float:
        """The factor of the physical losses at a step, 0 to 1."""
        since = step - self.physics.start
        return 0.0 if since < 0 else min(1.0, (since + 1) / self.physics.ramp) if self.physics.ramp else 1.0

    def is_unrolled_at(self, step: int) -> bool:
        """Whether the losses of a step include sampled poses."""
        return step >= (1 - self.physics.unroll_share) * self.steps

    def flat(self) -> dict[str, Any]:
        """All settings by dotted key."""
        return flatten_config(asdict(self))


NEAR = "embedded_set_near"
"""The preset that fine-tunes the weights of ``embedded_set``; ``initial`` is their file."""


def training_preset(name: str) -> CorrectorTrainingSettings:
    """Returns named settings: ``paper`` and ``paper_set`` as in the paper's appendix, ``embedded`` and ``embedded_set`` for a CPU.

    Raises:
        ConfigError: The name is unknown.
    """
    if name == NEAR:
        return _near(training_preset("embedded_set"))
    corrector = preset(name)
    if name.startswith("paper"):
        return CorrectorTrainingSettings(corrector=corrector)
    # One hour on one core allows few sampler steps, with physical losses on sampled poses for most of the run. The weights are
    # far above the paper's: with those, the physical terms are thousandths of L_flow and have no effect in so few steps.
    return CorrectorTrainingSettings(
        steps=12_000,
        epochs=0,
        batch_size=32,
        chunk=16,
        learning_rate=1e-3,
        warm_up=200,
        cool_down=0.4,
        ema=0.998,
        perturbation=PerturbationSettings(jitter=0.4, swap=0.05, edge=0.05),
        physics=PhysicsSchedule(share=0.5, limit=1.0, unroll_share=0.8, unroll_scenes=0.5, unroll_weight=2.0),
        losses=LossSettings(sdf_weight=5.0, support_weight=2.5, bounds_weight=0.5, clearance=1e-3),
        corrector=replace(corrector, flow=replace(corrector.flow, steps=4)),
    )


def _near(settings: CorrectorTrainingSettings) -> CorrectorTrainingSettings:
    """Settings that teach a trained corrector to move little: no L_flow, and a loss on the movement of sampled poses."""
    # Half of the sampler's steps are enough: movements are shorter, and each step costs time in training and in inference.
    flow = replace(settings.corrector.flow, steps=2)
    return replace(
        settings,
        steps=1_600,
        learning_rate=5e-4,
        warm_up=50,
        cool_down=0.5,
        ema=0.995,
        physics=PhysicsSchedule(share=0.0, limit=10.0, unroll_share=1.0, unroll_scenes=1.0),
        losses=replace(settings.losses, flow_weight=0.0, move_weight=0.35, order_weight=1.0, clearance=1.5e-3),
        corrector=replace(settings.corrector, flow=flow),
    )
