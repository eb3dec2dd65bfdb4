"""Drinkware."""

from stable_data.embedded_world.families.vessels import banded_lathe, cup, radius_at, round_handle, square_handle, well
from stable_data.embedded_world.families.wording import color_word, fix_articles
from stable_data.embedded_world.modelling.family import AssetDesign, VariantSampler
from stable_data.embedded_world.modelling.shapes import scaled


def mug(draw: VariantSampler) -> AssetDesign:
    """A cup with a handle on its right."""
    style = draw.pick("straight", "tapered", "rounded")
    color, lining, dip = draw.pick(
        ("white", "", ""), ("navy", "white", ""), ("red", "white", ""),
        ("teal", "cream", "cream"), ("black", "", ""), ("yellow", "white", "white"),
    )  # fmt: skip
    radius, height, wall = draw.between(0.037, 0.046), draw.between(0.08, 0.104), 0.0042
    shares = {"straight": [(1.0, 0.0), (1.0, 1.0)], "tapered": [(0.76, 0.0), (1.0, 1.0)]}
    profile = scaled(shares.get(style, [(0.74, 0.0), (1.0, 0.42), (0.86, 1.0)]), radius, height)
    foot, (lip, _) = profile[0][0], profile[-1]
    outer = [(foot - 0.003, 0.0), (foot, 0.003), *profile[1:-1], (lip, height - 0.0015), (lip - 0.001, height)]
    inner = [(foot - wall, 0.007), *((r - wall, z) for r, z in profile[1:])]
    low, high = ((radius_at(outer, z * height) - wall / 2, z * height) for z in (0.24, 0.8))
    handle = draw.pick(round_handle, round_handle, square_handle)(low, high, draw.between(0.024, 0.03), 0.012, 0.0075)
    body = cup(outer, inner, lining, bands=[(0.42 * height, dip)] if dip else ())
    word = f"{color} and {dip}" if dip else color
    captions = fix_articles(
        f"a {word} {style} mug with a handle", f"{word} coffee mug", f"ceramic mug, {word}", "mug for hot drinks"
    )
    return AssetDesign(body + handle, "ceramic", color, captions, hollow=well(foot - wall, 0.007, height - 0.007))


def teacup(draw: VariantSampler) -> AssetDesign:
    """A low wide cup on a small foot, thin-walled."""
    radius, height, wall = draw.between(0.042, 0.05), draw.between(0.052, 0.064), 0.0026
    color, lining, rim = draw.pick(
        ("white", "", "gold"), ("pink", "white", ""), ("white", "", "blue"),
        ("cream", "", "green"), ("teal", "white", "gold"), ("navy", "white", ""),
    )  # fmt: skip
    belly, lip = draw.pick((0.86, 0.96), (0.78, 0.9), (0.94, 0.99))
    outer = [(0.5 * radius, 0.0), (0.48 * radius, 0.08 * height), (belly * radius, 0.45 * height)]
    outer += [(lip * radius, 0.75 * height), (radius, height)]
    floor = 0.17 * height
    inner = [(0.4 * radius, floor), (belly * radius - wall, 0.45 * height), (radius - wall, height)]
    low, high = ((radius_at(outer, z * height) - wall / 2, z * height) for z in (0.36, 0.84))
    handle = draw.pick(round_handle, square_handle)(low, high, draw.between(0.018, 0.023), 0.0065, 0.0045)
    trim = f" with a {rim} rim" if rim else ""
    captions = fix_articles(
        f"a {color} teacup{trim}", f"{color} porcelain cup for tea", f"small wide {color} tea cup with a handle"
    )
    solid = cup(outer, inner, lining, 0.88 * height, rim) + handle
    return AssetDesign(solid, "ceramic", color, captions, hollow=well(0.4 * radius, floor, height - floor))


def tumbler(draw: VariantSampler) -> AssetDesign:
    """A tall cup without a handle: plastic, enamel, or of steel with a lid and a straw."""
    style = draw.pick("plastic", "lidded", "enamel")
    color = draw.pick("orange", "teal", "pink", "navy", "green", "purple")
    radius, height = draw.between(0.036, 0.042), draw.between(0.1, 0.125)
    if style == "lidded":
        return _travel_tumbler(draw, color, radius, 1.45 * height)
    foot, wall = draw.between(0.74, 0.9) * radius, 0.0024
    outer = [(foot - 0.002, 0.0), (foot, 0.002), (radius, height - 0.003), (radius - 0.0008, height)]
    edge = [(0.93 * height, "navy" if color != "navy" else "white")] if style == "enamel" else [(0.86 * height, "white")]
    body = cup(outer, [(foot - wall, 0.004), (radius - wall, height)], "white" if style == "enamel" else "", bands=edge)
    word = f"{color} {style}"
    captions = fix_articles(
        f"a {word} tumbler", f"{color} drinking cup without a handle", f"{color} {style} cup with a {edge[0][1]} rim"
    )
    material = "plastic" if style == "plastic" else "tin"
    return AssetDesign(body, material, color, captions, hollow=well(foot - wall, 0.004, height - 0.004))


def _travel_tumbler(draw: VariantSampler, color: str, radius: float, height: float) -> AssetDesign:
    foot = draw.between(0.72, 0.82) * radius
    profile = [(foot - 0.002, 0.0), (foot, 0.002), (radius, 0.93 * height), (radius, height - 0.003), (radius - 0.003, height)]
    body = banded_lathe(profile, [(0.002, "silver"), (0.1 * height, color), (0.93 * height, "black")])
    straw = banded_lathe([(0.0038, 0.0), (0.0038, 0.07)], corners=12).painted(draw.pick("clear", "white", "black"))
    captions = fix_articles(
        f"a {color} tumbler with a lid and a straw", f"insulated {color} travel tumbler", "cup with a straw"
    )
    solid = body + straw.turned(y=8).moved(0.35 * radius, 0.0, height - 0.012)
    return AssetDesign(solid, "metal", color, captions, density=650.0)


def drinking_glass(draw: VariantSampler) -> AssetDesign:
    """A glass for water or juice."""
    style = draw.pick("tall", "low", "rounded")
    color = draw.pick("clear", "#a9cfe0", "#cfe3c4", "clear", "#d9b878", "#c9c3d6")
    radius, height, wall, floor = draw.between(0.034, 0.04), draw.between(0.12, 0.15), 0.0024, draw.between(0.008, 0.012)
    if style == "low":
        radius, height, floor = 1.08 * radius, 0.64 * height, 1.3 * floor
    middle = [(0.86 * radius, 0.0), (radius, 0.5 * height), (0.9 * radius, height)] if style == "rounded" else []
    profile = middle or [(draw.between(0.76, 0.96) * radius, 0.0), (radius, height)]
    outer = [(profile[0][0] - 0.001, 0.0), (profile[0][0], 0.001), *profile[1:]]
    inner = [(radius_at(outer, floor) - 1.3 * wall, floor), *((r - wall, z) for r, z in profile[1:])]
    name = color_word(color)
    captions = (f"a {style} {name} drinking glass", f"{name} water glass", f"empty {style} glass for drinks")
    hollow = well(inner[0][0], floor, height - floor)
    return AssetDesign(cup(outer, inner), "glass", color, captions, hollow=hollow, density=1900.0)


def wine_glass(draw: VariantSampler) -> AssetDesign:
    """A glass with a bowl on a stem."""
    use, wide, tall, lip = draw.pick(
        ("red wine", 1.0, 0.5, 0.74), ("white wine", 0.82, 0.5, 0.76), ("sparkling wine", 0.62, 0.6, 0.8),
        ("red wine", 1.12, 0.48, 0.66), ("water", 0.9, 0.56, 0.92), ("dessert wine", 0.72, 0.5, 0.95),
    )  # fmt: skip
    color = draw.pick("clear", "clear", "#c3d9c8")
    height, radius = draw.between(0.17, 0.215), wide * draw.between(0.038, 0.042)
    foot, stalk, wall, high = draw.between(0.036, 0.04), 0.0046, 0.0019, tall * height
    low = height - high
    bowl = [(stalk, low), (0.58 * radius, low + 0.14 * high), (0.9 * radius, low + 0.32 * high)]
    bowl += [(radius, low + 0.5 * high), (lip * radius, height)]
    outer = [(foot, 0.0), (foot, 0.0016), (0.3 * foot, 0.0065), (stalk, 0.018), *bowl]
    inner = [(0.4 * radius, low + 0.15 * high), (radius - wall, low + 0.5 * high), (lip * radius - wall, height)]
    captions = (f"a stemmed glass for {use}", f"empty {use} glass on a thin stem", "wine glass with a round foot")
    return AssetDesign(cup(outer, inner), "glass", color, captions, density=1800.0)


def egg_cup(draw: VariantSampler) -> AssetDesign:
    """A little cup on a foot, empty or with an egg in it."""
    color, lining = draw.pick(
        ("white", ""), ("yellow", "white"), ("oak", ""), ("blue", "white"), ("teal", "orange"), ("green", "white")
    )
    word, material = ("wooden", "wood") if color == "oak" else (color, "ceramic")
    radius, waist, wall = draw.between(0.0245, 0.027), draw.between(0.36, 0.5), 0.0024
    height = draw.between(1.9, 2.5) * radius
    outer = scaled([(0.88, 0.0), (0.86, 0.07), (waist, 0.38), (0.84, 0.66), (1.0, 1.0)], radius, height)
    if draw.pick("empty", "full") == "full":
        shares = [(0.9, 0.0), (0.9, 0.12), (0.76, 0.45), (0.5, 0.72), (0.22, 0.84)]
        egg = banded_lathe(scaled(shares, radius, 0.038), corners=24).moved(z=height - 0.002)
        egg = egg.painted(draw.pick("#d9a878", "#f0e3d0"))
        captions = (f"a {word} egg cup with an egg", f"boiled egg in a {word} egg cup", f"breakfast egg in a {word} cup")
        density = 1100.0 if material == "ceramic" else 750.0
        return AssetDesign(banded_lathe(outer) + egg, material, color, captions, density=density)
    captions = (f"an empty {word} egg cup", f"small {word} cup for a boiled egg", f"{word} egg holder")
    solid = cup(outer, [(0.55 * radius, 0.58 * height), (radius - wall, height)], lining)
    return AssetDesign(solid, material, color, captions, hollow=well(0.55 * radius, 0.58 * height, 0.42 * height))


FAMILIES = (mug, teacup, tumbler, drinking_glass, wine_glass, egg_cup)
