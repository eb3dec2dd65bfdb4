"""Books, notes and other paper on a desk."""

import math
from itertools import pairwise

from stable_data.embedded_world.families.palette import NEON, PAPER
from stable_data.embedded_world.families.wording import fix_articles
from stable_data.embedded_world.modelling.family import ON_EDGE, AssetDesign, SupportArea, VariantSampler
from stable_data.embedded_world.modelling.shapes import disc, hoop, panel, prism, scaled, silhouette
from stable_data.embedded_world.modelling.solids import Solid, box, join, lathe
from stable_data.scene import UPRIGHT

_PAGES = "#f3ecd9"
_INK = "#7d8288"


def _lines(width: float, depth: float, z: float, count: int, x: float = 0.0, y: float = 0.0) -> Solid:
    """Lines of print, the last one short."""
    pitch, parts = depth / count, []
    for k in range(count):
        long = width if k < count - 1 else 0.6 * width
        parts.append(panel(long, 0.32 * pitch, z, _INK, x + (long - width) / 2, y + depth / 2 - (k + 0.5) * pitch, 0.0004))
    return join(parts)


def _volume(length: float, width: float, thickness: float, cover: float, inset: float) -> Solid:
    """Covers, a spine at -y and the pages between them."""
    pages = box(length - 2 * inset, width - inset - cover / 2, thickness - cover).moved(0.0, -inset / 2, cover / 2)
    boards = [box(length, width, cover).moved(z=z) for z in (0.0, thickness - cover)]
    back = box(length, cover, thickness).moved(y=(cover - width) / 2)
    return join([*boards, back, pages.painted(_PAGES)])


def book(draw: VariantSampler) -> AssetDesign:
    """A closed book that lies flat, its spine towards the viewer and its head on the left."""
    length, thickness = draw.between(0.175, 0.28), draw.between(0.015, 0.045)
    width = length * draw.between(0.66, 0.8)
    kind = draw.pick("hardcover", "paperback", "old leather-bound")
    color = draw.pick("navy", "red", "teal", "brown", "green", "purple")
    second = draw.pick("cream", "gold", "white", "orange")
    cover, inset = (0.0014, 0.0006) if kind == "paperback" else (0.0028, 0.004)
    solid, top = _volume(length, width, thickness, cover, inset), SupportArea(0.96 * length, 0.96 * width, thickness)
    if kind == "old leather-bound":
        ridge = silhouette([(-0.003, 0.001), (0.006, 0.001), (0.006, thickness - 0.001), (-0.003, thickness - 0.001)], 0.006)
        ridge = ridge.turned(z=-90).turned(z=180).painted("gold")
        solid += join(ridge.moved(x * length, -width / 2) for x in (-0.36, -0.12, 0.12, 0.36))
    else:
        title = panel(0.24 * length, 0.84 * width, thickness, second, -0.31 * length)
        picture = panel(0.5 * length, 0.84 * width, thickness, draw.pick("grey", "cream", "white"), 0.16 * length)
        label = panel(0.4 * length, 0.5 * thickness, 0.0, second, -0.15 * length).turned(x=90)
        solid += title + picture + label.moved(y=-width / 2, z=thickness / 2)
        top = SupportArea(0.84 * length, 0.84 * width, thickness + 0.0008, x=-0.01 * length)
    captions = fix_articles(f"a {color} {kind} book", f"{color} book", f"{kind} book with a {color} cover", "a book to read")
    return AssetDesign(solid, "paper", color, captions, top=top, tilts=(UPRIGHT, ON_EDGE), density=600.0)


def notebook(draw: VariantSampler) -> AssetDesign:
    """A notebook that lies flat, its spine on the left."""
    length, thickness = draw.between(0.14, 0.297), draw.between(0.009, 0.02)
    width = length * draw.between(0.68, 0.78)
    kind = draw.pick("spiral", "elastic band", "cloth spine")
    color, second = draw.pick("black", "blue", "kraft", "green", "red", "pink"), draw.pick("silver", "white", "gold")
    if kind == "spiral":
        boards = [box(length, width, 0.0018, 0.004).moved(z=z) for z in (0.0, thickness - 0.0018)]
        solid = join([*boards, box(length - 0.002, width - 0.002, thickness - 0.0016, 0.004).moved(z=0.0008).painted(_PAGES)])
        radius = thickness / 2 + 0.0022
        ring = disc(radius, -0.001, 0.001, 16).turned(z=11.25).turned(y=90).painted(second)
        count = round(length / 0.016)
        solid += join(ring.moved((k - (count - 1) / 2) * 0.016, 0.004 - width / 2, radius) for k in range(count))
    else:
        solid = _volume(length, width, thickness, 0.002, 0.0012)
        size, y = (0.007, 0.36 * width) if kind == "elastic band" else (0.16 * width, -0.418 * width)
        solid += box(length + 0.0014, size, thickness - 0.0002).moved(y=y, z=0.001).painted(second)
    title = panel(0.26 * length, 0.5 * width, thickness, second if kind == "spiral" else PAPER, -0.18 * length)
    phrase = {"spiral": "spiral-bound", "elastic band": "pocket", "cloth spine": "cloth-bound"}[kind]
    captions = fix_articles(
        f"a {phrase} notebook with a {color} cover", f"{color} notebook", f"notebook with a {kind}", "notebook for notes"
    )
    return AssetDesign((solid + title).turned(z=-90), "paper", color, captions, density=550.0)


def magazine(draw: VariantSampler) -> AssetDesign:
    """A magazine that lies closed, or open in the middle."""
    width, depth = draw.between(0.19, 0.22), draw.between(0.26, 0.295)
    color = draw.pick("red", "teal", "navy", "white", "yellow", "pink")
    second = {"red": "yellow", "teal": "white", "navy": "orange", "white": "red", "yellow": "black", "pink": "navy"}[color]
    kind, picture = draw.pick("closed", "open", "closed"), draw.pick("#8fb3c9", "#c99b7b", "#9aa88a", "#5d6470")
    thick = draw.between(0.005, 0.009)
    top = None
    if kind == "open":
        curve = [(0.0, 0.4), (0.06, 0.86), (0.16, 1.0), (0.86, 1.0), (1.0, 0.8)]
        outline = [(-0.001, 0.0), (width, 0.0), *((width * a, 0.012 * b) for a, b in reversed(curve))]
        page = silhouette([*outline[:-1], (-0.001, 0.0048)], depth).painted(PAPER)
        solid = page + page.turned(z=180) + box(2 * width + 0.006, depth + 0.004, 0.0016)
        solid += panel(0.62 * width, 0.46 * depth, 0.012, picture, 0.51 * width, 0.2 * depth, 0.0004)
        solid += panel(0.62 * width, 0.1 * depth, 0.012, second, -0.51 * width, 0.36 * depth, 0.0004)
        solid += _lines(0.62 * width, 0.32 * depth, 0.012, 7, 0.51 * width, -0.24 * depth)
        solid += _lines(0.62 * width, 0.68 * depth, 0.012, 14, -0.51 * width, -0.08 * depth)
    else:
        pages = box(width - 0.0012, depth - 0.0012, thick - 0.002).moved(z=0.001).painted(PAPER)
        covers = [box(width, depth, 0.0014).moved(z=z) for z in (0.0, thick - 0.0014)]
        back = box(0.0014, depth - 0.0004, thick - 0.0004).moved(0.0007 - width / 2, 0.0, 0.0002)
        title = panel(0.86 * width, 0.15 * depth, thick, second, y=0.39 * depth, rise=0.0006)
        image = panel(0.86 * width, 0.5 * depth, thick, picture, y=0.03 * depth, rise=0.0006)
        at = (0.4 * width, 0.16 * depth, thick)
        boxes = [panel(*at, c, x * 0.23 * width, -0.34 * depth, 0.0006) for x, c in ((-1, second), (1, PAPER))]
        solid = join([pages, *covers, back, title, image, *boxes])
        top = SupportArea(0.8 * width, 0.8 * depth, thick + 0.0006)
    captions = fix_articles(f"a {kind} magazine with a {color} cover", f"{color} magazine", f"{kind} magazine lying flat")
    return AssetDesign(solid, "paper", color, captions, top=top, density=500.0)


def newspaper(draw: VariantSampler) -> AssetDesign:
    """A newspaper, folded flat or rolled up."""
    kind, width = draw.pick("folded", "twice-folded", "rolled"), draw.between(0.28, 0.36)
    depth, thick = width * draw.between(0.66, 0.76), draw.between(0.009, 0.016)
    color, headline = draw.pick("#dfdcd2", "#e6dfcc", "#f0d9c4"), draw.pick("black", "navy", "#7c2a2a")
    top = None
    if kind == "rolled":
        r = draw.between(0.022, 0.03)
        reach = math.cos(math.pi / 24)
        tube, band = (
            disc(radius, -long / 2, long / 2, 24).turned(z=7.5).turned(y=90).moved(z=radius * reach)
            for radius, long in ((r, width), (r + 0.0009, 0.012))
        )
        flap = silhouette([(-0.3 * r, 0.0), (1.1 * r, 0.0), (1.3 * r, 0.003), (0.6 * r, 0.012)], width - 0.01).turned(z=90)
        row = join(panel(0.32 * width, 0.0026, r * reach, _INK, x * width, rise=0.0004) for x in (-0.25, 0.25))
        print_ = [row.turned(x=15.0 * k).moved(z=r * reach) for k in (-2, -1, 0, 1, 2)]
        solid = join([tube, flap, band.painted("red"), *print_])
    else:
        if kind == "twice-folded":
            width *= 0.72
        lower = scaled([(0.003 / depth - 0.5, 0.0), (0.5, 0.0), (0.5, 0.46), (-0.5, 0.46), (-0.503, 0.24)], depth, thick)
        back = 0.5 * depth - 0.008
        upper = [(-depth / 2, 0.42 * thick), (back, 0.42 * thick), (back, thick)]
        upper += [(0.004 - depth / 2, thick), (-depth / 2, 0.7 * thick)]
        second = draw.pick(PAPER, color)
        solid = (silhouette(lower, width) + silhouette(upper, width - 0.004).painted(second)).turned(z=90)
        print_ = [
            panel(0.86 * width, 0.12 * depth, thick, headline, y=0.34 * depth, rise=0.0005),
            panel(0.4 * width, 0.34 * depth, thick, "#8b9197", -0.23 * width, 0.05 * depth, 0.0005),
            _lines(0.4 * width, 0.26 * depth, thick, 5, -0.23 * width, -0.29 * depth),
            *(_lines(0.19 * width, 0.64 * depth, thick, 11, x * width, -0.09 * depth) for x in (0.13, 0.34)),
        ]
        solid = join([solid, *print_])
        top = SupportArea(0.8 * width, 0.8 * depth, thick + 0.0005)
    captions = fix_articles(
        f"a {kind} newspaper", f"{kind} daily paper", "newspaper with a headline" if top else "paper in a rubber band"
    )
    return AssetDesign(solid, "paper", color, captions, top=top, density=400.0)


def envelope(draw: VariantSampler) -> AssetDesign:
    """An envelope or a pile of letters, lying flat."""
    width, kind = draw.between(0.16, 0.235), draw.pick("addressed", "sealed", "bundle")
    depth, thick = width * draw.between(0.5, 0.7), 0.0022
    color = draw.pick("white", "cream", "kraft", "#b8cfe0", "pink", "#cfd8c4")
    name = {"#b8cfe0": "pale blue", "#cfd8c4": "pale green"}.get(color, color)
    solid, z = box(width, depth, thick), thick
    if kind == "bundle":
        pile = ((0.96, 3, 0.004, PAPER), (1.0, -4, 0.0, "cream"), (0.9, 2, 0.01, "#b8cfe0"), (0.94, -1, 0.0, "white"))
        layers = [
            box(share * width, share * depth, thick + 4e-4).turned(z=turn).moved(x, 0.0, 0.0022 * k + 0.002).painted(coat)
            for k, (share, turn, x, coat) in enumerate(pile)
        ]
        z = 0.0022 * 5 + 0.0002
        strings = box(0.003, depth + 0.006, z - 0.0012).moved(z=0.002) + box(width + 0.006, 0.003, z - 0.001).moved(z=0.002)
        solid = join([solid, *layers, strings.painted("red")])
    elif kind == "sealed":
        flap = [(-0.499 * width, 0.498 * depth), (0.0, -0.12 * depth), (0.499 * width, 0.498 * depth)]
        under = prism([(x, -0.9 * y + 0.01 * depth) for x, y in flap], 0.001, thick + 0.0006).painted("#dcd6c8")
        fold = prism(flap, 0.001, thick + 0.0012).painted(PAPER if color != "white" else "cream")
        wax = lathe([(0.012, 0.001), (0.012, thick + 0.0018), (0.009, thick + 0.0028)]).moved(y=-0.06 * depth).painted("red")
        solid = join([solid, under, fold, wax])
    else:
        stamp = panel(0.12 * width, 0.26 * depth, z, draw.pick("red", "teal", "navy"), 0.41 * width, 0.33 * depth)
        sender = _lines(0.26 * width, 0.16 * depth, z, 2, -0.33 * width, 0.38 * depth)
        solid += stamp + sender + _lines(0.42 * width, 0.34 * depth, z, 4, 0.1 * width, -0.16 * depth)
    words = {
        "bundle": ("a bundle of letters tied with red string", "stack of envelopes", "pile of letters"),
        "sealed": (f"a {name} envelope with a wax seal", f"{name} envelope", "sealed letter"),
        "addressed": (f"a {name} envelope with a stamp", f"{name} envelope", "letter ready to post"),
    }[kind]
    return AssetDesign(solid, "paper", color, fix_articles(*words))


def paper_stack(draw: VariantSampler) -> AssetDesign:
    """Sheets of paper on a pile."""
    width, depth = draw.pick((0.21, 0.297), (0.216, 0.279), (0.148, 0.21))
    kind, thick = draw.pick("neat", "untidy", "clipped"), draw.between(0.004, 0.012)
    solid, z = box(width, depth, thick), thick
    turns = {"neat": (0.6, -0.4), "untidy": (7, -5, 12, 2), "clipped": ()}[kind]
    for k, turn in enumerate(turns):
        coat = draw.pick(PAPER, "cream", "#dfe8ee") if kind == "untidy" and k == 1 else ("#fbfaf6", "#eceae4")[k % 2]
        high = 0.003 + 0.003 * (k % 2)
        solid += box(width, depth, high).turned(z=turn).moved(0.006 * (turn > 5), 0.0, z - 4e-4).painted(coat)
        z += high - 4e-4
    turn = turns[-1] if turns else 0
    print_ = _lines(0.72 * width, 0.6 * depth, z, draw.pick(12, 9), y=-0.06 * depth)
    title = panel(0.4 * width, 0.035 * depth, z, "black", -0.16 * width, 0.36 * depth, 0.0004)
    solid += (print_ + title).turned(z=turn)
    if kind == "clipped":
        x, y = -0.32 * width, depth / 2
        side = [(y - 0.018, z + 0.0012), (y + 0.005, z + 0.0135), (y + 0.005, 0.0), (y - 0.018, 0.0004)]
        lever = box(0.012, 0.03, 0.0015).moved(y=y - 0.026, z=z + 0.0002)
        solid += (silhouette(side, 0.03).turned(z=90) + lever).moved(x).painted("black")
    detail = {"neat": "neat stack", "untidy": "untidy pile", "clipped": "clipped bundle"}[kind]
    captions = fix_articles(
        f"a {detail} of printed papers", "stack of papers", f"{detail} of documents", "sheets of paper with text"
    )
    top = SupportArea(0.8 * width, 0.8 * depth, z + 0.0004) if kind == "neat" else None
    return AssetDesign(solid, "paper", "#f0eee8", captions, top=top)


def sticky_notes(draw: VariantSampler) -> AssetDesign:
    """A pad or a cube of sticky notes."""
    side, kind = draw.between(0.05, 0.078), draw.pick("pad", "cube", "set")
    name = draw.pick("yellow", "pink", "green", "orange", "blue", "purple")
    color, others = NEON[name], [NEON[other] for other in ("pink", "green", "blue", "orange", "yellow")]
    if kind == "cube":
        step = draw.between(0.007, 0.011)
        layers = [
            box(side, side, step + 0.0004).turned(z=turn).moved(z=k * step).painted(coat)
            for k, (turn, coat) in enumerate(zip((1.5, -1.0, 0.5, -2.0, 1.0), others, strict=True))
        ]
        solid, z = join(layers), 5 * step + 0.0004
        solid += box(side, side, 0.003).moved(z=z - 0.0004)
        z += 0.0026
    elif kind == "set":
        z = draw.between(0.006, 0.012)
        card = box(side + 0.012, side + 0.022, 0.0022).painted("white")
        pads = [box(side, 0.34 * side, z).moved(y=y * 0.339 * side).painted(c) for y, c in ((-1, others[0]), (1, others[2]))]
        solid = join([card, box(side - 0.001, 0.34 * side + 4e-4, z - 4e-4), *pads])
    else:
        z = draw.between(0.009, 0.018)
        solid = box(side, side, z)
        lift = draw.between(0.008, 0.016)
        curl = [(0.5, 0.0), (0.05, 0.0), (-0.3, 0.4 * lift), (-0.5, lift)]
        for (back, low), (front, high) in pairwise(curl):
            ends = [(back, low - 4e-4), (back, low + 0.0012), (front, high + 0.0012), (front, high - 4e-4)]
            solid += silhouette(scaled(ends, side, 1.0), side - 0.001).turned(z=90).moved(z=z)
        solid += _lines(0.6 * side, 0.3 * side, z + 0.0012, 3, y=0.26 * side)
    text = "sticky note cube in several colors" if kind == "cube" else f"{name} sticky note {kind}"
    plain = "colorful sticky notes" if kind == "cube" else f"{name} sticky notes"
    captions = fix_articles(f"a {text}", plain, "sticky notes for reminders", "block of self-adhesive notes")
    top = SupportArea(0.9 * side, 0.9 * side, z) if kind == "cube" else None
    return AssetDesign(solid, "paper", color, captions, top=top)


def binder(draw: VariantSampler) -> AssetDesign:
    """A ring binder, its spine towards the viewer when it stands."""
    length, width, thickness = 0.318, draw.between(0.26, 0.29), draw.between(0.045, 0.08)
    color = draw.pick("black", "blue", "red", "green", "grey", "yellow")
    papers = draw.between(0.4, 0.8) * thickness
    boards = [box(length, width, 0.003).moved(z=z) for z in (0.0, thickness - 0.003)]
    back = box(length - 0.0004, 0.003, thickness - 0.0004).moved(0.0, (0.003 - width) / 2, 0.0002)
    sheets = box(0.297, 0.215, papers).moved(0.0, 0.01, 0.002).painted(PAPER)
    arch = box(0.12, 0.06, thickness - 0.002).moved(0.0, -width / 2 + 0.032, 0.001).painted("silver")
    label = panel(0.17, 0.7 * thickness, 0.0, PAPER, -0.05) + _lines(0.12, 0.4 * thickness, 0.0008, 2, -0.05)
    eye = hoop(0.026, 0.026, 0.003, 0.004, 12).moved(0.11, 0.0, -0.0012).painted("silver")
    front = (label + eye).turned(x=90).moved(y=-width / 2, z=thickness / 2)
    thick = "thick" if thickness > 0.06 else "slim"
    captions = fix_articles(
        f"a {thick} {color} ring binder", f"{color} binder", f"{color} lever arch file", "binder full of papers"
    )
    solid, tilts = join([*boards, back, sheets, arch, front]), draw.pick((ON_EDGE, UPRIGHT), (UPRIGHT, ON_EDGE))
    return AssetDesign(solid, "cardboard", color, captions, tilts=tilts, density=400.0)


def clipboard(draw: VariantSampler) -> AssetDesign:
    """A clipboard with sheets under its clip, which is at the back."""
    width, depth = draw.between(0.22, 0.24), draw.between(0.31, 0.34)
    color, papers = draw.pick("brown", "black", "blue", "clear", "red", "oak"), draw.between(0.002, 0.008)
    z = 0.0035 + papers
    sheets = box(width - 0.016, depth - 0.045, papers + 0.0005).moved(0.0, -0.012, 0.003).painted(PAPER)
    written = _lines(0.66 * width, 0.6 * depth, z, draw.pick(9, 12, 7), y=-0.03)
    y = depth / 2 - 0.018
    jaw = box(0.46 * width, 0.032, z).moved(0.0, y, 0.003) + box(0.4 * width, 0.012, 0.006).moved(0.0, y + 0.008, z + 0.002)
    roll = lathe([(0.006, -0.23 * width), (0.006, 0.23 * width)]).turned(y=90).moved(0.0, y - 0.014, z + 0.0045)
    tab = prism([(-0.05, 0.0), (0.05, 0.0), (0.03, 0.03), (-0.03, 0.03)], 0.0, 0.002).turned(x=20)
    clip = join([jaw, roll, tab.moved(0.0, y, z + 0.005)]).painted("silver")
    material = "wood" if color in ("brown", "oak") else "plastic"
    captions = fix_articles(f"a {color} clipboard with sheets of paper", f"{color} clipboard", "clipboard with a metal clip")
    return AssetDesign(join([box(width, depth, 0.0035, 0.01), sheets, written, clip]), material, color, captions)


FAMILIES = (book, notebook, magazine, newspaper, envelope, paper_stack, sticky_notes, binder, clipboard)
