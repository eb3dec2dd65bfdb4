"""Vessels to serve food and drink: pots, jugs, shakers, trays."""

import math
from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from stable_data.embedded_world.families.vessels import Bands, banded_lathe, cup, radius_at, round_handle, square_handle, well
from stable_data.embedded_world.families.wording import color_word, fix_articles
from stable_data.embedded_world.modelling.family import AssetDesign, SupportArea, VariantSampler
from stable_data.embedded_world.modelling.shapes import scaled
from stable_data.embedded_world.modelling.solids import (
    Profile,
    Solid,
    bar,
    chain,
    circle,
    hull,
    join,
    loft,
    rectangle,
    slab,
    vessel,
)


def _spout(path: Sequence[tuple[float, float, float]]) -> Solid:
    """A tapered tube in the plane y = 0 through points (x, z, radius)."""
    points = np.array(path)
    steps = np.gradient(points[:, :2], axis=0)
    rings = []
    for (x, z, radius), step in zip(points, steps, strict=True):
        along = step / np.linalg.norm(step)
        section = circle(radius, 0.0, 16)
        rings.append(np.stack([x + section[:, 0] * along[1], section[:, 1], z - section[:, 0] * along[0]], axis=1))
    return chain(rings)


def _lidded(profile: Profile, bands: Bands, knob: float, color: str) -> Solid:
    """A closed pot of revolution with a round knob on its lid."""
    top = profile[-1][1]
    ball = [(0.55, -0.4), (0.6, 0.3), (1.0, 0.9), (1.0, 1.5), (0.6, 2.0)]
    return banded_lathe(profile, bands) + banded_lathe([(knob * r, top + knob * z) for r, z in ball], corners=24).painted(color)


def teapot(draw: VariantSampler) -> AssetDesign:
    """A pot with a spout on its left, a handle on its right and a lid."""
    style, belly, foot, rise = draw.pick(
        ("round", 0.5, 0.62, 1.5), ("tall", 0.3, 0.8, 2.0), ("squat", 0.45, 0.75, 1.15), ("straight-sided", 0.12, 0.98, 1.5)
    )
    color, lid = draw.pick(
        ("white", "white"), ("teal", "teal"), ("red", "black"), ("cream", "blue"), ("black", "copper"), ("#8fb0a2", "oak")
    )
    name = color_word(color)
    radius = draw.between(0.062, 0.075) * (0.85 if style == "tall" else 1.0)
    high, mouth = rise * radius, 0.56 * radius
    profile = [(foot * radius - 0.003, 0.0), (foot * radius, 0.003), (0.5 * (foot + 1.0) * radius + 0.003, 0.45 * belly * high)]
    profile += [(radius, belly * high), (0.97 * radius, (0.5 + belly / 2) * high), (0.8 * radius, 0.93 * high), (mouth, high)]
    profile += [(0.7 * mouth, high + 0.06 * radius), (0.2 * mouth, high + 0.1 * radius)]
    pot = _lidded(profile, [(high, lid)], draw.between(0.008, 0.011), lid)
    start, reach = radius_at(profile, 0.3 * high), draw.between(0.75, 0.95) * radius
    tube = [(0.02 - start, 0.26 * high, 0.017), (-start - 0.25 * reach, 0.4 * high, 0.0135)]
    tube += [(-start - 0.6 * reach, 0.75 * high, 0.0095), (-start - 0.78 * reach, 0.96 * high, 0.0085)]
    low, top = ((radius_at(profile, z * high) - 0.006, z * high) for z in (0.26, 0.84))
    handle = round_handle(low, top, draw.between(0.55, 0.7) * radius, 0.013, 0.009)
    captions = fix_articles(f"a {style} {name} teapot with a lid", f"{name} tea pot with a spout", f"{style} ceramic teapot")
    return AssetDesign(join([pot, handle, _spout(tube)]), "ceramic", color, captions, density=620.0)


def pitcher(draw: VariantSampler) -> AssetDesign:
    """An open jug with a lip on its left and a handle on its right."""
    style, foot, waist = draw.pick(("slender", 0.86, 0.84), ("bellied", 1.0, 0.72), ("conical", 1.06, 0.88))
    color, material = draw.pick(
        ("white", "ceramic"), ("clear", "glass"), ("blue", "ceramic"), ("silver", "metal"), ("cream", "ceramic"), ("green", "glass"),
    )  # fmt: skip
    name = {"clear": "clear glass", "green": "green glass", "silver": "steel"}.get(color, color)
    radius, wall, floor = draw.between(0.05, 0.06), 0.0034, 0.009
    height = draw.between(3.2, 3.8) * radius
    outer = [(foot * radius - 0.003, 0.0), (foot * radius, 0.003), (waist * radius, 0.8 * height), (0.88 * radius, height)]
    inner = [(r - wall, z) for r, z in ((radius_at(outer, floor) - 0.001, floor), *outer[2:])]
    edge, chin = 0.88 * radius, radius_at(outer, 0.86 * height)
    beak = [*((0.0016 - edge, y, height - 0.0006) for y in (-0.015, 0.015)), (0.0008 - chin, 0.0, 0.86 * height)]
    beak += [(-edge - 0.014, y, height + dz) for y in (-0.007, 0.007) for dz in (-0.002, 0.003)]
    low, high = ((radius_at(outer, z * height) - wall / 2, z * height) for z in (0.3, 0.9))
    handle = draw.pick(round_handle, square_handle)(low, high, draw.between(0.036, 0.045), 0.015, 0.009)
    captions = (f"a {style} {name} pitcher with a handle", f"{name} jug for water or juice", f"open {name} pitcher")
    solid, hollow = join([cup(outer, inner), handle, hull(np.array(beak))]), well(inner[1][0], floor, height - floor)
    return AssetDesign(solid, material, color, captions, hollow=hollow, density=1400.0)


def sugar_bowl(draw: VariantSampler) -> AssetDesign:
    """A small lidded pot with two ears."""
    color, lid = draw.pick(
        ("white", "gold"), ("blue", "white"), ("cream", "brown"), ("pink", "white"), ("grey", "oak"), ("white", "green")
    )
    radius, foot, rise = draw.between(0.042, 0.052), draw.between(0.6, 0.8), draw.between(1.1, 1.5)
    high = rise * radius
    profile = [(foot * radius, 0.0), (foot * radius + 0.001, 0.004), (radius, 0.5 * high), (0.94 * radius, 0.85 * high)]
    profile += [(0.8 * radius, high), (0.86 * radius, high + 0.003), (0.5 * radius, high + 0.011), (0.2 * radius, high + 0.014)]
    low, top = ((radius_at(profile, z * high) - 0.004, z * high) for z in (0.34, 0.78))
    side = round_handle(low, top, 0.013, 0.007, 0.005)
    captions = fix_articles(
        f"a {color} sugar bowl with a {lid} lid", f"{color} sugar pot with two handles", f"{color} ceramic sugar jar"
    )
    solid = join([_lidded(profile, [(high, lid)], 0.007, lid), side, side.turned(z=180)])
    solid = replace(solid, handle=())  # two ears, of which a hand needs both
    return AssetDesign(solid, "ceramic", color, captions, density=950.0)


def salt_shaker(draw: VariantSampler) -> AssetDesign:
    """A small shaker with holes in its cap."""
    style, color, cap = draw.pick(
        ("glass", "clear", "silver"), ("ceramic", "white", "white"), ("wood", "oak", "silver"),
        ("glass", "clear", "black"), ("ceramic", "cream", "blue"), ("metal", "silver", "silver"),
    )  # fmt: skip
    radius, height = draw.between(0.017, 0.022), draw.between(0.062, 0.09)
    corners, waist = draw.pick((8, 0.72), (48, 0.78), (48, 0.98))
    top = 0.76 * height
    body = banded_lathe(
        [(radius - 0.001, 0.0), (radius, 0.002), (waist * radius, top + 0.003)], ((0.5 * height, color),), corners
    )
    head = 1.06 * waist * radius
    dome = [(head, top), (head, top + 0.5 * (height - top)), (0.8 * head, height - 0.001), (0.66 * head, height)]
    hole = banded_lathe([(0.0013, height - 0.001), (0.0013, height + 0.0006)], corners=8).painted("black")
    ring = [hole, *(hole.moved(0.42 * head * math.cos(t), 0.42 * head * math.sin(t)) for t in (0.3, 1.557, 2.813, 4.07, 5.327))]
    word = {"wood": "wooden", "metal": "steel"}.get(style, style)
    salt = style == "glass"
    captions = (f"a small {word} salt shaker", f"{word} shaker full of salt", f"{word} salt cellar with holes in its {cap} top")
    return AssetDesign(join([body, banded_lathe(dome).painted(cap), *ring]), style, "white" if salt else color, captions)


def pepper_mill(draw: VariantSampler) -> AssetDesign:
    """A turned mill with a waist, a head and a knob."""
    color, head = draw.pick(
        ("walnut", "walnut"), ("oak", "oak"), ("black", "black"), ("oak", "black"), ("white", "oak"), ("red", "red")
    )
    radius, height, waist = draw.between(0.025, 0.03), draw.between(0.14, 0.23), draw.between(0.58, 0.8)
    shares = [(0.97, 0.0), (1.0, 0.03), (1.0, 0.14), (waist, 0.36), (waist, 0.46), (0.92, 0.66), (0.92, 0.69)]
    cap = [(0.72, 0.685), (0.96, 0.71), (1.0, 0.8), (0.8, 0.89), (0.3, 0.93)]
    body, top = banded_lathe(scaled(shares, radius, height)), banded_lathe(scaled(cap, radius, height)).painted(head)
    knob = banded_lathe(scaled([(0.2, 0.92), (0.34, 0.95), (0.22, 1.0)], radius, height), corners=16)
    size, word = "tall" if height > 0.185 else "short", {"walnut": "dark wooden", "oak": "wooden"}.get(color, color)
    captions = (f"a {size} {word} pepper mill", f"{word} pepper grinder with a metal knob", f"turned {word} mill for pepper")
    return AssetDesign(join([body, top, knob.painted("silver")]), "wood", color, captions)


def serving_tray(draw: VariantSampler) -> AssetDesign:
    """A low tray, oblong with two grips or round."""
    color, word, material = draw.pick(
        ("oak", "wooden", "wood"), ("black", "black", "wood"), ("white", "white", "wood"),
        ("walnut", "dark wooden", "wood"), ("silver", "steel", "metal"), ("teal", "teal", "plastic"),
    )  # fmt: skip
    height, floor, wall, shape = draw.between(0.03, 0.045), 0.007, 0.008, draw.pick("oblong", "oblong", "round")
    if shape == "round":
        radius = draw.between(0.15, 0.185)
        low = radius - wall - 0.005
        solid, top = cup([(radius - 0.006, 0.0), (radius, height)], [(low, floor), (radius - wall, height)]), well(low, floor)
    else:
        width, depth, flare = draw.between(0.36, 0.46), draw.between(0.25, 0.31), draw.pick(0.004, 0.02)
        outside = [rectangle(width - 2 * flare, depth - 2 * flare, 0.0, 0.02), rectangle(width, depth, height, 0.02)]
        sizes = ((2 * wall + 2 * flare * (1 - floor / height), floor), (2 * wall, height))
        solid = vessel(outside, [rectangle(width - cut, depth - cut, z, 0.012) for cut, z in sizes])
        arch = [(-0.055, -0.012), (-0.05, 0.018), (-0.035, 0.028), (0.035, 0.028), (0.05, 0.018), (0.055, -0.012)]
        grip = bar(arch, width=0.01, thickness=0.01).turned(z=90).painted(draw.pick("black", "gold", "brown"))
        solid = join([solid, *(grip.moved(side * (width - wall) / 2, 0.0, height) for side in (-1, 1))])
        clear = sizes[0][0] + 0.013  # the corners are cut off
        top = SupportArea(width - clear, depth - clear, floor)
    captions = fix_articles(f"a {shape} {word} serving tray", f"{word} tray with a low rim", f"{word} tray for carrying drinks")
    density = 800.0 if material == "metal" else None
    return AssetDesign(solid, material, color, captions, top, replace(top, height=height - floor), density=density)


def butter_dish(draw: VariantSampler) -> AssetDesign:
    """A flat dish under an oblong lid with a knob."""
    color, lid, word = draw.pick(
        ("white", "white", "white"), ("oak", "white", "wooden and white"), ("blue", "cream", "blue and cream"),
        ("silver", "clear", "glass-topped"), ("cream", "olive", "olive and cream"), ("black", "bamboo", "black and bamboo"),
    )  # fmt: skip
    width, depth, high = draw.between(0.16, 0.185), draw.between(0.1, 0.115), draw.between(0.045, 0.06)
    top = 0.012 + high
    base = loft([rectangle(width - e, depth - e, z, 0.012) for e, z in ((0.02, 0.0), (0.0, 0.009), (0.0, 0.013))])
    sides = ((0.034, 0.012), (0.036, 0.012 + 0.8 * high), (0.05, top))
    cover = loft([rectangle(width - e, depth - e, z, 0.01) for e, z in sides]).painted(lid)
    knob = slab(draw.between(0.024, 0.05), 0.018, 0.016, 0.004).moved(z=top - 0.001).painted("oak" if lid == "clear" else lid)
    captions = fix_articles(f"a {word} butter dish with a lid", f"covered {word} butter dish", "lidded dish for butter")
    return AssetDesign(join([base, cover, knob]), "ceramic", color, captions, density=700.0)


def cake_stand(draw: VariantSampler) -> AssetDesign:
    """A flat round plate on a foot."""
    color, word, material = draw.pick(
        ("white", "white", "ceramic"), ("pink", "pink", "ceramic"), ("oak", "wooden", "wood"),
        ("teal", "teal", "ceramic"), ("clear", "glass", "glass"), ("black", "black", "metal"),
    )  # fmt: skip
    radius, height = draw.between(0.105, 0.145), draw.between(0.07, 0.13)
    foot, stalk, skirt = draw.between(0.5, 0.62), draw.between(0.1, 0.17), draw.between(0.012, 0.02)
    profile = scaled([(foot, 0.0), (foot, 0.05), (stalk, 0.3), (0.85 * stalk, 0.55)], radius, height)
    profile += [(0.5 * radius, height - skirt), (radius - 0.002, height - skirt), (radius, height - skirt + 0.002)]
    profile += [(radius, height - 0.001), (radius - 0.001, height)]
    captions = (f"a {word} cake stand", f"round {word} cake plate on a foot", f"{word} stand for cakes")
    density = None if material == "wood" else 1100.0
    return AssetDesign(banded_lathe(profile), material, color, captions, top=well(radius - 0.001, height), density=density)


FAMILIES = (teapot, pitcher, sugar_bowl, salt_shaker, pepper_mill, serving_tray, butter_dish, cake_stand)
