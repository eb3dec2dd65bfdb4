"""Candles and scents."""

import math

from stable_data.embedded_world.modelling.family import AssetDesign, VariantSampler
from stable_data.embedded_world.modelling.shapes import arc_points, rod, round_body, scaled, square_body
from stable_data.embedded_world.modelling.solids import bar, box, join, slab, turned_vessel


def candle(draw: VariantSampler) -> AssetDesign:
    """A candle: a pillar, a cone, a block, one with three wicks, or wax in a glass."""
    radius, height = draw.between(0.028, 0.042), draw.between(0.07, 0.15)
    style = draw.pick("pillar", "glass", "square", "wide", "glass", "cone")
    color = draw.pick("cream", "white", "red", "olive", "pink", "navy")
    wick = round_body([(0.0016, -0.004), (0.0013, 0.01)], 8).painted("black")
    if style == "glass":
        height = 0.3 * height + 0.04
        level = 0.86 * height
        cup = turned_vessel(
            [(radius - 0.002, 0.0), (radius, 0.002), (radius, height)], [(radius - 0.003, z) for z in (level, height)]
        )
        wax = round_body([(radius - 0.0034, level - 0.002), (radius - 0.0034, level + 0.0008)], 32).painted("cream")
        label = round_body([(radius + 0.0008, z * height) for z in (0.25, 0.62)]).painted(
            "kraft" if color != "cream" else "walnut"
        )
        captions = (f"a scented candle in a {color} glass", f"{color} jar candle with a label", "candle in a glass")
        return AssetDesign(join([cup, wax, label, wick.moved(z=level)]), "wax", color, captions)
    if style == "square":
        body = box(1.7 * radius, 1.7 * radius, height, 0.003)
    elif style == "cone":
        body = round_body([(radius, 0.0), (0.35 * radius, height - 0.003), (0.28 * radius, height)])
    else:
        radius, height = (1.35 * radius, 0.65 * height) if style == "wide" else (radius, height)
        body = round_body([(radius, 0.0), (radius, height - 0.003), (radius - 0.003, height)])
    spots = [(0.0, 0.0)]
    if style == "wide":
        spots = [(0.45 * radius * math.cos(a), 0.45 * radius * math.sin(a)) for a in (0.5, 2.6, 4.7)]
    pools = [
        round_body([(0.009, height - 0.002), (0.009, height + 0.0008)], 16).painted("#f3ead2").moved(x, y) for x, y in spots
    ]
    kind = {"wide": "candle with three wicks", "pillar": "pillar candle", "square": "square candle", "cone": "cone candle"}[
        style
    ]
    captions = (f"{color} {kind}", f"{color} candle", f"wax candle, {round(100 * height)} cm high")
    return AssetDesign(join([body, *pools, *(wick.moved(x, y, height) for x, y in spots)]), "wax", color, captions)


def candlestick(draw: VariantSampler) -> AssetDesign:
    """A candle in a candlestick: turned, short with a ring, or with three arms."""
    height, foot = draw.between(0.1, 0.15), draw.between(0.045, 0.054)
    style = draw.pick("turned", "plain", "three-armed", "turned", "chamber", "three-armed")
    color = draw.pick("gold", "black", "silver", "walnut", "copper", "white")
    wax = draw.pick("cream", "red", "navy", "white", "olive", "pink")
    tall = draw.between(0.1, 0.16)
    if style == "chamber":
        height = 0.035
        parts = [turned_vessel([(0.8 * foot, 0.0), (1.3 * foot, 0.018)], [(0.8 * foot, 0.004), (1.3 * foot - 0.003, 0.018)])]
        ring = arc_points(0.018, (-150, -100, -50, 0, 50, 100, 150))
        parts.append(bar([(1.25 * foot + 0.012 + x, 0.024 + z) for x, z in ring], 0.008, 0.005, 8))
        parts.append(round_body([(0.016, 0.003), (0.015, height + 0.01)], 24))
    else:
        knobs = [(0.008, 0.02)]
        if style == "turned":
            knobs += [(0.016, 0.35), (0.008, 0.45), (0.008, 0.75), (0.015, 0.86)]
        profile = [(foot, 0.0), (foot, 0.006), (0.5 * foot, 0.014), *((r, 0.014 + z * (height - 0.02)) for r, z in knobs)]
        parts = [round_body([*profile, (0.009, height), (0.016, height + 0.005), (0.016, height + 0.018)], 32)]
    stick = round_body([(0.011, 0.0), (0.0095, tall), (0.005, tall + 0.003)], 16).painted(wax)
    stick += round_body([(0.0016, tall), (0.0014, tall + 0.014)], 8).painted("black")
    spots = [(0.0, height + 0.008)]
    if style == "three-armed":
        spots += [(-0.075, height - 0.004), (0.075, height - 0.004)]
        for side in (-1, 1):
            path = [*scaled([(0.0, 0.62), (0.04, 0.58), (0.07, 0.72)], side, height), (0.075 * side, height - 0.01)]
            parts.append(bar(path, 0.009, 0.009, 8))
            parts.append(
                round_body([(0.006, height - 0.016), (0.016, height - 0.01), (0.016, height + 0.006)], 24).moved(0.075 * side)
            )
    candles = [stick.moved(x, 0.0, z) for x, z in spots]
    kind = {"three-armed": "three-armed candlestick", "chamber": "short candlestick with a ring"}.get(
        style, f"{style} candlestick"
    )
    with_wax = f"with {wax} candles" if style == "three-armed" else f"with one candle, {wax}"
    material = "wood" if color == "walnut" else "metal"
    captions = (f"{color} {kind} {with_wax}", f"{color} candlestick", f"{material} candle holder")
    return AssetDesign(join([*parts, *candles]), material, color, captions, density=None if material == "wood" else 1800.0)


def tea_light(draw: VariantSampler) -> AssetDesign:
    """A tea light, bare or in a little holder."""
    style = draw.pick("bare", "glass", "cube", "saucer", "glass", "bare")
    color, wax = draw.pick("silver", "teal", "walnut", "white", "amber", "gold"), draw.pick("white", "cream", "pink", "white")
    radius, height = draw.between(0.0185, 0.021), draw.between(0.014, 0.018)
    lip = height - 0.0015
    tin = round_body([(radius - 0.0005, 0.0), (radius - 0.0005, lip), (radius + 0.0008, lip), (radius + 0.0008, height)], 32)
    tin = tin.painted("silver")
    tin += round_body([(radius - 0.002, height - 0.002), (radius - 0.002, height + 0.0008)], 24).painted(wax)
    tin += round_body([(0.0015, height), (0.0013, height + 0.008)], 8).painted("black")
    if style == "bare":
        captions = (f"a small tea light with {wax} wax", f"{wax} tealight candle", "tea light in its tin cup")
        return AssetDesign(tin, "wax", "silver", captions)
    wide, rise = draw.between(0.03, 0.036), 0.006
    if style == "glass":
        tall, wall = draw.between(0.03, 0.045), 0.0035
        rise = tall - 0.011
        inner = [(1.0 * wide - wall, rise + 0.001), (1.12 * wide - wall, tall)]
        holder = turned_vessel([(0.85 * wide, 0.0), (1.12 * wide, tall)], inner)
    elif style == "cube":
        rise = draw.between(0.03, 0.05)
        holder = slab(2 * wide, 2 * wide, rise + 0.004, 0.003)
    else:
        holder = turned_vessel([(0.9 * wide, 0.0), (1.6 * wide, 0.014)], [(0.95 * wide, 0.007), (1.6 * wide - 0.004, 0.014)])
    kind = {"glass": "glass", "cube": "block", "saucer": "dish"}[style]
    captions = (f"a tea light in a {color} {kind}", f"{color} tealight holder", f"small candle in a {kind}")
    material = {"glass": "glass", "cube": "wood"}.get(style, "ceramic")
    return AssetDesign(join([holder, tin.moved(z=rise)]), material, color, captions, density=900.0)


def diffuser(draw: VariantSampler) -> AssetDesign:
    """A scent bottle with reeds."""
    half, height, count = draw.between(0.028, 0.036), draw.between(0.07, 0.1), draw.pick(5, 7, 6)
    style, color = draw.pick("round", "square", "tapered"), draw.pick("clear", "amber", "white", "black", "teal", "pink")
    reed, rise = draw.pick("oak", "black", "bamboo"), draw.between(0.1, 0.14)
    top = 0.52 if style == "tapered" else 0.94
    profile = [(half - 0.002, 0.0), (half, 0.003), (top * half, 0.74 * height), (0.012, 0.84 * height), (0.012, 0.92 * height)]
    body = square_body(profile, 0.3) if style == "square" else round_body(profile)
    collar = round_body([(0.0145, 0.9 * height), (0.0145, height)], 24).painted("gold" if color != "amber" else "black")
    if style == "square":
        label = box(1.1 * half, 0.012, 0.3 * height).moved(0.0, 0.005 - 0.98 * half, 0.2 * height)
    else:
        label = round_body([(half * (1 + (top - 1) * z / 0.74) + 0.0008, z * height) for z in (0.18, 0.5)])
    sticks = []
    for k in range(count):
        a, out = 2 * math.pi * k / count + 0.4, 0.045 + 0.012 * (k % 2)
        foot = (0.006 * math.cos(a), 0.006 * math.sin(a), height - 0.004)
        sticks.append(rod(foot, (out * math.cos(a), out * math.sin(a), height + rise - 0.008 * (k % 3)), 0.0016).painted(reed))
    first = f"a reed diffuser with {count} sticks, {color}"
    captions = (first, f"{color} room fragrance with reeds", f"{style} scent bottle with sticks")
    label = label.painted("cream" if color != "white" else "kraft")
    return AssetDesign(join([body, collar, label, *sticks]), "glass", color, captions)


FAMILIES = (candle, candlestick, tea_light, diffuser)
