"""Articles for hair, shaving and the face."""

import math

import numpy as np

from stable_data.embedded_world.families.wording import fix_articles
from stable_data.embedded_world.modelling.family import AssetDesign, VariantSampler
from stable_data.embedded_world.modelling.shapes import lying_body, round_body, scaled, square_body
from stable_data.embedded_world.modelling.solids import bar, box, chain, join, loft, rectangle, slab


def comb(draw: VariantSampler) -> AssetDesign:
    """A comb that lies flat along x, its teeth to -y."""
    length, depth = draw.between(0.15, 0.185), draw.between(0.03, 0.042)
    style = draw.pick("pocket", "wide-tooth", "tail", "pocket", "wide-tooth", "handled")
    color = draw.pick("black", "walnut", "pink", "brown", "teal", "cream")
    thick, spine = 0.0045, 0.36 * depth
    toothed = length if style in ("pocket", "wide-tooth") else 0.58 * length
    pitch, tooth = (0.0092, 0.0052) if style == "wide-tooth" else (0.0055, 0.003)
    count = int((toothed - 0.012) / pitch)
    start = -length / 2 + (toothed - (count - 1) * pitch) / 2
    reach = depth - spine
    root, tip = rectangle(tooth, 0.0036, -0.001), rectangle(0.55 * tooth, 0.003, reach)
    one = loft([root, tip]).turned(x=90).moved(0.0, depth / 2 - spine, thick / 2)
    teeth = [one.moved(start + k * pitch) for k in range(count)]
    back = slab(toothed, spine, thick, 0.001).moved((toothed - length) / 2, (depth - spine) / 2)
    end = box(0.0045, depth, thick - 0.0004, 0.0008).moved(0.0, 0.0, 0.0002)
    parts = [back, end.moved(0.0028 - length / 2), end.moved(toothed - length / 2 - 0.0028)]
    if style in ("tail", "handled"):
        wide = 0.006 if style == "tail" else 0.02
        handle = slab(length - toothed + 0.01, wide, thick - 0.0003, 0.001)
        parts.append(handle.moved((toothed - 0.01) / 2, (depth - spine) / 2 - (0.0 if style == "tail" else 0.004)))
    material = "wood" if color == "walnut" else "plastic"
    words = "comb with a handle" if style == "handled" else f"{style} comb"
    captions = (f"{color} {words}", f"{color} comb", f"flat hair comb made of {material}")
    return AssetDesign(join([*parts, *teeth]), material, color, captions)


def hair_brush(draw: VariantSampler) -> AssetDesign:
    """A hair brush on its back, its bristles up, its handle to -y."""
    length, width = draw.between(0.2, 0.24), draw.between(0.055, 0.078)
    style = draw.pick("paddle", "oval", "oval", "paddle", "oval", "paddle")
    color = draw.pick("black", "walnut", "pink", "bamboo", "purple", "teal")
    cushion = draw.pick("grey", "black", "red", "cream", "white", "black")
    head, thick = 0.48 * length, 0.014
    ratio = head / width
    profile = [(0.46 * width, 0.0), (0.5 * width, 0.004), (0.5 * width, thick - 0.003), (0.46 * width, thick)]
    pad = [(0.4 * width, thick - 0.001), (0.37 * width, thick + 0.004)]
    back, pillow = (
        round_body(part, 32, ratio) if style == "oval" else square_body(part, 0.35, ratio) for part in (profile, pad)
    )
    grip = [(-0.02, 0.007, 0.006, 0.0055), (0.02, 0.0085, 0.007, 0.006)]
    grip += [(0.07, 0.012, 0.009, 0.0075), (length - head, 0.009, 0.007, 0.006)]
    handle = lying_body(grip, 16).turned(z=-90).moved(0.0, 0.004 - head / 2).as_handle()
    bristle = loft([rectangle(0.0032, 0.0032, 0.0), rectangle(0.002, 0.002, 0.016)]).moved(z=thick + 0.003)
    spots = [(i, j) for i in (-1.5, -0.5, 0.5, 1.5) for j in (-2, -1, 0, 1, 2) if abs(i) < 1 or abs(j) < 2]
    tufts = [
        bristle.moved(0.15 * width * i, 0.135 * head * j).painted("black" if cushion != "black" else "silver") for i, j in spots
    ]
    captions = fix_articles(
        f"{color} {style} hair brush with its bristles up", f"{color} hairbrush", f"{style} brush with a {cushion} cushion"
    )
    material = "wood" if color in ("walnut", "bamboo") else "plastic"
    return AssetDesign(join([back, pillow.painted(cushion), handle, *tufts]), material, color, captions, density=450.0)


def hair_dryer(draw: VariantSampler) -> AssetDesign:
    """A hair dryer that lies on its side, its nozzle to +x and its handle to -y."""
    length, radius = draw.between(0.17, 0.21), draw.between(0.036, 0.043)
    color = draw.pick("black", "white", "pink", "red", "navy", "purple")
    accent = draw.pick("silver", "gold", "grey", "black", "copper", "white")
    middle, left, nozzle = 0.86 * radius, -0.42 * length, draw.between(0.02, 0.035)
    shape = [(left, 0.9, 0.9), (left + 0.012, 1.0, 1.0), (0.1 * length, 0.98, 0.98), (0.36 * length, 0.72, 0.72)]
    barrel = lying_body([(x, a * radius, b * radius, middle) for x, a, b in shape])
    end = 0.36 * length - 0.004
    mouth = [(end, 0.76 * radius, 0.74 * radius, middle), (end + nozzle, 0.95 * radius, 0.36 * radius, middle)]
    dark = lying_body([(end + nozzle + x, 0.88 * radius, 0.26 * radius, middle) for x in (-0.003, 0.001)])
    grill = lying_body(
        [(left - 0.003, 0.74 * radius, 0.74 * radius, middle), (left + 0.004, 0.78 * radius, 0.78 * radius, middle)]
    )
    grip = [(0.0, 0.017, 0.017, 0.0155), (0.1, 0.0155, 0.0155, 0.014), (draw.between(0.135, 0.155), 0.0185, 0.0175, 0.0155)]
    handle = lying_body(grip, 16).turned(z=-97).moved(-0.02, -0.25 * radius).as_handle()
    switch = box(0.012, 0.03, 0.006, 0.002).moved(-0.03, -0.085, 0.0275).painted(accent)
    parts = [barrel, lying_body(mouth).painted(accent), dark.painted("black"), grill.painted("grey"), handle, switch]
    captions = (f"{color} hair dryer with a flat {accent} nozzle", f"{color} hairdryer on its side", "blow dryer for the hair")
    return AssetDesign(join(parts), "plastic", color, captions, density=480.0)


def razor(draw: VariantSampler) -> AssetDesign:
    """A razor that lies on its head and its handle's end, its head to -y."""
    length, width = draw.between(0.125, 0.15), draw.between(0.038, 0.044)
    color = draw.pick("blue", "silver", "pink", "black", "orange", "white")
    accent = draw.pick("grey", "black", "teal", "silver", "navy", "white")
    half = length / 2
    path = [(-half, 0.006), (-0.4 * half, 0.0075), (0.3 * half, 0.011), (half - 0.016, 0.0175), (half - 0.007, 0.012)]
    handle = bar(path, 0.0125, 0.0115).turned(z=90).as_handle()
    grips = [
        box(0.0135, 0.006, 0.0125, 0.002).moved(0.0, y * half, z).painted(accent)
        for y, z in ((-0.8, 0.0003), (-0.6, 0.0006), (-0.4, 0.0013))
    ]
    head = slab(width, 0.019, 0.0115, 0.002).moved(0.0, half - 0.0075)
    blades = [box(0.86 * width, 0.002, 0.0125).moved(0.0, half - 0.0075 + y, 0.0).painted("silver") for y in (0.0025, 0.0065)]
    cap = box(0.9 * width, 0.0032, 0.0092).moved(0.0, half + 0.0015, 0.001).painted(accent)
    captions = fix_articles(
        f"a {color} safety razor" if color != "orange" else "an orange disposable razor",
        f"{color} razor",
        "shaving razor, lying flat",
    )
    head = head.painted("black" if color != "black" else "grey")
    solid = join([handle, head, *grips, *blades, cap]).turned(z=180)
    return AssetDesign(solid, "metal" if color == "silver" else "plastic", color, captions)


def cotton_jar(draw: VariantSampler) -> AssetDesign:
    """A jar full of cotton balls or of cotton buds."""
    radius, height = draw.between(0.036, 0.044), draw.between(0.07, 0.09)
    has_buds = draw.pick(False, True, False, True, False, False)
    color, rim = draw.pick("clear", "teal", "amber", "clear", "pink", "grey"), draw.pick("gold", "bamboo", "silver")
    low, wide, cotton = 0.7 * height if has_buds else height, radius + 0.002, "#f4f2ee"
    glass = round_body([(radius - 0.003, 0.0), (radius, 0.004), (radius, low - 0.006), (wide, low - 0.004), (wide, low)], 32)
    foot = round_body([(radius + 0.0012, 0.0), (radius + 0.0012, 0.007)], 32).painted(rim)
    filling = round_body([(radius - 0.003, low - 0.003), (radius - 0.003, low + 0.0012)], 32).painted(cotton)
    spots = [(0.0, 0.0)] + [(math.cos(math.radians(60 * k)), math.sin(math.radians(60 * k))) for k in range(6)]
    if has_buds:
        tip = [(0.0018, 0.021), (0.0036, 0.025), (0.0036, 0.034), (0.0018, 0.038)]
        bud = round_body([(0.0015, -0.002), (0.0015, 0.024)], 6).painted("blue") + round_body(tip, 6).painted(cotton)
        spots += [(0.5 * y, 0.5 * x) for x, y in spots[1:]]
        contents = [bud.moved(0.74 * radius * x, 0.74 * radius * y, low) for x, y in spots]
    else:
        size, around = 0.46 * radius, 0.56 * radius
        ball = [(0.4, -0.8), (0.86, -0.45), (1.0, 0.0), (0.86, 0.45), (0.4, 0.8)]
        puff = round_body(scaled(ball, size, size), 12).painted(cotton).moved(z=low + 0.42 * size)
        contents = [puff.moved(around * x, around * y, 0.0 if k else 0.33 * size) for k, (x, y) in enumerate(spots)]
    words = "cotton buds" if has_buds else "cotton balls"
    captions = (f"a jar of {words}, {color}", f"jar of {words}", f"{color} glass of {words} with a {rim} foot")
    return AssetDesign(join([glass, foot, filling, *contents]), "glass", color, captions, density=500.0)


def tissue_box(draw: VariantSampler) -> AssetDesign:
    """A box of tissues, one of them standing out of the slot."""
    is_cube = draw.pick(False, True, False, True, False, False)
    if is_cube:
        width, depth, height = 0.115, 0.115, draw.between(0.12, 0.135)
    else:
        width, depth, height = draw.between(0.21, 0.24), 0.118, draw.between(0.055, 0.09)
    color = draw.pick("blue", "white", "pink", "bamboo", "teal", "grey")
    accent = draw.pick("cream", "yellow", "grey", "navy", "white")
    body = slab(width, depth, height, 0.002)
    slot = round_body([(0.042 if is_cube else 0.055, height + z) for z in (-0.003, 0.001)], 32, 0.42)
    band = box(width + 0.0018, depth + 0.0018, 0.22 * height).moved(z=0.3 * height).painted(accent)
    folds = [(0.036, 0.006, 0.0, 0.0), (0.05, 0.011, 0.022, 10.0), (0.062, 0.006, 0.045, -14.0), (0.02, 0.003, 0.066, -34.0)]
    rings = []
    for k, (wide, thick, z, turn) in enumerate(folds):
        c, s = math.cos(math.radians(turn)), math.sin(math.radians(turn))
        ring = rectangle(2 * wide * 0.72, 2 * thick, height - 0.002 + z)
        rings.append(ring @ np.array([[c, s, 0.0], [-s, c, 0.0], [0.0, 0.0, 1.0]]) + np.array([0.005 * k, 0.003 * k, 0.0]))
    parts = [body, slot.painted("black"), chain(rings).painted("white")] + ([band] if color != "bamboo" else [])
    kind = "cube" if is_cube else "long box"
    captions = (f"a {kind} of tissues, {color}, one tissue standing out", f"{color} tissue box", "box of paper tissues")
    return AssetDesign(join(parts), "cardboard", color, captions, density=150.0)


FAMILIES = (comb, hair_brush, hair_dryer, razor, cotton_jar, tissue_box)
