"""Toys on wheels."""

import math
from collections.abc import Sequence

from stable_data.embedded_world.families.palette import WINDOW
from stable_data.embedded_world.families.wording import fix_articles
from stable_data.embedded_world.modelling.family import AssetDesign, VariantSampler
from stable_data.embedded_world.modelling.shapes import ellipsoid, lying_body, round_body, silhouette
from stable_data.embedded_world.modelling.solids import Solid, box, join, slab


def _wheels(spots: Sequence[float], aside: float, radius: float, wide: float, color: str, hub: str) -> list[Solid]:
    """Wheels in pairs at the given x, flat where they touch the ground."""
    axle = radius * math.cos(math.pi / 12)
    tyre = round_body([(radius, -wide / 2), (radius, wide / 2)], 12).painted(color)
    cap = round_body([(0.55 * radius, -wide / 2 - 0.0012), (0.55 * radius, wide / 2 + 0.0012)], 8).painted(hub)
    wheel = (tyre + cap).turned(x=90).moved(z=axle)
    return [wheel.moved(x, side * aside) for x in spots for side in (-1, 1)]


def toy_car(draw: VariantSampler) -> AssetDesign:
    """A toy car on four wheels, its front to -y."""
    style = draw.pick("sedan", "truck", "van", "racing car", "beetle", "pickup")
    color, tyre = draw.pick("red", "blue", "yellow", "green", "orange", "purple"), draw.pick("black", "grey", "walnut")
    s, wide, r = draw.between(0.9, 1.3), 0.042, 0.0115
    front, rear = 0.032, -0.03
    body = slab(0.105, wide, 0.017, 0.003).moved(z=0.008)
    low = 0.0245
    parts: list[Solid] = []

    def cabin(x0: float, x1: float, height: float, nose: float, tail: float) -> None:
        outline = [(x0, low - 0.001), (x1, low - 0.001), (x1 - nose, low + height), (x0 + tail, low + height)]
        parts.append(silhouette(outline, wide - 0.004))
        pane = [(x0 + 0.3 * tail + 0.005, low + 0.2 * height), (x1 - 0.3 * nose - 0.005, low + 0.2 * height)]
        pane += [(x1 - 0.85 * nose - 0.004, low + 0.84 * height), (x0 + 0.85 * tail + 0.004, low + 0.84 * height)]
        parts.append(silhouette(pane, wide - 0.0018).painted(WINDOW))
        tilt = math.degrees(math.atan2(nose, height))
        screen = box(0.003, 0.74 * wide, 0.64 * height).turned(y=-tilt)
        parts.append(screen.moved(x1 - 0.2 * nose - 0.0003, 0.0, low + 0.18 * height).painted(WINDOW))

    if style == "sedan":
        cabin(-0.042, 0.024, 0.017, 0.016, 0.011)
    elif style == "beetle":
        body = slab(0.092, wide, 0.015, 0.003).moved(z=0.008)
        low = 0.0215
        parts.append(
            silhouette([(-0.045, low - 0.002), (0.044, low - 0.002), (0.036, low + 0.007), (-0.036, low + 0.01)], 0.7 * wide)
        )
        cabin(-0.036, 0.024, 0.022, 0.014, 0.02)
    elif style == "van":
        cabin(-0.051, 0.05, 0.03, 0.012, 0.002)
        parts.append(box(0.11, wide + 0.0016, 0.0035).moved(z=0.018).painted("white"))
    elif style == "pickup":
        cabin(-0.012, 0.03, 0.02, 0.011, 0.003)
        parts += [box(0.044, 0.004, 0.009).moved(-0.03, side * (wide / 2 - 0.002), low - 0.001) for side in (-1, 1)]
        parts += [box(0.004, wide - 0.001, 0.009).moved(-0.05, 0.0, low - 0.001)]
    elif style == "truck":
        cabin(0.016, 0.05, 0.026, 0.006, 0.001)
        parts.append(box(0.066, wide + 0.003, 0.033, 0.002).moved(-0.021, 0.0, low - 0.002).painted("cream"))
    else:
        body = lying_body([(-0.055, 0.016, 0.009, 0.015), (-0.01, 0.019, 0.011, 0.016), (0.062, 0.007, 0.006, 0.012)], 16)
        parts.append(box(0.014, 0.05, 0.004).moved(-0.05, 0.0, 0.036).painted("black"))
        parts += [box(0.006, 0.004, 0.02).moved(-0.05, y, 0.018) for y in (-0.012, 0.012)]
        parts.append(ellipsoid(0.0075, 0.0075, 0.0085, 12).moved(-0.008, 0.0, 0.031).painted("white"))
        parts.append(box(0.013, 0.046, 0.004, 0.001).moved(0.058, 0.0, 0.007).painted("black"))
        parts.append(box(0.085, 0.036, 0.006).moved(-0.005, 0.0, 0.008))
        front, r = 0.036, 0.0135
    if style != "racing car":
        nose = 0.046 if style == "beetle" else 0.0525
        parts += [box(0.004, 0.008, 0.006).moved(nose - 0.0012, side * 0.014, 0.0145).painted("#f4e9b0") for side in (-1, 1)]
        parts.append(box(0.005, wide + 0.001, 0.0035).moved(nose, 0.0, 0.009).painted("silver"))
    wheels = _wheels((front, rear), wide / 2 + (0.001 if style != "racing car" else 0.003), r, 0.01, tyre, "silver")
    whole = join([body, *parts, *wheels])
    captions = fix_articles(
        f"{color} toy {style}" if "car" in style else f"{color} toy car, a {style}",
        f"{color} toy car",
        "little car on four wheels",
    )
    return AssetDesign(whole.resized(s).turned(z=-90), "plastic", color, captions, density=650.0)


def toy_train(draw: VariantSampler) -> AssetDesign:
    """A locomotive, some with a wagon, its front to -y."""
    s, has_wagon = draw.between(0.9, 1.15), draw.pick(True, False, True, False, True, False)
    color = draw.pick("red", "blue", "green", "black", "oak", "yellow")
    accent = draw.pick("yellow", "red", "gold", "blue")
    roof = draw.pick("black", "navy", "walnut")
    accent = "green" if accent == color else accent
    frame = box(0.104, 0.036, 0.01).moved(z=0.012).painted(roof)
    boiler = round_body([(0.0165, 0.0), (0.0165, 0.07)], 20).turned(y=90).moved(-0.02, 0.0, 0.0365)
    nose = round_body([(0.0135, 0.069), (0.0125, 0.0735)], 16).turned(y=90).moved(-0.02, 0.0, 0.0365).painted(accent)
    bands = [
        round_body([(0.0175, x), (0.0175, x + 0.004)], 20).turned(y=90).moved(-0.02, 0.0, 0.0365).painted(accent)
        for x in (0.025, 0.05)
    ]
    cab = box(0.034, 0.04, 0.044).moved(-0.034, 0.0, 0.021)
    panes = [box(0.018, 0.0425, 0.014).moved(-0.034, 0.0, 0.042).painted(WINDOW)]
    cover = slab(0.044, 0.048, 0.006, 0.0015).moved(-0.034, 0.0, 0.064).painted(roof)
    chimney = round_body([(0.0055, 0.045), (0.0055, 0.064), (0.009, 0.074)], 12).moved(0.034).painted(roof)
    domed = round_body([(0.0075, 0.045), (0.0075, 0.056), (0.004, 0.06)], 12).moved(0.012).painted(accent)
    plough = silhouette([(0.05, 0.006), (0.066, 0.006), (0.066, 0.009), (0.05, 0.021)], 0.03).painted(accent)
    wheels = _wheels((-0.034, -0.003, 0.028), 0.019, 0.0125, 0.007, roof, accent)
    parts = [frame, boiler, nose, *bands, cab, *panes, cover, chimney, domed, plough, *wheels]
    if has_wagon:
        floor = box(0.07, 0.038, 0.018).moved(-0.102, 0.0, 0.012).painted(accent)
        walls = box(0.066, 0.034, 0.014).moved(-0.102, 0.0, 0.029)
        load = [
            ellipsoid(0.0115, 0.013, 0.009, 8).moved(-0.122 + 0.02 * k, 0.0, 0.043).painted(("walnut", "red", "green")[k])
            for k in range(3)
        ]
        hook = box(0.024, 0.01, 0.005).moved(-0.058, 0.0, 0.0145).painted("black")
        parts += [floor, walls, *load, hook, *_wheels((-0.124, -0.08), 0.019, 0.0105, 0.007, roof, accent)]
    words = "with a wagon" if has_wagon else "with a chimney"
    captions = (f"{color} toy train {words}", f"{color} toy locomotive", "little steam engine on wheels", "wooden toy train")
    return AssetDesign(join(parts).resized(s).turned(z=-90), "wood", color, captions)


FAMILIES = (toy_car, toy_train)
