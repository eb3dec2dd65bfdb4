"""Computers, monitors and input devices."""

import math

import numpy as np

from stable_data.embedded_world.families.displays import WALLPAPERS, lit_screen
from stable_data.embedded_world.families.wording import fix_articles
from stable_data.embedded_world.modelling.family import AssetDesign, SupportArea, VariantSampler
from stable_data.embedded_world.modelling.shapes import panel, prism, silhouette
from stable_data.embedded_world.modelling.solids import Solid, box, join, lathe, loft, slab


def _keys(width: float, depth: float, z: float, columns: int, rows: int, caps: str, middle: float) -> Solid:
    """A field of keys with a space bar: a plate in the colour of the caps under a grid in that of the body."""
    gap = 0.0028
    field = panel(width, depth, z, caps)
    bars = [box(gap, depth + gap, 0.0028).moved((k / columns - 0.5) * width, 0.0, z - 0.0012) for k in range(columns + 1)]
    bars += [box(width + gap - 4e-4, gap, 0.0026).moved(0.0, (k / rows - 0.5) * depth, z - 0.0012) for k in range(rows + 1)]
    pitch = width / columns
    space = panel(5.4 * pitch, 0.8 * depth / rows, z, caps, (middle - 0.5) * pitch, (0.5 / rows - 0.5) * depth, 0.0022)
    return join([field, *bars, space])


def laptop(draw: VariantSampler) -> AssetDesign:
    """A laptop, open or closed."""
    width, kind = draw.between(0.29, 0.38), draw.pick("open", "open", "closed")
    depth, opening = width * draw.between(0.64, 0.7), draw.between(98.0, 122.0)
    color, caps = draw.pick("silver", "black", "grey", "white", "navy", "pink"), draw.pick("black", "black", "white")
    captions = fix_articles(f"a {kind} {color} laptop", f"{color} laptop", f"{kind} notebook computer")
    if kind == "closed":
        hinge = box(0.7 * width, 0.012, 0.009).moved(0.0, depth / 2 - 0.007, 0.006)
        lid = slab(width, depth, 0.0085, 0.002).moved(z=0.0115) + hinge
        logo = lathe([(0.02, 0.018), (0.02, 0.0206)]).moved(y=0.33 * depth).painted("white" if color != "white" else "grey")
        seam = box(width - 0.004, depth - 0.004, 0.004).moved(z=0.009).painted("black")
        top = SupportArea(0.9 * width, 0.65 * depth, 0.02, y=-0.13 * depth)
        return AssetDesign(join([slab(width, depth, 0.0108, 0.002), seam, lid, logo]), "electronics", color, captions, top=top)
    keys = _keys(0.86 * width, 0.44 * depth, 0.015, 13, 5, caps if color != "black" else "grey", 0.0).moved(y=0.12 * depth)
    pad = panel(0.34 * width, 0.25 * depth, 0.015, "#8d949a" if color != "grey" else "silver", y=-0.3 * depth)
    long = 0.94 * depth
    lid = slab(width, long, 0.008, 0.002) + lit_screen(0.95 * width, 0.9 * long, 0.008, draw.pick(*WALLPAPERS))
    screen = lid.moved(y=long / 2).turned(x=180 - opening).moved(0.0, depth / 2 - 0.009, 0.011)
    hinge = box(0.7 * width, 0.012, 0.016).moved(0.0, depth / 2 - 0.008, 0.002).painted("black")
    return AssetDesign(join([slab(width, depth, 0.015, 0.003), keys, pad, hinge, screen]), "electronics", color, captions)


def monitor(draw: VariantSampler) -> AssetDesign:
    """A computer monitor on its stand."""
    width, kind = draw.between(0.46, 0.62), draw.pick("wide", "ultra-wide", "square")
    height = {"wide": 0.57, "ultra-wide": 0.43, "square": 0.76}[kind] * width * (0.75 if kind == "square" else 1.0)
    width *= {"wide": 1.0, "ultra-wide": 1.25, "square": 0.75}[kind]
    color, stand = draw.pick("black", "silver", "white", "grey"), draw.pick("round", "plate", "two-legged")
    bezel, lift = draw.between(0.008, 0.018), draw.between(0.09, 0.14)
    front = box(width, height, 0.03, 0.004) + box(0.5 * width, 0.5 * height, 0.03).moved(z=-0.02)
    lit = lit_screen(width - 2 * bezel, height - 2 * bezel - 0.008, 0.03, draw.pick(*WALLPAPERS)).moved(y=0.004)
    head = (front + lit).turned(x=90).moved(z=lift + height / 2)
    neck = box(0.05, 0.02, lift + 0.4 * height).moved(0.0, 0.024, 0.006)
    if stand == "round":
        foot = lathe([(0.115, 0.0), (0.115, 0.008), (0.1, 0.014)])
    elif stand == "plate":
        foot = slab(0.26, 0.2, 0.014, 0.004)
    else:
        legs = [(-0.014, -0.02), (0.014, -0.02), (0.012, 0.19), (-0.012, 0.19)]
        foot = slab(0.1, 0.08, 0.013, 0.003).moved(y=0.04)
        foot += join(prism(legs, 0.0, 0.012).turned(z=turn).moved(y=0.03) for turn in (-122, 122))
    name = "computer monitor" if kind == "wide" else f"{kind} computer monitor"
    captions = fix_articles(f"a {color} {name} on a stand", f"{color} monitor", f"computer screen with a {stand} foot")
    return AssetDesign(join([head, neck, foot.moved(y=0.014)]), "electronics", color, captions, density=420.0)


def tablet(draw: VariantSampler) -> AssetDesign:
    """A tablet computer: flat, with a pencil beside its screen, or leaning in its cover."""
    kind, width = draw.pick("flat", "propped", "with a stylus"), draw.between(0.15, 0.18)
    depth, thick = width * draw.between(1.3, 1.5), draw.between(0.008, 0.01)
    color, paper = draw.pick("black", "silver", "white", "grey", "blue", "pink"), draw.pick(*WALLPAPERS)
    wide, tall = (depth, width) if kind == "propped" else (width, depth)
    solid = slab(wide, tall, thick, 0.002) + lit_screen(wide - 0.01, tall - 0.012, thick, paper)
    icon = panel(0.04 * depth, 0.04 * depth, thick + 0.0012, "yellow", rise=0.0006)
    solid += join(
        icon.moved(k * 0.075 * depth, -0.42 * tall).painted(c)
        for k, c in zip((-2, -1, 0, 1, 2), ("yellow", "green", "red", "orange", "white"), strict=True)
    )
    if kind == "propped":
        slope = math.tan(math.radians(28))
        screen = solid.turned(x=90).moved(z=tall / 2 + 0.003).leaned(slope)
        flap = box(wide, 0.62 * tall, 0.004).moved(y=0.27 * tall).painted("brown")
        up, y = 0.6 * tall, 0.6 * tall * slope
        leg = [(0.56 * tall, 0.002), (0.56 * tall - 0.004, 0.0005), (y - 0.003, up), (y + 0.001, up)]
        lip = box(wide - 0.002, 0.008, 0.012).moved(y=-0.017).painted("brown")
        base = box(wide - 0.004, 0.03, 0.0038).moved(y=-0.01).painted("brown")
        solid = join([screen.moved(y=-0.004), flap, silhouette(leg, 0.8 * wide).turned(z=90).painted("brown"), lip, base])
    elif kind == "with a stylus":
        stylus = slab(0.009, 0.16, 0.0085, 0.002).moved(wide / 2 + 0.004)
        solid += stylus.painted("white" if color != "white" else "grey")
    name = {"flat": "tablet", "propped": "tablet leaning in its cover", "with a stylus": "tablet with a stylus"}[kind]
    captions = fix_articles(f"a {color} {name}", f"{color} tablet computer", f"touch-screen {name}")
    return AssetDesign(solid, "electronics", color, captions, density=1500.0)


def keyboard(draw: VariantSampler) -> AssetDesign:
    """A computer keyboard, rising a little to the back."""
    kind = draw.pick("full-size", "compact", "tenkeyless")
    width = {"full-size": 0.43, "compact": 0.29, "tenkeyless": 0.35}[kind] * draw.between(0.97, 1.04)
    depth = draw.between(0.105, 0.135)
    color, caps = draw.pick(
        ("black", "grey"), ("white", "grey"), ("silver", "white"), ("grey", "black"), ("navy", "cream"), ("white", "teal")
    )
    z, rows = 0.013, 5
    columns = {"full-size": 22, "compact": 14, "tenkeyless": 18}[kind]
    pitch, tall = (width - 0.016) / columns, depth - 0.018
    gaps = {"full-size": (15, 18), "compact": (), "tenkeyless": (15,)}[kind]
    fields = [_keys(columns * pitch, tall, z, columns, rows, caps, 7 - columns / 2)]
    fields += [box(0.9 * pitch, tall, 0.0032).moved((gap + 0.5 - columns / 2) * pitch, 0.0, z - 0.001) for gap in gaps]
    accent = draw.pick("red", "orange", "teal")
    x, y = (0.5 - columns / 2) * pitch, (0.5 - 0.5 / rows) * tall
    escape = panel(0.8 * pitch, 0.76 * tall / rows, z, accent, x, y, 0.0022)
    side = [(-depth / 2, 0.0), (depth / 2, 0.0), (depth / 2, 0.011), (-depth / 2, 0.003)]
    rise = silhouette(side, width - 0.001).turned(z=90)
    board = join([box(width, depth, z - 0.003, 0.004).moved(z=0.003), *fields, escape])
    tilted = board.moved(y=depth / 2).turned(x=3.6).moved(y=-depth / 2, z=-0.0004)
    captions = fix_articles(f"a {kind} {color} keyboard with {caps} keys", f"{color} keyboard", f"{kind} computer keyboard")
    return AssetDesign(rise + tilted, "electronics", color, captions, density=900.0)


def mouse(draw: VariantSampler) -> AssetDesign:
    """A computer mouse, its buttons away from the viewer."""
    n, kind = draw.between(0.1, 0.125), draw.pick("wireless", "gaming", "slim")
    width = n * draw.between(0.55, 0.62)
    high = {"wireless": 0.038, "gaming": 0.041, "slim": 0.026}[kind] * draw.between(0.92, 1.05)
    color, accent = draw.pick("black", "white", "grey", "red", "blue", "pink"), draw.pick("teal", "orange", "yellow")
    second = {"black": "#4a4f55", "white": "#cfd2d4", "grey": "#5d6470"}.get(color, "#2a2d31")
    shares = [(0.95, 0.0), (1.0, 0.16), (1.0, 0.4), (0.94, 0.66), (0.8, 0.86), (0.58, 0.97), (0.36, 1.0)]
    angle = 2 * np.pi * np.arange(28) / 28
    oval = 0.5 * np.stack([np.cos(angle), np.sin(angle)], axis=1)
    oval = np.sign(oval) * (np.abs(oval) / 0.5) ** 0.8 * 0.5 * (width, n)
    rings = [np.c_[s * oval + (0.0, -0.1 * (1 - s) * n), np.full(28, z * high)] for s, z in shares]
    buttons = loft([1.008 * ring[:15] + (0.0, 0.0, 4e-4) for ring in rings[1:]]).painted(second)
    ridge = [(0.504 * s * n - 0.1 * (1 - s) * n + 0.0008, z * high + 0.001) for s, z in shares[1:]]
    split = silhouette([*ridge, (-0.05 * n, high + 0.001), (-0.05 * n, 0.3 * high)], 0.0022).turned(z=90).painted("#16191d")
    wheel = lathe([(0.011, -0.004), (0.011, 0.004)], 20).turned(y=90).moved(0.0, 0.2 * n, 0.96 * high - 0.005)
    solid = loft(rings) + buttons + split + wheel.painted(accent if kind == "gaming" else "#555b61")
    if kind == "gaming":
        solid += loft([np.c_[1.02 * oval, np.full(28, z * high)] for z in (0.16, 0.28)]).painted(accent)
    captions = fix_articles(f"a {color} {kind} computer mouse", f"{color} mouse", f"{kind} mouse with a scroll wheel")
    return AssetDesign(solid, "electronics", color, captions, density=650.0)


def mouse_pad(draw: VariantSampler) -> AssetDesign:
    """A mat for a mouse."""
    width, kind = draw.between(0.2, 0.27), draw.pick("rectangular", "round", "wrist-rest")
    depth, thick = width * draw.between(0.78, 0.88), draw.between(0.003, 0.005)
    color, second = draw.pick("black", "navy", "teal", "red", "grey", "purple"), draw.pick("grey", "white", "black")
    second = "silver" if second == color else second
    if kind == "round":
        solid = lathe([(width / 2, 0.0), (width / 2, thick)]).painted(second)
        solid += lathe([(0.47 * width, 0.001), (0.47 * width, thick + 0.0008)])
        top = SupportArea(0.9 * width, 0.9 * width, thick + 0.0008, is_round=True)
    else:
        solid = box(width, depth, thick, 0.012).painted(second)
        solid += box(width - 0.008, depth - 0.008, thick - 4e-4, 0.01).moved(z=0.0012)
        top = SupportArea(0.9 * width, 0.9 * depth, thick + 0.0008)
    if kind == "wrist-rest":
        arch = [(-0.028, 0.0), (0.028, 0.0), (0.026, 0.01), (0.016, 0.018), (0.0, 0.021), (-0.016, 0.018), (-0.026, 0.01)]
        solid += silhouette(arch, 0.92 * width).turned(z=90).moved(y=-depth / 2 + 0.02).painted(second)
        top = SupportArea(0.9 * width, 0.9 * depth - 0.06, thick + 0.0008, y=0.03)
    name = "mouse pad with a wrist rest" if kind == "wrist-rest" else f"{kind} mouse pad"
    edge = f"{'and' if kind == 'wrist-rest' else 'with'} a {second} edge"
    captions = fix_articles(f"a {color} {name}", f"{color} mouse mat", f"{name} {edge}")
    return AssetDesign(solid, "rubber", color, captions, top=top, density=500.0)


FAMILIES = (laptop, monitor, tablet, keyboard, mouse, mouse_pad)
