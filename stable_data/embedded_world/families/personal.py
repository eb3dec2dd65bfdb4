"""Personal accessories and their containers."""

import math

import numpy as np

from stable_data.embedded_world.families.wording import fix_articles
from stable_data.embedded_world.modelling.family import AssetDesign, SupportArea, VariantSampler
from stable_data.embedded_world.modelling.shapes import lying_body, round_body, silhouette
from stable_data.embedded_world.modelling.solids import bar, box, join, lathe, loft, rectangle, slab, turned_vessel


def watch(draw: VariantSampler) -> AssetDesign:
    """A wrist watch, on its cushion or flat with its strap along y."""
    radius, on_cushion = draw.between(0.017, 0.021), draw.pick(True, False, False, True, False, True)
    color = draw.pick("brown", "black", "navy", "silver", "red", "gold")
    metal = draw.pick("silver", "gold", "copper")
    dial = draw.pick("white", "black", "cream", "navy")
    is_square = draw.pick(False, True, False, False, True, False)
    material = "metal" if color in ("silver", "gold") else "fabric"
    hand = "white" if dial in ("black", "navy") else "black"
    case, face = [(0.92, 0.0), (1.0, 0.002), (1.0, 0.007), (0.9, 0.0095)], [(0.82, 0.008), (0.82, 0.0107)]
    if is_square:
        rim, glass = (
            loft([rectangle(2 * r * radius, 2 * r * radius, z, 0.25 * radius) for r, z in rings]) for rings in (case, face)
        )
    else:
        rim, glass = (round_body([(r * radius, z) for r, z in rings], 32) for rings in (case, face))
    hands = [box(0.0022, 0.62 * radius, 0.0025).moved(0.0, 0.28 * radius, 0.0095).turned(z=a) for a in (-55, 60)]
    crown = box(0.006, 0.005, 0.004).moved(radius + 0.001, 0.0, 0.003)
    head = join([rim.painted(metal), glass.painted(dial), *(h.painted(hand) for h in hands), crown.painted(metal)])
    wide = 1.05 * radius
    if on_cushion:
        high, deep = draw.between(0.02, 0.024), draw.between(0.03, 0.034)
        ends = ((-0.042, 0.7), (-0.03, 1.0), (0.03, 1.0), (0.042, 0.7))
        pillow = lying_body([(x, r * deep, r * high, 0.9 * high) for x, r in ends])
        strap = lying_body([(x, deep + 0.0025, high + 0.0025, 0.9 * high) for x in (-wide / 2, wide / 2)], 32).painted(color)
        parts = [pillow, strap, head.moved(z=1.9 * high)]
        captions = fix_articles(
            f"a wrist watch with a {color} strap on a cushion",
            f"{color} watch on its cushion",
            f"{metal} watch with a {dial} dial",
        )
        return AssetDesign(join(parts), "fabric", "cream" if color != "gold" else "black", captions, density=900.0)
    long = draw.between(0.09, 0.105)
    strap = slab(wide, long, 0.0035, 0.001)
    strip = join([strap.moved(y=long / 2 + 0.5 * radius), strap.moved(y=-long / 2 - 0.5 * radius)])
    loops = [slab(wide + 0.003, 0.006, 0.0055, 0.001).moved(y=y) for y in (radius + 0.03, radius + 0.045)]
    buckle = join(
        [slab(wide + 0.006, 0.004, 0.006, 0.001).moved(y=0.5 * radius + long - y) for y in (0.0, 0.012)]
        + [slab(0.004, 0.016, 0.006, 0.001).moved(i * (wide / 2 + 0.001), 0.5 * radius + long - 0.006) for i in (-1, 1)]
    )
    captions = (f"a wrist watch with a {color} strap, lying flat", f"{color} watch", f"{metal} wristwatch with a {dial} dial")
    return AssetDesign(
        join([strip, *loops, buckle.painted(metal), head.moved(z=0.0005)]), material, color, captions, density=1500.0
    )


def sunglasses(draw: VariantSampler) -> AssetDesign:
    """Folded sunglasses that lie on their arms, lenses up."""
    wide, high = draw.between(0.05, 0.056), draw.between(0.04, 0.05)
    style = draw.pick("round", "square", "oval", "square", "round", "oval")
    color = draw.pick("black", "brown", "gold", "red", "white", "navy")
    lens, gap = draw.pick("#2c2f33", "#4a3524", "#2d4a3a", "#39414f"), 0.074
    high = wide if style == "round" else high
    sections = (((1.0, 0.0), (1.0, 0.0045)), ((0.84, 0.002), (0.84, 0.0057)))
    if style == "square":
        rim, glass = (loft([rectangle(s * wide, s * high, z, 0.008 * s) for s, z in rings]) for rings in sections)
    else:
        rim, glass = (round_body([(s * wide / 2, z) for s, z in rings], 32, high / wide) for rings in sections)
    eye = rim + glass.painted(lens)
    bridge = bar([(-0.014, 0.0025), (0.0, 0.0035), (0.014, 0.0025)], 0.006, 0.004, 8).moved(y=0.16 * high)
    ends = [box(0.014, 0.009, 0.0045).moved(side * (gap / 2 + wide / 2 - 0.0005), 0.24 * high) for side in (-1, 1)]
    front = join([eye.moved(-gap / 2), eye.moved(gap / 2), bridge, *ends]).turned(x=13)
    low = min(float(part[:, 2].min()) for part in front.parts)
    edge, arm = 0.24 * high, 0.118
    front = front.moved(z=-low)
    arms = [
        slab(arm, 0.005, 0.0065, 0.001)
        .turned(z=3.0 * side)
        .moved(side * 0.005, edge + 0.008 + 0.004 * side, 0.0 if side < 0 else 0.0055)
        for side in (-1, 1)
    ]
    reach = gap / 2 + wide / 2 + 0.0035
    hinges = [box(0.006, 0.02, 0.0135).moved(side * reach, edge + 0.006, 0.0) for side in (-1, 1)]
    captions = (f"folded {color} sunglasses with {style} lenses", f"{color} sunglasses", f"{style} sunglasses, folded up")
    return AssetDesign(join([front, *arms, *hinges]), "plastic", color, captions)


def wallet(draw: VariantSampler) -> AssetDesign:
    """A wallet that lies flat: folded with notes in it, with a clasp, or a holder with cards."""
    style = draw.pick("folded", "long", "cards", "folded", "long", "cards")
    color, metal = draw.pick("brown", "black", "red", "navy", "#b08a5e", "teal"), draw.pick("gold", "silver")
    width, depth, thick = {"folded": (0.112, 0.09, 0.011), "long": (0.19, 0.1, 0.011), "cards": (0.104, 0.074, 0.007)}[style]
    width, depth = width * draw.between(0.95, 1.05), depth * draw.between(0.95, 1.05)
    leaf = slab(width, depth, thick, 0.0025)
    name = {"#b08a5e": "tan"}.get(color, color)
    if style == "cards":
        tints = ("blue", "white", "gold")
        cards = [
            slab(0.086, 0.05, 0.0016, 0.0004).moved(0.0, depth / 2 - 0.012 + 0.007 * (2 - k), 0.0008 + 0.0018 * k).painted(t)
            for k, t in enumerate(tints)
        ]
        pocket = box(0.9 * width, 0.5 * depth, 0.0018).moved(0.0, -0.2 * depth, thick - 0.0006)
        captions: tuple[str, ...] = (f"a {name} card holder with three cards", f"{name} card wallet", "slim wallet with cards")
        return AssetDesign(join([leaf, *cards, pocket]), "fabric", color, captions, density=800.0)
    upper = slab(width - 0.003, depth - 0.002, thick - 0.001, 0.0025).moved(0.001, 0.0, thick - 0.0005)
    spine = lying_body(
        [(x, 0.007, thick - 0.0012, thick - 0.0012) for x in (-depth / 2 + 0.002, depth / 2 - 0.002)], 16
    ).turned(z=90)
    parts = [leaf, upper, spine.moved(0.003 - width / 2)]
    top = 2 * thick - 0.0015
    if style == "folded":
        parts += [slab(0.9 * width, 0.02, 0.004, 0.0005).moved(0.004, depth / 2 - 0.006, thick - 0.0022).painted("#8fae8a")]
        parts.append(slab(0.3 * width, 0.012, 0.0022, 0.0006).moved(0.2 * width, -0.3 * depth, top - 0.001).painted(metal))
        words = "folded wallet with notes in it"
    else:
        parts.append(slab(0.032, 0.03, 0.004, 0.001).moved(0.0, 0.012 - depth / 2, top - 0.0022))
        parts.append(round_body([(0.0065, top), (0.0065, top + 0.0035)], 16).moved(0.0, 0.008 - depth / 2).painted(metal))
        words = "long purse with a clasp"
    captions = (f"a {name} {words}", f"{name} leather wallet", f"{style} wallet")
    return AssetDesign(join(parts), "fabric", color, captions, density=550.0)


def glasses_case(draw: VariantSampler) -> AssetDesign:
    """A closed hard case for glasses."""
    n, width, high = draw.between(0.15, 0.172), draw.between(0.056, 0.07), draw.between(0.034, 0.05)
    color, kind = draw.pick("black", "brown", "navy", "red", "teal", "grey"), draw.pick("clamshell", "flap", "clamshell")
    half = ((0.34, 1.0), (0.42, 0.96), (0.475, 0.84), (0.5, 0.66))
    sections = [*((-x, share) for x, share in reversed(half)), *half]
    angles = [math.radians(a) for a in (-66, -36, 0, 36, 66, 114, 144, 180, 216, 246)]
    outline = np.array([(width / 2 * math.cos(a), high / 2 * (1 + math.sin(a) / math.sin(math.radians(66)))) for a in angles])
    solid = loft([np.c_[np.full(10, x * n), outline * share] for x, share in sections])
    if kind == "clamshell":
        ring = rectangle(n + 0.0016, width + 0.0016, 0.46 * high, 0.34 * width)
        seam = [ring, ring + np.array([0.0, 0.0, 0.0024])]
        clasp = box(0.024, 0.005, 0.014).moved(0.0, -width / 2, 0.4 * high)
        solid += loft(seam).painted("gold" if color != "grey" else "black") + clasp.painted("silver")
        detail = "with a clasp"
    else:
        y = 0.5 * width + 0.0012
        side = [(-y, 0.42 * high), (-y, 0.66 * high), (-0.22 * width, high + 0.0014), (0.2 * width, high + 0.0014)]
        flap = silhouette([*side, (0.2 * width, high - 0.004)], 0.5 * n)
        snap = lathe([(0.006, 0.0), (0.006, 0.004)]).turned(x=90).moved(0.0, 0.001 - width / 2, 0.54 * high)
        solid += flap.turned(z=90).painted("kraft") + snap.painted("silver")
        detail = "with a flap"
    captions = fix_articles(f"a {color} glasses case {detail}", f"{color} glasses case", "hard case for spectacles")
    return AssetDesign(solid, "plastic", color, captions, density=280.0)


def jewelry_box(draw: VariantSampler) -> AssetDesign:
    """A box for jewels with a lid, or with drawers."""
    width, depth, height = draw.between(0.14, 0.2), draw.between(0.1, 0.14), draw.between(0.07, 0.11)
    drawers = draw.pick(0, 2, 1, 3, 0, 2)
    color, metal = draw.pick("walnut", "white", "pink", "black", "teal", "oak"), draw.pick("gold", "silver", "copper")
    z = 0.006
    body = box(width - 0.004, depth - 0.004, height - z - 0.004, 0.003).moved(z=z)
    lid = slab(width, depth, 0.3 * height, 0.004).moved(z=0.7 * height)
    feet = [
        box(0.014, 0.014, 0.008).moved(i * (width / 2 - 0.014), j * (depth / 2 - 0.014)).painted(metal)
        for i in (-1, 1)
        for j in (-1, 1)
    ]
    front, parts = 0.002 - depth / 2, []
    each = (0.66 * height - z) / max(1, drawers)
    for k in range(drawers):
        low = z + 0.003 + k * each
        parts.append(box(width - 0.02, 0.005, each - 0.005).moved(0.0, front - 0.0005, low))
        parts.append(slab(0.008, 0.012, 0.008, 0.002).moved(0.0, front - 0.006, low + each / 2 - 0.006).painted(metal))
    if not drawers:
        parts.append(box(0.018, 0.005, 0.024).moved(0.0, -depth / 2 - 0.0005, 0.66 * height).painted(metal))
    words = f"with {drawers} drawer{'s' if drawers > 1 else ''}" if drawers else "with a lid and a clasp"
    captions = (f"a small {color} jewelry box {words}", f"{color} jewelry box", f"box for jewels, {metal} fittings")
    top = SupportArea(width - 0.012, depth - 0.012, height)
    return AssetDesign(join([body, lid, *feet, *parts]), "wood", color, captions, top=top, density=350.0)


def ring_dish(draw: VariantSampler) -> AssetDesign:
    """A small dish for rings, some with a cone that holds a ring."""
    radius, height = draw.between(0.045, 0.058), draw.between(0.014, 0.022)
    has_cone = draw.pick(True, False, True, False, True, False)
    color = draw.pick("white", "pink", "black", "teal", "cream", "navy")
    metal = draw.pick("gold", "silver", "copper")
    dish = turned_vessel(
        [(0.6 * radius, 0.0), (0.66 * radius, 0.002), (radius, height)], [(0.62 * radius, 0.005), (radius - 0.004, height)]
    )
    free = 1.2 * radius
    hollow: SupportArea | None = SupportArea(free, free, 0.005, height - 0.005, is_round=True)
    if has_cone:
        top = draw.between(0.055, 0.075)
        cone = round_body([(0.016, 0.004), (0.014, 0.009), (0.0035, top - 0.002), (0.002, top)], 24)
        band = round_body([(0.0112, 0.42 * top), (0.0118, 0.42 * top + 0.0016), (0.0112, 0.42 * top + 0.0032)], 24)
        dish, hollow = join([dish, cone, band.painted(metal)]), None
        words = f"with a cone and a {metal} ring"
    else:
        dish += round_body([(0.6 * radius, 0.004), (0.6 * radius, 0.0056)], 32).painted(metal)
        hollow = SupportArea(free - 0.004, free - 0.004, 0.0056, height - 0.0056, is_round=True)
        words = f"with a {metal} bottom"
    captions = (f"a small {color} ring dish {words}", f"{color} trinket dish", "dish for rings and earrings")
    return AssetDesign(dish, "ceramic", color, captions, hollow=hollow)


FAMILIES = (watch, sunglasses, wallet, glasses_case, jewelry_box, ring_dish)
