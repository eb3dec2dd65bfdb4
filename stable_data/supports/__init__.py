"""Supports of any shape: the surfaces of a mesh on which objects can stand, and what is in the way there."""

from stable_data.supports.finding import SupportLimits, find_surfaces
from stable_data.supports.joining import join_scenes
from stable_data.supports.obstacles import find_obstacles, seen_from_open_side, to_frame
from stable_data.supports.surface import SupportSurface, TabletopFit, as_tabletop

__all__ = [
    "SupportLimits",
    "SupportSurface",
    "TabletopFit",
    "as_tabletop",
    "find_obstacles",
    "find_surfaces",
    "join_scenes",
    "seen_from_open_side",
    "to_frame",
]
