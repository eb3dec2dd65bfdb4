"""Places of objects for which a relation holds, in a layout of boxes, the most likely ones first."""

import itertools
import math
from collections.abc import Iterator, Mapping

import numpy as np

from stable_data.metrics.alignment import members
from stable_data.scene import TABLE, FloatArray, Relation, RelationKind, SceneObject, Tabletop
from stable_data.scene_graph.relations import cell_of, direction_of, yawed_rectangle
from stable_data.scene_graph.support_tree import ancestors

DIRECTION = {
    RelationKind.LEFT_OF: (-1.0, 0.0),
    RelationKind.RIGHT_OF: (1.0, 0.0),
    RelationKind.IN_FRONT_OF: (0.0, -1.0),
    RelationKind.BEHIND: (0.0, 1.0),
}
_GAPS = (0.02, 0.05, 0.1, 0.2, 0.35)  # between two objects side by side, metres, the smallest first
_ASIDE = (0.0, 0.04, -0.04, 0.08, -0.08, 0.15, -0.15)  # at right angles to the gap, metres
SPOTS_PER_CELL = 5  # along each side of a ninth of the table
_OFF_CENTRE = (0.0, 0.25, -0.25, 0.5, -0.5)  # from the support's centre, in half extents of the support
_BASE = 0.7  # width of a container inside, at its bottom, as a share of its box
_ABOVE_BOTTOM = 0.01  # of an object in a container, metres; the correction finds its real height

Place = tuple[str, tuple[float, float, float]]
"""An instance that moves, and the centre of its box, metres."""


def places_beside(
    relation: Relation, objects: Mapping[str, SceneObject], carriers: Mapping[str, str | None]
) -> Iterator[Place]:
    """The subject beside the target, on the target's support or else on the table; then the target beside the subject."""
    direction = np.array(DIRECTION[relation.kind])
    for one, other, sign in ((relation.subject, relation.target, 1.0), (relation.target, relation.subject, -1.0)):
        mover, anchor = objects[one], objects[other]
        axis = int(direction[1] != 0)
        reach = half_extent(mover)[axis] + half_extent(anchor)[axis]
        lows = [0.0]
        if carriers[other] not in (None, TABLE, one):
            lows.insert(0, anchor.bottom)
        elif carriers[one] == TABLE:
            lows = [mover.bottom]
        for low, gap, aside in itertools.product(lows, _GAPS, _ASIDE):
            if abs(aside) < reach + gap:  # the offset along the relation has to be the larger one
                across = np.array((direction[1], direction[0])) * aside
                x, y = anchor.position[:2] + sign * direction * (reach + gap) + across
                yield one, (x, y, low + mover.size[2] / 2)


def places_between(
    relation: Relation, objects: Mapping[str, SceneObject], carriers: Mapping[str, str | None]
) -> Iterator[Place]:
    """The subject between its two targets; then one of these on the other side of the subject."""
    middle, one, other = members(relation)
    low = objects[middle].bottom if carriers[middle] == TABLE else 0.0
    ends = [np.array(objects[name].position[:2]) for name in (one, other)]
    for share, aside in itertools.product((0.5, 0.4, 0.6, 0.3, 0.7), _ASIDE):
        across = np.array((ends[0][1] - ends[1][1], ends[1][0] - ends[0][0]))
        x, y = ends[0] + share * (ends[1] - ends[0]) + aside * across / max(1e-6, float(np.linalg.norm(across)))
        yield middle, (x, y, low + objects[middle].size[2] / 2)
    for mover, anchor in ((one, other), (other, one)):
        side = direction_of(*np.subtract(objects[middle].position, objects[anchor].position)[:2])
        if side is not None:  # the mover on the side of the middle that is away from the anchor
            for name, place in places_beside(Relation(mover, side, middle), objects, carriers):
                if name == mover:
                    yield name, place


def places_in_cell(
    relation: Relation, objects: Mapping[str, SceneObject], carriers: Mapping[str, str | None], table: Tabletop
) -> Iterator[Place]:
    """An object, or one of its supports, in a ninth of the table."""
    names = (relation.subject, *ancestors(carriers, relation.subject))
    for name in reversed(names):  # its lowest support first, so that stacks stay together
        mover = objects[name]
        half, size = half_extent(mover), np.array(table.size_xy)
        spots = [np.clip(np.array(spot), half, np.maximum(half, size - half)) for spot in table_spots(size)]
        offset = objects[relation.subject].position[:2] - np.array(mover.position[:2])
        for spot in sorted(spots, key=lambda s: float(np.linalg.norm(s - mover.position[:2]))):
            x, y = (spot + offset).tolist()
            if cell_of((x, y), table.size_xy) == relation.target:
                low = mover.bottom if carriers[name] == TABLE else 0.0
                yield name, (float(spot[0]), float(spot[1]), low + mover.size[2] / 2)


def places_on_or_in(subject: SceneObject, target: SceneObject, kind: RelationKind) -> Iterator[Place]:
    """The subject on the target and in it, whatever the relation: without meshes it is unknown which objects are hollow."""
    half = half_extent(target)
    lows = (target.top, target.bottom + _ABOVE_BOTTOM)
    for low in reversed(lows) if kind is RelationKind.IN else lows:
        for x, y in itertools.product(_OFF_CENTRE, repeat=2):
            spot = target.position[:2] + half * (x, y)
            yield subject.instance, (float(spot[0]), float(spot[1]), low + subject.size[2] / 2)


def places_in_layers(subject: SceneObject, target: SceneObject, kind: RelationKind) -> Iterator[Place]:
    """Places for many objects like the subject on the target or in it: side by side, then in layers above, as high as a heap."""
    half, step = half_extent(target), 2 * half_extent(subject)
    highest = float(half.min()) + target.size[2] * (kind is RelationKind.IN)
    if kind is RelationKind.IN:
        half = half * _BASE
    counts = 1 + np.maximum(0, (2 * half - step) / step + 1e-6).astype(int)
    steps = itertools.product(*((np.arange(n) - (n - 1) / 2) * s for n, s in zip(counts.tolist(), step, strict=True)))
    spots = sorted(steps, key=lambda spot: round(math.hypot(*spot), 4))  # the same order for each of equal objects
    low = target.bottom + _ABOVE_BOTTOM if kind is RelationKind.IN else target.top
    for layer in range(max(1, int(highest / subject.size[2]))):
        z = low + (layer + 0.5) * subject.size[2]
        for dx, dy in spots:
            yield subject.instance, (target.position[0] + float(dx), target.position[1] + float(dy), z)


def table_spots(size: FloatArray) -> Iterator[tuple[float, float]]:
    """Points of a regular grid over the table, :data:`SPOTS_PER_CELL` along each side of a ninth."""
    steps = (np.arange(3 * SPOTS_PER_CELL) + 0.5) / (3 * SPOTS_PER_CELL)
    for x, y in itertools.product(steps, repeat=2):
        yield x * size[0], y * size[1]


def half_extent(o: SceneObject) -> FloatArray:
    """Half extents of a yawed object along x and y, metres."""
    return np.asarray(np.ptp(yawed_rectangle(o), axis=0) / 2)
