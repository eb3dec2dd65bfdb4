"""Draws another layout of the objects of a scene: bodies at random places with room, so that the stated relations hold."""

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
import shapely

from stable_data.metrics.alignment import members
from stable_data.rotations import rotate_xy
from stable_data.scene import TABLE, FloatArray, Relation, RelationKind, Scene, SceneObject
from stable_data.scene_graph.relations import cell_of, direction_of, facing_of, is_between, yawed_rectangle
from stable_data.scene_graph.support_tree import SupportTree

_TURN = math.radians(30.0)  # largest turn of a body; most things on a table have a front
_TALL = 0.2  # a body at least this high would hide what is behind it, metres
_NEARER = 0.05  # how much nearer to the front edge it may come, metres
_GAP = 5e-3  # wanted distance of the outlines, metres
_PLACES = 128  # places that are drawn for a body
_DRAWS = 24  # layouts that are drawn
_DIRECTIONS = frozenset({RelationKind.LEFT_OF, RelationKind.RIGHT_OF, RelationKind.IN_FRONT_OF, RelationKind.BEHIND})


@dataclass(frozen=True, slots=True, eq=False)
class _Body:
    """Objects that move together.

    Attributes:
        objects: The objects.
        centre: The point about which it turns, (2,), metres.
        outline: The corners of the hull of the boxes, (K, 2), metres, about the centre.
        height: How high it reaches above the table, metres.
        turns: Whether it may turn.
    """

    objects: tuple[SceneObject, ...]
    centre: FloatArray
    outline: FloatArray
    height: float
    turns: bool

    @classmethod
    def of(cls, objects: Sequence[SceneObject], turns: bool) -> "_Body":
        hull = shapely.convex_hull(shapely.multipoints(np.concatenate([yawed_rectangle(o) for o in objects])))
        corners = shapely.get_coordinates(hull)[:-1]
        centre = (corners.min(axis=0) + corners.max(axis=0)) / 2
        return cls(tuple(objects), centre, corners - centre, max(o.top for o in objects), turns)

    @property
    def names(self) -> tuple[str, ...]:
        return tuple(o.instance for o in self.objects)

    def at(self, place: FloatArray, turn: float) -> tuple[SceneObject, ...]:
        """The objects with the centre at a place, turned."""
        moved = []
        for o in self.objects:
            x, y = (rotate_xy(np.array([o.position[:2]]) - self.centre, turn)[0] + place).tolist()
            moved.append(o.moved((x, y, o.position[2]), math.remainder(o.yaw + turn, math.tau)))
        return tuple(moved)


def draw_layout(scene: Scene, rng: np.random.Generator, accepts: Callable[[Scene], bool] = lambda _: True) -> Scene | None:
    """Draws new positions and yaws for the objects of a scene.

    An object moves with all that it carries, turned by up to 30 degrees, and so do the members of a stated row, which do not turn. Bodies
    are placed one after the other, those of which relations are stated first, then from large to small: at the first place on the table
    and outside the restricted zone where there is room and where the stated relations to the bodies that are placed hold; if no place has
    room, at that with the smallest overlap, which a correction resolves. A body of 20 cm or more comes at most 5 cm nearer to the front
    edge, so that it hides no more than it did. What stands on surroundings, or has no known support, stays.

    Args:
        scene: The scene, with supports.
        rng: The random generator.
        accepts: Whether a layout is as wanted.

    Returns:
        The first of 24 layouts that is accepted and in which all stated relations hold that positions and yaws decide; None if there
        is none.
    """
    stated = () if scene.task is None else scene.task.relations
    there = {o.instance for o in scene.objects}
    stated = tuple(r for r in stated if set(members(r)) <= there)
    bodies, stuck = _bodies(scene, stated)
    if not bodies:
        return None
    about = {name for r in stated for name in members(r)}
    bodies.sort(key=lambda b: (about.isdisjoint(b.names), -shapely.Polygon(b.outline).area))
    for _ in range(_DRAWS):
        placed = _drawn(scene, bodies, stuck, stated, rng)
        if placed is None:
            continue
        layout = replace(scene, objects=tuple(placed[o.instance] for o in scene.objects))
        if accepts(layout):
            return layout
    return None


def _bodies(scene: Scene, stated: Sequence[Relation]) -> tuple[list[_Body], list[SceneObject]]:
    """The bodies that move, and the objects that stay."""
    tree = SupportTree.of(scene.objects, scene.scene_id)
    body_of = {o.instance: tree.root(o.instance) for o in scene.objects}
    rows = [r for r in stated if r.kind is RelationKind.EQUALLY_SPACED]
    for row in rows:
        joined = {body_of[name] for name in members(row)}
        first = min(joined)
        body_of = {name: first if root in joined else root for name, root in body_of.items()}
    in_row = {body_of[name] for row in rows for name in members(row)}
    groups: dict[str, list[SceneObject]] = {}
    for o in scene.objects:
        groups.setdefault(body_of[o.instance], []).append(o)
    bodies, stuck = [], []
    for root, objects in groups.items():
        roots = {tree.root(o.instance) for o in objects}
        if all(scene[name].support == TABLE and name not in scene.fixed for name in roots):
            bodies.append(_Body.of(objects, root not in in_row))
        else:
            stuck += objects
    return bodies, stuck


def _drawn(
    scene: Scene, bodies: Sequence[_Body], stuck: Sequence[SceneObject], stated: Sequence[Relation], rng: np.random.Generator
) -> dict[str, SceneObject] | None:
    """Objects at drawn poses, by instance; None if a body has no place where the stated relations hold."""
    placed = {o.instance: o for o in stuck}
    taken = [shapely.Polygon(yawed_rectangle(o)) for o in stuck]
    if scene.table.restricted_zone is not None:
        x_min, x_max, y_min, y_max = scene.table.restricted_zone
        taken.append(shapely.box(x_min, y_min, x_max, y_max))
    size = np.array(scene.table.size_xy)
    for body in bodies:
        own = {*placed, *body.names}
        wanted = [r for r in stated if set(members(r)) <= own and not set(members(r)).isdisjoint(body.names)]
        turns = rng.uniform(-_TURN, _TURN, _PLACES) * body.turns
        outlines = np.stack([rotate_xy(body.outline, turn) for turn in turns.tolist()])  # (P, K, 2)
        low, high = -outlines.min(axis=1), size - outlines.max(axis=1)
        if body.height >= _TALL:
            low[:, 1] = np.maximum(low[:, 1], np.minimum(high[:, 1], body.centre[1] - _NEARER))
        shares = rng.uniform(size=(_PLACES, 2))
        places = low + shares * np.maximum(high - low, 0.0)
        places = np.where(high < low, size / 2, places)  # larger than the table
        polygons = shapely.polygons(outlines + places[:, None])
        union = shapely.union_all(taken)
        is_free = shapely.distance(polygons, union) >= _GAP if taken else np.ones(_PLACES, np.bool_)
        overlaps = (
            np.where(is_free, 0.0, shapely.area(shapely.intersection(polygons, union)) + 1e-9) if taken else np.zeros(_PLACES)
        )
        found = None
        for k in np.argsort(overlaps, kind="stable").tolist():
            objects = body.at(places[k], float(turns[k]))
            if all(_holds(r, {**placed, **{o.instance: o for o in objects}}, scene.table.size_xy) for r in wanted):
                found = k, objects
                break
        if found is None:
            return None
        k, objects = found
        placed |= {o.instance: o for o in objects}
        taken.append(polygons[k])
    return placed


def _holds(relation: Relation, objects: Mapping[str, SceneObject], size_xy: tuple[float, float]) -> bool:
    """Whether a relation holds; True for one that a body keeps in itself, or that positions alone do not decide."""
    kind, names = relation.kind, members(relation)
    if kind is RelationKind.IS_AT:
        return cell_of(objects[relation.subject].position, size_xy) == relation.target
    if kind is RelationKind.FACE_TO:
        return facing_of(objects[relation.subject].yaw) == relation.target
    if kind is RelationKind.BETWEEN:
        middle, one, other = (objects[name].position for name in names)
        return is_between(middle, one, other)
    if kind in _DIRECTIONS:
        a, b = (objects[name].position for name in names)
        return direction_of(a[0] - b[0], a[1] - b[1]) is kind
    return True
