"""A table as a piece of furniture in a room: what pictures show of it. Nothing here collides.

The table top is the slab below z = 0 over the table's rectangle. What carries it, its materials, the floor and the walls follow
from the table's type alone, so that scenes of a type look alike. Instead of the room there may be a plain floor, or nothing.
"""

import math
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache
from itertools import pairwise
from types import MappingProxyType
from typing import Literal, TypeAlias

import numpy as np

from stable_data.geometry.mesh_colors import to_linear
from stable_data.geometry.surface import Surface
from stable_data.scene import FloatArray, Rectangle, Tabletop
from stable_data.simulation.materials import Material, basin, cloth, planks, stone, tiles, wood

TABLE_THICKNESS = 0.03
"""Thickness of a table top in pictures, metres."""

TABLE_TOP, TABLE_FRAME, FLOOR, WALL, RESTRICTED_ZONE = "table/top", "table/frame", "room/floor", "room/wall", "restricted_zone"

_SINK_RISE = 4e-4  # above the table top, so that it is visible, metres
_LAYER = 0.005  # upper layer of a table top, metres
_CHAMFER = 0.002  # of the upper edge of a table top, metres
_SIDE_WALL = 2.5  # from the table to the wall on its right, metres
_FLOOR_MARGIN = 6.0  # on the left and in front, metres
_WALL_HEIGHT = 3.0  # above the floor, metres
_PLAIN_MARGIN = 60.0  # of a plain floor, on all sides, metres: its end is above the picture

Surroundings: TypeAlias = Literal["room", "floor", "none"]
"""What is around the table: a room of its kind, a plain grey floor, or nothing on a black background."""

_PLAIN_FLOOR = Material("plain_floor", "#b9b9b7", gloss=0.0)

Support: TypeAlias = Literal["square legs", "tapered legs", "round legs", "steel frame", "cabinet", "low cabinet"]


@dataclass(frozen=True, slots=True)
class Design:
    """How a kind of table looks, and the room where it stands.

    Attributes:
        words: Words of the table types that it is for.
        height: Of the table top above the floor, metres.
        support: What carries the top.
        top: Material of the top.
        body: Material of legs and boards.
        metal: Material of handles.
        wall: Material of the walls.
        floor: Material of the floor.
        wall_gap: From the back edge to the wall, metres.
        edge: Material of the sides of the top; None: that of the top.
        front: Material of doors and drawers; None: that of the body.
        drawers: Drawers in the board below the top.
        has_shelf: Whether a shelf joins the legs.
        is_wet: Whether its restricted zone is a basin with a drain.
    """

    words: str
    height: float
    support: Support
    top: Material
    body: Material
    metal: Material
    wall: Material
    floor: Material
    wall_gap: float
    edge: Material | None = None
    front: Material | None = None
    drawers: int = 0
    has_shelf: bool = False
    is_wet: bool = False


@dataclass(frozen=True, slots=True, eq=False)
class RoomPart:
    """What is seen of a room in one material.

    Attributes:
        name: Such as ``table/top``; unique in a room.
        material: Its material.
        surface: Its triangles, metres, world frame.
    """

    name: str
    material: Material
    surface: Surface

    @property
    def is_of_table(self) -> bool:
        """Whether it belongs to the table and not to the room around it."""
        return not self.name.startswith("room/")


@lru_cache(maxsize=1)
def designs() -> tuple[Design, ...]:
    """The designs; the first with a word of a table type is taken, the last is for all others."""
    steel, brass = Material("steel", "#8d9297", gloss=0.5), Material("brass", "#b59a64", gloss=0.5)
    black = Material("black_steel", "#3b3e42", gloss=0.3)
    oak = wood("oak", "#a2764a", "#cfa878")
    pale = wood("pale_oak", "#b69468", "#d8bd94")
    band = Material("edge_band", "#7d6a54")
    walnut = wood("walnut", "#5d4230", "#8d6a4e")
    cherry = wood("cherry", "#85593a", "#b4855e")
    beech = wood("beech", "#b0845c", "#d4ab84")
    granite = stone("granite", "#696866", "#a8a5a0")
    sandstone = stone("sandstone", "#8a7c69", "#b5a792")
    painted = Material("painted_wood", "#d9d4c8", gloss=0.15)
    sage = Material("sage_paint", "#a3ada0", gloss=0.15)
    plaster, cool, warm = (
        Material(f"{name}plaster", colour, gloss=0.0, glow=0.28)
        for name, colour in (("", "#dedad3"), ("cool_", "#d6dadd"), ("warm_", "#e0d7cb"))
    )
    boards, grey_boards = planks("oak_boards", "#8f7559", "#b99c79"), planks("grey_boards", "#857c72", "#aaa196")
    carpet = cloth("carpet", "#858a8f", "#a3a7ab")
    wall_tiles = tiles("wall_tiles", "#c6c5c0", "#dfddd8", (0.2, 0.1), 0.28)
    bath_tiles = tiles("bath_tiles", "#b7c0c3", "#d3dbdd", (0.15, 0.15), 0.28)
    floor_tiles = tiles("floor_tiles", "#9c9992", "#c0bdb5", (0.4, 0.4), 0.1)
    # fmt: off
    return (
        Design("counter kitchen island worktop", 0.9, "cabinet", granite, sage, steel, wall_tiles, floor_tiles, 0.0, is_wet=True),
        Design("vanity bathroom washstand sink", 0.84, "cabinet", sandstone, oak, black, bath_tiles, floor_tiles, 0.0, is_wet=True),
        Design("dressing makeup", 0.76, "round legs", beech, painted, brass, warm, boards, 0.02, drawers=2),
        Design("nightstand bedside", 0.55, "low cabinet", walnut, walnut, brass, cool, grey_boards, 0.02, front=cherry),
        Design("tv sideboard console cabinet dresser", 0.5, "low cabinet", oak, painted, black, plaster, boards, 0.02),
        Design("coffee", 0.42, "square legs", walnut, walnut, brass, plaster, boards, 0.9, has_shelf=True),
        Design("side", 0.52, "round legs", oak, oak, brass, warm, grey_boards, 0.3, has_shelf=True),
        Design("office desk writing study computer work workbench", 0.74, "steel frame", pale, black, black, cool, carpet, 0.05,
               edge=band),
        Design("", 0.75, "tapered legs", cherry, cherry, brass, plaster, boards, 0.9),
    )
    # fmt: on


def design_of(table_type: str) -> Design:
    """Returns the design of a kind of table; a dining table if its words are not known."""
    words = set(table_type.lower().replace("-", "_").split("_"))
    *known, other = designs()
    return next((design for design in known if words & set(design.words.split())), other)


def furnish(
    table: Tabletop,
    low: FloatArray,
    high: FloatArray,
    support: tuple[FloatArray, FloatArray] | None = None,
    surroundings: Surroundings = "room",
) -> tuple[RoomPart, ...]:
    """Returns the table and its surroundings; the surroundings alone if the table is a surface of a support.

    Args:
        table: The table top.
        low: Lowest corner of objects and table, (3,), metres, world frame. The room keeps clear of what is there.
        high: Highest corner.
        support: Lowest and highest corner of the support, (3,) each, metres, world frame; it stands on the floor.
        surroundings: What is around the table.
    """
    design = design_of(table.table_type)
    joinery = _Joinery()
    if support is None:
        floor = min(-design.height, float(low[2]) - 0.01)
        _add_top(joinery, table, design)
        if table.restricted_zone is not None:
            _add_zone(joinery, table.restricted_zone, design)
        _SUPPORTS[design.support](joinery, table.size_xy, floor, design)
    else:
        low, high, floor = np.minimum(low, support[0]), np.maximum(high, support[1]), float(support[0][2])
    if surroundings == "room":
        _add_room(joinery, table, design, (low, high), floor)
    elif surroundings == "floor":
        _add_plain_floor(joinery, (low, high), floor)
    return joinery.parts()


class _Joinery:
    """Collects the triangles of boards, legs and walls by part and material."""

    def __init__(self) -> None:
        self._pieces: dict[tuple[str, Material], list[tuple[FloatArray, FloatArray]]] = {}
        self._number = 0

    def board(
        self, part: str, material: Material, low: Sequence[float], high: Sequence[float], grain: str = "x", chamfer: float = 0.0
    ) -> None:
        """Adds a box between two corners, metres; its upper edge is cut at 45 degrees over a width, metres."""
        lower, upper = _rectangle(low[0], high[0], low[1], high[1]), _rectangle(low[0], high[0], low[1], high[1], chamfer)
        levels = (
            [(lower, low[2]), (lower, high[2] - chamfer), (upper, high[2])] if chamfer else [(lower, low[2]), (lower, high[2])]
        )
        self.loft(part, material, levels, grain)

    def leg(
        self,
        part: str,
        material: Material,
        at: tuple[float, float],
        z: tuple[float, float],
        width: tuple[float, float],
        sides: int,
    ) -> None:
        """Adds a leg with widths at its foot and at its head, metres, square or round."""
        turn = math.pi / 4 if sides == 4 else 0.0
        angles = turn + 2 * np.pi * np.arange(sides) / sides
        ring = np.stack([np.cos(angles), np.sin(angles)], axis=1) / (math.sqrt(2.0) if sides == 4 else 2.0)
        self.loft(part, material, [(at + w * ring, height) for w, height in zip(width, z, strict=True)], "z")

    def loft(self, part: str, material: Material, levels: Sequence[tuple[FloatArray, float]], grain: str) -> None:
        """Adds a solid through convex polygons (N, 2), counter-clockwise, at rising heights."""
        rings = [np.column_stack([ring, np.full(len(ring), z)]) for ring, z in levels]
        triangles, uv = [], []
        around = np.r_[0.0, np.cumsum(np.linalg.norm(np.roll(rings[0], -1, axis=0) - rings[0], axis=1))]
        for a, b in pairwise(rings):
            for k in range(len(a)):
                n = (k + 1) % len(a)
                corners = np.array([[a[k], a[n], b[n]], [a[k], b[n], b[k]]])
                along = np.array([[around[k], around[k + 1], around[k + 1]], [around[k], around[k + 1], around[k]]])
                pair = (corners[..., 2], along) if grain == "z" else (along, corners[..., 2])
                triangles.append(corners)
                uv.append(np.stack(pair, axis=-1))
        for ring in (rings[0][::-1], rings[-1]):
            fan = np.array([[ring[0], ring[k], ring[k + 1]] for k in range(1, len(ring) - 1)])
            triangles.append(fan)
            uv.append(fan[..., [1, 0]] if grain == "y" else fan[..., :2])
        self._number += 1
        # Each piece is cut from another place of the material.
        shift = np.array([0.37, 0.61]) * self._number
        self.add(part, material, np.concatenate(triangles), np.concatenate(uv) / material.tile + shift)

    def sheet(self, part: str, material: Material, corner: FloatArray, along: FloatArray, across: FloatArray) -> None:
        """Adds a rectangle that is seen from one side: ``along`` × ``across`` points to the viewer."""
        lengths = np.linalg.norm([along, across], axis=1)
        uv = np.array([[[0.0, 0.0], [1.0, 0.0], [1.0, 1.0]], [[0.0, 0.0], [1.0, 1.0], [0.0, 1.0]]])
        self.add(part, material, corner + uv @ np.array([along, across]), uv * lengths / material.tile)

    def add(self, part: str, material: Material, triangles: FloatArray, uv: FloatArray) -> None:
        """Adds triangles (F, 3, 3) with texture coordinates (F, 3, 2), shares of the image, height upwards."""
        self._pieces.setdefault((part, material), []).append((triangles, uv * (1.0, -1.0)))

    def parts(self) -> tuple[RoomPart, ...]:
        """What was added; the second and later materials of a part have numbers in their names."""
        found: list[RoomPart] = []
        numbers = Counter[str]()
        for (part, material), pieces in self._pieces.items():
            name = f"{part}_{numbers[part]}" if numbers[part] else part
            numbers[part] += 1
            triangles, uv = (np.concatenate(arrays) for arrays in zip(*pieces, strict=True))
            if material.image is None:
                red, green, blue = to_linear(np.array([int(material.colour[k : k + 2], 16) / 255 for k in (1, 3, 5)])).tolist()
                surface = Surface(triangles, colour=(red, green, blue))
            else:
                surface = Surface(triangles, image=material.image, corner_uv=uv)
            found.append(RoomPart(name, material, surface))
        return tuple(found)


def _rectangle(x_min: float, x_max: float, y_min: float, y_max: float, inset: float = 0.0) -> FloatArray:
    """Corners, (4, 2), counter-clockwise from the near left."""
    x_min, x_max, y_min, y_max = x_min + inset, x_max - inset, y_min + inset, y_max - inset
    return np.array([[x_min, y_min], [x_max, y_min], [x_max, y_max], [x_min, y_max]])


def _add_top(joinery: _Joinery, table: Tabletop, design: Design) -> None:
    """The slab: its upper layer has the material of the top, the rest that of the edge."""
    x, y = table.size_xy
    joinery.board(TABLE_TOP, design.top, (0.0, 0.0, -_LAYER), (x, y, 0.0), chamfer=min(_CHAMFER, x / 50, y / 50))
    joinery.board(TABLE_TOP, design.edge or design.top, (0.0, 0.0, -TABLE_THICKNESS), (x, y, -_LAYER))


def _add_zone(joinery: _Joinery, zone: Rectangle, design: Design) -> None:
    """The restricted zone, a plate that lies on the table."""
    x_min, x_max, y_min, y_max = zone
    corners = np.column_stack([_rectangle(*zone), np.full(4, _SINK_RISE)])
    uv = np.array([[0.0, 0.0], [1.0, 0.0], [1.0, 1.0], [0.0, 1.0]])
    aspect = round(min(max((x_max - x_min) / (y_max - y_min), 0.125), 8.0), 1)
    triangles = np.array([[0, 1, 2], [0, 2, 3]])
    joinery.add(RESTRICTED_ZONE, basin(aspect, has_drain=design.is_wet), corners[triangles], uv[triangles])


def _add_legs(joinery: _Joinery, size: tuple[float, float], floor: float, design: Design) -> None:
    """Four legs below a frame of boards, perhaps with drawers and a shelf."""
    x, y = size
    sides = 12 if design.support == "round legs" else 4
    width = min(0.06 if sides == 4 else 0.05, 0.14 * min(size))
    foot = width * (1.0 if design.support == "square legs" else 0.55)
    inset = min(0.035, 0.06 * min(size)) + width / 2
    apron = min(0.13 if design.drawers else 0.075, 0.3 * -floor)
    below, under = -TABLE_THICKNESS, -TABLE_THICKNESS - apron
    left, right, near, far = inset, x - inset, inset, y - inset
    for at in ((left, near), (right, near), (right, far), (left, far)):
        if design.support == "square legs":
            joinery.leg(TABLE_FRAME, design.body, at, (floor, below), (width, width), sides)
        else:
            joinery.leg(TABLE_FRAME, design.body, at, (floor, under), (foot, width), sides)
            joinery.leg(TABLE_FRAME, design.body, at, (under, below), (width, width), 4)
    thick = width / 3
    for y_mid in (near, far):
        joinery.board(TABLE_FRAME, design.body, (left, y_mid - thick, under), (right, y_mid + thick, below))
    for x_mid in (left, right):
        joinery.board(TABLE_FRAME, design.body, (x_mid - thick, near, under), (x_mid + thick, far, below), "y")
    if design.drawers:
        clear = right - left - width
        _add_fronts(joinery, design, (left + width / 2, clear, near - thick), (under + 0.015, below - 0.01), design.drawers)
    if design.has_shelf:
        height = floor + 0.35 * (-floor)
        joinery.board(TABLE_FRAME, design.body, (left, near, height - 0.018), (right, far, height))


def _add_fronts(
    joinery: _Joinery, design: Design, span: tuple[float, float, float], z: tuple[float, float], count: int, gap: float = 0.004
) -> None:
    """A row of doors or drawers with handles; ``span`` is their left end, their common width and the plane behind them."""
    start, width, plane = span
    each = width / count
    for k in range(count):
        low, high = start + k * each + gap / 2, start + (k + 1) * each - gap / 2
        joinery.board(TABLE_FRAME, design.front or design.body, (low, plane - 0.016, z[0]), (high, plane, z[1]))
        middle, top = (low + high) / 2, max(z[1] - 0.035, (z[0] + z[1]) / 2)
        half = min(0.06, 0.2 * each)
        joinery.board(
            TABLE_FRAME, design.metal, (middle - half, plane - 0.04, top - 0.005), (middle + half, plane - 0.03, top + 0.005)
        )
        for x in (middle - half + 0.008, middle + half - 0.008):
            joinery.board(
                TABLE_FRAME, design.metal, (x - 0.004, plane - 0.03, top - 0.004), (x + 0.004, plane - 0.016, top + 0.004)
            )


def _add_steel(joinery: _Joinery, size: tuple[float, float], floor: float, design: Design) -> None:
    """Two frames of steel tube, and a bar between them."""
    x, y = size
    width = min(0.045, 0.1 * min(size))
    inset = min(0.06, 0.08 * min(size))
    below = -TABLE_THICKNESS
    for left in (inset, x - inset - width):
        for near in (inset, y - inset - width):
            joinery.board(TABLE_FRAME, design.body, (left, near, floor), (left + width, near + width, below))
        for z in (floor, below - width):
            joinery.board(TABLE_FRAME, design.body, (left, inset, z), (left + width, y - inset, z + width))
    for near in (inset, y - inset - width):
        joinery.board(TABLE_FRAME, design.body, (inset, near, below - width), (x - inset, near + width, below))


def _add_cabinet(joinery: _Joinery, size: tuple[float, float], floor: float, design: Design) -> None:
    """A cabinet with a row of drawers above doors, or with drawers alone on short legs."""
    x, y = size
    is_low = design.support == "low cabinet"
    below, overhang = -TABLE_THICKNESS, min(0.012, x / 20)
    front = min(0.025, y / 10)
    base = floor + min(0.1, -floor / 4)
    plane = front + 0.016
    joinery.board(TABLE_FRAME, design.body, (overhang, plane, base), (x - overhang, y, below), "z")
    if is_low:
        width = min(0.04, 0.1 * min(size))
        for at in (
            (overhang + width, plane + width),
            (x - overhang - width, plane + width),
            (overhang + width, y - width),
            (x - overhang - width, y - width),
        ):
            joinery.leg(TABLE_FRAME, design.body, at, (floor, base), (0.6 * width, width), 12)
    else:
        joinery.board(TABLE_FRAME, design.body, (overhang, plane + 0.05, floor), (x - overhang, y, base))
    count = max(1, round((x - 2 * overhang) / 0.5))
    span = (overhang, x - 2 * overhang, plane)
    split = below - 0.005 - min(0.17, 0.4 * (below - base))
    _add_fronts(joinery, design, span, (split + 0.002, below - 0.008), count)
    _add_fronts(joinery, design, span, (base, split - 0.002), count)


_SUPPORTS = MappingProxyType(
    {
        "square legs": _add_legs,
        "tapered legs": _add_legs,
        "round legs": _add_legs,
        "steel frame": _add_steel,
        "cabinet": _add_cabinet,
        "low cabinet": _add_cabinet,
    }
)


def _add_room(joinery: _Joinery, table: Tabletop, design: Design, bounds: tuple[FloatArray, FloatArray], floor: float) -> None:
    """Floor and two walls: behind the table and on its right."""
    low, high = bounds
    x, y = table.size_xy
    back = max(y + design.wall_gap, float(high[1]) + 0.005)
    right = max(x, float(high[0])) + _SIDE_WALL
    left, near = min(0.0, float(low[0])) - _FLOOR_MARGIN, min(0.0, float(low[1])) - _FLOOR_MARGIN
    ceiling = max(floor + _WALL_HEIGHT, float(high[2]) + 1.0)
    x_axis, y_axis, z_axis = np.diag([right - left, back - near, ceiling - floor])
    joinery.sheet(FLOOR, design.floor, np.array([left, back, floor]), -y_axis, x_axis)
    joinery.sheet(WALL, design.wall, np.array([left, back, floor]), x_axis, z_axis)
    joinery.sheet(WALL, design.wall, np.array([right, back, floor]), -y_axis, z_axis)
    if design.wall.image is not None:  # tiles go down to the floor
        return
    skirting = Material("skirting", "#dddad4", glow=0.2)
    for corners in (
        ((left, back - 0.012, floor), (right, back, floor + 0.07)),
        ((right - 0.012, near, floor), (right, back, floor + 0.07)),
    ):
        joinery.board(WALL, skirting, *corners)


def _add_plain_floor(joinery: _Joinery, bounds: tuple[FloatArray, FloatArray], floor: float) -> None:
    """A floor of one colour that ends far away on all sides."""
    low, high = bounds
    x_axis, y_axis, _ = np.diag(high - low + 2 * _PLAIN_MARGIN)
    corner = np.array([low[0] - _PLAIN_MARGIN, high[1] + _PLAIN_MARGIN, floor])
    joinery.sheet(FLOOR, _PLAIN_FLOOR, corner, -y_axis, x_axis)
