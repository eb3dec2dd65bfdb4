"""Cosmetics and mirrors."""

import math
from collections.abc import Sequence

import numpy as np

from stable_data.embedded_world.families.wording import fix_articles
from stable_data.embedded_world.modelling.family import LYING, AssetDesign, SupportArea, VariantSampler
from stable_data.embedded_world.modelling.shapes import front_panel, lying_body, round_body, square_body
from stable_data.embedded_world.modelling.solids import Solid, box, chain, circle, join, loft, slab, vessel

_GLASS = "#c3d9e4"  # a mirror


def perfume(draw: VariantSampler) -> AssetDesign:
    """A scent bottle: flat, square, round, a drum, with a stopper."""
    width, height = draw.between(0.05, 0.068), draw.between(0.06, 0.085)
    style = draw.pick("flat", "square", "drum", "round", "eight-sided", "tapered")
    color = draw.pick("pink", "amber", "clear", "purple", "#d9b46a", "teal")
    metal = draw.pick("gold", "silver", "black", "gold", "white", "copper")
    half, flat = width / 2, {"flat": 0.5, "tapered": 0.62}.get(style, 0.75)
    profile = [(half - 0.003, 0.0), (half, 0.004), (half, 0.9 * height), (half - 0.006, height)]
    if style == "tapered":
        profile = [(half - 0.002, 0.0), (half, 0.004), (0.62 * half, 0.97 * height), (0.55 * half, height)]
    if style == "round":
        profile = [(0.5 * half, 0.0), (0.9 * half, 0.2 * height), (half, 0.42 * height), (0.88 * half, 0.68 * height)]
        profile += [(0.45 * half, 0.92 * height), (0.38 * half, height)]
    if style in ("round", "drum", "eight-sided"):
        glass = round_body(profile, 8 if style == "eight-sided" else 48)
        front = -half * 0.924
    else:
        glass, front = square_body(profile, 0.2, flat), -half * flat
    neck = round_body([(0.0095, height - 0.003), (0.0095, height + 0.006)], 24).painted(metal)
    size = draw.between(0.011, 0.015)
    ball = [(0.5, 0.0), (0.9, 0.35), (1.0, 0.8), (0.9, 1.25), (0.5, 1.6)]
    block = [(0.95, 0.0), (1.0, 0.15), (1.0, 1.7), (0.9, 1.85)]
    stopper = [(r * size, height + 0.004 + z * size) for r, z in (ball if style in ("square", "round", "tapered") else block)]
    cap = (square_body(stopper, 0.3) if style == "flat" else round_body(stopper, 24)).painted(metal)
    label = []
    if style in ("flat", "square", "eight-sided"):
        wide = (0.36 if style == "eight-sided" else 0.5) * width
        label = [front_panel(wide, 0.3 * height, front, 0.32 * height, "cream", thickness=0.004)]
    name = {"#d9b46a": "golden"}.get(color, color)
    captions = fix_articles(
        f"a small {style} bottle of perfume, {name}", f"{name} perfume bottle with a {metal} cap", "scent bottle with a stopper"
    )
    return AssetDesign(join([glass, neck, cap, *label]), "glass", color, captions)


def lipstick(draw: VariantSampler) -> AssetDesign:
    """An open lipstick, its slanted tip out; or one with its cap on."""
    radius, low = draw.between(0.0095, 0.0115), draw.between(0.03, 0.038)
    case, metal = draw.pick("black", "gold", "white", "navy", "pink", "silver"), draw.pick("gold", "silver", "copper")
    color = draw.pick("red", "#c2405f", "#a03a5a", "#d9776c", "#8e2f3a", "#cf5f86")
    is_open = draw.pick(True, True, False, True, True, True)
    base = round_body([(radius, 0.0), (radius, low)], 24)
    if is_open:
        tube = round_body([(0.84 * radius, low - 0.001), (0.84 * radius, low + 0.014)], 24).painted(metal)
        tip = circle(0.68 * radius, low + 0.03, 24)
        stick = loft([circle(0.68 * radius, low + 0.013, 24), tip + tip[:, 1:2] * (0.0, 0.0, 0.9)]).painted(color)
        parts, words = [tube, stick], "open lipstick"
    else:
        ring = round_body([(1.06 * radius, low - 0.002), (1.06 * radius, low + 0.003)], 24).painted(metal)
        parts = [ring, round_body([(radius, low), (radius, low + 0.03), (0.85 * radius, low + 0.032)], 24)]
        words = "closed lipstick"
    shade = "red" if color in ("red", "#8e2f3a") else "rose"
    first = f"{words}, {shade}, in a {case} case" if is_open else f"{words} in a {case} case"
    captions = (first, f"{case} lipstick", "lipstick standing on its base")
    return AssetDesign(join([base, *parts]), "plastic", case, captions)


def nail_polish(draw: VariantSampler) -> AssetDesign:
    """A little bottle with a long cap."""
    half, low, cap = draw.between(0.014, 0.018), draw.between(0.03, 0.038), draw.between(0.03, 0.042)
    color = draw.pick("red", "pink", "purple", "teal", "#c2405f", "navy")
    style, tint = draw.pick("square", "round", "bell-shaped"), draw.pick("black", "white", "gold", "black", "silver", "black")
    profile = [(half - 0.001, 0.0), (half, 0.002), (half, 0.78 * low), (0.5 * half, low)]
    if style == "bell-shaped":
        profile = [(1.1 * half, 0.0), (1.12 * half, 0.003), (0.85 * half, 0.6 * low), (0.45 * half, low)]
    glass = square_body(profile, 0.25) if style == "square" else round_body(profile, 32)
    lid = round_body([(0.5 * half, low - 0.001), (0.52 * half, low + 0.002), (0.36 * half, low + cap)], 24).painted(tint)
    name = {"#c2405f": "raspberry"}.get(color, color)
    captions = (f"a small {style} bottle of {name} nail polish", f"{name} nail polish", f"nail varnish with a {tint} cap")
    return AssetDesign(join([glass, lid]), "glass", color, captions)


def cream_jar(draw: VariantSampler) -> AssetDesign:
    """A low jar with a wide lid."""
    radius, height = draw.between(0.028, 0.038), draw.between(0.034, 0.052)
    color = draw.pick("white", "clear", "pink", "amber", "teal", "cream")
    lid = draw.pick("gold", "silver", "white", "black", "bamboo", "copper")
    style, split = draw.pick("round", "tapered", "rounded"), 0.6 * height
    foot = {"round": 0.98, "tapered": 0.78, "rounded": 0.7}[style]
    belly = [(foot * radius, 0.0), (radius, (0.3 if style == "rounded" else 0.94) * split), (0.96 * radius, split)]
    cover = [(1.0, split - 0.001), (1.02, split + 0.002), (1.02, height - 0.002), (0.97, height)]
    top = round_body([(r * radius, z) for r, z in cover]).painted(lid)
    captions = (f"a low {color} jar of face cream with a {lid} lid", f"{color} cream jar", f"{style} pot of skin cream")
    space = SupportArea(1.3 * radius, 1.3 * radius, height, is_round=True)
    return AssetDesign(join([round_body(belly), top]), "glass", color, captions, top=space)


def makeup_palette(draw: VariantSampler) -> AssetDesign:
    """An open palette of powders, its lid with a mirror leaning back."""
    width, depth = draw.between(0.1, 0.15), draw.between(0.06, 0.08)
    columns, rows = draw.pick((4, 2), (5, 3), (3, 1), (4, 3), (6, 2), (2, 1))
    color, opening = draw.pick("black", "pink", "gold", "white", "navy", "copper"), draw.between(102, 118)
    tints = ("#d8a58c", "#b56a5a", "#8a4a4a", "#e3c3ab", "#c98a94", "#6e4a44", "#a9748a", "#d0b08a")
    base = slab(width, depth, 0.012, 0.0025)
    cell_x, cell_y = 0.9 * width / columns, 0.86 * depth / rows
    pans = [
        box(0.84 * cell_x, 0.84 * cell_y, 0.004, 0.002)
        .moved((i - (columns - 1) / 2) * cell_x, (j - (rows - 1) / 2) * cell_y - 0.002, 0.0095)
        .painted(tints[(3 * i + 5 * j) % len(tints)])
        for i in range(columns)
        for j in range(rows)
    ]
    lid = slab(width, depth, 0.006, 0.002).moved(0.0, depth / 2)
    glass = box(0.88 * width, 0.84 * depth, 0.004).moved(0.0, depth / 2, 0.0032).painted(_GLASS)
    cover = join([lid, glass]).turned(x=180 - opening).moved(0.0, depth / 2 - 0.004, 0.009)
    words = f"an open {color} makeup palette with {columns * rows} powders"
    captions = (words, f"{color} eyeshadow palette", "open makeup palette with a mirror in its lid")
    return AssetDesign(join([base, *pans, cover]), "plastic", color, captions)


def makeup_brush(draw: VariantSampler) -> AssetDesign:
    """A brush for powder or shadow, standing on its handle's end."""
    length, radius = draw.between(0.15, 0.19), draw.between(0.0045, 0.006)
    style = draw.pick("powder", "flat", "pointed", "powder", "fan", "small")
    color, metal = draw.pick("black", "pink", "walnut", "white", "bamboo", "purple"), draw.pick("silver", "gold", "copper")
    tint = draw.pick("#4a3a34", "#c9a58a", "#2f2b2c", "#e6dcd0", "#8a5a48")
    kinds = {"powder": (2.6, 0.26, 0.8), "flat": (1.9, 0.18, 0.5), "pointed": (1.7, 0.2, 0.9), "small": (1.25, 0.12, 0.9)}
    wide, tuft, flat = kinds.get(style, (3.2, 0.2, 0.34))
    neck, rise = (1 - tuft) * length, tuft * length
    ferrule, end = neck - 0.024, 0.35 if style == "pointed" else 0.62

    def flattened(sections: Sequence[tuple[float, float, float]]) -> Solid:
        """A round body with a flat back, so that it lies still."""
        rings = [circle(r * radius, z, 16) * (1.0, y, 1.0) for r, z, y in sections]
        return chain([np.maximum(ring, (-1.0, -0.72 * radius, 0.0)) for ring in rings])

    handle = flattened([(0.75, 0.0, 1.0), (1.1, 0.55 * ferrule, 1.0), (0.95, ferrule + 0.001, 1.0)])
    collar = flattened([(1.0, ferrule, 1.0), (1.05, neck, 1.0)]).painted(metal)
    bulge = [(wide, neck + 0.55 * rise, flat), (0.92 * wide, neck + 0.8 * rise, flat), (end * wide, length, flat)]
    hair = flattened([(1.0, neck - 0.001, 1.0), *bulge]).painted(tint)
    kind = {"powder": "powder brush", "fan": "fan brush", "small": "eyeshadow brush"}.get(style, f"{style} makeup brush")
    captions = (f"{color} {kind} with a {metal} collar", f"{color} makeup brush", f"cosmetic brush, {style}")
    return AssetDesign(join([handle, collar, hair]), "wood", color, captions, tilts=LYING)


def brush_holder(draw: VariantSampler) -> AssetDesign:
    """An open pot for makeup brushes, with a foot and a lower part of other colours."""
    radius, height, wall = draw.between(0.036, 0.045), draw.between(0.09, 0.12), 0.0034
    corners = draw.pick(48, 8, 48, 8, 48, 8)
    color, metal = draw.pick("clear", "pink", "white", "black", "#a9b8a4", "cream"), draw.pick("gold", "silver", "copper")
    flare = draw.pick(1.0, 0.86, 1.12)
    inside = 16 if corners == 48 else 8
    outer = [circle(radius * flare, 0.0, corners), circle(radius, height, corners)]
    inner = [circle(radius * flare - wall, 0.008, inside), circle(radius - wall, height, inside)]
    pot = vessel(outer, inner).turned(z=180 / corners)
    foot = round_body([(radius * flare + 0.0025, 0.0), (radius * flare + 0.0025, 0.0075)], corners).painted(metal)
    free = 2 * (radius * min(flare, 1.0) - wall) * math.cos(math.pi / inside)
    name = {"#a9b8a4": "sage"}.get(color, color)
    captions = fix_articles(
        f"{name} pot for makeup brushes with a {metal} foot", f"{name} brush holder", "open holder for cosmetic brushes"
    )
    material, hollow = "glass" if color == "clear" else "ceramic", SupportArea(free, free, 0.008, height - 0.008, is_round=True)
    return AssetDesign(join([pot, foot]), material, color, captions, hollow=hollow)


def mirror(draw: VariantSampler) -> AssetDesign:
    """A mirror on a stand, round, oval or square, leaning back a little."""
    radius, lean = draw.between(0.075, 0.1), draw.between(8, 13)
    style = draw.pick("round", "square", "oval", "round", "eight-sided", "oval")
    color = draw.pick("gold", "white", "black", "silver", "walnut", "copper")
    tall, rise = 1.3 if style == "oval" else 1.0, draw.pick(0.035, 0.05, 0.02)
    frame = [(radius - 0.003, 0.0), (radius, 0.003), (radius, 0.01), (radius - 0.003, 0.013)]
    glass = [(0.9 * radius, 0.01), (0.9 * radius, 0.0142)]
    if style in ("square", "eight-sided"):
        bevel = 0.12 if style == "square" else 0.58
        face = square_body(frame, bevel) + square_body(glass, bevel).painted(_GLASS)
    else:
        face = round_body(frame, 48, tall) + round_body(glass, 48, tall).painted(_GLASS)
    half, aside = (tall * radius * f(math.radians(lean)) for f in (math.cos, math.sin))
    foot = round_body([(0.62 * radius, 0.0), (0.62 * radius, 0.007), (0.5 * radius, 0.011), (0.012, 0.018)])
    stem = round_body([(0.0085, 0.012), (0.0085, 0.03 + rise)], 24)
    face = face.turned(x=90 - lean).moved(0.0, 0.004 + 0.85 * aside, 0.018 + rise + half)
    captions = (f"{style} table mirror on a {color} stand", f"{color} vanity mirror", f"{style} makeup mirror with a foot")
    material = "wood" if color == "walnut" else "metal"
    return AssetDesign(join([foot, stem, face]), material, color, captions, density=1100.0)


def hand_mirror(draw: VariantSampler) -> AssetDesign:
    """A mirror that lies on its back, its handle to -y."""
    radius, grip = draw.between(0.05, 0.062), draw.between(0.1, 0.13)
    style = draw.pick("round", "oval", "square", "oval", "round", "rounded")
    color = draw.pick("black", "gold", "pink", "silver", "walnut", "white")
    tall = 1.3 if style == "oval" else 1.0
    frame = [(radius - 0.004, 0.0), (radius, 0.004), (radius, 0.009), (radius - 0.004, 0.013)]
    glass = [(0.85 * radius, 0.01), (0.85 * radius, 0.0142)]
    if style in ("round", "oval"):
        face = round_body(frame, 48, tall) + round_body(glass, 48, tall).painted(_GLASS)
    else:
        bevel = 0.2 if style == "square" else 0.55
        face = square_body(frame, bevel) + square_body(glass, bevel).painted(_GLASS)
    shape = [(0.0, 0.016, 0.006, 0.0055), (0.025, 0.0085, 0.006, 0.0055)]
    shape += [(0.75 * grip, 0.0115, 0.007, 0.0065), (grip, 0.008, 0.0055, 0.005)]
    handle = lying_body(shape, 16).turned(z=-90).moved(0.0, 0.008 - tall * radius)
    captions = (f"{style} {color} hand mirror lying on its back", f"{color} hand mirror", f"hand-held mirror, {style}")
    return AssetDesign(face + handle, "wood" if color == "walnut" else "plastic", color, captions)


FAMILIES = (perfume, lipstick, nail_polish, cream_jar, makeup_palette, makeup_brush, brush_holder, mirror, hand_mirror)
