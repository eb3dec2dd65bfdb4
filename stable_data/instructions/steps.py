"""Tasks of several steps: tasks of other kinds about different objects, joined as one would say them."""

from collections.abc import Sequence
from dataclasses import dataclass

from stable_data.instructions.kind import TaskDraft, TaskKind
from stable_data.instructions.naming import ObjectNamer
from stable_data.instructions.situation import TaskContext
from stable_data.instructions.wording.paraphrase import is_clause, reword
from stable_data.instructions.wording.vocabulary import answers_to

_MOST_TRIED = 24  # kinds of task that a step may be sought among


@dataclass(frozen=True, slots=True)
class MultiStepKind:
    """A kind of task that joins others.

    Attributes:
        name: Unique.
        kinds: What may be joined.
        texts: With ``{a}``, ``{b}`` and so on for the steps, each a clause.
        order: In which order the steps of a text are done.
    """

    name: str
    kinds: Sequence[TaskKind]
    texts: tuple[str, ...]
    order: tuple[int, ...]

    def tell(self, situation: TaskContext, namer: ObjectNamer) -> TaskDraft | None:
        """A task of so many steps, or None where the scene has none."""
        told: list[TaskDraft] = []
        for kind in situation.mixed(self.kinds)[:_MOST_TRIED]:
            step = kind.tell(situation, namer)
            if step is not None and is_clause(step.text) and all(_are_apart(step, other, namer) for other in told):
                told.append(step)
            if len(told) == len(self.order):
                return self._joined(told, situation)
        return None

    def _joined(self, told: Sequence[TaskDraft], situation: TaskContext) -> TaskDraft:
        text = reword(situation.pick(self.texts), situation.rng)
        done = [told[k] for k in self.order]
        return TaskDraft(
            text.format_map({letter: step.text for letter, step in zip("abc", told, strict=False)}),
            tuple(goal for step in done for goal in step.goal),
            tuple(action for step in done for action in step.actions),
            tuple(name for step in done for name in step.objects),
            tuple(noun for step in done for noun in step.nouns),
            tuple(sorted({relation for step in done for relation in step.relations})),
        )


def _are_apart(one: TaskDraft, other: TaskDraft, namer: ObjectNamer) -> bool:
    """Does neither step speak of what the other moves, or of a thing that the other's words could mean?"""
    pairs = ((a, noun) for step, rest in ((one, other), (other, one)) for a in step.objects for noun in rest.nouns)
    return not any(answers_to(namer.objects[a].category, noun) for a, noun in pairs)


def steps_of(kinds: Sequence[TaskKind]) -> tuple[MultiStepKind, ...]:
    """The kinds of task that join others.

    Args:
        kinds: What may be joined.
    """
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
