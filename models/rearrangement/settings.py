"""Settings of the rearrangers. Numbers that are not of this project are those of the methods' papers and published code."""

from dataclasses import dataclass, field, replace
from typing import Annotated, Literal, TypeAlias, get_args

from annotated_types import Interval

from models.physics_corrector.flow.heights import Heights
from models.physics_corrector.flow.pose_coordinates import PoseCoordinates
from models.physics_corrector.flow.velocity_network import VelocityNetworkSettings
from models.rearrangement.noise_schedule import Schedule
from models.settings import Count, NonNegative, PositiveCount, Settings, Share
from stable_data.errors import ConfigError

Method: TypeAlias = Literal["lego_net", "struct_diffusion"]
METHODS: tuple[Method, ...] = get_args(Method)


@dataclass(frozen=True, slots=True)
class LegoNetSettings(Settings):
    """Loss and iteration of LEGO-Net. Its lengths are shares of half a room (6 m; 12 m for living rooms); here of half a table, 0.5 m."""

    l1_weight: NonNegative = 0.07
    """Weight of the absolute error beside the squared one."""

    step: Annotated[float, Interval(gt=0, le=1)] = 0.1
    """Share of the predicted displacement that the first step takes."""

    step_decay: NonNegative = 0.005
    """Step k takes the share step / (1 + step_decay · k)."""

    noise: NonNegative = 0.005
    """Metres; standard deviation of the noise along each axis that the first steps add."""

    noise_yaw: NonNegative = 0.08
    """Radians; the same of yaw."""

    noise_decay: Share = 0.9
    """Factor of the noise after every ``noise_steps`` steps."""

    noise_steps: PositiveCount = 10
    """Steps with the same noise."""

    still: NonNegative = 0.001
    """Metres; a scene is still if the mean predicted displacement of its objects is smaller, and that of yaw too."""

    still_yaw: NonNegative = 0.005
    """Radians; see above."""

    still_steps: PositiveCount = 3
    """A scene that was still at this many successive steps is finished."""

    max_steps: PositiveCount = 500
    """Largest number of steps. LEGO-Net has 1500; here steps and noise have become small by then."""


@dataclass(frozen=True, slots=True)
class StructDiffusionSettings(Settings):
    """Noise schedule and sampler of the pose diffusion."""

    times: Annotated[int, Interval(ge=1, le=10_000)] = 200
    """Number T of noise levels."""

    schedule: Schedule = "cosine"
    """Share of signal at each noise level: ``cosine``; ``published``, rates from 0.0001 to 0.02 over the T levels, which leave 13 % of
    the signal at the last of 200; or ``linear``, which scales these rates by 1000 / T, so that the last level is noise for every T.
    """

    sampler: Literal["ancestral", "ddim"] = "ancestral"
    """``ancestral`` draws noise at each step, as DDPM; ``ddim`` only at the start."""

    steps: Count = 0
    """Steps of the sampler, at evenly spaced noise levels; 0 takes all levels."""

    samples: Annotated[int, Interval(ge=1, le=1024)] = 8
    """Samples of each scene, of which the best is chosen."""


@dataclass(frozen=True, slots=True)
class RearrangerSettings(Settings):
    """The settings that a rearranger's weights belong to."""

    method: Method = "lego_net"
    """``lego_net`` or ``struct_diffusion``."""

    network: VelocityNetworkSettings = field(default_factory=VelocityNetworkSettings)
    """The shape of the network, which is that of the corrector."""

    coordinates: PoseCoordinates = field(default_factory=PoseCoordinates)
    """Units of displacements, those of the corrector's flow by default. Their form must be ``residual``."""

    heights: Heights = "geometry"
    """``learned``, or with ``geometry`` heights follow from the supports, as in the corrector."""

    lego_net: LegoNetSettings = field(default_factory=LegoNetSettings)
    """Read by ``lego_net`` alone."""

    struct_diffusion: StructDiffusionSettings = field(default_factory=StructDiffusionSettings)
    """Read by ``struct_diffusion`` alone."""

    def with_steps(self, steps: int) -> "RearrangerSettings":
        """Returns the settings with another largest number of steps of the method."""
        lego_net, diffusion = replace(self.lego_net, max_steps=steps), replace(self.struct_diffusion, steps=steps)
        return replace(self, lego_net=lego_net, struct_diffusion=diffusion)

    def check(self) -> None:
        """Refuses absolute coordinates, and errors that LEGO-Net would be told; see the base class."""
        if self.coordinates.form != "residual":
            raise ConfigError("coordinates.form is absolute, expected residual: the methods move objects", "config_invalid")
        if self.method == "lego_net" and self.network.reads_errors:
            raise ConfigError(
                "network.reads_errors is true, expected false for lego_net: the errors change at each of its steps",
                "config_invalid",
            )
