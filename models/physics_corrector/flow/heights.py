"""Heights of objects while they are moved: learned, or from the supports."""

from typing import Literal, TypeAlias

from torch import Tensor

from models.physics_corrector.flow.condition import Condition

Heights: TypeAlias = Literal["learned", "geometry"]


def at_first_heights(condition: Condition, heights: Heights) -> Condition:
    """Returns the scenes at the heights with which a motion begins: those of the supports, if heights follow from geometry."""
    return condition if heights == "learned" else condition.standing()


def without_heights(change: Tensor, heights: Heights) -> Tensor:
    """Returns a change of coordinates (B, N, 4) without that of the height, if heights follow from geometry."""
    return change if heights == "learned" else change * change.new_tensor([1.0, 1.0, 0.0, 1.0])
