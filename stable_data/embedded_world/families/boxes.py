"""Storage boxes, baskets and bags."""

from stable_data.embedded_world.families.vessels import banded_box, banded_lathe, banded_vessel, cup, well
from stable_data.embedded_world.families.wording import color_word, fix_articles
from stable_data.embedded_world.modelling.family import AssetDesign, SupportArea, VariantSampler
from stable_data.embedded_world.modelling.shapes import front_panel, scaled
from stable_data.embedded_world.modelling.solids import Solid, bar, box, join, loft, rectangle, slab, vessel


def _lid(width: float, depth: float, low: float, high: float) -> Solid:
    """A flat lid between two heights, its upper edge cut off."""
    return loft([rectangle(width - e, depth - e, z, 0.008) for e, z in ((0.0, low), (0.0, high - 0.002), (0.004, high))])


def basket(draw: VariantSampler) -> AssetDesign:
    """An open woven basket, round or oblong, with a grip at either end."""
    color, weave, word = draw.pick(
        ("#b98a55", "#9a6c3d", "wicker"), ("#d8b784", "#c19a63", "rattan"), ("#8a5d3b", "#70492d", "dark wicker"),
        ("grey", "white", "rope"), ("#c9a873", "teal", "seagrass"), ("#e4d2ae", "#c9b084", "light woven"),
    )  # fmt: skip
    height, wall, floor, flare = draw.between(0.09, 0.15), 0.007, 0.008, draw.between(0.008, 0.022)
    zs = [share * height for share in (0.18, 0.34, 0.5, 0.66, 0.82)]
    paints = [(z, weave if n % 2 == 0 else color) for n, z in enumerate(zs)]
    is_round = draw.pick(True, False)
    if is_round:
        end = draw.between(0.1, 0.135)
        solid = cup([(end - flare, 0.0), (end, height)], [(end - flare - wall, floor), (end - wall, height)], bands=paints)
        hollow = well(end - flare - wall, floor, height - floor)
    else:
        width, depth, bevel = draw.between(0.25, 0.34), draw.between(0.18, 0.22), 0.025
        end, low = width / 2, 2 * flare * (1 - floor / height)
        cuts = [(2 * flare * (1 - z / height), z) for z in (0.0, *zs, height)]
        rings = [rectangle(width - cut, depth - cut, z, bevel) for cut, z in cuts]
        inner = [rectangle(width - cut - 2 * wall, depth - cut - 2 * wall, z, 0.02) for cut, z in ((low, floor), (0.0, height))]
        marks = [(ring, paint) for ring, (_, paint) in zip(rings[1:], paints, strict=False)]
        solid = banded_vessel([rings[0], rings[-1]], inner, marks)
        hollow = SupportArea(width - low - 2 * wall - 0.021, depth - low - 2 * wall - 0.021, floor, height - floor)
    loop = bar([(-0.04, -0.02), (-0.036, 0.02), (-0.02, 0.034), (0.02, 0.034), (0.036, 0.02), (0.04, -0.02)], 0.007, 0.009)
    grips = [loop.turned(z=90 * side).moved(side * (end - wall / 2 - 0.001), 0.0, height).painted(weave) for side in (-1, 1)]
    shape = "round" if is_round else "oblong"
    captions = fix_articles(
        f"a {shape} {word} basket with two handles", f"open {word} basket", f"{shape} basket for keeping things in"
    )
    return AssetDesign(join([solid, *grips]), "fabric", color, captions, hollow=hollow, density=260.0)


def crate(draw: VariantSampler) -> AssetDesign:
    """An open box of slats between corner posts."""
    color, word, material = draw.pick(
        ("oak", "wooden", "wood"), ("walnut", "dark wooden", "wood"), ("#e2cfa5", "light wooden", "wood"),
        ("white", "white wooden", "wood"), ("green", "green plastic", "plastic"), ("navy", "blue plastic", "plastic"),
    )  # fmt: skip
    width, depth, height = draw.between(0.26, 0.36), draw.between(0.18, 0.26), draw.between(0.11, 0.17)
    board, post, num = 0.007, 0.018, draw.pick(3, 2)
    slat = 0.78 * height / num
    parts = [box(width - board, depth - board, 0.009)]
    for n in range(num):
        z = 0.004 + n * (height - 0.002 - slat - 0.004) / (num - 1)
        parts += [box(width, board, slat).moved(0.0, side * (depth - board) / 2, z) for side in (-1, 1)]
        end = box(board, depth - 0.001, slat - 0.0006)
        parts += [end.moved(side * (width - board - 0.001) / 2, 0.0, z + 0.0003) for side in (-1, 1)]
    x, y = width / 2 - board - post / 2 + 0.002, depth / 2 - board - post / 2 + 0.002
    parts += [box(post, post, height - 0.001).moved(sx * x, sy * y, 0.001) for sx in (-1, 1) for sy in (-1, 1)]
    captions = (f"a {word} crate made of slats", f"open {word} crate", f"{word} fruit box")
    inside = SupportArea(width - 2 * (board + post), depth - 2 * (board + post), 0.009, height - 0.009)
    return AssetDesign(join(parts), material, color, captions, hollow=inside, density=400.0)


def storage_box(draw: VariantSampler) -> AssetDesign:
    """A closed box with a flat lid a little wider than itself."""
    color, lid, word = draw.pick(
        ("kraft", "kraft", "brown cardboard"), ("grey", "white", "grey"), ("white", "oak", "white"),
        ("teal", "teal", "teal"), ("clear", "blue", "clear plastic"), ("#c9b79a", "brown", "beige fabric"),
    )  # fmt: skip
    width, depth, height = draw.between(0.2, 0.33), draw.between(0.15, 0.24), draw.between(0.09, 0.19)
    rim, edge = draw.between(0.018, 0.045), 0.004
    body = box(width - 2 * edge, depth - 2 * edge, height - 0.003, 0.006)
    cover = _lid(width, depth, height - rim, height)
    tag = front_panel(0.3 * width, 0.24 * height, edge - depth / 2, 0.3 * height, "white" if color != "white" else "black")
    captions = (f"a {word} storage box with a lid", f"closed {word} box", f"{word} box with a label on the front")
    top = SupportArea(width - 0.012, depth - 0.012, height)
    return AssetDesign(join([body, cover.painted(lid), tag]), "cardboard", color, captions, top=top, density=110.0)


def gift_box(draw: VariantSampler) -> AssetDesign:
    """A present: a lidded box with a ribbon around it and a bow."""
    color, ribbon = draw.pick(
        ("red", "gold"), ("white", "red"), ("navy", "silver"), ("pink", "white"), ("green", "red"), ("kraft", "teal")
    )
    name = {"kraft": "brown paper"}.get(color, color)
    width, depth, height = draw.between(0.12, 0.2), draw.between(0.1, 0.15), draw.between(0.06, 0.13)
    lid = box(width, depth, 0.026).moved(z=height - 0.026)
    bands = [box(0.02, depth + 0.003, height).moved(z=0.0015), box(width + 0.003, 0.02, height - 0.0003).moved(z=0.0015)]
    size = draw.between(0.9, 1.2)
    path = [(0.0, 0.004), (0.014, 0.018), (0.03, 0.023), (0.039, 0.015), (0.03, 0.006), (0.0, 0.001)]
    loop = bar(scaled(path, size, size), 0.02, 0.0026).moved(z=height + 0.001)
    knot = slab(0.018, 0.022, 0.013, 0.003).moved(z=height)
    bow = [part.painted(ribbon) for part in (*bands, loop, loop.turned(z=180), knot)]
    captions = (f"a {name} gift box with a {ribbon} ribbon", f"{name} present tied with a bow", f"{name} box wrapped as a gift")
    parts = [box(width - 0.004, depth - 0.004, height - 0.002), lid, *bow]
    return AssetDesign(join(parts), "cardboard", color, captions, density=230.0)


def storage_bin(draw: VariantSampler) -> AssetDesign:
    """An open storage bin with a broad rim or a soft fold."""
    color, edge, word, material = draw.pick(
        ("grey", "#c4c8ca", "grey fabric", "fabric"), ("white", "white", "white plastic", "plastic"),
        ("teal", "cream", "teal fabric", "fabric"), ("oak", "oak", "wooden", "wood"),
        ("clear", "clear", "clear plastic", "plastic"), ("pink", "pink", "pink plastic", "plastic"),
    )  # fmt: skip
    width, depth, height = draw.between(0.18, 0.3), draw.between(0.14, 0.22), draw.between(0.09, 0.16)
    wall, flare, bevel = {"plastic": 0.004}.get(material, 0.007), draw.pick(0.0, 0.012), {"wood": 0.001}.get(material, 0.012)
    cuts = [(2 * flare * (1 - z / height), z) for z in (0.0, 0.8 * height, height)]
    outer = [rectangle(width - cut, depth - cut, z, bevel) for cut, z in cuts]
    low = 2 * flare * (1 - 0.006 / height) + 2 * wall
    inner = [rectangle(width - cut, depth - cut, z, bevel) for cut, z in ((low, 0.006), (2 * wall, height))]
    solid = banded_vessel([outer[0], outer[2]], inner, [(outer[1], edge)])
    grip = slab(0.014, 0.36 * depth, 0.012, 0.003).moved(width / 2 + 0.0045, 0.0, height - 0.014)
    tag = front_panel(
        0.26 * width, 0.22 * height, flare * 0.5 - depth / 2, 0.5 * height, "black" if color == "white" else "white"
    )
    parts = [solid, grip, grip.turned(z=180)] + ([tag] if not flare else [])
    captions = (f"an open {word} storage bin", f"{word} box without a lid", f"{word} organizer bin with two grips")
    hollow = SupportArea(width - low - bevel - 0.001, depth - low - bevel - 0.001, 0.006, height - 0.006)
    return AssetDesign(join(parts), material, color, captions, hollow=hollow, density=350.0)


def tin_box(draw: VariantSampler) -> AssetDesign:
    """A metal box with a lid for biscuits or tea, round or oblong."""
    use, color, lid, stripe = draw.pick(
        ("biscuit", "blue", "blue", "white"), ("tea", "green", "gold", "gold"), ("biscuit", "red", "red", "gold"),
        ("tea", "black", "silver", "red"), ("biscuit", "cream", "pink", "pink"), ("candy", "#7fb0a8", "white", "white"),
    )  # fmt: skip
    half, height, rim = draw.between(0.085, 0.105), draw.between(0.055, 0.08), 0.02
    if use == "tea":
        half, height, rim = 0.46 * half, 1.7 * height, 0.03
    shape, rim, marks = draw.pick("round", "round", "oblong"), height - rim, ((0.3 * height, stripe), (0.45 * height, color))
    if shape == "round":
        body = banded_lathe([(half - 0.003, 0.0), (half - 0.002, 0.001), (half - 0.002, rim + 0.004)], marks)
        cover = banded_lathe([(half, rim), (half, height - 0.002), (half - 0.002, height)])
        top = well(half - 0.002, height)
    else:
        wide, deep = 2 * half, 1.6 * half
        body = banded_box([(wide - 0.004, deep - 0.004, z) for z in (0.0, *(z for z, _ in marks), rim + 0.004)], 0.008, marks)
        cover = _lid(wide, deep, rim, height)
        top = SupportArea(wide - 0.015, deep - 0.015, height)
    name = color_word(color)
    captions = fix_articles(f"a {shape} {name} {use} tin with a lid", f"{name} metal tin", f"closed {use} tin in {name}")
    return AssetDesign(body + cover.painted(lid), "tin", color, captions, top=top, density=420.0)


def paper_bag(draw: VariantSampler) -> AssetDesign:
    """A standing bag of stiff paper: open with two handles, or with its top folded over."""
    color, accent, name = draw.pick(
        ("kraft", "brown", "brown"), ("white", "black", "white"), ("kraft", "white", "brown"),
        ("pink", "white", "pink"), ("navy", "gold", "dark blue"), ("black", "cream", "black"),
    )  # fmt: skip
    if draw.pick("open", "folded") == "folded":
        width, depth, height = draw.between(0.085, 0.12), draw.between(0.06, 0.075), draw.between(0.19, 0.24)
        rows = [(width, deep, height * z) for deep, z in ((depth, 0.0), (depth, 0.62), (0.012, 0.84), (0.012, 0.98))]
        flap = box(width + 0.002, 0.017, 0.07 * height).moved(0.0, -0.002, 0.89 * height)
        tag = front_panel(0.6 * width, 0.26 * height, -depth / 2, 0.2 * height, accent)
        captions = (f"a {name} paper bag with its top folded over", f"closed {name} paper bag", f"{name} bag of coffee")
        return AssetDesign(join([banded_box(rows, 0.0), flap, tag]), "paper", color, captions, density=330.0)
    width, depth, height, wall = draw.between(0.18, 0.25), draw.between(0.09, 0.12), draw.between(0.22, 0.3), 0.0018
    outer = [rectangle(width, depth, z) for z in (0.0, height)]
    inner = [rectangle(width - 2 * wall, depth - 2 * wall, z) for z in (0.003, height)]
    reach = 0.17 * width
    path = [(-reach, -0.03), (-reach, 0.035), (-0.6 * reach, 0.06), (0.6 * reach, 0.06), (reach, 0.035), (reach, -0.03)]
    grip = bar(path, width=0.004, thickness=0.004, corners=8).painted(accent)
    grips = [grip.moved(0.0, side * (depth / 2 + 0.001), height) for side in (-1, 1)]
    mark = front_panel(0.34 * width, 0.34 * width, -depth / 2, 0.34 * height, accent)
    captions = (f"an open {name} paper bag with handles", f"{name} shopping bag", f"standing {name} paper carrier bag")
    hollow = SupportArea(width - 2 * wall - 0.001, depth - 2 * wall - 0.001, 0.003, height - 0.003)
    return AssetDesign(join([vessel(outer, inner), *grips, mark]), "paper", color, captions, hollow=hollow, density=400.0)


FAMILIES = (basket, crate, storage_box, gift_box, storage_bin, tin_box, paper_bag)
