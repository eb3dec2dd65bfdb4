"""Places for several objects at once, so that all stated relations between them hold, in a layout of boxes."""

from collections.abc import Iterator, Mapping, Sequence, Set
from dataclasses import dataclass, field

import numpy as np
import numpy.typing as npt

from models.semantic_reasoner.replies.places import DIRECTION, table_spots
from stable_data.metrics.alignment import members
from stable_data.scene import FloatArray, Relation, RelationKind, SceneObject, Tabletop, Vec3
from stable_data.scene_graph.relations import cell_of, is_between, yawed_rectangle
from stable_data.scene_graph.support_tree import SupportTree

_SPATIAL = {*DIRECTION, RelationKind.IS_AT, RelationKind.BETWEEN}
_CLEAR = 1.2  # of two objects side by side, the offset along the relation is at least this many times the other one
_GAP = 0.01  # between two boxes, metres
_MOST_SPOTS = 1000  # that are tried in one search, at most


def rearrangements(
    objects: Mapping[str, SceneObject],
    carriers: Mapping[str, str | None],
    movable: Set[str],
    stated: Sequence[Relation],
    broken: Sequence[Relation],
    table: Tabletop,
) -> Iterator[dict[str, Vec3]]:
    """Yields places in which the spatial relations of the objects that a broken one concerns hold together.

    An object moves with all that it carries; all other objects stay. The places are found by depth-first search over a grid on the
    table, the object with the most relations to placed ones next.

    Args:
        objects: The layout.
        carriers: What carries each object.
        movable: The objects that may move.
        stated: All stated relations, in the names of the layout.
        broken: Those of them that do not hold.
        table: The table.

    Yields:
        The centres of the boxes of the objects that move, metres.
    """
    search = _Search(objects, carriers, movable, [r for r in stated if r.kind in _SPATIAL], table)
    order = search.order(broken)
    if order:
        for spots in search.arrange(order, {}):
            yield {name: search.centre(name, spot) for name, spot in spots.items()}


@dataclass
class _Search:
    objects: Mapping[str, SceneObject]
    carriers: Mapping[str, str | None]
    movable: Set[str]
    stated: Sequence[Relation]
    table: Tabletop
    num_tried: int = field(default=0, init=False)

    def __post_init__(self) -> None:
        self._tree = SupportTree(self.carriers)
        self._root = {name: [name, *self._tree.ancestors(name)][-1] for name in self.objects}
        self._box = {name: self._box_of(name) for name in set(self._root.values())}
        self._grid = np.array(list(table_spots(np.array(self.table.size_xy))))
        self._fixed: set[str] = set()

    def _box_of(self, root: str) -> FloatArray:
        """The lowest and highest corner of what a root carries and of itself, relative to its centre, (2, 2)."""
        corners = np.concatenate([yawed_rectangle(self.objects[name]) for name in self._tree.with_descendants({root})])
        return np.asarray(np.array([corners.min(0), corners.max(0)]) - self.objects[root].position[:2])

    def roots(self, relation: Relation) -> set[str]:
        """The roots of the objects that a relation concerns."""
        return {self._root[name] for name in members(relation) if name in self._root}

    def order(self, broken: Sequence[Relation]) -> list[str]:
        """The roots to place: those that are linked with a broken relation and may move."""
        apart = [found for r in self.stated if len(found := self.roots(r)) > 1 or r.kind is RelationKind.IS_AT]
        linked: set[str] = set().union(*(self.roots(r) for r in broken if r.kind in _SPATIAL))
        while more := {name for found in apart if found & linked for name in found} - linked:
            linked |= more
        free = {name for name in linked if self._tree.with_descendants({name}) <= self.movable}
        self._fixed = set(self._box) - free
        placed, order = set(linked - free), list[str]()
        while free:
            area = {name: float(np.prod(np.ptp(self._box[name], axis=0))) for name in free}
            name = max(free, key=lambda n: (sum(n in f and bool(f & placed) for f in apart), area[n], n))
            order.append(name)
            placed.add(name)
            free.remove(name)
        return order

    def arrange(self, order: Sequence[str], placed: dict[str, FloatArray]) -> Iterator[dict[str, FloatArray]]:
        """Yields a spot for each root of the order."""
        if len(placed) == len(order):
            yield dict(placed)
            return
        name = order[len(placed)]
        for spot in self._spots(name, placed):
            if self.num_tried >= _MOST_SPOTS:
                return
            self.num_tried += 1
            yield from self.arrange(order, {**placed, name: spot})

    def _spots(self, name: str, placed: Mapping[str, FloatArray]) -> FloatArray:
        """The spots of a root where its relations to the placed ones hold and its box is free, the best first, (N, 2)."""
        size, box = np.array(self.table.size_xy), self._box[name]
        spots = np.unique(np.clip(self._grid, -box[0], np.maximum(-box[0], size - box[1])), axis=0)
        spots = spots[self._is_free(name, spots, placed)]
        known = self._fixed | placed.keys() | {name}
        near = [size / 2]
        for r in self.stated:
            found = self.roots(r)
            if name in found and found <= known:
                spots = spots[self._holds(r, name, spots, placed)]
                near += [placed[other] for other in found - {name} if other in placed]
                near += [np.array(self.objects[other].position[:2]) for other in found & self._fixed]
        anchor = np.mean(near[1:] or near, axis=0)
        return np.asarray(spots[np.argsort(np.linalg.norm(spots - anchor, axis=1), kind="stable")])

    def _is_free(self, name: str, spots: FloatArray, placed: Mapping[str, FloatArray]) -> npt.NDArray[np.bool_]:
        taken = [box + self.objects[other].position[:2] for other, box in self._box.items() if other in self._fixed]
        taken += [self._box[other] + spot for other, spot in placed.items()]
        if self.table.restricted_zone is not None:
            x_min, x_max, y_min, y_max = self.table.restricted_zone
            taken.append(np.array([(x_min, y_min), (x_max, y_max)]))
        low, high = spots + self._box[name][0] - _GAP, spots + self._box[name][1] + _GAP
        free = np.ones(len(spots), bool)
        for box in taken:
            free &= ~((low < box[1]) & (high > box[0])).all(1)
        return free

    def _holds(
        self, relation: Relation, root: str, spots: FloatArray, placed: Mapping[str, FloatArray]
    ) -> npt.NDArray[np.bool_]:
        """Whether a relation holds with a root at each of some spots."""

        def at(name: str) -> FloatArray:
            own = self._root[name]
            offset = self.objects[name].position[:2] - np.array(self.objects[own].position[:2])
            base = spots if own == root else np.asarray(placed.get(own, self.objects[own].position[:2]))
            return np.broadcast_to(base + offset, spots.shape)

        if relation.kind is RelationKind.IS_AT:
            return np.array([cell_of(tuple(p), self.table.size_xy) == relation.target for p in at(relation.subject)], bool)
        points = [at(name) for name in members(relation)]
        if relation.kind is RelationKind.BETWEEN:
            return np.array([is_between(*three) for three in zip(*points, strict=True)], bool)
        direction, offset = np.array(DIRECTION[relation.kind]), points[0] - points[1]
        return np.asarray(offset @ direction > _CLEAR * np.abs(offset @ direction[::-1]))

    def centre(self, name: str, spot: FloatArray) -> Vec3:
        """The centre of a root's box at a spot; it keeps its height if something carries it."""
        o = self.objects[name]
        z = o.position[2] if self.carriers[name] is not None else o.size[2] / 2
        return float(spot[0]), float(spot[1]), z
