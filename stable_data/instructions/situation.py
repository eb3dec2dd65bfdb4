"""Feasibility of tasks in a scene: which objects can be moved, what is in or on what, what fits where.

An object is approximated by the axis-aligned rectangle around its yawed box, seen from above. The rectangle is never smaller
than the box, so a task that is feasible for the rectangles is feasible for the boxes. The context also holds the random
generator, so that its lists are in random order.
"""

import itertools
from collections.abc import Collection, Iterable, Iterator, Sequence
from typing import TypeVar

import numpy as np

from stable_data.instructions.wording.vocabulary import classes_of
from stable_data.rotations import half_extents_xy
from stable_data.scene import TABLE, FloatArray, RelationKind, Scene, SceneObject
from stable_data.scene_graph.relations import SceneGraph, facing_of

T = TypeVar("T")

SIDES = {
    RelationKind.LEFT_OF: (0, -1),
    RelationKind.RIGHT_OF: (0, 1),
    RelationKind.IN_FRONT_OF: (1, -1),
    RelationKind.BEHIND: (1, 1),
}
"""Axis and sign of each direction."""

OPPOSITE = {
    RelationKind.LEFT_OF: RelationKind.RIGHT_OF,
    RelationKind.RIGHT_OF: RelationKind.LEFT_OF,
    RelationKind.IN_FRONT_OF: RelationKind.BEHIND,
    RelationKind.BEHIND: RelationKind.IN_FRONT_OF,
}

_MOVABLE_WIDTH, _MOVABLE_LENGTH, _FLAT = (
    0.15,
    0.4,
    0.06,
)  # largest footprint that one arm picks up, and the height below which the width does not count, metres
_FIT = 0.9  # largest width of contents, as a share of the width of their container
_FULL = 0.6  # largest volume (or base area) of all contents, as a share of the box (or base area) of their container
_RISE, _LOW = 2.5, 0.15  # largest height of contents: a multiple of the container's height, or metres, whichever is larger
_UPRIGHT_TILT = 0.5  # largest tilt of a container that can hold objects, radians
_CLEARANCE = 0.015  # least distance between a placed object and the others, metres
_MAX_PAIRS = 64  # largest number of pairs that a kind of task examines


class TaskContext:
    """A scene with its graph and a random generator.

    Args:
        scene: The scene.
        graph: Its scene graph.
        rng: The random generator.
        steady: Objects that a task may mention.
        named: Objects that a task may mention alone, because they have a unique name; others only with their whole category.
    """

    def __init__(
        self, scene: Scene, graph: SceneGraph, rng: np.random.Generator, steady: Iterable[str], named: Collection[str]
    ) -> None:
        self.scene, self.graph, self.rng = scene, graph, rng
        self.objects = {o.instance: o for o in scene.objects}
        self.steady, self.named = frozenset(steady), frozenset(named)
        self.load: dict[str | None, list[str]] = {}  # the objects that each object supports
        for o in scene.objects:
            self.load.setdefault(graph.nodes[o.instance]["support"], []).append(o.instance)
        self._names = [o.instance for o in scene.objects]
        self._boxes = np.array([_box(o) for o in scene.objects], np.float64)  # (N, 2, 2): axis, low and high
        self._halves = np.ptp(self._boxes, axis=2) / 2
        self._row = {name: k for k, name in enumerate(self._names)}
        self._on_table = np.array([graph.nodes[name]["support"] in (TABLE, None) for name in self._names], bool)
        self.standing = [n for n in self._names if n in self.steady and n in named and self._support(n) == TABLE]
        self.free = [n for n in self._names if n in self.steady and n not in self.load and _is_graspable(self.objects[n])]
        self.every_loose = [n for n in self.free if self._support(n) == TABLE]
        self.loose = [n for n in self.every_loose if n in named]
        self.containers = [n for n in self.standing if self._is_open_container(n)]

    def _support(self, name: str) -> str | None:
        support: str | None = self.graph.nodes[name]["support"]
        return support

    def _is_open_container(self, name: str) -> bool:
        return bool(self.graph.nodes[name]["container"]) and self.objects[name].tilt_angle < _UPRIGHT_TILT

    # --- random order ---

    def shuffled(self, items: Iterable[T]) -> list[T]:
        """Returns the items in random order."""
        found = list(items)
        return [found[k] for k in self.rng.permutation(len(found))]

    def pick(self, items: Sequence[T]) -> T:
        """Returns a random item."""
        return items[int(self.rng.integers(len(items)))]

    def pairs(self, ones: Iterable[str], others: Iterable[str]) -> Iterator[tuple[str, str]]:
        """Yields pairs of different objects in random order, at most 64."""
        found = ((a, b) for a, b in itertools.product(self.shuffled(ones), self.shuffled(others)) if a != b)
        return itertools.islice(found, _MAX_PAIRS)

    # --- categories and classes ---

    def of(self, name: str, names: Iterable[str]) -> list[str]:
        """Returns the objects of ``names`` that belong to the class ``name``."""
        return [n for n in names if name in classes_of(self.objects[n].category)]

    def all_of(self, name: str) -> list[str]:
        """Returns all objects of the scene that belong to the class ``name``, also those that a task may not mention."""
        return self.of(name, self._names)

    def kinds(self, names: Iterable[str]) -> list[list[str]]:
        """Groups objects by category."""
        found: dict[str, list[str]] = {}
        for n in names:
            found.setdefault(self.objects[n].category, []).append(n)
        return list(found.values())

    def whole_kinds(self, least: int, most: int | None = None, name: str | None = None) -> Iterator[tuple[str, ...]]:
        """Yields categories all of whose objects are loose, as the tuple of their objects, in random order.

        Args:
            least: Smallest number of objects.
            most: Largest number of objects.
            name: A class to which the objects belong.
        """
        loose = self.every_loose if name is None else self.of(name, self.every_loose)
        for xs in self.shuffled(self.kinds(loose)):
            if least <= len(xs) and (most is None or len(xs) <= most) and self.is_every(xs):
                yield tuple(xs)

    def is_every(self, names: Sequence[str]) -> bool:
        """Whether ``names``, objects of one category, are all objects of this category in the scene."""
        category = self.objects[names[0]].category
        return len(names) == sum(o.category == category for o in self.scene.objects)

    # --- in and on ---

    def linked(self, kind: RelationKind) -> list[tuple[str, str]]:
        """Returns pairs of a graspable object and the object that it is in or on (``kind``), in random order."""
        edges = ((a, b) for a in self.free for _, b, k in self.graph.out_edges(a, keys=True) if k == kind and b != TABLE)
        return self.shuffled(edge for edge in edges if edge[1] in self.steady)

    def parts(self, parent: str, kind: RelationKind) -> list[str]:
        """Returns all objects in or on (``kind``) an object."""
        return [a for a in self._names if self.graph.has_edge(a, parent, key=kind)]

    def filled(self, kind: RelationKind, least: int) -> Iterator[tuple[str, tuple[str, ...]]]:
        """Yields each object with ``least`` or more objects in or on (``kind``) it, all of them graspable."""
        for y in self.shuffled(n for n in self.objects if n in self.steady & self.named and n in self.load):
            xs = self.parts(y, kind)
            if least <= len(xs) and set(xs) <= set(self.free):
                yield y, tuple(xs)

    def fits(self, x: str, y: str) -> bool:
        """Whether ``x`` fits into ``y`` beside its contents."""
        return x != y and self.all_fit([x], y)

    def all_fit(self, xs: Sequence[str], y: str) -> bool:
        """Whether all of ``xs`` fit into ``y`` together, beside its contents."""
        container = self.objects[y]
        room = min(container.size[:2]) * _FIT
        if y in xs or any(not self._passes_opening(self.objects[x], container, room) for x in xs):
            return False
        inside = [*xs, *(n for n in self.load.get(y, ()) if n not in xs)]
        volume = sum(float(np.prod(self.objects[n].size)) for n in inside)
        ground = sum(float(np.prod(self.objects[n].size[:2])) for n in inside)
        return volume <= _FULL * float(np.prod(container.size)) or ground <= _FULL * float(np.prod(container.size[:2]))

    def _passes_opening(self, item: SceneObject, container: SceneObject, room: float) -> bool:
        if max(item.size[:2]) <= room:
            return item.size[2] <= max(_RISE * container.size[2], _LOW)
        # A slender object may stand in a narrow container, such as a pen in a cup.
        short, middle, long = sorted(item.size)
        stands = "slender" in classes_of(item.category) and middle <= 0.5 * room and long <= 2.6 * container.size[2]
        return stands and short > 0

    def can_carry(self, x: str, y: str, besides: str | None = None) -> bool:
        """Whether ``x`` can be put on ``y``: ``y`` is level, wide enough and supports nothing except ``besides``."""
        item, base = self.objects[x], self.objects[y]
        is_level = base.size[2] <= 0.7 * min(base.size[:2]) and not self.graph.nodes[y]["container"]
        classes = classes_of(base.category)
        if x == y or not is_level or "uneven" in classes or self.load.get(y, [besides]) != [besides] or item.tilt_angle > 2.8:
            return False
        rolls = "round" in classes_of(item.category) and not classes & {"serving", "saucer"}
        return not rolls and max(item.size[:2]) <= 1.15 * min(base.size[:2])

    # --- places ---

    def gap(self, x: str, y: str) -> float:
        """Returns the distance of two rectangles seen from above, metres."""
        a, b = self._boxes[self._row[x]], self._boxes[self._row[y]]
        apart = np.maximum(0.0, np.maximum(a[:, 0] - b[:, 1], b[:, 0] - a[:, 1]))
        return float(np.hypot(*apart))

    def margin(self, x: str, side: RelationKind) -> float:
        """Returns the distance of a rectangle to the edge of the table on a side, metres."""
        axis, sign = SIDES[side]
        low, high = self._boxes[self._row[x]][axis]
        return float(low if sign < 0 else self.scene.table.size_xy[axis] - high)

    def is_free(self, box: FloatArray, moved: Iterable[str], clearance: float = _CLEARANCE) -> bool:
        """Whether a rectangle on the table is free, ignoring ``moved``; ``box`` is (2, 2): axis, low and high, metres."""
        width, depth = self.scene.table.size_xy
        if (box[:, 0] < 0).any() or box[0, 1] > width or box[1, 1] > depth:
            return False
        zone = self.scene.table.restricted_zone
        if zone is not None and box[0, 0] < zone[1] and box[0, 1] > zone[0] and box[1, 0] < zone[3] and box[1, 1] > zone[2]:
            return False
        others = self._on_table.copy()
        for name in moved:
            others[self._row[name]] = False
        boxes = self._boxes[others]
        meets = (boxes[:, :, 0] < box[:, 1] + clearance) & (boxes[:, :, 1] > box[:, 0] - clearance)
        return not meets.all(axis=1).any()

    def box(self, x: str, centre: tuple[float, float] | None = None) -> FloatArray:
        """Returns the rectangle of an object seen from above, (2, 2) metres, moved to ``centre`` if it is given."""
        if centre is None:
            return np.asarray(self._boxes[self._row[x]])
        (dx, dy), (x_mid, y_mid) = self._halves[self._row[x]], centre
        return np.array(((x_mid - dx, x_mid + dx), (y_mid - dy, y_mid + dy)))

    def has_room(self, x: str, y: str, side: RelationKind, moved: Iterable[str] = ()) -> bool:
        """Whether ``x`` can be placed close to ``y`` on its ``side``."""
        axis, sign = SIDES[side]
        one, base = self._boxes[self._row[x]], self._boxes[self._row[y]]
        centre = base.mean(axis=1)
        reach = (np.ptp(one[axis]) + np.ptp(base[axis])) / 2
        for more in (0.03, 0.08):
            centre[axis] = base[axis].mean() + sign * (reach + more)
            if self.is_free(self.box(x, (centre[0], centre[1])), (x, *moved)):
                return True
        return False

    def has_room_in(self, x: str, cell: str) -> bool:
        """Whether ``x`` can be placed in a cell, a ninth of the table such as ``back_left``."""
        row, column = cell.split("_")
        k = {"left": 0, "middle": 1, "right": 2}[column], {"front": 0, "middle": 1, "back": 2}[row]
        size = self.scene.table.size_xy
        across, along = ([(k[a] + share) * size[a] / 3 for share in (1 / 6, 1 / 2, 5 / 6)] for a in (0, 1))
        centres = itertools.product(across, along)
        return any(self.is_free(self.box(x, centre), (x,)) for centre in centres)

    def can_slide(self, x: str, side: RelationKind, length: float) -> bool:
        """Whether ``x`` can be pushed by ``length`` metres to a side without a collision."""
        axis, sign = SIDES[side]
        swept = self._boxes[self._row[x]].copy()
        swept[axis, 0 if sign < 0 else 1] += sign * (length + 0.02)
        return self.is_free(swept, (x,), clearance=0.0)

    def clearing_distance(self, x: str, y: str, side: RelationKind) -> float:
        """Returns how far ``x`` must move to a side until it overlaps ``y`` no more along that axis, metres."""
        axis, sign = SIDES[side]
        (low, high), (start, end) = self._boxes[self._row[x]][axis], self._boxes[self._row[y]][axis]
        return float(high - start if sign < 0 else end - low)

    def is_beyond(self, x: str, y: str, side: RelationKind) -> bool:
        """Whether the centre of ``x`` is on that side of the centre of ``y``."""
        axis, sign = SIDES[side]
        return sign * (self.objects[x].position[axis] - self.objects[y].position[axis]) > 0

    def is_beside(self, x: str, y: str, side: RelationKind, reach: float = 0.12) -> bool:
        """Whether ``x`` is on that side of ``y`` and at most ``reach`` metres away."""
        axis, sign = SIDES[side]
        step = np.subtract(self.objects[x].position[:2], self.objects[y].position[:2])
        return bool(sign * step[axis] > abs(step[1 - axis])) and self.gap(x, y) <= reach

    def facing_towards(self, x: str, y: str) -> str:
        """Returns the direction that ``x`` faces after it is turned towards ``y``."""
        dx, dy, _ = np.subtract(self.objects[y].position, self.objects[x].position)
        return facing_of(float(np.arctan2(dy, dx) + np.pi / 2))


def _box(item: SceneObject) -> list[list[float]]:
    """The interval of the yawed box along x and y, metres."""
    half = half_extents_xy(item.size, item.yaw)
    return [[float(p - h), float(p + h)] for p, h in zip(item.position, half, strict=False)]


def _is_graspable(item: SceneObject) -> bool:
    width, length = sorted(item.size[:2])
    return length <= _MOVABLE_LENGTH and (width <= _MOVABLE_WIDTH or item.size[2] <= _FLAT)
