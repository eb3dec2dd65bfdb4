"""The noise levels of a diffusion, and its steps back: DDPM (Ho et al. 2020) and DDIM (Song et al. 2021).

    y_k = √ᾱ_k y_0 + √(1 − ᾱ_k) ε,  ε ~ N(0, I),  k = 0 … T,  ᾱ_0 = 1

A step from level k to a lower level j, with the estimates ε̂ and ŷ_0 = (y_k − √(1 − ᾱ_k) ε̂) / √ᾱ_k:

    y_j = √ᾱ_j ŷ_0 + √(1 − ᾱ_j − σ²) ε̂ + σ z,   σ² = η² (1 − ᾱ_j) / (1 − ᾱ_k) · (1 − ᾱ_k / ᾱ_j)

η = 1 is ancestral sampling, η = 0 is DDIM. A step to level 0 gives ŷ_0.
"""

import math
from dataclasses import dataclass
from typing import Literal, TypeAlias

import torch
from torch import Tensor

_COSINE_OFFSET = 0.008  # Nichol and Dhariwal 2021
_LARGEST_RATE = 0.999  # of one level: the last level keeps some signal, so that its root can divide
_LINEAR_RATES = (1e-4, 0.02)  # of DDPM, for 1000 levels
_LINEAR_LEVELS = 1000

Schedule: TypeAlias = Literal["cosine", "linear", "published"]
"""``published``: the rates of DDPM whatever the number of levels, as StructDiffusion has them for 200; ``linear`` scales them."""


@dataclass(frozen=True, slots=True, eq=False)
class NoiseSchedule:
    """The share of signal at each level.

    Attributes:
        signal: ᾱ_0 … ᾱ_T, (T + 1,) float64, falling from 1.
    """

    signal: Tensor

    @classmethod
    def of(cls, times: int, schedule: Schedule) -> "NoiseSchedule":
        """Makes a schedule of T levels."""
        if schedule == "cosine":
            level = torch.arange(times + 1, dtype=torch.float64) / times
            found = torch.cos((level + _COSINE_OFFSET) / (1 + _COSINE_OFFSET) * math.pi / 2).square()
            rates = 1 - found[1:] / found[:-1]
        else:
            scale = _LINEAR_LEVELS / times if schedule == "linear" else 1.0
            rates = torch.linspace(scale * _LINEAR_RATES[0], scale * _LINEAR_RATES[1], times, dtype=torch.float64)
        kept = torch.cumprod(1 - rates.clamp(0, _LARGEST_RATE), 0)
        return cls(torch.cat([torch.ones(1, dtype=torch.float64), kept]))

    @property
    def times(self) -> int:
        """The number T of levels with noise."""
        return len(self.signal) - 1

    def levels(self, steps: int) -> list[int]:
        """Returns the levels that a sampler of some steps visits, from T down to 0; all for 0 steps or more than T."""
        count = min(steps or self.times, self.times)
        return [round(self.times * (count - n) / count) for n in range(count + 1)]

    def noised(self, y0: Tensor, noise: Tensor, levels: Tensor) -> Tensor:
        """Returns y_k of clean coordinates (B, N, C) and noise (B, N, C) at the level of each scene, (B,) int64."""
        signal = self.signal.to(y0.device)[levels].to(y0.dtype)[:, None, None]
        return signal.sqrt() * y0 + (1 - signal).sqrt() * noise

    def clean(self, y: Tensor, noise: Tensor, level: int) -> Tensor:
        """Returns ŷ_0 of y_k and an estimate of its noise, k ≥ 1."""
        signal = float(self.signal[level])
        return (y - math.sqrt(1 - signal) * noise) / math.sqrt(signal)

    def noise(self, y: Tensor, y0: Tensor, level: int) -> Tensor:
        """Returns ε̂ of y_k and an estimate of its clean coordinates, k ≥ 1: the inverse of :meth:`clean`."""
        signal = float(self.signal[level])
        return (y - math.sqrt(signal) * y0) / math.sqrt(1 - signal)

    def step(self, y: Tensor, y0: Tensor, level: int, lower: int, drawn: Tensor | None = None) -> Tensor:
        """Returns y_j of y_k and an estimate of its clean coordinates.

        Args:
            y: y_k, (B, N, C).
            y0: ŷ_0, (B, N, C).
            level: k.
            lower: j, less than k.
            drawn: z for ancestral sampling; None for DDIM.
        """
        now, then = float(self.signal[level]), float(self.signal[lower])
        spread = 0.0 if drawn is None else math.sqrt((1 - then) / (1 - now) * (1 - now / then))
        found = math.sqrt(then) * y0 + math.sqrt(max(0.0, 1 - then - spread**2)) * self.noise(y, y0, level)
        return found if drawn is None else found + spread * drawn
