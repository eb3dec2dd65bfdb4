"""Settings of the corrector's training, and the named ones."""

import math
from dataclasses import asdict, dataclass, field, replace
from typing import Any, get_args

from models.physics_corrector.flow.presets import CorrectorSettings, preset
from models.physics_corrector.training.dataset import FeatureSource
from models.physics_corrector.training.losses import LossSettings
from models.physics_corrector.training.perturbation import PerturbationSettings
from models.physics_corrector.training.stage_prefixes import PrefixSettings
from stable_data.config_diff import flat
from stable_data.errors import ConfigError


@dataclass(frozen=True, slots=True)
class PhysicsSchedule:
    """When and on how much the physical losses are taken; their weights are those of ``LossSettings``.

    Attributes:
        share: Share of the scenes of a step that they are taken on, drawn anew each time; the sum is scaled by its inverse. 0
            leaves them to the sampled poses alone.
        from_time: Flow time from which on they count: an estimate made earlier is vague.
        power: w(t) = t^power from there on.
        start: Step at which they begin ...
        ramp: ... and steps over which they grow to their full weight.
        limit: A scene's weighted loss ℓ counts as limit · log(1 + ℓ / limit), so that one pile does not outweigh all near
            misses; 0 leaves it as it is, as in the paper.
        unroll_share: Share of the steps, the last ones, in which they are also taken on poses sampled as at inference.
        unroll_scenes: Share of the scenes of such a step that is sampled.
        unroll_gradient: How many of the sampler's last steps keep their gradient.
        unroll_weight: Weight of the losses there.
    """

    share: float = 0.25
    from_time: float = 0.3
    power: float = 2.0
    start: int = 0
    ramp: int = 0
    limit: float = 0.0
    unroll_share: float = 0.0
    unroll_scenes: float = 0.25
    unroll_gradient: int = 2
    unroll_weight: float = 1.0

    def __post_init__(self) -> None:
        """Refuses what cannot be drawn."""
        shares = (self.from_time, self.unroll_share)
        if not (0 <= self.share <= 1 and 0 < self.unroll_scenes <= 1 and all(0 <= share <= 1 for share in shares)):
            raise ConfigError(f"physics: {asdict(self)}, expected shares and times between 0 and 1", "config_invalid")
        if min(self.start, self.ramp, self.unroll_gradient) < 0 or min(self.power, self.limit, self.unroll_weight) < 0:
            raise ConfigError(f"physics: {asdict(self)}, expected no negative figure", "config_invalid")


@dataclass(frozen=True, slots=True)
class CorrectorTrainingSettings:
    """What shapes the weights; ``--set key=value`` or the table ``[train_corrector]`` of a TOML file.

    Attributes:
        seed: Of the first weights and of every draw.
        initial: Weights to start from, a file of a corrector with the same network; empty draws them from the seed.
        steps: Length of the run; 0 takes ``epochs``.
        epochs: Length in passes over the scenes.
        batch_size: Scenes of a step.
        chunk: Scenes that go through the network together; those of a step are sorted by their number of objects and cut into
            chunks, whose gradients add up. It bounds memory, and spares padding.
        learning_rate: Of Adam.
        warm_up: Steps over which it grows to that.
        cool_down: Share of the steps, the last ones, over which it falls to 0.
        ema: Decay of the average of the weights, which is what is kept in the end.
        clip: Largest norm of a gradient.
        features: ``point`` or ``box``; ``box`` makes a network that reads no features.
        num_surface: Samples of a surface for L_obj-obj.
        num_bottom: Samples of a bottom region for L_sup.
        perturbation: How coarse layouts are made.
        prefixes: Which parts of scenes are trained on.
        physics: When the physical losses count.
        losses: Their weights and tolerances.
        corrector: Network and flow.
    """

    seed: int = 0
    initial: str = ""
    steps: int = 0
    epochs: int = 5000
    batch_size: int = 2048
    chunk: int = 256
    learning_rate: float = 2e-4
    warm_up: int = 0
    cool_down: float = 0.0
    ema: float = 0.999
    clip: float = 1.0
    features: FeatureSource = "point"
    num_surface: int = 256
    num_bottom: int = 64
    perturbation: PerturbationSettings = field(default_factory=PerturbationSettings)
    prefixes: PrefixSettings = field(default_factory=PrefixSettings)
    physics: PhysicsSchedule = field(default_factory=PhysicsSchedule)
    losses: LossSettings = field(default_factory=LossSettings)
    corrector: CorrectorSettings = field(default_factory=CorrectorSettings)

    def __post_init__(self) -> None:
        """Refuses what cannot run."""
        for key in ("batch_size", "chunk", "num_surface", "num_bottom", "learning_rate", "clip"):
            if not 0 < getattr(self, key) < math.inf:
                raise ConfigError(f"{key} is {getattr(self, key)}, expected a positive number", "config_invalid")
        if not (min(self.steps, self.epochs, self.warm_up) >= 0 and self.steps + self.epochs > 0):
            found = f"steps {self.steps}, epochs {self.epochs}, warm_up {self.warm_up}"
            raise ConfigError(f"{found}: expected a length, and nothing negative", "config_invalid")
        if not (0 <= self.ema < 1 and 0 <= self.cool_down <= 1):
            raise ConfigError(f"ema is {self.ema}, cool_down {self.cool_down}, expected shares", "config_invalid")
        followed = self.losses.flow_weight > 0 or self.physics.share > 0
        if not followed and (self.physics.unroll_share < 1 or self.physics.start > 0):
            found = f"physics.unroll_share {self.physics.unroll_share}, physics.start {self.physics.start}"
            raise ConfigError(
                f"{found}: with losses.flow_weight and physics.share 0 there are steps without a loss, expected 1 and 0",
                "config_invalid",
            )
        if self.features not in get_args(FeatureSource):
            raise ConfigError(f"features is {self.features!r}, expected point or box", "config_invalid")

    def resolved(self, num_scenes: int) -> "CorrectorTrainingSettings":
        """The same with ``steps`` set, and without features where the network is to read none."""
        steps = self.steps or max(1, math.ceil(self.epochs * num_scenes / self.batch_size))
        network = self.corrector.network
        if self.features == "box":
            network = replace(network, num_features=0)
        return replace(self, steps=steps, corrector=replace(self.corrector, network=network))

    def learning_rate_at(self, step: int) -> float:
        """Adam's learning rate at a step of a run whose ``steps`` is set."""
        grown = min(1.0, (step + 1) / self.warm_up) if self.warm_up else 1.0
        last = self.cool_down * self.steps
        left = min(1.0, (self.steps - step) / last) if last else 1.0
        return self.learning_rate * grown * left

    def physics_at(self, step: int) -> float:
        """By how much the physical losses have grown at a step, 0 to 1."""
        since = step - self.physics.start
        return 0.0 if since < 0 else min(1.0, (since + 1) / self.physics.ramp) if self.physics.ramp else 1.0

    def is_unrolled_at(self, step: int) -> bool:
        """Whether a step also looks at sampled poses."""
        return step >= (1 - self.physics.unroll_share) * self.steps

    def flat(self) -> dict[str, Any]:
        """Every setting by its dotted key."""
        return flat(asdict(self))


NEAR = "embedded_set_near"
"""The preset that goes on from the weights of ``embedded_set``; ``initial`` names them."""


def training_preset(name: str) -> CorrectorTrainingSettings:
    """Named settings: ``paper`` and ``paper_set`` as in the paper's appendix, ``embedded`` and ``embedded_set`` for a CPU.

    Raises:
        ConfigError: There are none of that name.
    """
    if name == NEAR:
        return _near(training_preset("embedded_set"))
    corrector = preset(name)
    if name.startswith("paper"):
        return CorrectorTrainingSettings(corrector=corrector)
    # What an hour of one core allows: few sampler steps, and for most of the run physics on what they give. The weights are far
    # above the paper's, whose physical terms are thousandths of L_flow here and hardly move a network in so few steps.
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
    """Settings that teach a trained corrector to move little: no L_flow, and a price on what the sampler's poses move.

    What is clean and near is learned from the losses alone. Half the sampler's steps do: it has less far to go, and each step
    costs as much to learn through as to take.
    """
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
