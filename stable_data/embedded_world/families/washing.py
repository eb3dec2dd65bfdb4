"""Toiletries and towels."""

import math

import numpy as np

from stable_data.embedded_world.families.wording import fix_articles
from stable_data.embedded_world.modelling.family import EITHER, LYING, AssetDesign, SupportArea, VariantSampler
from stable_data.embedded_world.modelling.shapes import front_panel, lying_body, round_body, scaled, square_body
from stable_data.embedded_world.modelling.solids import Solid, bar, box, chain, circle, join, loft, rectangle, slab, vessel


def _pump(z: float, size: float, color: str) -> Solid:
    """The pump of a bottle whose shoulder is at z, its spout to -y."""
    parts = round_body(
        [(0.6 * size, z - 0.001), (0.6 * size, z + 0.014), (0.22 * size, z + 0.016), (0.22 * size, z + 0.034)], 24
    )
    head = slab(0.8 * size, 1.0 * size, 0.011, 0.003).moved(z=z + 0.031)
    spout = bar([(0.0, z + 0.037), (1.7 * size, z + 0.037), (1.95 * size, z + 0.027)], 0.009, 0.007, 8).turned(z=-90)
    return join([parts, head, spout]).painted(color)


def _folded(width: float, depth: float, thickness: float) -> Solid:
    """A layer of cloth, its left and right edges round."""
    angle = np.radians([-90, -54, -18, 18, 54, 90])
    x, z = (width - thickness) / 2 + thickness / 2 * np.cos(angle), thickness / 2 * (1 + np.sin(angle))
    outline = np.array([*zip(x, z, strict=True), *zip(-x[::-1], z[::-1], strict=True)])
    return loft([np.stack([outline[:, 0], np.full(12, y), outline[:, 1]], axis=1) for y in (-depth / 2, depth / 2)])


def toothbrush(draw: VariantSampler) -> AssetDesign:
    """A toothbrush on its handle's end, its flat back to -y."""
    length, thick = draw.between(0.165, 0.195), draw.between(0.95, 1.25)
    color = draw.pick("blue", "green", "bamboo", "pink", "white", "purple")
    accent = draw.pick("teal", "yellow", "grey", "navy", "orange", "red")
    is_wood = color == "bamboo"
    shape = [(0.0, 9, 7), (0.015, 12, 9), (0.35, 12.5, 10), (0.52, 11, 8), (0.7, 6.5, 5.5), (0.84, 6, 5)]
    shape += [(0.86, 10.5, 5.5), (0.985, 10.5, 5.5), (1.0, 8, 4.5)]
    rings = [
        rectangle(w * 1e-3 * thick, d * 1e-3, z * length, 0.3e-3 * min(w, d)) + np.array([0.0, d * 5e-4, 0.0])
        for z, w, d in shape
    ]
    tufts = [
        box(0.0092, 0.0125, 0.066 * length).moved(0.0, 0.0105, (0.858 + 0.062 * k) * length).painted(tint)
        for k, tint in enumerate((accent, "white") if color != "white" else ("white", accent))
    ]
    grip = box(0.0075 * thick, 0.004, 0.26 * length, 0.0015).moved(0.0, 0.0085, 0.12 * length).painted(accent)
    body = join([loft(rings), *tufts] + ([] if is_wood else [grip]))
    kind = "bamboo toothbrush" if is_wood else f"{color} toothbrush"
    detail = "wooden toothbrush with a plain handle" if is_wood else f"plastic toothbrush, its grip {accent}"
    captions = (f"a slim {kind}", kind, detail, "brush for the teeth")
    return AssetDesign(body, "wood" if is_wood else "plastic", color, captions, tilts=LYING)


def toothbrush_cup(draw: VariantSampler) -> AssetDesign:
    """A cup for toothbrushes: round, tapered, square, on a foot of another colour."""
    radius, height, wall = draw.between(0.034, 0.041), draw.between(0.095, 0.118), 0.0034
    style = draw.pick("straight", "tapered", "square", "footed", "waisted", "eight-sided")
    color = draw.pick("white", "grey", "teal", "cream", "pink", "navy")
    inner_at = radius - wall
    if style == "square":
        side = 1.85 * radius
        outer = [rectangle(side, side, z, 0.007) for z in (0.0, height)]
        cup = vessel(outer, [rectangle(side - 2 * wall, side - 2 * wall, z, 0.005) for z in (0.007, height)])
        hollow = SupportArea(1.7 * inner_at, 1.7 * inner_at, 0.007, height - 0.007, is_round=True)
    else:
        foot, waist = {"tapered": (0.8, 0.9), "waisted": (0.96, 0.84)}.get(style, (1.0, 1.0))
        corners, inside = (8, 8) if style == "eight-sided" else (48, 16)
        half = 0.5 * height
        outer = [circle(radius * s, z, corners) for s, z in ((foot, 0.0), (waist, half), (1.0, height))]
        inner = [circle(radius * s - wall, z, inside) for s, z in ((foot, 0.007), (waist, half), (1.0, height))]
        cup = vessel(outer, inner)
        free = 2 * (radius * min(foot, waist) - wall) * math.cos(math.pi / inside)
        hollow = SupportArea(free, free, 0.007, height - 0.007, is_round=True)
    if style == "footed":
        cup += round_body([(radius + 0.002, 0.0), (radius + 0.002, 0.0065)]).painted("bamboo")
    words = f"{color} and {style}"
    captions = (f"{style} {color} cup for toothbrushes", f"{color} toothbrush holder", f"ceramic bathroom tumbler, {words}")
    return AssetDesign(cup, "ceramic", color, captions, hollow=hollow)


def toothpaste(draw: VariantSampler) -> AssetDesign:
    """A tube that lies along x, its cap on the left."""
    length, radius = draw.between(0.135, 0.175), draw.between(0.016, 0.020)
    color = draw.pick("white", "red", "blue", "white", "green", "white")
    cap = draw.pick("white", "blue", "red", "green", "orange", "navy")
    band = draw.pick("blue", "red", "teal", "green", "yellow", "navy")
    middle, left = 0.88 * radius, -length / 2
    band = "white" if color != "white" else band

    def section(share: float, more: float = 0.0) -> tuple[float, float, float, float]:
        x = left + 0.022 + share * (length - 0.022)
        half = radius + share * (0.46 * radius) + more
        high = radius + share * (0.0022 - radius) + more
        return (x, half, high, middle + share * (0.0024 - middle))

    tube = lying_body(
        [(left + 0.017, 0.45 * radius, 0.45 * radius, middle), *(section(k) for k in (0.0, 0.16, 0.72, 0.93, 1.0))]
    )
    tip = [(left, 0.52 * radius, 0.55 * radius, middle), (left + 0.019, 0.62 * radius, 0.62 * radius, middle)]
    stripe = lying_body([section(0.16, 0.0009), section(0.72, 0.0009)]).painted(band)
    captions = (f"a tube of toothpaste, {color} with a {band} band", f"{color} toothpaste tube", f"toothpaste, its cap {cap}")
    return AssetDesign(join([tube, lying_body(tip, 16).painted(cap), stripe]), "plastic", color, captions)


def soap(draw: VariantSampler) -> AssetDesign:
    """A bar of soap: oval, round or a block, with a raised field."""
    length, height = draw.between(0.07, 0.092), draw.between(0.022, 0.03)
    style = draw.pick("oval", "rectangular", "round", "rounded", "oval", "rectangular")
    color = draw.pick("pink", "cream", "white", "green", "#b9a5cf", "#e8b98a")
    name = {"#b9a5cf": "lavender", "#e8b98a": "honey"}.get(color, color)
    half = length / 2
    profile = scaled([(0.86, 0.0), (1.0, 0.3), (1.0, 0.65), (0.86, 0.95), (0.7, 1.0)], half, height)
    if style == "round":
        body = round_body([(0.85 * r, z) for r, z in profile])
        field = round_body([(0.42 * half, 0.5 * height), (0.4 * half, height + 0.0012)], 24)
    elif style == "oval":
        body = round_body(profile, 32, 0.64)
        field = round_body([(0.5 * half, 0.5 * height), (0.48 * half, height + 0.0012)], 24, 0.5)
    else:
        body = square_body(profile, 0.5 if style == "rounded" else 0.16, 0.62)
        field = square_body([(0.5 * half, 0.5 * height), (0.48 * half, height + 0.0012)], 0.15, 0.4)
    captions = (f"a bar of {name} soap, {style}", f"{name} soap", f"{style} bar of hand soap", "scented soap bar")
    return AssetDesign(join([body, field]), "wax", color, captions)


def soap_dish(draw: VariantSampler) -> AssetDesign:
    """A shallow dish with ribs on its floor."""
    width, height = draw.between(0.12, 0.14), draw.between(0.02, 0.03)
    depth = draw.between(0.085, 0.098)
    style = draw.pick("rectangular", "oval", "rounded", "oval", "rectangular", "rounded")
    color = draw.pick("white", "bamboo", "grey", "teal", "black", "cream")
    floor, wall = 0.005, 0.004
    if style == "oval":
        scale = np.array([1.0, depth / width, 1.0])
        outer = [circle(width / 2 * s, z) * scale for s, z in ((0.8, 0.0), (1.0, height))]
        inner = [(circle(width / 2 * s - 1.4 * wall, z, 16)) * scale for s, z in ((0.82, floor), (1.0, height))]
        reach = 0.42
    else:
        bevel = 0.022 if style == "rounded" else 0.006
        outer = [rectangle(width - s, depth - s, z, bevel) for s, z in ((0.016, 0.0), (0.0, height))]
        inner = [
            rectangle(width - s - 2 * wall, depth - s - 2 * wall, z, 0.8 * bevel) for s, z in ((0.014, floor), (0.0, height))
        ]
        reach = 0.58
    ribs = [box(0.005, reach * depth, 0.0045, 0.0008).moved(k * 0.017, 0.0, floor - 0.001) for k in (-2, -1, 0, 1, 2)]
    top = floor + 0.0035
    captions = (f"{style} {color} soap dish with ribs", f"{color} soap dish", f"shallow {style} dish for a bar of soap")
    material, hollow = "wood" if color == "bamboo" else "ceramic", SupportArea(0.068, reach * depth, top, height - top)
    return AssetDesign(join([vessel(outer, inner), *ribs]), material, color, captions, hollow=hollow)


def soap_dispenser(draw: VariantSampler) -> AssetDesign:
    """A bottle with a pump, its spout to -y."""
    radius, height = draw.between(0.031, 0.038), draw.between(0.105, 0.135)
    style = draw.pick("round", "square", "tapered", "bulbous", "six-sided", "straight")
    color = draw.pick("amber", "white", "teal", "pink", "grey", "cream")
    pump = draw.pick("black", "silver", "gold", "white", "black", "copper")
    shoulder = [(radius, 0.8 * height), (0.62 * radius, 0.97 * height), (0.014, height)]
    profile = [(radius - 0.003, 0.0), (radius, 0.004), *shoulder]
    if style == "tapered":
        profile = [(1.1 * radius, 0.0), (1.12 * radius, 0.004), (0.62 * radius, 0.95 * height), (0.014, height)]
    if style == "bulbous":
        profile = scaled([(0.8, 0.0), (1.15, 0.25), (1.15, 0.45), (0.6, 0.85), (0.5, 1.0)], radius, height)
    if style == "square":
        body = square_body([(0.9 * r, z) for r, z in profile], 0.25)
    else:
        body = round_body(profile, 6) if style == "six-sided" else round_body(profile)
    if style in ("round", "straight"):
        body += round_body([(radius + 0.0008, 0.2 * height), (radius + 0.0008, 0.58 * height)]).painted(
            "white" if color != "white" else "kraft"
        )
    captions = fix_articles(
        f"a {style} {color} soap dispenser with a {pump} pump", f"{color} pump dispenser", f"liquid hand soap, {pump} pump"
    )
    return AssetDesign(join([body, _pump(height, 0.024, pump)]), "plastic", color, captions)


def shampoo_bottle(draw: VariantSampler) -> AssetDesign:
    """A tall bottle with a flip cap and a label, flat in front or round."""
    half, height = draw.between(0.032, 0.04), draw.between(0.17, 0.22)
    style, flat = draw.pick("oval", "round", "square", "shouldered", "tapered", "oval"), draw.between(0.55, 0.68)
    color = draw.pick("green", "white", "orange", "blue", "#6d4a86", "black")
    cap, label = draw.pick("white", "teal", "gold", "white", "grey", "white"), draw.pick("cream", "green", "white", "yellow")
    top = 0.84 * height
    profile = [(half - 0.003, 0.0), (half, 0.004), (half, 0.8 * top), (0.55 * half, top)]
    if style == "tapered":
        profile = [(0.95 * half, 0.0), (half, 0.006), (0.6 * half, top)]
    if style == "shouldered":
        profile = [(half - 0.003, 0.0), (half, 0.004), (0.88 * half, 0.4 * top), (half, 0.75 * top), (0.7 * half, top)]
    if style == "square":
        body, flat = square_body(profile, 0.35, flat), flat
        sticker = front_panel(1.4 * half, 0.4 * top, -half * flat, 0.2 * top, label, thickness=0.004)
    else:
        flat = 0.95 if style == "round" else flat
        body = round_body(profile, 48, flat)
        band = [(r + 0.0009, z) for r, z in ((half, 0.18 * top), (half, 0.62 * top))]
        sticker = round_body(band, 48, flat).painted(label)
        if style in ("tapered", "shouldered"):
            sticker = front_panel(0.9 * half, 0.4 * top, -0.93 * half * flat, 0.15 * top, label, thickness=0.004)
    lid = round_body(
        [(0.6 * half, top - 0.001), (0.6 * half, height - 0.002), (0.52 * half, height)], 32, min(1.0, flat + 0.2)
    ).painted(cap)
    name = {"#6d4a86": "violet"}.get(color, color)
    captions = (f"a tall {name} bottle of shampoo with a {cap} cap", f"{name} shampoo bottle", f"{style} bottle of shower gel")
    return AssetDesign(join([body, sticker, lid]), "plastic", color, captions, tilts=EITHER)


def lotion_bottle(draw: VariantSampler) -> AssetDesign:
    """A lotion: a tube on its cap, a flat oval bottle with a disc cap, or one with a pump."""
    half, height = draw.between(0.027, 0.034), draw.between(0.13, 0.17)
    style = draw.pick("tube", "oval", "pump", "tube", "pump", "oval")
    color = draw.pick("white", "pink", "cream", "teal", "yellow", "purple")
    accent = draw.pick("navy", "gold", "green", "copper", "white", "grey")
    if style == "tube":
        sides = ((0.82, 1.0, 0.026), (1.0, 0.8, 0.36 * height), (1.05, 0.55, 0.6 * height), (1.15, 0.07, 0.92 * height))
        outline = [circle(half * wide, z, 24) * (1.0, flat, 1.0) for wide, flat, z in (*sides, (1.15, 0.07, height))]
        band = chain([ring * (1.03, 1.04, 1.0) for ring in outline[1:3]])
        cap = round_body([(0.9 * half, 0.0), (0.9 * half, 0.026), (0.84 * half, 0.028)], 32)
        bottle, words = chain(outline), "tube of hand cream standing on its cap"
    else:
        profile = [(half - 0.002, 0.0), (half, 0.003), (half, 0.78 * height), (0.75 * half, 0.92 * height)]
        bottle = round_body([*profile, (0.45 * half, 0.95 * height)], 48, 0.62)
        band = round_body([(half + 0.0009, 0.2 * height), (half + 0.0009, 0.6 * height)], 48, 0.62)
        cap = round_body([(0.52 * half, 0.94 * height), (0.52 * half, height + 0.018)], 32)
        words = "flat lotion bottle with a round cap"
        if style == "pump":
            cap, words = _pump(0.95 * height, 0.02, accent), "lotion bottle with a pump"
    captions = (f"{color} {words}", f"{color} body lotion", f"skin lotion, {color} and {accent}")
    return AssetDesign(join([bottle, band.painted(accent), cap.painted(accent)]), "plastic", color, captions)


def deodorant(draw: VariantSampler) -> AssetDesign:
    """A deodorant: a flat stick, a roll-on with a domed cap, a spray can."""
    style = draw.pick("stick", "roll-on", "spray", "stick", "spray", "roll-on")
    color = draw.pick("white", "blue", "black", "teal", "purple", "green")
    accent = draw.pick("grey", "white", "orange", "white", "pink")
    if style == "stick":
        half, height = draw.between(0.029, 0.034), draw.between(0.11, 0.13)
        parts = [round_body([(half, 0.0), (half, 0.66 * height)], 48, 0.55)]
        parts.append(round_body([(half + 0.001, 0.0), (half + 0.001, 0.012)], 48, 0.55).painted(accent))
        cap = [(half + 0.0008, 0.655 * height), (half + 0.0008, 0.94 * height), (0.8 * half, height)]
        parts.append(round_body(cap, 48, 0.55).painted(accent))
        parts.append(front_panel(half, 0.3 * height, -0.54 * half, 0.22 * height, accent, thickness=0.004))
    elif style == "roll-on":
        half, height = draw.between(0.021, 0.025), draw.between(0.095, 0.112)
        low = [(0.9 * half, 0.0), (half, 0.003), *scaled([(0.86, 0.3), (1.0, 0.54), (0.9, 0.58)], half, height)]
        cap = [(half, 0.57 * height), (half, 0.82 * height), (0.84 * half, 0.93 * height), (0.5 * half, height)]
        parts = [round_body(low, 32), round_body(cap, 32).painted(accent)]
    else:
        half, height = draw.between(0.023, 0.027), draw.between(0.15, 0.18)
        can = [(half - 0.002, 0.0), (half, 0.002), *scaled([(1.0, 0.76), (0.82, 0.8), (0.82, 0.81)], half, height)]
        band = [(half + 0.0008, 0.3 * height), (half + 0.0008, 0.6 * height)]
        cap = [(0.93 * half, 0.8 * height), (0.93 * half, 0.95 * height), (0.8 * half, height)]
        parts = [round_body(can, 32), round_body(band, 32).painted(accent), round_body(cap, 32).painted(accent)]
    captions = (f"{style} deodorant in {color} and {accent}", f"{color} deodorant", f"deodorant {style}")
    return AssetDesign(join(parts), "plastic", color, captions, tilts=EITHER if style == "spray" else (EITHER[0],))


def towel(draw: VariantSampler) -> AssetDesign:
    """A towel, folded in layers or rolled."""
    width, depth = draw.between(0.2, 0.26), draw.between(0.14, 0.18)
    is_rolled, layers = draw.pick(False, True, False, False, True, False), draw.pick(2, 3, 4)
    color, stripe = draw.pick("white", "grey", "teal", "pink", "navy", "cream"), draw.pick("blue", "copper", "olive")
    if is_rolled:
        radius = draw.between(0.042, 0.055)
        middle, half = 0.9 * radius, width / 2
        roll = lying_body([(x, radius, radius, middle) for x in (-half, half)], 32)
        coils = [
            lying_body([(x, s * radius, s * radius, middle) for x in (-half - d, half + d)], 24).painted(tint)
            for s, d, tint in ((0.78, 0.0012, stripe), (0.64, 0.0024, color), (0.42, 0.0036, stripe), (0.26, 0.0048, color))
        ]
        flap = slab(width - 0.004, 0.05, 0.009, 0.003).turned(x=-38).moved(0.0, -0.72 * radius, 0.9 * middle + 0.62 * radius)
        captions = (f"a rolled {color} towel", f"{color} towel in a roll", "rolled bath towel")
        return AssetDesign(join([roll, *coils, flap]), "fabric", color, captions)
    thick = draw.between(0.014, 0.019)
    pitch = thick - 0.0008
    sheets = [_folded(width - 0.004 * (k % 2), depth - 0.006 * (k % 2), thick).moved(z=k * pitch) for k in range(layers)]
    # Which layers are joined by a fold, and on which side.
    folds = ((0, -1), (1, 1)) if layers == 3 else ((0, -1), (2, -1))[: layers // 2]
    turns = [_folded(0.06, depth - 0.002, thick + pitch).moved(side * (width / 2 - 0.028), 0.0, k * pitch) for k, side in folds]
    height = thick + (layers - 1) * pitch
    band = box(0.022, depth - 0.01, 0.004).moved(0.25 * width, 0.0, height - 0.003).painted(stripe)
    captions = (f"a folded {color} towel, its stripe {stripe}", f"{color} hand towel, folded", "towel folded in layers")
    top = SupportArea(0.5 * width, 0.7 * depth, height, x=-0.08 * width)
    return AssetDesign(join([*sheets, *turns, band]), "fabric", color, captions, top=top)


FAMILIES = (
    toothbrush, toothbrush_cup, toothpaste, soap, soap_dish, soap_dispenser, shampoo_bottle, lotion_bottle, deodorant,
    towel,
)  # fmt: skip
