"""Parts of vessels: bodies painted in bands, hollows, handles, lips."""

import math
from collections.abc import Sequence
from itertools import pairwise
from typing import TypeAlias

import numpy as np

from stable_data.embedded_world.modelling.family import SupportArea
from stable_data.embedded_world.modelling.solids import (
    NUM_AROUND,
    NUM_INSIDE,
    Profile,
    Ring,
    Solid,
    bar,
    chain,
    circle,
    join,
    lathe,
    loft,
    rectangle,
    vessel,
)

Bands: TypeAlias = Sequence[tuple[float, str]]  # (height from which, colour) from the bottom up, metres
Paints: TypeAlias = Sequence[tuple[Ring, str]]  # (ring from which, colour) from the bottom up
Point: TypeAlias = tuple[float, float]  # (x, z), metres

SNUG = 0.97
"""Share of the radius of a hollow that is free between its corners, with some play."""

INSCRIBED = 0.98
"""The same without play, for sixteen corners."""


def radius_at(profile: Profile, z: float) -> float:
    """Radius of a profile at a height, metres."""
    return float(np.interp(z, [row[1] for row in profile], [row[0] for row in profile]))


def banded_loft(rings: Sequence[Ring], bands: Paints) -> Solid:
    """A loft, painted from some rings upwards."""
    starts = [-np.inf, *(ring[0, 2] for ring, _ in bands), np.inf]
    pieces = []
    for k, (low, high) in enumerate(pairwise(starts)):
        stack = [ring for ring in rings if low < ring[0, 2] < high]
        if k and low > rings[0][0, 2]:
            # A piece begins inside the piece below; the two share only the corners of one ring.
            first = bands[k - 1][0]
            stack = [(first - [0, 0, low]) * 0.9 + [0, 0, low - 0.0006], first, *stack]
        elif k:
            stack.insert(0, rings[0])
        if high < rings[-1][0, 2]:
            stack.append(bands[k][0])
        if len(stack) > 1:
            piece = loft(stack)
            pieces.append(piece.painted(bands[k - 1][1]) if k else piece)
    # The parts are those of the plain loft: bands are no bodies of their own.
    whole = join(pieces)
    return Solid(whole.body, loft(rings).parts, whole.paints)


def banded_lathe(profile: Profile, bands: Bands = (), corners: int = NUM_AROUND) -> Solid:
    """A solid of revolution, painted in bands; below the first it stays bare. A flat of it looks to -y, to lie on."""
    rings = [circle(r, z, corners) for r, z in profile]
    marks = [(circle(radius_at(profile, z), z, corners), color) for z, color in bands]
    return banded_loft(rings, marks).turned(z=180 / corners)


def banded_box(rows: Sequence[tuple[float, float, float]], bevel: float, bands: Bands = ()) -> Solid:
    """A stack of rectangles, painted in bands.

    Args:
        rows: (width, depth, z) from the bottom up, metres.
        bevel: Cut off the upright edges, metres.
        bands: Their heights are those of rows.
    """
    rings = [rectangle(width, depth, z, bevel) for width, depth, z in rows]
    return banded_loft(rings, [(next(ring for ring in rings if ring[0, 2] == z), color) for z, color in bands])


def banded_vessel(outer: Sequence[Ring], inner: Sequence[Ring], bands: Paints = (), linings: Paints = ()) -> Solid:
    """A vessel painted in bands outside and in linings inside.

    Args:
        outer: Rings of the outside, as for :func:`stable_data.embedded_world.modelling.solids.vessel`.
        inner: Rings of the hollow, likewise.
        bands: Of the outside; their rings lie on it.
        linings: Of the hollow, likewise.
    """
    mouth = inner[-1] + (inner[-1] - inner[-2]) * 0.25  # goes on above the rim, so that no two faces coincide
    skin, plug = banded_loft(outer, bands), banded_loft([*inner, mouth], linings)
    return Solid(skin.body - plug.body, vessel(outer, inner).parts, skin.paints + plug.paints)


def cup(outer: Profile, inner: Profile, lining: str = "", rim: float = 0.0, rim_color: str = "", bands: Bands = ()) -> Solid:
    """A vessel of revolution with painted insides.

    Args:
        outer: Of the outside.
        inner: Of the hollow; the last point is at the rim.
        lining: Colour of the hollow; empty leaves it as the outside.
        rim: Height from which the hollow has the colour ``rim_color`` instead; within the last layer of the hollow.
        rim_color: Likewise; empty for none.
        bands: Of the outside.
    """
    rings, paints = [circle(r, z) for r, z in outer], [(circle(radius_at(outer, z), z), color) for z, color in bands]
    inside = [(z, color) for z, color in ((0.0, lining), (rim, rim_color)) if color]
    linings = [(circle(radius_at(inner, z), z, NUM_INSIDE), color) for z, color in inside]
    return banded_vessel(rings, [circle(r, z, NUM_INSIDE) for r, z in inner], paints, linings)


def well(radius: float, z: float, height: float = 0.0, free: float = SNUG) -> SupportArea:
    """A round place inside a ring with corners.

    Args:
        radius: Of the ring, metres.
        z: Of its floor, metres.
        height: Up to the rim, metres.
        free: Share of the radius that is free between the corners.
    """
    return SupportArea(2 * free * radius, 2 * free * radius, z, height, is_round=True)


def round_handle(low: Point, high: Point, reach: float, width: float, thickness: float) -> Solid:
    """A round handle on the right of a wall.

    Args:
        low: Where it begins.
        high: Where it ends.
        reach: How far it stands out, metres.
        width: Along y, metres.
        thickness: In the plane of the handle, metres.
    """
    (x, z), (dx, dz) = ((low[n] + high[n]) / 2 for n in (0, 1)), ((high[n] - low[n]) / 2 for n in (0, 1))
    # Six points on the right side of an ellipse.
    turns = [(math.cos(math.radians(d)), math.sin(math.radians(d))) for d in (-68, -40, -13, 13, 40, 68)]
    return bar([low, *((x + dx * s + reach * c, z + dz * s) for c, s in turns), high], width, thickness).as_handle()


def square_handle(low: Point, high: Point, reach: float, width: float, thickness: float) -> Solid:
    """An angular handle on the right of a wall; its measures are those of :func:`round_handle`."""
    x, cut = max(low[0], high[0]) + reach, 0.35 * reach
    path = [low, (x - cut, low[1]), (x, low[1] + cut), (x, high[1] - cut), (x - cut, high[1]), high]
    return bar(path, width, thickness).as_handle()


def angular_grip(x: float, z: float, reach: float, rise: float, width: float = 0.016, thickness: float = 0.011) -> Solid:
    """An angular grip on the right of an upright wall.

    Args:
        x: Of the wall, metres.
        z: Of its middle, metres.
        reach: How far it stands out, metres.
        rise: Half its height, metres.
        width: Along y, metres.
        thickness: In the plane of the grip, metres.
    """
    half = [(x, rise), (x + 0.75 * reach, rise), (x + reach, 0.6 * rise)]
    return bar([(u, z + w) for u, w in half] + [(u, z - w) for u, w in half[::-1]], width, thickness, corners=8)


def side_grips(radius: float, z: float, reach: float, rise: float) -> Solid:
    """A level grip on either side of a round wall; its measures are those of :func:`angular_grip`."""
    one = angular_grip(math.sqrt(radius**2 - rise**2) - 0.002, 0.0, reach, rise, 0.012, 0.01).turned(x=90).moved(z=z)
    return one + one.turned(z=180)


def pouring_lip(radius: float, z: float, reach: float, drop: float, half: float = 0.018) -> Solid:
    """A lip on the left of a round rim.

    Args:
        radius: Of the rim, metres.
        z: Of the rim, metres.
        reach: How far it stands out, metres.
        drop: How far it goes down the wall, metres.
        half: Half its width at the wall, metres.
    """
    root, tip = 0.002 - math.sqrt(radius**2 - half**2), -radius - reach
    top = np.array([(root, half, z), (root, -half, z), (tip, -0.004, z), (tip, 0.004, z)])
    return chain([np.array([(root, half / 3, z - drop), (root, -half / 3, z - drop)]), top])


def lid_knob(radius: float, height: float) -> Solid:
    """A turned knob, its foot at z = 0."""
    return lathe([(0.6 * radius, -0.002), (0.5 * radius, 0.3 * height), (radius, 0.65 * height), (0.7 * radius, height)])
