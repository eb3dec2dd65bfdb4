"""The goal of the task of a scene: conditions on its state, and the steps that a robot takes to fulfil them."""

import itertools
import math
from collections.abc import Mapping, Sequence, Set
from dataclasses import dataclass, replace
from enum import StrEnum
from typing import Any

from stable_data.condition import (
    BY_HEIGHT,
    BY_SIZE,
    NAME_SEPARATOR,
    SIDE_KINDS,
    ConditionKind,
    GoalCondition,
    condition_document,
    condition_of,
)
from stable_data.errors import GoalError
from stable_data.scene import Vec3


class StepAction(StrEnum):
    """What a robot does in a step."""

    PICK = "pick"
    PLACE = "place"
    PUSH = "push"
    TURN = "turn"
    CARRY = "carry"


@dataclass(frozen=True, slots=True)
class Step:
    """One step of a task.

    Attributes:
        action: ``pick`` grasps and lifts; ``place`` puts a held object down; ``push`` slides one over the table; ``turn`` puts a held
            object down in another orientation, where it was; ``carry`` brings a held object to a place and keeps it in the hand.
        subject: The instance that is acted on.
        conditions: Conditions on it that hold after the step; a ``place`` without any means a free spot on the table.
    """

    action: StepAction
    subject: str
    conditions: tuple[GoalCondition, ...] = ()

    def __str__(self) -> str:
        """Returns the step in words."""
        return f"{self.action} {self.subject}" + "".join(f"; {c}" for c in self.conditions)


class GoalKind(StrEnum):
    """Kinds of goals, to group results by."""

    PICK = "pick"
    HAND_OVER = "hand_over"
    PLACE_ON = "place_on"
    PLACE_IN = "place_in"
    PLACE_BESIDE = "place_beside"
    STACK = "stack"
    SORT = "sort"
    CLEAR = "clear"
    MOVE = "move"
    SWAP = "swap"
    PUSH = "push"
    TURN = "turn"
    SEVERAL = "several"


@dataclass(frozen=True, slots=True)
class Goal:
    """The goal of the task of a scene.

    Attributes:
        kind: Its kind.
        conditions: All must hold at the end.
        steps: What leads there, in order.
    """

    kind: GoalKind
    conditions: tuple[GoalCondition, ...]
    steps: tuple[Step, ...]

    def __str__(self) -> str:
        """Returns the conditions in words."""
        return f"{self.kind}: {'; '.join(map(str, self.conditions))}"


_ALWAYS_INSTANCES = SIDE_KINDS | {ConditionKind.IN, ConditionKind.BESIDE, ConditionKind.BETWEEN}
_INSTANCES_OR_WORDS = frozenset({ConditionKind.ON, ConditionKind.AT, ConditionKind.APART, ConditionKind.FACING})

_CLEARLY = 1.1
"""Least ratio of two lengths of which one is clearly the larger."""


def rename_conditions(
    conditions: Sequence[GoalCondition], names: Mapping[str, str], known: Set[str], sizes: Mapping[str, Vec3]
) -> tuple[GoalCondition, ...]:
    """Returns conditions between the instances of another scene; none if an instance has no counterpart there.

    The order of sizes may be another one there, so ``ordered`` is ordered anew; without a measure, or where two of the sizes are nearly
    equal, it has no counterpart. What is to leave an object that shall be empty may be missing there.

    Args:
        conditions: The conditions.
        names: Instance -> its counterpart.
        known: All instances of the first scene.
        sizes: Size of each instance of the other scene, metres.
    """
    found = []
    is_emptied = any(c.kind is ConditionKind.EMPTY for c in conditions)
    for c in conditions:
        has_instances = c.kind in _ALWAYS_INSTANCES or (c.kind in _INSTANCES_OR_WORDS and c.target in known)
        targets = [names.get(t) for t in c.targets] if has_instances else list(c.targets)
        parts = [*(names.get(s) for s in c.subjects), *targets]
        if None in parts:
            if is_emptied and c.kind is not ConditionKind.EMPTY:
                continue
            return ()
        filled = [part for part in parts if part is not None]
        count = len(c.subjects)
        subjects = filled[:count]
        if c.kind is ConditionKind.ORDERED:
            subjects = _ordered(subjects, c.target, sizes)
            if not subjects:
                return ()
        found.append(replace(c, subject=NAME_SEPARATOR.join(subjects), target=NAME_SEPARATOR.join(filled[count:])))
    return tuple(found)


def _ordered(names: Sequence[str], measure: str, sizes: Mapping[str, Vec3]) -> list[str]:
    """Instances in the order of a measure, the smallest first; none without a measure, or if two are nearly equal."""
    if measure == BY_HEIGHT:
        lengths = {name: sizes[name][2] for name in names}
    elif measure == BY_SIZE:
        lengths = {name: math.cbrt(math.prod(sizes[name])) for name in names}
    else:
        return []
    ordered = sorted(names, key=lambda name: lengths[name])
    is_clear = all(lengths[b] > _CLEARLY * lengths[a] for a, b in itertools.pairwise(ordered))
    return ordered if is_clear else []


def goal_document(goal: Goal) -> dict[str, Any]:
    """Returns a goal as values of JSON."""
    return {
        "kind": str(goal.kind),
        "conditions": [condition_document(c) for c in goal.conditions],
        "steps": [
            {"action": str(s.action), "subject": s.subject, "conditions": [condition_document(c) for c in s.conditions]}
            for s in goal.steps
        ],
    }


def goal_of(document: Mapping[str, Any]) -> Goal:
    """Returns the goal of a document that :func:`goal_document` made.

    Raises:
        GoalError: ``goal_invalid``: it has another form.
    """
    try:
        return Goal(
            GoalKind(document["kind"]),
            tuple(map(condition_of, document["conditions"])),
            tuple(
                Step(StepAction(s["action"]), str(s["subject"]), tuple(map(condition_of, s["conditions"])))
                for s in document["steps"]
            ),
        )
    except (KeyError, TypeError, ValueError) as error:
        if isinstance(error, GoalError):
            raise
        message = f"goal is {str(document)[:80]!r}, expected kind, conditions and steps; compile the goal again"
        raise GoalError(message, "goal_invalid") from error
