"""Tools, trays and holders of an office."""

import math
from itertools import product

from stable_data.embedded_world.families.displays import digits
from stable_data.embedded_world.families.palette import PAPER
from stable_data.embedded_world.families.wording import fix_articles
from stable_data.embedded_world.modelling.family import AssetDesign, SupportArea, VariantSampler
from stable_data.embedded_world.modelling.shapes import hoop, panel, prism, scaled, silhouette
from stable_data.embedded_world.modelling.solids import (
    Solid,
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

_MADE_OF = {"oak": "wood", "bamboo": "wood", "walnut": "wood", "kraft": "cardboard", "silver": "metal"}  # plastic otherwise


def file_tray(draw: VariantSampler) -> AssetDesign:
    """A letter tray, one or two levels high, open to the viewer."""
    width, depth, levels = draw.between(0.245, 0.27), draw.between(0.32, 0.35), draw.pick(1, 2, 2)
    color = draw.pick("black", "white", "oak", "blue", "grey", "silver")
    material = _MADE_OF.get(color, "plastic")
    wall, rim, pitch = 0.006 if material == "wood" else 0.004, draw.between(0.045, 0.065), draw.between(0.09, 0.115)
    front, back = 0.4 * rim if draw.pick(True, False, False) else rim, rim
    side = silhouette([(-depth / 2, 0), (depth / 2, 0), (depth / 2, back), (0, back), (-depth / 2, front)], wall).turned(z=90)
    sides = [side.moved(x * (width - wall) / 2) for x in (-1, 1)]
    lips = [box(0.28 * width, wall, front - 0.001).moved(x * 0.35 * width, (wall - depth) / 2, 0.0005) for x in (-1, 1)]
    end = box(width - 0.001, wall, back - 0.001).moved(0.0, (depth - wall) / 2, 0.0005)
    level = join([box(width - 0.001, depth - 0.001, wall), *sides, end, *lips])
    solid, floor = level, wall
    if levels == 2:
        post = box(wall + 0.004, 0.016, pitch + 0.02).moved(z=0.001)
        posts = [post.moved(x * (width - wall) / 2, y * (depth / 2 - 0.03)) for x in (-1, 1) for y in (-1, 1)]
        solid, floor = join([level, level.moved(z=pitch), join(posts).painted("grey")]), pitch + wall
    height = "two-tier" if levels == 2 else "single"
    captions = fix_articles(f"a {height} {color} letter tray", f"{color} file tray", f"{height} tray for papers")
    inside = SupportArea(width - 2 * wall - 0.004, depth - 2 * wall - 0.002, floor, front - wall)
    return AssetDesign(solid, material, color, captions, hollow=inside, density=1500.0 if material == "metal" else None)


def file_holder(draw: VariantSampler) -> AssetDesign:
    """A magazine holder, its low side towards the viewer."""
    width, depth, height = draw.between(0.08, 0.12), draw.between(0.23, 0.27), draw.between(0.27, 0.32)
    color = draw.pick("white", "oak", "black", "blue", "kraft", "red")
    material = _MADE_OF.get(color, "plastic")
    wall, low, bend = 0.004, draw.between(0.09, 0.14), draw.between(-0.15, 0.1) * depth
    side = silhouette([(-depth / 2, 0), (depth / 2, 0), (depth / 2, height), (bend, height), (-depth / 2, low)], wall).turned(
        z=90
    )
    walls = [side.moved(x * (width - wall) / 2) for x in (-1, 1)]
    at = (depth - wall) / 2 - 0.0002
    ends = [box(width - 0.001, wall, h).moved(y=y) for y, h in ((-at, low - 0.003), (at, height - 0.001))]
    label = panel(0.5 * width, 0.032, 0.0, PAPER).turned(x=90).moved(0.0, 0.0002 - depth / 2, 0.6 * low)
    solid = join([box(width - 0.002, depth - 0.002, 0.005), *walls, *ends, label])
    captions = fix_articles(f"a {color} {material} magazine holder", f"{color} file holder", f"{material} magazine file")
    inside = SupportArea(width - 2 * wall - 0.001, depth - 2 * wall - 0.002, 0.005, low - 0.005)
    return AssetDesign(solid, material, color, captions, hollow=inside, density=600.0)


def pen_holder(draw: VariantSampler) -> AssetDesign:
    """An open cup for pens."""
    radius, height, kind = draw.between(0.034, 0.046), draw.between(0.085, 0.115), draw.pick("round", "square", "six-sided")
    color, second = draw.pick("black", "oak", "white", "silver", "teal", "red"), draw.pick("gold", "grey", "cream", "navy")
    material = {"white": "ceramic", "teal": "ceramic"}.get(color, _MADE_OF.get(color, "plastic"))
    sizes = {"round": (48, 0.003, radius), "square": (4, 0.004, 1.25 * radius), "six-sided": (6, 0.0036, 1.08 * radius)}
    corners, wall, r = sizes[kind]
    inside = 16 if kind == "round" else corners
    flare = draw.pick(1.0, 1.12, 1.0) if kind == "round" else 1.0
    cup = vessel(
        [circle(r - 0.002, 0.0, corners), circle(r, 0.002, corners), circle(flare * r, height, corners)],
        [circle(r - wall, 0.006, inside), circle(flare * r - wall, height, inside)],
    )
    if draw.pick(True, False):
        band = [circle(r + 0.0012, z, corners) for z in (0.0015, 0.2 * height)]
        cup += vessel(band, [circle(r - 0.0012, z, inside) for z in (0.004, 0.2 * height)]).painted(second)
    captions = fix_articles(f"a {kind} {color} pen holder", f"{color} pen cup", f"{kind} {material} pencil holder")
    room = 2 * (r - wall) * math.cos(math.pi / inside) if kind != "square" else math.sqrt(2) * (r - wall)
    space = SupportArea(room, room, 0.006, height - 0.006, is_round=kind != "square")
    return AssetDesign(cup.turned(z=45 if kind == "square" else 0), material, color, captions, hollow=space)


def _tub(width: float, depth: float, height: float, wall: float, floor: float) -> Solid:
    """An open box with straight walls."""
    inner = [rectangle(width - 2 * wall, depth - 2 * wall, z) for z in (floor, height)]
    return vessel([rectangle(width, depth, z) for z in (0.0, height)], inner)


def desk_organizer(draw: VariantSampler) -> AssetDesign:
    """A desk tidy with compartments of several heights."""
    width, depth, high = draw.between(0.19, 0.26), draw.between(0.11, 0.14), draw.between(0.09, 0.115)
    color = draw.pick("black", "oak", "white", "bamboo", "teal", "silver")
    material = _MADE_OF.get(color, "plastic")
    kind, wall, floor = draw.pick("stepped", "with a drawer", "with cups"), 0.005, 0.006
    low = draw.between(0.4, 0.55) * high
    if kind == "with cups":
        r = 0.2 * width
        cups = [
            turned_vessel([(r, 0.0), (r, h)], [(r - 0.004, floor), (r - 0.004, h)]).moved(x, y)
            for x, y, h in ((-0.34 * width, 0.2 * depth, high), (0.052 * width, 0.2 * depth, 0.8 * high))
        ]
        bin_ = _tub(0.5 * width, 0.8 * depth, low, wall, floor).moved(0.36 * width)
        solid = join([*cups, bin_, _tub(1.2 * width, 1.1 * depth, 0.018, 0.003, 0.0052).moved(0.035 * width, 0.06 * depth)])
        space = SupportArea(2 * r - 0.01, 2 * r - 0.01, floor, high - floor, is_round=True, x=-0.34 * width, y=0.2 * depth)
    else:
        left = 0.4 * width
        tall = _tub(left, depth, high, wall, floor).moved((left - width) / 2)
        rest, x = width - left + wall - 0.0006, (left - wall + 0.0006) / 2
        back = _tub(rest, 0.5 * depth, 0.75 * high, wall, floor).moved(x, 0.25 * depth - 0.0004)
        front_y = -0.25 * depth + wall / 2
        if kind == "stepped":
            part, shift = 0.5 * (rest + wall), 0.25 * (rest - wall) + 0.0002
            tub = (part, 0.5 * depth + wall - 0.0012)
            pieces = [_tub(*tub, low * s, wall, floor).moved(x + t * shift, front_y) for s, t in ((1.0, -1), (0.9, 1))]
        else:
            body = box(rest - 0.0004, 0.5 * depth + wall - 0.0012, low).moved(x, front_y)
            drawer = panel(0.84 * rest, 0.7 * low, 0.0, "cream" if color != "white" else "grey", rise=0.0016)
            drawer += lathe([(0.007, 0.0), (0.007, 0.012)])
            pieces = [body, drawer.turned(x=90).moved(x, 0.0008 - depth / 2, low / 2)]
        solid = join([tall, back, *pieces])
        space = SupportArea(left - 2 * wall - 0.001, depth - 2 * wall - 0.001, floor, high - floor, x=(left - width) / 2)
    name = f"{color} desk organizer {kind}" if kind != "stepped" else f"stepped {color} desk organizer"
    captions = fix_articles(f"a {name}", f"{color} desk organizer", f"{material} desk tidy with compartments")
    return AssetDesign(solid, material, color, captions, hollow=space, density=1000.0 if material == "metal" else None)


def stapler(draw: VariantSampler) -> AssetDesign:
    """A stapler, its long side along x, its mouth on the left."""
    n, kind = draw.between(0.115, 0.17), draw.pick("desktop", "compact", "long-arm")
    color = draw.pick("black", "red", "blue", "grey", "teal", "pink")
    k = {"desktop": 1.0, "compact": 1.25, "long-arm": 0.85}[kind] * draw.between(0.9, 1.1)
    wide = draw.between(0.034, 0.042)
    base = slab(n, wide, 0.01, 0.003).painted("black") + panel(0.16 * n, 0.5 * wide, 0.01, "silver", -0.4 * n)
    hinge = box(0.2 * n, 0.7 * wide, 0.034 * k).moved(0.36 * n, 0.0, 0.006)
    rail = [(0.44 * n, 0.016 * k), (0.44 * n, 0.03 * k), (-0.475 * n, 0.036 * k), (-0.475 * n, 0.024 * k)]
    shape = [(0.47, 24), (0.48, 36), (0.4, 50), (0.1, 58), (-0.36, 54), (-0.46, 46), (-0.48, 34)]
    arm = scaled(shape, n, 0.001 * k)
    solid = join([base, hinge.painted("silver"), silhouette(rail, 0.4 * wide).painted("silver"), silhouette(arm, 0.78 * wide)])
    captions = fix_articles(f"a {color} {kind} stapler", f"{color} stapler", f"{kind} office stapler")
    return AssetDesign(solid, "metal", color, captions, density=1500.0)


def tape_dispenser(draw: VariantSampler) -> AssetDesign:
    """A heavy desk dispenser with a roll of clear tape, its cutter on the left."""
    n, roll, wide = draw.between(0.125, 0.165), draw.between(0.028, 0.034), draw.between(0.05, 0.06)
    color, core = draw.pick("black", "red", "white", "blue", "teal", "grey"), draw.pick("white", "orange", "blue")
    x, z, high = 0.14 * n, roll + 0.012, draw.between(0.046, 0.056)
    foot = loft([rectangle(n, wide, 0.0, 0.008), rectangle(n - 0.004, wide - 0.004, 0.022, 0.008)])
    head = silhouette([(-0.49 * n, 0.001), (-0.22 * n, 0.001), (-0.34 * n, high - 0.006), (-0.47 * n, high)], 0.6 * wide)
    cheek = silhouette([(x - 0.3 * n, 0.01), (x + 0.3 * n, 0.01), (x + 0.012, z + 0.012), (x - 0.012, z + 0.012)], 0.006)
    hub = lathe([(0.011, -0.5 * wide + 0.002), (0.011, 0.5 * wide - 0.002)]).turned(x=90).moved(x, 0.0, z).painted(core)
    tape = lathe([(roll, -0.0095), (roll, 0.0095)]).turned(x=90).moved(x, 0.0, z)
    strip = silhouette([(x, z + roll), (x, z + roll - 0.002), (-0.44 * n, high - 0.002), (-0.45 * n, high + 0.0012)], 0.018)
    blade = silhouette(
        [(-0.485 * n, high - 0.01), (-0.46 * n, high - 0.01), (-0.46 * n, high + 0.004), (-0.485 * n, high + 0.006)], 0.024
    )
    cheeks = [cheek.moved(y=y * 0.38 * wide) for y in (-1, 1)]
    solid = join([foot, head, *cheeks, hub, (tape + strip).painted("#e9dcae"), blade.painted("silver")])
    captions = fix_articles(f"a {color} tape dispenser with a roll of tape", f"{color} tape dispenser", "desk tape dispenser")
    return AssetDesign(solid, "plastic", color, captions, density=1300.0)


def scissors(draw: VariantSampler) -> AssetDesign:
    """Scissors that lie flat, a little open, their points away from the viewer."""
    n, opening = draw.between(0.15, 0.22), draw.between(6.0, 24.0)
    color, blunt = draw.pick("orange", "black", "blue", "red", "green", "purple"), draw.pick(0.001, 0.004)
    long, w = draw.between(0.5, 0.6) * n, 0.045 * n
    loop, thick = (0.2 * n, 0.3 * n), 0.009
    halves = []
    for side, low in ((1, 0.0), (-1, 0.0022)):
        point = -side * 0.3 * w
        tip = [(w, 0.3 * long), (point + blunt, long), (point - blunt, long), (-w, 0.3 * long)]
        blade = prism([(-w, -0.06 * n), (w, -0.06 * n), *tip], low, low + 0.0024).painted("silver")
        neck = [(-side * w, -0.03 * n), (side * w, -0.03 * n), (side * 1.6 * w, -0.2 * n), (side * 0.2 * w, -0.2 * n)]
        ring = hoop(*loop, thick, 0.036 * n).turned(z=side * 14).moved(side * 0.1 * n, -0.29 * n)
        halves.append((blade + prism(neck, 0.0, thick) + ring).turned(z=side * opening / 2))
    pivot = lathe([(0.026 * n, 0.0), (0.026 * n, 0.0062)]).painted("grey")
    size = "large" if n > 0.185 else "small"
    captions = (f"a pair of {size} scissors with {color} handles", f"{color} scissors", f"{size} office scissors")
    return AssetDesign(join([*halves, pivot]), "metal", color, captions)


def ruler(draw: VariantSampler) -> AssetDesign:
    """A straight ruler that lies flat, its scale towards the viewer."""
    color = draw.pick("oak", "clear", "silver", "yellow", "blue", "bamboo")
    material = _MADE_OF.get(color, "plastic")
    centimetres, width = draw.pick(15, 20, 30), draw.between(0.025, 0.038)
    n, thick = 0.01 * centimetres + 0.01, 0.003
    ink = "white" if color == "blue" else "black"
    section = scaled([(-0.5, 0.0), (0.5, 0.0), (0.5, 1.0), (-0.1, 1.0), (-0.5, 0.66)], width, thick)
    body = silhouette(section, n).turned(z=90)
    long = [0.5 if k % 5 == 0 else 0.26 for k in range(centimetres + 1)]
    marks = [
        panel(0.0013, share * width, thick, ink, 0.01 * k - 0.005 * centimetres, 0.4 * width - share * width / 2, 0.0004)
        for k, share in enumerate(long)
    ]
    line = panel(n - 0.012, 0.0014, thick, ink, y=0.42 * width, rise=0.0004)
    captions = fix_articles(f"a {centimetres} cm {color} {material} ruler", f"{color} ruler", f"{material} ruler")
    return AssetDesign(join([body, line, *marks]), material, color, captions)


def calculator(draw: VariantSampler) -> AssetDesign:
    """A pocket or desk calculator that lies flat, its display at the back."""
    width, thick = draw.between(0.075, 0.13), draw.between(0.01, 0.016)
    depth = width * draw.between(1.25, 1.75)
    color = draw.pick("black", "white", "grey", "navy", "pink", "silver")
    keys = {"black": "grey", "white": "grey", "navy": "white", "pink": "white"}.get(color, "black")
    size, rows = draw.pick("pocket", "desk"), draw.pick(5, 4)
    pitch_x, pitch_y, middle = 0.225 * width, 0.6 * depth / rows, -0.14 * depth
    sizes = ((0.004, 0.0), (0.0, 0.3 * thick), (0.003, thick))
    parts = [loft([rectangle(width - inset, depth - inset, z, 0.006) for inset, z in sizes])]
    for row, column in product(range(rows), range(4)):
        ink = {(0, 3): "red", (rows - 1, 3): "orange"}.get((row, column), keys)
        x, y = (column - 1.5) * pitch_x, middle + (rows / 2 - row - 0.5) * pitch_y
        parts.append(panel(0.76 * pitch_x, 0.68 * pitch_y, thick, ink, x, y, 0.0022))
    parts.append(panel(0.86 * width, 0.16 * depth, thick, "#a9b79c", y=0.31 * depth))
    parts.append(digits("1280", 0.1 * depth, thick + 0.0008, "black").moved(0.2 * width, 0.31 * depth))
    parts.append(panel(0.36 * width, 0.05 * depth, thick, "#4a2f2b", 0.22 * width, 0.44 * depth))
    solid = join(parts)
    if size == "desk":
        side = [(-0.46 * depth, 0.0), (0.46 * depth, 0.0), (0.46 * depth, 0.023), (-0.46 * depth, 0.003)]
        rise = math.degrees(math.atan2(0.02, 0.92 * depth))
        solid = solid.moved(y=0.46 * depth).turned(x=rise).moved(y=-0.46 * depth, z=0.0024)
        solid += silhouette(side, 0.92 * width).turned(z=90)
    captions = fix_articles(f"a {color} {size} calculator with {keys} keys", f"{color} calculator", f"{size} calculator")
    return AssetDesign(solid, "electronics", color, captions, density=700.0)


def hole_punch(draw: VariantSampler) -> AssetDesign:
    """A two-hole punch, its lever lifted at the viewer's side."""
    width, depth = draw.between(0.1, 0.13), draw.between(0.1, 0.13)
    color, lift = draw.pick("black", "blue", "red", "grey", "green", "white"), draw.between(0.022, 0.034)
    base = slab(width, depth, 0.012, 0.003).painted("black" if color != "black" else "grey")
    posts = [box(0.02, 0.34 * depth, 0.04).moved(x * 0.36 * width, 0.2 * depth, 0.008) for x in (-1, 1)]
    pins = [lathe([(0.006, 0.008), (0.006, 0.05)]).moved(x * 0.36 * width, 0.0) for x in (-1, 1)]
    rail = box(0.9 * width, 0.16 * depth, 0.01).moved(0.0, 0.02 * depth, 0.016)
    metal = join([*posts, *pins, rail]).painted("silver")
    lever = [(-0.46, 0.02 + lift), (-0.42, 0.034 + lift), (0.28, 0.056), (0.4, 0.048), (0.4, 0.036)]
    guide = box(0.5 * width, 0.014, 0.004).moved(0.62 * width, 0.34 * depth, 0.004).painted("silver")
    solid = join([base, metal, guide, silhouette(scaled(lever, depth, 1.0), 0.86 * width).turned(z=90)])
    captions = fix_articles(
        f"a {color} two-hole punch", f"{color} hole punch", "hole punch with a lever", "paper punch for binders"
    )
    return AssetDesign(solid, "metal", color, captions, density=1300.0)


FAMILIES = (
    file_tray, file_holder, pen_holder, desk_organizer, stapler, tape_dispenser, scissors, ruler, calculator,
    hole_punch,
)  # fmt: skip
