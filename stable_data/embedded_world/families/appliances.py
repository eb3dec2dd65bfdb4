"""Kitchen appliances: kettles, toasters, blenders, coffee makers, scales."""

import math

from stable_data.embedded_world.families.vessels import angular_grip, lid_knob, pouring_lip
from stable_data.embedded_world.families.wording import fix_articles, material_word, pick_words
from stable_data.embedded_world.modelling.family import AssetDesign, SupportArea, VariantSampler
from stable_data.embedded_world.modelling.shapes import arc_points, disc, scaled
from stable_data.embedded_world.modelling.solids import Ring, Solid, bar, box, circle, join, lathe, loft, rectangle, slab


def _electric_kettle(r: float, h: float, trim: str) -> Solid:
    foot = lathe([(r + 0.004, 0.0), (r + 0.008, 0.003), (r + 0.008, 0.016), (r - 0.004, 0.024)])
    jug = lathe([(r - 0.002, 0.022), (r, 0.028), (0.72 * r, h - 0.004), (0.68 * r, h)])
    lid = lathe([(0.66 * r, h - 0.002), (0.6 * r, h + 0.008), (0.015, h + 0.012)]) + disc(0.012, 0.0, 0.026).moved(z=h)
    grip = angular_grip(0.72 * r, 0.55 * h, 0.95 * r, 0.34 * h, 0.024, 0.018).as_handle()
    return join([jug, pouring_lip(0.77 * r, h - 0.006, 0.03, 0.06, 0.022), join([foot, lid, grip]).painted(trim)])


def _stovetop_kettle(r: float, h: float, trim: str) -> Solid:
    curve = ((0.94, 0.0), (1.0, 0.06), (0.99, 0.3), (0.88, 0.62), (0.66, 0.88), (0.42, 1.0))
    body = lathe(scaled(curve, r, h))
    lid = lathe([(0.4 * r, h - 0.003), (0.38 * r, h + 0.006), (0.012, h + 0.012)])
    knob = lathe([(0.006, h + 0.01), (0.012, h + 0.022), (0.008, h + 0.03)])
    mouth = disc(0.0095, 0.0, 0.03).moved(z=0.65 * r - 0.0288).painted("black")
    spout = (lathe([(0.026, 0.0), (0.013, 0.65 * r)]) + mouth).turned(y=-48).moved(-0.72 * r, 0.0, 0.42 * h)
    arc = arc_points(1.0, range(0, 181, 30))
    arch = bar([(0.8 * r * c, 0.72 * h + 0.85 * r * s) for c, s in arc], 0.018, 0.012).as_handle()
    return join([body, lid, spout, (arch + knob).painted(trim)])


def kettle(draw: VariantSampler) -> AssetDesign:
    """A kettle, its spout on the left."""
    is_electric = draw.pick(True, False)
    color, trim = pick_words(draw, "silver black, red black, cream oak, black copper, teal silver, white grey")
    r, h = draw.between(0.07, 0.082), draw.between(0.19, 0.225)
    solid = _electric_kettle(r, h, trim) if is_electric else _stovetop_kettle(1.3 * r, 0.62 * h, trim)
    words = "electric kettle on its base" if is_electric else "stovetop kettle with an arched handle"
    captions = fix_articles(f"a {material_word(color)} {words}", f"{color} tea kettle", f"{color} kettle with {trim} parts")
    return AssetDesign(solid, "metal", color, captions, density=480.0)


def toaster(draw: VariantSampler) -> AssetDesign:
    """A toaster with two slots, its lever on the right; some with toast in it."""
    width, depth, h = draw.between(0.25, 0.3), draw.between(0.15, 0.18), draw.between(0.17, 0.2)
    color, trim = pick_words(draw, "silver black, red silver, cream oak, black silver, teal silver, white black")
    has_toast, bevel = draw.pick(True, False, False), draw.pick(0.009, 0.018)
    body, feet = slab(width, depth, h - 0.012, bevel).moved(z=0.012), slab(0.94 * width, 0.8 * depth, 0.03, 0.004)
    slots = [box(0.72 * width, 0.03, 0.006).moved(0.0, y * depth, h - 0.0045) for y in (-0.17, 0.17)]
    toast = slab(0.44 * width, 0.016, 0.07, 0.003).moved(0.0, 0.0, h - 0.03)
    bread = [toast.moved(y=y * depth).painted("oak") for y in (-0.17, 0.17)] if has_toast else []
    lever = slab(0.026, 0.04, 0.014, 0.003).moved(width / 2 + 0.01, 0.1 * depth, 0.62 * h)
    track = box(0.004, 0.012, 0.5 * h).moved(width / 2 - 0.0008, 0.1 * depth, 0.25 * h)
    dial = disc(0.012, 0.0, 0.012).turned(y=90).moved(width / 2 - 0.001, -0.16 * depth, 0.4 * h)
    solid = join([body, join([*slots, track]).painted("black"), *bread, join([feet, lever, dial]).painted(trim)])
    more = "toaster with two slices of toast" if bread else "two-slot toaster"
    captions = fix_articles(
        f"a {material_word(color)} {more}", f"{color} toaster with a lever", f"toaster in {color} and {trim}"
    )
    return AssetDesign(solid, "electronics", color, captions, density=250.0)


_LID = ((1.0, -0.002), (1.04, 0.002), (1.04, 0.014), (0.9, 0.02))


def blender(draw: VariantSampler) -> AssetDesign:
    """A jug on a motor, its handle on the right, its buttons in front."""
    w, low, h = draw.between(0.15, 0.18), draw.between(0.1, 0.14), draw.between(0.19, 0.24)
    color, is_round = draw.pick("black", "silver", "red", "white", "teal", "cream"), draw.pick(True, False)
    r = 0.4 * w
    base = loft([rectangle(w, w, 0.0, 0.02), rectangle(0.72 * w, 0.72 * w, low, 0.02)])

    def ring(x: float, z: float) -> Ring:
        return circle(x, z) if is_round else rectangle(1.8 * x, 1.8 * x, z, 0.45 * x)

    jug = loft([ring(0.72 * r, low + 0.01), ring(r, low + h)]).painted("clear")
    collar, lid = lathe([(0.85 * r, low - 0.002), (0.78 * r, low + 0.022)]), loft([ring(x * r, low + h + z) for x, z in _LID])
    cap = disc(0.3 * r, 0.0, 0.032).moved(z=low + h + 0.012)
    grip = angular_grip(0.78 * r, low + 0.55 * h, 0.75 * r, 0.33 * h, 0.02, 0.014)
    front, lean = -0.43 * w, math.degrees(math.atan(0.14 * w / low))
    knobs = (
        [(disc(0.022, 0.0, 0.018), 0.0)] if is_round else [(slab(0.018, 0.012, 0.008, 0.002), x) for x in (-0.03, 0.0, 0.03)]
    )
    panel = [knob.turned(x=90).moved(x, 0.003, 0.0).turned(x=-lean).moved(y=front, z=0.5 * low) for knob, x in knobs]
    light = "black" if color in ("silver", "white", "cream") else "silver"
    solid = join([base, collar.painted("black"), jug, join([lid, cap, grip]).painted("black"), join(panel).painted(light)])
    captions = fix_articles(f"a {color} blender with a glass jug", f"{color} kitchen blender", "blender for smoothies")
    return AssetDesign(solid, "electronics", color, captions, density=380.0)


def _stand(w: float, d: float, h: float, low: float, head: float) -> Solid:
    """A foot, a column at the back and a head over the foot."""
    column = slab(w, 0.45 * d, h, 0.008).moved(y=0.275 * d)
    return join([slab(w, d, low, 0.006), column, slab(w, d, head * h, 0.008).moved(z=(1 - head) * h)])


def _drip_machine(w: float, trim: str) -> Solid:
    d, h, r, y = 1.2 * w, 1.7 * w, 0.34 * w, -0.19 * w
    body = _stand(w, d, h, 0.035, 0.3)
    jug = lathe([(0.9 * r, 0.034), (r, 0.05), (r, 0.034 + 0.2 * h), (0.7 * r, 0.034 + 0.42 * h)])
    lid = lathe([(0.73 * r, 0.43 * h), (0.73 * r, 0.5 * h), (0.4 * r, 0.55 * h)])
    lid += disc(0.3 * r, 0.0, 0.2 * h).moved(z=0.53 * h)
    grip = angular_grip(0.85 * r, 0.034 + 0.25 * h, 0.32 * w, 0.16 * h, 0.018, 0.012).turned(z=-40)
    lights = join([disc(0.009, 0.0, 0.006).turned(x=90).moved(x, -d / 2 + 0.001, 0.85 * h) for x in (-0.03, 0.0, 0.03)])
    return join([body, lights.painted(trim), jug.painted("amber").moved(y=y), (lid + grip).painted("black").moved(y=y)])


def _espresso_machine(w: float, trim: str) -> Solid:
    d, h = 1.25 * w, 1.35 * w
    body = _stand(w, d, h, 0.05, 0.34)
    tray = slab(0.8 * w, 0.42 * d, 0.006, 0.002).moved(0.0, -0.24 * d, 0.046)
    group = disc(0.17 * w, 0.0, 0.12 * h).moved(0.0, -0.2 * d, 0.55 * h)
    grip = bar([(0.1 * w, 0.0), (0.7 * w, -0.012)], 0.026, 0.02).turned(z=-90).moved(0.0, -0.2 * d, 0.59 * h)
    wand = bar([(0.4 * w, 0.68 * h), (0.4 * w, 0.45 * h), (0.48 * w, 0.25 * h)], 0.01, 0.01, 8).moved(y=-0.33 * d)
    dials = [disc(0.02, 0.0, 0.014).turned(x=90).moved(x * w, -d / 2 + 0.001, 0.84 * h) for x in (-0.3, 0.3)]
    return join([body, join([tray, group, wand]).painted("silver"), join([grip, *dials]).painted(trim)])


def _moka_pot(w: float, trim: str) -> Solid:
    r, h = 0.27 * w, 0.9 * w
    body = [[(1.0, 0.0), (0.86, 0.42), (0.74, 0.46)], [(0.7, 0.5), (0.94, 0.86), (0.9, 0.865), (0.2, 0.94)]]
    boiler, top = (lathe(scaled(profile, r, h), 8) for profile in body)
    band = lathe([(0.78 * r, 0.44 * h), (0.78 * r, 0.52 * h)])
    grip = bar([(0.7 * r, 0.8 * h), (1.7 * r, 0.82 * h), (1.75 * r, 0.72 * h), (1.6 * r, 0.38 * h)], 0.016, 0.014)
    knob = lid_knob(0.011, 0.03).moved(z=0.935 * h)
    return join([boiler, band, top, pouring_lip(0.9 * r, 0.86 * h, 0.018, 0.035, 0.012), (grip + knob).painted(trim)])


_MACHINES = {"drip": (_drip_machine, 500.0), "espresso": (_espresso_machine, 550.0), "moka": (_moka_pot, 1200.0)}


def coffee_maker(draw: VariantSampler) -> AssetDesign:
    """A drip machine with its jug, an espresso machine or a moka pot."""
    style, color, trim = pick_words(
        draw, "drip black silver, espresso red black, moka silver black, drip white red, espresso silver black, moka teal oak"
    )
    make, density = _MACHINES[style]
    name = {"drip": "filter coffee maker with a jug", "espresso": "espresso machine"}.get(style, "stovetop moka pot")
    captions = fix_articles(
        f"a {material_word(color)} {name}", f"{color} coffee maker", f"{style} coffee maker with {trim} parts"
    )
    return AssetDesign(make(draw.between(0.17, 0.2), trim), "electronics", color, captions, density=density)


def _digital_scale(w: float) -> tuple[Solid, float, float, float]:
    """A flat body and the radius, y and z of its plate."""
    d = 1.3 * w
    screen = slab(0.5 * w, 0.03, 0.003, 0.001).moved(0.0, -0.4 * d, 0.019).painted("olive")
    buttons = join([disc(0.007, 0.0, 0.003, 12).moved(x * w, -0.4 * d, 0.019) for x in (-0.36, 0.36)]).painted("grey")
    solid = join([slab(w, d, 0.02, 0.005), screen, buttons, disc(0.13 * w, 0.0, 0.012).moved(0.0, 0.1 * d, 0.018)])
    return solid, 0.45 * w, 0.1 * d, 0.034


def _dial_scale(w: float) -> tuple[Solid, float, float, float]:
    """A body with a dial that leans back and the radius, y and z of its plate."""
    d, h = 0.75 * w, 0.95 * w
    face = disc(0.38 * w, 0.0, 0.005, 48).painted("white") + disc(0.016, 0.0, 0.009).painted("black")
    ticks = join([box(0.004, 0.02, 0.0062).moved(y=0.31 * w).turned(z=angle) for angle in range(0, 360, 45)]).painted("black")
    needle = box(0.006, 0.27 * w, 0.0075).moved(y=0.12 * w).turned(z=-35).painted("red")
    lean = math.degrees(math.atan(0.1 * d / h))
    dial = join([face, ticks, needle]).turned(x=90).moved(0.0, 0.003, 0.0).turned(x=-lean).moved(y=-0.45 * d, z=0.48 * h)
    body = loft([rectangle(w, d, 0.0, 0.02), rectangle(w, 0.8 * d, h, 0.02)])
    return join([body, dial, disc(0.025, 0.0, 0.028).moved(z=h - 0.004)]), 0.55 * w, 0.0, h + 0.028


def kitchen_scale(draw: VariantSampler) -> AssetDesign:
    """A flat scale with a display, or one with a dial; its plate is on top."""
    style, color, plate = pick_words(
        draw,
        "digital white silver, dial red silver, digital black clear, dial cream copper, digital silver black, dial teal white",
    )
    w = draw.between(0.15, 0.19)
    make = _digital_scale if style == "digital" else _dial_scale
    body, r, y, z = make(w)
    pan = lathe([(r - 0.001, z - 0.007), (r, z - 0.006), (r, z)]).moved(y=y)
    captions = fix_articles(
        f"a {material_word(color)} {style} kitchen scale",
        f"scale with a {material_word(plate)} plate",
        f"{color} scale for baking",
    )
    top = SupportArea(2 * r - 0.004, 2 * r - 0.004, z, is_round=True, y=y)
    return AssetDesign(body + pan.painted(plate), "electronics", color, captions, top=top, density=800.0)


FAMILIES = (kettle, toaster, blender, coffee_maker, kitchen_scale)
