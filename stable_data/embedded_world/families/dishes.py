"""Dishes to eat from and the mats and napkins beside them."""

import math
from dataclasses import replace

import numpy as np

from stable_data.embedded_world.families.vessels import banded_lathe, banded_vessel, cup, well
from stable_data.embedded_world.families.wording import color_word, fix_articles
from stable_data.embedded_world.modelling.family import AssetDesign, SupportArea, VariantSampler
from stable_data.embedded_world.modelling.solids import Solid, box, circle, join, loft, rectangle


def _dish(radius: float, height: float, foot: float, rim: str, line: str) -> tuple[Solid, SupportArea]:
    """A round dish with a flat well and a straight rim, painted from the well outwards; equal dishes stack without touching."""
    floor, edge, inside = 0.0055, 0.0025, 24  # the floor is thicker than the rim is high over the same place
    outer = [circle(foot, 0.0), circle(radius, height - edge), circle(radius, height)]
    low, lip = foot + 0.003, radius - 0.002
    inner = [circle(low, floor, inside), circle(lip, height, inside)]
    marks = [(floor + share * (height - floor), color) for share, color in ((0.12, rim), (0.86, line)) if color]
    linings = [(circle(float(np.interp(z, [floor, height], [low, lip])), z, inside), color) for z, color in marks]
    return banded_vessel(outer, inner, linings=linings), well(low, floor)


def plate(draw: VariantSampler) -> AssetDesign:
    """A plate; equal plates stack."""
    kind, low, high = draw.pick(("dinner plate", 0.125, 0.138), ("side plate", 0.092, 0.106))
    color, rim, line = draw.pick(
        ("white", "", ""), ("white", "", "blue"), ("#5f7f8c", "", ""),
        ("cream", "terracotta", ""), ("white", "olive", ""), ("#4a4e54", "", "copper"),
    )  # fmt: skip
    radius, height = draw.between(low, high), draw.between(0.019, 0.026)
    solid, top = _dish(radius, height, draw.pick(0.6, 0.72, 0.66) * radius, rim, line)
    name, trim = color_word(color), f" with a {rim or line} rim" if rim or line else ""
    captions = fix_articles(f"a {name} {kind}{trim}", f"round {name} ceramic plate", f"{name} {kind} for a meal")
    return AssetDesign(solid, "ceramic", color, captions, top, replace(top, height=height - top.z))


def saucer(draw: VariantSampler) -> AssetDesign:
    """A small plate for under a cup."""
    color, rim, line = draw.pick(
        ("white", "", "gold"), ("pink", "", ""), ("white", "blue", ""),
        ("cream", "", "green"), ("teal", "", "gold"), ("navy", "", ""),
    )  # fmt: skip
    radius, height = draw.between(0.066, 0.08), draw.between(0.015, 0.02)
    solid, top = _dish(radius, height, draw.between(0.52, 0.6) * radius, rim, line)
    trim = f" with a {rim or line} rim" if rim or line else ""
    captions = fix_articles(f"a {color} saucer{trim}", f"small {color} plate for under a teacup", f"{color} porcelain saucer")
    return AssetDesign(solid, "ceramic", color, captions, top)


def bowl(draw: VariantSampler) -> AssetDesign:
    """An open bowl: for rice, cereal, pasta, salad."""
    use, low, high, rise, belly, material = draw.pick(
        ("rice", 0.056, 0.065, 0.95, 0.86, "ceramic"), ("cereal", 0.07, 0.082, 0.82, 0.88, "ceramic"),
        ("pasta", 0.1, 0.116, 0.5, 0.86, "ceramic"), ("salad", 0.11, 0.135, 0.62, 0.86, "wood"),
        ("soup", 0.074, 0.088, 0.66, 0.93, "ceramic"), ("mixing", 0.1, 0.12, 0.8, 0.87, "metal"),
    )  # fmt: skip
    color, lining = draw.pick(
        ("blue", "white"), ("white", ""), ("cream", "#c98f62"), ("green", "white"), ("#d8653f", "cream"), ("grey", "teal")
    )
    color, lining = {"wood": ("oak", ""), "metal": ("silver", "")}.get(material, (color, lining))
    name = {"wood": "wooden", "metal": "steel"}.get(material, color_word(color))
    radius, foot, wall = (
        draw.between(low, high),
        draw.between(0.48, 0.56),
        {"wood": 0.006, "metal": 0.0018}.get(material, 0.004),
    )
    height = rise * radius
    outer = [(foot * radius, 0.0), ((foot - 0.03) * radius, 0.005), (belly * radius, 0.48 * height), (radius, height)]
    floor = max(0.0085, 0.14 * height)
    inner = [((foot - 0.06) * radius, floor), (belly * radius - wall, 0.48 * height), (radius - wall, height)]
    shape = "deep" if rise > 0.75 else "wide"
    captions = (f"a {shape} {name} {use} bowl", f"{name} bowl for {use}", f"round {name} bowl")
    hollow, density = well(inner[0][0], floor, height - floor), {"metal": 2200.0, "ceramic": 1800.0}.get(material)
    return AssetDesign(cup(outer, inner, lining), material, color, captions, hollow=hollow, density=density)


def coaster(draw: VariantSampler) -> AssetDesign:
    """A flat round, square or six-sided mat for a glass."""
    word, material, color, inset = draw.pick(
        ("cork", "wood", "#c9a06c", ""), ("slate", "ceramic", "#4a4e54", ""), ("marble", "ceramic", "white", "grey"),
        ("wooden", "wood", "walnut", ""), ("felt", "fabric", "grey", ""), ("leather", "rubber", "brown", "#8f6344"),
    )  # fmt: skip
    corners, name = draw.pick((48, "round"), (4, "square"), (6, "six-sided"))
    half, thick = draw.between(0.045, 0.052) * (1.32 if corners == 4 else 1.0), draw.between(0.004, 0.008)
    profile = [(half - 0.0008, 0.0), (half, 0.0008), (half, thick - 0.0008), (half - 0.0008, thick)]
    solid = banded_lathe(profile, corners=corners)
    if inset:
        solid += banded_lathe([(0.8 * half, thick - 0.001), (0.8 * half, thick + 0.0004)], corners=corners).painted(inset)
    flat = 2 * (0.8 if inset else 0.97) * half * math.cos(math.pi / corners)
    captions = (f"a {name} {word} coaster", f"{word} coaster for a glass", f"small {name} mat for a drink")
    top = SupportArea(flat, flat, thick + (0.0004 if inset else 0), is_round=corners != 4)
    return AssetDesign(solid, material, color, captions, top=top)


def napkin(draw: VariantSampler) -> AssetDesign:
    """A cloth folded into layers: oblong, square or three-cornered."""
    shape = draw.pick("oblong", "square", "triangular")
    color, stripe = draw.pick(
        ("white", "red"), ("#b9a88c", ""), ("navy", ""), ("olive", "cream"), ("terracotta", ""), ("cream", "blue")
    )
    name = color_word(color)
    side, layer, edge = draw.between(0.15, 0.19), 0.0032, ((0.0, 0.0008), (0.001, 0.0), (0.0022, 0.0), (0.0032, 0.0008))
    width = 0.56 * side if shape == "oblong" else side
    layers = []
    for n in range(3):
        if shape == "triangular":
            half = 0.72 * side - 0.006 * n
            corners = np.array([(-half, -half / 3, 0.0), (half, -half / 3, 0.0), (0.0, 2 * half / 3, 0.0)])
            sheet = loft([corners * (1 - 4 * e / half) + [0, 0, z] for z, e in edge])
        else:
            sheet = loft([rectangle(width - 0.006 * n - 2 * e, side - 0.004 * n - 2 * e, z, 0.003) for z, e in edge])
        layers.append(sheet.moved(-0.0022 * n, 0.0014 * n, (layer - 0.0004) * n))
    if stripe and shape != "triangular":
        top = 3 * layer - 0.0008
        line = box(0.008, side - 0.014, 0.0014).painted(stripe)
        layers += [line.moved(share * width, 0.003, top - 0.001) for share in (-0.3, -0.2)]
    captions = (f"a folded {name} cloth napkin", f"{shape} {name} napkin", f"{name} cloth for the table, folded")
    return AssetDesign(join(layers), "fabric", color, captions)


def placemat(draw: VariantSampler) -> AssetDesign:
    """A thin mat to set a place on: oblong, round or eight-sided."""
    color, inner, word, material = draw.pick(
        ("navy", "blue", "blue", "fabric"), ("#b9a88c", "cream", "linen", "fabric"), ("bamboo", "oak", "bamboo", "wood"),
        ("olive", "#a3ab70", "olive", "fabric"), ("black", "grey", "grey", "rubber"), ("terracotta", "#c98a6a", "terracotta", "fabric"),
    )  # fmt: skip
    shape = draw.pick("oblong", "round", "eight-sided")
    thick = 0.0026
    if shape == "round":
        radius = draw.between(0.165, 0.185)
        solid = banded_lathe([(radius, 0.0), (radius, thick)])
        solid += banded_lathe([(0.9 * radius, thick - 0.001), (0.9 * radius, 0.003)]).painted(inner)
        top = well(0.9 * radius, 0.003)
    else:
        width, depth, cut = draw.between(0.4, 0.45), draw.between(0.29, 0.32), 0.06 if shape == "eight-sided" else 0.002
        solid = box(width, depth, thick, cut) + box(width - 0.03, depth - 0.03, 0.0014, cut).moved(z=0.0016).painted(inner)
        top = SupportArea(width - 0.031 - cut, depth - 0.031 - cut, 0.003)
    captions = fix_articles(f"a {shape} {word} placemat", f"{word} table mat", f"flat {shape} {word} mat")
    return AssetDesign(solid, material, color, captions, top=top)


FAMILIES = (plate, saucer, bowl, coaster, napkin, placemat)
