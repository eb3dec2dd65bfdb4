"""Plans the steps that fulfil the conditions of a goal, in order, and finds the kind of the goal."""

from collections.abc import Iterable, Mapping, Sequence
from typing import Protocol

from stable_data.condition import GROUP_KINDS, SIDE_KINDS, ConditionKind, GoalCondition
from stable_data.scene import TABLE
from stable_data.scene_graph.support_tree import ancestors
from stable_data.tasks.goal import GoalKind, Step, StepAction

K = ConditionKind

_ASIDE_KINDS = SIDE_KINDS | {K.BESIDE, K.BETWEEN, K.APART, K.TOGETHER}
_TURNS = frozenset({K.FACING, K.UPRIGHT})
_ARRANGED = frozenset({K.IN_A_ROW, K.ORDERED, K.EVEN, K.TOGETHER})


class StartFacts(Protocol):
    """What the planner asks about the start."""

    def holds_at_start(self, condition: GoalCondition) -> bool:
        """Whether a condition holds at the start."""
        ...

    def contents_at_start(self, condition: GoalCondition) -> Sequence[str]:
        """What is in or on the subject of a condition ``empty`` at the start."""
        ...

    def staying(self, condition: GoalCondition) -> frozenset[str]:
        """The members of a group that stay where they are, because the others are put in order about them."""
        ...


class StepPlanner:
    """Plans steps for conditions.

    Args:
        supports: The support of each object at the start.
        facts: Answers about the start.
    """

    def __init__(self, supports: Mapping[str, str | None], facts: StartFacts) -> None:
        self._supports, self._facts = dict(supports), facts
        self._steps: list[Step] = []
        self._waiting: dict[str, list[GoalCondition]] = {}

    def plan(self, conditions: Sequence[GoalCondition]) -> tuple[Step, ...]:
        """Returns the steps, each object's at the first of its conditions; what is held at the end comes last."""
        self._waiting = self._by_object(conditions)
        held = [c for c in conditions if c.kind is K.HELD and not c.is_negated]
        while self._waiting:
            self._place(next(iter(self._waiting)), ())
        for c in held:
            self._steps.append(Step(StepAction.PICK, c.subject))
            if c.target:
                self._steps.append(Step(StepAction.CARRY, c.subject, (c,)))
        return tuple(self._steps)

    def _by_object(self, conditions: Sequence[GoalCondition]) -> dict[str, list[GoalCondition]]:
        """The conditions on each object that must be moved, in the order in which they are first stated."""
        found: dict[str, list[GoalCondition]] = {}
        for c in conditions:
            if c.kind is K.HELD:
                continue
            if c.kind is K.EMPTY:
                for name in self._facts.contents_at_start(c):
                    found.setdefault(name, [])
                continue
            staying = self._facts.staying(c) if c.kind in GROUP_KINDS else frozenset()
            for name in c.subjects if c.kind in GROUP_KINDS else (c.subject,):
                if name not in staying:
                    found.setdefault(name, []).append(c)
        done = [name for name, stated in found.items() if stated and all(map(self._facts.holds_at_start, stated))]
        return {name: stated for name, stated in found.items() if name not in done}

    def _place(self, name: str, trail: tuple[str, ...]) -> None:
        """Adds the steps of one object, after what must be out of its way."""
        conditions = self._waiting.pop(name)
        for c in conditions:
            for target in c.targets:
                if target in self._supports and name in ancestors(self._supports, target):
                    self._set_aside(target, name)
                elif c.kind is K.AT and target in self._waiting and target not in trail:
                    # Its place is taken by an object that is to be moved too: in a swap, that one waits on a free spot.
                    if any(other.target == name for other in self._waiting[target]):
                        self._steps += [Step(StepAction.PICK, name), Step(StepAction.PLACE, name)]
                    self._place(target, (*trail, name))
        pushes = [c for c in conditions if c.kind is K.MOVED and not c.is_negated]
        if pushes:
            self._steps.append(Step(StepAction.PUSH, name, tuple(conditions)))
            return
        wanted = tuple(conditions)
        if not any(not c.is_negated and c.kind is not K.FACING for c in wanted) and not _is_region(wanted):
            # Taken out or off, with no place stated: on the table. What shall only face elsewhere stays.
            wanted += () if any(c.kind is K.FACING for c in wanted) else (GoalCondition(name, K.ON, TABLE),)
        action = StepAction.TURN if wanted and all(c.kind in _TURNS for c in wanted) else StepAction.PLACE
        self._steps += [Step(StepAction.PICK, name), Step(action, name, wanted)]
        self._supports[name] = next((c.target for c in wanted if c.kind in (K.ON, K.IN) and not c.is_negated), TABLE)

    def _set_aside(self, target: str, base: str) -> None:
        """Puts what carries ``target`` on ``base`` onto the table, so that ``base`` can be put on or in ``target``."""
        chain = [target, *ancestors(self._supports, target)]
        top = chain[chain.index(base) - 1]
        self._steps += [
            Step(StepAction.PICK, top),
            Step(StepAction.PLACE, top, (GoalCondition(top, K.ON, TABLE),)),
        ]
        self._supports[top] = TABLE


def _is_region(conditions: Iterable[GoalCondition]) -> bool:
    """Whether an object only has to leave a region of the table."""
    return any(c.is_negated and c.kind not in (K.ON, K.IN) for c in conditions)


def kind_of(conditions: Sequence[GoalCondition], categories: Mapping[str, str]) -> GoalKind:
    """Returns the kind of a goal.

    Args:
        conditions: Its conditions.
        categories: The category of each instance.
    """
    found = {_kind_of_one(c, categories) for c in conditions}
    if any(c.kind is K.EMPTY for c in conditions):
        found = {GoalKind.CLEAR}
    elif len(found) > 1:  # what is cleared away goes somewhere
        found -= {GoalKind.CLEAR}
    containers = {c.target for c in conditions if c.kind is K.IN and not c.is_negated}
    subjects = {c.subject for c in conditions if c.kind is K.IN and not c.is_negated}
    if found == {GoalKind.PLACE_IN} and len(containers) > 1 and len(subjects) > 1:
        return GoalKind.SORT
    if len(found) == 1:
        return next(iter(found))
    return GoalKind.SEVERAL


def _kind_of_one(c: GoalCondition, categories: Mapping[str, str]) -> GoalKind:
    if c.is_negated:
        return GoalKind.CLEAR
    if c.kind is K.HELD and c.target:
        return GoalKind.HAND_OVER
    if c.kind is K.ON and c.target != TABLE:
        return GoalKind.STACK if categories.get(c.subject) == categories.get(c.target) else GoalKind.PLACE_ON
    if c.kind is K.AT and c.target in categories:
        return GoalKind.SWAP
    if c.kind is K.APART and c.target not in categories:
        return GoalKind.MOVE
    kinds: dict[ConditionKind, GoalKind] = {
        K.HELD: GoalKind.PICK,
        K.ON: GoalKind.CLEAR,
        K.EMPTY: GoalKind.CLEAR,
        K.IN: GoalKind.PLACE_IN,
        K.AT: GoalKind.MOVE,
        K.MOVED: GoalKind.PUSH,
        **dict.fromkeys(_TURNS, GoalKind.TURN),
        **dict.fromkeys(_ASIDE_KINDS, GoalKind.PLACE_BESIDE),
        **dict.fromkeys(_ARRANGED, GoalKind.SORT),
    }
    return kinds[c.kind]
