"""Vegetables."""

import math
from collections.abc import Sequence

import numpy as np

from stable_data.embedded_world.families.palette import LEAF
from stable_data.embedded_world.families.wording import fix_articles, pick_words
from stable_data.embedded_world.modelling.family import AssetDesign, VariantSampler
from stable_data.embedded_world.modelling.shapes import BALL, disc, lying_lathe, prism, scaled
from stable_data.embedded_world.modelling.solids import Solid, bar, box, circle, hull, join, lathe, loft


def _lobe(radius: float, height: float, profile: Sequence[tuple[float, float, float]], corners: int) -> Solid:
    """One rib on the right, from shares: (how far out its middle is, its radius, z)."""
    return loft([circle(r * radius, z * height, corners) + np.array([x * radius, 0.0, 0.0]) for x, r, z in profile])


def tomato(draw: VariantSampler) -> AssetDesign:
    """A tomato with its green star."""
    r, share = draw.between(0.03, 0.043), draw.pick(0.72, 0.86, 1.1)
    word, color = pick_words(draw, "red #c8352c, red #b92d2a, orange #e0762c, yellow #e5b93a, dark_red #7d2b2b, red #d2452f")
    h = 1.85 * share * r
    ray = prism([(-0.003, -0.003), (0.3 * r, -0.0042), (0.72 * r, 0.0), (0.3 * r, 0.0042), (-0.003, 0.003)], -0.0012, 0.0012)
    star = [ray.turned(y=13).turned(z=72 * k + 20).moved(z=h + 0.0005) for k in range(5)]
    stalk = lathe([(0.0026, h - 0.002), (0.002, h + 0.008)], 8)
    shape = {0.72: "flat", 1.1: "plum"}.get(share, "round")
    captions = fix_articles(f"a {shape} {word} tomato", f"ripe {word} tomato", f"{shape} tomato with a green stem")
    return AssetDesign(lathe(scaled(BALL, r, h), 32) + join([*star, stalk]).painted(LEAF), "fruit", color, captions)


def potato(draw: VariantSampler) -> AssetDesign:
    """A lumpy potato that lies on a flat side."""
    length, width, height = draw.between(0.075, 0.12), draw.between(0.05, 0.065), draw.between(0.042, 0.055)
    word, color = pick_words(draw, "brown #b08a55, yellow #d3b36b, red #a3584c, brown #9c7748, pale #cfb98a, dark #7c5c3c")
    angle = 2 * np.pi * np.arange(14) / 14
    points = []
    for along in (-1.0, -0.9, -0.65, -0.3, 0.1, 0.45, 0.75, 0.92, 1.0):
        swell = math.sqrt(1.04 - along**2) * draw.between(0.93, 1.05)
        y, z = (
            swell * size / 2 * wave(angle) + draw.between(-0.003, 0.003) for size, wave in ((width, np.cos), (height, np.sin))
        )
        points.append(np.stack([np.full(14, along * length / 2), y, np.maximum(z, -0.36 * height)], axis=1))
    places = [points[k][n] - (0.0, 0.0, 0.0018) for k, n in ((2, 3), (4, 4), (6, 3), (3, 4), (5, 3))]
    eyes = [box(0.006, 0.0035, 0.0024).moved(*place) for place in places]
    solid = hull(np.concatenate(points)) + join(eyes).painted("#6a4d30")
    captions = fix_articles(
        f"a {word} potato", f"{'long' if length > 0.1 else 'small'} {word} potato", f"raw potato with {word} skin"
    )
    return AssetDesign(solid.moved(z=0.36 * height), "fruit", color, captions)


def carrot(draw: VariantSampler) -> AssetDesign:
    """A carrot along x, its thick end and its greens on the right."""
    r, length, has_leaves = draw.between(0.013, 0.02), draw.between(0.14, 0.2), draw.pick(True, True, False)
    word, color = pick_words(
        draw, "orange #e07b2a, orange #d96a1e, purple #6d3a5c, orange #e88a38, yellow #e0b144, orange #dd7226"
    )
    shape = [(0.0, 0.14), (0.04, 0.28), (0.3, 0.55), (0.7, 0.85), (0.93, 1.0), (0.98, 0.85), (1.0, 0.5)]
    body = lying_lathe(scaled(shape, length, r), sag=0.9)
    reach = draw.between(0.05, 0.08) if has_leaves else 0.012
    greens = []
    for turn, lift in ((-20, 0.2), (-4, 0.55), (14, 0.3)):
        stalk = bar([(-0.006, 0.0), (reach, lift * r)], 0.005, 0.004, corners=6)
        if has_leaves:
            blade = [(0.3, -0.02), (0.7, -0.26), (1.1, -0.2), (1.35, 0.0), (1.1, 0.2), (0.7, 0.26), (0.3, 0.02)]
            stalk += prism(scaled(blade, reach, reach), -0.001, 0.002).moved(z=0.7 * lift * r)
        greens.append(stalk.turned(z=turn).moved(length, 0.0, 0.75 * r))
    kind = "with its leaves" if has_leaves else "without leaves"
    captions = fix_articles(f"a {word} carrot {kind}", f"{word} carrot", f"raw {word} carrot, a root vegetable")
    return AssetDesign(join([body, join(greens).painted(LEAF)]), "fruit", color, captions)


def cucumber(draw: VariantSampler) -> AssetDesign:
    """A cucumber along x; some are cut, with slices leaning at the cut."""
    r, length, is_cut = draw.between(0.019, 0.025), draw.between(0.2, 0.28), draw.pick(False, True)
    word, color = pick_words(draw, "dark_green #3f6a35, green #55803f, green #4a7a3b")
    start = [(0.0, 0.25), (0.03, 0.55), (0.1, 0.86), (0.24, 1.0)]
    shape, parts = [*start, *((1 - x, y) for x, y in start[::-1])], []
    if is_cut:
        length *= 0.7
        shape = [*start, (1.0, 1.0)]
        z = r * math.cos(math.pi / 20)
        face = disc(0.9 * r, -0.002, 0.0012).turned(y=90).moved(length, 0.0, z).painted("#cfe0a0")
        slice_ = disc(r, 0.0, 0.006) + disc(0.9 * r, -0.0009, 0.0069).painted("#cfe0a0")
        leaning = [slice_.turned(y=lean).moved(length + x) for lean, x in ((70, 0.006), (48, 0.021))]
        parts = [face, *(one.grounded() for one in leaning)]
    body = lying_lathe(scaled(shape, length, r), corners=20)
    kind, more = ("cut", " with two slices") if is_cut else ("whole", "")
    captions = fix_articles(f"a {kind} {word} cucumber{more}", f"{kind} cucumber{more}", f"fresh {word} cucumber")
    return AssetDesign(join([body, *parts]), "fruit", color, captions)


def onion(draw: VariantSampler) -> AssetDesign:
    """An onion with a dry neck and ribs in its skin."""
    r, share, is_long = draw.between(0.03, 0.042), draw.between(1.7, 2.0), draw.pick(False, True, False)
    word, color, stripe = pick_words(
        draw,
        "brown #b9762f #9a5c22, red #7b2d52 #5f2140, white #e8e2d2 #cbc3a8",
        "yellow #d19a45 #b07c30, red #8a3a5c #6b2a48, brown #a86a2c #8a5220",
    )
    h = share * r * (1.2 if is_long else 1.0)
    profile = (
        (0.3, 0.0), (0.66, 0.09), (0.94, 0.28), (1.0, 0.42), (0.92, 0.58),
        (0.62, 0.74), (0.26, 0.84), (0.14, 0.93), (0.18, 1.0),
    )  # fmt: skip
    # Rings of the skin: the same outline, flattened to a rib that stands out by a millimetre.
    wide = [circle(x * r + 0.0009, z * h, 32) * (1.0, 0.11, 1.0) for x, z in profile[1:6]]
    ribs = join([loft(wide).turned(z=angle) for angle in (11, 56, 101, 146)]).painted(stripe)
    captions = fix_articles(
        f"a {word} onion", f"whole {word} onion", f"{'long' if is_long else 'round'} {word} onion with dry skin"
    )
    return AssetDesign(lathe(scaled(profile, r, h), 32) + ribs, "fruit", color, captions)


def bell_pepper(draw: VariantSampler) -> AssetDesign:
    """A lobed pepper with a stem."""
    r, h, num = draw.between(0.034, 0.043), draw.between(0.068, 0.095), draw.pick(4, 3)
    word, color = pick_words(
        draw, "red #bf2f2c, green #4e8a3c, yellow #e8bd33, orange #e07c28, dark_green #386b33, red #a82a2a"
    )
    share = ((0.26, 0.26, 0.0), (0.32, 0.44, 0.06), (0.4, 0.56, 0.3), (0.45, 0.58, 0.7), (0.42, 0.5, 0.9), (0.36, 0.28, 1.0))
    lobe = _lobe(r, h, share, 16)
    core = disc(0.34 * r, 0.08 * h, 0.93 * h, 12)
    cap = lathe(scaled(((0.36, 0.9), (0.26, 0.98)), r, h), 12)
    stalk = bar([(0.0, 0.93 * h), (0.0, h + 0.008), (0.007, h + 0.022)], 0.0085, 0.0085, corners=8)
    solid = join([*(lobe.turned(z=360 / num * k + 20) for k in range(num)), core, (cap + stalk).painted(LEAF)])
    captions = fix_articles(
        f"a {word} bell pepper", f"{'tall' if h > 2 * r else 'squat'} {word} pepper", f"fresh {word} sweet pepper"
    )
    return AssetDesign(solid, "fruit", color, captions, density=450.0)


def eggplant(draw: VariantSampler) -> AssetDesign:
    """An eggplant along x, its green cap on the right."""
    r, length = draw.between(0.032, 0.045), draw.between(0.16, 0.23)
    word, color = pick_words(
        draw, "dark_purple #40254d, purple #5c3568, black #2f2233, white #e3dccb, violet #7a4a86, dark_purple #4a2a50"
    )
    shape = (
        (0.0, 0.3), (0.03, 0.58), (0.08, 0.84), (0.16, 1.0), (0.48, 1.0),
        (0.68, 0.76), (0.85, 0.58), (0.97, 0.46), (1.0, 0.3),
    )  # fmt: skip
    body = lying_lathe(scaled(shape, length, r), corners=20)
    cap = lathe([(x * r, z) for x, z in ((0.58, -0.012), (0.56, 0.001), (0.2, 0.008))], 16)
    tongue = prism([(-0.25 * r, 0.0), (0.25 * r, 0.0), (0.004, -0.034), (-0.004, -0.034)], 0.0, 0.0026)
    leaves = [tongue.turned(x=80).moved(y=0.0016 - 0.57 * r).turned(z=60 * k) for k in range(6)]
    stalk = bar([(0.0, 0.004), (0.0, 0.018), (0.008, 0.032)], 0.011, 0.011, corners=8)
    top = join([cap, stalk, *leaves]).painted("#6d8a45").turned(y=90).moved(length - 0.004, 0.0, math.cos(math.pi / 20) * r)
    captions = fix_articles(
        f"a {word} eggplant with a green cap", f"{word} aubergine", f"{'long' if length > 0.2 else 'small'} {word} eggplant"
    )
    return AssetDesign(body + top, "fruit", color, captions, density=550.0)


def pumpkin(draw: VariantSampler) -> AssetDesign:
    """A ribbed pumpkin with a stem."""
    r, share, num = draw.between(0.06, 0.1), draw.pick(0.62, 0.8, 0.95), draw.pick(9, 8)
    word, color = pick_words(
        draw, "orange #dc7a26, white #e9e0cb, deep_orange #c9601d, green #5f7a4a, yellow #dfab45, orange #e58c35"
    )
    h = 1.8 * share * r
    profile = (
        (0.3, 0.2, 0.0), (0.44, 0.36, 0.09), (0.53, 0.46, 0.32),
        (0.53, 0.47, 0.58), (0.47, 0.4, 0.84), (0.38, 0.2, 0.99),
    )  # fmt: skip
    lobe = _lobe(r, h, profile, 12)
    core = disc(0.4 * r, 0.02 * h, 0.88 * h, 12)
    stalk = bar([(0.0, 0.84 * h), (0.0, h + 0.008), (0.16 * r, h + 0.3 * r)], 0.17 * r, 0.17 * r, corners=6).painted("#7c7a42")
    lobes = [lobe.turned(z=360 / num * k) for k in range(num)]
    size = "flat" if share < 0.7 else "round"
    captions = fix_articles(f"a small {size} {word} pumpkin", f"{word} pumpkin with ribs and a stem", f"{size} {word} squash")
    return AssetDesign(join([*lobes, core, stalk]), "fruit", color, captions, density=600.0)


FAMILIES = (tomato, potato, carrot, cucumber, onion, bell_pepper, eggplant, pumpkin)
