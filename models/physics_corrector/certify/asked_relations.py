"""The directions and the cells of the table that a correction is asked to keep or to make true."""

from collections.abc import Iterable, Sequence

import numpy as np

from models.physics_corrector.certify.layout_state import LayoutState
from models.physics_corrector.packing.packing_problem import AXES, holds_relation
from stable_data.scene import FloatArray, Relation, RelationKind
from stable_data.scene_graph.relations import cell_bounds

_INSIDE = 1e-3  # distance from the border of a cell, metres


class AskedRelations:
    """The directions and cells that shall hold in a layout; relations of other kinds are left out.

    Args:
        layout: The layout.
        asked: The relations.

    Attributes:
        orders: The directional relations, sorted.
        cells: Index of an object -> lowest and highest position of its centre, (2, 2), metres.
    """

    def __init__(self, layout: LayoutState, asked: Iterable[Relation]) -> None:
        self._number = {o.instance: k for k, o in enumerate(layout.scene.objects)}
        there = [r for r in sorted(asked) if r.subject in self._number]
        self.orders = [r for r in there if r.kind in AXES and r.target in self._number]
        self.cells: dict[int, FloatArray] = {}
        for r in there:
            if r.kind is RelationKind.IS_AT:
                bounds = cell_bounds(r.target, layout.scene.table.size_xy)
                self.cells[self._number[r.subject]] = bounds + np.array([[_INSIDE], [-_INSIDE]])
        subjects = {self._number[r.subject] for r in there}
        self._moving = {layout.scene.objects[m].instance for k in subjects for m in layout.tree(k)}

    def with_others(self, relations: Sequence[Relation]) -> list[Relation]:
        """The directions that shall hold, with those relations that are not about objects of which something is asked.

        Such an object has to move, and where it stood beside others before does not matter.
        """
        return sorted({*self.orders, *(r for r in relations if self._moving.isdisjoint((r.subject, r.target)))})

    def is_about(self, k: int) -> bool:
        """Whether a direction or a cell is asked of an object."""
        return k in self.cells or any(self._number[r.subject] == k for r in self.orders)

    def allow(self, k: int, pose: FloatArray, poses: FloatArray) -> bool:
        """Whether all that is asked of an object holds with it at a pose (4,) and the others at poses (N, 4)."""
        if k in self.cells and ((pose[:2] < self.cells[k][0]) | (pose[:2] > self.cells[k][1])).any():
            return False
        own = [r for r in self.orders if self._number[r.subject] == k]
        return all(holds_relation(pose[:2] - poses[self._number[r.target], :2], np.array(AXES[r.kind])) for r in own)
