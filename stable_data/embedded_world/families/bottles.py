"""Bottles and flasks, all closed."""

from stable_data.embedded_world.families.vessels import banded_lathe, round_handle
from stable_data.embedded_world.families.wording import color_word, fix_articles
from stable_data.embedded_world.modelling.family import EITHER, AssetDesign, VariantSampler
from stable_data.embedded_world.modelling.shapes import scaled
from stable_data.embedded_world.modelling.solids import bar, join


def bottle(draw: VariantSampler) -> AssetDesign:
    """A closed glass bottle: wine, beer, oil, milk."""
    kind, wide, tall, throat, shoulder, color, label, cap = draw.pick(
        ("red wine", 38, 300, 14.5, 0.6, "#2c4434", "cream", "#6d2230"), ("beer", 31, 235, 13.0, 0.52, "amber", "gold", "silver"),
        ("olive oil", 33, 280, 13.5, 0.66, "#77803a", "white", "black"), ("milk", 43, 220, 20.0, 0.55, "#f1eee6", "#f1eee6", "blue"),
        ("white wine", 37, 320, 14.5, 0.5, "#aab878", "white", "gold"), ("lemonade", 35, 250, 15.0, 0.58, "#e3c95f", "white", "red"),
    )  # fmt: skip
    radius, height, neck = wide * draw.between(0.94, 1.06) / 1e3, tall * draw.between(0.94, 1.05) / 1e3, throat / 1e3
    z = shoulder * height
    rise = 0.5 * (0.88 * height - z)
    profile = [(radius - 0.003, 0.0), (radius, 0.003), (radius, z), (0.84 * radius + 0.16 * neck, z + 0.4 * rise)]
    profile += [(1.25 * neck, z + rise), (neck, z + 1.35 * rise), (neck, 0.9 * height)]
    bands = [(share * z, paint) for share, paint in ((0.18, label), (0.8, color))] if label != color else []
    top = [(1.14 * neck, 0.84 * height - 0.003), (1.14 * neck, height - 0.002), (1.14 * neck - 0.002, height)]
    captions = (f"a bottle of {kind}", "glass bottle with a cap", f"full {kind} bottle")
    return AssetDesign(
        banded_lathe(profile, bands) + banded_lathe(top, corners=24).painted(cap), "glass", color, captions, tilts=EITHER
    )


def sauce_bottle(draw: VariantSampler) -> AssetDesign:
    """A bottle of ketchup, mustard, soy sauce and the like."""
    kind, style, color, label, cap = draw.pick(
        ("ketchup", "squeeze", "#b32d2a", "white", "white"), ("mustard", "nozzle", "#e3b92c", "#c8372d", "#e3b92c"),
        ("soy sauce", "glass", "#38251d", "gold", "red"), ("hot sauce", "glass", "#c2452b", "cream", "green"),
        ("mayonnaise", "squeeze", "#f0e6c4", "blue", "blue"), ("barbecue sauce", "nozzle", "#5b2b20", "orange", "black"),
    )  # fmt: skip
    radius, height = draw.between(0.027, 0.033), draw.between(0.16, 0.2)
    shapes = {
        "squeeze": [(0.94, 0.0), (1.0, 0.03), (0.9, 0.42), (1.0, 0.62), (0.72, 0.76), (0.66, 0.79)],
        "nozzle": [(0.94, 0.0), (1.0, 0.03), (1.0, 0.6), (0.82, 0.7), (0.6, 0.74)],
        "glass": [(0.94, 0.0), (1.0, 0.02), (1.0, 0.5), (0.45, 0.68), (0.42, 0.88)],
    }
    caps = {
        "squeeze": [(0.74, 0.78), (0.78, 0.97), (0.7, 1.0)],
        "nozzle": [(0.68, 0.73), (0.68, 0.79), (0.34, 0.82), (0.12, 1.0)],
        "glass": [(0.5, 0.84), (0.5, 0.98), (0.42, 1.0)],
    }
    if style == "glass":
        radius, height = 0.92 * radius, 0.95 * height
    body, top = (scaled(shape[style], radius, height) for shape in (shapes, caps))
    solid = banded_lathe(body, [(0.16 * height, label), (0.44 * height, color)]) + banded_lathe(top, corners=24).painted(cap)
    captions = (f"a bottle of {kind}", f"{style} bottle of {kind} sauce".replace("sauce sauce", "sauce"), f"full {kind} bottle")
    return AssetDesign(solid, "plastic", color, captions, tilts=EITHER)


def water_bottle(draw: VariantSampler) -> AssetDesign:
    """A bottle to drink from on the way: clear plastic, steel or for sports."""
    style, color, second, cap = draw.pick(
        ("plastic", "clear", "blue", "white"), ("steel", "teal", "teal", "black"), ("sports", "orange", "white", "black"),
        ("plastic", "#b7d8e2", "green", "blue"), ("steel", "pink", "pink", "silver"), ("sports", "#8fb7d6", "navy", "navy"),
    )  # fmt: skip
    radius, height = draw.between(0.031, 0.036), draw.between(0.2, 0.25)
    shapes = {
        "plastic": [(0.9, 0.0), (1.0, 0.02), (1.0, 0.14), (0.94, 0.17), (1.0, 0.2), (1.0, 0.66), (0.42, 0.88), (0.38, 0.95)],
        "steel": [(0.97, 0.0), (1.0, 0.012), (1.0, 0.72), (0.6, 0.83), (0.58, 0.88)],
        "sports": [(0.95, 0.0), (1.0, 0.02), (1.0, 0.4), (0.86, 0.5), (0.86, 0.56), (1.0, 0.68), (0.98, 0.8)],
    }
    caps = {
        "plastic": [(0.46, 0.92), (0.46, 0.99), (0.42, 1.0)],
        "steel": [(0.66, 0.86), (0.66, 0.99), (0.62, 1.0)],
        "sports": [(1.06, 0.78), (1.06, 0.86), (0.4, 0.92), (0.32, 0.93), (0.28, 1.0)],
    }
    body, top = (scaled(shape[style], radius, height) for shape in (shapes, caps))
    low, high = {"plastic": (0.32, 0.56), "steel": (0.0, 0.5), "sports": (0.1, 0.3)}[style]
    parts = [banded_lathe(body, [(low * height, second), (high * height, color)]), banded_lathe(top).painted(cap)]
    if style == "steel":
        loop = scaled([(-0.5, 0.97), (-0.4, 1.07), (0.4, 1.07), (0.5, 0.97)], radius, height)
        parts.append(bar(loop, 0.011, 0.004).painted(cap))
    name = color_word(color)
    captions = fix_articles(
        f"a {name} {style} water bottle", f"{name} drinking bottle with a {cap} cap", f"{style} bottle of water"
    )
    return AssetDesign(join(parts), "plastic", color, captions, tilts=EITHER)


def thermos(draw: VariantSampler) -> AssetDesign:
    """A vacuum flask with a cup for a lid."""
    color, lid, metal = draw.pick(
        ("green", "silver", "silver"), ("silver", "black", "silver"), ("red", "black", "silver"),
        ("navy", "navy", "silver"), ("cream", "oak", "copper"), ("black", "silver", "black"),
    )  # fmt: skip
    radius, height = draw.between(0.036, 0.043), draw.between(0.23, 0.29)
    body = scaled([(0.94, 0.0), (1.0, 0.012), (1.0, 0.68), (0.72, 0.76), (0.7, 0.79)], radius, height)
    bands = [(0.0, metal), (0.08 * height, color), (0.62 * height, metal)]
    cover = scaled([(0.84, 0.77), (0.88, 0.79), (0.8, 0.992), (0.77, 1.0)], radius, height)
    parts, extra = [banded_lathe(body, bands), banded_lathe(cover).painted(lid)], draw.pick(" with a handle", " flask")
    if extra == " with a handle":
        parts.append(
            round_handle((radius - 0.003, 0.2 * height), (radius - 0.003, 0.56 * height), 0.03, 0.014, 0.008).painted("black")
        )
    captions = fix_articles(
        f"a {color} thermos{extra}", f"{color} vacuum flask with a {lid} lid", f"{color} flask for hot drinks"
    )
    return AssetDesign(join(parts), "metal", color, captions, density=850.0)


FAMILIES = (bottle, sauce_bottle, water_bottle, thermos)
