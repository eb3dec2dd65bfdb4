"""Shapes of the desk, the dressing table and the bathroom. Lengths in metres; every shape stands on z = 0 and faces -y."""

import math

from stable_data.synth.solids import Solid, bar, box, circle, join, lathe, loft, rectangle, slab, turned_vessel, vessel


def book(width: float, depth: float, thickness: float) -> Solid:
    """A closed book that lies flat, its spine on the left, covers standing out over the pages."""
    cover = 0.0025
    pages = box(width - 0.006, depth - 0.008, thickness - 2 * cover + 2e-4).moved(-0.001, 0.0, cover - 1e-4)
    boards = [box(width, depth, cover).moved(z=z) for z in (0.0, thickness - cover)]
    spine = box(cover, depth, thickness).moved((cover - width) / 2)
    return join([*boards, spine, pages])


def pen(length: float, radius: float, corners: int = 12) -> Solid:
    """A pen that stands on its end, its point up."""
    straight = 0.88 * length
    rings = [(0.85 * radius, 0.0), (radius, 0.002), (radius, straight), (0.25 * radius, length)]
    return loft([circle(r, z, corners) for r, z in rings])


def pencil(length: float) -> Solid:
    """A six-sided pencil that stands on its end, its point up."""
    return pen(length, 0.0042, corners=6)


def pen_holder(radius: float, height: float) -> Solid:
    """A round cup for pens."""
    outer = [(radius - 0.002, 0.0), (radius, 0.002), (radius, height)]
    return turned_vessel(outer, [(radius - 0.004, 0.006), (radius - 0.004, height)])


def cardboard_box(width: float, depth: float, height: float) -> Solid:
    """A closed box with its lid a little wider than the body."""
    lid = box(width, depth, 0.28 * height).moved(z=0.72 * height)
    return box(width - 0.004, depth - 0.004, 0.75 * height) + lid


def carton(width: float, depth: float, height: float) -> Solid:
    """A plain closed box."""
    return box(width, depth, height, bevel=0.0015)


def laptop(width: float, depth: float, opening: float = 112.0) -> Solid:
    """An open laptop, its screen leaning back, keys and touchpad raised."""
    base = slab(width, depth, 0.016, 0.003)
    keys = box(0.86 * width, 0.45 * depth, 0.0025).moved(0.0, 0.14 * depth, 0.0155)
    pad = box(0.34 * width, 0.24 * depth, 0.0015).moved(0.0, -0.31 * depth, 0.0155)
    screen = slab(width, 0.94 * depth, 0.007, 0.002).moved(0.0, 0.47 * depth).turned(x=180 - opening)
    hinge = box(0.8 * width, 0.012, 0.02).moved(0.0, depth / 2 - 0.008)
    return join([base, keys, pad, hinge, screen.moved(0.0, depth / 2 - 0.006, 0.012)])


def desk_lamp(height: float) -> Solid:
    """A lamp with a round foot, a stem and a shade."""
    foot = lathe([(0.075, 0.0), (0.08, 0.004), (0.078, 0.014), (0.03, 0.02)])
    stem = lathe([(0.008, 0.018), (0.008, 0.75 * height)])
    shade = lathe([(0.105, 0.58 * height), (0.065, height - 0.002), (0.063, height)])
    return join([foot, stem, shade])


def stapler(length: float) -> Solid:
    """A stapler, its long side along x."""
    base = slab(length, 0.036, 0.012, 0.003)
    arm = slab(0.94 * length, 0.028, 0.018, 0.004).turned(y=-7).moved(0.0, 0.0, 0.021)
    hinge = box(0.04, 0.03, 0.03, 0.004).moved(0.4 * length - 0.02, 0.0, 0.006)
    return join([base, arm, hinge])


def notebook(width: float, depth: float, thickness: float) -> Solid:
    """A flat notebook with rounded edges."""
    return slab(width, depth, thickness, 0.002)


def soap(length: float) -> Solid:
    """A bar of soap with rounded edges."""
    outline = [(0.82, 0.0), (0.95, 0.2), (1.0, 0.45), (0.97, 0.75), (0.82, 1.0)]
    return loft([circle(0.5, 0.028 * z) * (length * r, 0.62 * length * r, 1.0) for r, z in outline])


def toothbrush(length: float) -> Solid:
    """A toothbrush that stands on its handle's end, its bristles towards -y."""
    handle = bar([(0.0, 0.0), (0.0, 0.55 * length), (0.0, 0.75 * length)], width=0.009, thickness=0.011)
    neck = bar([(0.0, 0.74 * length), (0.0, length)], width=0.007, thickness=0.007)
    bristles = box(0.01, 0.013, 0.027).moved(0.0, -0.0085, length - 0.031)
    return join([handle, neck, bristles])


def pump_bottle(radius: float, height: float) -> Solid:
    """A soap dispenser with a spout that looks to -y."""
    body = lathe(
        [(radius - 0.003, 0.0), (radius, 0.004), (radius, 0.66 * height), (0.6 * radius, 0.75 * height), (0.012, 0.76 * height)]
    )
    collar = lathe([(0.015, 0.75 * height), (0.015, 0.82 * height)])
    stem = lathe([(0.005, 0.8 * height), (0.005, 0.95 * height)])
    head = slab(0.024, 0.062, 0.05 * height, 0.003).moved(0.0, -0.014, 0.95 * height - 0.001)
    return join([body, collar, stem, head])


def perfume(width: float, height: float) -> Solid:
    """A flat bottle with a square stopper."""
    glass = slab(width, 0.55 * width, 0.7 * height, 0.004)
    neck = lathe([(0.009, 0.7 * height - 0.003), (0.009, 0.78 * height)])
    stopper = slab(0.028, 0.028, 0.24 * height, 0.003).moved(z=0.76 * height)
    return join([glass, neck, stopper])


def candle(radius: float, height: float) -> Solid:
    """A pillar candle with a wick."""
    return lathe([(radius, 0.0), (radius, height - 0.002), (radius - 0.002, height)]) + lathe(
        [(0.0015, height - 0.004), (0.001, height + 0.012)]
    )


def vase(radius: float, height: float) -> Solid:
    """A slender vase, narrow at the neck and open at the top."""
    share = [(0.62, 0.0), (0.86, 0.14), (1.0, 0.34), (0.86, 0.58), (0.5, 0.8), (0.46, 0.9), (0.62, 1.0)]
    outer = [(r * radius, z * height) for r, z in share]
    inner = [
        (0.7 * radius, 0.58 * height),
        (0.38 * radius, 0.8 * height),
        (0.36 * radius, 0.9 * height),
        (0.52 * radius, height),
    ]
    return turned_vessel(outer, inner)


def mirror(radius: float) -> Solid:
    """A round mirror on a stand, leaning back a little."""
    foot = lathe([(0.5 * radius, 0.0), (0.5 * radius, 0.006), (0.2 * radius, 0.014)])
    stem = lathe([(0.009, 0.01), (0.009, 0.064)])
    disc = lathe([(radius - 0.002, 0.0), (radius, 0.003), (radius, 0.009), (radius - 0.002, 0.012)]).turned(x=82)
    return join([foot, stem, disc.moved(0.0, 0.018, 0.055 + radius * math.sin(math.radians(82)))])


def basket(width: float, depth: float, height: float) -> Solid:
    """A low open box with sloping walls."""
    wall = 0.005
    slope = 0.015
    outer = [rectangle(width - 2 * slope, depth - 2 * slope, 0.0, 0.02), rectangle(width, depth, height, 0.02)]
    low = 2 * slope * (1 - wall / height)
    inner = [rectangle(width - low - 2 * wall, depth - low - 2 * wall, wall, 0.02 - 0.6 * wall)]
    return vessel(outer, [*inner, rectangle(width - 2 * wall, depth - 2 * wall, height, 0.02 - 0.6 * wall)])
