"""The rules of the criterion "Object Size Reasonableness": sizes that are usual for a category, and the size of the table."""

import math
from collections.abc import Iterator

import numpy as np

from models.scene_rating.fault import Fault, listed, score_by, unknown
from models.scene_rating.rating_case import AuditedScene
from stable_data.importers.conversion.sizes import SizeTable
from stable_data.rating.rating import CriterionScore
from stable_data.scene import SceneObject, Tabletop

_SIGMAS = 2.6  # standard deviations within which a size is usual: 99 % of a normal distribution
_SLACK = 1.25  # factor by which a size may exceed these bounds
_MIDDLE_SPREAD = 1.1  # spread of the middle side, relative to that of the longest
_MOST_OF_TABLE = 0.5  # share of the table's area that the box of one object may take


class SizeRules:
    """Judges whether objects have sizes that are usual for their categories.

    The usual sizes are those of the table by which imported assets get their scale: the embedded world's catalogue, YCB and
    furniture libraries. Only a category of the table, or another name of one, is judged by them; of others it is known only that none
    takes most of the tabletop.
    """

    def __init__(self) -> None:
        self._table = SizeTable()  # without an encoder: what is only like another category says little
        self._usual: dict[str, tuple[tuple[float, float], tuple[float, float]] | None] = {}

    def __call__(self, case: AuditedScene) -> CriterionScore:
        """Returns the score; unknown if no object has a known category, unless one takes most of the table."""
        scene = case.scene
        objects = [(k, o) for k, o in enumerate(scene.objects) if o.instance not in scene.fixed]
        if not objects:
            return unknown("the scene has no objects")
        known = [(k, o) for k, o in objects if self._bounds(o.category) is not None]
        others = [o for _, o in objects if self._bounds(o.category) is None]
        faults = [fault for o in others for fault in _share_faults(o, scene.table)]
        if not known and not faults:
            return unknown("the usual size of no object is known")
        faults += [fault for k, o in known for fault in self._faults(case, k, o)]
        checked = [f"sizes of {len(known)} of {len(objects)} objects"]
        categories = listed(sorted({o.category for o in others}))
        return score_by(faults, checked, [f"categories without known sizes ({categories})"] if others else [])

    def _faults(self, case: AuditedScene, index: int, o: SceneObject) -> Iterator[Fault]:
        bounds = self._bounds(o.category)
        assert bounds is not None
        mesh = case.geometry.meshes[index]
        # A thing that leans has a larger box; the sides of its mesh are its own.
        _, middle, longest = sorted(o.size if mesh is None or o.scale is None else (mesh.extents * o.scale).tolist())
        factors = [_beyond(side, *usual) for side, usual in zip((longest, middle), bounds, strict=True)]
        factor = max(factors, key=lambda f: abs(math.log(f)))
        if factor != 1.0:
            words = f"{factor:.1f} times too large" if factor > 1 else f"{1 / factor:.1f} times too small"
            yield Fault(1 - min(factor, 1 / factor), f"{o.instance} is {words}, {100 * longest:.0f} cm long")

    def _bounds(self, category: str) -> tuple[tuple[float, float], tuple[float, float]] | None:
        """Smallest and largest usual length of the longest and of the middle side, metres; None if the category is not known."""
        if category not in self._usual:
            found = self._table.find(category)
            self._usual[category] = None
            if found is not None:
                size, added = found
                spread = _SIGMAS * math.hypot(size.spread, added)
                longest, middle = np.exp(size.log_sides[:2]).tolist()
                wide, wider = _SLACK * math.exp(spread), _SLACK * math.exp(_MIDDLE_SPREAD * spread)
                self._usual[category] = (longest / wide, longest * wide), (middle / wider, middle * wider)
        return self._usual[category]


def _share_faults(o: SceneObject, table: Tabletop) -> Iterator[Fault]:
    """A thing that takes most of the table, whatever it is."""
    width, depth = table.size_xy
    share = o.size[0] * o.size[1] / (width * depth)
    if share > _MOST_OF_TABLE:
        yield Fault(1 - _MOST_OF_TABLE / share, f"{o.instance} takes {share:.0%} of the table")


def _beyond(length: float, least: float, most: float) -> float:
    """By which factor a length is beyond its bounds; 1 within them, below 1 if it is too small."""
    return length / most if length > most else length / least if length < least else 1.0
