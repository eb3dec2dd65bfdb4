"""Long objects that lean in containers: the geometry and the constants that drawing, retrieval and correction share.

An object leans in a container when it is slender and longer than the container is deep: its foot stands near the middle of the
floor, and its upper part rests on the rim. Where two users have different values, both are here, because one value would
change the scenes that are drawn or corrected.
"""

import math
from typing import Final

from stable_data.scene import QuatXyzw

# --- which objects lean. Tuned on: not recorded.

SLENDER_MESH: Final = 2.5
"""Longest extent over the next one from which a mesh can lean (correction, where the scale of the object is known)."""
SLENDER_ASSET: Final = 3.0
"""The same for an asset of a catalogue, before its scale is known: only what is clearly long gets leaning tilts."""
PROTRUSION_DRAWN: Final = 1.15
"""Length over the container's depth from which an object is drawn as leaning in it: it should be seen over the rim."""
PROTRUSION_CORRECTED: Final = 1.05
"""The same from which a proposed object leans: what is shorter has room to lie or stand in the container."""

# --- how they lean. Tuned on: not recorded.

LEAN_SHARE: Final = 0.8
"""Share of the largest possible angle at which an object is placed: the rest is left for the simulation to settle."""
FOOT_CLEARANCE: Final = 7e-4
"""Distance between the feet of two objects, and between a foot and the floor, metres."""
LEAST_ROOM: Final = 1e-3
"""Free space beside the feet below which nothing leans, metres."""
FOOT_SHARE_DRAWN: Final = 0.25
"""Share of its length, from below, that counts as the foot of an asset of the embedded world: its pens taper."""
FOOT_SHARE_CORRECTED: Final = 0.05
"""The same for an object of any mesh."""
RIM_MARGIN: Final = 4e-3
"""The underside of an object in a container is at least this far below the rim, metres."""
CATALOGUE_ANGLES: Final = tuple(math.radians(a) for a in (6, 12, 18, 24, 30, 36, 45, 55, 65, 75))
"""Angles from upright at which a catalogue offers a long asset that was only seen lying, radians."""


def leaning_tilt(angle: float) -> QuatXyzw:
    """The tilt of an upright object that leans by an angle, its top towards -y of its yaw frame.

    Args:
        angle: From upright, radians.
    """
    return (math.sin(angle / 2), 0.0, 0.0, math.cos(angle / 2))


def feet_radius(foot_radius: float, count: int) -> float:
    """Radius of the circle on which the feet of several objects stand side by side, metres.

    Args:
        foot_radius: Of the largest foot, metres.
        count: How many objects, at least two.
    """
    return (foot_radius + FOOT_CLEARANCE) / math.sin(math.pi / count)
