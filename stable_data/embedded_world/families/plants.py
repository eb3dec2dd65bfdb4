"""Vases and plants."""

import math

import numpy as np

from stable_data.embedded_world.families.wording import fix_articles
from stable_data.embedded_world.modelling.family import AssetDesign, SupportArea, VariantSampler
from stable_data.embedded_world.modelling.shapes import ellipsoid, rod, round_body, scaled
from stable_data.embedded_world.modelling.solids import Solid, bar, box, chain, circle, join, loft, vessel

_VASES = {
    "bulbous": ((0.5, 0.0), (0.9, 0.18), (1.0, 0.36), (0.86, 0.55), (0.4, 0.76), (0.36, 0.86), (0.5, 1.0)),
    "slender": ((0.42, 0.0), (0.56, 0.2), (0.62, 0.45), (0.44, 0.7), (0.3, 0.8), (0.36, 1.0)),
    "cylinder": ((0.58, 0.0), (0.6, 0.02), (0.6, 0.5), (0.6, 1.0)),
    "trumpet": ((0.5, 0.0), (0.42, 0.1), (0.45, 0.45), (0.62, 0.8), (0.92, 1.0)),
    "urn": ((0.55, 0.0), (0.38, 0.1), (0.85, 0.45), (0.95, 0.68), (0.62, 0.84), (0.78, 1.0)),
    "gourd": ((0.6, 0.0), (0.95, 0.16), (0.95, 0.34), (0.55, 0.54), (0.62, 0.68), (0.34, 0.84), (0.42, 1.0)),
}
"""Profiles of vases: shares of the radius and the height. The last three go around the hollow."""


def _vase(style: str, radius: float, height: float, corners: int = 48) -> Solid:
    """An open vase, hollow in its upper part."""
    profile = scaled(_VASES[style], radius, height)
    wall = 0.004
    inner = [(r - wall, z) for r, z in profile[-3:]]
    return vessel([circle(r, z, corners) for r, z in profile], [circle(r, z, corners // 3) for r, z in inner])


def vase(draw: VariantSampler) -> AssetDesign:
    """An empty vase."""
    radius, height = draw.between(0.05, 0.065), draw.between(0.17, 0.26)
    style = draw.pick(*_VASES)
    color, glaze = draw.pick("teal", "white", "terracotta", "navy", "olive", "pink"), draw.pick("cream", "gold", "black")
    body = _vase(style, radius, height)
    if style == "urn":
        path = scaled([(0.58, 0.93), (1.05, 0.94), (1.15, 0.8), (0.86, 0.64)], radius, height)
        body += bar(path, 0.01, 0.008, 8) + bar([(-x, z) for x, z in path], 0.01, 0.008, 8)
    if style in ("bulbous", "slender", "gourd"):
        (r, z), (s, t) = _VASES[style][1:3]
        band = [(r * radius + 0.0008, z * height + 0.002), (s * radius + 0.0008, t * height - 0.002)]
        body += round_body(band).painted(glaze)
    captions = (f"an empty {color} vase, {style}", f"{color} ceramic vase", f"{style} vase without flowers")
    hollow = None
    if style == "trumpet":
        hollow = SupportArea(0.68 * radius, 0.68 * radius, 0.45 * height, 0.55 * height, is_round=True)
    if style == "cylinder":
        hollow = SupportArea(1.05 * radius - 0.008, 1.05 * radius - 0.008, 0.02 * height, 0.98 * height, is_round=True)
    return AssetDesign(body, "ceramic", color, captions, hollow=hollow, density=900.0)


_CORNERS = ((1, -1), (1, 1), (-1, 1), (-1, -1))


def _leaf(length: float, width: float, lean: float, bend: float, turn: float) -> Solid:
    """A long leaf from the origin: it leaves at ``lean`` degrees from upright, bends over by ``bend`` more, towards ``turn``."""
    x, z, rings = 0.0, 0.0, []
    shares = (0.5, 1.0, 0.22) if length < 0.06 else (0.45, 0.95, 1.0, 0.22)
    for k, share in enumerate(shares):
        angle = math.radians(lean + bend * k / (len(shares) - 1))
        along, aside = np.array([math.sin(angle), 0.0, math.cos(angle)]), np.array([math.cos(angle), 0.0, -math.sin(angle)])
        half, thick = share * width / 2, 0.0011
        across = np.array([0.0, 1.0, 0.0])
        rings.append(np.array([np.array([x, 0.0, z]) + i * half * across + j * thick * aside for i, j in _CORNERS]))
        x, z = np.array([x, z]) + along[[0, 2]] * length / (len(shares) - 1)
    return chain(rings).turned(z=turn)


def _petal(x: float, y: float, thickness: float, corners: int) -> Solid:
    """A thin level ellipse around the origin."""
    return loft([circle(1.0, z, corners) * (x, y, 1.0) for z in (-thickness / 2, thickness / 2)])


def _flower(kind: str, tint: str) -> Solid:
    """A blossom on the origin, open upwards."""
    if kind == "tulip":
        return round_body([(0.006, -0.003), (0.0145, 0.008), (0.0155, 0.018), (0.0095, 0.034)], 10).painted(tint)
    if kind == "rose":
        outer = round_body([(0.006, -0.003), (0.017, 0.005), (0.019, 0.013), (0.0155, 0.018)], 10)
        inner = round_body([(0.0125, 0.012), (0.0135, 0.02), (0.009, 0.025)], 8)
        return join([outer, inner.moved(0.001, 0.001), round_body([(0.006, 0.02), (0.006, 0.028)], 6)]).painted(tint)
    size = 1.45 if kind == "sunflower" else 1.05
    petals = [_petal(0.024 * size, 0.0062 * size, 0.003, 6).turned(z=45 * k).moved(z=0.002 + 0.0006 * k) for k in range(4)]
    core = round_body([(0.004, -0.003), (0.009 * size, 0.001), (0.009 * size, 0.006), (0.005 * size, 0.0085)], 10)
    return join([*(p.painted(tint) for p in petals), core.painted("#5a3b22" if kind == "sunflower" else "yellow")])


def flower_vase(draw: VariantSampler) -> AssetDesign:
    """A vase with cut flowers: tulips, roses, daisies, sunflowers."""
    radius, height, count = draw.between(0.046, 0.058), draw.between(0.13, 0.18), draw.pick(5, 6, 4, 3, 6, 5)
    style = draw.pick("cylinder", "bulbous", "urn", "slender", "gourd", "trumpet")
    color = draw.pick("clear", "white", "blue", "teal", "cream", "black")
    flower = draw.pick("tulip", "rose", "daisy", "sunflower", "rose", "tulip")
    tint = {"daisy": "white", "sunflower": "yellow"}.get(flower) or draw.pick(
        "red", "pink", "yellow", "purple", "orange", "cream"
    )
    profile = scaled(_VASES[style], radius, height)
    pot, mouth = round_body(profile, 24), profile[-1][0]
    pot += round_body([(mouth - 0.003, height - 0.002), (mouth - 0.003, height + 0.0012)], 24).painted("#3d5a3f")
    head = _flower(flower, tint)
    count = min(count, 4) if flower in ("daisy", "sunflower") else count
    parts, rise = [pot], draw.between(0.085, 0.12)
    for k in range(count):
        a = 2 * math.pi * k / max(1, count - 1)
        out, tall = (0.0, 1.25) if k == 0 else (1.0, 1.0 + 0.12 * (k % 2))
        reach, foot = 0.062 * out, 0.5 * mouth * out
        tip = (reach * math.cos(a), reach * math.sin(a), height + rise * tall)
        parts.append(rod((foot * math.cos(a), foot * math.sin(a), height - 0.004), tip, 0.0018).painted("green"))
        parts.append(head.turned(x=0.0, y=22 * out).turned(z=math.degrees(a)).moved(*tip))
    for k in range(3):
        leaf = _leaf(0.07, 0.022, 20, 65, 45 + 120 * k).painted("green")
        parts.append(leaf.moved(z=height - 0.003))
    kind = {"daisy": "daisies", "rose": f"{tint} roses", "tulip": f"{tint} tulips", "sunflower": "sunflowers"}[flower]
    captions = (f"a {color} vase with {kind}", f"vase of {kind}", f"bunch of {kind} in a vase", f"{color} flower vase")
    return AssetDesign(join(parts), "glass" if color == "clear" else "ceramic", color, captions, density=700.0)


def _pot(radius: float, height: float, style: str) -> Solid:
    """A closed pot for a plant with its earth: tapered with a rim, round, a cube or a bowl."""
    if style == "cube":
        pot = box(1.8 * radius, 1.8 * radius, height, 0.006)
    else:
        shapes = {
            "tapered": ((0.68, 0.0), (0.9, 0.74), (1.0, 0.75), (1.04, 1.0)),
            "round": ((0.6, 0.0), (0.95, 0.3), (1.0, 0.6), (0.86, 1.0)),
            "straight": ((0.94, 0.0), (0.96, 0.04), (1.0, 1.0)),
            "bowl": ((0.5, 0.0), (0.85, 0.35), (1.0, 0.75), (1.0, 1.0)),
        }
        pot = round_body(scaled(shapes[style], radius, height), 32)
    inside = (0.76 if style == "round" else 0.8) * radius
    return pot + round_body([(inside, height - 0.002), (inside, height + 0.002)], 24).painted("#4c382b")


def potted_plant(draw: VariantSampler) -> AssetDesign:
    """A plant in a pot: upright blades, arching leaves, a bush, a rosette, round leaves, big leaves on stalks."""
    radius, height = draw.between(0.045, 0.065), draw.between(0.07, 0.11)
    kind = draw.pick("snake plant", "fern", "bush", "succulent", "pilea", "monstera")
    color = draw.pick("terracotta", "white", "grey", "teal", "cream", "black")
    pot = draw.pick("tapered", "straight", "round", "cube", "bowl")
    green, size = draw.pick("green", "#5f9a52", "olive", "#3f7550"), draw.between(0.85, 1.15)
    if kind == "succulent":
        height, size = 0.6 * height, radius / 0.05
        leaves = [
            _leaf(s * size, 0.02 * size, lean, 25, 360 * (k + 0.5 * row) / n)
            for row, (n, s, lean) in enumerate(((7, 0.05, 45), (5, 0.04, 20), (3, 0.03, 2)))
            for k in range(n)
        ]
    elif kind == "snake plant":
        leaves = [
            _leaf((0.15 + 0.03 * (k % 3)) * size, 0.03, 6 + 4 * (k % 2), 9, 137.5 * k).moved(
                0.4 * radius * math.cos(2.4 * k), 0.4 * radius * math.sin(2.4 * k)
            )
            for k in range(7)
        ]
    elif kind == "fern":
        leaves = [_leaf((0.13 + 0.03 * (k % 2)) * size, 0.026, 10 + 24 * (k % 3), 85, 360 * 4 * k / 9) for k in range(9)]
        leaves.append(rod((0.0, 0.0, -0.002), (0.0, 0.0, 0.02), 0.012, 0.008))
    elif kind == "bush":
        spots = [(0.0, 0.0, 0.085)] + [
            (0.04 * math.cos(1.257 * k), 0.04 * math.sin(1.257 * k), 0.045 + 0.012 * (k % 2)) for k in range(5)
        ]
        leaves = [ellipsoid(0.04, 0.04, 0.04, 10).moved(x, y, z) for x, y, z in spots]
        leaves.append(rod((0.0, 0.0, -0.002), (0.0, 0.0, 0.085), 0.02))
    else:
        is_round, leaves = kind == "pilea", []
        for k in range(9 if is_round else 7):
            a, out, up = 2.4 * k, (0.03 + 0.007 * k) * size, (0.13 - 0.009 * k) * size
            tip = (out * math.cos(a), out * math.sin(a), up)
            leaves.append(rod((0.1 * tip[0], 0.1 * tip[1], -0.003), tip, 0.0017))
            blade = _petal(0.024, 0.024, 0.0044, 14) if is_round else ellipsoid(0.042, 0.03, 0.0024, 8).moved(x=0.018)
            leaves.append(blade.turned(y=22).turned(z=math.degrees(a)).moved(*tip))
    foliage = join(leaves).painted(green).moved(z=height)
    words = {"bush": "leafy bush", "pilea": "plant with round leaves", "monstera": "plant with big leaves"}.get(kind, kind)
    captions = (f"a {words} in a {color} pot", f"potted {kind}", "green house plant", f"small plant in a {color} pot")
    density = 400.0 if kind == "bush" else 800.0  # its foliage is modelled as full
    return AssetDesign(_pot(radius, height, pot) + foliage, "ceramic", color, captions, density=density)


def cactus(draw: VariantSampler) -> AssetDesign:
    """A cactus in a small pot: a ribbed globe, a column with arms, flat pads."""
    radius, height = draw.between(0.032, 0.043), draw.between(0.045, 0.065)
    kind = draw.pick("round", "saguaro", "prickly", "column", "round", "saguaro")
    color = draw.pick("terracotta", "white", "yellow", "grey", "pink", "teal")
    pot = draw.pick("tapered", "straight", "round", "cube")
    green, bloom = draw.pick("green", "#5f8f5a", "#4a7d5f"), draw.pick("pink", "red", "yellow")
    top = draw.between(0.08, 0.12)
    if kind == "round":
        half, top = 0.82 * radius, 1.5 * radius
        body = [ellipsoid(half, 0.3 * half, top / 2, 12).turned(z=30 * k).moved(z=0.46 * top) for k in range(6)]
    elif kind == "prickly":
        pads = ((0.0, 0.0, 0.03, 0), (0.018, 0.004, 0.068, 24), (-0.02, -0.002, 0.062, -32), (0.034, 0.002, 0.1, 40))
        body = [ellipsoid(0.021, 0.0085, 0.027, 14).turned(y=tilt).moved(x, y, z * 0.95 - 0.005) for x, y, z, tilt in pads]
        top = 0.1
    else:
        thick = 0.0145 if kind == "saguaro" else 0.02
        body = [
            loft(
                [circle(thick * r, z, 12) * (1.0, 0.4, 1.0) for r, z in ((1.0, -0.002), (1.0, 0.88 * top), (0.5, top))]
            ).turned(z=36 * k)
            for k in range(5)
        ]
        for side, low in ((1, 0.35), (-1, 0.52)) if kind == "saguaro" else ():
            rise = ((0.0, 0.0), (0.026, 0.003), (0.032, 0.011), (0.032, 0.04))
            path = [(x * side, low * top + z) for x, z in rise]
            body.append(bar(path, 0.0165, 0.0165, 10))
            body.append(ellipsoid(0.0083, 0.0083, 0.007, 10).moved(0.032 * side, 0.0, low * top + 0.04))
    plant = join(body).painted(green)
    if kind in ("round", "column"):
        plant += round_body([(0.004, top - 0.008), (0.0095, top + 0.005), (0.005, top + 0.009)], 8).painted(bloom)
    words = {"round": "round cactus with a flower", "saguaro": "cactus with two arms", "prickly": "cactus with flat pads"}.get(
        kind, "column cactus with a flower"
    )
    captions = fix_articles(
        f"a small {words} in a {color} pot", f"little cactus in a {color} pot", "potted cactus", "desert plant in a pot"
    )
    return AssetDesign(_pot(radius, height, pot) + plant.moved(z=height), "ceramic", color, captions, density=900.0)


FAMILIES = (vase, flower_vase, potted_plant, cactus)
