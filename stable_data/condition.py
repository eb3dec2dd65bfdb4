"""Conditions on the state of a scene, the goal of a task; part of its task info.

:mod:`stable_data.tasks` compiles, checks and reaches them.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from enum import StrEnum
from typing import Any

from stable_data.errors import GoalError
from stable_data.json_text import number

NAME_SEPARATOR = ", "
"""Joins several instances in one field, as in a relation."""


class ConditionKind(StrEnum):
    """The kinds of conditions. The relations have the values of the scene graph's relations."""

    HELD = "held"
    ON = "on"
    IN = "in"
    LEFT_OF = "left of"
    RIGHT_OF = "right of"
    IN_FRONT_OF = "in front of"
    BEHIND = "behind"
    BESIDE = "beside"
    BETWEEN = "between"
    APART = "apart"
    AT = "at"
    FACING = "facing"
    UPRIGHT = "upright"
    MOVED = "moved"
    EMPTY = "empty"
    TOGETHER = "together"
    IN_A_ROW = "in a row"
    ORDERED = "ordered"
    EVEN = "evenly spaced"


GROUP_KINDS = frozenset({ConditionKind.TOGETHER, ConditionKind.IN_A_ROW, ConditionKind.ORDERED, ConditionKind.EVEN})
"""Kinds whose subject is two or more instances."""

BY_HEIGHT, BY_SIZE = "by_height", "by_size"
"""Measures that grow in the order of a condition ``ordered``: the height, or the volume of the box."""

HAND_OVER_REGION = "front_edge"
"""Where an object is held that is handed over: the user sits at the front edge."""

SIDE_KINDS = frozenset({ConditionKind.LEFT_OF, ConditionKind.RIGHT_OF, ConditionKind.IN_FRONT_OF, ConditionKind.BEHIND})
"""The four directions."""


@dataclass(frozen=True, slots=True, order=True)
class GoalCondition:
    """One condition on the state of a scene.

    ========================================  ======================================================================================
    kind                                      holds if the subject
    ========================================  ======================================================================================
    held                                      is in the gripper, off its support and lifted; with a ``target``, a region, it is held there
    on, in                                    is on or in ``target`` as in the scene graph; ``table`` means directly on it
    left of, right of, in front of, behind    is in that direction of ``target``, to 45 degrees
    beside                                    is close to ``target``, neither on nor in the other
    between                                   is between the two instances of ``target``
    apart                                     is ``distance`` or more away from ``target``, an instance or an edge of the table
    at                                        is in the region ``target``, or where the instance ``target`` was at the start
    facing                                    faces the direction or the instance ``target``
    upright                                   stands on its base
    moved                                     is ``distance`` farther in the direction ``target`` than at the start
    empty                                     has nothing in it (``target`` in), on it (on) or either (empty text)
    together, in a row, ordered, evenly       several instances: close to each other; in one row; from left to right in this order (with a
    spaced                                    ``target``, a measure that grows in this order); with equal steps from left to right
    ========================================  ======================================================================================

    Attributes:
        subject: Instance; of the last four kinds several, joined by a comma and a space.
        kind: The kind.
        target: Instance, ``table``, region, direction or measure, see above; for ``between`` two instances, joined likewise.
        distance: Metres, for ``apart`` and ``moved``; None: the least that counts.
        is_negated: Whether it must not hold.

    Raises:
        GoalError: ``goal_invalid``: the distance is not above zero.
    """

    subject: str
    kind: ConditionKind
    target: str = ""
    distance: float | None = None
    is_negated: bool = False

    def __post_init__(self) -> None:
        if self.distance is not None and not 0 < self.distance < float("inf"):
            raise GoalError(f"{self}: distance is {self.distance:g}, expected metres above zero", "goal_invalid")

    def __str__(self) -> str:
        """Returns the condition in words."""
        words = [self.subject, "not" if self.is_negated else "", str(self.kind), self.target]
        words.append("" if self.distance is None else f"{self.distance * 100:g} cm")
        return " ".join(filter(None, words))

    @property
    def subjects(self) -> tuple[str, ...]:
        """The instances of the subject."""
        return tuple(self.subject.split(NAME_SEPARATOR))

    @property
    def targets(self) -> tuple[str, ...]:
        """The parts of the target: instances, a region or a direction; none if it is empty."""
        return tuple(self.target.split(NAME_SEPARATOR)) if self.target else ()


def condition_document(condition: GoalCondition) -> dict[str, Any]:
    """Returns a condition as values of JSON."""
    return {
        "subject": condition.subject,
        "kind": str(condition.kind),
        "target": condition.target,
        "distance": condition.distance,
        "is_negated": condition.is_negated,
    }


def condition_of(document: object) -> GoalCondition:
    """Returns the condition of a value that :func:`condition_document` made; ``distance`` and ``is_negated`` may be missing.

    Raises:
        GoalError: ``goal_invalid``.
    """
    if isinstance(document, Mapping):
        subject, kind, target = (document.get(key) for key in ("subject", "kind", "target"))
        stated, is_negated = document.get("distance"), document.get("is_negated")
        distance = number(stated)
        is_length = stated is None or distance is not None
        if (
            isinstance(subject, str)
            and subject
            and kind in list(ConditionKind)
            and isinstance(target, str)
            and is_length
            and is_negated in (None, False, True)
        ):
            return GoalCondition(subject, ConditionKind(str(kind)), target, distance, bool(is_negated))
    expected = f"subject, kind (one of {', '.join(ConditionKind)}), target, distance in metres and is_negated"
    raise GoalError(f"condition is {str(document)[:80]!r}, expected {expected}; compile the goal again", "goal_invalid")
