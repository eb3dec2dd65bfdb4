"""Long objects that lean in containers: the geometry and the constants that generation, retrieval and correction share.

An object leans in a container if it is slender and longer than the container is deep: its foot stands near the middle of the
floor, and its upper part rests on the rim. If two users have different values, both are here, because a common value would
change the scenes that are generated or corrected.
"""

import math
from typing import Final

from stable_data.scene import QuatXyzw

# --- Which objects lean. The data on which these values were tuned are not recorded.

SLENDER_MESH: Final = 2.5
"""Ratio of the longest extent to the next one from which a mesh can lean (correction, where the object's scale is known)."""
SLENDER_ASSET: Final = 3.0
"""The same for an asset of a catalogue, whose scale is not known yet: only clearly long assets get leaning tilts."""
PROTRUSION_DRAWN: Final = 1.15
"""Length divided by the container's depth from which a generated object leans: it should be visible above the rim."""
PROTRUSION_CORRECTED: Final = 1.05
"""The same for a proposed object: a shorter one has room to lie or stand in the container."""

# --- How they lean. The data on which these values were tuned are not recorded.

LEAN_SHARE: Final = 0.8
"""Share of the largest possible angle at which an object is placed; the simulation settles the rest."""
FOOT_CLEARANCE: Final = 7e-4
"""Distance between the feet of two objects, and between a foot and the floor, metres."""
LEAST_ROOM: Final = 1e-3
"""Smallest free space beside the feet in which an object can lean, metres."""
FOOT_SHARE_DRAWN: Final = 0.25
"""Share of the length, from below, that counts as the foot of an asset of the embedded world, whose pens taper."""
FOOT_SHARE_CORRECTED: Final = 0.05
"""The same for an object of any mesh."""
RIM_MARGIN: Final = 4e-3
"""Smallest distance from the rim down to the underside of an object in a container, metres."""
CATALOGUE_ANGLES: Final = tuple(math.radians(a) for a in (6, 12, 18, 24, 30, 36, 45, 55, 65, 75))
"""Angles from upright at which a catalogue offers a long asset that scenes show only lying, radians."""


def leaning_tilt(angle: float) -> QuatXyzw:
    """The tilt of an upright object that leans by ``angle`` radians from upright, its top towards -y of its yaw frame."""
    return (math.sin(angle / 2), 0.0, 0.0, math.cos(angle / 2))


def feet_radius(foot_radius: float, count: int) -> float:
    """Radius, metres, of the circle on which ``count`` feet (at least two), none larger than ``foot_radius``, stand side by side."""
    return (foot_radius + FOOT_CLEARANCE) / math.sin(math.pi / count)
