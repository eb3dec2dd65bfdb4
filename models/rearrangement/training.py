"""The training of a rearranger, on the samples of the corrector's training: the same scenes, errors, steps and optimizer."""

from dataclasses import dataclass, field, fields, replace
from typing import Self

import torch
from torch import Tensor

from models.physics_corrector.flow.flow_matching import Mover
from models.physics_corrector.flow.velocity_network import VelocityNetworkSettings
from models.physics_corrector.training.dataset import TrainingSet
from models.physics_corrector.training.layout_settings import LayoutTrainingSettings
from models.physics_corrector.training.layout_trainer import CoarseSamples, LayoutTrainer, seeded_network
from models.physics_corrector.training.settings import training_preset as corrector_preset
from models.rearrangement.scene_noise import SceneNoise, drawn_seeds
from models.rearrangement.settings import METHODS, RearrangerSettings
from models.rearrangement.weights import build_network, method_of
from models.training.distributed import CPU, ProcessContext
from stable_data.errors import ConfigError

_LIKE = "embedded_set"  # the preset of the corrector with the same network and training


@dataclass(frozen=True, slots=True)
class RearrangerTrainingSettings(LayoutTrainingSettings):
    """Settings that determine the weights; ``--set key=value`` or the table ``[train_rearranger]`` of a TOML file."""

    rearranger: RearrangerSettings = field(default_factory=RearrangerSettings)
    """Method and network."""

    @property
    def network(self) -> VelocityNetworkSettings:
        """See the base class."""
        return self.rearranger.network

    def with_network(self, network: VelocityNetworkSettings) -> Self:
        """See the base class."""
        return replace(self, rearranger=replace(self.rearranger, network=network))


def training_preset(method: str) -> RearrangerTrainingSettings:
    """Returns the settings of a method with network, coordinates and training of the corrector's preset ``embedded_set``.

    With the same units, the losses weigh a turn and a length as the flow's does.

    Raises:
        ConfigError: The method is unknown.
    """
    if method not in METHODS:
        raise ConfigError(f"method {method!r} is unknown, expected one of {', '.join(METHODS)}", "config_invalid")
    like = corrector_preset(_LIKE)
    shared = {f.name: getattr(like, f.name) for f in fields(LayoutTrainingSettings)}
    network = replace(like.network, reads_errors=method != "lego_net")
    flow = like.corrector.flow
    rearranger = RearrangerSettings(method, network, flow.coordinates, flow.heights)
    return RearrangerTrainingSettings(**shared, rearranger=rearranger)


class RearrangerTrainer(LayoutTrainer):
    """The state of a rearranger's training.

    Args:
        data: The scenes; copied to the device.
        settings: The training's settings, resolved.
        place: The process and its device.

    Attributes:
        method: The method.
    """

    LOGGED = ("denoising",)

    settings: RearrangerTrainingSettings

    def __init__(self, data: TrainingSet, settings: RearrangerTrainingSettings, place: ProcessContext = CPU) -> None:
        self.method = method_of(settings.rearranger)
        super().__init__(data, settings, seeded_network(settings.seed, lambda: build_network(settings.rearranger)), place)

    def _loss(self, samples: CoarseSamples, share: float, generator: torch.Generator) -> tuple[Tensor, Tensor]:
        """See the base class."""
        loss = share * self.method.loss(self.velocity(), samples.condition, samples.targets, generator)
        return loss, loss.detach()[None]

    def mover(self) -> Mover:
        """Returns what moves objects by the averaged weights: one sample of each scene, without a choice."""
        velocity = self.velocity(self.averaged())
        return lambda condition, generator: self.method.sample(
            velocity, condition, SceneNoise(condition, drawn_seeds(len(condition), generator))
        )
