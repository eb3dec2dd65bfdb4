"""What the refinement takes and gives, without torch, which not everything that names a layout needs."""

from collections.abc import Sequence, Set
from dataclasses import dataclass

from stable_data.geometry.shape import Shape
from stable_data.metrics.verdicts import Audit
from stable_data.scene import Scene


@dataclass(frozen=True, slots=True, eq=False)
class LayoutToRefine:
    """A layout to refine.

    Attributes:
        scene: The scene, resolved (``AssetStore.resolved``). The carrier of an object is the one that the scene's relations name,
            else its ``support``, else the table.
        shapes: The geometry of its objects, in order.
        fixed: Instances that must not move.
        steady: Instances that are known to stay on their carriers if they do not move on them, such as those of a simulation.
    """

    scene: Scene
    shapes: Sequence[Shape]
    fixed: Set[str] = frozenset()
    steady: Set[str] = frozenset()


@dataclass(frozen=True, slots=True, eq=False)
class RefinedLayout:
    """The result for one layout.

    Attributes:
        scene: The refined scene; fixed and unmoved objects are the input objects.
        audit: Its exact audit.
        is_solved: Whether nothing is left for ``certify``.
    """

    scene: Scene
    audit: Audit
    is_solved: bool
