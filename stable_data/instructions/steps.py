"""Tasks of several steps: joins tasks of simple kinds about different objects."""

from collections.abc import Sequence
from dataclasses import dataclass

from stable_data.condition import ConditionKind, GoalCondition
from stable_data.instructions.kind import TaskDraft, TaskKind
from stable_data.instructions.naming import ObjectNamer
from stable_data.instructions.situation import TaskContext
from stable_data.instructions.wording.paraphrase import is_clause, reword
from stable_data.instructions.wording.vocabulary import answers_to

_MAX_TRIED = 24  # kinds of task that are tried for the steps


@dataclass(frozen=True, slots=True)
class MultiStepKind:
    """A kind of task that joins tasks of other kinds.

    Attributes:
        name: Unique.
        kinds: The kinds of its steps.
        texts: Templates with ``{a}``, ``{b}`` and so on for the steps, each a clause.
        order: The order in which the steps of a text are done.
    """

    name: str
    kinds: Sequence[TaskKind]
    texts: tuple[str, ...]
    order: tuple[int, ...]

    def draft(self, context: TaskContext, namer: ObjectNamer) -> TaskDraft | None:
        """Returns a task with one step for each entry of ``order``, or None if none was found in the scene."""
        steps: list[TaskDraft] = []
        for kind in context.shuffled(self.kinds)[:_MAX_TRIED]:
            step = kind.draft(context, namer)
            if step is not None and is_clause(step.text) and all(_are_apart(step, other, namer) for other in steps):
                steps.append(step)
            if len(steps) == len(self.order):
                return self._joined(steps, context)
        return None

    def _joined(self, steps: Sequence[TaskDraft], context: TaskContext) -> TaskDraft:
        text = reword(context.pick(self.texts), context.rng)
        done = [steps[k] for k in self.order]
        return TaskDraft(
            text.format_map({letter: step.text for letter, step in zip("abc", steps, strict=False)}),
            tuple(goal for step in done for goal in step.goal),
            tuple(action for step in done for action in step.actions),
            tuple(name for step in done for name in step.objects),
            tuple(noun for step in done for noun in step.nouns),
            tuple(sorted({relation for step in done for relation in step.relations})),
            conditions=_joined_conditions(done),
        )


def _joined_conditions(done: Sequence[TaskDraft]) -> tuple[GoalCondition, ...]:
    """The conditions of all steps; none if they do not state the goal.

    What is held or handed over is so at the end, so it can only be asked for in the last step.
    """
    is_late = not any(c.kind is ConditionKind.HELD for step in done[:-1] for c in step.conditions)
    return tuple(c for step in done for c in step.conditions) if is_late and all(step.conditions for step in done) else ()


def _are_apart(one: TaskDraft, other: TaskDraft, namer: ObjectNamer) -> bool:
    """Whether no noun of one step matches an object of the other step."""
    pairs = ((a, noun) for step, rest in ((one, other), (other, one)) for a in step.objects for noun in rest.nouns)
    return not any(answers_to(namer.objects[a].category, noun) for a, noun in pairs)


def steps_of(kinds: Sequence[TaskKind]) -> tuple[MultiStepKind, ...]:
    """Returns the kinds of task that join tasks of ``kinds``."""
    return (
        MultiStepKind(
            "two_steps",
            kinds,
            (
                "{a}, [then] {b}",
                "{a} and [then|after that] {b}",
                "first {a}. After that, {b}.",
                "start by doing this: {a}. Once that is done, {b}.",
                "two things are to be done: first {a}, then {b}.",
            ),
            (0, 1),
        ),
        MultiStepKind(
            "before",
            kinds,
            (
                "before you {a}, {b}.",
                "{a}, but first {b}",
                "{b}, and only then {a}",
            ),
            (1, 0),
        ),
        MultiStepKind(
            "three_steps",
            kinds,
            (
                "{a}, [then] {b}, and finally {c}",
                "first {a}. Then {b}. Finally, {c}.",
                "there are three things to do: {a}, {b}, and {c}.",
                "step one: {a}. Step two: {b}. Step three: {c}.",
            ),
            (0, 1, 2),
        ),
    )
