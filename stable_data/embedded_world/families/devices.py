"""Small devices with a plug or a battery."""

import math
from itertools import product

import numpy as np

from stable_data.embedded_world.families.displays import WALLPAPERS
from stable_data.embedded_world.families.palette import DARK_GLASS
from stable_data.embedded_world.families.wording import fix_articles
from stable_data.embedded_world.modelling.family import AssetDesign, VariantSampler
from stable_data.embedded_world.modelling.shapes import panel, prism, silhouette
from stable_data.embedded_world.modelling.solids import bar, box, join, lathe, loft, rectangle, slab, turned_vessel


def phone(draw: VariantSampler) -> AssetDesign:
    """A mobile phone that lies flat: its screen up, its back up, or with a keypad."""
    kind, width = draw.pick("screen up", "screen down", "keypad"), draw.between(0.068, 0.08)
    depth, thick = width * draw.between(1.98, 2.16), draw.between(0.0085, 0.011)
    color, paper = draw.pick("black", "silver", "pink", "blue", "white", "green"), draw.pick(*WALLPAPERS)
    if kind == "keypad":
        width, depth, thick = 0.66 * width, 0.72 * depth, 0.016
        keys = "white" if color != "white" else "grey"
        parts = [slab(width, depth, thick, 0.004), panel(0.78 * width, 0.34 * depth, thick, "#9fb48a", y=0.24 * depth)]
        for x, row in product((-1, 0, 1), range(4)):
            ink = {(-1, 0): "green", (1, 0): "red"}.get((x, row), keys)
            parts.append(panel(0.2 * width, 0.08 * depth, thick, ink, 0.27 * x * width, (-0.08 - 0.11 * row) * depth, 0.0012))
        parts.append(slab(0.009, 0.04, 0.009, 0.002).moved(0.36 * width, 0.5 * depth + 0.014, 0.003).painted("#2a2d31"))
        name = "mobile phone with a keypad"
    elif kind == "screen down":
        bump = slab(0.38 * width, 0.36 * width, 0.004, 0.001).moved(-0.24 * width, 0.5 * depth - 0.26 * width, thick - 0.001)
        lens = lathe([(0.007, 0.0), (0.007, 0.0034)], 20).painted(DARK_GLASS)
        places = ((-0.32, 0.34), (-0.32, 0.18), (-0.16, 0.26))
        lenses = [lens.moved(x * width, 0.5 * depth - y * width, thick + 0.001) for x, y in places]
        logo = lathe([(0.007, thick - 0.001), (0.007, thick + 0.0006)], 20).painted("silver" if color != "silver" else "grey")
        parts, name = [slab(width, depth, thick, 0.002), bump, *lenses, logo], "smartphone lying on its screen"
    else:
        lit = panel(0.88 * width, 0.93 * depth, thick + 0.0008, paper, rise=0.0004)
        parts = [slab(width, depth, thick, 0.002), panel(0.93 * width, 0.96 * depth, thick, DARK_GLASS), lit]
        icons = ("white", "yellow", "green", "red", "orange", "teal", "pink", "cream")
        for i, (j, y) in product(range(4), enumerate((0.12, 0.0, -0.12, -0.38))):
            ink = icons[(3 * i + 2 * j) % 8]
            parts.append(panel(0.13 * width, 0.13 * width, thick + 0.0012, ink, (i - 1.5) * 0.2 * width, y * depth, 0.0006))
        parts.append(panel(0.5 * width, 0.07 * depth, thick + 0.0012, "white", y=0.3 * depth, rise=0.0004))
        name = "smartphone with its screen on"
    captions = fix_articles(f"a {color} {name}", f"{color} phone", f"{color} mobile phone")
    return AssetDesign(join(parts), "electronics", color, captions, density=1500.0)


def charger_dock(draw: VariantSampler) -> AssetDesign:
    """A stand or a pad to charge a phone on."""
    kind, width = draw.pick("leaning", "pad", "double"), draw.between(0.07, 0.085)
    color = draw.pick("black", "white", "oak", "silver", "walnut", "grey")
    material = {"oak": "wood", "walnut": "wood", "silver": "metal"}.get(color, "plastic")
    dark = "#2a2d31" if color != "black" else "#5d6470"
    if kind == "pad":
        r = 0.6 * width
        ring = lathe([(0.7 * r, 0.008), (0.7 * r, 0.0128)]).painted(dark) + lathe([(0.5 * r, 0.01), (0.5 * r, 0.0132)])
        plug = bar([(r - 0.004, 0.004), (r + 0.03, 0.004)], 0.008, 0.006, 8).painted(dark)
        solid = join([lathe([(r, 0.0), (r, 0.008), (0.9 * r, 0.012)]), ring, plug])
        lamp = lathe([(0.002, 0.008), (0.002, 0.0108)], 12)
        solid, name = solid + lamp.moved(y=-0.93 * r).painted("#58d06a"), "round charging pad"
    else:
        high, slope = 1.35 * width, math.tan(math.radians(22))
        back = slab(width, high, 0.01, 0.003) + lathe([(0.36 * width, 0.009), (0.36 * width, 0.0112)]).painted(dark)
        lip = box(0.9 * width, 0.014, 0.018).moved(y=0.012 - high / 2, z=0.002)
        rest = (back + lip).turned(x=90).moved(z=high / 2 + 0.006).leaned(slope)
        up, y = 0.78 * high, 0.78 * high * slope
        strut = [(0.0, 0.004), (0.95 * y + 0.012, 0.004), (y, up), (0.9 * y, up)]
        foot = slab(1.1 * width, 1.05 * width, 0.012, 0.003).moved(y=0.012)
        solid, name = join([rest, silhouette(strut, 0.4 * width).turned(z=90), foot]), "phone charging stand"
        if kind == "double":
            x = 1.02 * width
            puck = lathe([(0.27 * width, 0.0), (0.27 * width, 0.008)]).painted(dark).turned(x=60).moved(x, 0.0, 0.8 * width)
            post = bar([(x, 0.01), (x, 0.8 * width)], 0.016, 0.016, 12).moved(y=0.004)
            solid += slab(1.1 * width, 1.05 * width, 0.012, 0.003).moved(0.96 * width, 0.012) + post + puck
            name = "charging station for a phone and a watch"
    captions = fix_articles(f"a {color} {name}", f"{color} phone charger", f"{material} {name}")
    return AssetDesign(solid, material, color, captions, density=900.0)


def power_bank(draw: VariantSampler) -> AssetDesign:
    """A battery to charge phones with, its sockets towards the viewer."""
    kind, width = draw.pick("flat", "chunky"), draw.between(0.062, 0.075)
    depth, thick = width * draw.between(1.8, 2.1), {"flat": 0.014, "chunky": 0.024}[kind] * draw.between(0.95, 1.15)
    color = draw.pick("black", "white", "blue", "silver", "pink", "green")
    ink = "white" if color in ("black", "blue", "green") else "black"
    lamp = lathe([(0.0022, thick - 0.001), (0.0022, thick + 0.0008)], 12).moved(y=-0.4 * depth).painted("#58d06a")
    lamps = [lamp.moved(0.008 * k - 0.012) for k in range(4)]
    port = panel(0.014, 0.4 * thick, 0.0, DARK_GLASS).turned(x=90).moved(0.0, -depth / 2, thick / 2)
    ports = [port.moved(0.27 * x * width) for x in (-1, 0, 1)]
    label = panel(0.5 * width, 0.08 * depth, thick, ink, y=0.06 * depth)
    label += panel(0.3 * width, 0.03 * depth, thick, ink, y=-0.04 * depth)
    bolt = [(0.012, 0.03), (-0.012, 0.004), (0.004, 0.0)]
    mark = [prism(points, thick - 0.001, thick + 0.0008) for points in (bolt, [(-x, -y + 0.002) for x, y in bolt])]
    solid = join([slab(width, depth, thick, 0.004), *lamps, *ports, label, join(mark).moved(y=0.25 * depth).painted("yellow")])
    captions = fix_articles(f"a {kind} {color} power bank", f"{color} power bank", f"{color} portable charger")
    return AssetDesign(solid, "electronics", color, captions, density=1500.0)


def remote_control(draw: VariantSampler) -> AssetDesign:
    """A remote control that lies flat, pointing away from the viewer."""
    kind, width = draw.pick("classic", "slim"), draw.between(0.038, 0.052)
    n, thick = draw.between(0.15, 0.2), draw.between(0.014, 0.02)
    color = draw.pick("black", "grey", "white", "silver")
    dark, keys = draw.pick("red", "green", "blue"), "white" if color == "black" else "black"
    body = [
        rectangle(0.86 * width, 0.97 * n, 0.0, 0.004),
        rectangle(width, n, 0.5 * thick, 0.008),
        rectangle(0.92 * width, 0.98 * n, thick, 0.008),
    ]
    parts = [
        loft(body),
        lathe([(0.005, thick - 0.001), (0.005, thick + 0.002)], 16).moved(-0.25 * width, 0.43 * n).painted("red"),
    ]
    if kind == "classic":
        grid = [(i, 0.34 - 0.065 * j) for j in range(4) for i in (-1, 0, 1)] + [
            (i, -0.28 - 0.06 * j) for j in range(3) for i in (-1, 0, 1)
        ]
        parts += [panel(0.19 * width, 0.036 * n, thick, keys, 0.27 * i * width, y * n, 0.0018) for i, y in grid]
        parts += [
            panel(0.15 * width, 0.025 * n, thick, c, (k - 1.5) * 0.21 * width, -0.445 * n, 0.0018)
            for k, c in enumerate(("red", "green", "yellow", "blue"))
        ]
    else:
        parts += [panel(0.2 * width, 0.16 * n, thick, keys, x * 0.24 * width, -0.12 * n, 0.0018) for x in (-1, 1)]
        parts += [panel(0.5 * width, 0.05 * n, thick, c, y=y * n, rise=0.0018) for y, c in ((-0.28, dark), (-0.38, "grey"))]
    y = -0.06 * n if kind == "classic" else 0.2 * n
    parts.append(lathe([(0.36 * width, thick - 0.001), (0.36 * width, thick + 0.0016)]).moved(y=y).painted(keys))
    parts.append(lathe([(0.15 * width, thick), (0.15 * width, thick + 0.003)], 20).moved(y=y).painted("grey"))
    captions = fix_articles(f"a {color} {kind} remote control", f"{color} remote control", f"{kind} tv remote")
    return AssetDesign(join(parts), "plastic", color, captions, density=800.0)


def router(draw: VariantSampler) -> AssetDesign:
    """A wireless router, its aerials at the back and its lights to the viewer."""
    width, count = draw.between(0.17, 0.24), draw.pick(2, 3, 4)
    depth, high, rise = width * draw.between(0.55, 0.7), draw.between(0.024, 0.036), draw.between(0.1, 0.16)
    color, light = draw.pick("white", "black", "grey"), draw.pick("#58d06a", "#59b7e8")
    body = loft(
        [
            rectangle(0.94 * width, 0.94 * depth, 0.0, 0.01),
            rectangle(width, depth, 0.4 * high, 0.014),
            rectangle(0.9 * width, 0.86 * depth, high, 0.012),
        ]
    )
    slats = [
        panel(0.5 * width, 0.004, high, "grey" if color != "grey" else "black", y=(0.05 + 0.07 * k) * depth) for k in range(4)
    ]
    dots = [panel(0.006, 0.01, high, light, (k - 2) * 0.03, -0.3 * depth) for k in range(5)]
    stick = lathe([(0.007, 0.0), (0.007, 0.02)], 12) + loft([rectangle(0.016, 0.009, 0.012), rectangle(0.012, 0.008, rise)])
    step = 0.84 * width / (count - 1)
    lean = [(k - (count - 1) / 2) for k in range(count)]
    sticks = [stick.turned(y=8 * k).moved(k * step, 0.42 * depth, 0.4 * high) for k in lean]
    captions = fix_articles(
        f"a {color} router with {count} antennas", f"{color} wireless router", f"wi-fi router with {count} aerials"
    )
    return AssetDesign(join([body, *slats, *dots, *sticks]), "electronics", color, captions, density=500.0)


def game_controller(draw: VariantSampler) -> AssetDesign:
    """A game controller with two sticks, its grips towards the viewer."""
    color, second = draw.pick("black", "white", "red", "blue", "grey", "purple"), draw.pick("#4a4f55", "silver", "#6b7177")
    aligned, pull = draw.pick(True, False), draw.between(0.045, 0.06)
    plan = np.array([(62, -20), (68, 10), (52, 34), (-52, 34), (-68, 10), (-62, -20), (-50, -26), (50, -26)]) / 1000
    core = loft([np.c_[share * plan, np.full(8, z)] for share, z in ((0.86, 0.002), (1.0, 0.016), (0.96, 0.034), (0.9, 0.04))])
    angle, grips = np.pi * (np.arange(16) + 0.5) / 8, []
    for side in (-1, 1):
        sizes = ((-0.022, 0.0205), (0.01, 0.0212), (pull, 0.0175), (pull + 0.012, 0.011))
        rings = [np.c_[r * np.cos(angle), np.full(16, -t), r * (np.sin(angle) + math.cos(math.pi / 16))] for t, r in sizes]
        grips.append(loft(rings).turned(z=14.0 * side).moved(0.046 * side, -0.006))
    stick = (
        lathe([(0.012, 0.036), (0.007, 0.05)], 20) + lathe([(0.0095, 0.049), (0.0105, 0.053), (0.009, 0.056)], 20)
    ).painted(second)
    left, cross = ((-0.024, -0.018), (-0.044, 0.012)) if aligned else ((-0.044, 0.012), (-0.024, -0.018))
    pads = [stick.moved(*left), stick.moved(0.024, -0.018)]
    pads += [panel(w, 0.026 - w + 0.008, 0.04, second, *cross, 0.003) for w in (0.008, 0.026)]
    spots = ((0.0, -1, "green"), (1, 0.0, "red"), (0.0, 1, "yellow"), (-1, 0.0, "#3f72d8"))
    knob = lathe([(0.0048, 0.038), (0.0048, 0.044)], 16)
    pads += [knob.moved(0.044 + 0.0105 * x, 0.012 + 0.0105 * y).painted(c) for x, y, c in spots]
    pads += [slab(0.034, 0.014, 0.02, 0.003).moved(0.042 * x, 0.032, 0.018).painted(second) for x in (-1, 1)]
    pads.append(lathe([(0.007, 0.039), (0.007, 0.0416)], 20).moved(y=0.014).painted("silver" if color != "silver" else "grey"))
    captions = fix_articles(
        f"a {color} game controller", f"{color} gamepad with two sticks", f"{color} controller for video games"
    )
    return AssetDesign(join([core, *grips, *pads]), "plastic", color, captions, density=700.0)


def camera(draw: VariantSampler) -> AssetDesign:
    """A camera, its lens towards the viewer."""
    kind = draw.pick("reflex", "compact", "instant")
    color, trim = draw.pick("black", "silver", "red", "white", "teal", "pink"), draw.pick("black", "#7a5236")
    if kind == "reflex":
        color = draw.pick("black", "#4a4f55", "grey", "silver", "#5d5148", "navy")
    name = {"#4a4f55": "dark grey", "#5d5148": "dark brown"}.get(color, color)
    sizes = {"reflex": (130, 56, 85, 34, 45), "compact": (105, 32, 62, 23, 16), "instant": (115, 62, 100, 26, 20)}[kind]
    width, depth, high, r, reach = (0.001 * size * draw.between(0.92, 1.08) for size in sizes)
    rings = [(1.06 * r, -0.004), (1.06 * r, 0.004), (r, 0.005)]
    rings += [(r, reach - 0.006), (1.04 * r, reach - 0.005), (1.04 * r, reach)]
    barrel = lathe(rings).painted("#2a2d31") + lathe([(0.72 * r, reach - 0.001), (0.72 * r, reach + 0.0008)]).painted("#3a5f86")
    glint = lathe([(0.2 * r, reach), (0.2 * r, reach + 0.0014)], 20).moved(0.25 * r, 0.3 * r).painted("white")
    lens = (barrel + glint).turned(x=90).moved(0.0, -depth / 2, 0.47 * high)
    parts = [slab(width, depth, high, 0.005), lens]
    skin = box(width + 0.0014, depth + 0.0014, 0.5 * high, 0.005).moved(z=0.2 * high)
    skin = skin.painted(trim if color != "black" else "#4a4f55")
    button = lathe([(0.007, high - 0.002), (0.007, high + 0.005)], 20).moved(-0.38 * width)
    parts.append(button.painted("red" if kind == "instant" else "silver" if color != "silver" else "black"))
    if kind == "reflex":
        side = [(-0.034, high - 0.004), (0.034, high - 0.004), (0.018, high + 0.022), (-0.018, high + 0.022)]
        wheel = lathe([(0.011, high - 0.002), (0.011, high + 0.008)], 20).moved(0.4 * width).painted("grey")
        parts += [skin, silhouette(side, 0.86 * depth), wheel]
        parts.append(slab(0.026, 0.03, 0.86 * high, 0.006).moved(-0.42 * width, -0.5 * depth).painted("#24272b"))
    elif kind == "compact":
        flash = panel(0.02, 0.009, 0.0, "white", 0.36 * width, 0.35 * high, 0.0012)
        parts += [skin, flash.turned(x=90).moved(0.0, -depth / 2, high / 2)]
    else:
        window = panel(0.022, 0.018, 0.0, DARK_GLASS, 0.34 * width, 0.32 * high, 0.0012)
        window += panel(0.03, 0.016, 0.0, "white", -0.3 * width, 0.33 * high, 0.0012)
        slot = slab(0.9 * width, depth + 0.03, 0.22 * high, 0.004).moved(y=-0.01)
        parts.append(slot.painted("#d9d4c8" if color != "white" else "grey"))
        parts.append(window.turned(x=90).moved(0.0, -depth / 2, high / 2))
        stripe = box(0.008, 0.004, 0.4 * high).moved(y=0.0012 - depth / 2, z=0.2 * high)
        parts += [stripe.moved((k - 5.2) * 0.0079).painted(c) for k, c in enumerate(("red", "yellow", "teal"))]
    what = {"reflex": "camera with a large lens", "compact": "compact camera", "instant": "instant camera"}[kind]
    captions = fix_articles(f"a {name} {what}", f"{name} camera", f"{kind} camera for taking photos")
    return AssetDesign(join(parts), "electronics", color, captions, density=900.0)


def webcam(draw: VariantSampler) -> AssetDesign:
    """A webcam on a foot or a tripod."""
    kind, r = draw.pick("ball", "bar"), draw.between(0.024, 0.03)
    color, stand = draw.pick("black", "white", "grey", "silver"), draw.pick("tripod", "foot", "clip")
    low = {"tripod": 0.085, "foot": 0.05, "clip": 0.03}[stand] * draw.between(0.95, 1.2)
    parts = [lathe([(0.007, 0.006), (0.007, low + 0.01)], 12)]
    if stand == "tripod":
        leg = bar([(0.0, 0.6 * low), (0.06, 0.004), (0.068, 0.004)], 0.012, 0.008, 8)
        parts = [parts[0].moved(z=0.3 * low), *(leg.turned(z=t) for t in (90, 210, 330))]
    elif stand == "foot":
        parts.append(lathe([(0.036, 0.0), (0.036, 0.006), (0.02, 0.012)]))
    else:
        parts.append(slab(0.06, 0.06, 0.012, 0.003) + box(0.05, 0.012, low).moved(y=0.02))
    lens = lathe([(0.62 * r, -0.002), (0.62 * r, 0.006)]).painted("#2a2d31")
    lens += lathe([(0.42 * r, 0.005), (0.42 * r, 0.0072)]).painted("#3a5f86")
    lens += lathe([(0.12 * r, 0.006), (0.12 * r, 0.008)], 12).moved(0.15 * r, 0.15 * r).painted("white")
    if kind == "ball":
        profile = [(0.72 * r, -0.5), (0.95 * r, -0.25), (r, 0.0), (0.95 * r, 0.25), (0.72 * r, 0.5)]
        head = lathe([(a, 1.5 * r * z) for a, z in profile], 32) + lens.moved(z=0.74 * r)
    else:
        sizes = ((3.3, -0.5), (3.6, -0.3), (3.6, 0.4), (3.4, 0.55))
        head = loft([rectangle(w * r, 1.5 * r, z * r, 0.5 * r) for w, z in sizes]) + lens.moved(z=0.55 * r)
        head += lathe([(0.003, 0.5 * r), (0.003, 0.55 * r + 0.001)], 12).moved(1.2 * r).painted("#58d06a")
    solid = join([head.turned(x=90).moved(z=low + 0.74 * r), *parts])
    captions = fix_articles(f"a {color} webcam on a {stand}", f"{color} webcam", f"{kind}-shaped camera for video calls")
    low = min(float(part[:, 2].min()) for part in solid.parts)
    return AssetDesign(solid.moved(z=-low), "electronics", color, captions, density=900.0)


def desk_fan(draw: VariantSampler) -> AssetDesign:
    """A fan on a foot, its blades behind a guard."""
    r, stem = draw.between(0.075, 0.12), draw.between(0.05, 0.11)
    color, second = draw.pick("white", "black", "silver", "teal", "red", "pink"), draw.pick("#6fa8d8", "grey", "cream")
    count, deep = draw.pick(3, 4, 5), 0.42 * r
    guard = turned_vessel([(0.8 * r, 0.0), (r, deep)], [(0.78 * r, 0.005), (r - 0.005, deep)])
    blade = [(0.1 * r, -0.1 * r), (0.6 * r, -0.3 * r), (0.84 * r, -0.12 * r), (0.84 * r, 0.2 * r), (0.1 * r, 0.1 * r)]
    fan = [prism(blade, 0.52 * deep, 0.52 * deep + 0.003).turned(z=360 * k / count + 20).painted(second) for k in range(count)]
    wires = [box(2 * r - 0.004, 0.0024, 0.0024).turned(z=t).moved(z=deep - 0.003) for t in (0, 45, 90, 135)]
    hub = lathe([(0.16 * r, 0.002), (0.16 * r, 0.8 * deep)]) + lathe([(0.24 * r, deep - 0.004), (0.2 * r, deep + 0.003)])
    motor = lathe([(0.26 * r, -0.5 * r), (0.36 * r, -0.4 * r), (0.4 * r, 0.003)])
    head = join([guard, *fan, *wires, hub, motor]).turned(x=82).moved(z=stem + 1.05 * r)
    foot = lathe([(0.86 * r, 0.0), (0.86 * r, 0.01), (0.6 * r, 0.024), (0.2 * r, 0.03)]).moved(y=0.06 * r)
    neck = box(0.24 * r, 0.2 * r, stem + 0.9 * r).moved(0.0, 0.22 * r, 0.012)
    button = lathe([(0.008, 0.0), (0.008, 0.03)], 16).moved(0.0, -0.5 * r + 0.06 * r).painted(second)
    captions = fix_articles(
        f"a {color} desk fan with {count} blades", f"{color} table fan", f"small {color} fan on a round foot"
    )
    return AssetDesign(join([head, foot, neck, button]), "plastic", color, captions, density=600.0)


FAMILIES = (phone, charger_dock, power_bank, remote_control, router, game_controller, camera, webcam, desk_fan)
