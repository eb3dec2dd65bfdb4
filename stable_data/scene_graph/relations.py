"""The scene graph: supports, containment and spatial relations, from boxes, footprints and contacts of meshes.

A correction must preserve the relations ``on`` and ``in``. They follow from contacts. The caller measures these on the meshes:
it lowers an object by 0.5 to 3 mm and finds what the object then meets with an upward normal. "Supported" has two meanings:

* In the audit, an object without contact floats, however small the gap is.
* In the scene graph, an object without contact is supported by an object at most 10 mm below it, or by the container that its
  bottom is in. Layouts that were settled as convex hulls have gaps of some millimetres. A graph without these supports would
  let a correction take a ball out of its bowl.

The other relations are those of MesaTask and follow from boxes. Overlap is a share of the smaller footprint.
"""

import itertools
from collections.abc import Iterator, Mapping, Sequence, Set
from dataclasses import replace
from typing import TYPE_CHECKING, TypeAlias

import networkx as nx
import numpy as np
import shapely

from stable_data.rotations import rotate_xy
from stable_data.scene import TABLE, FloatArray, Relation, RelationKind, Scene, SceneObject
from stable_data.scene_graph.support_tree import ancestors

if TYPE_CHECKING:
    SceneGraph: TypeAlias = nx.MultiDiGraph[str]
else:
    SceneGraph: TypeAlias = nx.MultiDiGraph

Contacts: TypeAlias = Mapping[str, tuple[str, ...]]
"""The supports that each object touches: instances and ``table``."""

NEAREST = 3
"""Directional relations link an object to this number of nearest objects."""

REACH = 0.4
"""Largest distance of the centres in a directional relation, as a share of the table's longer side."""

GAP = 1e-2
"""An object at most this far below an object without contact supports it, metres."""

INSIDE_SLACK = 5e-3  # how far the centre of a content may be outside its container's outline, metres
_SINK = 1.5e-2  # how deep an object without contact may reach into the box of its support (a plate's hollow), metres
_TOP = 5e-3  # how deep an object on the top of another one may reach into its box, metres
_BOTTOM = 5e-3  # how much the bottom of a support may be above the bottom of the supported object, metres
INSIDE_FLOOR = 1.5e-3  # a content is at least this much above its container's bottom, metres
_RIM_SHARE = 0.15  # the bottom of a content is below the rim by at least this share of the container's height
# The rules for objects of which it is not known whether they are containers:
_RIM_SHARE_UNKNOWN = 0.3  # the share for these
_SHEET = 8e-3  # an object lower than this, metres, contains nothing: a depth in a mat is only rounding of the position
_OVERLAP_UNKNOWN = 0.5  # least common share of the smaller outline: an object that leans on another one is not in it
_ABOVE_SLACK = 5e-3  # metres
_ABOVE_OVERLAP = 0.5  # least common share of the smaller outline
_EVEN = 0.1  # steps of a row differ from their mean by at most this share
_ROW_WIDTH = 0.25  # members of a row leave its line by at most this share of a step

_FACINGS = ("front", "front_right", "right", "back_right", "back", "back_left", "left", "front_left")
_COLUMNS = ("left", "middle", "right")
_ROWS = ("front", "middle", "back")
CELLS = tuple(f"{row}_{column}" for row, column in itertools.product(_ROWS, _COLUMNS))
"""The ninths of a table."""


class _Layout:
    """Boxes and outlines of the objects of a scene, and comparisons of these."""

    def __init__(
        self, scene: Scene, footprints: Mapping[str, FloatArray] | None, containers: Mapping[str, bool | None] | None
    ) -> None:
        self.objects = {o.instance: o for o in scene.objects}
        self.low = {o.instance: o.bottom for o in scene.objects}
        self.high = {o.instance: o.top for o in scene.objects}
        self.outline = {
            name: shapely.convex_hull(shapely.multipoints((footprints or {}).get(name, yawed_rectangle(o)))).buffer(1e-6)
            for name, o in self.objects.items()  # the buffer gives flat outlines an area
        }
        self.containers = containers or {}

    def distance_outside(self, child: str, parent: str) -> float:
        """How far a child's centre is outside its parent's outline, metres; negative inside."""
        centre, outline = shapely.Point(self.objects[child].position[:2]), self.outline[parent]
        distance = float(outline.exterior.distance(centre))
        return -distance if outline.contains(centre) else distance

    def depth(self, child: str, parent: str) -> float:
        """How far a child's bottom is below its parent's top, metres."""
        return self.high[parent] - self.low[child]

    def holds(self, parent: str, child: str) -> bool:
        """Whether a child is well inside a container, by outline and height."""
        is_container, height = self.containers.get(parent), self.high[parent] - self.low[parent]
        if is_container is False or self.distance_outside(child, parent) > INSIDE_SLACK:
            return False
        if is_container is None and (
            height < _SHEET or common_share(self.outline[parent], self.outline[child]) < _OVERLAP_UNKNOWN
        ):
            return False
        is_deep = self.depth(child, parent) >= (_RIM_SHARE if is_container else _RIM_SHARE_UNKNOWN) * height
        return is_deep and self.low[child] > self.low[parent] + INSIDE_FLOOR


def common_share(a: shapely.Geometry, b: shapely.Geometry) -> float:
    """Returns the common area of two outlines as a share of the smaller."""
    return float(a.intersection(b).area / min(a.area, b.area))


def yawed_rectangle(item: SceneObject) -> FloatArray:
    """The corners of an object's box seen from above, (4, 2) float64, metres, world frame, counter-clockwise."""
    half = np.array(item.size[:2]) / 2
    corners = np.array([(-1.0, -1.0), (1.0, -1.0), (1.0, 1.0), (-1.0, 1.0)]) * half
    return rotate_xy(corners, item.yaw) + item.position[:2]


def supports(
    scene: Scene,
    contacts: Contacts,
    footprints: Mapping[str, FloatArray] | None = None,
    containers: Mapping[str, bool | None] | None = None,
) -> dict[str, str | None]:
    """Derives the support of each object, in the meaning of the scene graph; supports never form a cycle.

    An object that touches several others has one support: the table, unless the object is on the floor of a container; else the
    object under its centre; else the highest. An object without contact is supported by the closest object below it (see the
    module).

    Args:
        scene: The scene.
        contacts: The supports that each object touches; a missing object touches none.
        footprints: Convex outline of each mesh, (K, 2) float64, metres, world frame; the yawed box if missing.
        containers: Whether objects can be put into an object; None or missing if it is not known.

    Returns:
        Instance -> instance, ``table``, or None without a support near below.
    """
    return _carriers(_Layout(scene, footprints, containers), contacts)


def _carriers(layout: _Layout, contacts: Contacts) -> dict[str, str | None]:
    carriers: dict[str, str | None] = dict.fromkeys(layout.objects)
    # From the bottom up, so that the supports below an object are known when it is checked for a cycle.
    for child in sorted(layout.objects, key=layout.low.__getitem__):  # stable: ties keep the scene's order
        touched = [p for p in contacts.get(child, ()) if p == TABLE or _may_support(layout, carriers, p, child)]
        carriers[child] = _best_contact(layout, child, touched) if touched else _closest_below(layout, carriers, child)
    return carriers


def _may_support(layout: _Layout, carriers: Mapping[str, str | None], parent: str, child: str) -> bool:
    is_below = parent in layout.objects and parent != child and layout.low[parent] <= layout.low[child] + _BOTTOM
    return is_below and child not in ancestors(carriers, parent)


def _best_contact(layout: _Layout, child: str, touched: list[str]) -> str:
    others = [p for p in touched if p != TABLE]
    if TABLE in touched and not any(layout.holds(p, child) for p in others):
        return TABLE
    return min(others, key=lambda p: (max(0.0, layout.distance_outside(child, p)), layout.depth(child, p), p))


def _closest_below(layout: _Layout, carriers: Mapping[str, str | None], child: str) -> str | None:
    below = [
        p
        for p in layout.objects
        if _may_support(layout, carriers, p, child) and layout.distance_outside(child, p) <= INSIDE_SLACK
    ]
    solid = [p for p in below if -GAP <= layout.depth(child, p) <= _SINK]
    on = min(solid, key=lambda p: (abs(layout.depth(child, p)), p), default=None)
    hollow = [p for p in below if layout.holds(p, child)]
    # Of nested ones the innermost: the top one of three plates in each other ends near the rim of the lowest.
    inside = min(hollow, key=lambda p: (-layout.low[p], layout.depth(child, p), p), default=None)
    if on is not None:
        return inside if inside is not None and on in ancestors(carriers, inside) else on
    if inside is not None:
        return inside
    return TABLE if layout.low[child] <= GAP else None


def contacts_of(scene: Scene) -> dict[str, tuple[str, ...]]:
    """Returns the contacts that the supports of a scene state: each object touches its support, if that is known."""
    return {o.instance: (o.support,) for o in scene.objects if o.support is not None}


def scene_graph(
    scene: Scene,
    contacts: Contacts,
    footprints: Mapping[str, FloatArray] | None = None,
    containers: Mapping[str, bool | None] | None = None,
) -> SceneGraph:
    """Builds the scene graph.

    Nodes are the instances and ``table``. An object's node has ``category``, ``support`` (see :func:`supports`), ``container``,
    ``cell`` and ``facing``. Edges run from subject to target; their key is the :class:`RelationKind`. An object on another one
    in a container has both relations. The graph's ``rows`` are the equally spaced rows, (instances, axis). Of two opposite
    relations, only the one whose subject comes first in the scene is included. Fixed objects only carry others.

    Args:
        scene: The scene.
        contacts: As for :func:`supports`.
        footprints: As for :func:`supports`.
        containers: As for :func:`supports`.

    Returns:
        The graph; :func:`relations_of` lists its relations.
    """
    layout = _Layout(scene, footprints, containers)
    carriers = _carriers(layout, contacts)
    graph: SceneGraph = nx.MultiDiGraph(scene_id=scene.scene_id, rows=_rows(scene, carriers))
    graph.add_node(TABLE)
    for o in scene.objects:
        graph.add_node(
            o.instance,
            category=o.category,
            support=carriers[o.instance],
            container=layout.containers.get(o.instance),
            cell=cell_of(o.position, scene.table.size_xy),
            facing=facing_of(o.yaw),
            is_fixed=o.instance in scene.fixed,
        )
    for child in carriers:
        if child not in scene.fixed:
            for link in _links_to_parents(layout, carriers, child, len(contacts.get(child, ()))):
                graph.add_edge(link.subject, link.target, key=link.kind)
    for one, other in _near_pairs(scene):
        kind = _spatial_relation(scene, layout, one, other)
        is_stacked = other in ancestors(carriers, one) or one in ancestors(carriers, other)
        if kind is not None and not is_stacked:
            graph.add_edge(one, other, key=kind)
    return graph


def _links_to_parents(layout: _Layout, carriers: Mapping[str, str | None], child: str, num_contacts: int) -> Iterator[Relation]:
    carrier = carriers[child]
    if carrier is None:
        return
    # A container further down counts: the second ball in a bowl is in the bowl, although it rests on the first.
    container = next((p for p in ancestors(carriers, child) if layout.holds(p, child)), None)
    yield Relation(child, RelationKind.IN if container else RelationKind.ON, container or carrier)
    # The apple on a book in a crate is on the book too; a ball in a heap, which rests on the sides of others, is not.
    if container not in (None, carrier) and layout.depth(child, carrier) <= _TOP and num_contacts <= 1:
        yield Relation(child, RelationKind.ON, carrier)


def on_in_relations(
    scene: Scene,
    contacts: Contacts,
    footprints: Mapping[str, FloatArray] | None = None,
    containers: Mapping[str, bool | None] | None = None,
) -> frozenset[Relation]:
    """Returns the relations ``on`` and ``in`` of the scene graph alone, which is quick for a few objects.

    The arguments are those of :func:`scene_graph`.
    """
    layout = _Layout(scene, footprints, containers)
    carriers = _carriers(layout, contacts)
    links = (_links_to_parents(layout, carriers, child, len(contacts.get(child, ()))) for child in carriers)
    return frozenset(itertools.chain.from_iterable(links))


def _near_pairs(scene: Scene) -> list[tuple[str, str]]:
    """Each movable object with its nearest ones within reach, each pair once, in the scene's order."""
    names = [o.instance for o in scene.movable]
    centres = np.array([o.position[:2] for o in scene.movable], np.float64).reshape(-1, 2)
    distance = np.linalg.norm(centres[:, None] - centres[None], axis=2)
    np.fill_diagonal(distance, np.inf)
    pairs = set()
    for i, row in enumerate(distance):
        near = np.argsort(row, kind="stable")[:NEAREST]
        pairs |= {(min(i, int(j)), max(i, int(j))) for j in near if row[j] <= REACH * max(scene.table.size_xy)}
    return [(names[i], names[j]) for i, j in sorted(pairs)]


def _spatial_relation(scene: Scene, layout: _Layout, one: str, other: str) -> RelationKind | None:
    vertical = _vertical_kind(layout, one, other)
    if vertical is not None:
        return vertical
    dx, dy, _ = np.subtract(scene[one].position, scene[other].position)
    return direction_of(dx, dy)


def _vertical_kind(layout: _Layout, one: str, other: str) -> RelationKind | None:
    over = layout.low[one] > layout.high[other] - _ABOVE_SLACK
    under = layout.high[one] < layout.low[other] + _ABOVE_SLACK
    if (over or under) and common_share(layout.outline[one], layout.outline[other]) >= _ABOVE_OVERLAP:
        return RelationKind.ABOVE if over else RelationKind.BELOW
    return None


def direction_of(dx: float, dy: float) -> RelationKind | None:
    """Returns the direction of a subject seen from its target, to 45 degrees; None exactly on a diagonal.

    ``dx`` and ``dy`` are the subject's position minus the target's, metres.
    """
    if abs(dx) == abs(dy):
        return None
    if abs(dx) > abs(dy):
        return RelationKind.LEFT_OF if dx < 0 else RelationKind.RIGHT_OF
    return RelationKind.IN_FRONT_OF if dy < 0 else RelationKind.BEHIND


def vertical_relation(
    scene: Scene, one: str, other: str, footprints: Mapping[str, FloatArray] | None = None
) -> RelationKind | None:
    """Returns ``above`` or ``below`` if one object is over or under another, at any distance and with any support; else None.

    ``footprints`` are those of :func:`scene_graph`.
    """
    pair = replace(scene, objects=(scene[one], scene[other]))
    return _vertical_kind(_Layout(pair, footprints, None), one, other)


def is_held(on_in: Set[Relation], relation: Relation) -> bool:
    """Returns whether the subject is on or in the target, directly or through others.

    Args:
        on_in: The ``on`` and ``in`` relations that hold; without circles.
        relation: The relation to test. ``on`` also holds if the subject is in the target. ``in`` holds if at least one relation
            between subject and target is ``in``.
    """
    below: dict[str, list[Relation]] = {}
    for r in on_in:
        below.setdefault(r.subject, []).append(r)
    seen: set[tuple[str, bool]] = set()
    paths = [(relation.subject, relation.kind is RelationKind.ON)]  # how far one came, and whether that is enough
    while paths:
        name, is_enough = paths.pop()
        for r in below.get(name, ()):
            reached = r.target, is_enough or r.kind is RelationKind.IN
            if reached == (relation.target, True):
                return True
            if reached not in seen:
                seen.add(reached)
                paths.append(reached)
    return False


def is_between(middle: Sequence[float], one: Sequence[float], other: Sequence[float]) -> bool:
    """Returns whether a position lies between two others: seen from these, in opposite directions (:func:`direction_of`)."""
    seen = {direction_of(middle[0] - end[0], middle[1] - end[1]) for end in (one, other)}
    return seen in ({RelationKind.LEFT_OF, RelationKind.RIGHT_OF}, {RelationKind.IN_FRONT_OF, RelationKind.BEHIND})


def are_even(positions: Sequence[float]) -> bool:
    """Returns whether positions along an axis, in increasing order, have equal steps, as the members of a row."""
    steps = np.diff(positions)
    return bool(np.abs(steps - steps.mean()).max() <= _EVEN * steps.mean())


def cell_of(position: tuple[float, ...], size_xy: tuple[float, float]) -> str:
    """Returns the ninth of the table that a point is in, such as ``back_left``; beyond the edge, the nearest one."""
    column, row = (min(2, max(0, int(3 * p / s))) for p, s in zip(position, size_xy, strict=False))
    return f"{_ROWS[row]}_{_COLUMNS[column]}"


def cell_bounds(cell: str, size_xy: tuple[float, float]) -> FloatArray:
    """Returns the lowest and the highest point of a ninth of the table, (2, 2) float64, metres."""
    row, column = cell.split("_")
    low = np.array((_COLUMNS.index(column), _ROWS.index(row)), np.float64)
    return np.asarray(np.array((low, low + 1)) * size_xy / 3)


def facing_of(yaw: float) -> str:
    """Returns the direction that an object faces, to 45 degrees; ``front`` is towards the viewer, the facing at yaw 0."""
    return _FACINGS[round(np.degrees(yaw) / 45) % 8]


def _rows(scene: Scene, carriers: Mapping[str, str | None]) -> tuple[tuple[tuple[str, ...], str], ...]:
    """Longest evenly spaced rows of three or more objects that stand on the table."""
    standing = [o for o in scene.movable if carriers[o.instance] == TABLE]
    found: list[tuple[tuple[str, ...], str]] = []
    for axis in (0, 1):
        ordered = sorted(standing, key=lambda o: (o.position[axis], o.instance))
        starts = itertools.combinations(range(len(ordered)), 2)
        rows = {row for first, second in starts if len(row := _row_from(ordered, first, second, axis)) >= 3}
        # Every pair starts a row, so most rows are the ends of longer ones.
        longest = [row for row in rows if not any(set(row) < set(other) for other in rows)]
        found += [(row, "xy"[axis]) for row in sorted(longest)]
    return tuple(found)


def _row_from(ordered: list[SceneObject], first: int, second: int, axis: int) -> tuple[str, ...]:
    """Instances of the row that starts with two objects."""
    members = [ordered[first], ordered[second]]
    step = members[1].position[axis] - members[0].position[axis]
    if step <= 0 or abs(members[1].position[1 - axis] - members[0].position[1 - axis]) > _ROW_WIDTH * step:
        return ()
    for o in ordered[second + 1 :]:
        if o.position[axis] - members[-1].position[axis] > (1 + 3 * _EVEN) * step:
            break  # farther than any even step
        if abs(o.position[1 - axis] - members[0].position[1 - axis]) > _ROW_WIDTH * step:
            continue
        if are_even([m.position[axis] for m in (*members, o)]):
            members.append(o)
    return tuple(m.instance for m in members)


def relations_of(graph: SceneGraph) -> tuple[Relation, ...]:
    """Lists every relation of a scene graph, sorted.

    Returns:
        Edges, ``face to`` and ``is at`` of every object, and the equally spaced rows, all in :class:`Relation`'s order.
    """
    found = [Relation(subject, RelationKind(kind), target) for subject, target, kind in graph.edges(keys=True)]
    for name, about in graph.nodes(data=True):
        if name != TABLE and not about.get("is_fixed"):
            found += [Relation(name, RelationKind.FACE_TO, about["facing"]), Relation(name, RelationKind.IS_AT, about["cell"])]
    found += [Relation(", ".join(row), RelationKind.EQUALLY_SPACED, axis) for row, axis in graph.graph["rows"]]
    return tuple(sorted(found))
