"""Supports of any shape: the surfaces of a mesh on which objects can stand."""

from stable_data.supports.finding import SupportLimits, find_surfaces
from stable_data.supports.surface import SupportSurface, TabletopFit, as_tabletop

__all__ = ["SupportLimits", "SupportSurface", "TabletopFit", "as_tabletop", "find_surfaces"]
