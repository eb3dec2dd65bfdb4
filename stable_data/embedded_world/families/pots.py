"""Cookware and mixing vessels."""

import math

import numpy as np

from stable_data.embedded_world.families.vessels import INSCRIBED, angular_grip, pouring_lip, side_grips, well
from stable_data.embedded_world.families.wording import fix_articles, material_word, pick_words
from stable_data.embedded_world.modelling.family import AssetDesign, SupportArea, VariantSampler
from stable_data.embedded_world.modelling.shapes import disc, scaled
from stable_data.embedded_world.modelling.solids import (
    Solid,
    bar,
    box,
    circle,
    join,
    lathe,
    rectangle,
    slab,
    turned_vessel,
    vessel,
)


def _pot(radius: float, height: float, foot: float, wall: float = 0.0035) -> tuple[Solid, SupportArea]:
    """A round pan and the room in it; ``foot`` is the share of the radius that it stands on."""
    low, floor = foot * radius, foot * radius - wall - 0.003
    outer = [(low - 0.006, 0.0), (low, 0.006), (radius, height)]
    return turned_vessel(outer, [(floor, 0.005), (radius - wall, height)]), well(floor, 0.005, height - 0.005, INSCRIBED)


def saucepan(draw: VariantSampler) -> AssetDesign:
    """A pan with a long handle on its right."""
    r, h, reach = draw.between(0.072, 0.1), draw.between(0.065, 0.115), draw.between(0.14, 0.19)
    color, grip = pick_words(draw, "silver black, copper silver, red black, black oak, cream oak, navy silver")
    pot, hollow = _pot(r, h, draw.between(0.88, 0.97))
    neck = bar([(r - 0.002, 0.78 * h), (r + 0.06, 0.88 * h)], 0.015, 0.009)
    handle = bar([(r + 0.035, 0.83 * h), (r + 0.07, 0.9 * h), (r + reach, h + 0.004)], 0.024, 0.016).painted(grip).as_handle()
    lip = [pouring_lip(0.995 * r, h, 0.008, 0.03)] if draw.pick(True, False) else []
    kind = "milk pan with a pouring lip" if lip else "sauce pot with one handle"
    captions = fix_articles(
        f"a {material_word(color)} saucepan with a long {grip} handle", f"{color} saucepan", f"{color} {kind}"
    )
    return AssetDesign(join([pot, *lip, neck, handle]), "metal", color, captions, hollow=hollow)


def frying_pan(draw: VariantSampler) -> AssetDesign:
    """A low pan with sloping sides and a long handle on its right."""
    r, h, reach = draw.between(0.1, 0.145), draw.between(0.034, 0.052), draw.between(0.16, 0.2)
    color, grip, coat = pick_words(
        draw, "black black grey, silver silver grey, copper black cream, red black black, teal oak black, grey walnut black"
    )
    pan, room = _pot(r, h, draw.between(0.74, 0.86))
    free = room.width - 0.002
    lining = disc(free / 2, 0.0, 0.0014, 48).moved(z=0.0046).painted(coat)
    neck = bar([(r - 0.003, 0.8 * h), (r + 0.06, 1.1 * h + 0.008)], 0.018, 0.009)
    handle = (
        bar([(r + 0.03, h), (r + 0.07, 1.1 * h + 0.01), (r + reach, 1.1 * h + 0.018)], 0.026, 0.015).painted(grip).as_handle()
    )
    size = "large" if r > 0.122 else "small"
    captions = fix_articles(
        f"a {size} {material_word(color)} frying pan with a {grip} handle", f"{color} skillet", f"{size} pan for eggs, {color}"
    )
    hollow = SupportArea(free, free, 0.006, h - 0.006, is_round=True)
    return AssetDesign(join([pan, lining, neck, handle]), "metal", color, captions, hollow=hollow)


def cooking_pot(draw: VariantSampler) -> AssetDesign:
    """An open pot with a grip on either side."""
    r, share = draw.between(0.095, 0.13), draw.pick(0.85, 1.4, 1.1)
    h = share * r + draw.between(-0.006, 0.006)
    color, grip = pick_words(draw, "silver silver, red red, black copper, cream oak, blue black, copper gold")
    pot, hollow = _pot(r, h, draw.between(0.9, 0.98))
    ears = side_grips(r, 0.8 * h, draw.between(0.026, 0.04), draw.between(0.032, 0.042))
    size, kind = ("tall", "stock pot") if share > 1 else ("low", "casserole")
    captions = fix_articles(
        f"a {size} {material_word(color)} cooking pot with two {grip} handles", f"{color} {kind}", f"open {color} pot for soup"
    )
    return AssetDesign(pot + ears.painted(grip), "metal", color, captions, hollow=hollow)


def pot_lid(draw: VariantSampler) -> AssetDesign:
    """A domed lid with a knob; it lies on its rim."""
    r, dome = draw.between(0.08, 0.13), draw.between(0.014, 0.038)
    color, knob, style = pick_words(
        draw, "clear black ball, silver silver loop, red black disc, clear silver loop, cream oak ball, black copper disc"
    )
    rim = lathe([(r - 0.002, 0.0), (r, 0.002), (r, 0.0065), (r - 0.002, 0.0085)])
    cap = lathe([(share * r, 0.007 + rise * dome) for share, rise in ((0.95, 0.0), (0.75, 0.58), (0.5, 0.85), (0.22, 1.0))])
    grip = {
        "ball": lathe([(0.009, -0.003), (0.009, 0.006), (0.017, 0.012), (0.019, 0.02), (0.015, 0.029), (0.008, 0.033)]),
        "disc": lathe([(0.008, -0.003), (0.008, 0.016), (0.025, 0.02), (0.025, 0.026), (0.02, 0.031)]),
        "loop": angular_grip(-0.004, 0.0, 0.036, 0.036, 0.014, 0.009).turned(y=-90),
    }[style].moved(z=0.007 + dome)
    said, end = material_word(color), f"a {material_word(knob)} {'handle' if style == 'loop' else 'knob'}"
    captions = fix_articles(f"a round {said} pot lid with {end}", f"{said} lid of a pot", f"saucepan lid with {end}")
    solid = join([rim.painted("silver" if color == "clear" else color), cap, grip.painted(knob)])
    return AssetDesign(solid, "metal", color, captions, density=900.0)


def oven_dish(draw: VariantSampler) -> AssetDesign:
    """A rectangular or oval baking dish with a grip at either end."""
    w, share, h = draw.between(0.2, 0.31), draw.between(0.62, 0.78), draw.between(0.048, 0.072)
    color, shape = pick_words(
        draw, "white rectangular, red oval, clear rectangular, cream oval, blue rectangular, terracotta rectangular"
    )
    wall, low = 0.0055, 0.86
    if shape == "oval":
        oval = np.array([1.0, share, 1.0])
        outer = [circle(scale * w / 2, z) * oval for scale, z in ((0.97 * low, 0.0), (low, 0.004), (1.0, h))]
        inner = [circle(scale * w / 2 - 1.3 * wall, z, 16) * oval for scale, z in ((low, 0.006), (1.0, h))]
        free = 0.66 * (low * w - 3 * wall)
    else:
        outer = [rectangle(scale * w, scale * share * w, z, 0.02) for scale, z in ((low, 0.0), (1.0, h))]
        inset = [(low, 0.006), (1.0, h)]
        inner = [rectangle(scale * w - 2 * wall, scale * share * w - 2 * wall, z, 0.018) for scale, z in inset]
        free = low * w - 2 * wall - 0.03
    ear = slab(0.034, 0.42 * share * w, 0.012, 0.004).moved(w / 2 + 0.011, 0.0, h - 0.0125)
    said = f"{material_word(color)}{'' if color in ('clear', 'terracotta') else ' ceramic'}"
    name = f"a {shape} {said} oven dish"
    captions = fix_articles(name, f"{color} baking dish", f"{color} dish for baking lasagne")
    solid, hollow = join([vessel(outer, inner), ear, ear.turned(z=180)]), SupportArea(free, share * free, 0.006, h - 0.006)
    return AssetDesign(solid, "glass" if color == "clear" else "ceramic", color, captions, hollow=hollow)


_BOWLS = {  # outside and hollow, shares of the radius and of the height
    "round": (
        [(0.5, 0.0), (0.5, 0.05), (0.72, 0.22), (0.88, 0.5), (0.97, 0.8), (1.0, 1.0)],
        [(0.46, 0.07), (0.83, 0.5), (0.96, 1.0)],
    ),
    "steep": ([(0.62, 0.0), (0.66, 0.04), (0.8, 0.35), (1.0, 1.0)], [(0.58, 0.06), (0.76, 0.35), (0.96, 1.0)]),
}


def mixing_bowl(draw: VariantSampler) -> AssetDesign:
    """A wide open bowl; some have a pouring lip."""
    r, h = draw.between(0.1, 0.135), draw.between(0.085, 0.125)
    color, material, shape = pick_words(
        draw,
        "silver metal round, cream ceramic steep, clear glass round, teal plastic steep, white ceramic round, yellow plastic steep",
    )
    outer, inner = (scaled(profile, r, h) for profile in _BOWLS[shape])
    lip = [pouring_lip(0.99 * r, h, 0.02, 0.035, 0.024)] if material in ("glass", "plastic") else []
    size, more = "deep" if h > 0.9 * r else "wide", " with a pouring lip" if lip else ""
    captions = fix_articles(
        f"a {size} {material_word(color)} mixing bowl{more}", f"{shape} {color} {material} bowl", f"{color} bowl for dough"
    )
    hollow = well(inner[0][0], inner[0][1], h - inner[0][1], INSCRIBED)
    density = 1100.0 if material == "metal" else None  # steel bowls are thinner than these walls
    return AssetDesign(join([turned_vessel(outer, inner), *lip]), material, color, captions, hollow=hollow, density=density)


def colander(draw: VariantSampler) -> AssetDesign:
    """A bowl full of holes with a grip on either side."""
    r, h = draw.between(0.1, 0.13), draw.between(0.09, 0.12)
    color, low, wall = draw.pick("silver", "red", "white", "green", "blue", "yellow"), 0.6 * r, 0.005
    bowl = turned_vessel([(low - 0.02, 0.0), (low - 0.02, 0.008), (low, 0.02), (r, h)], [(low - wall, 0.022), (r - wall, h)])
    slope = math.degrees(math.atan2(r - low, h - 0.02))
    # A plug through the middle of a facet of the wall reads as a hole on both sides.
    hole = disc(0.007, 0.0, 0.012, 8).moved(z=-0.0085).turned(y=90 + slope)
    holes = []
    for k in range(16):
        share = 0.34 if k % 2 else 0.7
        holes.append(hole.moved(low + share * (r - low), 0.0, 0.02 + share * (h - 0.02)).turned(z=22.5 * (k + 0.5)))
    captions = fix_articles(
        f"a {material_word(color)} colander with two handles",
        f"{color} strainer",
        f"{color} bowl with holes for draining pasta",
    )
    solid = join([bowl, join(holes).painted("black"), side_grips(r, h - 0.008, 0.03, 0.035)])
    hollow = well(low - wall - 0.003, 0.022, h - 0.022, INSCRIBED)
    return AssetDesign(solid, "metal", color, captions, hollow=hollow, density=1800.0)


def measuring_cup(draw: VariantSampler) -> AssetDesign:
    """A jug with marks and a lip on its left, or a scoop with a flat handle on its right."""
    style, color, mark = pick_words(
        draw, "jug clear red, scoop silver black, jug clear blue, scoop red white, jug white teal, scoop copper black"
    )
    r, h = draw.between(0.044, 0.058), draw.between(0.095, 0.125)
    if style == "scoop":
        r, h = 0.8 * r, 0.4 * h
        cup, hollow = _pot(r, h, 0.88, 0.0025)
        flat = slab(1.9 * r, 0.022, 0.004, 0.001).moved(1.85 * r, 0.0, h - 0.005)
        end = slab(0.03, 0.026, 0.0045, 0.001).moved(2.7 * r, 0.0, h - 0.0048).painted(mark)
        solid, kind = join([cup, flat, end]), "scoop with a flat handle"
    else:
        cup, hollow = _pot(r, h, 0.8, 0.004)
        lines = [(0.02 if k % 2 else 0.012, z * h) for k, z in enumerate((0.25, 0.38, 0.51, 0.64, 0.77))]
        marks = [box(w, 0.005, 0.0022).moved(w / 2 - 0.01, -r * (0.8 + 0.2 * z / h) + 0.0011, z) for w, z in lines]
        grip = angular_grip(0.86 * r, 0.55 * h, 0.7 * r, 0.3 * h, 0.014, 0.009).as_handle()
        solid, kind = join([cup, pouring_lip(0.995 * r, h, 0.012, 0.03), grip, join(marks).painted(mark)]), "jug with a handle"
    captions = fix_articles(
        f"a {material_word(color)} measuring cup, a {kind}",
        f"{material_word(color)} measuring {style}",
        "cup for measuring flour",
    )
    return AssetDesign(solid, "glass" if color == "clear" else "plastic", color, captions, hollow=hollow)


def mortar(draw: VariantSampler) -> AssetDesign:
    """A thick bowl with a pestle that leans to the right."""
    r, share, is_waisted = draw.between(0.05, 0.068), draw.between(1.2, 1.5), draw.pick(False, True)
    color, tool, stone = pick_words(
        draw, "grey grey granite, white white marble, oak oak wood, black black granite, walnut walnut wood, white oak ceramic"
    )
    h = share * r
    waisted, plain = ((0.75, 0.0), (0.75, 0.08), (0.55, 0.22), (0.88, 0.5)), ((0.72, 0.0), (0.77, 0.04), (0.93, 0.5))
    outer = scaled((*(waisted if is_waisted else plain), (1.0, 0.8), (1.0, 1.0)), r, h)
    bowl = turned_vessel(outer, [(0.35 * r, 0.35 * h), (0.66 * r, 0.55 * h), (0.78 * r, h)])
    curve = ((0.011, 0.0), (0.017, 0.008), (0.016, 0.02), (0.009, 0.06), (0.011, 0.14), (0.008, 0.147))
    pestle = lathe([(x, z * r / 0.058) for x, z in curve], 16).turned(y=36).moved(-0.25 * r, 0.0, 0.35 * h + 0.006)
    captions = fix_articles(
        f"a {color} {stone} mortar with a pestle", f"{stone} mortar and pestle", f"{color} mortar for grinding spices"
    )
    return AssetDesign(bowl + pestle.painted(tool), "wood" if stone == "wood" else "ceramic", color, captions)


FAMILIES = (saucepan, frying_pan, cooking_pot, pot_lid, oven_dish, mixing_bowl, colander, measuring_cup, mortar)
