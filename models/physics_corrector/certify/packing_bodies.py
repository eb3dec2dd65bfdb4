"""The support trees of a layout as bodies of a packing problem."""

import itertools
from collections.abc import Mapping, Sequence, Set

import numpy as np
import shapely

from models.physics_corrector.certify.layout_state import LayoutState
from models.physics_corrector.certify.mesh_queries import MeshQueries
from models.physics_corrector.certify.support_inference import TABLE_TOP
from models.physics_corrector.packing.no_fit_polygon import NoFitPolygons, RigidGroup, no_fit
from models.physics_corrector.packing.packing_problem import AXES, BodyArrays, OrderConstraint, PackingProblem
from models.physics_corrector.packing.slab_outline import SlabOutline, join_outlines, rectangle, slabs_of
from stable_data.metrics.audit import BOUNDS_SLACK
from stable_data.scene import TABLE, FloatArray, Relation, RelationKind
from stable_data.scene_graph.relations import scene_graph

_OVERHANG = 0.9 * BOUNDS_SLACK  # how far an outline may reach over the edge, metres: less than the audit allows
_HANGS = 0.01  # height of the lower side of a fixed thing from which it covers nothing, metres
_DEEP = 3e-3  # trees whose outlines overlap deeper than this, but whose meshes are apart, move as one, metres


class PackingBodies:
    """The trees on the table of a layout, as bodies to separate.

    Args:
        layout: The layout.
        meshes: Its objects.
        original: Poses from which movement is measured, (N, 4).
        orders: Directional relations to preserve.
        cells: Index of an object -> lowest and highest position of its centre, (2, 2), metres; ignored where there is no room.
        clearance: Distance between objects that stand side by side, metres.
    """

    def __init__(
        self,
        layout: LayoutState,
        meshes: MeshQueries,
        original: FloatArray,
        orders: Sequence[Relation],
        cells: Mapping[int, FloatArray],
        clearance: float,
    ) -> None:
        self._layout, self._meshes, self._original = layout, meshes, original
        self._orders, self._cells, self._clearance = orders, cells, clearance
        self._stacks: dict[tuple[int, ...], tuple[FloatArray, SlabOutline]] = {}

    def problem(self, strict: Set[frozenset[int]]) -> tuple[PackingProblem, list[list[int]]]:
        """Builds the packing problem.

        Args:
            strict: Pairs of roots whose outlines must be apart, even if their meshes are.

        Returns:
            The problem, and the roots of each body.
        """
        layout, size = self._layout, np.array(self._layout.scene.table.size_xy)
        roots = layout.roots()
        parts = [RigidGroup(self._slabs(r), layout.poses[r, :2].copy()) for r in roots]
        zone = layout.scene.table.restricted_zone
        if zone is not None:
            corners = np.array([[zone[0], zone[2]], [zone[1], zone[3]]])
            parts.append(RigidGroup(rectangle(corners[0], corners[1]), np.zeros(2)))
        pairs = no_fit(parts)
        groups, relaxed = self._groups(roots, pairs, strict)
        number = {r: b for b, group in enumerate(groups) for r in group}
        body = np.array([number[r] for r in roots] + [len(groups)] * (zone is not None), np.int64)
        num = len(groups) + (zone is not None)
        stiffness = np.full(num, np.inf)
        aims, low, high = np.zeros((num, 2)), np.full((num, 2), -np.inf), np.full((num, 2), np.inf)
        for b, group in enumerate(groups):
            stiffness[b] = sum(layout.stiffness(r) for r in group)
            if np.isfinite(stiffness[b]):
                aims[b] = self._original[group[0], :2] - layout.poses[group[0], :2]
        for b, p in zip(body[: len(roots)], parts, strict=False):
            if not np.isfinite(stiffness[b]):
                continue  # what does not move may be beside the table
            least, most = p.slabs.box
            low[b] = np.maximum(low[b], -_OVERHANG - least - p.anchor)
            high[b] = np.minimum(high[b], size + _OVERHANG - most - p.anchor)
        for k, cell in self._cells.items():
            if layout.is_there[k]:
                b = number[layout.root_of(k)]
                least, most = (
                    np.maximum(low[b], cell[0] - layout.poses[k, :2]),
                    np.minimum(high[b], cell[1] - layout.poses[k, :2]),
                )
                if (least <= most).all():
                    low[b], high[b] = least, most
        bodies = BodyArrays(stiffness, aims, low, high)
        return PackingProblem(pairs, body, bodies, self._orders_between(number), self._clearance, relaxed), groups

    def covered(self, roots: Sequence[int]) -> float:
        """Returns the area of the table top that trees cover, square metres; what hangs over it covers nothing."""
        layout, (width, depth) = self._layout, self._layout.scene.table.size_xy
        table = shapely.box(0.0, 0.0, width, depth)
        covered = 0.0
        for r in roots:
            corners = self._slabs(r).corners[0]
            if layout.scene.objects[r].instance not in layout.scene.fixed:
                x, y = corners.T
                covered += 0.5 * abs(float(x @ np.roll(y, -1) - y @ np.roll(x, -1)))
            elif layout.low(r) <= _HANGS:  # it may be beside the table
                outline = shapely.convex_hull(shapely.multipoints(corners + layout.poses[r, :2]))
                covered += float(shapely.intersection(outline, table).area)
        return covered

    def _slabs(self, root: int) -> SlabOutline:
        """Returns the slabs of a tree around its root's anchor; computed again only if the poses within the tree change."""
        layout = self._layout
        tree = tuple(layout.tree(root))
        anchor = np.append(layout.poses[root, :2], 0.0)
        offsets = layout.poses[list(tree), :3] - anchor
        inner = np.concatenate([offsets, layout.poses[list(tree), 3:]], axis=1)
        if tree not in self._stacks or not np.allclose(self._stacks[tree][0], inner, rtol=0, atol=1e-9):
            stacks = []
            for m, offset in zip(tree, offsets, strict=True):
                at = np.append(offset[:2], layout.low(m))
                stacks.append(slabs_of(layout.shapes[m]).transformed(layout.poses[m, 3], at))
            self._stacks[tree] = inner, join_outlines(stacks)
        return self._stacks[tree][1]

    def _orders_between(self, number: dict[int, int]) -> list[OrderConstraint]:
        layout = self._layout
        index = {o.instance: k for k, o in enumerate(layout.scene.objects)}
        found = []
        for r in self._orders:
            i, j = index[r.subject], index[r.target]
            if layout.is_there[i] and layout.is_there[j]:
                first, second = number[layout.root_of(i)], number[layout.root_of(j)]
                if first != second:
                    offset = layout.poses[i, :2] - layout.poses[j, :2]
                    found.append(OrderConstraint(first, second, np.array(AXES[r.kind]), offset))
        return found

    def _groups(
        self, roots: Sequence[int], pairs: NoFitPolygons, strict: Set[frozenset[int]]
    ) -> tuple[list[list[int]], dict[tuple[int, int], float]]:
        """Groups trees that must move as one, because their meshes are apart but their outlines overlap.

        Returns:
            The roots of each group, and the clearance of the outlines for pairs of parts that overlap only a little.
        """
        free: dict[tuple[int, int], float] = {}
        colliding: set[frozenset[int]] = set()
        for (i, j), clear in pairs.clearances().items():
            if clear >= self._clearance or j >= len(roots):
                continue
            both = frozenset((roots[i], roots[j]))
            if both in strict or self._collide(roots[i], roots[j]):
                colliding.add(both)
            else:
                free[i, j] = clear
        group = {r: [r] for r in roots}
        for (i, j), clear in sorted(free.items(), key=lambda item: (item[1], item[0])):
            one, other = group[roots[i]], group[roots[j]]
            if clear > -_DEEP or one is other:
                continue
            if any(frozenset(pair) in colliding for pair in itertools.product(one, other)):
                continue
            both_groups = one + other
            for r in both_groups:
                group[r] = both_groups
        groups = sorted({id(members): sorted(members) for members in group.values()}.values())
        return groups, {pair: clear for pair, clear in free.items() if clear > -_DEEP}

    def _collide(self, one: int, other: int) -> bool:
        layout = self._layout
        theirs = layout.tree(other)
        return any(
            self._meshes.penetrates(a, layout.poses[a], b, layout.poses[b])
            for a in layout.tree(one)
            for b in self._meshes.near(a, layout.poses[a], theirs, layout.poses)
        )


def directional_relations(layout: LayoutState, original: FloatArray) -> list[Relation]:
    """Returns the directional relations of the scene graph with the objects at poses (N, 4)."""
    objects = [o.moved((p[0], p[1], p[2]), p[3]) for o, p in zip(layout.scene.objects, original.tolist(), strict=True)]
    names = [o.instance for o in objects]
    above = {n: (TABLE if c.parent == TABLE_TOP else names[c.parent],) for n, c in zip(names, layout.carried, strict=True)}
    scene = type(layout.scene)(layout.scene.scene_id, layout.scene.table, tuple(objects))
    edges = scene_graph(scene, above).edges(keys=True)
    return sorted(Relation(s, RelationKind(kind), t) for s, t, kind in edges if RelationKind(kind) in AXES)
