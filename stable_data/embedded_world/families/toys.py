"""Toys for small children."""

import math
from itertools import pairwise

from stable_data.embedded_world.families.palette import WINDOW
from stable_data.embedded_world.families.wording import fix_articles
from stable_data.embedded_world.modelling.family import AssetDesign, SupportArea, VariantSampler
from stable_data.embedded_world.modelling.shapes import arc_points, ellipsoid, rod, round_body, silhouette
from stable_data.embedded_world.modelling.solids import Solid, box, chain, circle, join, loft, rectangle, slab

_STROKES = {  # x, y, width and height of the strokes of a letter, shares of the cube
    "H": ((-0.2, 0, 0.14, 0.6), (0.2, 0, 0.14, 0.6), (0, 0, 0.4, 0.13)),
    "T": ((0, 0.23, 0.56, 0.14), (0, -0.06, 0.14, 0.48)),
    "L": ((-0.15, 0, 0.14, 0.6), (0.04, -0.23, 0.46, 0.14)),
    "E": ((-0.15, 0, 0.14, 0.6), (0.05, 0.23, 0.42, 0.14), (0.02, 0, 0.36, 0.12), (0.05, -0.23, 0.42, 0.14)),
}


def _letter_cube(size: float, letter: str, color: str) -> Solid:
    """A cube with a letter on each of its four sides."""
    strokes = _STROKES[letter]
    parts = [box(w * size, h * size, 0.003).moved(x * size, y * size, size / 2 - 0.0018) for x, y, w, h in strokes]
    flat = join(parts).painted(color)
    sign = [flat.turned(x=90), flat.turned(x=90, z=90), flat.turned(x=90, z=-90), flat.turned(x=90, z=180)]
    return join([slab(size, size, size, 0.002), *(face.moved(z=size / 2) for face in sign)])


def _studded_brick(size: float) -> Solid:
    """A brick with two rows of four studs."""
    pitch, high = 0.5 * size, 0.55 * size
    stud = round_body([(0.3 * pitch, high - 0.001), (0.3 * pitch, high + 0.2 * pitch)], 16)
    spots = [(i * pitch, j * pitch) for i in (-1.5, -0.5, 0.5, 1.5) for j in (-0.5, 0.5)]
    return join([box(4 * pitch - 0.0004, 2 * pitch - 0.0004, high, 0.0006), *(stud.moved(x, y) for x, y in spots)])


def _arch(size: float) -> Solid:
    """A block with a round gateway along y."""
    wide, high = 0.95 * size, 0.95 * size
    parts = []
    for k, ((x0, z0), (x1, z1)) in enumerate(pairwise(arc_points(0.55 * size, range(0, 181, 30)))):
        z0, z1 = (max(0.0, z) for z in (z0, z1))
        if k in (0, 5):
            edge = wide if k == 0 else -wide
            side = [(x0, z0), (edge, 0.0), (edge, high), (x1, high), (x1, z1)]
            side = side if k == 0 else [(x1, 0.0), (x0, z0), (x0, high), (edge, high), (edge, 0.0)]
            parts.append(silhouette(side, 0.7 * size))
        else:
            x0, x1 = x0 + 0.0004, x1 - 0.0004  # a little into its neighbours
            parts.append(silhouette([(x0, z0), (x0, high), (x1, high), (x1, z1)], 0.7 * size - 0.0004))
    return join(parts)


def toy_block(draw: VariantSampler) -> AssetDesign:
    """A building block: a cube with letters, a brick with studs, a column, a roof, an arch."""
    size = draw.between(0.035, 0.05)
    kind = draw.pick("cube", "studs", "column", "roof", "arch", "cube")
    color, accent = draw.pick("oak", "red", "blue", "yellow", "green", "#e9c79a"), draw.pick("red", "blue", "green", "purple")
    name = {"#e9c79a": "pale"}.get(color, color)
    top: SupportArea | None = None
    if kind == "cube":
        letter = draw.pick(*"HTLE")
        body = _letter_cube(size, letter, accent)
        words, top = f"cube with the letter {letter.lower()}", SupportArea(0.88 * size, 0.88 * size, size)
    elif kind == "studs":
        body, words = _studded_brick(size), "brick with eight studs"
    elif kind == "column":
        body = round_body([(0.46 * size, 0.0), (0.46 * size, 1.6 * size)])
        words, top = "round column", SupportArea(0.8 * size, 0.8 * size, 1.6 * size, is_round=True)
    elif kind == "roof":
        body = silhouette([(-size, 0.0), (size, 0.0), (size, 0.003), (0.002, size), (-0.002, size), (-size, 0.003)], 0.9 * size)
        words = "roof-shaped block"
    else:
        body, words, top = _arch(size), "arch", SupportArea(1.6 * size, 0.55 * size, 0.95 * size)
    captions = (
        f"{name} wooden toy block, {words}" if kind != "studs" else f"{name} toy {words}",
        f"{name} building block",
        f"toy block, {words}",
    )
    return AssetDesign(body, "plastic" if kind == "studs" else "wood", color, captions, top=top)


def stacking_rings(draw: VariantSampler) -> AssetDesign:
    """Rings of falling size on a post."""
    count, radius, rise = draw.pick(5, 4, 6, 5, 4, 6), draw.between(0.042, 0.055), draw.between(0.015, 0.019)
    color, is_wood = draw.pick("white", "oak", "yellow", "bamboo", "red", "blue"), draw.pick(False, True, False)
    bright, muted = ("red", "orange", "yellow", "green", "blue", "purple"), ("teal", "cream", "pink", "olive", "gold", "navy")
    tints = muted if is_wood else bright
    foot, parts = 0.012, [round_body([(1.02 * radius, 0.0), (1.02 * radius, 0.007), (0.85 * radius, 0.012)], 24)]
    for k in range(count):
        r, z = radius * (1 - 0.58 * k / count), foot - 0.0006 + k * (rise - 0.0006)
        profile = [(r - 0.006, z), (r, z + 0.35 * rise), (r, z + 0.65 * rise), (r - 0.006, z + rise)]
        parts.append(round_body(profile, 24).painted(tints[k]))
    top = foot - 0.0006 + count * (rise - 0.0006)
    parts.append(round_body([(0.008, top - 0.002), (0.008, top + 0.006)], 16))
    parts.append(ellipsoid(0.015, 0.015, 0.014).moved(z=top + 0.014).painted("red" if not is_wood else "walnut"))
    captions = (
        f"a stack of {count} coloured rings, the foot {color}",
        f"baby toy with {count} rings",
        "stacking rings",
        "tower of rings on a post",
    )
    return AssetDesign(join(parts), "wood" if is_wood else "plastic", color, captions, density=450.0)


def rubber_duck(draw: VariantSampler) -> AssetDesign:
    """A bath duck, its beak to -y."""
    s = draw.between(0.8, 1.25)
    color = draw.pick("yellow", "pink", "blue", "yellow", "white", "#f2d36b")
    extra = draw.pick("nothing", "a crown", "a scarf", "sunglasses", "a top hat", "nothing")
    beak = draw.pick("orange", "red")
    trunk = [(0.62, 0.0), (0.92, 0.008), (1.0, 0.02), (0.94, 0.033), (0.7, 0.044), (0.3, 0.05)]
    body = round_body([(0.033 * r, z) for r, z in trunk], 24, 1.22).moved(y=0.006)
    tail = chain([circle(0.017, 0.0, 10) * (1.2, 0.6, 1.0), circle(0.004, 0.03, 10) * (2.0, 0.7, 1.0)])
    tail = tail.turned(x=-38).moved(0.0, 0.03, 0.03)
    head = ellipsoid(0.0245, 0.0235, 0.0235, 20).moved(0.0, -0.016, 0.066)
    bill = [ellipsoid(0.0125, 0.013, 0.0036, 12).moved(0.0, -0.042, z).painted(beak) for z in (0.0635, 0.0585)]
    eyes = [ellipsoid(0.0042, 0.0035, 0.0048, 8).moved(side * 0.0115, -0.0355, 0.073).painted("black") for side in (-1, 1)]
    wings = [ellipsoid(0.007, 0.021, 0.0125, 12).turned(x=14).moved(side * 0.0305, 0.012, 0.028) for side in (-1, 1)]
    parts = [body, tail, head, *bill, *eyes, *wings]
    if extra == "a crown":
        parts += [round_body([(0.013, 0.083), (0.0145, 0.094)], 16).moved(y=-0.016).painted("gold")]
        for a in (0.3, 1.56, 2.8, 4.07, 5.3):
            foot, tip = ((r * math.cos(a), r * math.sin(a) - 0.016, z) for r, z in ((0.0115, 0.092), (0.0125, 0.101)))
            parts.append(rod(foot, tip, 0.0042, 0.0012).painted("gold"))
    elif extra == "a top hat":
        hat = round_body([(0.019, 0.083), (0.019, 0.087), (0.0125, 0.0872), (0.0135, 0.104)], 20)
        parts.append(hat.moved(y=-0.016).painted("black"))
    elif extra == "a scarf":
        parts += [round_body([(0.0215, 0.046), (0.0245, 0.05), (0.0215, 0.054)], 24).moved(y=-0.011).painted("red")]
    elif extra == "sunglasses":
        parts += [box(0.018, 0.006, 0.011, 0.001).moved(side * 0.011, -0.0375, 0.0675).painted("black") for side in (-1, 1)]
        parts += [box(0.046, 0.016, 0.003).moved(0.0, -0.028, 0.075).painted("black")]
    name = {"#f2d36b": "yellow"}.get(color, color)
    look = "" if extra == "nothing" else f" with {extra}"
    captions = (f"a {name} rubber duck{look}", f"{name} bath duck", "toy duck for the bath", "rubber duck")
    return AssetDesign(join(parts).resized(s), "rubber", color, captions, density=350.0)


def teddy_bear(draw: VariantSampler) -> AssetDesign:
    """A sitting bear."""
    s, plump = draw.between(0.95, 1.5), draw.between(0.92, 1.1)
    color, light = draw.pick("brown", "#c79a6a", "cream", "grey", "#8a5a3c", "pink"), draw.pick("cream", "#e6cfa8", "white")
    bow, has_bow = draw.pick("red", "blue", "green", "purple"), draw.pick(True, False, True)
    light = "white" if color == "cream" else light
    trunk = [(0.03 * plump, 0.0), (0.041 * plump, 0.02), (0.041 * plump, 0.045), (0.03, 0.072), (0.018, 0.085)]
    parts = [
        round_body(trunk, 16, 0.88),
        ellipsoid(0.036, 0.033, 0.033, 16).moved(0.0, -0.004, 0.108),
        ellipsoid(0.016, 0.012, 0.013, 12).moved(0.0, -0.034, 0.1).painted(light),
    ]
    parts += [ellipsoid(0.0055, 0.004, 0.0042, 8).moved(0.0, -0.0455, 0.104).painted("black")]
    parts += [ellipsoid(0.026 * plump, 0.012, 0.027, 12).moved(0.0, 0.0095 - 0.0365 * plump, 0.038).painted(light)]
    for side in (-1, 1):
        parts += [
            ellipsoid(0.0135, 0.008, 0.0135, 10).moved(side * 0.028, 0.002, 0.135),
            ellipsoid(0.0085, 0.004, 0.0085, 8).moved(side * 0.0275, -0.0052, 0.1345).painted(light),
        ]
        parts += [ellipsoid(0.0042, 0.003, 0.0045, 6).moved(side * 0.0135, -0.0345, 0.1165).painted("black")]
        parts += [ellipsoid(0.0125, 0.014, 0.03, 12).turned(x=-35, y=-side * 32).moved(side * 0.044 * plump, -0.016, 0.058)]
        leg = ellipsoid(0.0175, 0.032, 0.0175, 12).turned(z=side * 18).moved(side * 0.031, -0.042, 0.0172)
        sole = round_body([(0.0135, 0.0), (0.0135, 0.0055)], 12).turned(x=90, z=side * 18).moved(side * 0.0405, -0.0685, 0.0172)
        parts += [leg, sole.painted(light)]
        if has_bow:
            wing = loft([rectangle(0.004, 0.006, 0.0), rectangle(0.014, 0.007, 0.018)]).turned(y=side * 90)
            parts.append(wing.moved(side * 0.001, -0.024, 0.078).painted(bow))
    name = {"#c79a6a": "tan", "#8a5a3c": "dark brown"}.get(color, color)
    captions = fix_articles(
        f"a sitting {name} teddy bear" + (f" with a {bow} bow" if has_bow else ""),
        f"{name} teddy bear",
        "stuffed toy bear",
        "plush bear",
    )
    return AssetDesign(join(parts).resized(s), "fabric", color, captions)


def toy_robot(draw: VariantSampler) -> AssetDesign:
    """A robot with lamps on its chest, its face to -y."""
    s, color = draw.between(0.85, 1.3), draw.pick("silver", "red", "teal", "yellow", "blue", "grey")
    accent, glow = draw.pick("navy", "black", "orange", "white"), draw.pick("yellow", "green", "red")
    head_kind, arms = draw.pick("square", "round", "dome"), draw.pick("down", "raised", "forward")
    parts = [
        slab(0.048, 0.034, 0.046, 0.003).moved(z=0.036),
        box(0.034, 0.004, 0.02, 0.002).moved(0.0, -0.0175, 0.053).painted(accent),
    ]
    parts += [
        round_body([(0.0032, 0.0), (0.0032, 0.004)], 10).turned(x=90).moved(x, -0.0155, 0.045).painted(t)
        for x, t in ((-0.011, "red"), (0.0, glow), (0.011, "white"))
    ]
    parts += [round_body([(0.009, 0.08), (0.009, 0.088)], 16).painted(accent)]
    if head_kind == "square":
        parts.append(slab(0.038, 0.03, 0.03, 0.003).moved(z=0.086))
    else:
        dome = [(0.019, 0.086), (0.019, 0.098), (0.014, 0.11), (0.006, 0.116)]
        head = [(0.0165, 0.086), (0.019, 0.094), (0.019, 0.106), (0.0125, 0.116)] if head_kind == "round" else dome
        parts.append(round_body(head, 24))
    front = -0.0152 if head_kind == "square" else -0.0172
    parts += [
        round_body([(0.0056, 0.0), (0.0056, 0.006)], 12).turned(x=90).moved(i * 0.009, front + 0.0035, 0.103).painted(glow)
        for i in (-1, 1)
    ]
    parts += [
        round_body([(0.0025, 0.0), (0.0025, 0.0075)], 8).turned(x=90).moved(i * 0.009, front + 0.0035, 0.103).painted("black")
        for i in (-1, 1)
    ]
    parts.append(box(0.016, 0.006, 0.004).moved(0.0, front + 0.002, 0.0905).painted("black"))
    parts += [
        round_body([(0.0017, 0.114), (0.0017, 0.13)], 8),
        ellipsoid(0.0042, 0.0042, 0.0042, 10).moved(z=0.131).painted("red"),
    ]
    for side in (-1, 1):
        parts.append(slab(0.016, 0.02, 0.034, 0.002).moved(side * 0.0125, 0.002, 0.006).painted(accent))
        parts.append(slab(0.02, 0.036, 0.011, 0.002).moved(side * 0.0125, -0.003))
        arm = slab(0.011, 0.012, 0.036, 0.002).moved(z=-0.036)
        arm += slab(0.015, 0.015, 0.012, 0.002).moved(z=-0.044).painted(accent)
        turn = {"down": 0.0, "raised": 155.0, "forward": -78.0}[arms if side > 0 else ("down" if arms == "raised" else arms)]
        parts.append(arm.turned(x=turn).moved(side * 0.031, 0.0, 0.075))
        shoulder = round_body([(0.0075, 0.0), (0.0075, 0.014)], 12).turned(y=90)
        parts.append(shoulder.moved(side * 0.029 - 0.007, 0.0, 0.073).painted(accent))
    captions = (f"a {color} toy robot with an antenna", f"{color} robot with {glow} eyes", "little toy robot", "tin robot")
    return AssetDesign(join(parts).resized(s), "tin", color, captions, density=600.0)


def toy_house(draw: VariantSampler) -> AssetDesign:
    """A little house with a roof, a door and windows, its door to -y."""
    width, depth, wall = draw.between(0.075, 0.11), draw.between(0.06, 0.085), draw.between(0.05, 0.08)
    style, floors = draw.pick("gable", "hip", "gable", "tower", "gable", "hip"), 2 if wall > 0.065 else 1
    color = draw.pick("cream", "yellow", "pink", "blue", "white", "oak")
    roof = draw.pick("red", "navy", "walnut", "green", "teal", "black")
    door, rise = draw.pick("brown", "red", "green"), draw.between(0.032, 0.048)
    eaves, front = 0.007, -depth / 2
    parts = [box(width, depth, wall), box(width + 0.02, depth + 0.024, 0.005, 0.004).painted("green")]
    # The roof reaches a little into the walls, so that they are joined.
    low = wall - 0.0015
    if style == "gable":
        end, top = width / 2 + eaves, low + rise
        outline = [(-end, low), (end, low), (end, low + 0.003), (0.002, top), (-0.002, top), (-end, low + 0.003)]
        parts.append(silhouette(outline, depth + 2 * eaves).painted(roof))
    else:
        wide, deep, tip = width + 2 * eaves, depth + 2 * eaves, 0.45 * width if style == "hip" else 0.004
        peak = rectangle(tip, 0.004, low + rise * (1.0 if style == "hip" else 1.7))
        parts.append(loft([rectangle(wide, deep, low), rectangle(wide, deep, low + 0.003), peak]).painted(roof))
    if style != "tower":
        parts.append(box(0.013, 0.013, rise + 0.004).moved(0.27 * width, 0.12 * depth, low).painted("terracotta"))
        parts.append(box(0.017, 0.017, 0.004).moved(0.27 * width, 0.12 * depth, low + rise + 0.002))
    parts.append(box(0.2 * width, 0.004, 0.032).moved(0.0, front + 0.0006, 0.003).painted(door))
    parts.append(ellipsoid(0.002, 0.002, 0.002, 8).moved(0.06 * width, front - 0.0016, 0.018).painted("gold"))
    pane = box(0.19 * width, 0.004, 0.016)
    sill = box(0.23 * width, 0.006, 0.003)
    spots = [(side * 0.31 * width, 0.016) for side in (-1, 1)] + (
        [(x * width, 0.043) for x in (-0.31, 0.0, 0.31)] if floors == 2 else []
    )
    for x, z in spots:
        parts += [pane.moved(x, front + 0.0006, z).painted(WINDOW), sill.moved(x, front - 0.0005, z - 0.002).painted("white")]
    parts.append(box(0.004, 0.3 * depth, 0.02).moved(width / 2 - 0.0006, 0.0, 0.018).painted(WINDOW))
    parts.append(box(0.004, 0.3 * depth, 0.02).moved(0.0006 - width / 2, 0.0, 0.018).painted(WINDOW))
    captions = fix_articles(
        f"{color} toy house with a {roof} roof",
        f"{color} doll house",
        "little wooden house",
        f"toy house with {'two floors' if floors == 2 else 'one floor'}",
    )
    return AssetDesign(join(parts), "wood", color, captions, density=400.0)


FAMILIES = (toy_block, stacking_rings, rubber_duck, teddy_bear, toy_robot, toy_house)
