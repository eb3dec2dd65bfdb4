"""Kitchen utensils."""

import math

import numpy as np

from stable_data.embedded_world.families.vessels import INSCRIBED, angular_grip, lid_knob, side_grips, well
from stable_data.embedded_world.families.wording import fix_articles, material_word, pick_words
from stable_data.embedded_world.modelling.family import LYING, AssetDesign, SupportArea, VariantSampler
from stable_data.embedded_world.modelling.shapes import disc, prism
from stable_data.embedded_world.modelling.solids import (
    Solid,
    bar,
    box,
    circle,
    join,
    lathe,
    loft,
    rectangle,
    slab,
    turned_vessel,
    vessel,
)


def _stood_up(solid: Solid) -> Solid:
    """Puts a solid that lies along y, its working end towards -y, upright on the end of its handle."""
    return solid.turned(x=-90).grounded()


_BOARDS = {"white": "white plastic", "bamboo": "bamboo"}


def cutting_board(draw: VariantSampler) -> AssetDesign:
    """A flat board, its grip on the left."""
    style, color, second = pick_words(
        draw,
        "plain bamboo kraft, long walnut walnut, round oak oak, handled white green, striped walnut oak, handled oak black",
    )
    width, thick = draw.between(0.26, 0.35), draw.between(0.012, 0.026)
    depth, half, edge = width * draw.between(0.58, 0.7), width / 2, 0.002
    board, more, top = slab(width, depth, thick, 0.003), [], SupportArea(width - 0.01, depth - 0.01, thick)
    if style == "round":
        half = depth = 0.38 * width
        board = lathe([(half - edge, 0.0), (half, edge), (half, thick - edge), (half - edge, thick)])
        top = SupportArea(1.9 * half, 1.9 * half, thick, is_round=True)
    if style in ("striped", "plain"):
        x, wide = (0.3, 0.07) if style == "striped" else (0.46, 0.08)
        more = [slab(wide * width, depth + 0.001, thick + 0.0005, edge).moved(s * x * width) for s in (-1, 1)]
        top = SupportArea((1.94 * x - wide) * width, depth - 0.01, thick)
    else:
        across, reach = (0.9 * depth, 0.045) if style == "handled" else (0.06, 0.1)
        rail = slab(reach + 0.02, 0.02, thick - 0.001, 0.003).moved(0.01 - half - reach / 2)
        more = [rail.moved(y=y * (across / 2 - 0.01)) for y in (-1, 1)]
        more.append(slab(0.024, across, thick - 0.0005, 0.003).moved(-half - reach))
    solid, said = join([board, join(more).painted(second)]), _BOARDS.get(color, f"{color} wood")
    captions = fix_articles(
        f"a {style} {said} cutting board", f"{said} chopping board", f"{style} {color} board for cutting vegetables"
    )
    return AssetDesign(solid, "plastic" if color == "white" else "wood", color, captions, top=top)


_BLADES = {  # length, depth of the blade and its outline from heel to back, shares of both
    "chef": (0.2, 0.044, [(0.0, 0.0), (0.0, 0.3), (0.18, 0.62), (0.5, 0.85), (0.88, 0.99), (1.0, 0.99), (1.0, 0.0)]),
    "paring": (0.1, 0.02, [(0.0, 0.0), (0.0, 0.4), (0.25, 0.75), (0.8, 1.0), (1.0, 0.97), (1.0, 0.0)]),
    "cleaver": (0.155, 0.06, [(0.02, 0.0), (0.0, 0.05), (0.0, 0.98), (0.05, 1.0), (1.0, 1.0), (1.0, 0.0)]),
    "bread": (0.23, 0.031, [(0.0, 0.0), (0.0, 0.93), (0.15, 0.98), (0.4, 1.0), (0.8, 1.0), (1.0, 0.93), (1.0, 0.0)]),
    "santoku": (0.17, 0.046, [(0.0, 0.0), (0.0, 0.75), (0.05, 0.97), (0.3, 1.0), (0.75, 0.9), (1.0, 0.72), (1.0, 0.0)]),
}


def kitchen_knife(draw: VariantSampler) -> AssetDesign:
    """A knife that lies on its side, its handle towards the viewer, its edge to the left."""
    style, grip = pick_words(draw, "chef black, paring red, cleaver walnut, bread black, santoku oak, chef navy")
    length, deep, outline = _BLADES[style]
    length, thick = length * draw.between(0.92, 1.1), 0.014
    hold = 0.075 + 0.22 * length
    blade = prism([((x - 1) * deep + 0.011, y * length) for x, y in outline], 0.0, 0.0022).moved(z=thick / 2 - 0.0011)
    bolster = slab(0.023, 0.014, thick - 0.001, 0.002).moved(0.0, -0.003)
    handle = slab(0.022, hold, thick, 0.003).moved(0.0, -0.005 - hold / 2) + slab(0.026, 0.02, thick, 0.003).moved(0.0, -hold)
    rivets = [disc(0.0035, 0.0, 0.0015, 12).moved(0.0, -0.005 - share * hold, thick - 0.0005) for share in (0.2, 0.5, 0.78)]
    name, size = "cleaver" if style == "cleaver" else f"{style} knife", "small" if length < 0.12 else "large"
    captions = fix_articles(
        f"a {name} with a {grip} handle", f"{size} kitchen knife with a {grip} handle", f"sharp {name} for cooking"
    )
    return AssetDesign(join([blade, bolster, handle.painted(grip).as_handle(), *rivets]), "metal", "silver", captions)


def ladle(draw: VariantSampler) -> AssetDesign:
    """A soup ladle on the end of its handle; laid down, its bowl opens towards the handle."""
    r, length = draw.between(0.034, 0.046), draw.between(0.24, 0.3)
    color, grip = pick_words(draw, "silver silver, silver black, black black, oak oak, red red, copper walnut")
    profiles = [(0.4, 0.0), (0.82, 0.42), (1.0, 0.9)], [(0.36, 0.1), (0.74, 0.48), (0.94, 0.9)]
    bowl = vessel(*([circle(share * r, z * r, 16) for share, z in profile] for profile in profiles))
    tilt = math.degrees(math.atan(1 / math.cos(math.pi / 16)))  # brings its lowest facet level
    bowl = bowl.turned(z=90 - 180 / 16).turned(x=-tilt).grounded()
    stick = bar([(1.24 * r, 0.2 * r), (1.7 * r, 0.0075), (length, 0.0055)], 0.013, 0.008)
    hold = bar([(0.55 * length, 0.007), (length + 0.01, 0.007)], 0.02, 0.0139).painted(grip).as_handle()
    captions = fix_articles(
        f"a {material_word(color)} soup ladle with a long handle", f"{color} ladle with a {grip} grip", "ladle for soup"
    )
    solid, material = _stood_up(bowl + (stick + hold).turned(z=90)), "wood" if color == "oak" else "metal"
    return AssetDesign(solid, material, color, captions, tilts=LYING)


def spatula(draw: VariantSampler) -> AssetDesign:
    """A turner on the end of its handle."""
    style, color, grip = pick_words(
        draw, "slotted silver black, rubber red oak, flat oak oak, slotted black red, rubber teal silver, flat walnut walnut"
    )
    width, blade, length = draw.between(0.06, 0.08), draw.between(0.085, 0.105), draw.between(0.17, 0.22)
    if style == "slotted":
        strips = [box(0.13 * width, blade, 0.003).moved(x * width, -blade / 2) for x in (-0.44, -0.22, 0.0, 0.22, 0.44)]
        head = join([*strips, *(box(width * 1.01, 0.016, 0.0034).moved(0.0, y) for y in (-0.008, 0.008 - blade))])
    else:
        half, near, thick = (0.36 * width, 0.9, 0.009) if style == "rubber" else (0.45 * width, 0.5, 0.006)
        right = [(0.4 * near * half, 0.008), (near * half, -0.006), (half, -0.7 * blade), (half, 0.008 - blade)]
        right.append((half - 0.008, -blade))
        head = prism([*right, *((-x, y) for x, y in right[::-1])], 0.0, thick)
    stick = bar([(-0.012, 0.004), (0.004, 0.0045), (0.04, 0.012), (length, 0.006)], 0.014, 0.007)
    hold = bar([(0.38 * length, 0.0095), (length + 0.005, 0.0058)], 0.022, 0.0115).as_handle()
    name = f"{color} rubber spatula" if style == "rubber" else f"{style} {material_word(color)} spatula"
    captions = fix_articles(f"a {name} with a {grip} handle", f"{color} spatula", f"{style} spatula for cooking")
    solid = _stood_up(head + (stick + hold).turned(z=90).painted(grip))
    return AssetDesign(solid, "plastic" if style == "rubber" else "wood", color, captions, tilts=LYING)


def wooden_spoon(draw: VariantSampler) -> AssetDesign:
    """A spoon for stirring on the end of its handle."""
    color, tip = pick_words(draw, "oak oak, walnut walnut, bamboo red, oak teal, bamboo bamboo, walnut black")
    r, length, stretch = draw.between(0.023, 0.032), draw.between(0.19, 0.26), draw.pick(1.0, 1.5, 1.25)
    oval = np.array([1.0, stretch, 1.0])
    outer = [circle(share * r, z, 32) * oval for share, z in ((0.5, 0.0), (0.85, 0.0045), (1.0, 0.012))]
    inner = [circle(share * r, z, 16) * oval for share, z in ((0.55, 0.005), (0.88, 0.012))]
    root = 0.93 * stretch * r
    stick = bar([(root, 0.0085), (root + 0.3 * length, 0.007), (root + length, 0.0055)], 0.013, 0.0108)
    end = bar([(root + 0.8 * length, 0.006), (root + length + 0.006, 0.006)], 0.0145, 0.012).painted(tip)
    shape = {1.0: "round", 1.5: "long"}.get(stretch, "oval")
    captions = fix_articles(
        f"a wooden spoon with a {shape} bowl", f"{color} cooking spoon", f"{shape} wooden spoon for stirring"
    )
    return AssetDesign(
        _stood_up(vessel(outer, inner) + (stick + end).as_handle().turned(z=90)), "wood", color, captions, tilts=LYING
    )


def whisk(draw: VariantSampler) -> AssetDesign:
    """A whisk that lies along x, its wires on the left."""
    r, long, hold = draw.between(0.026, 0.036), draw.between(0.11, 0.15), draw.between(0.1, 0.13)
    wire, grip = pick_words(draw, "silver silver, silver black, red silver, silver oak, black black, teal silver")
    half = [(0.005, 0.0), (0.3 * r, 0.3 * long), (0.85 * r, 0.6 * long), (r, 0.78 * long), (0.7 * r, 0.94 * long), (0.0, long)]
    loop = bar([*half, *((-x, z) for x, z in half[-2::-1])], 0.0026, 0.0026, corners=6)
    wires = join([loop.turned(z=angle) for angle in (30, 90, 150)]).painted(wire)
    profile = ((0.008, -hold), (0.011, 0.004 - hold), (0.012, -0.5 * hold), (0.0085, -0.01), (0.0085, 0.012))
    handle = lathe(profile, 16).as_handle()
    # Lying it rests on two of its wires and on the end of its handle.
    lean = math.degrees(math.atan((0.87 * r + 0.0013 - 0.011) / (0.78 * long + hold)))
    captions = fix_articles(
        f"a whisk with a {material_word(grip)} handle", f"{wire} balloon whisk", "kitchen whisk for beating eggs"
    )
    return AssetDesign((wires + handle).turned(y=-90).turned(y=lean).grounded(), "metal", grip, captions)


def rolling_pin(draw: VariantSampler) -> AssetDesign:
    """A rolling pin along x."""
    r, half, is_french = draw.between(0.021, 0.032), draw.between(0.11, 0.15), draw.pick(False, True, False)
    color, grip = pick_words(draw, "oak oak, walnut walnut, walnut oak, oak red, bamboo walnut, grey oak")
    ends = [(0.6 * r, half + 0.075), (r, 0.3 * half)] if is_french else [(r - 0.003, half), (r, half - 0.003)]
    shape = [*((radius, -x) for radius, x in ends), *ends[::-1]]
    pin = [lathe(shape, 24).turned(z=7.5)]  # it lies on a facet
    knob = ((0.007, -0.004), (0.007, 0.008), (0.012, 0.014), (0.0145, 0.045), (0.0135, 0.085), (0.008, 0.09))
    if not is_french:
        end = lathe([(radius, half + x) for radius, x in knob], 16).painted(grip)
        pin += [end, end.turned(y=180)]
    kind = "tapered French rolling pin" if is_french else f"rolling pin with {grip} handles"
    said, material = ("grey marble", "marble") if color == "grey" else (color, "wooden")
    captions = fix_articles(f"a {said} {kind}", f"{material} rolling pin", "rolling pin for dough")
    return AssetDesign(join(pin).turned(y=90).grounded(), "wood", color, captions)


def grater(draw: VariantSampler) -> AssetDesign:
    """A box grater with a grip on top."""
    width, depth, h = draw.between(0.09, 0.12), draw.between(0.07, 0.085), draw.between(0.17, 0.22)
    trim, holes, is_arch = draw.pick("black", "red", "silver"), draw.pick("round", "slots"), draw.pick(True, True, False)
    rings = [rectangle(width, depth, 0.0, 0.006), rectangle(0.62 * width, 0.55 * depth, h, 0.006)]
    lean = math.degrees(math.atan(0.225 * depth / h))
    hole = disc(0.006, 0.0, 0.004, 8) if holes == "round" else slab(0.026, 0.009, 0.004, 0.001)
    grid = [(x, z) for z in (0.18, 0.34, 0.5, 0.66, 0.82) for x in ((-0.26, 0.0, 0.26) if holes == "round" else (-0.16, 0.16))]
    front = [hole.turned(x=90).moved(x * width, 0.0029, z * h).turned(x=-lean).moved(y=-depth / 2) for x, z in grid]
    cap = slab(0.66 * width, 0.6 * depth, 0.012, 0.003).moved(z=h - 0.004)
    grip = (
        angular_grip(-0.004, 0.0, 0.045, 0.27 * width, 0.022, 0.012).turned(y=-90) if is_arch else lid_knob(0.3 * depth, 0.05)
    )
    base = box(width + 0.004, depth + 0.004, 0.012, 0.007)
    solid = join([loft(rings), join(front).painted("black"), join([base, cap, grip.moved(z=h + 0.006)]).painted(trim)])
    captions = fix_articles(
        f"a four-sided box grater with a {material_word(trim)} handle", "cheese grater", f"steel grater with {trim} trim"
    )
    return AssetDesign(solid, "metal", "silver", captions, density=300.0)


def utensil_holder(draw: VariantSampler) -> AssetDesign:
    """An open crock for spoons and spatulas."""
    style, color = pick_words(draw, "crock cream, bucket silver, square oak, labelled blue, crock terracotta, square white")
    r, h, foot = draw.between(0.052, 0.066), draw.between(0.13, 0.175), {"bucket": 0.8, "crock": 0.94}.get(style, 1.0)
    wall, low, parts = 0.005, foot * r, []
    if style == "square":
        free = 2 * r - 2 * wall
        cup = vessel(
            *([rectangle(w, w, z, b) for z in zs] for w, b, zs in ((2 * r, 0.008, (0.0, h)), (free, 0.006, (0.008, h))))
        )
        hollow = SupportArea(free - 0.007, free - 0.007, 0.008, h - 0.008)
        parts = [slab(r, 0.3 * h, 0.002, 0.0008).turned(x=90).moved(0.0, 0.0005 - r, 0.55 * h).painted("black")]
    else:
        cup = turned_vessel([(low - 0.004, 0.0), (low, 0.004), (r, h)], [(low - wall, 0.008), (r - wall, h)])
        hollow = well(low - wall, 0.008, h - 0.008, INSCRIBED)
    if style == "bucket":
        parts = [side_grips(r, h - 0.012, 0.02, 0.02).painted("oak")]
    if style == "crock":
        knob = lathe([(0.012, -0.003), (0.01, 0.006), (0.013, 0.014)]).turned(y=90).moved(0.98 * r, 0.0, 0.8 * h)
        parts = [knob, knob.turned(z=180)]
    if style == "labelled":
        parts = [slab(0.6 * r, 0.4 * h, 0.006, 0.001).turned(x=90).moved(0.0, 0.0046 - r, 0.55 * h).painted("white")]
    material = {"silver": "metal", "oak": "wood"}.get(color, "ceramic")
    kind = {"square": "square jar", "labelled": "jar with a label"}.get(style, style)
    captions = fix_articles(f"a {color} {material} utensil holder", f"{color} {kind} for cooking spoons", "kitchen utensil jar")
    return AssetDesign(join([cup, *parts]), material, color, captions, hollow=hollow)


def _waisted(width: float, depth: float, height: float) -> Solid:
    """Two rounds and what joins them."""
    end = disc(depth / 2, 0.0, height, 32)
    return join([box(width - depth, 0.72 * depth, height), end.moved((width - depth) / 2), end.moved((depth - width) / 2)])


def dish_sponge(draw: VariantSampler) -> AssetDesign:
    """A sponge with a scouring side on top."""
    w, d, h = draw.between(0.085, 0.12), draw.between(0.055, 0.075), draw.between(0.024, 0.04)
    color, scour, shape = pick_words(
        draw,
        "yellow green plain, pink grey waisted, blue white plain, green olive waisted, orange black plain, cream brown plain",
    )
    z = 0.76 * h
    if shape == "plain":
        layers = [(w, d, 0.0, z, 0.005), (w + 0.001, d + 0.001, z - 0.001, h, 0.006)]
        soft, rough = (box(x, y, high - low, b).moved(z=low) for x, y, low, high, b in layers)
    else:
        soft, rough = (_waisted(w, d + 0.001 * k, (z, h - z + 0.001)[k]).moved(z=(z - 0.001) * k) for k in (0, 1))
    captions = fix_articles(
        f"a {color} dish sponge with a {scour} scouring side",
        f"{color} kitchen sponge",
        f"{color} and {scour} sponge for washing up",
    )
    return AssetDesign(soft + rough.painted(scour), "foam", color, captions)


FAMILIES = (cutting_board, kitchen_knife, ladle, spatula, wooden_spoon, whisk, rolling_pin, grater, utensil_holder, dish_sponge)
