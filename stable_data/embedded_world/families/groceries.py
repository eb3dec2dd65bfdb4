"""Packed and fresh food: jars, tins, cartons, cheese, eggs."""

import math

import numpy as np

from stable_data.embedded_world.families.vessels import banded_box, banded_lathe, well
from stable_data.embedded_world.families.wording import color_word, fix_articles, pick_words
from stable_data.embedded_world.modelling.family import AssetDesign, VariantSampler
from stable_data.embedded_world.modelling.shapes import HALF_BALL, disc, front_panel, lying_lathe, prism, scaled, wedge
from stable_data.embedded_world.modelling.solids import bar, box, circle, join, lathe, loft


def jar(draw: VariantSampler) -> AssetDesign:
    """A closed full glass jar with a wide lid."""
    food, color, label, lid = draw.pick(
        ("strawberry jam", "#9e2634", "white", "red"), ("honey", "#d39a2c", "cream", "gold"), ("pickles", "#7d8a42", "white", "green"),
        ("peanut butter", "#b98a55", "blue", "red"), ("olives", "#59603a", "cream", "black"), ("flour", "#ece4d2", "#ece4d2", "oak"),
    )  # fmt: skip
    radius, height, corners = draw.between(0.034, 0.046), draw.between(0.085, 0.135), draw.pick(48, 48, 8)
    neck = draw.between(0.78, 0.9) * radius
    body = [(radius - 0.004, 0.0), (radius, 0.004), (radius, 0.74 * height), (neck, 0.84 * height), (neck, 0.87 * height)]
    solid = banded_lathe(body, [(0.2 * height, label), (0.6 * height, color)] if label != color else (), corners)
    cover = neck + 0.003
    solid += banded_lathe([(cover, 0.84 * height), (cover, height - 0.0015), (cover - 0.0015, height)]).painted(lid)
    captions = fix_articles(f"a jar of {food} with a {lid} lid", f"glass jar full of {food}", f"closed {food} jar")
    return AssetDesign(solid, "glass", color, captions, top=well(cover - 0.0015, height))


def spice_jar(draw: VariantSampler) -> AssetDesign:
    """A little jar of a spice."""
    spice, color = draw.pick(
        ("paprika", "#b5452a"), ("turmeric", "#d9a02b"), ("dried basil", "#6f7c45"),
        ("cinnamon", "#8a5a35"), ("peppercorns", "#3b3634"), ("sea salt", "#e9e5da"),
    )  # fmt: skip
    lid, shape = draw.pick("black", "silver", "oak"), draw.pick("round", "square")
    radius, height = draw.between(0.019, 0.024), draw.between(0.08, 0.108)
    label = "white" if spice != "sea salt" else "navy"
    if shape == "round":
        bands = [(0.24 * height, label), (0.56 * height, color)]
        body = banded_lathe([(radius - 0.001, 0.0), (radius, 0.0015), (radius, 0.8 * height)], bands)
    else:
        body = box(1.8 * radius, 1.8 * radius, 0.8 * height, 0.004)
        body += front_panel(1.2 * radius, 0.34 * height, -0.9 * radius, 0.24 * height, label)
    cap = [(0.86 * radius, 0.78 * height), (0.86 * radius, height - 0.001), (0.86 * radius - 0.001, height)]
    captions = fix_articles(f"a small {shape} jar of {spice}", f"spice jar with {spice}", f"{spice} in a jar with a {lid} lid")
    return AssetDesign(body + banded_lathe(cap).painted(lid), "glass", color, captions, density=900.0)


def can(draw: VariantSampler) -> AssetDesign:
    """A tin of food with a paper label between its rims."""
    food, label, stripe, wide, tall = draw.pick(
        ("tomatoes", "#c23a2e", "white", 37.5, 110), ("tuna", "blue", "white", 42.5, 40), ("beans", "teal", "gold", 37.5, 110),
        ("peas", "green", "cream", 37.5, 100), ("peaches", "orange", "#f4d27a", 50.0, 120), ("cat food", "purple", "pink", 36.5, 60),
    )  # fmt: skip
    radius, height, rim = wide * draw.between(0.96, 1.04) / 1e3, tall * draw.between(0.95, 1.05) / 1e3, 0.0014
    bead = [(radius - rim, 0.0), (radius, rim), (radius, 0.003), (radius - rim, 0.0045)]
    bands = [(0.005, label), (0.3 * height, stripe), (0.45 * height, label), (height - 0.005, "silver")]
    body = banded_lathe([*bead, *((r, height - z) for r, z in reversed(bead))], bands)
    lid = banded_lathe([(0.86 * radius, height - 0.004), (0.86 * radius, height + 0.0005)]).painted("grey")
    captions = fix_articles(f"a tin of {food}", f"metal can of {food}", f"canned {food} with a {color_word(label)} label")
    return AssetDesign(body + lid, "tin", "silver", captions, top=well(0.86 * radius, height + 0.0005))


def soda_can(draw: VariantSampler) -> AssetDesign:
    """A drink can, narrow at both ends."""
    drink, color, stripe = draw.pick(
        ("cola", "red", "white"), ("lemonade", "yellow", "green"), ("orange soda", "orange", "white"),
        ("tonic water", "silver", "blue"), ("energy drink", "navy", "silver"), ("lime soda", "green", "#d5e06a"),
    )  # fmt: skip
    slim = draw.pick(False, False, True)
    radius, height = (0.0285, draw.between(0.135, 0.15)) if slim else (0.033, draw.between(0.113, 0.122))
    profile = [(0.72 * radius, 0.0), (0.78 * radius, 0.003), (radius, 0.011), (radius, height - 0.014)]
    profile += [(0.84 * radius, height - 0.003), (0.84 * radius, height)]
    bands = [(0.009, color), (0.34 * height, stripe), (0.56 * height, color), (height - 0.013, "silver")]
    tab = bar([(-0.0095, 0.0), (0.0095, 0.0)], 0.011, 0.003).turned(z=90).moved(0.0, 0.004, height + 0.0002).painted("#84898e")
    captions = (f"a {'slim ' * slim}can of {drink}", f"closed {color} soda can", f"drink can, {color}")
    return AssetDesign(banded_lathe(profile, bands) + tab, "tin", "silver", captions)


def milk_carton(draw: VariantSampler) -> AssetDesign:
    """A carton with a gable top."""
    drink, color, paint = draw.pick(
        ("milk", "white", "blue"), ("orange juice", "orange", "white"), ("oat milk", "cream", "teal"),
        ("chocolate milk", "white", "brown"), ("apple juice", "green", "yellow"), ("buttermilk", "white", "red"),
    )  # fmt: skip
    side, body = draw.between(0.068, 0.094), draw.between(0.14, 0.19)
    roof = body + 0.42 * side
    rows = [(side, side, 0.0), (side, side, 0.3 * body), (side, side, 0.72 * body), (side, side, body), (side, 0.003, roof)]
    solid = banded_box(rows, 0.0, [(0.3 * body, paint), (0.72 * body, color)])
    solid += box(side - 0.001, 0.0026, 0.02).moved(z=roof - 0.004)
    if draw.pick(True, False):
        slope = math.degrees(math.atan2(0.42 * side, 0.5 * side))
        cap = banded_lathe([(0.0125, -0.003), (0.0125, 0.009), (0.0115, 0.01)], corners=24).turned(x=slope)
        solid += cap.moved(0.0, -0.26 * side, body + 0.2 * side).painted(paint)
    captions = (f"a carton of {drink}", f"{drink} carton with a gable top", f"square paper carton of {drink}")
    return AssetDesign(solid, "paper", color, captions, density=1000.0)


def cereal_box(draw: VariantSampler) -> AssetDesign:
    """A tall flat cardboard box with a picture of a bowl on it."""
    food, color, panel, accent = draw.pick(
        ("corn flakes", "yellow", "white", "red"), ("granola", "#c39a6b", "cream", "green"), ("cocoa puffs", "brown", "yellow", "white"),
        ("oat flakes", "blue", "white", "gold"), ("fruit rings", "purple", "#f3d4dc", "orange"), ("muesli", "green", "cream", "brown"),
    )  # fmt: skip
    width, depth, height = draw.between(0.165, 0.2), draw.between(0.05, 0.07), draw.between(0.24, 0.3)
    face, cut = -depth / 2, draw.between(0.5, 0.62)
    dish = [(0.4, 0.0), (0.8, 0.35), (1.0, 1.0), (-1.0, 1.0), (-0.8, 0.35), (-0.4, 0.0)]
    outline = [(0.28 * width * x, (0.12 + 0.18 * z) * height) for x, z in dish]
    picture = loft([np.array([(x, y, z) for x, z in outline]) for y in (face - 0.0018, face + 0.002)]).painted(accent)
    parts = [box(width, depth, height), front_panel(0.86 * width, cut * height, face, 0.06 * height, panel), picture]
    parts.append(front_panel(0.7 * width, 0.11 * height, face, 0.76 * height, accent))
    captions = (f"a box of {food}", f"{color_word(color)} cereal box", f"cardboard box of {food} with a picture")
    return AssetDesign(join(parts), "cardboard", color, captions, density=140.0)


def cheese(draw: VariantSampler) -> AssetDesign:
    """A wedge of cheese, with holes, mould or a rind, its cut side to the viewer."""
    style, color, rind = pick_words(
        draw,
        "holes #e8bc45 #d29a2b, brie #f0e2b6 #f5f1e6, blue #ece4cc #6f8a86",
        "gouda #e3ad4a #b5352f, holes #efcf6a #d9ab3c, gouda #d9953a #3a3532",
    )
    r, h, degrees = draw.between(0.1, 0.13), draw.between(0.042, 0.062), draw.between(34.0, 50.0)
    if style == "brie":
        h *= 0.65
    parts = [wedge(r, degrees, 0.0, h)]
    if style in ("holes", "blue"):
        # x and z as shares of the cut side, radius in mm
        spots = ((0.14, 0.5, 6), (0.36, 0.3, 8), (0.62, 0.62, 10), (0.5, 0.78, 5), (0.84, 0.35, 8), (0.28, 0.7, 4))
        for x, z, size in spots:
            hole = disc(size * (0.001 if style == "holes" else 0.0005), -0.002, 0.001, 10)
            parts.append(hole.turned(x=90).moved((x - 0.5) * r, 0.0, z * h).painted(rind))
            away = math.radians(degrees * (0.25 + 0.5 * z))
            if x > 0.3:
                parts.append(hole.moved(x * r * math.cos(away) - 0.5 * r, x * r * math.sin(away), h).painted(rind))
    else:
        arc = [math.radians(degrees * (k + 0.1) / 4.2) for k in range(5)]
        both = ((r - 0.001, arc), (r + 0.003, arc[::-1]))
        edge = [(x * math.cos(a) - 0.5 * r, x * math.sin(a)) for x, angles in both for a in angles]
        cover = [prism([edge[k], edge[k + 1], edge[8 - k], edge[9 - k]], 0.0, h + 0.0008) for k in range(4)]
        parts.append(join(cover).painted(rind))
        if style == "brie":
            parts.append(wedge(r, degrees, h - 0.0015, h + 0.0022, -0.012).painted(rind))
    names = {"holes": "cheese with holes", "brie": "soft white cheese", "blue": "blue cheese"}
    name = names.get(style, "hard cheese with a rind")
    return AssetDesign(join(parts), "food", color, (f"a wedge of {name}", f"piece of {name}", "cheese wedge"), density=1000.0)


def egg(draw: VariantSampler) -> AssetDesign:
    """An egg on its side, or half of a boiled one."""
    r, stretch, is_half = draw.between(0.02, 0.0235), draw.between(1.24, 1.4), draw.pick(False, False, True)
    word, color = pick_words(
        draw, "white #eee9df, brown #c48d62, pale #ecd9b8, light_brown #d3a47c, white #f2efe8, pale #f0e3cc"
    )
    shape = [(-1.0, 0.22), (-0.9, 0.5), (-0.66, 0.8), (-0.3, 0.99), (-0.02, 1.0)]
    shape += [(0.3, 0.95), (0.66, 0.74), (0.9, 0.43), (1.0, 0.18)]
    if is_half:
        oval, h = np.array([stretch, 1.0, 1.0]), 0.86 * r
        dome = loft([circle(x * r, z * h, 32) * oval for x, z in HALF_BALL])
        yolk = lathe(scaled(((1.0, -0.9), (1.0, 0.3), (0.9, 1.0)), 0.56 * r, 0.0022), 32).moved(-0.12 * r, 0.0, h)
        captions = fix_articles("half of a boiled egg", "halved hard-boiled egg with a yellow yolk", "boiled egg, cut side up")
        return AssetDesign(dome + yolk.painted("#eda93a"), "fruit", "#f4f0e6", captions, density=1030.0)
    solid = lying_lathe([(x * stretch * r, y * r) for x, y in shape], corners=20)
    captions = (f"a {word} egg", f"raw {word} egg", f"chicken egg with a {word} shell")
    return AssetDesign(solid, "fruit", color, captions, density=1030.0)


FAMILIES = (jar, spice_jar, can, soda_can, milk_carton, cereal_box, cheese, egg)
