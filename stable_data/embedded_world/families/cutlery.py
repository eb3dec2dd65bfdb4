"""Cutlery, lying flat."""

from collections.abc import Sequence

import numpy as np

from stable_data.embedded_world.modelling.family import AssetDesign, VariantSampler
from stable_data.embedded_world.modelling.solids import NUM_INSIDE, Solid, chain, circle, join, loft, rectangle, vessel


def _strip(stations: Sequence[tuple[float, float, float, float]]) -> Solid:
    """A flat bar along y through stations (y, z of its underside, width, thickness)."""
    rings = []
    for y, z, width, thickness in stations:
        section = rectangle(width, thickness, 0.0, 0.28 * min(width, thickness))
        rings.append(np.stack([-section[:, 0], np.full(8, y), section[:, 1] + z + thickness / 2], axis=1))
    return chain(rings)


def _handle(draw: VariantSampler, length: float) -> tuple[Solid, str, str]:
    """The handle of a spoon or fork from y = 0, its neck at 0.66 of the length; its colour and a word for it."""
    color, grip, word = draw.pick(
        ("silver", "", "steel"), ("gold", "", "golden"), ("silver", "black", "black-handled"),
        ("silver", "oak", "wooden-handled"), ("#4a4e54", "", "dark steel"), ("silver", "", "polished steel"),
    )  # fmt: skip
    end = draw.between(0.017, 0.022)
    shares = [(0.0, 0.0, 0.7 * end, 0.0032), (0.03, 0.0, end, 0.0036), (0.2, 0.0, 0.8 * end, 0.0044)]
    shares += [(0.4, 0.0066, 0.011, 0.0042), (0.55, 0.0092, 0.0075, 0.0038), (0.66, 0.0072, 0.0066, 0.0034)]
    stations = [(y * length, z, width, thick) for y, z, width, thick in shares]
    if not grip:
        return _strip(stations).as_handle(), color, word
    wood = _strip([(y, z, w + 0.001, t + 0.0016 * (z > 0)) for y, z, w, t in stations[:4]]).painted(grip)
    neck = _strip([(0.38 * length, 0.0068, 0.008, 0.0036), *stations[4:]])
    return (wood + neck).as_handle(), color, word


def fork(draw: VariantSampler) -> AssetDesign:
    """A fork that lies on its back, its tines towards +y."""
    length, (num_tines, count) = draw.between(0.165, 0.205), draw.pick((4, "four"), (3, "three"))
    handle, color, word = _handle(draw, length)
    wide, tine = 0.0235, 0.0026
    root = [(0.64 * length, 0.0078, 0.0066, 0.0034), (0.7 * length, 0.0024, 0.018, 0.003)]
    root += [(0.735 * length, 0.0, wide, 0.003), (0.785 * length, 0.0, wide, 0.0028)]
    bars = []
    for n in range(num_tines):
        x = (n / (num_tines - 1) - 0.5) * (wide - tine)
        prong = [(0.77 * length, 0.0, tine, 0.0026), (0.9 * length, 0.0008, tine, 0.0024), (length, 0.007, 0.7 * tine, 0.0018)]
        bars.append(_strip(prong).moved(x))
    captions = (f"a {word} fork with {count} tines", f"{word} table fork", f"{word} fork for eating")
    return AssetDesign(join([handle, _strip(root), *bars]), "metal", color, captions, density=4000.0)


def spoon(draw: VariantSampler) -> AssetDesign:
    """A spoon that lies on its back, its bowl towards +y."""
    kind, length = draw.pick(("soup", draw.between(0.18, 0.2)), ("tea", draw.between(0.135, 0.15)))
    handle, color, word = _handle(draw, length)
    half, wall = draw.between(0.105, 0.12) * length, 0.0014
    stretch = np.array([1.0, 1.38, 1.0])
    outer = [circle(half * r, z) * stretch for r, z in ((0.45, 0.0), (0.72, 0.0022), (1.0, 0.0075))]
    inner = [circle(half * r - wall, z, NUM_INSIDE) * stretch for r, z in ((0.5, 0.0022), (1.0, 0.0075))]
    scoop = vessel(outer, inner).moved(0.0, length - 1.38 * half)
    root = length - 2.76 * half
    neck = _strip([(0.65 * length, 0.0073, 0.0066, 0.0034), (root + 0.002, 0.004, 0.0075, 0.0034)])
    captions = (f"a {word} {kind}spoon" if kind == "tea" else f"a {word} {kind} spoon", f"{word} spoon", "spoon for eating")
    return AssetDesign(join([handle, neck, scoop]), "metal", color, captions, density=4000.0)


def table_knife(draw: VariantSampler) -> AssetDesign:
    """A table knife that lies flat, its rounded blade towards +y."""
    color, grip, word = draw.pick(
        ("silver", "", "steel"), ("gold", "", "golden"), ("silver", "black", "black-handled"),
        ("silver", "walnut", "wooden-handled"), ("#4a4e54", "", "dark steel"), ("silver", "cream", "cream-handled"),
    )  # fmt: skip
    length, share, thick = draw.between(0.2, 0.24), draw.between(0.44, 0.5), draw.between(0.006, 0.0085)
    y, wide = share * length, draw.between(0.017, 0.021)
    widths = ((0.0, 0.016, 0.8), (0.09, 0.019, 1.0), (0.85, 0.0135, 1.0), (1.0, 0.013, 0.7))
    handle = _strip([(share * y, 0.0, width, part * thick) for share, width, part in widths]).as_handle()
    blade = [(y - 0.008, 0.0005, 0.011, 0.0026), (y + 0.02, 0.0005, wide, 0.0022), (0.86 * length, 0.0005, wide, 0.002)]
    blade += [(0.95 * length, 0.0005, 0.8 * wide, 0.002), (length, 0.0005, 0.35 * wide, 0.002)]
    captions = (f"a {word} table knife", f"{word} dinner knife with a rounded blade", "knife for eating")
    solid = (handle.painted(grip) if grip else handle) + _strip(blade)
    return AssetDesign(solid, "metal", color, captions, density=2000.0 if grip else 3200.0)


def chopsticks(draw: VariantSampler) -> AssetDesign:
    """A pair of chopsticks, their tips towards +y on a rest."""
    color, word, rest = draw.pick(
        ("bamboo", "bamboo", "white"), ("black", "black", "red"), ("walnut", "dark wooden", "blue"),
        ("red", "red", "black"), ("#4a4e54", "dark grey", "cream"), ("oak", "light wooden", "teal"),
    )  # fmt: skip
    length, wide, rise = draw.between(0.22, 0.245), draw.between(0.0066, 0.0082), draw.between(0.008, 0.011)
    points = ((0.0, 0.0, wide), (0.07, 0.0, wide), (0.8, rise, 0.0055), (1.0, 1.3 * rise, 0.003))
    stick = _strip([(y * length, z, side, side) for y, z, side in points])
    block = loft([rectangle(w, d, z, 0.003) for w, d, z in ((0.05, 0.024, 0.0), (0.044, 0.014, rise + 0.0012))]).painted(rest)
    captions = (f"a pair of {word} chopsticks on a rest", f"{word} chopsticks", f"two chopsticks on a small {rest} rest")
    sticks = [stick.moved(-0.007).turned(z=-0.6), stick.moved(0.007).turned(z=0.6)]
    return AssetDesign(join([*sticks, block.moved(0.0, 0.8 * length)]), "wood", color, captions)


FAMILIES = (fork, spoon, table_knife, chopsticks)
