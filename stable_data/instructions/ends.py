"""What holds when a task of a kind is done: templates of conditions, whose roles are instances."""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass

from stable_data.condition import GROUP_KINDS, NAME_SEPARATOR, ConditionKind, GoalCondition


@dataclass(frozen=True, slots=True)
class End:
    """A template of conditions.

    ``kind``, ``target`` and ``distance_cm`` may contain words of the roles in braces.

    Attributes:
        subject: A role, each of whose instances has a condition (of a kind for groups, all have one together); or text with words in
            braces that are instances.
        kind: A value of :class:`ConditionKind`.
        target: A role, several joined by a comma and a space, or text.
        distance_cm: Centimetres, or empty.
        is_negated: Whether it must not hold.
        is_chain: Whether only the first instance of the subject has this target, and each other one the instance before it.
    """

    subject: str
    kind: str
    target: str = ""
    distance_cm: str = ""
    is_negated: bool = False
    is_chain: bool = False

    def filled(self, by_role: Mapping[str, Sequence[str]], words: Mapping[str, object]) -> Iterator[GoalCondition]:
        """Yields the conditions for the instances of the roles.

        Args:
            by_role: The instances of each role.
            words: The other words of the template.
        """
        kind = ConditionKind(self.kind.format_map(words))
        subjects = by_role.get(self.subject) or self.subject.format_map(words).split(NAME_SEPARATOR)
        roles = self.target.split(NAME_SEPARATOR)
        if all(role in by_role for role in roles):
            target = NAME_SEPARATOR.join(by_role[role][0] for role in roles)
        else:
            target = self.target.format_map(words).removesuffix(" side").replace(" ", "_")
        distance = int(self.distance_cm.format_map(words)) / 100 if self.distance_cm else None
        if kind in GROUP_KINDS:
            subjects = (NAME_SEPARATOR.join(subjects),)
        for subject in subjects:
            if target or not self.is_chain:
                yield GoalCondition(subject, kind, target, distance, self.is_negated)
            if self.is_chain:
                target = subject
