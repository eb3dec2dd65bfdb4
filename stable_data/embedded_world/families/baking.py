"""Bread, cakes and biscuits."""

import math
from collections.abc import Sequence

import numpy as np

from stable_data.embedded_world.families.wording import fix_articles, pick_words
from stable_data.embedded_world.modelling.family import AssetDesign, VariantSampler
from stable_data.embedded_world.modelling.shapes import BALL, Outline, disc, scaled, wedge
from stable_data.embedded_world.modelling.solids import Ring, Solid, box, chain, circle, hull, join, lathe, loft, slab

_CRUST, _CRUMB = "#bd8140", "#efd9ae"


def _slices(width: float, height: float) -> list[tuple[float, float]]:
    """The outline of a loaf cut across, (y, z)."""
    side = [(-0.44, 0.0), (0.44, 0.0), (0.5, 0.3), (0.5, 0.62), (0.4, 0.86), (0.18, 1.0)]
    return [(y * width, z * height) for y, z in [*side, *((-y, z) for y, z in side[:1:-1])]]


def _across(outline: Outline, places: Sequence[tuple[float, float]]) -> Solid:
    """The loft along x of an outline (y, z) at (x, scale) each."""
    points = np.array(outline)
    return loft([np.c_[np.full(len(points), x), scale * points] for x, scale in places])


def _cut_across(radius: float, height: float, places: Sequence[tuple[float, float]], width: float) -> Solid:
    """A strip over a round top from shares of its radius and height, lower end first."""
    return chain([np.array([(s * x * radius, y * width, z * height) for s in (-1, 1) for y in (-0.5, 0.5)]) for x, z in places])


def bread(draw: VariantSampler) -> AssetDesign:
    """A tin loaf along x, whole or cut, or a round loaf with a cross."""
    style, color, cut = pick_words(
        draw,
        "tin #b5763a plain, sliced #a5682f white, round #8f5a2b plain",
        "tin #7c4c28 dark, sliced #8a5630 wholemeal, round #c08a4a plain",
    )
    length, w, h = draw.between(0.2, 0.27), draw.between(0.1, 0.12), draw.between(0.085, 0.11)
    if style == "round":
        r, h = 0.95 * w, 0.9 * h
        profile = ((0.9, 0.0), (0.98, 0.1), (1.0, 0.28), (0.92, 0.58), (0.72, 0.83), (0.42, 0.97), (0.2, 1.0))
        slash = _cut_across(r, h, ((0.7, 0.83), (0.4, 1.015)), 0.012)
        solid = lathe(scaled(profile, r, h), 32) + (slash + slash.turned(z=90)).painted(_CRUMB)
        captions = fix_articles("a round loaf of bread with a cross on top", "round country bread", "crusty round loaf")
        return AssetDesign(solid, "food", color, captions, density=300.0)
    outline, crumb = _slices(w, h), "#8f6a45" if cut == "dark" else _CRUMB
    ends = [(-length / 2, 0.9), (0.015 - length / 2, 1.0), (length / 2 - 0.015, 1.0), (length / 2, 0.9)]
    if style == "tin":
        strip = slab(0.32 * w, 0.014, 0.006, 0.002)
        marks = [strip.turned(z=62).moved(x * length, 0.0, h - 0.0045) for x in (-0.3, -0.1, 0.1, 0.3)]
        solid, words = _across(outline, ends) + join(marks).painted(crumb), "whole tin loaf"
    else:
        ends[2:] = [(0.2 * length, 1.0)]
        slice_ = _across(outline, [(0.0, 1.0), (0.012, 1.0)]) + _across(outline, [(-0.001, 0.92), (0.013, 0.92)]).moved(
            z=0.04 * h
        ).painted(crumb)
        face = _across(outline, [(0.2 * length - 0.002, 0.92), (0.2 * length + 0.0012, 0.92)]).moved(z=0.04 * h).painted(crumb)
        leaning = [slice_.turned(y=-lean).moved(0.2 * length + x) for lean, x in ((10, 0.165 * h), (20, 0.341 * h + 0.0107))]
        solid, words = join([_across(outline, ends), face, *leaning]), "sliced loaf"
    captions = fix_articles(f"a {words} of {cut if cut != 'plain' else 'brown'} bread", "loaf of bread", f"bread, a {words}")
    return AssetDesign(solid, "food", color, captions, density=280.0)


def baguette(draw: VariantSampler) -> AssetDesign:
    """A long loaf along x with slanted cuts; some are halved."""
    length, w, h = draw.between(0.38, 0.5), draw.between(0.055, 0.07), draw.between(0.042, 0.052)
    color, is_half, num = draw.pick("#bd8140", "#a86c30", "#cc9450"), draw.pick(False, True), draw.pick(5, 4)
    side = [(-0.34, 0.0), (0.34, 0.0), (0.5, 0.3), (0.46, 0.65), (0.3, 0.9), (0.1, 1.0)]
    outline = [(y * w, z * h) for y, z in [*side, *((-y, z) for y, z in side[:1:-1])]]
    half = length / 2
    start = [(-half, 0.25), (0.012 - half, 0.55), (0.04 - half, 0.84), (0.09 - half, 1.0)]
    parts, end = [], 0.1 * half if is_half else half - 0.07
    places = [*start, (end, 1.0)] if is_half else [*start, *((-x, y) for x, y in start[::-1])]
    if is_half:
        parts = [_across(outline, [(end - 0.002, 0.9), (end + 0.0012, 0.9)]).moved(z=0.05 * h).painted(_CRUMB)]
    strip = slab(0.8 * (end + half) / num, 0.011, 0.005, 0.002).turned(z=24)
    spots = [0.07 - half + (k + 0.5) * (end - 0.07 + half) / num for k in range(num)]
    slashes = join([strip.moved(x, 0.0, h - 0.0036) for x in spots]).painted("#e6c68e")
    kind = "half of a baguette" if is_half else "a whole baguette"
    captions = fix_articles(
        f"{kind} with a golden crust", f"crusty French bread, {kind}", f"{'cut ' if is_half else 'long '}baguette"
    )
    return AssetDesign(join([_across(outline, places), slashes, *parts]), "food", color, captions, density=220.0)


def bun(draw: VariantSampler) -> AssetDesign:
    """A round bun with seeds or a cross, or a long roll with a cut."""
    r, share, style = draw.between(0.04, 0.053), draw.between(0.88, 1.1), draw.pick("seeds", "cross", "long")
    word, color = pick_words(draw, "golden #c98d45, brown #9c6230, pale #dcb374, dark #7d4b28, golden #d19a52, brown #ab7038")
    h = share * r
    profile = ((0.82, 0.0), (0.96, 0.12), (1.0, 0.32), (0.92, 0.62), (0.7, 0.86), (0.38, 0.98), (0.15, 1.0))
    rings = [circle(x * r, z * h, 32) * ((1.5, 0.8, 0.8) if style == "long" else (1.0, 1.0, 1.0)) for x, z in profile]
    if style == "seeds":
        places = [(0.0, 0.05)] + [(60 * k, 0.4) for k in range(6)] + [(45 * k + 20, 0.7) for k in range(8)]
        seed = slab(0.006, 0.0035, 0.003, 0.0008)
        top = [seed.turned(y=35 * x**2).moved(x * r, 0.0, (1.0 - 0.3 * x**2.2) * h - 0.0018).turned(z=a) for a, x in places]
    elif style == "cross":
        one = _cut_across(r, h, ((0.7, 0.86), (0.36, 1.02)), 0.01)
        top = [one, one.turned(z=90)]
    else:
        top = [slab(1.5 * r, 0.014, 0.006, 0.002).moved(z=0.8 * h - 0.0045)]
    solid = loft(rings) + join(top).painted("#f0dfb6")
    kind = {"seeds": "bun with sesame seeds", "cross": "bun with a cross on top"}.get(style, "long bread roll")
    return AssetDesign(solid, "food", color, (f"a {word} {kind}", f"{word} bread bun", f"fresh {kind}"), density=250.0)


def croissant(draw: VariantSampler) -> AssetDesign:
    """A crescent of seven folds, open towards the viewer."""
    radius, thick, bend = draw.between(0.05, 0.062), draw.between(0.042, 0.052), draw.pick(96.0, 78.0, 64.0)
    word, color, fold = pick_words(draw, "golden #c98a3e #b07430, brown #a96a2e #8c5424, pale #d9a860 #c18e48")
    radius *= 80 / bend
    angle = 2 * np.pi * np.arange(12) / 12

    def ring(degrees: float, share: float) -> Ring:
        y, z = share * thick / 2 * np.cos(angle), share * thick / 2 * np.maximum(np.sin(angle), -0.6) + share * 0.3 * thick
        a = math.radians(90 + degrees)
        return np.stack([(radius + y) * math.cos(a), (radius + y) * math.sin(a), z], axis=1)

    shares, parts = (0.42, 0.66, 0.88, 1.0, 0.88, 0.66, 0.42), []
    for k, share in enumerate(shares):
        low, high = (bend * (2 * (k + shift) / 7 - 1) for shift in (-0.06, 1.06))
        lean = 0.07 * ((k > 3) - (k < 3))  # every fold narrows towards its tip of the crescent
        one = chain([ring(low, (0.85 + lean) * share), ring((low + high) / 2, 1.06 * share), ring(high, (0.85 - lean) * share)])
        parts.append(one.painted(fold) if k % 2 else one)
    captions = fix_articles(f"a {word} croissant", f"{word} butter croissant", "crescent-shaped pastry")
    return AssetDesign(join(parts), "food", color, captions, density=220.0)


def cake(draw: VariantSampler) -> AssetDesign:
    """A small round cake, or a slice of one with its layers."""
    flavour, sponge, icing, is_slice = pick_words(
        draw,
        "strawberry #edd3a0 #e9a3b2 slice, chocolate #5a3825 #3f261a round, lemon #ecd08a #f3e9a8 slice",
        "vanilla #e6c58c #f4efe2 round, chocolate #55331f #6f442c slice, raspberry #e0bd86 #c9506a round",
    )
    h, cherry = draw.between(0.05, 0.07), draw.pick("#b5202f", "#8e1f3c")
    ball = lathe(scaled(((0.4, 0.0), (0.85, 0.16), (1.0, 0.48), (0.8, 0.84), (0.4, 1.0)), 0.011, 0.02), 12)
    if is_slice == "slice":
        r, degrees = draw.between(0.1, 0.12), draw.between(38.0, 50.0)
        layers = [wedge(r, degrees, low * h, high * h + 0.0003) for low, high in ((0.0, 0.44), (0.54, 0.92))]
        fill = [wedge(r, degrees, 0.43 * h, 0.55 * h, -0.014), wedge(r, degrees, 0.9 * h, h, -0.02)]
        swirl = lathe(scaled(((1.0, -0.1), (1.0, 0.25), (0.6, 0.75), (0.4, 1.0)), 0.016, 0.016), 16).moved(0.2 * r, 0.3 * r, h)
        parts = [*layers, join([*fill, swirl]).painted(icing), ball.moved(0.2 * r, 0.3 * r, h + 0.01).painted(cherry)]
        name = f"slice of {flavour} cake"
    else:
        r = draw.between(0.07, 0.095)
        body = disc(r, 0.0, 0.93 * h, 32)
        top = lathe([(r + x, z * h) for x, z in ((0.003, 0.78), (0.004, 0.95), (0.001, 1.02))], 32)
        drop = lathe([(x, z * h) for x, z in ((0.004, 0.0), (0.007, 0.1), (0.007, 0.5))], 8)
        drops = [drop.moved(r - 0.0015, 0.0, (0.36 + 0.1 * (k % 3)) * h).turned(z=36 * k) for k in range(10)]
        balls = [ball.moved(0.68 * r, 0.0, h + 0.0006).turned(z=60 * k) for k in range(6)]
        parts = [body, join([top, *drops]).painted(icing), join(balls).painted(cherry)]
        name = f"small round {flavour} cake with cherries"
    return AssetDesign(join(parts), "food", sponge, (f"a {name}", f"{flavour} cake", f"{name} for dessert"), density=450.0)


def _torus(radius: float, width: float, profile: Outline, num: int = 14) -> Solid:
    """A ring around the z axis whose section is convex: (from its middle outwards, z), shares of its width."""
    section = np.array(profile) * width
    rings = []
    for angle in 2 * np.pi * np.arange(num) / num:
        reach = radius + section[:, 0]
        rings.append(np.stack([reach * math.cos(angle), reach * math.sin(angle), section[:, 1]], axis=1))
    # The last part reaches a little into the first, so that they do not only touch.
    ahead = 0.9 * rings[0] + 0.1 * rings[1]
    return chain([*rings, rings[0], 0.9 * ahead + 0.1 * ahead.mean(axis=0)])


def donut(draw: VariantSampler) -> AssetDesign:
    """A ring of dough, glazed or plain, some with sprinkles."""
    radius, width = draw.between(0.026, 0.031), draw.between(0.032, 0.038)
    word, glaze, extra = pick_words(
        draw,
        "pink #e58fa8 sprinkles, chocolate #4a2c1d sprinkles, plain #c4904d none",
        "white #f1ece2 sprinkles, blue #7fb2d1 none, caramel #a9682f sprinkles",
    )
    dough = [(-0.32, 0.0), (0.32, 0.0), (0.5, 0.25), (0.5, 0.5), (0.32, 0.74), (-0.32, 0.74), (-0.5, 0.5), (-0.5, 0.25)]
    cover = [(-0.52, 0.42), (0.52, 0.42), (0.52, 0.54), (0.35, 0.76), (0.12, 0.83), (-0.12, 0.83), (-0.35, 0.76), (-0.52, 0.54)]
    body, top, color = _torus(radius, width, dough), 0.83 * width, _CRUST
    if word == "plain":
        color = glaze
        body += _torus(radius, width, [(x, z - 0.014) for x, z in cover])
    else:
        body += _torus(radius, width, cover).painted(glaze)
    if extra == "sprinkles":
        colors, places = ("#e8c53a", "#4f9bc4", "#f3f0e8", "#57a05c"), [(29 * k, (0.0, 0.1, -0.1)[k % 3]) for k in range(12)]
        for k, (turn, out) in enumerate(places):
            one = slab(0.008, 0.003, 0.003, 0.0006).turned(z=50 * k).moved(radius + out * width, 0.0, top - 0.0014)
            body += one.turned(z=turn).painted(colors[k % 4])
    kind = "plain donut" if word == "plain" else f"donut with {word} icing{' and sprinkles' if extra == 'sprinkles' else ''}"
    return AssetDesign(body, "food", color, (f"a {kind}", f"{word} ring doughnut", f"sweet {word} donut"), density=380.0)


def muffin(draw: VariantSampler) -> AssetDesign:
    """A muffin or a cupcake in a paper cup."""
    r, h, style = draw.between(0.025, 0.03), draw.between(0.04, 0.048), draw.pick("muffin", "cupcake")
    word, dough, paper, bits = pick_words(
        draw,
        "blueberry #d3a25a white #3a3f66, strawberry #eba7b6 red #b5202f, chocolate #5a3723 brown #2c1a12",
        "vanilla #f3ead2 teal #b5202f, chocolate-chip #cf9c55 kraft #3b2417, mint #a9d3bd pink #4a2c1d",
    )
    hexagon = [circle(0.82 * r, 0.0, 6), circle(1.06 * r, h, 6)]
    cup = join([loft(hexagon).turned(z=15 * k) for k in range(4)]).painted(paper)
    if style == "muffin":
        top = lathe(scaled(((0.8, -0.18), (1.0, 0.0), (0.98, 0.22), (0.8, 0.56), (0.5, 0.8), (0.2, 0.88)), 1.22 * r, r), 24)
        lump = slab(0.008, 0.007, 0.006, 0.0014).moved(z=-0.003)
        places = [(0, 0.1, 0.85), *((72 * k, 0.66, 0.66) for k in range(5)), *((72 * k + 36, 1.02, 0.4) for k in range(5))]
        parts = [top, join([lump.turned(y=50 * x).moved(x * r, 0.0, z * r).turned(z=a) for a, x, z in places]).painted(bits)]
    else:
        swirl = [(1.0, -0.1), (1.1, 0.2), (0.95, 0.42), (0.78, 0.46), (0.84, 0.66), (0.66, 0.84), (0.46, 0.88), (0.5, 1.05)]
        swirl.append((0.2, 1.3))
        parts = [lathe(scaled(swirl, r, r), 24), lathe(scaled(BALL, 0.008, 0.015), 12).moved(z=1.22 * r).painted(bits)]
    captions = fix_articles(f"a {word} {style} in a {paper} paper cup", f"{word} {style}", f"sweet {word} {style}")
    return AssetDesign(join([cup, join(parts).moved(z=h)]), "food", dough, captions, density=400.0)


def _gingerbread(size: float, icing: str) -> Solid:
    """A little man who lies on his back."""

    def limb(x0: float, y0: float, x1: float, y1: float) -> Solid:
        end = disc(0.13 * size, 0.0, 0.008, 16)
        ends = [end.moved(x * size, y * size).parts[0] for x, y in ((x0, y0), (x1, y1))]
        return hull(np.concatenate(ends))

    body = [disc(0.2 * size, 0.0, 0.0085).moved(y=0.5 * size), limb(0.0, 0.22, 0.0, -0.1)]
    body += [limb(0.0, 0.15, s * 0.38, 0.22) for s in (-1, 1)] + [limb(0.0, -0.1, s * 0.2, -0.5) for s in (-1, 1)]
    dot = disc(0.035 * size, 0.0, 0.003, 10).moved(z=0.007)
    spots = ((0.0, 0.12), (0.0, -0.06), (-0.07, 0.55), (0.07, 0.55))
    mouth = box(0.12 * size, 0.025 * size, 0.003).moved(0.0, 0.43 * size, 0.007)
    cuffs = [box(0.025 * size, 0.2 * size, 0.003).moved(s * 0.4 * size, 0.22 * size, 0.007) for s in (-1, 1)]
    return join([*body, join([*(dot.moved(x * size, y * size) for x, y in spots), mouth, *cuffs]).painted(icing)])


def cookie(draw: VariantSampler) -> AssetDesign:
    """A biscuit that lies flat: with chips, with jam, filled, or a gingerbread man."""
    style, color, second = pick_words(
        draw,
        "chips #c9954f #3b2417, sandwich #3a2a22 #f1ece2, jam #dcb36c #b3263a",
        "gingerbread #9a5f2e #f4efe2, chips #5b3a26 #efe6d2, sandwich #d8ad66 #6a3c22",
    )
    r, h = draw.between(0.031, 0.042), draw.between(0.01, 0.014)
    names = {"chips": "cookie with chips", "jam": "jam cookie", "sandwich": "sandwich cookie with cream"}
    name = names.get(style, "gingerbread man")
    profile = ((0.94, 0.0), (1.0, 0.25), (0.96, 0.7), (0.8, 0.95), (0.5, 1.0))
    if style == "gingerbread":
        solid = _gingerbread(2.4 * r, second)
    elif style == "sandwich":
        plate = lathe(scaled(((0.97, 0.0), (1.0, 0.2), (1.0, 0.8), (0.97, 1.0)), r, 0.4 * h + 0.002), 32)
        dots = join([box(0.004, 0.006, 0.002).moved(0.8 * r, 0.0, 1.2 * h + 0.0009).turned(z=30 * k) for k in range(12)])
        fill = disc(0.95 * r, 0.3 * h, 1.0 * h, 32).painted(second)
        solid = join([plate, plate.moved(z=0.8 * h), fill, dots])
    elif style == "jam":
        jam = lathe(scaled(((1.0, -0.5), (0.95, 0.4), (0.5, 1.0)), 0.5 * r, 0.004), 32).moved(z=h)
        solid = lathe(scaled(profile, r, h), 32) + jam.painted(second)
    else:
        chip = slab(0.009, 0.008, 0.005, 0.0018)
        places = [(0.1, 0), *((0.45, 72 * k) for k in range(5)), *((0.74, 60 * k + 25) for k in range(6))]
        spots = [(x * r, (0.99 if x < 0.6 else 0.92) * h - 0.0028, angle) for x, angle in places]
        chips = [chip.turned(z=37 * angle).moved(x, 0.0, z).turned(z=angle) for x, z, angle in spots]
        solid = lathe(scaled(profile, r, h), 32) + join(chips).painted(second)
    return AssetDesign(solid, "food", color, (f"a {name}", f"sweet {name}", f"baked {name}, a biscuit"), density=550.0)


FAMILIES = (bread, baguette, bun, croissant, cake, donut, muffin, cookie)
