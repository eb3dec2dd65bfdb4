"""What an asset weighs, how its mass is distributed, and how slippery it is."""

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import pyarrow.compute as pc

from stable_data.geometry.mass_properties import inertia_of, second_moments, usable_inertia
from stable_data.scene import FloatArray, Vec3

PHYSICS_COLUMNS = ("mass_source", "typical_scale", "mass", "center_of_mass", "inertia", "inertia_per_mass", "friction")
"""Columns of the table ``assets`` that :func:`physics_of_row` reads."""

IS_WEIGHED = pc.field("mass_source").is_valid()
"""Condition on the rows that state a mass with its origin."""

_LARGEST = 1e12  # a larger number is none of an asset, in any unit


@dataclass(frozen=True, slots=True, eq=False)
class AssetPhysics:
    """Mass and friction of an asset at one scale, along the axes of its mesh.

    Attributes:
        mass: Kilograms.
        typical_scale: The scale at which the values hold, metres per mesh unit.
        center_of_mass: From the centre of the mesh's box, (3,) float64, metres; None if it is not known.
        inertia: About the centre of mass, (3, 3) float64, kg m²; None if it is not known.
        friction: Sliding, torsional (metres) and rolling (metres) friction, as MuJoCo defines them; None if they are not known.
    """

    mass: float
    typical_scale: Vec3
    center_of_mass: FloatArray | None = None
    inertia: FloatArray | None = None
    friction: Vec3 | None = None

    def at(self, scale: Vec3) -> "AssetPhysics":
        """Returns the values at another scale, at which the material is as dense at every point of the mesh as before.

        Args:
            scale: Metres per mesh unit along the axes of the mesh.
        """
        if tuple(scale) == tuple(self.typical_scale):
            return self  # to the last bit
        ratio = np.divide(scale, self.typical_scale)
        growth = float(abs(ratio.prod()))
        centre, inertia = self.center_of_mass, self.inertia
        return replace(
            self,
            mass=self.mass * growth,
            typical_scale=scale,
            center_of_mass=None if centre is None else centre * ratio,
            inertia=None if inertia is None else growth * inertia_of(second_moments(inertia) * np.outer(ratio, ratio)),
        )


def physics_of_row(row: Mapping[str, Any]) -> AssetPhysics | None:
    """Returns the physics that a row of the table ``assets`` states; None if it states no mass with its origin.

    A mass without ``mass_source`` is an annotation that nobody has checked; it is not used. Without a usable inertia tensor, that
    of the mesh (``inertia_per_mass``) is used: it is also known for open meshes, whose walls convex parts make too thick.

    Args:
        row: Its :data:`PHYSICS_COLUMNS`.
    """
    mass, scale = row["mass"], _numbers(row["typical_scale"], 3)
    if row["mass_source"] is None or mass is None or not 0 < mass < _LARGEST or scale is None or not (scale > 0).all():
        return None
    inertia, friction = _inertia(row["inertia"]), _numbers(row["friction"], 3)
    if inertia is None and (per_mass := _inertia(row["inertia_per_mass"])) is not None:
        inertia = mass * per_mass
    known = None if friction is None or (friction < 0).any() else _vec3(friction)
    return AssetPhysics(mass, _vec3(scale), _numbers(row["center_of_mass"], 3), inertia, known)


def _inertia(values: Any) -> FloatArray | None:
    """An inertia tensor, (3, 3) float64, that a body can have; None for other numbers."""
    found = _numbers(values, 9)
    if found is None:
        return None
    return usable_inertia(found.reshape(3, 3))


def _numbers(values: Any, count: int) -> FloatArray | None:
    """So many numbers of a plausible size; None for anything else."""
    found = np.array([] if values is None else values, np.float64)  # null in a list becomes NaN
    return found if found.shape == (count,) and (np.abs(found) < _LARGEST).all() else None


def _vec3(values: FloatArray) -> Vec3:
    x, y, z = values.tolist()
    return x, y, z
