"""Settings of the corrector's training, and their presets."""

import math
from dataclasses import dataclass, field, replace
from typing import Annotated, Self

from annotated_types import Interval

from models.physics_corrector.flow.presets import CorrectorSettings, preset
from models.physics_corrector.flow.velocity_network import VelocityNetworkSettings
from models.physics_corrector.training.hints import HintSettings
from models.physics_corrector.training.layout_settings import LayoutTrainingSettings
from models.physics_corrector.training.losses import LossSettings
from models.physics_corrector.training.perturbation import PerturbationSettings
from models.physics_corrector.training.stage_prefixes import PrefixSettings
from models.settings import Count, NonNegative, Settings, Share
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
class CorrectorTrainingSettings(LayoutTrainingSettings):
    """Settings that determine the weights; ``--set key=value`` or the table ``[train_corrector]`` of a TOML file."""

    initial: str = ""
    """File of a corrector with the same network whose weights initialise the training; empty draws weights from the seed."""

    physics: PhysicsSchedule = field(default_factory=PhysicsSchedule)
    """Schedule of the physical losses."""

    losses: LossSettings = field(default_factory=LossSettings)
    """Weights and tolerances of the losses."""

    corrector: CorrectorSettings = field(default_factory=CorrectorSettings)
    """Network and flow."""

    def check(self) -> None:
        """Refuses a run without steps, and steps without a loss; see the base class."""
        LayoutTrainingSettings.check(self)  # super() does not find its class in a dataclass with slots
        has_path_loss = self.losses.flow_weight > 0 or self.physics.share > 0
        if not has_path_loss and (self.physics.unroll_share < 1 or self.physics.start > 0):
            found = f"physics.unroll_share {self.physics.unroll_share}, physics.start {self.physics.start}"
            raise ConfigError(
                f"{found}: with losses.flow_weight and physics.share 0 there are steps without a loss, expected 1 and 0",
                "config_invalid",
            )

    @property
    def network(self) -> VelocityNetworkSettings:
        """See the base class."""
        return self.corrector.network

    def with_network(self, network: VelocityNetworkSettings) -> Self:
        """See the base class."""
        return replace(self, corrector=replace(self.corrector, network=network))

    def physics_at(self, step: int) -> float:
        """The factor of the physical losses at a step, 0 to 1."""
        since = step - self.physics.start
        return 0.0 if since < 0 else min(1.0, (since + 1) / self.physics.ramp) if self.physics.ramp else 1.0

    def is_unrolled_at(self, step: int) -> bool:
        """Whether the losses of a step include sampled poses."""
        return step >= (1 - self.physics.unroll_share) * self.steps


def training_preset(name: str) -> CorrectorTrainingSettings:
    """Returns named settings: ``paper`` to the letter, ``paper_tuned`` and ``paper_set`` at its size, the others for a CPU.

    Raises:
        ConfigError: The name is unknown.
    """
    corrector = preset(name)
    if name == "paper":
        return CorrectorTrainingSettings(
            corrector=corrector,
            ema=0.0,
            clip=0.0,
            prefixes=PrefixSettings(fixed=0.0),
            physics=PhysicsSchedule(share=1.0, from_time=0.0, power=0.0),
            hints=HintSettings(errors=0.0, order=0.0, features=1.0, texts=1.0),
        )
    if name.startswith("paper"):
        return CorrectorTrainingSettings(corrector=corrector)
    # Refinement separates objects and geometry gives heights. L_flow teaches where things belong; in the last part of the steps,
    # collisions of sampled poses count as well.
    return CorrectorTrainingSettings(
        steps=60_000,
        epochs=0,
        batch_size=64,
        chunk=32,
        precision="bfloat16",
        learning_rate=1e-3,
        warm_up=500,
        cool_down=0.5,
        ema=0.999,
        perturbation=PerturbationSettings(
            small=0.25,
            jitter=0.55,
            swap=0.05,
            pile=0.05,
            height=0.0,
            edge=0.1,
            xy_high=0.12,
            yaw_low=math.radians(2),
            together=0.5,
        ),
        scattered=0.25,
        physics=PhysicsSchedule(share=0.0, limit=1.0, unroll_share=0.1, unroll_scenes=0.25, unroll_gradient=1),
        losses=LossSettings(sdf_weight=1.0, support_weight=0.0, table_factor=0.0, bounds_weight=0.5, clearance=1e-3),
        corrector=corrector,
    )
