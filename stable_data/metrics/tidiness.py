"""Tidiness of layouts: how their spacing, alignment and facing differ from those of layouts that people, or a world, made.

No layout is tidy by itself: books stand in a row and toys do not. So distributions are compared: three figures for each object, and
the distance of two samples of them. Lower is more alike.

* Spacing: from an object's outline to the nearest other outline on the same support.
* Alignment: the smaller of the distances along x and along y to each of the three nearest centres on the same support, the least one.
* Facing: the angle between an object's axes and those of the table, 0 to 45 degrees.
"""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import numpy as np
import shapely
from scipy.stats import wasserstein_distance

from stable_data.geometry.shape import Shape
from stable_data.scene import FloatArray, Scene

_NEIGHBOURS = 3


@dataclass(frozen=True, slots=True, eq=False)
class Tidiness:
    """Figures of the objects of some layouts; lengths in millimetres, angles in degrees.

    Attributes:
        spacing: (S,) float64; objects that are alone on their support have none.
        alignment: (S,) float64; likewise.
        facing: (N,) float64.
    """

    spacing: FloatArray
    alignment: FloatArray
    facing: FloatArray

    @classmethod
    def of(cls, scene: Scene, shapes: Sequence[Shape]) -> "Tidiness":
        """Measures a layout.

        Args:
            scene: The layout, with the supports of its objects.
            shapes: The geometry of its objects, in order.
        """
        poses = scene.poses()
        outlines = [shapely.Polygon(shape.posed_footprint(pose)) for shape, pose in zip(shapes, poses, strict=True)]
        spacing, alignment = [], []
        for k, o in enumerate(scene.objects):
            beside = [n for n, other in enumerate(scene.objects) if n != k and other.support == o.support]
            if not beside:
                continue
            spacing.append(1e3 * min(shapely.distance(outlines[k], outlines[n]) for n in beside))
            apart = np.abs(poses[beside, :2] - poses[k, :2])
            nearest = np.linalg.norm(apart, axis=1).argsort()[:_NEIGHBOURS]
            alignment.append(1e3 * float(apart[nearest].min()))
        turn = np.degrees(poses[:, 3])
        return cls(np.array(spacing), np.array(alignment), np.abs(turn - 90 * np.round(turn / 90)))

    @classmethod
    def joined(cls, parts: Iterable["Tidiness"]) -> "Tidiness":
        """Joins the figures of several layouts."""
        several = list(parts)
        if not several:
            return cls(np.zeros(0), np.zeros(0), np.zeros(0))
        return cls(*(np.concatenate([getattr(part, name) for part in several]) for name in cls.__slots__))

    def distance(self, other: "Tidiness") -> tuple[float | None, float | None, float | None]:
        """The Wasserstein distance of the spacing, alignment and facing of two sets of layouts; None where one set has no figures."""
        pairs = [(getattr(self, name), getattr(other, name)) for name in self.__slots__]
        spacing, alignment, facing = (float(wasserstein_distance(a, b)) if len(a) and len(b) else None for a, b in pairs)
        return spacing, alignment, facing


NOTHING = Tidiness(np.zeros(0), np.zeros(0), np.zeros(0))
"""The tidiness of no layout."""
