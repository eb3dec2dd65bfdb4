"""Finds places on the table where a box overlaps no other one."""

from collections.abc import Iterable

import numpy as np

from stable_data.scene import SceneObject, Tabletop
from stable_data.scene_graph.relations import yawed_rectangle


class FreePlaces:
    """The places on a table that are free, filled row by row from the near left corner.

    Args:
        table: The table; its restricted zone is taken.
        objects: The objects that stand there.
        gap: Least distance between boxes, metres.
    """

    def __init__(self, table: Tabletop, objects: Iterable[SceneObject] = (), gap: float = 0.0) -> None:
        self._size, self._gap = table.size_xy, gap
        taken = [(*corners.min(0), *corners.max(0)) for corners in map(yawed_rectangle, objects)]
        if table.restricted_zone is not None:
            x_min, x_max, y_min, y_max = table.restricted_zone
            taken.append((x_min, y_min, x_max, y_max))
        self._taken = np.array(taken, np.float64).reshape(-1, 4)

    def take(self, width: float, depth: float) -> tuple[float, float, bool] | None:
        """Takes a place for a box.

        Returns:
            The centre of the box, and whether it is turned by 90 degrees; None if no place is free.
        """
        for turned, (w, d) in enumerate(((width, depth), (depth, width))):
            corner = self._corner(w, d)
            if corner is not None:
                x, y = corner
                self._taken = np.vstack([self._taken, (x, y, x + w, y + d)])
                return x + w / 2, y + d / 2, bool(turned)
        return None

    def _corner(self, width: float, depth: float) -> tuple[float, float] | None:
        """The near left corner of a free place, which touches two others or the edges."""
        gap, slack = self._gap, 1e-9
        (x0, y0, x1, y1), (table_width, table_depth) = self._taken.T, self._size
        xs, ys = (np.unique(np.concatenate([[0.0], np.maximum(0.0, high + gap)])) for high in (x1, y1))
        xs = xs[xs + width <= table_width + slack]
        for y in ys[ys + depth <= table_depth + slack]:
            beside = (y0 < y + depth + gap - slack) & (y < y1 + gap - slack)
            within = (x0 < xs[:, None] + width + gap - slack) & (xs[:, None] < x1 + gap - slack)
            free = ~(within & beside).any(1)
            if free.any():
                return float(xs[free.argmax()]), float(y)
        return None
