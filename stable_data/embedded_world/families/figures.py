"""Animal figures."""

from dataclasses import dataclass

from stable_data.embedded_world.modelling.family import AssetDesign, VariantSampler
from stable_data.embedded_world.modelling.shapes import ellipsoid, rod, round_body
from stable_data.embedded_world.modelling.solids import Solid, bar, box, join, lathe, loft, rectangle, slab


@dataclass(frozen=True, slots=True)
class _Clay:
    """Rounded parts of figures; their measures are metres in a figure of size 1.

    Attributes:
        size: Size of the figure.
        dark: Colour of the eyes.
    """

    size: float
    dark: str

    def blob(self, x: float, y: float, z: float, wide: float, deep: float, high: float, tint: str | None = None) -> Solid:
        """An ellipsoid around a point from its half axes."""
        s = self.size
        part = ellipsoid(wide * s, deep * s, high * s, 16 if wide + deep > 0.03 else 10).moved(x * s, y * s, z * s)
        return part.painted(tint) if tint else part

    def foot(self, wide: float, deep: float, high: float) -> Solid:
        """A flat round base."""
        return round_body([(wide * self.size, 0.0), (wide * self.size, high * self.size)], 24, deep / wide)

    def eyes(self, x: float, y: float, z: float, radius: float) -> list[Solid]:
        """An eye on each side."""
        return [self.blob(side * x, y, z, radius, radius, radius, self.dark) for side in (-1, 1)]


def _cat(clay: _Clay) -> list[Solid]:
    s, blob = clay.size, clay.blob
    rings = [rectangle(0.013 * s, 0.008 * s, 0.0), rectangle(0.002 * s, 0.002 * s, 0.017 * s)]
    ears = [loft(rings).moved(i * 0.011 * s, -0.008 * s, 0.088 * s) for i in (-1, 1)]
    path = [(0.012 * s, 0.006 * s), (0.04 * s, 0.006 * s), (0.046 * s, 0.014 * s), (0.046 * s, 0.04 * s)]
    tail = bar(path, 0.009 * s, 0.009 * s, 8).moved(y=0.014 * s)
    legs = [blob(i * 0.01, -0.024, 0.02, 0.008, 0.009, 0.02) for i in (-1, 1)]
    body = [clay.foot(0.026, 0.027, 0.008), blob(0, 0.004, 0.026, 0.028, 0.03, 0.026), blob(0, -0.004, 0.05, 0.019, 0.02, 0.03)]
    head = [blob(0, -0.01, 0.08, 0.021, 0.018, 0.017), *clay.eyes(0.009, -0.025, 0.084, 0.0036), *ears]
    return [*body, *head, *legs, tail, blob(0, -0.028, 0.077, 0.003, 0.003, 0.0024, "pink")]


def _owl(clay: _Clay) -> list[Solid]:
    s, blob = clay.size, clay.blob
    tufts = [lathe([(0.009 * s, 0.0), (0.002 * s, 0.018 * s)], 8).moved(i * 0.016 * s, 0.0, 0.09 * s) for i in (-1, 1)]
    wings = [blob(i * 0.029, 0.004, 0.045, 0.008, 0.02, 0.03) for i in (-1, 1)]
    discs = [blob(i * 0.012, -0.021, 0.08, 0.012, 0.006, 0.012, "cream") for i in (-1, 1)]
    beak = lathe([(0.001 * s, 0.065 * s), (0.0055 * s, 0.076 * s)], 8).moved(y=-0.026 * s).painted("orange")
    body = [clay.foot(0.024, 0.024, 0.01), blob(0, 0, 0.045, 0.031, 0.029, 0.043), blob(0, 0, 0.08, 0.028, 0.025, 0.02)]
    return [*body, *tufts, *wings, *discs, *clay.eyes(0.012, -0.026, 0.08, 0.0052), beak]


def _rabbit(clay: _Clay) -> list[Solid]:
    blob = clay.blob
    ears = [blob(i * 0.01, 0.002, 0.1, 0.0065, 0.0045, 0.026) for i in (-1, 1)]
    paws = [blob(i * 0.013, -0.024, 0.0084, 0.009, 0.014, 0.0086) for i in (-1, 1)]
    body = [clay.foot(0.026, 0.027, 0.008), blob(0, 0.004, 0.028, 0.029, 0.03, 0.029)]
    head = [blob(0, -0.006, 0.066, 0.021, 0.021, 0.02), *ears]
    eyes = clay.eyes(0.012, -0.023, 0.07, 0.0035)
    return [*body, *head, *paws, *eyes, blob(0, 0.035, 0.018, 0.009, 0.009, 0.009, "cream")]


def _bird(clay: _Clay) -> list[Solid]:
    s, blob = clay.size, clay.blob
    tail = slab(0.02 * s, 0.04 * s, 0.006 * s, 0.0015).turned(x=22).moved(0.0, 0.042 * s, 0.028 * s)
    cone = lathe([(0.006 * s, 0.0), (0.001 * s, 0.016 * s)], 8)
    beak = cone.turned(x=90).moved(0.0, -0.042 * s, 0.057 * s).painted("orange")
    body = [clay.foot(0.022, 0.022, 0.02), blob(0, 0, 0.03, 0.026, 0.036, 0.026), blob(0, -0.026, 0.056, 0.019, 0.019, 0.018)]
    eyes = clay.eyes(0.014, -0.037, 0.06, 0.0034)
    return [*body, tail, beak, *eyes, *(blob(i * 0.022, 0.008, 0.034, 0.007, 0.024, 0.014) for i in (-1, 1))]


def _elephant(clay: _Clay) -> list[Solid]:
    s, blob = clay.size, clay.blob
    leg = [(0.0105 * s, 0.0), (0.0095 * s, 0.035 * s)]
    legs = [round_body(leg, 12).moved(i * 0.015 * s, j * s) for i in (-1, 1) for j in (-0.016, 0.022)]
    path = [(0.04 * s, 0.058 * s), (0.058 * s, 0.04 * s), (0.06 * s, 0.02 * s), (0.074 * s, 0.016 * s)]
    trunk = bar(path, 0.011 * s, 0.011 * s, 10).turned(z=-90)
    ears = [blob(i * 0.026, -0.024, 0.06, 0.006, 0.016, 0.02).turned(z=-i * 8.0) for i in (-1, 1)]
    body = [*legs, blob(0, 0.002, 0.046, 0.028, 0.036, 0.026), blob(0, -0.034, 0.06, 0.022, 0.02, 0.022)]
    eyes, tusks = clay.eyes(0.014, -0.048, 0.066, 0.0035), []
    for i in (-1, 1):
        root, tip = (i * 0.012 * s, -0.044 * s, 0.046 * s), (i * 0.014 * s, -0.066 * s, 0.042 * s)
        tusks.append(rod(root, tip, 0.0036 * s, 0.0018 * s).painted("cream"))
    return [*body, trunk, *ears, *eyes, *tusks]


def _stones(clay: _Clay) -> list[Solid]:
    s, tints = clay.size, (None, "grey", "cream", "black")
    places = ((0, 0, 0.013, 0.042, 0.034), (0.004, 0, 0.034, 0.032, 0.027), (-0.003, 0.002, 0.053, 0.024, 0.02))
    stones = [
        clay.blob(*place, 0.0135 if k == 0 else 0.0115, tint)
        for k, (place, tint) in enumerate(zip((*places, (0.001, 0, 0.07, 0.015, 0.014)), tints, strict=True))
    ]
    return [*stones, round_body([(0.05 * s, 0.0), (0.05 * s, 0.006 * s)], 32).painted("walnut")]


_FIGURES = {"cat": _cat, "owl": _owl, "rabbit": _rabbit, "bird": _bird, "elephant": _elephant, "stones": _stones}


def figurine(draw: VariantSampler) -> AssetDesign:
    """A little figure: a cat, an owl, a rabbit, a bird, an elephant, stacked stones."""
    kind = draw.pick(*_FIGURES)
    color = draw.pick("white", "black", "teal", "gold", "grey", "terracotta")
    parts = _FIGURES[kind](_Clay(draw.between(0.85, 1.2), "gold" if color == "black" else "black"))
    words = {"stones": "stack of balanced stones"}.get(kind, f"{kind} figurine")
    captions = (f"a small {color} {words}", f"{color} {words}", f"ceramic ornament, {words}", "little figure for a shelf")
    return AssetDesign(join(parts), "ceramic", color, captions, density=1400.0)


def piggy_bank(draw: VariantSampler) -> AssetDesign:
    """A money box shaped as a pig, its snout to -y."""
    s, plump = draw.between(0.85, 1.2), draw.between(0.9, 1.1)
    color, accent = draw.pick("pink", "white", "gold", "blue", "#e9b7b0", "teal"), draw.pick("red", "#b86a72", "black")
    body = ellipsoid(0.05 * s * plump, 0.062 * s, 0.048 * s * plump, 24).moved(z=0.058 * s)
    snout = round_body([(0.02 * s, 0.0), (0.018 * s, 0.026 * s)], 20, 0.85).turned(x=90).moved(0.0, -0.05 * s, 0.058 * s)
    holes = [
        round_body([(0.0042 * s, 0.0), (0.0042 * s, 0.003)], 8)
        .turned(x=90)
        .moved(i * 0.0075 * s, 0.0015 - 0.0765 * s, 0.058 * s)
        .painted(accent)
        for i in (-1, 1)
    ]
    legs = [
        round_body([(0.0135 * s, 0.0), (0.0145 * s, 0.035 * s)], 16).moved(i * 0.025 * s, j * 0.03 * s)
        for i in (-1, 1)
        for j in (-1, 1)
    ]
    ears = [
        loft([rectangle(0.024 * s, 0.009 * s, 0.0), rectangle(0.005 * s, 0.004 * s, 0.028 * s)])
        .turned(x=18, y=22 * i)
        .moved(i * 0.024 * s, -0.034 * s, 0.088 * s)
        for i in (-1, 1)
    ]
    eyes = [
        ellipsoid(0.0042 * s, 0.0042 * s, 0.0042 * s, 10).moved(i * 0.02 * s, -0.051 * s, 0.075 * s).painted("black")
        for i in (-1, 1)
    ]
    slot = box(0.006, 0.034 * s, 0.012).moved(0.0, 0.008 * s, 0.058 * s + 0.9512 * 0.048 * s * plump - 0.01).painted("black")
    curl = ellipsoid(0.006 * s, 0.011 * s, 0.006 * s, 10).moved(0.0, 0.064 * s, 0.066 * s)
    name = {"#e9b7b0": "rosy"}.get(color, color)
    captions = (f"a {name} piggy bank with a slot in its back", f"{name} piggy bank", "money box shaped like a pig")
    return AssetDesign(join([body, snout, *holes, *legs, *ears, *eyes, slot, curl]), "ceramic", color, captions, density=900.0)


FAMILIES = (figurine, piggy_bank)
