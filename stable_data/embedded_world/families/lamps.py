"""Lamps."""

import math
from itertools import pairwise

from stable_data.embedded_world.families.wording import fix_articles
from stable_data.embedded_world.modelling.family import AssetDesign, VariantSampler
from stable_data.embedded_world.modelling.shapes import arc_points, disc, panel, scaled, silhouette
from stable_data.embedded_world.modelling.solids import Solid, bar, box, join, lathe, slab, turned_vessel

_LIGHT = "#fff1c4"


def _shade(low: float, high: float, height: float, wall: float = 0.003) -> Solid:
    """A lamp shade, open below, its rim at z = 0."""
    outer = [(high, -height), (low, 0.0)]
    inner = [(high - wall - 0.001, wall - height), (low - wall, 0.0)]
    return turned_vessel(outer, inner).turned(x=180)


def desk_lamp(draw: VariantSampler) -> AssetDesign:
    """A lamp to work by: with joints, a gooseneck, a bar of light or a green glass shade."""
    kind, high = draw.pick("jointed", "gooseneck", "bar", "banker's"), draw.between(0.32, 0.42)
    glass = draw.pick("green", "red", "blue")
    color, foot = draw.pick("black", "white", "red", "silver", "teal", "yellow"), draw.between(0.085, 0.1)
    base = lathe([(foot, 0.0), (foot, 0.014), (0.9 * foot, 0.022)])
    if kind == "banker's":
        color = "gold"
        angles = [math.radians(a) for a in range(0, 181, 30)]
        hood = silhouette([(0.065 * math.cos(a), 0.055 * math.sin(a)) for a in angles], 0.25).turned(z=90).painted(glass)
        tube = box(0.2, 0.05, 0.006).moved(z=-0.004).painted(_LIGHT)
        chain = lathe([(0.003, -0.06), (0.003, 0.001), (0.002, 0.002)], 8).moved(0.06, -0.03)
        head = join([hood, tube, chain]).moved(z=high - 0.06)
        solid = base + lathe([(0.012, 0.02), (0.008, 0.06), (0.008, high - 0.05)]) + head
    elif kind == "bar":
        joint = disc(0.013, -0.014, 0.014, 16).turned(x=90)
        arms = bar([(0.0, 0.02), (-0.05, high)], 0.02, 0.014, 8) + joint.moved(-0.05, 0.0, high)
        bar_ = slab(0.26, 0.036, 0.014, 0.003) + panel(0.2, 0.026, 0.0, _LIGHT, 0.02, rise=0.0008).turned(x=180)
        solid = base + (arms + bar_.turned(y=6).moved(0.07, 0.0, high)).turned(z=-90)
    else:
        shade = _shade(0.062, 0.028, 0.085) + lathe([(0.022, 0.016), (0.026, 0.04), (0.012, 0.084)], 20).painted(_LIGHT)
        if kind == "jointed":
            path = [(0.0, 0.018), (0.0, 0.05), (-0.1, 0.58 * high), (0.07, high)]
            joint = disc(0.012, -0.011, 0.011, 16).turned(x=90).painted("grey")
            joints = [joint.moved(x, 0.0, z) for x, z in path[1:]]
            arms = join([*(bar(pair, 0.012, 0.012, 8) for pair in pairwise(path)), *joints])
        else:
            bend = [math.radians(a) for a in (150, 120, 90, 60, 40)]
            arc = [(0.06 + 0.08 * math.cos(a), high - 0.08 + 0.08 * math.sin(a)) for a in bend]
            path = [(-0.02, 0.018), (-0.02, high - 0.08), *arc]
            arms = bar(path, 0.011, 0.011, 8)
        x, z = path[-1]
        solid = base + (arms + shade.moved(z=-0.082).turned(y=-32).moved(x, 0.0, z)).turned(z=-90)
    name = {"bar": "LED desk lamp", "banker's": f"banker's lamp with a {glass} shade"}.get(kind, f"{kind} desk lamp").lower()
    captions = fix_articles(f"a {color} {name}", f"{color} desk lamp", "lamp to read by")
    return AssetDesign(solid, "electronics", color, captions)


def table_lamp(draw: VariantSampler) -> AssetDesign:
    """A lamp with a fabric shade on a turned, a round or a square body."""
    kind, high = draw.pick("vase", "ball", "column", "block"), draw.between(0.3, 0.45)
    color = draw.pick("white", "blue", "oak", "teal", "terracotta", "black")
    shade = draw.pick("cream", "white", "#d9c7a3", "grey")
    low, tall = high * draw.between(0.27, 0.34), high * draw.between(0.36, 0.44)
    body, r = high - tall + 0.02, draw.between(0.05, 0.065)
    if kind == "vase":
        share = [(0.72, 0.0), (0.8, 0.05), (1.0, 0.4), (0.92, 0.62), (0.5, 0.84), (0.24, 0.92), (0.24, 1.0)]
        solid = lathe(scaled(share, r, body))
    elif kind == "ball":
        sphere = lathe(arc_points(r, (-66, -44, -22, 0, 22, 44, 66)), 32)
        solid = lathe([(1.1 * r, 0.0), (1.1 * r, 0.012), (0.5 * r, 0.02)]).painted("gold") + sphere.moved(z=0.91 * r + 0.016)
    elif kind == "column":
        solid = lathe([(1.4 * r, 0.0), (1.4 * r, 0.012), (0.5 * r, 0.026)]) + lathe([(0.3 * r, 0.02), (0.24 * r, body)])
    else:
        solid = box(1.7 * r, 1.7 * r, 0.75 * body, 0.006)
    stem = lathe([(0.008, 0.01), (0.008, high - 0.001)], 12).painted("gold")
    cover = _shade(low, draw.pick(1.0, 0.72, 0.5) * low, tall, 0.0025).moved(z=high - tall).painted(shade)
    knob = lathe([(0.007, high - 0.002), (0.009, high + 0.008), (0.005, high + 0.014)], 12).painted("gold")
    name = shade if not shade.startswith("#") else "beige"
    material = "wood" if color == "oak" else "ceramic"
    captions = fix_articles(f"a table lamp with a {color} {kind} base", f"{color} table lamp", f"lamp with a {name} shade")
    return AssetDesign(join([solid, stem, cover, knob]), material, color, captions, density=1000.0)


FAMILIES = (desk_lamp, table_lamp)
