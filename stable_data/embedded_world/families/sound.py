"""Speakers, headphones, microphones and radios."""

import math

from stable_data.embedded_world.families.displays import digits
from stable_data.embedded_world.families.palette import DARK_GLASS
from stable_data.embedded_world.families.wording import fix_articles
from stable_data.embedded_world.modelling.family import AssetDesign, VariantSampler
from stable_data.embedded_world.modelling.shapes import arc_points, disc, panel, scaled, silhouette
from stable_data.embedded_world.modelling.solids import bar, box, join, lathe, slab


def headphones(draw: VariantSampler) -> AssetDesign:
    """Headphones, folded flat on the table or hung on a stand."""
    kind, reach = draw.pick("flat", "stand"), draw.between(0.072, 0.082)
    color, second = draw.pick("black", "white", "red", "silver", "blue", "pink"), draw.pick("#4a4f55", "cream", "brown")
    r, arc = draw.between(0.034, 0.041), [math.radians(a) for a in range(0, 181, 18)]
    path = [(reach, -0.024), *((reach * math.cos(a), reach * 1.06 * math.sin(a)) for a in arc), (-reach, -0.024)]
    band = bar(path, 0.022, 0.007, 8)
    pillow = bar([(0.985 * x, 0.985 * z - 0.002) for x, z in path[4:9]], 0.026, 0.011, 8).painted(second)
    shell = lathe([(0.8 * r, 0.0), (r, 0.005), (r, 0.014)])
    cushion = lathe([(0.98 * r, 0.0135), (0.98 * r, 0.024), (0.8 * r, 0.029)], 32).painted(second)
    ear = shell + cushion + lathe([(0.45 * r, 0.028), (0.45 * r, 0.0296)], 24).painted("#24272b")
    if kind == "flat":
        ears = [ear.moved(x * (reach - 0.004), -0.012 - r) for x in (-1, 1)]
        solid = join([(band + pillow).turned(x=-90).moved(z=0.0134), *ears])
    else:
        high = draw.between(0.2, 0.25)
        metal = [lathe([(0.075, 0.0), (0.075, 0.008), (0.06, 0.016)]), box(0.022, 0.014, high).moved(z=0.01)]
        metal.append(disc(0.03, -0.022, 0.022, 24).turned(x=90).moved(z=high))
        hung = join([band, pillow, *(ear.turned(y=-90 * x).moved(x * (reach + 0.012), 0.0, -0.018 - r) for x in (-1, 1))])
        solid = hung.moved(z=high + 0.03 - 1.06 * reach + 0.006) + join(metal).painted(draw.pick("oak", "silver", "black"))
    where = "on a stand" if kind == "stand" else "lying flat"
    captions = (f"{color} headphones {where}", f"{color} headphones", f"over-ear headphones {where}")
    return AssetDesign(solid, "plastic", color, captions, density=600.0)


def speaker(draw: VariantSampler) -> AssetDesign:
    """A loudspeaker: a shelf box, a portable cylinder or a smart speaker."""
    kind, r = draw.pick("bookshelf", "portable", "smart"), draw.between(0.034, 0.045)
    color = draw.pick("black", "walnut", "grey", "white", "red", "blue")
    trim = "black" if color != "black" else "grey"
    if kind == "bookshelf":
        width, depth, high = 3.7 * r, 3.9 * r, 6.2 * r
        rim = lathe([(1.45 * r, 0.0), (1.45 * r, 0.003), (1.3 * r, 0.005)]).painted("#2a2d31")
        cone = lathe([(1.15 * r, 0.004), (1.15 * r, 0.0062)]).painted("#6b7177")
        dome = lathe([(0.45 * r, 0.006), (0.2 * r, 0.012)]).painted("black")
        ring = lathe([(0.7 * r, 0.0), (0.7 * r, 0.003)]).painted("#2a2d31")
        tweeter = (ring + lathe([(0.35 * r, 0.002), (0.15 * r, 0.008)], 20).painted("silver")).moved(y=1.55 * r)
        board = box(width - 0.01, high - 0.01, 0.002).moved(z=-0.001).painted("#3b3f44")
        face = join([join([rim, cone, dome]).moved(y=-1.1 * r), tweeter, board])
        solid = box(width, depth, high, 0.004) + face.turned(x=90).moved(0.0, -depth / 2, high / 2)
        name = "bookshelf speaker with two drivers"
    elif kind == "portable":
        n, r = 4.6 * r, 0.95 * r
        tube = disc(r, -0.46 * n, 0.46 * n, 24)
        cap = lathe([(1.04 * r, 0.0), (1.04 * r, 0.014), (0.9 * r, 0.02)], 24).painted(trim)
        caps = [cap.moved(z=0.44 * n), cap.turned(x=180).moved(z=-0.44 * n)]
        turned = join([tube, *caps]).turned(z=7.5).turned(y=90).moved(z=1.04 * r + 0.002)
        badge = panel(0.3 * n, 0.4 * r, 0.0, "white" if color != "white" else "red", rise=0.0012)
        badge = badge.turned(x=90).moved(0.0, -r, 1.04 * r + 0.002)
        pads = slab(0.6 * n, 1.1 * r, 0.4 * r, 0.002).painted(trim)
        buttons = [
            lathe([(0.006, 0.0), (0.006, 0.005)], 12).moved(x * 0.02, 0.0, 2.04 * r).painted("white") for x in (-1, 0, 1)
        ]
        solid, name = join([turned, badge, pads, *buttons]), "portable speaker"
    else:
        high = r * draw.pick(1.7, 3.2)
        solid = lathe([(1.1 * r, 0.0), (1.2 * r, 0.006), (1.2 * r, high - 0.008), (1.1 * r, high)])
        solid += lathe([(1.21 * r, high - 0.02), (1.21 * r, high - 0.014)]).painted("#59b7e8")
        dot = lathe([(0.005, high - 0.001), (0.005, high + 0.0012)], 12).moved(x=0.45 * r).painted("grey")
        rubber = lathe([(1.22 * r, 0.0), (1.22 * r, 0.008)]).painted(trim)
        solid = join([solid, rubber, *(dot.turned(z=turn) for turn in (0, 90, 180, 270))])
        name = "smart speaker with a light ring"
    captions = fix_articles(f"a {color} {name}", f"{color} speaker", f"{kind} loudspeaker")
    return AssetDesign(solid, "electronics", color, captions, density=600.0)


def microphone(draw: VariantSampler) -> AssetDesign:
    """A microphone on a desk stand."""
    kind, r = draw.pick("capsule", "ball-head", "studio"), draw.between(0.022, 0.03)
    color, mesh = draw.pick("black", "silver", "white", "red"), draw.pick("grey", "silver", "gold")
    mesh = "#5d6470" if mesh == color else mesh
    base, stem = lathe([(0.075, 0.0), (0.075, 0.008), (0.055, 0.018)]), draw.between(0.09, 0.14)
    if kind == "capsule":
        body = lathe([(0.8 * r, 0.0), (r, 0.006), (r, 2.2 * r)])
        grille = lathe([(0.97 * r, 2.19 * r), (0.97 * r, 4.0 * r), (0.8 * r, 4.6 * r), (0.4 * r, 4.9 * r)]).painted(mesh)
        ring = lathe([(1.06 * r, 2.1 * r), (1.06 * r, 2.3 * r)]).painted("gold" if mesh != "gold" else "silver")
        head = join([body, grille, ring]).moved(z=stem)
    elif kind == "ball-head":
        grille = lathe(arc_points(r, (-60, -35, -12, 12, 35, 60, 80)), 32).painted(mesh)
        handle = lathe([(0.45 * r, -4.6 * r), (0.82 * r, -0.7 * r)])
        band = lathe([(1.04 * r, -0.08 * r), (1.04 * r, 0.08 * r)]).painted("silver")
        clip = lathe([(0.7 * r, -3.2 * r), (0.8 * r, -2.2 * r)], 20).painted("#2a2d31")
        head = join([grille, handle, band, clip]).turned(x=42).moved(y=-1.7 * r, z=stem + 2.1 * r)
    else:
        body = lathe([(0.9 * r, 0.0), (r, 0.1 * r), (r, 2.0 * r), (0.98 * r, 2.2 * r)])
        grille = lathe([(0.96 * r, 2.1 * r), (0.96 * r, 3.6 * r), (0.6 * r, 4.2 * r)]).painted(mesh)
        half = [(0.9 * r, -0.6 * r), (1.5 * r, 0.0), (1.5 * r, 3.0 * r)]
        yoke = [*((-x, z) for x, z in reversed(half)), *half]
        pin = disc(0.3 * r, -1.7 * r, 1.7 * r, 12).turned(y=90).moved(z=1.5 * r).painted("silver")
        head = join([body, grille, bar(yoke, 0.014, 0.006, 8), pin]).moved(z=stem + 0.6 * r)
    rod = lathe([(0.006, 0.01), (0.006, stem + 0.004)]).painted("grey")
    captions = fix_articles(
        f"a {color} {kind} microphone on a desk stand", f"{color} microphone", "microphone for recording a voice"
    )
    return AssetDesign(join([base, rod, head]), "electronics", color, captions)


def radio(draw: VariantSampler) -> AssetDesign:
    """A portable radio with a handle or an aerial."""
    kind, width = draw.pick("retro", "portable", "clock"), draw.between(0.17, 0.25)
    high, depth = width * {"retro": 0.66, "portable": 0.56, "clock": 0.42}[kind], width * draw.between(0.3, 0.38)
    color, grille = draw.pick("walnut", "teal", "red", "cream", "black", "yellow"), draw.pick("#d9c7a3", "#4a4f55", "silver")
    edge = [(-0.5, 0.0), (0.5, 0.0), (0.5, 0.82), (0.44, 0.95), (0.36, 1.0), (-0.36, 1.0), (-0.44, 0.95), (-0.5, 0.82)]
    solid = silhouette(scaled(edge, width, high), depth)
    face = [panel(0.44 * width, 0.62 * high, 0.0, grille, -0.22 * width)]
    face += [panel(0.42 * width, 0.016 * width, 0.0008, color, -0.22 * width, (k - 2) * 0.11 * high) for k in range(5)]
    knob = lathe([(0.085 * width, -0.001), (0.075 * width, 0.012)]) + panel(
        0.012 * width, 0.06 * width, 0.012, "white", y=0.035 * width
    )
    if kind == "clock":
        shown = panel(0.42 * width, 0.36 * high, 0.0, DARK_GLASS, 0.24 * width, 0.12 * high)
        face += [shown, digits("6:45", 0.22 * high, 0.0008, "#f05a4a").moved(0.24 * width, 0.12 * high)]
        face.append(knob.painted("silver").moved(0.24 * width, -0.26 * high))
    else:
        strip = panel(0.4 * width, 0.18 * high, 0.0, "cream" if color != "cream" else "white", 0.25 * width, 0.24 * high)
        needle = panel(0.006, 0.15 * high, 0.0008, "red", 0.3 * width, 0.24 * high)
        ticks = [panel(0.002, 0.06 * high, 0.0008, "black", (0.1 + 0.05 * k) * width, 0.26 * high, 0.0004) for k in range(7)]
        knob = knob.painted("gold" if kind == "retro" else "black")
        face += [strip, needle, *ticks, *(knob.moved(x * width, -0.16 * high) for x in (0.14, 0.36))]
    solid += join(face).turned(x=90).moved(0.0, -depth / 2, high / 2)
    if kind == "retro":
        half = ((0.26, 0.22), (0.34, 0.16), (0.36, -0.02))
        path = [(x * width, (1.0 + z) * high) for x, z in (*((-x, z) for x, z in reversed(half)), *half)]
        solid += bar(path, 0.018, 0.01, 8).painted("brown" if color != "walnut" else "gold")
    else:
        rod = lathe([(0.0035, 0.0), (0.0022, 0.8 * width), (0.004, 0.801 * width), (0.004, 0.83 * width)], 12).turned(y=-38)
        solid += rod.moved(0.38 * width, 0.3 * depth, high - 0.006).painted("silver")
    detail = "a handle" if kind == "retro" else "a silver aerial"
    captions = fix_articles(f"a {color} {kind} radio with {detail}", f"{color} radio", f"{kind} radio")
    return AssetDesign(solid, "electronics", color, captions, density=450.0)


FAMILIES = (headphones, speaker, microphone, radio)
