"""Contents of screens: digits, windows. Lengths in metres; all lie on a level surface and are read from -y."""

from stable_data.embedded_world.families.palette import DARK_GLASS
from stable_data.embedded_world.modelling.shapes import panel
from stable_data.embedded_world.modelling.solids import Solid, join

WALLPAPERS = ("#4f86b8", "#7a6fae", "#4d9a8d", "#c7785a", "#39424f", "#86b0d6")
_SEGMENTS = {
    "0": "abcdef", "1": "bc", "2": "abged", "3": "abgcd", "4": "fgbc", "5": "afgcd", "6": "afgedc", "7": "abc",
    "8": "abcdefg", "9": "abfgcd",
}  # fmt: skip


def digits(text: str, height: float, z: float, color: str) -> Solid:
    """Luminous digits on a level surface, read from -y; a colon is two dots."""
    wide, stroke, parts = 0.52 * height, 0.13 * height, []
    middle, side, x = (height - stroke) / 2, (wide - stroke) / 2, 0.0
    place = {
        "a": (0, middle),
        "g": (0, 0),
        "d": (0, -middle),
        "f": (-side, 1),
        "b": (side, 1),
        "e": (-side, -1),
        "c": (side, -1),
    }
    for sign in text:
        if sign == ":":
            parts += [panel(stroke, stroke, z, color, x - 0.2 * wide, y) for y in (-0.2 * height, 0.2 * height)]
            x += 0.6 * wide
            continue
        for name in _SEGMENTS[sign]:
            dx, dy = place[name]
            size = (wide, stroke) if name in "agd" else (stroke, middle + stroke)
            parts.append(panel(*size, z, color, x + dx, dy if name in "agd" else dy * middle / 2))
        x += 1.4 * wide
    return join(parts).moved(-(x - 1.4 * wide) / 2)


def lit_screen(width: float, depth: float, z: float, paper: str) -> Solid:
    """A lit screen on a level surface: glass, wallpaper and two windows."""
    glass = panel(width, depth, z, DARK_GLASS)
    lit = panel(0.96 * width, 0.93 * depth, z + 0.0008, paper, rise=0.0004)
    at = z + 0.0012
    window = panel(0.44 * width, 0.56 * depth, at, "#eef1f4", -0.18 * width, 0.06 * depth, 0.0004)
    head = panel(0.44 * width, 0.07 * depth, at + 0.0004, "#7d8791", -0.18 * width, 0.3 * depth, 0.0004)
    side = panel(0.3 * width, 0.4 * depth, at, "#2b323b", 0.26 * width, -0.08 * depth, 0.0004)
    return join([glass, lit, window, head, side])
