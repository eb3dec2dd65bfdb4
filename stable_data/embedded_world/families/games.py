"""Games, puzzles and balls."""

import math

import numpy as np

from stable_data.embedded_world.families.wording import fix_articles
from stable_data.embedded_world.modelling.family import AssetDesign, SupportArea, VariantSampler
from stable_data.embedded_world.modelling.shapes import arc_points, ellipsoid, prism, round_body, silhouette
from stable_data.embedded_world.modelling.solids import Solid, box, chain, join, loft, rectangle, slab

_STICKERS = ("red", "white", "blue", "orange", "green", "yellow")


def puzzle_cube(draw: VariantSampler) -> AssetDesign:
    """A cube puzzle of coloured stickers, solved or mixed; on some the top layer is half turned."""
    size, layers = draw.between(0.05, 0.06), draw.pick(3, 3, 2, 3, 3, 2)
    state = draw.pick("solved", "mixed", "half-turned", "mixed", "half-turned", "solved")
    color = draw.pick("black", "black", "white")
    cell, seed = size / layers, draw.pick(1, 2, 4, 5, 7, 8)
    turn = 35.0 if state == "half-turned" else 0.0
    split = size - cell if turn else size
    sticker = box(0.84 * cell, 0.84 * cell, 0.003, 0.1 * cell)
    lower = [slab(size, size, split + (0.0006 if turn else 0.0), 0.0012)]
    upper = [slab(size, size, cell, 0.0012).moved(z=split)] if turn else []
    for face in range(4):
        for i in range(layers):
            for j in range(layers):
                tint = face if state == "solved" else (seed * (i + 2 * j) + 3 * face + i * j) % 6
                tile = sticker.painted(_STICKERS[tint]).moved(
                    (i + 0.5) * cell - size / 2, (j + 0.5) * cell - size / 2, size / 2 - 0.0019
                )
                tile = tile.turned(x=90).turned(z=90 * face).moved(z=size / 2)
                (upper if turn and j == layers - 1 else lower).append(tile)
    for i in range(layers):
        for j in range(layers):
            tint = 5 if state == "solved" else (seed + 2 * i + 3 * j + i * j) % 6
            tile = sticker.painted(_STICKERS[tint]).moved(
                (i + 0.5) * cell - size / 2, (j + 0.5) * cell - size / 2, size - 0.0019
            )
            (upper if turn else lower).append(tile)
    solid = join(lower) + join(upper).turned(z=turn) if turn else join(lower)
    captions = fix_articles(
        f"a {state} puzzle cube, {layers} by {layers}",
        "colourful twisty puzzle cube",
        f"{color} puzzle cube with coloured stickers",
    )
    return AssetDesign(solid, "plastic", color, captions, density=600.0)


_LATITUDES = (-70, -56, -40, -24, -8, 8, 24, 40, 56, 72, 86)
"""Degrees of the corners of a ball's profile."""


def _cut_low(seam: Solid, low: float) -> Solid:
    """Cuts a seam where it extends below the flat of the ball."""
    part = np.vstack(seam.parts)
    above = part[part[:, 2] > -low + 0.0008]
    return Solid(chain([above[: len(above) // 2], above[len(above) // 2 :]]).body, (above,)).painted(seam.paints[0][1])


def _seams(kind: str, more: float, radius: float, color: str) -> list[Solid]:
    """The seams of a basketball, or the two curves of a tennis ball."""
    seam = round_body([(more, -0.0013), (more, 0.0013)], 32).painted(color)
    if kind == "basketball":
        return [seam, seam.turned(y=90), seam.turned(x=90)]
    rim = 0.8 * radius
    profile = [(math.sqrt(more**2 - (rim - 0.0013) ** 2), rim - 0.0013), (math.sqrt(more**2 - rim**2), rim + 0.0013)]
    curve = round_body(profile, 32).painted(color)
    return [curve.turned(x=62, z=20), curve.turned(x=-75, z=-24)]


def _gores(more: float, radius: float) -> list[Solid]:
    """The coloured gores of a beach ball, from pole to pole."""
    gores = []
    for k, tint in enumerate(("red", "yellow", "blue")):
        arcs = [
            [(x * math.cos(turn), x * math.sin(turn), z) for x, z in arc_points(more, (-60, *_LATITUDES[2:]))]
            for turn in np.radians(120 * k + np.array([0, 12, 24, 36, 48, 60]))
        ]
        near = [*arcs[0], *arcs[1], *arcs[2], (0.0, 0.0, -0.8 * radius), (0.0, 0.0, 0.9 * radius)]
        gores.append(chain([np.array(near), np.array([*arcs[3], *arcs[4], *arcs[5]])]).painted(tint))
    return gores


def _patches(kind: str, more: float, radius: float, color: str) -> list[Solid]:
    """The pentagons of a football, or dots in their places."""
    if kind == "football":
        patch = round_body([(0.36 * radius, 0.86 * radius), (0.33 * radius, more)], 5).painted(color)
    else:
        patch = round_body([(0.24 * radius, 0.9 * radius), (0.22 * radius, more + 0.0008)], 12).painted(color)
    upper, lower = ([patch.turned(y=y, z=72 * k + z) for k in range(5)] for y, z in ((63.4, 0), (116.6, 36)))
    return [patch, *upper, *lower]


def ball(draw: VariantSampler) -> AssetDesign:
    """A small ball, flat where it rests."""
    radius = draw.between(0.034, 0.055)
    kind = draw.pick("football", "basketball", "beach ball", "tennis ball", "striped ball", "dotted ball")
    colors = {"football": "white", "basketball": "orange", "beach ball": "white", "tennis ball": "#c9d94f"}
    color = colors.get(kind) or draw.pick("red", "blue", "purple", "teal")
    accents = {"football": "black", "basketball": "black", "tennis ball": "white"}
    accent = accents.get(kind) or draw.pick("yellow", "white", "pink")
    body = round_body(arc_points(radius, _LATITUDES), 32)
    low, more = radius * math.sin(math.radians(70)), radius + 0.0008
    if kind in ("basketball", "tennis ball"):
        parts = [_cut_low(seam, low) for seam in _seams(kind, more, radius, accent)]
    elif kind == "beach ball":
        parts = _gores(more, radius)
    elif kind == "striped ball":
        stripes = ((-30, -22, -14), (4, 12, 20), (38, 46, 54))
        parts = [round_body(arc_points(more, degrees), 32).painted(accent) for degrees in stripes]
    else:
        parts = _patches(kind, more, radius, accent)
    name = {"#c9d94f": "yellow-green"}.get(color, color)
    captions = (f"a small {name} {kind}", f"toy {kind}", f"{kind} in {name} and {accent}")
    return AssetDesign(join([body, *parts]).moved(z=low), "rubber", color, captions, density=300.0)


def board_game(draw: VariantSampler) -> AssetDesign:
    """The box of a board game, its lid printed."""
    width, depth = draw.pick((0.26, 0.26), (0.3, 0.2), (0.19, 0.13), (0.27, 0.19), (0.22, 0.22), (0.36, 0.24))
    height = draw.between(0.04, 0.068)
    color = draw.pick("red", "navy", "green", "purple", "orange", "teal")
    accent = draw.pick("yellow", "white", "red")
    ground = draw.pick("cream", "white")
    accent = "white" if color == accent else accent
    base = box(width - 0.005, depth - 0.005, 0.5 * height)
    lid = slab(width, depth, 0.74 * height, 0.0015).moved(z=0.26 * height)
    top = height - 0.0012
    title = box(0.7 * width, 0.16 * depth, 0.002, 0.004).moved(0.0, 0.28 * depth, top).painted(accent)
    board = box(0.62 * width, 0.46 * depth, 0.002).moved(0.0, -0.13 * depth, top).painted(ground)
    cell, tints = 0.09 * depth, ("red", "blue", "green", "yellow", "black")
    tiles = [
        box(0.92 * cell, 0.92 * cell, 0.002)
        .moved((i - 2) * 1.2 * cell, -0.13 * depth + (j - 1) * 1.3 * cell, top + 0.0006)
        .painted(tints[(i + 2 * j) % 5])
        for i in range(5)
        for j in range(3)
    ]
    label = box(0.6 * width, 0.004, 0.3 * height).moved(0.0, 0.0008 - depth / 2, 0.48 * height).painted(accent)
    captions = fix_articles(
        f"a board game in its {color} box",
        f"{color} board game box",
        f"flat game box with a {accent} title",
        "boxed family game",
    )
    solid = join([base.painted(ground), lid, title, board, *tiles, label])
    top_space = SupportArea(0.62 * width, 0.46 * depth, top + 0.0026, y=-0.13 * depth)
    return AssetDesign(solid, "cardboard", color, captions, top=top_space, density=260.0)


_PIPS = {1: ((0, 0),), 2: ((-1, -1), (1, 1)), 3: ((-1, -1), (0, 0), (1, 1)), 4: ((-1, -1), (-1, 1), (1, -1), (1, 1))}
_PIPS |= {5: (*_PIPS[4], (0, 0)), 6: (*_PIPS[4], (-1, 0), (1, 0))}


def dice(draw: VariantSampler) -> AssetDesign:
    """A die with raised pips; on its lower face it has none."""
    size, up = draw.between(0.018, 0.03), draw.pick(6, 5, 4, 3, 2, 1)
    color, pip = draw.pick("white", "red", "blue", "black", "green", "oak"), "black"
    pip = "white" if color in ("red", "blue", "black", "green") else pip
    # Opposite faces of a die add up to seven.
    around = [n for n in range(1, 7) if n not in (up, 7 - up)]
    numbers = (around[0], around[1], 7 - around[0], 7 - around[1])
    dot = round_body([(0.085 * size, size / 2 - 0.0008), (0.08 * size, size / 2 + 0.0007)], 8).painted(pip)

    def pips(number: int) -> Solid:
        return join([dot.moved(0.25 * size * x, 0.25 * size * y) for x, y in _PIPS[number]])

    sides = [pips(n).turned(x=90).turned(z=90 * k) for k, n in enumerate(numbers)]
    body = join([slab(size, size, size, 0.09 * size), *(face.moved(z=size / 2) for face in (*sides, pips(up)))])
    captions = (f"{color} die that shows {up}", f"{color} dice with {pip} pips", "die for board games", "six-sided die")
    return AssetDesign(body, "wood" if color == "oak" else "plastic", color, captions)


def _suit(kind: str, size: float) -> list[Solid]:
    """A flat sign of a suit around the origin, point to +y or -y."""
    lobe, square = round_body([(0.5 * size, 0.0), (0.5 * size, 0.0022)], 16), box(size, size, 0.0022).turned(z=45)
    if kind == "diamond":
        return [prism([(0, -1.2 * size), (0.85 * size, 0), (0, 1.2 * size), (-0.85 * size, 0)], 0.0, 0.0022)]
    if kind == "heart":
        return [square, *(lobe.moved(side * 0.354 * size, 0.354 * size) for side in (-1, 1))]
    foot_plan = [(-0.45 * size, -1.15 * size), (0.45 * size, -1.15 * size), (0.06 * size, 0.0), (-0.06 * size, 0.0)]
    foot = prism(foot_plan, 0.0003, 0.0019)
    if kind == "spade":
        return [square, *(lobe.moved(side * 0.354 * size, -0.354 * size) for side in (-1, 1)), foot]
    return [
        foot,
        lobe.moved(y=0.48 * size),
        *(lobe.moved(side * 0.48 * size, -0.2 * size) for side in (-1, 1)),
        round_body([(0.25 * size, 0.0), (0.25 * size, 0.0022)], 8),
    ]


def card_deck(draw: VariantSampler) -> AssetDesign:
    """A pack of playing cards, in its box or as a loose stack; it lies along y."""
    is_boxed = draw.pick(True, False, True, True, False, True)
    suit = draw.pick("diamond", "heart", "spade", "club", "heart", "diamond")
    color = draw.pick("red", "blue", "black", "green", "purple", "navy")
    width, depth, height = 0.063, 0.088, draw.between(0.014, 0.02)
    tint = "red" if suit in ("diamond", "heart") else "black"
    parts: list[Solid] = []
    if is_boxed:
        width, depth = width + 0.003, depth + 0.003
        parts.append(box(width, depth, height))
        parts.append(box(0.82 * width, 0.82 * depth, 0.0022, 0.004).moved(z=height - 0.0011).painted("white"))
        parts.append(box(0.3 * width, 0.0035, 0.6 * height).moved(0.0, 0.0008 - depth / 2, 0.2 * height).painted("white"))
        top = height + 0.0011
    else:
        heap = box(width, depth, 0.2 * height + 0.0004).painted("white")
        slips = ((0.0, 0.0), (1.6, 0.0008), (-1.2, -0.001), (0.8, 0.0006), (-2.2, 0.0))
        parts += [heap.turned(z=turn).moved(x, 0.0, 0.2 * height * k) for k, (turn, x) in enumerate(slips)]
        face = box(0.86 * width, 0.9 * depth, 0.0022, 0.003).moved(z=height - 0.0008)
        parts.append(face.turned(z=-2.2))
        parts.append(box(0.6 * width, 0.66 * depth, 0.0022, 0.008).turned(z=-2.2).moved(z=height + 0.0002).painted("white"))
        top, tint = height + 0.0024, color
    mark = [one.moved(z=top - 0.0012).painted(tint) for one in _suit(suit, 0.0125)]
    words = f"box of playing cards with a {suit}" if is_boxed else "loose stack of playing cards"
    captions = (f"a {color} {words}", f"{color} deck of cards", "pack of playing cards", "card deck")
    return AssetDesign(join([*parts, *mark]), "paper", color, captions)


def chess_piece(draw: VariantSampler) -> AssetDesign:
    """A chess piece."""
    kind = draw.pick("pawn", "rook", "knight", "bishop", "queen", "king")
    color, s = draw.pick("cream", "black", "walnut", "white", "oak", "#5a3a2a"), draw.between(0.9, 1.35)
    tall = {"pawn": 0.042, "rook": 0.048, "knight": 0.05, "bishop": 0.06, "queen": 0.068, "king": 0.072}[kind]
    foot = 0.0145 if kind == "pawn" else 0.017
    neck = {"pawn": 0.52, "rook": 0.62, "knight": 0.3, "bishop": 0.6, "queen": 0.68, "king": 0.68}[kind] * tall
    slim = 0.0055 if kind == "pawn" else 0.0068
    profile = [(foot, 0.0), (foot, 0.005), (0.82 * foot, 0.008), (0.86 * foot, 0.0095), (0.62 * foot, 0.014), (slim, neck)]
    if kind == "knight":
        profile = [(foot, 0.0), (foot, 0.005), (0.82 * foot, 0.008), (0.86 * foot, 0.0095), (0.78 * foot, neck)]
    collar = [(slim, neck - 0.001), (1.6 * slim, neck + 0.001), (1.6 * slim, neck + 0.0025), (slim, neck + 0.0045)]
    parts = [round_body(profile, 32)] + ([] if kind in ("knight", "rook") else [round_body(collar, 24)])
    if kind == "pawn":
        parts.append(ellipsoid(0.0098, 0.0098, 0.0098).moved(z=neck + 0.011))
    elif kind == "rook":
        parts.append(round_body([(slim, neck - 0.002), (0.0125, neck + 0.006), (0.0125, neck + 0.013)], 24))
        notch = box(0.0065, 0.0055, 0.0065)
        parts += [notch.moved(0.0091).turned(z=60 * k).moved(z=neck + 0.012) for k in range(6)]
    elif kind == "knight":
        outline = [(-0.0105, 0.0), (0.009, 0.0), (0.0095, 0.014), (0.004, 0.028), (-0.004, 0.03)]
        parts.append(silhouette([(x, z + neck - 0.002) for x, z in outline], 0.0125))
        snout = [(-0.006, 0.03), (0.002, 0.021), (0.0145, 0.0125), (0.0185, 0.0165), (0.0155, 0.022), (0.003, 0.0325)]
        parts.append(silhouette([(x, z + neck - 0.002) for x, z in snout], 0.0105))
        parts += [
            loft([rectangle(0.005, 0.004, 0.0), rectangle(0.0016, 0.0016, 0.007)]).moved(-0.001, y, neck + 0.028)
            for y in (-0.003, 0.003)
        ]
        parts += [
            box(0.003, 0.0165 - 0.001 * k, 0.005).moved(-0.0085 + 0.0012 * k, 0.0, neck + 0.004 + 0.007 * k) for k in range(3)
        ]
        parts = [part.turned(z=-90) for part in parts]
    elif kind == "bishop":
        parts.append(
            round_body([(0.0062, neck + 0.003), (0.0092, neck + 0.009), (0.0075, neck + 0.016), (0.002, neck + 0.0225)], 24)
        )
        parts.append(ellipsoid(0.0028, 0.0028, 0.0028, 10).moved(z=neck + 0.0235))
    else:
        parts.append(round_body([(0.0062, neck + 0.003), (0.0112, neck + 0.016), (0.0095, neck + 0.0185)], 24))
        if kind == "queen":
            parts += [
                ellipsoid(0.0026, 0.0026, 0.003, 8).moved(0.0092).turned(z=45 * k).moved(z=neck + 0.0185) for k in range(8)
            ]
            parts.append(ellipsoid(0.0036, 0.0036, 0.0036, 10).moved(z=neck + 0.0205))
        else:
            parts.append(round_body([(0.0095, neck + 0.018), (0.003, neck + 0.022)], 16))
            parts += [box(0.0038, 0.0034, 0.0135).moved(z=neck + 0.02), box(0.0105, 0.0032, 0.0038).moved(z=neck + 0.0262)]
    name = {"#5a3a2a": "dark brown"}.get(color, color)
    captions = (f"{name} chess {kind}", f"{name} chess piece, a {kind}", f"wooden {kind} of a chess set")
    return AssetDesign(join(parts).resized(s), "wood", color, captions)


FAMILIES = (puzzle_cube, ball, board_game, dice, card_deck, chess_piece)
