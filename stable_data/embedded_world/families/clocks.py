"""Clocks."""

import math

from stable_data.embedded_world.families.displays import digits
from stable_data.embedded_world.families.palette import PAPER
from stable_data.embedded_world.families.wording import fix_articles
from stable_data.embedded_world.modelling.family import AssetDesign, VariantSampler
from stable_data.embedded_world.modelling.shapes import panel, round_body, scaled, silhouette
from stable_data.embedded_world.modelling.solids import Solid, bar, box, join, lathe, loft, rectangle, slab


def _dial(radius: float, z: float, face: str, hands: str) -> Solid:
    """The face of a clock on a level surface, ten past ten, read from -y."""
    disc = lathe([(radius, z - 0.0012), (radius, z + 0.0008)]).painted(face)
    tick = panel(0.06 * radius, 0.14 * radius, z + 0.0008, hands, y=0.83 * radius)
    marks = [tick.turned(z=30.0 * hour) for hour in range(12)]
    sizes = ((0.085, 0.55, 54.0), (0.06, 0.78, -60.0))
    bars = [panel(w * radius, a * radius, z + 0.0012, hands, y=0.46 * a * radius, rise=0.001).turned(z=t) for w, a, t in sizes]
    return join([disc, *marks, *bars])


def desk_clock(draw: VariantSampler) -> AssetDesign:
    """A clock to stand on a desk: a drum on a foot, a mantel clock or a digital block."""
    kind = draw.pick("round", "mantel", "digital")
    color = draw.pick("walnut", "white", "gold", "black", "oak", "teal")
    face, hands = draw.pick(PAPER, "cream", "white"), draw.pick("black", "navy", "#7c2a2a")
    r, thick = draw.between(0.045, 0.075), draw.between(0.032, 0.05)
    if kind == "digital":
        width, high = draw.between(0.13, 0.2), draw.between(0.06, 0.085)
        shown = digits("10:08", 0.5 * high, 0.0008, draw.pick("#6fe08a", "#e8f0f5", "#f07a5a"))
        glass = panel(0.92 * width, 0.8 * high, 0.0, "#1d2024") + shown
        solid = (box(width, thick, high) + glass.turned(x=90).moved(y=-thick / 2, z=high / 2)).leaned(0.18)
    else:
        front = _dial(0.86 * r, 0.0, face, hands).turned(x=90).moved(y=-thick / 2)
        if kind == "round":
            drum = lathe([(r - 0.002, -thick / 2), (r, 0.002 - thick / 2), (r, thick / 2)]).turned(x=90)
            sizes = ((1.3, 0.026, 0.0), (1.3, 0.026, 0.01), (0.7, -0.002, 0.03))
            foot = loft([rectangle(wide * r, thick + deep, z) for wide, deep, z in sizes])
            solid = (drum + front).moved(z=r + 0.014) + foot
        else:
            angles = [math.radians(a) for a in range(0, 181, 15)]
            arch = [(-1.0, -1.0), (1.0, -1.0), *((math.cos(a), math.sin(a)) for a in angles)]
            body = silhouette(scaled(arch, 1.15 * r, 1.15 * r), thick)
            solid = (body + front).moved(z=1.15 * r + 0.01) + slab(3.0 * r, thick + 0.02, 0.0104, 0.002)
    captions = fix_articles(f"a {color} {kind} desk clock", f"{color} desk clock", f"{kind} clock for a desk")
    return AssetDesign(solid, "wood", color, captions, density=500.0)


def alarm_clock(draw: VariantSampler) -> AssetDesign:
    """An alarm clock: with two bells, square, or with digits."""
    kind, r = draw.pick("twin-bell", "digital", "square"), draw.between(0.036, 0.055)
    color, thick = draw.pick("red", "black", "teal", "white", "pink", "silver"), draw.between(0.036, 0.05)
    if kind == "digital":
        width, high = 3.4 * r, 1.4 * r
        shown = digits("7:30", 0.5 * high, 0.0008, draw.pick("#f05a4a", "#6fe08a", "#8fd0f0"))
        glass = panel(0.9 * width, 0.74 * high, 0.0, "#1d2024") + shown
        side = [(-0.6 * high, 0.0), (0.6 * high, 0.0), (0.4 * high, high), (-0.36 * high, high)]
        lean = math.degrees(math.atan2(0.24 * high, high))
        solid = silhouette(side, width).turned(z=90) + glass.turned(x=90 - lean).moved(y=-0.48 * high, z=high / 2)
        solid += loft([rectangle(0.5 * width, 0.4 * high, z) for z in (high - 0.002, high + 0.006)]).painted("grey")
    elif kind == "square":
        shell = slab(2.3 * r, 2.3 * r, thick, 0.008) + _dial(0.96 * r, thick, "white", "black")
        snooze = slab(1.2 * r, 0.5 * thick, 0.012, 0.003).painted("grey")
        feet = [box(0.012, 0.8 * thick, 0.008).moved(x * 0.8 * r) for x in (-1, 1)]
        solid = join([shell.turned(x=90).moved(y=thick / 2, z=1.15 * r + 0.006), snooze.moved(z=2.3 * r), *feet])
    else:
        drum = lathe([(r - 0.003, -thick / 2), (r, 0.003 - thick / 2), (r, thick / 2 - 0.002), (r - 0.002, thick / 2)])
        drum = (drum + _dial(0.86 * r, thick / 2, "white", "black")).turned(x=90)
        cup = [(0.42, 0.0), (0.42, 0.12), (0.36, 0.3), (0.2, 0.42), (0.06, 0.45)]
        bell = lathe([(a * r, (b + 1.12) * r) for a, b in cup], 20) + lathe([(0.0035, 0.9 * r), (0.0035, 1.66 * r)], 8)
        leg = lathe([(0.008, -1.32 * r), (0.006, -0.85 * r)], 12)
        hammer = box(0.004, 0.006, 0.45 * r).moved(z=0.95 * r) + box(0.022, 0.01, 0.008).moved(z=1.38 * r)
        grip = bar([(x * r, (1.4 + 0.45 * (1 - (x / 0.82) ** 2)) * r) for x in (-0.82, -0.5, 0.0, 0.5, 0.82)], 0.006, 0.004, 8)
        top = join([*(bell.turned(y=t) for t in (-30, 30)), hammer, grip]).painted("silver")
        legs = [leg.moved(x * 0.55 * r, y * 0.3 * thick, 0.0) for x in (-1, 1) for y in (-1, 1)]
        solid = join([drum, top, join(legs).painted("silver")]).moved(z=1.32 * r)
    captions = fix_articles(
        f"a {color} {kind} alarm clock", f"{color} alarm clock", f"{kind} alarm clock", "bedside clock with an alarm"
    )
    return AssetDesign(solid, "metal" if kind == "twin-bell" else "plastic", color, captions, density=700.0)


def hourglass(draw: VariantSampler) -> AssetDesign:
    """Two glass bulbs with sand between two plates on posts."""
    radius, height, plate = draw.between(0.03, 0.04), draw.between(0.12, 0.17), 0.009
    color = draw.pick("walnut", "gold", "oak", "black", "silver", "white")
    sand = draw.pick("cream", "blue", "pink", "#d8b36a", "teal", "red")
    posts, corners = draw.pick(3, 4), draw.pick(48, 8, 48)
    inner, half = height - 2 * plate, height / 2
    ends = round_body([(radius, 0.0), (radius, plate)], corners)
    shape = ((0.6, 0.0), (0.66, 0.1), (0.6, 0.3), (0.14, 0.48), (0.14, 0.52), (0.6, 0.7), (0.66, 0.9), (0.6, 1.0))
    glass = round_body([(r * radius, plate - 0.0005 + z * (inner + 0.001)) for r, z in shape], 32).painted("clear")
    low = [(0.665, 0.1), (0.65, 0.2), (0.615, 0.3)]
    pile = round_body([(r * radius + 0.0004, plate + z * inner) for r, z in [(0.62, 0.02), *low]], 32).painted(sand)
    upper = round_body(
        [(r * radius + 0.0004, plate + z * inner) for r, z in ((0.16, 0.525), (0.42, 0.62), (0.5, 0.66))], 32
    ).painted(sand)
    angles = [2 * math.pi * (k + 0.75) / posts for k in range(posts)]
    rods = [
        round_body([(0.0035, 0.004), (0.0035, half), (0.0035, height - 0.004)], 8).moved(
            0.86 * radius * math.cos(a), 0.86 * radius * math.sin(a)
        )
        for a in angles
    ]
    captions = (
        f"an hourglass with sand in a frame, {color}",
        f"{color} hourglass",
        "sand timer",
        f"hourglass with {posts} posts",
    )
    material = "wood" if color in ("walnut", "oak") else "metal"
    return AssetDesign(
        join([ends, ends.moved(z=height - plate), glass, pile, upper, *rods]), material, color, captions, density=900.0
    )


FAMILIES = (desk_clock, alarm_clock, hourglass)
