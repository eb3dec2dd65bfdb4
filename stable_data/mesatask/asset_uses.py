"""How scenes use an asset: the scales, aspects and tilts of its objects, of which its grids and point features are made."""

from array import array
from collections.abc import Iterable
from dataclasses import dataclass, field
from typing import TypeAlias

import numpy as np

from stable_data.geometry.sdf.aspects import aspect_steps
from stable_data.rotations import canonical_quaternion, tilt_key
from stable_data.scene import QuatXyzw, Vec3

MOST_SCALES = 1001
"""Scales of an asset of which its typical scale is the median; further ones are not looked at."""

_MOST_TILTS = 8
_EVEN = (0, 0, 0)  # the aspect of uniform scales, in steps

ShapeKey: TypeAlias = tuple[tuple[int, int, int], QuatXyzw]
"""Aspect in steps and rounded tilt."""


@dataclass(frozen=True, slots=True)
class ShapeUse:
    """An aspect and tilt in which scenes use an asset.

    Attributes:
        steps: The aspect, in steps of 5 % (``stable_data.geometry.sdf.aspects.aspect_steps``).
        tilt_quat_xyzw: Rotation before yaw.
        scale: Median of the scales' largest components, metres per mesh unit.
    """

    steps: tuple[int, int, int]
    tilt_quat_xyzw: QuatXyzw
    scale: float


@dataclass(slots=True)
class AssetUseCount:
    """Counts how scenes use an asset.

    Attributes:
        scales: The first scales, at most :data:`MOST_SCALES`, three numbers each, metres per mesh unit.
        tilts: Rounded tilt -> the first tilt that is rounded to it, and how many objects have it.
        shapes: Aspect in steps and rounded tilt -> the largest component of each scale, metres per mesh unit.
    """

    scales: "array[float]" = field(default_factory=lambda: array("d"))
    tilts: dict[QuatXyzw, tuple[QuatXyzw, int]] = field(default_factory=dict)
    shapes: dict[ShapeKey, "array[float]"] = field(default_factory=dict)

    def add(self, scale: Vec3 | None, tilt: QuatXyzw) -> None:
        """Counts an object.

        Args:
            scale: Metres per mesh unit along the mesh's axes, positive; None if the file does not say it.
            tilt: Its rotation before yaw, unit.
        """
        key = tilt_key(tilt)  # nearly equal tilts share a key; the first of them is stored
        first, count = self.tilts.get(key, (canonical_quaternion(tilt), 0))
        self.tilts[key] = (first, count + 1)
        if scale is not None:
            self.shapes.setdefault((aspect_steps(scale), key), array("d")).append(max(scale))
            if len(self.scales) < 3 * MOST_SCALES:
                self.scales.extend(scale)

    @property
    def has_more_scales(self) -> bool:
        """Whether there are scales that were not looked at for the typical one."""
        return 3 * sum(map(len, self.shapes.values())) > len(self.scales)

    def typical_scale(self) -> Vec3 | None:
        """The median scale, metres per mesh unit, or None if no scale is known."""
        if not self.scales:
            return None
        x, y, z = np.median(np.reshape(self.scales, (-1, 3)), axis=0).tolist()
        return x, y, z

    def aspects(self) -> set[tuple[int, int, int]]:
        """The aspects that get a grid, in steps: those in which the asset is used, and that of uniform scales."""
        return {_EVEN} | {steps for steps, _ in self.shapes}

    def most_tilts(self) -> list[tuple[QuatXyzw, int]]:
        """The most frequent tilts with their counts, most frequent first."""
        return sorted(self.tilts.values(), key=lambda item: (-item[1], item[0]))[:_MOST_TILTS]

    def shape_scales(self, tilts: Iterable[QuatXyzw]) -> dict[ShapeKey, float]:
        """The shapes that get a feature, each with the median of its scales' largest components, metres per mesh unit.

        These are every used pair of aspect and tilt, and the uniform scale, which generation uses, at some tilts.

        Args:
            tilts: These tilts, rounded: the most frequent ones.
        """
        scales = {key: float(np.median(found)) for key, found in self.shapes.items()}
        if (typical := self.typical_scale()) is not None:
            for tilt in tilts:
                scales.setdefault((_EVEN, tilt), max(typical))
        return scales

    def shape_uses(self) -> tuple[ShapeUse, ...]:
        """The shapes that get a feature, each with its first tilt."""
        scales = self.shape_scales(tilt_key(tilt) for tilt, _ in self.most_tilts())
        return tuple(ShapeUse(steps, self.tilts[key][0], scales[steps, key]) for steps, key in sorted(scales))
