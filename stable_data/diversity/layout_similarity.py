"""How alike the layouts of scenes are: a kernel for the diversity of a set, and pairs of near-duplicates.

Objects are compared by category and by their place on the table, so that other meshes of the same things do not make a new layout. Which
of two cups is at which place does not matter. Positions are relative to the centre of the table.
"""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import numpy as np
from scipy.optimize import linear_sum_assignment
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

from stable_data.scene import FloatArray, IntArray, Scene

SAME_PLACE = 0.02
"""Largest distance of two objects at the same place, metres."""

SAME_SHARE = 0.9
"""Share of the objects of two near-duplicates that have a counterpart."""

OTHER_PLACE = 0.1
"""How far an object moves until its place counts as another one, metres."""

_BLOCK = 2048  # scenes that are compared with all others at once


@dataclass(frozen=True, slots=True, eq=False)
class SceneLayouts:
    """What is compared of S scenes with M objects in all.

    Attributes:
        table_types: Type of the table of each scene, S.
        first: Index of the first object of each scene, and M, (S + 1,) int64.
        category: Number of the category of each object, the same in all scenes, (M,) int64.
        position: Centre of each object, (M, 3), metres, relative to the centre of the table top.
    """

    table_types: tuple[str, ...]
    first: IntArray
    category: IntArray
    position: FloatArray

    @classmethod
    def of(cls, scenes: Iterable[Scene]) -> "SceneLayouts":
        """The layouts of scenes, of their movable objects."""
        return cls.from_lists(
            (s.table.table_type, s.table.size_xy, [o.category for o in s.movable], [o.position for o in s.movable])
            for s in scenes
        )

    @classmethod
    def from_lists(
        cls, scenes: Iterable[tuple[str, Sequence[float], Sequence[str], Sequence[Sequence[float]] | FloatArray]]
    ) -> "SceneLayouts":
        """The layouts of scenes that are given as lists.

        Args:
            scenes: For each the type of the table, its width and depth in metres, and the category and the position of each object in
                the frame of the scene, metres.
        """
        types, counts, categories, positions = list[str](), [0], list[str](), [np.zeros((0, 3))]
        for table_type, (width, depth), own, places in scenes:
            types.append(table_type)
            counts.append(len(own))
            categories += own
            positions.append(np.asarray(places, np.float64).reshape(-1, 3) - (width / 2, depth / 2, 0.0))
        _, number = np.unique(np.array(categories, dtype=np.str_), return_inverse=True)
        return cls(tuple(types), np.cumsum(counts), number.astype(np.int64), np.concatenate(positions))

    def __len__(self) -> int:
        """Number of scenes."""
        return len(self.table_types)

    @property
    def counts(self) -> IntArray:
        """Number of objects of each scene, (S,) int64."""
        return np.diff(self.first)

    def some(self, chosen: Sequence[int]) -> "SceneLayouts":
        """The layouts of some scenes, in the given order."""
        counts = self.counts[list(chosen)]
        objects = np.concatenate([np.arange(self.first[k], self.first[k + 1]) for k in chosen] or [np.zeros(0, np.int64)])
        first = np.concatenate([[0], np.cumsum(counts)]).astype(np.int64)
        return SceneLayouts(tuple(self.table_types[k] for k in chosen), first, self.category[objects], self.position[objects])


def layout_kernel(layouts: SceneLayouts, length: float = OTHER_PLACE) -> FloatArray:
    """Returns the similarities of layouts, (S, S): 1 for equal ones, 0 for those without a common category.

    k(a, b) is the sum over all pairs of objects of the same category of exp(-d² / (2 · length²)), d their distance, divided by
    sqrt(k(a, a) · k(b, b)). It is positive semi-definite, as a sum of Gaussian kernels. Two scenes without objects are equal.

    Args:
        layouts: The scenes.
        length: Length of the kernel, metres; infinity compares what is on the tables, wherever it is.
    """
    size, scene = len(layouts), np.repeat(np.arange(len(layouts)), layouts.counts)
    kernel = np.zeros((size, size))
    order = np.argsort(layouts.category, kind="stable")
    for group in np.split(order, np.flatnonzero(np.diff(layouts.category[order])) + 1):
        place, own = layouts.position[group], scene[group]
        for k in range(0, len(group), _BLOCK):
            part = slice(k, k + _BLOCK)
            square = ((place[part, None] - place[None]) ** 2).sum(-1)
            np.add.at(kernel, (own[part, None], own[None]), np.exp(-square / (2 * length**2)))
    norm = np.sqrt(np.diagonal(kernel))
    is_empty = norm == 0.0
    kernel /= np.where(norm[:, None] * norm[None] > 0.0, norm[:, None] * norm[None], 1.0)
    kernel[np.ix_(is_empty, is_empty)] = 1.0
    return kernel


def near_duplicates(layouts: SceneLayouts, within: float = SAME_PLACE, share: float = SAME_SHARE) -> IntArray:
    """Returns the pairs of scenes that are near-duplicates, (P, 2) int64, each with the smaller index first, in ascending order.

    Two scenes are near-duplicates if they have the same type of table, and 2 · m ≥ share · (n + n'), where m objects of one can be matched
    with objects of the same category of the other that are within a distance, and n and n' are their numbers of objects.

    Args:
        layouts: The scenes.
        within: Largest distance of two matched objects, metres.
        share: See above, in (0, 1].
    """
    # Σ min(c, c') over the categories bounds m. It is the product of rows that hold [c >= 1], [c >= 2], … for each category.
    counted, counts = _unary_counts(layouts), layouts.counts
    types = np.unique(np.array(layouts.table_types, dtype=np.str_), return_inverse=True)[1]
    pairs = []
    for k in range(0, len(layouts), _BLOCK):
        part = slice(k, k + _BLOCK)
        bound = 2 * (counted[part] @ counted.T)
        may_be = (bound >= share * (counts[part, None] + counts[None]) - 1e-6) & (types[part, None] == types[None])
        rows, columns = np.nonzero(may_be)
        rows += k
        is_ordered = rows < columns
        pairs += [
            (a, b)
            for a, b in zip(rows[is_ordered].tolist(), columns[is_ordered].tolist(), strict=True)
            if num_matched(layouts, a, b, within) * 2 >= share * (counts[a] + counts[b]) - 1e-9
        ]
    return np.array(pairs, np.int64).reshape(-1, 2)


def group_pairs(pairs: IntArray, size: int) -> IntArray:
    """Returns the group of each of some items, (size,) int64: items that pairs connect, directly or through others, are in one group."""
    graph = coo_array((np.ones(len(pairs)), (pairs[:, 0], pairs[:, 1])), shape=(size, size))
    return np.asarray(connected_components(graph, directed=False)[1], np.int64)


def _unary_counts(layouts: SceneLayouts) -> np.ndarray[tuple[int, int], np.dtype[np.float32]]:
    """For each scene and category [count >= 1], [count >= 2], …, (S, K) float32."""
    scene = np.repeat(np.arange(len(layouts)), layouts.counts)
    num_categories = int(layouts.category.max(initial=-1)) + 1
    counts = np.zeros((len(layouts), num_categories), np.int64)
    np.add.at(counts, (scene, layouts.category), 1)
    columns = [counts[:, c, None] >= np.arange(1, most + 1) for c, most in enumerate(counts.max(axis=0, initial=0).tolist())]
    return np.concatenate([np.zeros((len(layouts), 0), np.bool_), *columns], axis=1).astype(np.float32)


def num_matched(layouts: SceneLayouts, one: int, other: int, within: float) -> int:
    """Returns the largest number of objects of two scenes, given by their indices, that can be matched; see :func:`near_duplicates`."""
    a, b = (slice(layouts.first[k], layouts.first[k + 1]) for k in (one, other))
    distance = np.linalg.norm(layouts.position[a][:, None] - layouts.position[b][None], axis=2)
    fits = (layouts.category[a][:, None] == layouts.category[b][None]) & (distance <= within)
    rows, columns = linear_sum_assignment(fits, maximize=True)
    return int(fits[rows, columns].sum())
