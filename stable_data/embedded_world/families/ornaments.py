"""Ornaments."""

import math

import numpy as np

from stable_data.embedded_world.families.wording import fix_articles
from stable_data.embedded_world.modelling.family import AssetDesign, SupportArea, VariantSampler
from stable_data.embedded_world.modelling.shapes import arc_points, ellipsoid, panel, prism, round_body, scaled, silhouette
from stable_data.embedded_world.modelling.solids import Solid, bar, box, circle, join, lathe, loft, rectangle, vessel


def decor_tray(draw: VariantSampler) -> AssetDesign:
    """A small tray with a low rim, round, oval or eight-sided, with or without grips."""
    radius, height = draw.between(0.1, 0.14), draw.between(0.018, 0.032)
    style = draw.pick("round", "oval", "eight-sided", "round", "oval", "footed")
    color, metal = draw.pick("gold", "walnut", "white", "black", "bamboo", "teal"), draw.pick("gold", "silver", "copper")
    wall, flat = 0.005, 0.7 if style == "oval" else 1.0
    corners, inside = (8, 8) if style == "eight-sided" else (48, 16)
    rise, base = (0.008 if style == "footed" else 0.0), 0.005
    scale = np.array([1.0, flat, 1.0])
    outer = [circle(r, z, corners) * scale for r, z in ((0.94 * radius, 0.0), (radius, height))]
    inner = [circle(r - wall / flat, z, inside) * scale for r, z in ((0.95 * radius, base), (radius, height))]
    parts = [vessel(outer, inner).turned(z=180 / corners if corners == 8 else 0.0).moved(z=rise)]
    if style == "footed":
        foot = round_body([(0.006, 0.0), (0.009, 0.004), (0.007, 0.0095)], 12).painted(metal)
        parts += [foot.moved(0.8 * radius * math.cos(a), 0.8 * radius * math.sin(a)) for a in (0.8, 2.37, 3.94, 5.5)]
    if style in ("oval", "eight-sided"):
        grip = bar(
            [(-0.018, height - 0.008), (-0.014, height + 0.014), (0.014, height + 0.014), (0.018, height - 0.008)],
            0.007,
            0.006,
            8,
        )
        edge = 0.975 * radius * (0.975 if style == "oval" else 0.924) - wall / 2
        parts += [grip.turned(z=90).moved(side * edge).painted(metal) for side in (-1, 1)]
    free = 2 * (0.95 * radius - wall / flat) * math.cos(math.pi / inside)
    hollow = SupportArea(free, free * flat, base + rise, height - base, is_round=True)
    material = "wood" if color in ("walnut", "bamboo") else "metal"
    captions = (f"{style} {color} tray with a low rim", f"small {color} tray", f"decorative {material} tray")
    return AssetDesign(join(parts), material, color, captions, hollow=hollow, density=None if material == "wood" else 1500.0)


def snow_globe(draw: VariantSampler) -> AssetDesign:
    """A glass ball with snow and firs on a foot; the contents extend slightly beyond the glass, so that they are visible."""
    radius, foot = draw.between(0.034, 0.046), draw.between(0.02, 0.032)
    color, band = draw.pick("walnut", "red", "gold", "navy", "black", "white"), draw.pick("gold", "silver", "cream")
    style = draw.pick("flared", "straight", "stepped")
    shapes = {"flared": ((1.0, 0.0), (1.0, 0.3), (0.72, 1.0)), "straight": ((0.84, 0.0), (0.84, 1.0))}
    shape = shapes.get(style, ((1.0, 0.0), (1.0, 0.5), (0.8, 0.52), (0.8, 1.0)))
    rim = shape[0][0] * radius + 0.0008
    base = round_body(scaled(shape, radius, foot), 32) + round_body([(rim, 0.1 * foot), (rim, 0.24 * foot)], 32).painted(band)
    middle = foot + 0.8 * radius

    def dome(degrees: tuple[int, ...], more: float) -> Solid:
        """A part of the ball between two heights."""
        angles = [math.radians(a) for a in degrees]
        return round_body([(radius * math.cos(a) + more, middle + radius * math.sin(a)) for a in angles], 24)

    snow = dome((-58, -40, -22, -5), 0.0007).painted("white")
    firs = []
    for k in range(5):
        a, wide = 1.257 * k + 0.5, (0.2 - 0.03 * (k % 2)) * radius
        fir = round_body([(wide, -0.16 * radius), (0.12 * wide, (0.5 - 0.16 * (k % 2)) * radius)], 6).painted("#3f7a52")
        firs.append(fir.moved(0.88 * radius * math.cos(a), 0.88 * radius * math.sin(a), middle))
    flakes = []
    for k in range(7):
        a, up = 2.4 * k, math.radians(30 + 7 * k)
        spot = [radius * math.cos(up) * math.cos(a), radius * math.cos(up) * math.sin(a), middle + radius * math.sin(up)]
        flakes.append(round_body([(0.0016, -0.002), (0.0024, 0.0), (0.0016, 0.002)], 6).moved(*spot).painted("white"))
    glass = dome((-50, -20, 8, 32, 54, 76), 0.0).painted("#b5d6ea")
    captions = fix_articles(
        f"a snow globe with firs on a {color} foot", f"{color} snow globe", "glass ball with snow in it", "snow globe souvenir"
    )
    return AssetDesign(join([base, glass, snow, *firs, *flakes]), "glass", color, captions)


def bookend(draw: VariantSampler) -> AssetDesign:
    """A bookend, its upright plate on the left: a bent plate, a wedge, an arch, with a ball or a cat."""
    width, depth, height = draw.between(0.09, 0.12), draw.between(0.085, 0.11), draw.between(0.12, 0.16)
    style = draw.pick("plate", "wedge", "ball", "arch", "cat", "stairs")
    color, accent = draw.pick("black", "walnut", "white", "gold", "grey", "teal"), draw.pick("gold", "copper", "silver")
    thick = 0.004 if style == "plate" else 0.014
    left = -width / 2
    parts = [box(width, depth, thick, 0.001), box(thick, depth - 0.001, height, 0.001).moved(left + thick / 2)]
    if style == "plate":
        parts.append(box(0.005, 0.4 * depth, 0.3 * height).moved(left + thick / 2 + 0.001, 0.0, 0.45 * height).painted(accent))
    elif style == "wedge":
        profile = np.array(
            [(left + 0.004, 0.004), (-left - 0.008, 0.004), (-left - 0.008, 0.02), (left + 0.004, 0.92 * height)]
        )
        parts.append(
            loft([np.c_[profile[:, :1], np.full(4, y), profile[:, 1:]] for y in (-0.13 * depth, 0.13 * depth)]).painted(accent)
        )
    elif style == "ball":
        size = 0.36 * min(width, depth)
        parts.append(
            ellipsoid(size, size, size, 24).moved(left + thick + size - 0.003, 0.0, thick + 0.92 * size).painted(accent)
        )
    elif style == "arch":
        for share, tint in ((1.0, accent), (0.68, "cream"), (0.38, color)):
            outer = share * 0.46 * depth
            arc = [(outer * math.cos(math.radians(a)), outer * 1.5 * math.sin(math.radians(a))) for a in range(0, 181, 15)]
            rings = [
                np.array([(left + thick - 0.002 + x * (1.9 - share), y, thick - 0.003 + z) for y, z in arc])
                for x in (0.0, 0.026)
            ]
            parts.append(loft(rings).painted(tint))
    elif style == "cat":
        x = left + thick + 0.024
        shapes = [(0.0, 0.026, 0.024, 0.026, 0.03), (-0.004, 0.06, 0.018, 0.02, 0.03), (-0.004, 0.094, 0.017, 0.019, 0.016)]
        parts += [ellipsoid(a, b, c).moved(x + dx, 0.0, thick + z - 0.003).painted(accent) for dx, z, a, b, c in shapes]
        ear = loft([rectangle(0.008, 0.011, 0.0), rectangle(0.002, 0.002, 0.016)])
        parts += [ear.moved(x - 0.004, y, thick + 0.1).painted(accent) for y in (-0.01, 0.01)]
    else:
        for k in range(4):
            size = 0.24 * height * (4 - k) / 1.3
            parts.append(
                box(0.03, 0.7 * depth, size)
                .moved(left + thick + 0.012 + 0.02 * k, 0.0, thick - 0.002)
                .painted(accent if k % 2 else "cream")
            )
    material = "wood" if color == "walnut" else "metal"
    words = {"plate": "plain bookend", "stairs": "bookend with steps"}.get(
        style, f"bookend with a {style}" if style != "arch" else "bookend with an arch"
    )
    captions = (f"{color} {words}", f"{color} bookend", f"{material} stand that keeps books upright")
    return AssetDesign(join(parts), material, color, captions, density=1000.0 if material == "wood" else 2200.0)


_LANDS = (
    (-100, 50, 32), (-98, 24, 14), (-60, -8, 24), (-66, -34, 15), (18, 14, 28), (24, -14, 20), (40, 54, 30), (95, 48, 34),
    (80, 22, 14), (134, -25, 18),
)  # fmt: skip
"""Land on a globe: longitude, latitude and half its width, degrees."""


def _land(radius: float, longitude: float, latitude: float, reach: float) -> Solid:
    """A patch that extends slightly from a ball around the origin."""
    rings = []
    for share, lift in ((1.0, 0.92), (1.0, 1.01), (0.66, 1.013), (0.3, 1.014)):
        tilt = math.radians(share * reach)
        rings.append(circle(lift * radius * math.sin(tilt), lift * radius * math.cos(tilt), 9) * (1.0, 0.8, 1.0))
    return loft(rings).turned(y=90 - latitude, z=longitude)


def globe(draw: VariantSampler) -> AssetDesign:
    """A globe on a foot, its axis held by an arc."""
    r, tilt = draw.between(0.065, 0.12), 23.5
    sea = draw.pick("blue", "#cdb98a", "navy", "teal", "black", "#8fc0dd")
    land = {"#cdb98a": "#8a6a42", "navy": "gold", "teal": "cream", "black": "silver"}.get(sea, "green")
    wood = draw.pick("walnut", "silver", "gold")
    earth = lathe(arc_points(r, (-84, -62, -40, -15, 15, 40, 62, 84)), 32)
    spin = draw.pick(-15, 160, -100)
    lands = [_land(r, lon + spin, lat, reach) for lon, lat, reach in _LANDS]
    height = 1.12 * r + 0.05 + 0.014
    outside, arc = 1.13 * r, [math.radians(a) for a in range(-90, 91, 30)]
    arm = bar([(outside * math.cos(a), outside * math.sin(a)) for a in arc], 0.012, 0.007, 8).painted(wood)
    axis = lathe([(0.004, -1.14 * r), (0.004, 1.14 * r)], 8).painted(wood)
    whole = join([earth.painted(sea), *(patch.painted(land) for patch in lands), arm, axis]).turned(y=tilt).moved(z=height)
    foot = lathe([(0.72 * r, 0.0), (0.74 * r, 0.006), (0.7 * r, 0.014), (0.3 * r, 0.02)])
    stem = lathe([(0.011, 0.015), (0.008, height - outside + 0.004)], 20)
    name = {"#cdb98a": "antique", "#8fc0dd": "pale blue"}.get(sea, sea)
    captions = fix_articles(
        f"a {name} globe on a {wood} stand", f"{name} globe", "desk globe with the continents", "model of the earth"
    )
    return AssetDesign(whole + foot + stem, "plastic", wood, captions, density=280.0)


def photo_frame(draw: VariantSampler) -> AssetDesign:
    """A picture frame that leans back on its strut."""
    width, height = draw.pick((0.13, 0.18), (0.18, 0.13), (0.15, 0.2), (0.1, 0.15), (0.25, 0.2), (0.15, 0.15))
    color, kind = draw.pick("oak", "black", "white", "silver", "walnut", "gold"), draw.pick("landscape", "portrait")
    rim, thick, slope = draw.between(0.014, 0.024), draw.between(0.013, 0.018), draw.between(0.2, 0.3)
    w, h = width - 2 * rim, height - 2 * rim
    bars = [box(width, rim, thick).moved(y=y * (height - rim) / 2) for y in (-1, 1)]
    bars += [box(rim, height - 0.001, thick - 0.0004).moved(x * (width - rim - 0.0004) / 2) for x in (-1, 1)]
    z = 0.006
    if kind == "landscape":
        hill = scaled([(-0.4, -0.15), (0.3, -0.15), (-0.08, 0.25)], w, h)
        sun = lathe([(0.09 * h, z - 0.001), (0.09 * h, z + 0.0006)]).moved(0.28 * w, 0.27 * h).painted("yellow")
        meadow = panel(w + 0.002, 0.36 * h, z, "#6f9b57", y=-0.32 * h)
        sky = box(w + 0.002, h + 0.002, z).painted("#a9cfe6")
        scene = [sky, meadow, prism(hill, z - 0.001, z + 0.0006).painted("#7d8794"), sun]
    else:
        head = lathe([(0.16 * h, z - 0.001), (0.16 * h, z + 0.0012)]).moved(y=0.1 * h).painted("#dcae8c")
        hair = lathe([(0.19 * h, z - 0.001), (0.19 * h, z + 0.0006)]).moved(y=0.14 * h).painted("#54392a")
        bust = scaled([(-0.3, -0.5), (0.3, -0.5), (0.24, -0.22), (0.1, -0.1), (-0.1, -0.1), (-0.24, -0.22)], h, h)
        body = prism(bust, z - 0.001, z + 0.0008).painted(draw.pick("red", "navy", "teal"))
        scene = [box(w + 0.002, h + 0.002, z).painted("#d8d2c4"), hair, head, body]
    frame = join([*bars, *scene]).turned(x=90).moved(z=height / 2).leaned(slope)
    foot = (0.62 * slope + 0.36) * height
    up, y = 0.66 * height, 0.66 * height * slope
    strut = silhouette([(foot - 0.012, 0.0), (foot, 0.0), (y, up), (y - 0.06 * height * slope - 0.003, 0.6 * height)], 0.03)
    way = "landscape" if width > height else "upright"
    captions = fix_articles(
        f"a {color} photo frame with a {kind} picture", f"{color} picture frame", f"{way} photo in a {color} frame"
    )
    return AssetDesign(frame + strut.turned(z=90), "wood", color, captions)


FAMILIES = (decor_tray, snow_globe, bookend, globe, photo_frame)
