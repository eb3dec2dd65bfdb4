"""Shapes of the kitchen and the dining table. Lengths in metres; every shape stands on z = 0 and faces -y."""

import math

import numpy as np

from stable_data.synth.solids import Solid, bar, box, chain, circle, join, lathe, loft, rectangle, slab, turned_vessel, vessel

_HANDLE_DEGREES = (-66, -40, -14, 14, 40, 66)


def mug(radius: float, height: float, taper: float = 0.93, wall: float = 0.0042) -> Solid:
    """A cup with a handle on its right."""
    foot = radius * taper
    outer = [(foot - 0.003, 0.0), (foot, 0.003), (radius, height - 0.0015), (radius - 0.001, height)]
    cup = turned_vessel(outer, [(foot - wall - 0.003, 0.005), (foot - wall, 0.009), (radius - wall, height)])
    reach, rise = 0.62 * radius, 0.34 * height
    arc = [(math.cos(math.radians(a)), math.sin(math.radians(a))) for a in _HANDLE_DEGREES]
    middle, root = 0.52 * height, radius * (taper + 1) / 2 - wall / 2
    path = [
        (root, middle - 0.92 * rise),
        *((root + 0.2 * reach + reach * c, middle + rise * s) for c, s in arc),
        (root, middle + 0.92 * rise),
    ]
    return cup + bar(path, width=0.011, thickness=0.007)


def tumbler(radius: float, height: float) -> Solid:
    """A cup without a handle, wider at the rim."""
    wall, foot = 0.0028, 0.78 * radius
    return turned_vessel([(foot, 0.0), (radius, height)], [(foot - wall, 0.006), (radius - wall, height)])


def bowl(radius: float, height: float) -> Solid:
    """A round bowl on a foot."""
    wall = 0.004
    curve = [(0.46, 0.06), (0.66, 0.2), (0.84, 0.45), (0.94, 0.7), (1.0, 1.0)]
    outer = [(0.44 * radius, 0.0), *((radius * r, height * z) for r, z in curve)]
    hollow = [(0.36, 0.13), (0.6, 0.24), (0.83, 0.5), (1.0, 1.0)]
    return turned_vessel(outer, [(radius * r - wall, height * z) for r, z in hollow])


def plate(radius: float, height: float = 0.022) -> Solid:
    """A plate with a flat well and a raised rim; plates of one kind stack."""
    foot, thick = 0.62 * radius, 0.005
    outer = [(foot, 0.0), (0.66 * radius, 0.002), (radius, height - 0.003), (radius, height)]
    return turned_vessel(outer, [(foot + 0.002, thick), (radius - 0.004, height)])


def saucepan(radius: float, height: float) -> Solid:
    """A pan with a long handle on its right."""
    pot = turned_vessel(
        [(0.95 * radius, 0.0), (radius, 0.01), (radius, height)], [(radius - 0.004, 0.006), (radius - 0.004, height)]
    )
    path = [(radius - 0.002, 0.8 * height), (1.25 * radius, 0.86 * height), (2.7 * radius, 1.02 * height)]
    return pot + bar(path, width=0.022, thickness=0.011)


def spoon(length: float) -> Solid:
    """A spoon with a shallow bowl, its handle along +y."""
    width, wall = 0.22 * length, 0.0012
    rings = [(0.42, 0.0), (0.7, 0.002), (1.0, 0.0065)]
    hollow = [(0.42, 0.0016), (1.0, 0.0065)]
    outer = [circle(width / 2 * r, z) * (1.0, 1.4, 1.0) for r, z in rings]
    inner = [circle(width / 2 * r - wall, z, 24) * (1.0, 1.4, 1.0) for r, z in hollow]
    root = 0.66 * width
    path = [(root, 0.0052), (root + 0.12 * length, 0.0115), (root + 0.45 * length, 0.0075), (length - 0.7 * width, 0.0045)]
    return vessel(outer, inner) + bar(path, width=0.0085, thickness=0.0026).turned(z=90)


def knife(length: float) -> Solid:
    """A kitchen knife that lies flat, its handle along +y."""
    blade, height = 0.58 * length, 0.018
    outline = [(0.0, 0.0), (height, 0.02), (height, blade), (-height / 2, blade), (-height / 2, 0.03)]
    rings = [np.array([(x, y - blade, z) for x, y in outline]) for z in (0.0, 0.002)]
    handle = slab(0.021, length - blade + 0.004, 0.012, 0.003).moved(0.002, (length - blade) / 2 - 0.002)
    return loft(rings) + handle


def bottle(radius: float, height: float, neck: float, shoulder: float) -> Solid:
    """A closed bottle: body, shoulder, neck, cap.

    Args:
        radius: Of the body.
        height: With the cap.
        neck: Radius of the neck.
        shoulder: Height at which the body ends, share of the height.
    """
    z = shoulder * height
    rise = 0.42 * (0.88 * height - z)
    body = [
        (radius - 0.003, 0.0),
        (radius, 0.004),
        (radius, z),
        (0.86 * radius + 0.14 * neck, z + 0.4 * rise),
        (1.25 * neck, z + rise),
    ]
    glass = lathe([*body, (neck, z + 1.3 * rise), (neck, 0.9 * height)])
    cap = lathe([(1.2 * neck, 0.9 * height - 0.002), (1.2 * neck, height - 0.002), (1.2 * neck - 0.002, height)])
    return glass + cap


def jar(radius: float, height: float) -> Solid:
    """A closed jar with a wide lid."""
    top = height - 0.016
    profile = [(radius - 0.004, 0.0), (radius, 0.005), (radius, 0.86 * top), (0.86 * radius, top), (0.86 * radius, top + 0.002)]
    lid = [(0.93 * radius, top), (0.93 * radius, height - 0.0015), (0.93 * radius - 0.0015, height)]
    return lathe(profile) + lathe(lid)


def can(radius: float, height: float) -> Solid:
    """A tin with a rim at both ends."""
    rim = 0.0015
    profile = [(radius - rim, 0.0), (radius, rim), (radius, 0.004), (radius - rim, 0.0055), (radius - rim, height - 0.0055)]
    return lathe([*profile, (radius, height - 0.004), (radius, height - rim), (radius - rim, height)])


def tray(width: float, depth: float, height: float = 0.035) -> Solid:
    """A rectangular tray with a sloping rim and a grip at either end."""
    outer = [rectangle(width - 2 * height / 3, depth - 2 * height / 3, 0.0, 0.03), rectangle(width, depth, height, 0.03)]
    inset = 0.014
    inner = [rectangle(w - inset, d - inset, z, 0.024) for w, d, z in _slope(width, depth, height)]
    return vessel(outer, inner)


def _slope(width: float, depth: float, height: float) -> list[tuple[float, float, float]]:
    share = 2 / 3 * (height - 0.006)
    return [(width - share, depth - share, 0.006), (width, depth, height)]


def cutting_board(width: float, depth: float, thickness: float = 0.018) -> Solid:
    """A board with a grip on its left."""
    board = slab(width, depth, thickness, 0.004)
    grip = slab(0.09, 0.045, 0.014, 0.004).moved(-width / 2 - 0.035, 0.0, 0.002)
    return board + grip


def fruit(radius: float, squash: float, stem: bool) -> Solid:
    """An apple, an orange: a rounded body, with or without a stem."""
    degrees = (-72, -54, -36, -18, 0, 18, 36, 54, 72)
    points = [(radius * math.cos(math.radians(a)), squash * radius * math.sin(math.radians(a))) for a in degrees]
    low = points[0][1]
    body = lathe([(r, z - low) for r, z in points])
    top = points[-1][1] - low
    return body + lathe([(0.0022, top - 0.004), (0.0016, top + 0.016)]).turned(y=4) if stem else body


def banana(length: float, thickness: float = 0.036) -> Solid:
    """A bent fruit that lies on its side, along x."""
    shares = [(-1.0, 0.2), (-0.93, 0.42), (-0.75, 0.8), (-0.35, 1.0), (0.35, 1.0), (0.75, 0.8), (0.93, 0.42), (1.0, 0.26)]
    bend = length / 1.2
    rings = []
    for along, share in shares:
        section = circle(share * thickness / 2, 0.0, 16)
        reach = bend + section[:, 0]
        rings.append(np.stack([reach * np.sin(0.6 * along), reach * np.cos(0.6 * along) - bend, section[:, 1]], axis=1))
    return chain(rings).moved(z=thickness / 2)


def bread(length: float, width: float = 0.1, height: float = 0.075) -> Solid:
    """A loaf with a round top, along x."""
    side = [(-0.45, 0.0), (0.45, 0.0), (0.5, 0.3), (0.46, 0.65), (0.33, 0.9), (0.12, 1.0)]
    outline = np.array([*side, *((-y, z) for y, z in side[:1:-1])]) * (width, height)
    ends = [(-length / 2, 0.84), (0.018 - length / 2, 1.0), (length / 2 - 0.018, 1.0), (length / 2, 0.84)]
    return loft([np.c_[np.full(len(outline), x), share * outline] for x, share in ends])


def crate(width: float, depth: float, height: float, wall: float = 0.008) -> Solid:
    """An open box with straight walls and grips."""
    outer = [rectangle(width, depth, 0.0), rectangle(width, depth, height)]
    inner = [rectangle(width - 2 * wall, depth - 2 * wall, z) for z in (wall, height)]
    grip = box(0.012, 0.3 * depth, 0.016).moved(width / 2 + 0.004, 0.0, 0.72 * height)
    return join([vessel(outer, inner), grip, grip.turned(z=180)])
