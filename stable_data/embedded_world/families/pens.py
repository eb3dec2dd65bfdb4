"""Pens and erasers."""

import math

from stable_data.embedded_world.families.palette import NEON, PAPER
from stable_data.embedded_world.families.wording import fix_articles
from stable_data.embedded_world.modelling.family import LYING, AssetDesign, VariantSampler
from stable_data.embedded_world.modelling.shapes import panel, scaled, silhouette
from stable_data.embedded_world.modelling.solids import Profile, Solid, box, join, lathe, loft, rectangle, slab
from stable_data.scene import FloatArray


def _rod(profile: Profile, floor: float, corners: int = 12) -> Solid:
    """A piece of a pen, upright, with a facet on the plane y = -floor so that all pieces lie on one table."""
    reach = max(radius for radius, _ in profile) * math.cos(math.pi / corners)
    turn = 0.0 if corners % 4 else 180 / corners
    return lathe(profile, corners).turned(z=turn).moved(y=reach - floor)


def pen(draw: VariantSampler) -> AssetDesign:
    """A pen that stands on its end, its point up."""
    length, r = draw.between(0.132, 0.148), draw.between(0.0046, 0.0062)
    kind = draw.pick("click ballpoint", "stick ballpoint", "fountain")
    color, trim = draw.pick("blue", "black", "red", "green", "navy", "purple"), draw.pick("silver", "gold")
    clip, root = box(0.003, 0.0016, 0.28 * length), box(0.003, 0.005, 0.006)
    if kind == "click ballpoint":
        pieces = [
            _rod([(0.5 * r, 0.0), (0.5 * r, 0.05 * length)], 0.6 * r).painted(trim),
            _rod([(0.86 * r, 0.04 * length), (r, 0.06 * length), (r, 0.62 * length)], r),
            _rod([(0.97 * r, 0.61 * length), (0.97 * r, 0.8 * length), (0.86 * r, 0.87 * length)], r - 1e-4).painted("black"),
            _rod([(0.8 * r, 0.865 * length), (0.24 * r, 0.975 * length), (0.2 * r, length)], 0.8 * r).painted(trim),
            (clip.moved(0.0, r + 0.0012, 0.08 * length) + box(0.003, 0.004, 0.006).moved(0.0, r, 0.08 * length)).painted(trim),
        ]
    elif kind == "stick ballpoint":
        pieces = [
            _rod([(0.9 * r, 0.0), (1.16 * r, 0.02 * length), (1.16 * r, 0.38 * length)], r),
            _rod([(0.86 * r, 0.36 * length), (0.86 * r, 0.86 * length)], r - 1e-4, 6).painted("white"),
            _rod([(0.7 * r, 0.85 * length), (0.24 * r, 0.97 * length), (0.2 * r, length)], 0.7 * r).painted(trim),
            (clip.moved(0.0, 1.5 * r, 0.1 * length) + root.moved(0.0, 1.2 * r, 0.1 * length)),
        ]
    else:
        pieces = [
            _rod([(0.6 * r, 0.0), (1.02 * r, 0.06 * length), (1.08 * r, 0.4 * length), (1.08 * r, 0.5 * length)], r),
            _rod([(1.16 * r, 0.49 * length), (1.16 * r, 0.52 * length)], r).painted(trim),
            _rod([(1.13 * r, 0.515 * length), (1.1 * r, 0.92 * length), (0.6 * r, length)], r - 1e-4),
            (clip.moved(0.0, 1.4 * r, 0.58 * length) + root.moved(0.0, 1.2 * r, 0.84 * length)).painted(trim),
        ]
    captions = fix_articles(f"a {color} {kind} pen", f"{color} pen", f"{kind} pen with {trim} trim", "pen to write with")
    return AssetDesign(join(pieces), "plastic", color, captions, tilts=LYING)


def pencil(draw: VariantSampler) -> AssetDesign:
    """A pencil that stands on its end, its point up."""
    length, kind = draw.between(0.09, 0.19), draw.pick("with an eraser", "plain", "carpenter's")
    color = draw.pick("yellow", "green", "red", "blue", "black", "orange")
    r, point = 0.0043, draw.between(0.018, 0.024)
    start, bare = (0.016 if kind == "with an eraser" else 0.0), length - point
    if kind == "carpenter's":
        sizes = ((1.0, 0.0), (1.0, bare), (0.94, bare - 4e-4), (0.42, length - 0.008), (0.36, length - 0.0084), (0.22, length))
        rings = [rectangle(0.014 * share, 0.007 * share, z, 0.0016 * share) for share, z in sizes]
        shaft, wood, tip = (loft(rings[k : k + 2]) for k in (0, 2, 4))
    else:
        shaft = _rod([(r, start), (r, bare)], r * math.cos(math.pi / 6), 6)
        wood = _rod([(0.93 * r, bare - 4e-4), (0.36 * r, length - 0.006)], 0.8 * r, 6)
        tip = _rod([(0.34 * r, length - 0.0064), (0.16 * r, length)], 0.29 * r, 6)
    solid = join([shaft, wood.painted("oak"), tip.painted("black")])
    if kind == "with an eraser":
        solid += _rod([(0.78 * r, 0.0), (0.84 * r, 0.001), (0.84 * r, 0.007)], 0.84 * r).painted("pink")
        solid += _rod([(0.9 * r, 0.006), (0.9 * r, 0.0164)], 0.86 * r).painted("silver")
    size = "short" if length < 0.13 else "long"
    name = "carpenter's pencil" if kind == "carpenter's" else "pencil"
    detail = "with an eraser on its end" if kind == "with an eraser" else "with a sharpened point"
    captions = fix_articles(
        f"a {size} {color} {name} {detail}", f"{color} {name}", f"sharpened {size} {name}", "wooden pencil for drawing"
    )
    return AssetDesign(solid, "wood", color, captions, tilts=LYING)


def marker(draw: VariantSampler) -> AssetDesign:
    """A capped felt-tip marker that stands on its end, its cap up."""
    length, r, kind = draw.between(0.118, 0.142), draw.between(0.0075, 0.01), draw.pick("permanent", "whiteboard", "felt-tip")
    color = draw.pick("black", "red", "blue", "green", "orange", "purple")
    cut = draw.between(0.58, 0.68) * length
    barrel = _rod([(0.8 * r, 0.0), (0.92 * r, 0.003), (0.92 * r, cut + 0.002)], r, 16)
    plug = _rod([(0.7 * r, 0.0), (0.7 * r, 0.02)], 0.7 * r, 16).moved(z=-0.004)
    if kind == "permanent":
        barrel = barrel.painted("grey")
        cap = _rod([(r, cut), (r, cut + 0.016)], r, 16) + _rod([(0.86 * r, cut + 0.015), (0.74 * r, length)], r - 1e-4, 16)
    elif kind == "whiteboard":
        barrel = barrel.painted(PAPER) + _rod([(0.96 * r, 0.2 * length), (0.96 * r, 0.3 * length)], r, 16)
        cap = _rod([(r, cut), (r, length - 0.003), (0.85 * r, length)], r, 16)
    else:
        barrel, cap = barrel + plug, _rod([(r, cut), (0.9 * r, length - 0.012), (0.45 * r, length)], r, 16)
        cap = cap.painted("white")
    clip = box(0.005, 0.003, length - cut - 0.006).moved(0.0, 0.98 * r, cut + 0.002)
    solid = barrel + cap + (clip if kind == "whiteboard" else cap)
    lift = 0.004 if kind == "felt-tip" else 0.0
    captions = fix_articles(
        f"a {color} {kind} marker with its cap on", f"{color} marker", f"{kind} marker pen in {color}", "thick felt pen"
    )
    return AssetDesign(solid.moved(z=lift), "plastic", color, captions, tilts=LYING)


def highlighter(draw: VariantSampler) -> AssetDesign:
    """A flat highlighter that stands on its end, its cap up."""
    length, width, thick = draw.between(0.105, 0.128), draw.between(0.02, 0.028), draw.between(0.011, 0.015)
    name = draw.pick("yellow", "pink", "green", "orange", "blue", "purple")
    color = NEON[name]
    cut, dark = draw.between(0.56, 0.66) * length, draw.pick(True, False)

    def ring(share: float, z: float) -> FloatArray:
        return rectangle(share * width, min(1.0, share + 0.08) * thick, z, 0.003 * share)

    body = loft([ring(0.8, 0.0), ring(0.92, 0.004), ring(0.92, cut + 0.003)])
    cap = loft([ring(1.0, cut), ring(0.94, length - 0.004), ring(0.66, length)])
    clip = box(0.3 * width, 0.0024, length - cut - 0.002).moved(0.0, thick / 2 + 0.0008, cut - 0.008)
    label = panel(0.5 * width, 0.5 * cut, 0.0, "black" if not dark else color).turned(x=-90).moved(0.0, thick / 2, 0.48 * cut)
    body = body.painted("black") if dark else body
    captions = fix_articles(
        f"a {name} highlighter", f"fluorescent {name} highlighter pen", f"{name} text marker with its cap on"
    )
    return AssetDesign(join([body, cap, clip, label]), "plastic", color, captions, tilts=LYING, density=600.0)


def eraser(draw: VariantSampler) -> AssetDesign:
    """A rubber, lying flat."""
    n, kind = draw.between(0.042, 0.065), draw.pick("sleeve", "slanted", "two-color")
    width, thick = n * draw.between(0.38, 0.48), draw.between(0.011, 0.016)
    color, second = draw.pick("white", "pink", "cream", "green"), draw.pick("blue", "red", "black", "orange", "navy", "grey")
    if kind == "sleeve":
        sleeve = box(0.62 * n, width + 0.0014, thick + 0.0014).moved(0.14 * n).painted(second)
        mark = panel(0.3 * n, 0.3 * width, thick + 0.0014, "white", 0.14 * n)
        solid, text = slab(n, width, thick, 0.0025) + sleeve + mark, f"in a {second} sleeve"
    elif kind == "slanted":
        shape = scaled([(-0.58, 0.0), (0.42, 0.0), (0.58, 1.0), (-0.42, 1.0)], n, thick)
        solid, text = silhouette(shape, width) + panel(0.44 * n, 0.4 * width, thick, second), f"with a {second} print"
    else:
        end = box(0.36 * n + 0.0004, width - 0.0004, thick - 0.0002).moved(0.32 * n).painted(second)
        solid, text = slab(0.64 * n, width, thick, 0.001).moved(-0.18 * n) + end, f"with a {second} end"
    captions = fix_articles(f"a {color} eraser {text}", f"{color} eraser", f"small {color} rubber {text}", "pencil eraser")
    return AssetDesign(solid, "rubber", color, captions)


FAMILIES = (pen, pencil, marker, highlighter, eraser)
