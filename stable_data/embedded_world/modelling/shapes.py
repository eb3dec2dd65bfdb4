"""Common shapes of assets: plates, panels, round and lying bodies, rods, hoops.

Frame and units as in :mod:`stable_data.embedded_world.modelling.solids`: z up, metres; a shape stands on z = 0 unless stated
otherwise.
"""

import math
from collections.abc import Iterable, Sequence
from typing import TypeAlias

import manifold3d
import numpy as np

from stable_data.embedded_world.modelling.solids import NUM_AROUND, Profile, Solid, box, chain, circle, loft, rectangle

Outline: TypeAlias = Sequence[tuple[float, float]]  # corners of a convex polygon in order, metres

Sections: TypeAlias = Sequence[tuple[float, float, float, float]]  # (x, half width, half height, z of the middle), metres

_LATITUDES = (-72, -45, -15, 15, 45, 72)  # of the rings of an ellipsoid, degrees


def scaled(outline: Outline, across: float, up: float) -> list[tuple[float, float]]:
    """Scales an outline or a profile that is given in shares of its two extents, metres."""
    return [(x * across, z * up) for x, z in outline]


def arc_points(radius: float, degrees: Iterable[float]) -> list[tuple[float, float]]:
    """Points on a circle around the origin, counter-clockwise from the first axis; also the profile of a ball as (radius, z)."""
    return [(radius * math.cos(math.radians(a)), radius * math.sin(math.radians(a))) for a in degrees]


def ball_profile(degrees: Sequence[float]) -> list[tuple[float, float]]:
    """The profile of a ball between two latitudes, in shares of its radius and of the height between them."""
    low, high = (math.sin(math.radians(a)) for a in (degrees[0], degrees[-1]))
    return [(math.cos(math.radians(a)), (math.sin(math.radians(a)) - low) / (high - low)) for a in degrees]


BALL = ball_profile((-66, -50, -30, -10, 10, 30, 50, 70, 82))
"""Profile of a ball with a flat to rest on, shares."""

HALF_BALL = ball_profile((-62, -45, -28, -12, 0))
"""Profile of the lower half of such a ball, shares."""


def prism(outline: Outline, low: float, high: float) -> Solid:
    """Extrudes a plan, corners (x, y), between two heights."""
    return loft([np.array([(x, y, z) for x, y in outline]) for z in (low, high)])


def silhouette(outline: Outline, depth: float) -> Solid:
    """Extrudes a side view, corners (x, z), along y by ``depth``, symmetric about y = 0."""
    return loft([np.array([(x, y, z) for x, z in outline]) for y in (-depth / 2, depth / 2)])


def disc(radius: float, low: float, high: float, corners: int = 24) -> Solid:
    """Returns an upright cylinder between two heights."""
    return loft([circle(radius, low, corners), circle(radius, high, corners)])


def wedge(radius: float, degrees: float, low: float, high: float, inset: float = 0.0) -> Solid:
    """Returns a slice of a disc with its tip on the left and one cut side along x.

    Args:
        radius: Radius of the disc.
        degrees: Angle between the cut sides.
        low: Height of the underside.
        high: Height of the top.
        inset: Share by which the slice shrinks towards its middle.
    """
    arc = [math.radians(degrees * k / 4) for k in range(5)]
    points = [(0.0, 0.0), *((radius * math.cos(a), radius * math.sin(a)) for a in arc)]
    middle = np.mean(points, axis=0)
    outline = middle + (np.array(points) - middle) * (1 - inset)
    return prism([(x - 0.5 * radius, y) for x, y in outline.tolist()], low, high)


def panel(width: float, depth: float, z: float, color: str, x: float = 0.0, y: float = 0.0, rise: float = 0.0008) -> Solid:
    """Returns a coloured plate in a level surface: a label, a screen, a key.

    Args:
        width: Along x.
        depth: Along y.
        z: Height of the surface.
        color: Colour of the plate.
        x: Middle of the plate.
        y: Middle of the plate.
        rise: Height above the surface.
    """
    return box(width, depth, rise + 0.0012).moved(x, y, z - 0.0012).painted(color)


def front_panel(width: float, height: float, y: float, z: float, color: str, x: float = 0.0, thickness: float = 0.003) -> Solid:
    """Returns a coloured plate in a face towards -y, 1 mm in front of it.

    Args:
        width: Along x.
        height: Along z.
        y: Position of the face.
        z: Height of the lower edge.
        color: Colour of the plate.
        x: Middle of the plate.
        thickness: Along y, mostly behind the face.
    """
    return box(width, thickness, height).moved(x, y + (thickness / 2 - 0.001), z).painted(color)


def round_body(profile: Profile, corners: int = NUM_AROUND, flatness: float = 1.0) -> Solid:
    """Returns a solid of round or elliptic section; on its side it lies on a facet, not on an edge.

    Args:
        profile: (half width, z) from the bottom up.
        corners: Corners of the section.
        flatness: Depth as a share of the width.
    """
    # The half step turns facets instead of corners towards the axes.
    angle = 2 * np.pi * (np.arange(corners) + 0.5) / corners
    outline = np.stack([np.cos(angle), flatness * np.sin(angle)], axis=1)
    return loft([np.c_[r * outline, np.full(corners, z)] for r, z in profile])


def square_body(profile: Profile, bevel: float = 0.2, flatness: float = 1.0) -> Solid:
    """Returns a solid of rectangular section with cut corners.

    Args:
        profile: (half width, z) from the bottom up.
        bevel: Cut at the corners as a share of the half width.
        flatness: Depth as a share of the width.
    """
    return loft([rectangle(2 * r, 2 * r * flatness, z, bevel * r) for r, z in profile])


def lying_body(sections: Sections, corners: int = 24) -> Solid:
    """Returns a body along x of elliptic sections with the given number of corners, flat underneath; sections from left to right."""
    angle = 2 * np.pi * np.arange(corners) / corners
    rings = []
    for x, half_width, half_height, middle in sections:
        z = np.maximum(middle + half_height * np.sin(angle), 0.0)
        rings.append(np.stack([np.full(corners, x), half_width * np.cos(angle), z], axis=1))
    return chain(rings)


def lying_lathe(profile: Outline, sag: float = 0.0, corners: int = 16) -> Solid:
    """Returns a solid of revolution along x that lies on a facet.

    Args:
        profile: (x, radius) from the left to the right.
        sag: 0 for a straight axis; 1 rests the whole length on the table.
        corners: Corners of the section.
    """
    thick, facet = max(r for _, r in profile), math.cos(math.pi / corners)
    # A facet faces down.
    angle = 2 * np.pi * (np.arange(corners) + 0.5) / corners - np.pi / 2
    rings = []
    for x, r in profile:
        z = facet * (sag * r + (1 - sag) * thick)
        rings.append(np.stack([np.full(corners, x), r * np.cos(angle), z + r * np.sin(angle)], axis=1))
    return loft(rings)


def ellipsoid(x: float, y: float, z: float, corners: int = 16) -> Solid:
    """Returns an ellipsoid around the origin from its half axes, with flat poles."""
    rings = [circle(math.cos(math.radians(a)), z * math.sin(math.radians(a)), corners) for a in _LATITUDES]
    return loft([ring * (x, y, 1.0) for ring in rings])


def rod(foot: tuple[float, float, float], tip: tuple[float, float, float], radius: float, end: float | None = None) -> Solid:
    """Returns a straight thin rod with six sides and level ends.

    Args:
        foot: Start point.
        tip: End point.
        radius: Radius at the foot.
        end: Radius at the tip; ``radius`` if None.
    """
    rings = [circle(r, 0.0, 6) + np.array(point) for point, r in ((foot, radius), (tip, radius if end is None else end))]
    return loft(rings)


def hoop(width: float, depth: float, height: float, thickness: float, corners: int = 14) -> Solid:
    """Returns an elliptic ring that lies on z = 0.

    Args:
        width: Outer extent along x.
        depth: Outer extent along y.
        height: Along z.
        thickness: Thickness of the ring in its plane.
        corners: Corners of the outline, with one part between two of them.
    """
    angle = 2 * np.pi * np.arange(corners) / corners
    around = np.stack([np.cos(angle), np.sin(angle)], axis=1) / 2
    # The outer and the inner edge of the ring.
    edges = [around * (width - 2 * inset, depth - 2 * inset) for inset in (0.0, thickness)]
    rings = np.stack([np.c_[edge, np.full(corners, z)] for z in (0.0, height) for edge in edges], axis=1)
    parts = []
    for k in range(corners):
        # A tip inside the next part prevents two parts from sharing a face.
        tip = 0.9 * rings[k].mean(axis=0) + 0.1 * rings[(k + 1) % corners].mean(axis=0)
        parts.append(np.vstack([rings[k - 1], rings[k], tip]))
    hulls = [manifold3d.Manifold.hull_points(part) for part in parts]
    return Solid(manifold3d.Manifold.batch_boolean(hulls, manifold3d.OpType.Add), tuple(parts))
