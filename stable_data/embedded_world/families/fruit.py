"""Fruit, whole and cut."""

import math
from collections.abc import Sequence

import numpy as np

from stable_data.embedded_world.families.palette import LEAF
from stable_data.embedded_world.families.wording import fix_articles, pick_words
from stable_data.embedded_world.modelling.family import AssetDesign, VariantSampler
from stable_data.embedded_world.modelling.shapes import BALL, HALF_BALL, disc, lying_lathe, prism, scaled
from stable_data.embedded_world.modelling.solids import Ring, Solid, box, chain, circle, hull, join, lathe, loft, vessel

_BARK = "#6b4a2f"


def _stem(z: float, height: float, lean: float = 8.0, radius: float = 0.0019) -> Solid:
    return lathe([(radius, -0.003), (1.4 * radius, height)], 8).turned(y=lean).moved(z=z).painted(_BARK)


def _leaf(length: float, tilt: float) -> Solid:
    """A leaf that grows from the z axis to the right."""
    outline = [(0.0, -0.002), (0.35, -0.24), (0.7, -0.2), (1.0, 0.0), (0.7, 0.2), (0.35, 0.24), (0.0, 0.002)]
    return prism(scaled(outline, length, length), -0.0009, 0.0009).turned(y=-tilt).painted(LEAF)


def _half(radius: float, height: float, pith: str, flesh: str, num: int) -> tuple[Solid, list[Solid]]:
    """Half a fruit, cut side up, and the visible cut: pith and ``num`` segments."""
    face = disc(0.96 * radius, height - 0.002, height + 0.0009, 32).painted(pith)
    step = 2 * math.pi / num
    arc = [(0.84 * radius * math.cos(a), 0.84 * radius * math.sin(a)) for a in (0.08 * step, 0.5 * step, 0.92 * step)]
    tip = (0.14 * radius * math.cos(step / 2), 0.14 * radius * math.sin(step / 2))
    piece = prism([tip, *arc], height - 0.001, height + 0.0019)
    pieces = join([piece.turned(z=360 / num * k) for k in range(num)]).painted(flesh)
    return lathe(scaled(HALF_BALL, radius, height), 32), [face, pieces]


def apple(draw: VariantSampler) -> AssetDesign:
    """An apple with a dimple and a stem; some have a leaf."""
    r, share = draw.between(0.034, 0.042), draw.between(0.8, 0.95)
    word, color = pick_words(draw, "red red, green #8fb548, yellow #e3c552, dark_red #8f2a36, green #a9bf4d, pale_red #c9604f")
    h = 2 * share * r
    profile = ((0.42, 0.0), (0.68, 0.08), (0.9, 0.28), (1.0, 0.56), (0.97, 0.74), (0.8, 0.92), (0.52, 1.0))
    rings = [circle(x * r, z * h, 32) for x, z in profile]
    body = vessel(rings, [circle(0.1 * r, 0.87 * h, 16), circle(0.46 * r, h, 16)])
    leaf = [_leaf(0.034, 25).moved(0.001, 0.0, h + 0.002)] if draw.pick(True, False) else []
    captions = fix_articles(
        f"a {word} apple{' with a leaf' if leaf else ' with a stem'}", f"{word} apple", f"fresh {word} apple, a fruit"
    )
    return AssetDesign(join([body, _stem(0.87 * h, 0.13 * h + 0.011), *leaf]), "fruit", color, captions)


def orange(draw: VariantSampler) -> AssetDesign:
    """An orange, or half of one."""
    r, is_half = draw.between(0.035, 0.043), draw.pick(False, False, True)
    word, color = pick_words(draw, "ripe orange, bright #f08a24, dark #d9651f")
    if is_half:
        body, inside = _half(r, 0.9 * r, "#f6e3bd", "#f29a3a", 10)
        captions = fix_articles(f"half of a {word} orange, cut side up", "halved orange", "cut orange, a fruit")
    else:
        h = 1.86 * r
        inside = [disc(0.005, h - 0.003, h + 0.0012, 5).painted(LEAF)]
        inside += [_leaf(0.035, 18).moved(z=h + 0.0003)] if draw.pick(True, False) else []
        body = lathe(scaled(BALL, r, h), 32)
        captions = fix_articles(f"a {word} orange", "whole round orange", f"{word} orange, a fruit")
    return AssetDesign(join([body, *inside]), "fruit", color, captions)


def lemon(draw: VariantSampler) -> AssetDesign:
    """A lemon or a lime on its side, or half of one."""
    r, stretch, is_half = draw.between(0.026, 0.031), draw.between(1.2, 1.4), draw.pick(False, True, False)
    word, color = pick_words(
        draw, "yellow #efd13c, yellow #e6c22e, green #8fae3e, yellow #f2d84b, pale_yellow #eedd70, yellow #eaca30"
    )
    if is_half:
        body, inside = _half(r, 0.95 * r, "#f7f0cf", "#ecd964" if word != "green" else "#bcd07a", 9)
        tip = [circle(0.45 * r, 0.0, 16), circle(0.45 * r, 0.3 * r, 16)]
        solid = join([body, loft(tip), *inside])
        captions = fix_articles(f"half of a {word} lemon, cut side up", "halved lemon", f"cut {word} lemon")
    else:
        curve = [(-1.28, 0.1), (-1.2, 0.2), (-1.0, 0.34), (-0.78, 0.7), (-0.45, 0.94), (-0.15, 1.0)]
        rings = [*curve, *((-x, y) for x, y in curve[::-1])]
        solid = lying_lathe([(x * stretch * r, y * r) for x, y in rings], corners=20)
        captions = fix_articles(f"a {word} lemon", f"whole {word} lemon", f"fresh {word} lemon, a sour fruit")
    return AssetDesign(solid, "fruit", color, captions)


def banana(draw: VariantSampler) -> AssetDesign:
    """A banana that lies on its side, or a bunch of them joined at their stems."""
    length, thick, num = draw.between(0.15, 0.19), draw.between(0.032, 0.038), draw.pick(1, 3, 1, 2, 1, 4)
    word, color = pick_words(draw, "yellow #ecc93b, ripe_yellow #e3b733, greenish #c3c64a")
    bend, turn = length / 1.3, 0.62
    angle = 2 * np.pi * np.arange(12) / 12

    def ring(along: float, share: float) -> Ring:
        reach = bend + share * thick / 2 * np.cos(angle)
        z = np.maximum(share * thick / 2 * np.sin(angle), -0.4 * thick)  # flat where it lies
        return np.stack([reach * np.sin(turn * along), reach * np.cos(turn * along) - bend, z], axis=1)

    # Places along the bend and thickness there, shares.
    shape = ((-1.06, 0.3), (-0.94, 0.34), (-0.76, 0.82), (-0.4, 1.0), (0.4, 1.0), (0.75, 0.84), (0.97, 0.36))
    stem, tip = chain([ring(-1.22, 0.34), ring(-1.02, 0.33)]), chain([ring(0.94, 0.42), ring(1.03, 0.22)])
    one = chain([ring(*place) for place in shape]) + (stem + tip).painted(_BARK)
    # Fanned out around the stem, they share it.
    x, y = bend * math.sin(1.1 * turn), bend * (1 - math.cos(1.1 * turn))
    fan = [one.moved(x, y).turned(z=13 * k).moved(-x, -y) for k in range(num)]
    some = f"{word} banana{'s' if num > 1 else ''}"
    captions = fix_articles(f"a bunch of {num} {some}" if num > 1 else f"a {some}", some, f"fresh {some}, a fruit")
    return AssetDesign(join(fan).moved(z=0.4 * thick), "fruit", color, captions)


def pear(draw: VariantSampler) -> AssetDesign:
    """A pear with a stem."""
    r, share = draw.between(0.033, 0.039), draw.between(2.3, 2.7)
    word, color = pick_words(
        draw, "green #a4b64c, yellow #dcc455, brown #a5743c, green #8ba446, red #a8463c, yellow-green #c3c050"
    )
    h = share * r
    belly = [(0.42, 0.0), (0.72, 0.05), (0.96, 0.2), (1.0, 0.32), (0.9, 0.48)]
    profile = [*belly, (0.66, 0.66), (0.5, 0.82), (0.4, 0.93), (0.18, 1.0)]
    parts = [lathe(scaled(profile, r, h), 32), _stem(h, 0.018, draw.between(8, 20))]
    parts += [_leaf(0.035, 20).moved(0.001, 0.0, h + 0.004)] if draw.pick(False, False, True) else []
    captions = fix_articles(f"a {word} pear with a stem", f"ripe {word} pear", f"fresh pear, {word}")
    return AssetDesign(join(parts), "fruit", color, captions)


def avocado(draw: VariantSampler) -> AssetDesign:
    """An avocado on its side, or half of one with its stone."""
    r, length, is_half = draw.between(0.028, 0.036), draw.between(0.088, 0.115), draw.pick(True, False)
    word, color = pick_words(
        draw, "dark_green #33452b, green #4f6b34, black #2f2d2a, green #5a7a3a, dark_green #3b5230, brownish #45382c"
    )
    shape = (
        (0.0, 0.25), (0.03, 0.5), (0.1, 0.82), (0.18, 1.0), (0.46, 1.0),
        (0.7, 0.74), (0.9, 0.46), (0.97, 0.3), (1.0, 0.14),
    )  # fmt: skip
    if not is_half:
        solid = lying_lathe([((x - 0.5) * length, y * r) for x, y in shape], corners=20)
        end = lying_lathe([(0.0, 0.005), (0.004, 0.004)], corners=8).moved(length / 2 - 0.002, 0.0, r - 0.005).painted(_BARK)
        captions = fix_articles(f"a {word} avocado", f"whole {word} avocado", "ripe avocado, a fruit")
        return AssetDesign(solid + end, "fruit", color, captions)
    outline = np.array(
        [*((x - 0.35, y * r / length) for x, y in shape), *((x - 0.35, -y * r / length) for x, y in shape[::-1])]
    )
    h = 0.9 * r

    def rings(scales: Sequence[tuple[float, float]]) -> Solid:
        return loft([np.c_[scale * length * outline, np.full(len(outline), z)] for scale, z in scales])

    skin = rings([(0.5, 0.0), (0.74, 0.16 * h), (0.92, 0.5 * h), (1.0, h)])
    flesh = rings([(0.95, h - 0.002), (0.95, h + 0.0012)]).painted("#cdd47e")
    stone = scaled(((0.97, -0.1), (1.0, 0.05), (0.9, 0.45), (0.6, 0.8), (0.2, 0.95)), 0.5 * r, 0.5 * r)
    seed = lathe(stone, 32).painted("#7a4a28")
    captions = fix_articles("half of an avocado with its stone", f"halved {word} avocado", "cut avocado with a brown pit")
    return AssetDesign(join([skin, flesh, seed.moved(-0.05 * length, 0.0, h)]), "fruit", color, captions)


def watermelon(draw: VariantSampler) -> AssetDesign:
    """A small striped watermelon, or half of one."""
    r, stretch, is_half = draw.between(0.078, 0.095), draw.between(1.0, 1.22), draw.pick(False, False, True)
    word, color, stripe = pick_words(draw, "green #86b257 #3a6b33, light_green #a3c26d #4d7d3d, dark_green #3f6e3a #24472a")
    if is_half:
        h = 0.92 * r
        rind = disc(0.97 * r, h - 0.002, h + 0.001, 48).painted("#e6ecc4")
        red = disc(0.88 * r, h, h + 0.0024, 48).painted("#cf4046")
        seed = box(0.008, 0.004, 0.004, 0.0012).moved(0.55 * r, 0.0, h)
        seeds = join([seed.moved(x=-0.22 * r * (k % 2)).turned(z=36 * k) for k in range(10)]).painted("black")
        captions = fix_articles(
            "half of a small watermelon, cut side up", "halved watermelon with red flesh and seeds", "cut watermelon"
        )
        return AssetDesign(join([lathe(scaled(HALF_BALL, r, h), 48), rind, red, seeds]), "fruit", color, captions)
    degrees = np.array([-80, -60, -40, -20, -7, 7, 20, 40, 60, 80])
    curve = [(stretch * math.sin(a), math.cos(a)) for a in np.radians(degrees)]
    body = lying_lathe([(x * r, min(y, 0.99) * r) for x, y in curve], corners=24)
    middle = math.cos(math.pi / 24) * 0.99 * r
    bands = []
    for k in range(8):
        arcs = [
            np.array([(x * r, math.sin(side) * y * r, math.cos(side) * y * r) for x, y in curve]) for side in (-0.13, 0.0, 0.13)
        ]
        bands.append(hull(np.concatenate([*arcs, [(x * 0.8 * r, 0.0, 0.0) for x in (-1, 1)]]) * 1.006).turned(x=45 * k + 22.5))
    dark = join(bands).moved(z=middle).painted(stripe)
    captions = fix_articles(f"a small {word} watermelon with stripes", f"whole {word} watermelon", "striped melon")
    return AssetDesign(body + dark, "fruit", color, captions, density=920.0)


FAMILIES = (apple, orange, lemon, banana, pear, avocado, watermelon)
